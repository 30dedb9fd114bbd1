//! What a session runs on, and what it is to do.

use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use super::board::ConsumerId;
use super::changes::{ChangePlan, Taken, Wanted};
use super::options::DemoNode;
use super::recording::Recording;
use super::roles::{Consumer, PlayedTopic};

/// The flows and services that a session runs on.
pub trait Stage {
    /// Nodes of this process and their admin ports.
    fn admin_ports(&self) -> Vec<(DemoNode, SocketAddr)>;

    /// Starts a service that listens: what it receives goes to the board under `id`.
    fn listen(
        &self,
        consumer: &Consumer,
        id: ConsumerId,
    ) -> impl Future<Output = Result<(), String>>;

    /// Ends a service that listens.
    fn stop_listening(&self, id: ConsumerId) -> impl Future<Output = Result<(), String>>;

    /// Publishes; called on the player's thread. Topics are counted over all recordings, see
    /// [`played_topics`](super::roles::played_topics). `None`: the publishers are in another
    /// process.
    fn publisher(&self) -> Option<Box<dyn FnMut(usize, bytes::Bytes) + Send>>;

    /// Changes the configuration over REST, and waits until whom it concerns was called back.
    fn change(&self, wanted: &Wanted) -> impl Future<Output = Result<Taken, String>>;

    /// Results of the service whose configuration is changed, so far.
    fn results(&self) -> u64;

    /// Brings to the board what listeners dropped; called each second and at the end.
    fn look(&self) -> impl Future<Output = ()>;

    /// Completes when the user wants an end, or a flow ended by itself (then with a sentence).
    fn interrupted(&self) -> impl Future<Output = Option<String>>;
}

/// What a session plays, and for how long.
pub struct Script {
    /// Nodes of this process.
    pub nodes: Vec<DemoNode>,
    /// What is played.
    pub recordings: Vec<Arc<Recording>>,
    /// Its topics.
    pub topics: Vec<PlayedTopic>,
    /// Who listens here.
    pub consumers: Vec<Consumer>,
    /// How long.
    pub duration: Duration,
    /// Which changes of the configuration are shown; else why none are, where people should know.
    pub changes: Result<ChangePlan, String>,
}
