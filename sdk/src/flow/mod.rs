//! Advertising and requesting topics.
//!
//! ```text
//! FlowManager ─► LeaseBook (state machine) ◄─► driver task ─► blaze/flow/control
//!                                                          ◄─ own reply topic, blaze/flow/events
//! ```

mod book;
mod driver;
mod terms;

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::Broker;
use blaze_domain::TopicName;
use blaze_domain::control::ControlMessage;
pub use blaze_domain::control::{
    ErrorCode as RefusalCode, Event as FlowEvent, EventKind as FlowEventKind,
    OriginSelector as OriginFilter,
};
use blaze_domain::names::ChannelName;
use blaze_runtime::{Supervisor, TaskPolicy};
use parking_lot::Mutex;
use tokio::sync::{Notify, broadcast, oneshot};

use book::{AskResult, Claim, LeaseBook};
pub use terms::{Advertise, Request};

use crate::service::Identity;

/// Events that wait for a listener at most; the oldest give way.
const EVENT_QUEUE: usize = 256;

/// Why there is no lease.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FlowError {
    /// A flow refused it.
    #[error("refused: {code} at {pointer:?}: {detail}")]
    Refused {
        /// Why.
        code: RefusalCode,
        /// Which field is the cause: a JSON pointer, or empty.
        pointer: String,
        /// For people.
        detail: String,
        /// The flow, `layer/node`, if it said so.
        flow: Option<String>,
    },
    /// No flow answered in time. It may still have taken effect; the SDK withdraws it.
    #[error("no flow answered; it was sent {attempts} times")]
    NoAnswer {
        /// How often it was sent; 0 = the broker was away.
        attempts: u32,
    },
    /// A value that no flow would accept.
    #[error("{field} {reason}")]
    Invalid {
        /// The field.
        field: &'static str,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// The service holds as many leases as there can be.
    #[error("more than {0} leases")]
    TooManyLeases(usize),
    /// The service was shut down, the broker closed, or the lease withdrawn meanwhile.
    #[error("closed")]
    Closed,
}

impl FlowError {
    /// Whether the same again may succeed later.
    #[must_use]
    pub fn may_retry(&self) -> bool {
        match self {
            Self::NoAnswer { .. } | Self::TooManyLeases(_) => true,
            Self::Refused { code, .. } => matches!(code, RefusalCode::TooManyLeases),
            Self::Invalid { .. } | Self::Closed => false,
        }
    }
}

/// How a lease is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LeaseState {
    /// No flow has answered yet.
    Asking,
    /// A flow agreed to it, and it is renewed.
    Held,
    /// It was withdrawn, or a newer process of the same identity has it; when that one has ended, it
    /// is held again.
    Ended,
}

struct Shared {
    identity: Identity,
    book: Mutex<LeaseBook>,
    /// The book has something to send.
    wake: Notify,
    /// The book may have changed.
    changed: Notify,
    events: broadcast::Sender<FlowEvent>,
    control_timeout: Duration,
}

/// Tells flows what the service publishes and what it wants to receive.
#[derive(Clone)]
pub struct FlowManager {
    shared: Arc<Shared>,
}

impl FlowManager {
    pub(crate) fn start(
        identity: Identity,
        broker: Arc<dyn Broker>,
        supervisor: &Supervisor,
        ttl_s: u32,
        control_timeout: Duration,
    ) -> Self {
        let life = rand::random::<u64>();
        let reply = ChannelName::reply(&identity.service, &identity.instance, life);
        let shared = Arc::new(Shared {
            identity,
            book: Mutex::new(LeaseBook::new(
                reply.clone(),
                format!("{life:016x}"),
                ttl_s,
                Box::new(rand::random::<f64>),
            )),
            wake: Notify::new(),
            changed: Notify::new(),
            events: broadcast::Sender::new(EVENT_QUEUE),
            control_timeout,
        });
        let (running, stop) = (Arc::clone(&shared), supervisor.shutdown_token());
        supervisor.spawn("leases", TaskPolicy::MayEnd, async move {
            tokio::select! {
                () = stop.cancelled() => running.book.lock().close(),
                () = driver::run(Arc::clone(&running), broker, reply) => {}
            }
            running.changed.notify_waiters();
        });
        Self { shared }
    }

