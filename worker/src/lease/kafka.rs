//! The lease as the one partition of a topic of Kafka, which a member of a consumer group has.

use std::time::Duration;

use async_trait::async_trait;
use blaze_brokers::OpenError;
use blaze_brokers::kafka::{GroupLease, GroupLeaseOptions};
use blaze_domain::LayerName;
use blaze_domain::node_file::KafkaBroker as Section;

use super::{Held, Lease, Mark};

/// The topic of the leases of all layers.
const TOPIC: &str = "blaze/worker/lease";

/// The lease of a layer: membership of the group `blaze-worker-<layer>`, with the mark beside the
/// committed offset.
pub struct KafkaLease {
    group: String,
    lease: GroupLease,
}

impl KafkaLease {
    /// The lease of a layer, for a worker that holds it for `time` at a time. Begins to connect in
    /// the background.
    ///
    /// # Errors
    /// [`OpenError`] for a section that can never work.
    pub fn open(section: &Section, layer: &LayerName, time: Duration) -> Result<Self, OpenError> {
        let group = format!("blaze-worker-{layer}");
        let options = GroupLeaseOptions { channel: TOPIC, group: group.clone(), time };
        Ok(Self { group, lease: GroupLease::open(section, options)? })
    }
}

#[async_trait]
impl Lease for KafkaLease {
    /// The time is the one that it was opened with.
    async fn hold(&self, _time: Duration, told: Option<&Mark>) -> Result<Held, String> {
        let text = told.map(Mark::to_text);
        let held = self.lease.hold(text.as_deref()).await?;
        Ok(Held {
            is_held: held.is_held,
            told: held.note.as_deref().and_then(Mark::parse),
            by: None,
        })
    }

    async fn release(&self) {
        self.lease.release().await;
    }

    fn describe(&self) -> String {
        format!("Kafka, group {}", self.group)
    }
}
