//! The SDK over the memory broker.

mod leases;
mod publish_subscribe;
