//! Redis as a cache, and who lives.
//!
//! ```text
//! set_state ─► watchdog task ─► blaze:watchdog:<service>:<node>:<instance>, every third of its time to live
//!                            └► without Redis: a message on blaze/watchdog
//! wait_for  ◄─ records, or messages: until each service has an instance that is ready
//! ```

mod record;
mod store;
#[cfg(test)]
mod tests;
mod wait;
mod watchdog;

use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use blaze_brokers::Broker;
use blaze_brokers::redis::KeyError;
use blaze_domain::ServiceName;
pub use blaze_domain::config::ServiceState;
use blaze_runtime::{Supervisor, TaskPolicy};
use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::{Notify, watch};

pub(crate) use store::Store;

use crate::config::Shown;
use crate::service::{Identity, now_ms};

/// Between two looks at the records of those that are waited for.
const LOOK: Duration = Duration::from_millis(250);
/// Instances of one service that are looked at, at most.
const MAX_INSTANCES: usize = 1_024;
/// Longest key of a value, in bytes.
pub const MAX_CACHE_KEY_BYTES: usize = 200;
/// Largest value, in bytes (1 MiB).
pub const MAX_CACHE_VALUE_BYTES: usize = 1024 * 1024;
/// Longest time that a value may stay (30 days).
pub const MAX_CACHE_TIME: Duration = Duration::from_secs(30 * 24 * 3600);

