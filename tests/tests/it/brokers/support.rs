//! What the tests of all adapters share: frames and waits.

use std::time::{Duration, Instant};

use blaze_brokers::{Broker, Health, SubscribeOptions};
use blaze_domain::{Origin, WriterId};
use blaze_proto::{Frame, Header};
use bytes::Bytes;

/// How long a condition may take; spent only where a test fails.
pub(super) const DEADLINE: Duration = Duration::from_secs(40);

pub(super) const WITH_KEPT: SubscribeOptions = SubscribeOptions {
    max_messages: 4096,
    max_bytes: 64 * 1024 * 1024,
    large: false,
    with_kept: true,
};

pub(super) fn writer(number: u8) -> WriterId {
    WriterId([number; 16])
}

pub(super) fn frame(topic: &str, number: u8, sequence: u64, bytes: usize) -> Frame {
    let header = Header::new(topic, Origin::default(), writer(number), sequence, 0);
    Frame::new(&header, Bytes::from(vec![b'x'; bytes])).unwrap()
}

/// Waits until a client's health is as given, and gives its detail.
pub(super) async fn wait_for(broker: &dyn Broker, health: Health) -> String {
    let mut status = broker.status();
    let waited =
        tokio::time::timeout(DEADLINE, status.wait_for(|status| status.health == health)).await;
    match waited {
        Ok(status) => status.unwrap().detail.clone(),
        Err(_) => panic!("not {health:?} within {DEADLINE:?}: {:?}", broker.status().borrow()),
    }
}

/// Waits until something holds.
pub(super) async fn eventually<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let until = Instant::now() + DEADLINE;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < until, "{what}: not within {DEADLINE:?}");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}
