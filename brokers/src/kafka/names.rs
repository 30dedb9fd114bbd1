//! From channels to topics of the server.

use std::sync::Arc;

use blaze_domain::names::ChannelName;

use crate::port::BrokerError;

/// Longest topic name that Kafka takes, in bytes.
const MAX_TOPIC_BYTES: usize = 249;

/// Channels that a flow makes before it says that it is up, beside its leases.
pub(super) const RESERVED: [&str; 4] =
    ["blaze/flow/control", "blaze/flow/events", "blaze/flow/peers", "blaze/reply"];

/// Channels that a worker of BlazeConfig makes before it says that it is up. `blaze/reply` is a
/// flow's as well: the first makes it, and both make the same.
pub(super) const OF_WORKER: [&str; 4] =
    ["blaze/config/get", "blaze/config/ack", "blaze/watchdog", "blaze/reply"];

/// Where flows keep leases: a topic that is no channel.
const LEASES: &str = "blaze.flow.leases";

/// Where flows of one layer meet: it is read and written also while the scope belongs to another.
const PEERS: &str = "blaze/flow/peers";

/// Whether a channel is used while the scope belongs to another flow.
pub(super) fn stays_open(channel: &ChannelName) -> bool {
    channel.as_str() == PEERS
}

/// Names of topics: `<prefix>` and the channel, with `.` for `/`.
#[derive(Debug, Clone)]
pub(super) struct Names {
    prefix: String,
}

impl Names {
    /// A prefix that leaves names valid, or what is wrong with it.
    pub(super) fn new(prefix: &str) -> Result<Self, String> {
        let prefix = prefix.replace('/', ".");
        match prefix.chars().find(|c| !is_legal(*c)) {
            None if is_kept(&prefix) => Err("begins with __, which Kafka keeps for itself".into()),
            None => Ok(Self { prefix }),
            Some(found) => {
                Err(format!("holds {found:?}, and Kafka's topics have only A-Z a-z 0-9 . _ -"))
            }
        }
    }

    /// The topic of a channel.
    pub(super) fn topic(&self, channel: &ChannelName) -> Result<Arc<str>, BrokerError> {
        let topic = format!("{}{}", self.prefix, channel.as_str().replace('/', "."));
        let refuse =
            |reason: String| Err(BrokerError::Name { channel: channel.to_string(), reason });
        if topic.len() > MAX_TOPIC_BYTES {
            return refuse(format!(
                "its Kafka topic would have {} bytes, at most {MAX_TOPIC_BYTES} are possible",
                topic.len()
            ));
        }
        if is_kept(&topic) {
            return refuse(format!("Kafka keeps names that begin with __, as {topic}, for itself"));
        }
        if topic == "." || topic == ".." || !topic.chars().all(is_legal) {
            return refuse(format!("{topic:?} cannot be a Kafka topic"));
        }
        Ok(Arc::from(topic))
    }

    /// The topic that holds the leases.
    pub(super) fn leases(&self) -> Arc<str> {
        Arc::from(format!("{}{LEASES}", self.prefix))
    }

    /// The topic of a reserved channel, which fits always.
    pub(super) fn reserved(&self, channel: &str) -> Arc<str> {
        Arc::from(format!("{}{}", self.prefix, channel.replace('/', ".")))
    }
}

/// Whether Kafka keeps such topics for itself, as `__transaction_state`.
fn is_kept(topic: &str) -> bool {
    topic.starts_with("__")
}

fn is_legal(c: char) -> bool {
    c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-')
}

/// Whether two topics cannot exist side by side: Kafka tells them apart, its metrics do not.
pub(super) fn collide(one: &str, other: &str) -> bool {
    let same = |(a, b): (u8, u8)| a == b || (matches!(a, b'.' | b'_') && matches!(b, b'.' | b'_'));
    one != other && one.len() == other.len() && one.bytes().zip(other.bytes()).all(same)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic(prefix: &str, channel: &str) -> Result<String, BrokerError> {
        let names = Names::new(prefix).unwrap();
        names.topic(&channel.parse().unwrap()).map(|topic| topic.to_string())
    }

    #[test]
    fn channels_become_topics() {
        assert_eq!(topic("", "imu/data").unwrap(), "imu.data");
        assert_eq!(topic("edge-1.", "blaze/flow/control").unwrap(), "edge-1.blaze.flow.control");
        assert_eq!(topic("fog/", "a").unwrap(), "fog.a");
        assert_eq!(&*Names::new("x.").unwrap().leases(), "x.blaze.flow.leases");
    }

    #[test]
    fn impossible_names_are_refused() {
        assert!(Names::new("a:").is_err());
        assert!(Names::new("__a").is_err());
        assert!(matches!(topic("", "__transaction_state"), Err(BrokerError::Name { .. })));
        assert!(matches!(topic("_", "_a"), Err(BrokerError::Name { .. })));
        let longest = "t".repeat(200);
        assert!(topic(&"p".repeat(49), &longest).is_ok());
        assert!(matches!(topic(&"p".repeat(50), &longest), Err(BrokerError::Name { .. })));
    }

    #[test]
    fn dots_and_underscores_collide() {
        assert!(collide("imu.data", "imu_data"));
        assert!(!collide("imu.data", "imu.data"));
        assert!(!collide("imu.data", "imu-data"));
        assert!(!collide("imu.data", "imu.dat"));
    }
}
