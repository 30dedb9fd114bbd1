//! What only the flow of a scope does on its Redis: leases, and the end of what is kept of a
//! writer.

use std::sync::Arc;

use async_trait::async_trait;
use blaze_domain::WriterId;
use blaze_domain::names::ChannelName;
use bytes::Bytes;

use super::Shared;
use super::leases::{self, Leases};
use crate::port::{BrokerError, FlowSide};

/// The flow's side of a Redis.
pub(super) struct RedisFlowSide {
    pub(super) shared: Arc<Shared>,
    pub(super) leases: Arc<Leases>,
}

#[async_trait]
impl FlowSide for RedisFlowSide {
    /// A channel of Redis is there when it is used.
    fn prepare(&self, _channel: &ChannelName, _depth: u32) -> Result<(), BrokerError> {
        Ok(())
    }

    fn release(&self, _channel: &ChannelName) {}

    async fn load_leases(&self) -> Result<Vec<(String, Bytes)>, BrokerError> {
        leases::load(&self.shared, &self.leases).await
    }

    fn put_lease(&self, key: &str, value: Bytes) {
        self.leases.put(key, value);
    }

    fn remove_lease(&self, key: &str) {
        self.leases.remove(key);
    }

    fn forget_writer(&self, channel: &ChannelName, writer: WriterId) {
        let hash = self.shared.settings.names.last(channel);
        let key = (hash, writer);
        self.shared.mirror.lock().forget(&key);
        self.leases.delete_retained(key.0, writer);
    }

    fn stand_back(&self, for_whom: Option<String>) {
        self.shared.state.change(|conditions| conditions.stand_back = for_whom);
    }
}
