//! Who publishes and who listens in the demo.
//!
//! ```text
//! edge  robot-1: imu-driver, odometry, camera-driver      edge-2: monitor
//! fog   fog-1:   dashboard, analytics (until half time)
//! cloud cloud-1: recorder, analytics (from half time)
//! ```

use std::time::Duration;

use blaze_domain::node_file::LARGE_BYTES;
use blaze_domain::{Durability, Reliability, Scope, TopicName};

use super::flows::Spot;
use super::options::DemoNode;
use super::recording::{RecordedTopic, Recording};

/// How long a picture is of use.
pub const PICTURE_LIFESPAN: Duration = Duration::from_millis(500);
/// Messages of a topic that are kept for those who come later, at most.
const MAX_KEPT: usize = 100;
/// The service that moves at half time.
pub const MOVING_SERVICE: &str = "analytics";
/// Where it starts.
pub const MOVES_FROM: DemoNode = DemoNode::Fog1;
/// Where it goes.
pub const MOVES_TO: DemoNode = DemoNode::Cloud1;
/// Who plays.
pub const PUBLISHING_NODE: DemoNode = DemoNode::Robot1;
/// The node with the ROS 2 network.
pub const ROS2_NODE: DemoNode = DemoNode::Cloud1;

/// A topic that is played, and how it is advertised.
#[derive(Debug, Clone)]
pub struct PlayedTopic {
    /// Its name.
    pub name: TopicName,
    /// Who publishes it.
    pub service: &'static str,
    /// ROS type, or empty.
    pub type_name: String,
    /// Media type of the payload.
    pub encoding: String,
    /// Messages a second.
    pub rate_hz: f64,
    /// Largest payload.
    pub max_bytes: usize,
    /// Messages kept for those who come later; 0 = none.
    pub depth: u32,
    /// Whether it is larger than [`LARGE_BYTES`], as pictures are: best effort, with a lifespan.
    pub large: bool,
}

impl PlayedTopic {
    fn new(topic: &RecordedTopic) -> Self {
        let large = topic.max_bytes > LARGE_BYTES as usize;
        let service = match topic.type_name.as_str() {
            "sensor_msgs/msg/Imu" => "imu-driver",
            "nav_msgs/msg/Odometry" => "odometry",
            _ if large => "camera-driver",
            _ => "player",
        };
        Self {
            name: topic.name.clone(),
            service,
            type_name: topic.type_name.clone(),
            encoding: topic.encoding.clone(),
            rate_hz: topic.rate_hz,
            max_bytes: topic.max_bytes,
            depth: match topic.durability {
                Durability::TransientLocal => kept(topic.messages),
                Durability::Volatile => 0,
            },
            large,
        }
    }

    /// Whether messages are kept for those who come later.
    #[must_use]
    pub fn durability(&self) -> Durability {
        if self.depth > 0 { Durability::TransientLocal } else { Durability::Volatile }
    }

    /// Pictures may be lost, everything else is repaired.
    #[must_use]
    pub fn reliability(&self) -> Reliability {
        if self.large { Reliability::BestEffort } else { Reliability::Reliable }
    }

    /// How long a message is of use; zero = for ever.
    #[must_use]
    pub fn lifespan(&self) -> Duration {
        if self.large { PICTURE_LIFESPAN } else { Duration::ZERO }
    }
}

/// How many messages of a topic are kept: several publishers may have spoken once each, and play as
/// one.
fn kept(messages: usize) -> u32 {
    u32::try_from(messages.clamp(1, MAX_KEPT)).unwrap_or(1)
}

/// Topics of all recordings, in their order: first of the first recording first.
#[must_use]
pub fn played_topics<'a>(recordings: impl IntoIterator<Item = &'a Recording>) -> Vec<PlayedTopic> {
    let topics = recordings.into_iter().flat_map(|recording| &recording.topics);
    topics.map(PlayedTopic::new).collect()
}

/// One topic that one service listens to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Consumer {
    /// The service.
    pub service: &'static str,
    /// Where it runs.
    pub node: DemoNode,
    /// What it listens to.
    pub topic: TopicName,
    /// Whether it starts only at half time.
    pub later: bool,
}

impl Consumer {
    /// Where it listens.
    #[must_use]
    pub fn spot(&self) -> Spot {
        match scope_of(self.service, self.node) {
            Scope::Node => Spot::Node(self.node),
            Scope::Layer | Scope::Ros2 | Scope::Inter => Spot::Layer(self.node.layer().to_owned()),
        }
    }
}

/// On the edge a service talks to its node's broker, in fog and cloud to that of the layer; the one
/// that moves keeps to its node, so that its move is seen in the bridges although others in both
/// layers listen to the same topic.
#[must_use]
pub fn scope_of(service: &str, node: DemoNode) -> Scope {
    match node {
        DemoNode::Fog1 | DemoNode::Cloud1 if service != MOVING_SERVICE => Scope::Layer,
        _ => Scope::Node,
    }
}

/// The topic of the service that moves: of an IMU, else the fastest that is not large, else the first.
fn moving_topic(topics: &[PlayedTopic]) -> Option<&PlayedTopic> {
    let imu = topics.iter().find(|topic| topic.service == "imu-driver");
    let small = topics.iter().filter(|topic| !topic.large);
    let fastest = small.max_by(|one, other| one.rate_hz.total_cmp(&other.rate_hz));
    imu.or(fastest).or(topics.first())
}

/// Everybody who listens on the given nodes.
#[must_use]
pub fn consumers(topics: &[PlayedTopic], nodes: &[DemoNode]) -> Vec<Consumer> {
    let all = [
        ("monitor", DemoNode::Edge2),
        ("dashboard", DemoNode::Fog1),
        ("recorder", DemoNode::Cloud1),
    ];
    let steady = all.into_iter().flat_map(|(service, node)| {
        topics.iter().map(move |topic| Consumer {
            service,
            node,
            topic: topic.name.clone(),
            later: false,
        })
    });
    let moving = moving_topic(topics).into_iter().flat_map(|topic| {
        [(MOVES_FROM, false), (MOVES_TO, true)].map(|(node, later)| Consumer {
            service: MOVING_SERVICE,
            node,
            topic: topic.name.clone(),
            later,
        })
    });
    steady.chain(moving).filter(|consumer| nodes.contains(&consumer.node)).collect()
}