    /// Tells that the service publishes a topic, and waits for a flow to agree. The lease renews
    /// itself. Advertising a topic that the service advertises already changes the terms; the lease
    /// ends with its last holder.
    ///
    /// # Errors
    /// [`FlowError`]: refused, no answer within `control_timeout`, or a value that cannot be.
    pub async fn advertise(&self, advertise: Advertise) -> Result<Lease, FlowError> {
        let message = advertise.message(&self.shared.identity)?;
        self.ask(ControlMessage::Advertise(message)).await
    }

    /// Tells that the service wants to receive a topic; as [`FlowManager::advertise`] otherwise.
    ///
    /// # Errors
    /// As [`FlowManager::advertise`].
    pub async fn request(&self, request: Request) -> Result<Lease, FlowError> {
        let message = request.message(&self.shared.identity)?;
        self.ask(ControlMessage::Request(message)).await
    }

    /// What flows tell to all from now on.
    #[must_use]
    pub fn events(&self) -> FlowEvents {
        FlowEvents { receiver: self.shared.events.subscribe(), missed: 0 }
    }

    async fn ask(&self, message: ControlMessage) -> Result<Lease, FlowError> {
        let (answer, answered) = oneshot::channel();
        let claim = self.shared.book.lock().ask(message, answer, driver::now())?;
        self.shared.wake.notify_one();
        // From here on dropping it withdraws, also when the caller stops waiting.
        let lease = Lease { shared: Arc::clone(&self.shared), claim, left: false };
        self.shared.answered(&lease.claim, answered).await?;
        Ok(lease)
    }

    /// Withdraws everything, and waits for the flow to know.
    pub(crate) async fn leave(&self, within: Duration) {
        self.shared.book.lock().leave_all(driver::now());
        self.shared.wake.notify_one();
        let gone = async {
            loop {
                let changed = self.shared.changed.notified();
                if self.shared.book.lock().is_empty() {
                    return;
                }
                changed.await;
            }
        };
        let _ = tokio::time::timeout(within, gone).await;
    }
}

impl Shared {
    async fn answered(&self, claim: &Claim, answered: oneshot::Receiver<AskResult>) -> AskResult {
        match tokio::time::timeout(self.control_timeout, answered).await {
            Ok(Ok(result)) => result,
            Ok(Err(_)) => Err(FlowError::Closed),
            Err(_) => Err(FlowError::NoAnswer { attempts: self.book.lock().attempts(claim) }),
        }
    }
}

/// What the service advertises or requests, as long as it is held. Dropping it withdraws it in the
/// background.
#[must_use = "dropping a lease withdraws it"]
pub struct Lease {
    shared: Arc<Shared>,
    claim: Claim,
    left: bool,
}

impl Lease {
    /// The topic.
    #[must_use]
    pub fn topic(&self) -> &TopicName {
        &self.claim.key.topic
    }

    /// How it is.
    #[must_use]
    pub fn state(&self) -> LeaseState {
        self.shared.book.lock().state(&self.claim)
    }

    /// Gives it back and waits until the flow knows.
    ///
    /// # Errors
    /// [`FlowError::NoAnswer`]: the lease lapses by itself. [`FlowError::Refused`]: the flow did not accept the withdraw.
    pub async fn withdraw(mut self) -> Result<(), FlowError> {
        let (done, answered) = oneshot::channel();
        self.left = true;
        self.shared.book.lock().leave(&self.claim, Some(done), driver::now());
        self.shared.wake.notify_one();
        self.shared.answered(&self.claim, answered).await
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        if !self.left {
            self.shared.book.lock().leave(&self.claim, None, driver::now());
            self.shared.wake.notify_one();
        }
    }
}

impl fmt::Debug for Lease {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Lease")
            .field("kind", &self.claim.key.kind)
            .field("topic", &self.claim.key.topic)
            .field("state", &self.state())
            .finish_non_exhaustive()
    }
}

/// What flows tell to all, one by one. A listener that is more than 256 behind misses the oldest.
pub struct FlowEvents {
    receiver: broadcast::Receiver<FlowEvent>,
    missed: u64,
}

impl FlowEvents {
    /// The next event; `None` when the service is gone. Cancelling it loses nothing.
    pub async fn next(&mut self) -> Option<FlowEvent> {
        loop {
            match self.receiver.recv().await {
                Ok(event) => return Some(event),
                Err(broadcast::error::RecvError::Lagged(count)) => self.missed += count,
                Err(broadcast::error::RecvError::Closed) => return None,
            }
        }
    }

    /// Events that this listener missed because it was slow.
    #[must_use]
    pub fn missed(&self) -> u64 {
        self.missed
    }
}
