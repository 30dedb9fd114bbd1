//! Of several workers of one layer, one answers and notifies: the one that holds the lease.
//!
//! ```text
//! each third of the lease: hold ─ yes ─▶ leader until the time of asking + nine tenths of the lease
//!                               ─ no ──▶ not the leader; looks again after a twentieth of the lease
//!                               ─ ? ───▶ as before, until that time is over
//! ```
//!
//! It lies in the layer's MongoDB (`MongoLease`), else in Redis ([`RedisLease`]), else it is
//! membership of a consumer group on the layer's Kafka ([`KafkaLease`]). Beside it lies how far
//! services were told ([`Mark`]): the worker that takes over tells the rest. A node on Redis has a
//! lease for the case that two workers run under its name: the one that was started last serves.

#[cfg(feature = "conformance")]
pub mod conformance;
#[cfg(feature = "kafka")]
mod kafka;
mod mark;
#[cfg(feature = "mongodb")]
mod mongo;
mod open;
mod redis;
mod term;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use blaze_brokers::redis::RedisLock;
use blaze_runtime::{BEAT, on_beat};
use tokio::time::Instant;

#[cfg(feature = "kafka")]
pub use kafka::KafkaLease;
pub use mark::Mark;
#[cfg(feature = "mongodb")]
pub use mongo::MongoLease;
pub use open::open;
pub use redis::RedisLease;
pub use term::{Holder, Leadership, Term, leadership};

/// What became of asking for a lease.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Held {
    /// Whether it is had.
    pub is_held: bool,
    /// How far services were told; `None`: nobody knows.
    pub told: Option<Mark>,
    /// On a node, where one is meant to run: the worker that has it instead, for people.
    pub by: Option<String>,
}

/// Where the lease lies.
#[async_trait]
pub trait Lease: Send + Sync + 'static {
    /// Takes it if nobody has it, or goes on having it, for so long from now. Whoever had it before
    /// leaves `told` beside it; whoever takes it does not, and gets what the one before has left.
    ///
    /// # Errors
    /// For people: nobody knows.
    async fn hold(&self, time: Duration, told: Option<&Mark>) -> Result<Held, String>;

    /// Gives it up; if that fails it runs out.
    async fn release(&self);

    /// By what a Redis itself can tell whether it is held, if it lies there.
    fn lock(&self) -> Option<&RedisLock> {
        None
    }

    /// Where it lies, for people; without secrets.
    fn describe(&self) -> String;
}

/// Holds it as long as it can, for ever, and says whether it has it. Whoever cancels this gives it
/// up with [`Lease::release`].
pub async fn keep(lease: Arc<dyn Lease>, time: Duration, holder: &mut Holder) {
    let mut until: Option<Instant> = None;
    // Whoever waits looks often, and what is held is a little shorter, so that together they are no
    // longer than the lease.
    let (held, renew, look) = (time * 9 / 10, time / 3, time / 20);
    loop {
        // The lease counts from before it was asked for: the server began later.
        let asked = Instant::now();
        // Whoever was stopped in between learns first that its time is over.
        until = until.filter(|until| asked < *until);
        holder.lead(until);
        let told = until.and_then(|_| holder.told());
        match tokio::time::timeout(renew, lease.hold(held, told.as_ref())).await {
            Ok(Ok(answer)) => {
                holder.note(answer.told);
                holder.note_rival(answer.by);
                until = answer.is_held.then(|| asked + held);
            }
            Ok(Err(error)) => tracing::debug!(error, "nobody knows who has the lease"),
            Err(_) => tracing::debug!("no answer about the lease"),
        }
        holder.lead(until);
        let next = asked + if until.is_some() { renew } else { look };
        // Short leases have no room for that.
        let next = if look >= BEAT { on_beat(next) } else { next };
        match until.filter(|until| *until < next) {
            Some(over) => {
                tokio::time::sleep_until(over).await;
                holder.lead(until);
            }
            None => tokio::time::sleep_until(next).await,
        }
    }
}

/// Nothing is told from now on, and the lease is taken no more.
pub async fn give_up(lease: &dyn Lease, holder: &mut Holder) {
    holder.lead(None);
    lease.release().await;
}

#[cfg(test)]
mod tests;