/// Why the cache did not do it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CacheError {
    /// The service was started without a Redis.
    #[error("the service has no cache: give ServiceOptions::cache a Redis")]
    None,
    /// The Redis does not answer or refuses.
    #[error(transparent)]
    Key(#[from] KeyError),
    /// A key, value or time that may not be.
    #[error("{what} {reason}")]
    Invalid {
        /// Which of them.
        what: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// Services that were not ready in time.
    #[error("not ready within {within:?}: {}", names(.services))]
    NotReady {
        /// Which ones.
        services: Vec<ServiceName>,
        /// How long it was waited.
        within: Duration,
    },
    /// The broker on which services say that they live refused or was closed.
    #[error(transparent)]
    Broker(#[from] blaze_brokers::BrokerError),
}

fn names(services: &[ServiceName]) -> String {
    let names: Vec<&str> = services.iter().map(ServiceName::as_str).collect();
    names.join(", ")
}

/// Whether others can see that the service lives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Liveness {
    /// It does not say so: nobody called [`CacheManager::set_state`], or it has no node to be named
    /// by.
    Off,
    /// It said so lately.
    Alive,
    /// It cannot say so: Redis or the broker is away. It tries again.
    Silent,
    /// A newer process of the same service, node and instance says so. This one does not until that
    /// one has ended.
    Superseded,
    /// It said that it ends.
    Ended,
}

/// How a service says that it lives.
pub(crate) struct WatchdogOptions {
    /// Version of the program.
    pub(crate) version: String,
    /// Where its metrics are served; empty where they are not.
    pub(crate) metrics: String,
    /// How long a sign counts.
    pub(crate) ttl: Duration,
    /// The number of its life is the time at which it began. Clocks go back; whoever begins is the
    /// newer one all the same.
    pub(crate) by_clock: bool,
}

/// What the service says of itself.
#[derive(Debug, Clone)]
struct Said {
    state: ServiceState,
    since_ms: u64,
    is_on: bool,
    ending: bool,
}

struct Shared {
    identity: Identity,
    /// Key of its record; `None` where it has no node.
    key: Option<String>,
    broker: Arc<dyn Broker>,
    store: Option<Arc<dyn Store>>,
    watchdog: WatchdogOptions,
    /// Number of this life, as it is said.
    epoch: AtomicU64,
    config: watch::Receiver<Shown>,
    said: Mutex<Said>,
    /// What is said has changed.
    wake: Notify,
    liveness: watch::Sender<Liveness>,
    /// The state, once there is one, for `/readyz`.
    state: watch::Sender<Option<ServiceState>>,
}

/// How a service says that it lives, waits for others that do, and keeps values for a while.
#[derive(Clone)]
pub struct CacheManager {
    shared: Arc<Shared>,
}

impl CacheManager {
    pub(crate) fn start(
        identity: Identity,
        broker: Arc<dyn Broker>,
        store: Option<Arc<dyn Store>>,
        watchdog: WatchdogOptions,
        config: watch::Receiver<Shown>,
        supervisor: &Supervisor,
    ) -> Self {
        let shared = Arc::new(Shared {
            key: record::key(&identity),
            epoch: AtomicU64::new(identity.epoch),
            identity,
            broker,
            store,
            watchdog,
            config,
            said: Mutex::new(Said {
                state: ServiceState::Starting,
                since_ms: now_ms(),
                is_on: false,
                ending: false,
            }),
            wake: Notify::new(),
            liveness: watch::Sender::new(Liveness::Off),
            state: watch::Sender::new(None),
        });
        let (running, stop) = (Arc::clone(&shared), supervisor.shutdown_token());
        supervisor.spawn("watchdog", TaskPolicy::MayEnd, async move {
            tokio::select! {
                () = stop.cancelled() => {}
                () = watchdog::run(&running) => {}
            }
        });
        Self { shared }
    }

    /// Says how the service is: at once, and again every third of `watchdog_ttl`. The first call
    /// begins it; a service that never calls it is not watched by anybody. `Stopping` does not end
    /// it: that does [`crate::ServiceManager::shutdown`].
    pub fn set_state(&self, state: ServiceState) {
        {
            let mut said = self.shared.said.lock();
            if said.is_on && said.state == state {
                return;
            }
            if said.state != state {
                said.state = state;
                said.since_ms = now_ms();
            }
            said.is_on = true;
            self.shared.state.send_replace(Some(state));
        }
        self.shared.wake.notify_one();
    }

    /// The state that was set last, and its changes.
    pub(crate) fn state(&self) -> watch::Receiver<Option<ServiceState>> {
        self.shared.state.subscribe()
    }

    /// Whether others can see that it lives, and the changes of that.
    #[must_use]
    pub fn liveness(&self) -> watch::Receiver<Liveness> {
        self.shared.liveness.subscribe()
    }

    /// Waits until each of these services has an instance that is `ready`, on whatever node, at the
    /// same time. Without Redis it hears of them at their pace: a third of their time to live, by
    /// default 5 s.
    ///
    /// # Errors
    /// [`CacheError::NotReady`] names those that are not; [`CacheError::Broker`].
    pub async fn wait_for(
        &self,
        services: &[ServiceName],
        timeout: Duration,
    ) -> Result<(), CacheError> {
        let missing = Mutex::new(services.to_vec());
        match tokio::time::timeout(timeout, watchdog::wait(&self.shared, services, &missing)).await
        {
            Ok(result) => Ok(result?),
            Err(_) => Err(CacheError::NotReady { services: missing.into_inner(), within: timeout }),
        }
    }

    /// A value that this service, whichever instance of it, has put there; `None` if there is none
    /// or its time is over.
    ///
    /// # Errors
    /// [`CacheError::None`], [`CacheError::Key`] or [`CacheError::Invalid`].
    pub async fn get(&self, key: &str) -> Result<Option<Bytes>, CacheError> {
        let key = self.key(key)?;
        Ok(self.store()?.get(&key).await?)
    }

    /// Keeps a value of at most 1 MiB for 1 ms to 30 days. The key has 1 to 200 bytes and belongs
    /// to this service.
    ///
    /// # Errors
    /// As [`CacheManager::get`].
    pub async fn put(&self, key: &str, value: Bytes, expires: Duration) -> Result<(), CacheError> {
        let invalid = |what, reason: String| CacheError::Invalid { what, reason };
        let key = self.key(key)?;
        if value.len() > MAX_CACHE_VALUE_BYTES {
            let reason =
                format!("has {} bytes, at most {MAX_CACHE_VALUE_BYTES} are allowed", value.len());
            return Err(invalid("the value", reason));
        }
        if !(Duration::from_millis(1)..=MAX_CACHE_TIME).contains(&expires) {
            let reason = format!("is {expires:?}, 1 ms to {MAX_CACHE_TIME:?} are allowed");
            return Err(invalid("the time", reason));
        }
        Ok(self.store()?.put(&key, &value, expires).await?)
    }

    fn store(&self) -> Result<&dyn Store, CacheError> {
        self.shared.store.as_deref().ok_or(CacheError::None)
    }

    fn key(&self, key: &str) -> Result<String, CacheError> {
        if key.is_empty() || key.len() > MAX_CACHE_KEY_BYTES || key.chars().any(char::is_control) {
            return Err(CacheError::Invalid {
                what: "the key",
                reason: format!(
                    "must have 1 to {MAX_CACHE_KEY_BYTES} bytes and no control characters"
                ),
            });
        }
        Ok(format!("blaze:cache:{}:{key}", self.shared.identity.service))
    }

    /// Takes leave: the record goes, and others need not wait until it vanishes.
    pub(crate) async fn leave(&self, within: Duration) {
        {
            let mut said = self.shared.said.lock();
            if !said.is_on {
                return;
            }
            said.ending = true;
            said.state = ServiceState::Stopping;
            said.since_ms = now_ms();
        }
        self.shared.wake.notify_one();
        let mut liveness = self.shared.liveness.subscribe();
        let has_ended = liveness.wait_for(|liveness| match liveness {
            Liveness::Ended | Liveness::Superseded => true,
            // Without a node nothing was ever said.
            Liveness::Off => self.shared.key.is_none(),
            Liveness::Alive | Liveness::Silent => false,
        });
        let _ = tokio::time::timeout(within, has_ended).await;
    }
}
