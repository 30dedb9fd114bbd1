//! What the engine is connected to.

use std::sync::Arc;

use blaze_domain::NodeName;
use blaze_domain::names::ChannelName;
use blaze_proto::v1;
use bytes::Bytes;
use tokio::sync::{mpsc, oneshot, watch};

use super::{Own, Sign, Status};
use crate::copy::{Copies, Found, defaults};
use crate::core::Site;
use crate::core::messages::Delivery;
use crate::lease::{Mark, Term};
use crate::serve::{Channels, Speaker};
use crate::sync::SyncEvent;

/// Gives answers to those who ask.
pub trait Replies: Send + Sync + 'static {
    /// Sends one, now. What cannot be sent is dropped: whoever asked asks again.
    ///
    /// # Errors
    /// For people.
    fn reply(&self, to: &ChannelName, payload: Bytes) -> Result<(), String>;

    /// The one channel that all answers go to, where the broker cannot make one for each who asks;
    /// then an id is needed.
    fn shared(&self) -> Option<ChannelName>;
}

/// Who the worker is and how it serves.
#[derive(Debug, Clone)]
pub struct Identity {
    /// Whom it serves.
    pub site: Site,
    /// The node that it runs on.
    pub node: NodeName,
    /// Its name among the workers of its layer; no other life of it has the same.
    pub worker_id: String,
    /// How secrets reach services.
    pub delivery: Delivery,
}

/// What comes in.
pub struct Inputs {
    /// From the main service.
    pub sync: mpsc::Receiver<SyncEvent>,
    /// Requests for configurations, as they came.
    pub gets: mpsc::Receiver<Bytes>,
    /// What services say about themselves.
    pub signs: mpsc::Receiver<Sign>,
    /// The mounted file.
    pub defaults: watch::Receiver<defaults::Status>,
    /// The term in which this worker answers and notifies.
    pub leader: watch::Receiver<Option<u64>>,
    /// How far services were told, as it lies beside the lease.
    pub noted: watch::Receiver<Option<Mark>>,
    /// Questions of the admin port.
    pub queries: mpsc::Receiver<oneshot::Sender<Status>>,
    /// What copies hold that could not be read at the start.
    pub found: mpsc::Receiver<Found>,
}

/// Where things go.
pub struct Outputs {
    /// Answers.
    pub replies: Arc<dyn Replies>,
    /// Keys and notices.
    pub speaker: Speaker,
    /// Channels; absent where the broker has them as soon as they are used.
    pub channels: Option<Arc<dyn Channels>>,
    /// Copies; absent where nothing is kept.
    pub copies: Option<Copies>,
    /// What the worker has, for the main service.
    pub acks: watch::Sender<Option<v1::Ack>>,
    /// Its own configuration; absent where it takes none.
    pub own: Option<Own>,
    /// Until when this worker leads.
    pub term: Term,
    /// How far it has told services, for whoever leads next.
    pub told: watch::Sender<Option<Mark>>,
}

/// What happened since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Requests that were answered.
    pub answered: u64,
    /// Requests that could not be read or answered.
    pub refused: u64,
    /// Requests that another worker of the layer answers.
    pub left_to_others: u64,
    /// Streams that were begun anew because something was missing or different.
    pub faults: u64,
    /// Acknowledgements and signs of life that were understood.
    pub signs: u64,
    /// Those that could not be read.
    pub misunderstood: u64,
    /// Those of instances beyond as many as are known at a time.
    pub left_out: u64,
    /// Roll-outs that failed here and were undone.
    pub failed_rollouts: u64,
    /// Places that asked and are not notified any more, because too many asked.
    pub forgotten_asked: u64,
    /// Places whose last notice stays with the broker, because too many ended.
    pub forgotten_ended: u64,
}
