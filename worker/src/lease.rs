//! Of several workers of one layer, one answers and notifies: the one that holds the lease.
//!
//! ```text
//! each third of the lease: hold ─ yes ─▶ leader until the time of asking + nine tenths of the lease
//!                               ─ no ──▶ not the leader; looks again after a twentieth of the lease
//!                               ─ ? ───▶ as before, until that time is over
//! ```

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use blaze_brokers::redis::RedisKeys;
use blaze_domain::LayerName;
use tokio::sync::watch;
use tokio::time::Instant;

/// Where the lease lies.
#[async_trait]
pub trait Lease: Send + Sync + 'static {
    /// Takes it if nobody has it, or goes on having it, for so long from now. Returns whether it is had.
    ///
    /// # Errors
    /// For people: nobody knows.
    async fn hold(&self, time: Duration) -> Result<bool, String>;

    /// Gives it up; if that fails it runs out.
    async fn release(&self);
}

/// A key of Redis.
pub struct RedisLease {
    keys: Arc<RedisKeys>,
    key: String,
    owner: String,
}

impl RedisLease {
    /// The lease of a layer, for a worker.
    #[must_use]
    pub fn new(keys: Arc<RedisKeys>, layer: &LayerName, owner: String) -> Self {
        Self {
            keys,
            key: format!("blaze:lease:worker:{layer}"),
            owner,
        }
    }
}

#[async_trait]
impl Lease for RedisLease {
    async fn hold(&self, time: Duration) -> Result<bool, String> {
        self.keys
            .hold(&self.key, &self.owner, time)
            .await
            .map_err(|error| error.to_string())
    }

    async fn release(&self) {
        if let Err(error) = self.keys.release(&self.key, &self.owner).await {
            tracing::debug!(%error, "the lease was not given up; it runs out");
        }
    }
}

/// Holds it as long as it can, for ever, and says whether it has it. Whoever cancels this gives it up with
/// [`Lease::release`].
pub async fn keep(lease: Arc<dyn Lease>, time: Duration, leader: watch::Sender<bool>) {
    let mut until: Option<Instant> = None;
    // Whoever waits looks often, and what is held is a little shorter, so that together they are no longer than the lease.
    let (held, renew, look) = (time * 9 / 10, time / 3, time / 20);
    loop {
        // The lease counts from before it was asked for: the server began later.
        let asked = Instant::now();
        match tokio::time::timeout(renew, lease.hold(held)).await {
            Ok(Ok(true)) => until = Some(asked + held),
            Ok(Ok(false)) => until = None,
            Ok(Err(error)) => tracing::debug!(error, "nobody knows who has the lease"),
            Err(_) => tracing::debug!("no answer about the lease"),
        }
        set(&leader, until);
        let next = asked + if until.is_some() { renew } else { look };
        match until.filter(|until| *until < next) {
            Some(over) => {
                tokio::time::sleep_until(over).await;
                set(&leader, until);
            }
            None => tokio::time::sleep_until(next).await,
        }
    }
}

fn set(leader: &watch::Sender<bool>, until: Option<Instant>) {
    let is_leader = until.is_some_and(|until| Instant::now() < until);
    leader.send_if_modified(|was| std::mem::replace(was, is_leader) != is_leader);
}

#[cfg(test)]
mod tests {
    use parking_lot::Mutex;
    use tokio::task::JoinSet;

    use super::*;

    const TIME: Duration = Duration::from_secs(5);

    /// A server that may be away.
    #[derive(Default)]
    struct Server {
        held: Mutex<Option<(String, Instant)>>,
        is_away: Mutex<bool>,
    }

    struct OnServer {
        server: Arc<Server>,
        owner: &'static str,
    }

    #[async_trait]
    impl Lease for OnServer {
        async fn hold(&self, time: Duration) -> Result<bool, String> {
            if *self.server.is_away.lock() {
                return Err("away".to_owned());
            }
            let mut held = self.server.held.lock();
            let now = Instant::now();
            let is_free = held
                .as_ref()
                .is_none_or(|(owner, until)| owner == self.owner || *until <= now);
            if is_free {
                *held = Some((self.owner.to_owned(), now + time));
            }
            Ok(is_free)
        }

        async fn release(&self) {
            self.server.held.lock().take_if(|(owner, _)| owner == self.owner);
        }
    }

    fn start(server: &Arc<Server>, owner: &'static str) -> (watch::Receiver<bool>, JoinSet<()>) {
        let (send, leader) = watch::channel(false);
        let lease = Arc::new(OnServer {
            server: Arc::clone(server),
            owner,
        });
        let mut tasks = JoinSet::new();
        tasks.spawn(keep(lease, TIME, send));
        (leader, tasks)
    }

    #[tokio::test(start_paused = true)]
    async fn the_other_one_takes_over_within_one_lease_and_there_are_never_two() {
        let server = Arc::new(Server::default());
        let (mut one, tasks) = start(&server, "one");
        one.wait_for(|leader| *leader).await.unwrap();
        let (mut other, _tasks) = start(&server, "other");
        tokio::time::sleep(TIME * 3).await;
        assert!(*one.borrow() && !*other.borrow());
        let died = Instant::now();
        drop(tasks);
        other.wait_for(|leader| *leader).await.unwrap();
        assert!(died.elapsed() <= TIME, "{:?}", died.elapsed());
    }

    #[tokio::test(start_paused = true)]
    async fn whoever_cannot_renew_it_stops_before_another_may_begin() {
        let server = Arc::new(Server::default());
        let (mut one, _tasks) = start(&server, "one");
        one.wait_for(|leader| *leader).await.unwrap();
        *server.is_away.lock() = true;
        let until = server.held.lock().as_ref().unwrap().1;
        one.wait_for(|leader| !*leader).await.unwrap();
        assert!(Instant::now() <= until);
        *server.is_away.lock() = false;
        one.wait_for(|leader| *leader).await.unwrap();
    }
}
