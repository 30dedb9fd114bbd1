//! Readers and writers of ROS 2 nodes, as discovery tells them.

use std::net::{IpAddr, Ipv4Addr};
use std::time::Duration;

use rustdds::policy::Liveliness;

use super::names::{RosName, type_of_dds};
use crate::dds::{EndpointId, FoundEndpoint};

/// A Lifespan, deadline or lease from here on is none: 68 years.
const INFINITE: Duration = Duration::from_secs(0x7fff_ffff);

/// Which implementation of DDS an endpoint is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Vendor {
    /// eProsima Fast DDS: `rmw_fastrtps`.
    FastDds,
    /// Eclipse Cyclone DDS: `rmw_cyclonedds`.
    CycloneDds,
    /// RTI Connext: `rmw_connextdds`.
    Connext,
    /// RustDDS, and so every flow.
    RustDds,
    /// Any other.
    Other,
}

impl Vendor {
    /// Who gave an endpoint its identity: its first two bytes.
    #[must_use]
    pub fn of(endpoint: &EndpointId) -> Self {
        match endpoint[..2] {
            [0x01, 0x0f] => Self::FastDds,
            [0x01, 0x10] => Self::CycloneDds,
            [0x01, 0x01] => Self::Connext,
            [0x01, 0x12] => Self::RustDds,
            _ => Self::Other,
        }
    }

    /// The word in admin JSON.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::FastDds => "fastdds",
            Self::CycloneDds => "cyclonedds",
            Self::Connext => "connext",
            Self::RustDds => "rustdds",
            Self::Other => "other",
        }
    }
}

/// A reader or writer of a topic or service of ROS 2.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RosEndpoint {
    /// Its identity on the wire.
    pub id: EndpointId,
    /// Whether it writes.
    pub is_writer: bool,
    /// What it reads or writes.
    pub name: RosName,
    /// The type as DDS has it, `sensor_msgs::msg::dds_::Imu_`.
    pub dds_type: String,
    /// The type as ROS 2 has it, `sensor_msgs/msg/Imu`; `None` where ROS 2 made no such name.
    pub type_name: Option<String>,
    /// RIHS01 hash of the type; `None` in Humble, and of programs that tell none.
    pub type_hash: Option<String>,
    /// Full name of its node; `None` while that is not known.
    pub node: Option<String>,
    /// Whose implementation it is.
    pub vendor: Vendor,
    /// A writer repairs losses; a reader acknowledges.
    pub reliable: bool,
    /// A writer keeps samples for late joiners; a reader asks for them.
    pub durable: bool,
    /// Offered or asked for; `None`: none.
    pub deadline: Option<Duration>,
    /// Lease of its liveliness, offered or asked for; `None`: none.
    pub lease: Option<Duration>,
    /// A writer tells that it lives by writing; a reader asks for that.
    pub manual: bool,
    /// After this time samples are over; `None`: never.
    pub lifespan: Option<Duration>,
    /// IPv4 addresses at which it is reached; empty where it uses no UDP.
    pub addresses: Vec<Ipv4Addr>,
    /// Samples have keys, which no topic of ROS 2 has.
    pub is_keyed: bool,
}

impl RosEndpoint {
    /// What was found, if it is of ROS 2.
    pub(super) fn of(found: &FoundEndpoint, is_writer: bool) -> Option<Self> {
        let name = RosName::of_dds(&found.topic)?;
        let finite = |duration: rustdds::Duration| {
            Some(duration.to_std()).filter(|duration| *duration < INFINITE)
        };
        let mut addresses: Vec<Ipv4Addr> = found
            .sockets
            .iter()
            .filter_map(|socket| match socket.ip() {
                IpAddr::V4(address) => Some(address),
                IpAddr::V6(_) => None,
            })
            .collect();
        addresses.sort_unstable();
        addresses.dedup();
        Some(Self {
            id: found.id,
            is_writer,
            name,
            dds_type: found.type_name.clone(),
            type_name: type_of_dds(&found.type_name),
            type_hash: type_hash(&found.user_data),
            node: None,
            vendor: Vendor::of(&found.id),
            reliable: found.is_reliable(),
            durable: found.is_durable(),
            deadline: found.qos.deadline().and_then(|deadline| finite(deadline.0)),
            lease: found.qos.liveliness().and_then(|liveliness| finite(liveliness.duration())),
            manual: matches!(
                found.qos.liveliness(),
                Some(Liveliness::ManualByParticipant { .. } | Liveliness::ManualByTopic { .. })
            ),
            lifespan: found.qos.lifespan().and_then(|lifespan| finite(lifespan.duration)),
            addresses,
            is_keyed: matches!(found.id[15], 0x02 | 0x07),
        })
    }
}

