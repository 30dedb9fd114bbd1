//! The lease as membership of a consumer group of Kafka: whoever has the one partition leads.

use std::time::Duration;

use async_trait::async_trait;
use blaze_brokers::OpenError;
use blaze_brokers::kafka::GroupLease;
use blaze_domain::LayerName;
use blaze_domain::node_file::KafkaBroker as Section;

use super::{Held, Lease, Mark};

/// The topic whose partition the members of the groups of all layers share out; there is never anything in it.
const TOPIC: &str = "blaze/worker/lease";

/// A member of the group `blaze-worker-<layer>`.
pub struct KafkaLease {
    group: String,
    member: GroupLease,
}

impl KafkaLease {
    /// Begins to join the group of a layer. A member that is not asked to hold the lease for `time` leaves; the broker takes
    /// one for dead after the same time, or after the least that it lets members ask for, if that is longer.
    ///
    /// # Errors
    /// [`OpenError`] for a section that can never work.
    pub fn open(section: &Section, layer: &LayerName, time: Duration) -> Result<Self, OpenError> {
        let group = format!("blaze-worker-{layer}");
        let member = GroupLease::open(section, &group, TOPIC, time)?;
        Ok(Self { group, member })
    }
}

#[async_trait]
impl Lease for KafkaLease {
    /// The time is the one that the group was joined with.
    async fn hold(&self, _time: Duration, told: Option<&Mark>) -> Result<Held, String> {
        let text = told.map(Mark::to_text);
        let held = self.member.hold(text.as_deref()).await?;
        Ok(Held {
            is_held: held.is_held,
            told: held.note.as_deref().and_then(Mark::parse),
        })
    }

    async fn release(&self) {
        self.member.release().await;
    }

    fn describe(&self) -> String {
        format!("Kafka, group {}", self.group)
    }
}
