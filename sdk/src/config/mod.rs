//! The configuration of a service, from the worker of BlazeConfig.
//!
//! ```text
//! ConfigManager ─► ConfigBook (state machine) ◄─► driver task ─► blaze/config/get, blaze/config/ack
//!       │                                                     ◄─ reply channel, blaze/config/changed/<service>
//!       └─► listeners ─► callbacks on the pool
//! BaseConfiguration: the mounted file, and over it what the worker says
//! ProgramConfig: the same for a program that has a node file
//! ```

mod base;
mod book;
mod change;
mod driver;
mod listeners;
mod program;
#[cfg(test)]
mod program_tests;
#[cfg(test)]
mod tests;
mod typed;
mod wire;

use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::{Broker, PublishOutcome};
use blaze_domain::Scope;
use blaze_domain::names::ChannelName;
use blaze_runtime::{Supervisor, TaskPolicy};
use bytes::Bytes;
use parking_lot::Mutex;
use serde::de::DeserializeOwned;
use serde_json::Value;
use tokio::sync::{Notify, watch};

pub use base::{BaseConfiguration, BaseSource};
pub use blaze_domain::config::AckStatus;
pub use book::ConfigCounts;
use book::{ConfigBook, Standing};
pub(crate) use change::Held;
pub use change::{ConfigChange, ConfigScope, ConfigSource};
pub use listeners::ConfigListener;
use listeners::Listeners;
pub use program::ProgramConfig;

use crate::SdkError;
use crate::pool::PoolHandle;
use crate::reserved;
use crate::service::Identity;

/// Where acknowledgements go.
const ACK: &str = "blaze/config/ack";

/// Why there is no configuration, or none of that type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// No worker gave one yet.
    #[error("no configuration is there yet: {reason}")]
    NotReady {
        /// In the words of the worker, or that none answered.
        reason: String,
    },
    /// The service was deleted.
    #[error("the service was deleted at revision {revision}")]
    Deleted {
        /// When.
        revision: u64,
    },
    /// It does not fit the type that it was to be read into.
    #[error("the configuration does not fit: {reason}")]
    Type {
        /// What is wrong, without any value of the configuration.
        reason: String,
    },
    /// The mounted file cannot be used.
    #[error("{file}: {reason}")]
    File {
        /// The file as it was named.
        file: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The service was shut down, or its broker closed.
    #[error("closed")]
    Closed,
}

/// What the driver shows to all.
#[derive(Debug, Clone)]
pub(crate) struct Shown {
    standing: Standing,
    /// Why there is nothing.
    refusal: Option<String>,
    closed: bool,
}

impl Shown {
    pub(crate) fn held(&self) -> Option<&Held> {
        self.standing.held()
    }

    fn missing(&self) -> ConfigError {
        match &self.standing {
            Standing::Deleted { revision, .. } => ConfigError::Deleted { revision: *revision },
            Standing::Held(_) | Standing::Nothing if self.closed => ConfigError::Closed,
            Standing::Held(_) | Standing::Nothing => ConfigError::NotReady {
                reason: self.refusal.clone().unwrap_or_else(|| "no worker answered".to_owned()),
            },
        }
    }
}

struct Shared {
    identity: Identity,
    broker: Arc<dyn Broker>,
    book: Mutex<ConfigBook>,
    shown: watch::Sender<Shown>,
    listeners: Listeners,
    acks: Mutex<Option<Arc<dyn blaze_brokers::Publisher>>>,
    /// Somebody wants to know: from then on the service asks.
    wanted: Notify,
}

/// The service's configuration: what it is now, and callbacks when it changes. Asking begins with
/// the first call of [`ServiceManager::config`](crate::ServiceManager::config).
#[derive(Clone)]
pub struct ConfigManager {
    shared: Arc<Shared>,
}

impl ConfigManager {
    pub(crate) fn start(
        identity: Identity,
        scope: Scope,
        broker: Arc<dyn Broker>,
        supervisor: &Supervisor,
        pool: PoolHandle,
    ) -> Self {
        let life = rand::random::<u64>();
        let reply = ChannelName::reply(&identity.service, &identity.instance, life);
        let book =
            ConfigBook::new(identity.clone(), scope, life, reply.to_string(), reserved::now());
        let shared = Arc::new(Shared {
            identity,
            broker,
            book: Mutex::new(book),
            shown: watch::Sender::new(Shown {
                standing: Standing::Nothing,
                refusal: None,
                closed: false,
            }),
            listeners: Listeners::new(pool),
            acks: Mutex::new(None),
            wanted: Notify::new(),
        });
        let (running, stop) = (Arc::clone(&shared), supervisor.shutdown_token());
        supervisor.spawn("configuration", TaskPolicy::MayEnd, async move {
            tokio::select! {
                () = stop.cancelled() => {}
                () = driver::run(&running, reply) => {}
            }
            running.shown.send_modify(|shown| shown.closed = true);
        });
        Self { shared }
    }

    /// From now on the service asks.
    pub(crate) fn want(&self) {
        self.shared.wanted.notify_one();
    }

    pub(crate) fn shown(&self) -> watch::Receiver<Shown> {
        self.shared.shown.subscribe()
    }