impl RosEndpoint {
    /// Whether its samples are messages of ROS 2: they have a type of ROS 2 and no keys.
    #[must_use]
    pub fn is_readable(&self) -> bool {
        self.type_name.is_some() && !self.is_keyed
    }

    /// Its lifespan in whole milliseconds, at least 1; 0 = none.
    #[must_use]
    pub fn lifespan_ms(&self) -> u32 {
        self.lifespan
            .map_or(0, |lifespan| u32::try_from(lifespan.as_millis()).unwrap_or(u32::MAX).max(1))
    }
}

/// The hash in USER_DATA `typehash=RIHS01_<64 hex>;`.
fn type_hash(user_data: &[u8]) -> Option<String> {
    let text = String::from_utf8_lossy(user_data);
    let (_, rest) = text.split_once("typehash=")?;
    let (hash, _) = rest.split_once(';')?;
    let hex = hash.strip_prefix("RIHS01_")?;
    let is_hash = hex.len() == 64 && hex.bytes().all(|byte| byte.is_ascii_hexdigit());
    is_hash.then(|| hash.to_owned())
}

#[cfg(test)]
pub(super) mod tests {
    use rustdds::QosPolicies;
    use rustdds::policy::{Deadline, Durability, Lifespan};

    use super::*;

    /// A writer of participant `number`, as discovery finds it.
    pub(crate) fn found(number: u8, topic: &str, type_name: &str) -> FoundEndpoint {
        let mut id = [number; 16];
        id[..2].copy_from_slice(&[0x01, 0x0f]);
        id[12..].copy_from_slice(&[0, 0, number, 0x03]);
        FoundEndpoint {
            id,
            topic: topic.to_owned(),
            type_name: type_name.to_owned(),
            qos: QosPolicies::builder().build(),
            user_data: Vec::new(),
            sockets: vec!["127.0.0.1:7411".parse().unwrap(), "127.0.0.1:7413".parse().unwrap()],
        }
    }

    #[test]
    fn what_discovery_tells_is_understood() {
        let hash = format!("RIHS01_{}", "0a".repeat(32));
        let seconds = |seconds| rustdds::Duration::from_secs(seconds);
        let qos = QosPolicies::builder()
            .reliable(rustdds::Duration::ZERO)
            .durability(Durability::TransientLocal)
            .deadline(Deadline(seconds(2)))
            .lifespan(Lifespan { duration: rustdds::Duration::INFINITE })
            .liveliness(Liveliness::ManualByTopic { lease_duration: seconds(3) })
            .build();
        let user_data = format!("Q\0\0\0typehash={hash};\0\0\0").into_bytes();
        let found =
            FoundEndpoint { qos, user_data, ..found(7, "rt/imu", "sensor_msgs::msg::dds_::Imu_") };
        let endpoint = RosEndpoint::of(&found, true).unwrap();
        assert_eq!(endpoint.type_name.as_deref(), Some("sensor_msgs/msg/Imu"));
        assert_eq!(endpoint.type_hash, Some(hash));
        assert_eq!(endpoint.vendor.as_str(), "fastdds");
        assert!(endpoint.reliable && endpoint.durable && !endpoint.is_keyed);
        assert_eq!(endpoint.deadline, Some(Duration::from_secs(2)));
        assert_eq!(endpoint.lease, Some(Duration::from_secs(3)));
        assert!(endpoint.manual);
        assert_eq!(endpoint.lifespan, None);
        assert_eq!(endpoint.addresses, [Ipv4Addr::LOCALHOST]);
    }

    #[test]
    fn a_writer_that_says_nothing_is_reliable_and_a_reader_is_not() {
        let writer = found(1, "rt/a", "x");
        assert!(RosEndpoint::of(&writer, true).unwrap().reliable, "the default of DDS");
        let mut reader = writer.clone();
        reader.id[15] = 0x04;
        assert!(!RosEndpoint::of(&reader, false).unwrap().reliable);
        let qos = QosPolicies::builder().best_effort().build();
        assert!(!RosEndpoint::of(&FoundEndpoint { qos, ..writer }, true).unwrap().reliable);
    }

    #[test]
    fn what_is_missing_or_odd_is_left_out() {
        let plain = RosEndpoint::of(&found(1, "rt/a", "blaze::v1::Frame"), false).unwrap();
        assert_eq!((plain.type_name, plain.type_hash, plain.node), (None, None, None));
        assert!(!plain.durable);
        assert_eq!(RosEndpoint::of(&found(1, "ros_discovery_info", "x"), true), None);
        let mut keyed = found(1, "rt/a", "x");
        keyed.id[15] = 0x02;
        assert!(RosEndpoint::of(&keyed, true).unwrap().is_keyed);
        for odd in ["typehash=RIHS01_00;", "typehash=RIHS02_", "typehash=", "\u{fffd}", ""] {
            assert_eq!(type_hash(odd.as_bytes()), None, "{odd}");
        }
    }
}