    /// Waits until a worker has given a configuration, for so long.
    ///
    /// # Errors
    /// [`ConfigError::NotReady`] with the worker's words, [`ConfigError::Deleted`],
    /// [`ConfigError::Closed`].
    pub async fn ready(&self, timeout: Duration) -> Result<(), ConfigError> {
        let mut shown = self.shared.shown.subscribe();
        let is_there = shown.wait_for(|shown| shown.held().is_some() || shown.closed);
        let in_time = tokio::time::timeout(timeout, is_there).await.is_ok();
        let shown = self.shared.shown.borrow();
        match shown.held() {
            Some(_) if in_time => Ok(()),
            Some(_) | None => Err(shown.missing()),
        }
    }

    /// What it is now; `None`: no worker gave one yet, or the service was deleted.
    #[must_use]
    pub fn value(&self) -> Option<Arc<Value>> {
        self.held(|held| Arc::clone(&held.config))
    }

    /// What it is now, as a type.
    ///
    /// # Errors
    /// [`ConfigError::NotReady`], [`ConfigError::Deleted`] or [`ConfigError::Type`].
    pub fn typed<T: DeserializeOwned>(&self) -> Result<T, ConfigError> {
        let Some(config) = self.value() else {
            return Err(self.shared.shown.borrow().missing());
        };
        typed::read(&config)
    }

    /// Its revision: where the store stood when it became what it is.
    #[must_use]
    pub fn revision(&self) -> Option<u64> {
        self.held(|held| held.revision)
    }

    /// Its hash, `sha256:…`.
    #[must_use]
    pub fn hash(&self) -> Option<String> {
        self.held(|held| held.hash.clone())
    }

    /// From where the worker had it when it last said so.
    #[must_use]
    pub fn source(&self) -> Option<ConfigSource> {
        self.held(|held| held.source)
    }

    /// What was asked, told and left alone so far.
    #[must_use]
    pub fn counts(&self) -> ConfigCounts {
        self.shared.book.lock().counts()
    }

    fn held<T>(&self, read: impl FnOnce(&Held) -> T) -> Option<T> {
        self.shared.shown.borrow().held().map(read)
    }

    /// Calls back for each change from now on, also for the first configuration if it comes later
    /// than this call, on the service's pool, in order, one at a time. A callback that is more than
    /// 16 changes behind gets its last two as one. Whoever must not miss the first one looks at
    /// [`ConfigManager::value`] once afterwards.
    pub fn on_change(
        &self,
        callback: impl Fn(&ConfigChange) + Send + Sync + 'static,
    ) -> ConfigListener {
        self.shared.listeners.add(&[], Box::new(callback))
    }

    /// As [`ConfigManager::on_change`], when the layer's document changed, or may have
    /// ([`ConfigChange::scopes`]).
    pub fn on_layer_change(
        &self,
        callback: impl Fn(&ConfigChange) + Send + Sync + 'static,
    ) -> ConfigListener {
        self.shared.listeners.add(&[ConfigScope::Layer], Box::new(callback))
    }

    /// As [`ConfigManager::on_change`], when the node's document changed, or may have.
    pub fn on_node_change(
        &self,
        callback: impl Fn(&ConfigChange) + Send + Sync + 'static,
    ) -> ConfigListener {
        self.shared.listeners.add(&[ConfigScope::Node], Box::new(callback))
    }

    /// As [`ConfigManager::on_change`], when the document of the service or of its instance
    /// changed, or may have.
    pub fn on_service_change(
        &self,
        callback: impl Fn(&ConfigChange) + Send + Sync + 'static,
    ) -> ConfigListener {
        let scopes = [ConfigScope::Service, ConfigScope::Instance];
        self.shared.listeners.add(&scopes, Box::new(callback))
    }

    /// Tells workers how the service gets on with the configuration that it has now. A staged
    /// roll-out is undone by `rejected` and `unhealthy`. Of the detail, 4 KiB are sent. In a
    /// callback, while which the next configuration may come, use [`ConfigManager::ack_change`].
    ///
    /// # Errors
    /// [`SdkError::Broker`], when the broker cannot carry it at all. One that is away drops it,
    /// which is an outcome.
    pub fn ack(&self, status: AckStatus, detail: &str) -> Result<PublishOutcome, SdkError> {
        let held = self.held(|held| (held.revision, held.hash.clone()));
        self.ack_of(
            held.as_ref().map(|(revision, hash)| (*revision, hash.as_str())),
            status,
            detail,
        )
    }

    /// The same of the configuration that a change has brought, whatever came since.
    ///
    /// # Errors
    /// As [`ConfigManager::ack`].
    pub fn ack_change(
        &self,
        change: &ConfigChange,
        status: AckStatus,
        detail: &str,
    ) -> Result<PublishOutcome, SdkError> {
        let of = change.hash.as_deref().map(|hash| (change.revision, hash));
        self.ack_of(of, status, detail)
    }

    /// The same of a configuration that may not be the newest any more: its revision and hash.
    pub(crate) fn ack_of(
        &self,
        of: Option<(u64, &str)>,
        status: AckStatus,
        detail: &str,
    ) -> Result<PublishOutcome, SdkError> {
        let text = wire::ack(&self.shared.identity, of, status, detail);
        let publisher = {
            let mut acks = self.shared.acks.lock();
            match &*acks {
                Some(publisher) => Arc::clone(publisher),
                None => {
                    let channel = reserved::channel(ACK)?;
                    let publisher = self
                        .shared
                        .broker
                        .publisher(&channel, reserved::speaking(self.shared.broker.kind()))?;
                    Arc::clone(acks.insert(publisher))
                }
            }
        };
        Ok(publisher.publish_bare(&Bytes::from(text), None))
    }
}
