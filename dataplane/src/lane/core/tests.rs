//! The message path alone: a link that only takes notes, brokers that only collect.

use std::collections::BTreeMap;
use std::sync::Arc;

use blaze_brokers::{Later, PublishOutcome, Publisher, PublisherOptions};
use blaze_domain::{LayerName, Priority};
use parking_lot::Mutex;
use proptest::prelude::*;

use super::*;
use crate::lane::path::BareInfo;

#[derive(Default)]
struct NotingLink {
    submitted: Vec<(LaneId, Priority, Frame)>,
    waiting: BTreeMap<LaneId, u64>,
    refuse: bool,
}

impl LaneLink for NotingLink {
    fn submit(&mut self, _now: Instant, message: Submit<'_>) -> Result<(), DropReason> {
        if self.refuse {
            return Err(DropReason::LinkDown);
        }
        *self.waiting.entry(message.lane).or_default() += 1;
        self.submitted.push((message.lane, message.class, message.frame));
        Ok(())
    }
    fn queued(&self, lane: LaneId) -> u64 {
        self.waiting.get(&lane).copied().unwrap_or(0)
    }
    fn drop_lane(&mut self, lane: LaneId) -> u64 {
        self.waiting.remove(&lane).unwrap_or(0)
    }
}

#[derive(Default)]
struct Collector {
    frames: Mutex<Vec<Frame>>,
    bare: Mutex<Vec<Bytes>>,
}

impl Publisher for Collector {
    fn publish(&self, frame: &Frame, _: Option<Instant>) -> PublishOutcome {
        self.frames.lock().push(frame.clone());
        PublishOutcome::Taken
    }
    fn publish_bare(&self, payload: &Bytes, _: Option<Instant>) -> PublishOutcome {
        self.bare.lock().push(payload.clone());
        PublishOutcome::Taken
    }
    fn later(&self) -> blaze_brokers::Later {
        blaze_brokers::Later::default()
    }
}

fn lane_spec() -> crate::plan::LaneSpec {
    crate::plan::LaneSpec {
        max_rate_hz: None,
        lifespan_ms: 0,
        reliable: false,
        durable: false,
        depth: 1,
        priority: None,
        from: Vec::new(),
        degraded: None,
    }
}

fn to_cloud() -> Target {
    let layer: LayerName = "cloud".parse().unwrap();
    Target::Inter {
        receiver: "cloud/cloud-1".parse().unwrap(),
        layer,
    }
}

struct Bench {
    core: DataCore,
    link: NotingLink,
    out: Arc<Collector>,
    topic: TopicId,
    now: Instant,
}

const WALL: u64 = 1_700_000_000_000_000_000;

impl Bench {
    fn new(bridges: Vec<Bridge>) -> Self {
        let config = DataConfig {
            me: "edge/robot-1".parse().unwrap(),
            epoch: 7,
            large_bytes: 65_536,
            salt: 1,
        };
        let mut core = DataCore::new(config);
        let now = Instant::now();
        let topic = core.intern(&"imu/data".parse().unwrap(), now).unwrap();
        let mut bench = Self {
            core,
            link: NotingLink::default(),
            out: Arc::default(),
            topic,
            now,
        };
        bench.apply(bridges, TopicInfo::default());
        bench
    }

    fn apply(&mut self, bridges: Vec<Bridge>, info: TopicInfo) {
        let plan = TopicPlan {
            bridges,
            blocked: Vec::new(),
        };
        let out = Arc::clone(&self.out);
        self.core.apply(self.now, self.topic, info, &plan, |_| {
            Ok(NewWriter {
                publisher: Arc::clone(&out) as Arc<dyn Publisher>,
                options: PublisherOptions::default(),
            })
        });
    }

    fn take(&mut self, from: Scope, contents: Vec<Content>) {
        let mut batch: Vec<Received> = contents
            .into_iter()
            .map(|content| Received {
                content,
                at: self.now,
                broker_age_us: 0,
            })
            .collect();
        self.core
            .ingest(self.now, WALL, self.topic, from, &mut batch, &mut self.link);
    }

    fn drops(&self) -> Vec<(DropReason, u64)> {
        self.core.path(self.topic).ingress_drops.iter().collect()
    }
}

fn frame(writer: u8, sequence: u64, node: &str, hops: u32, bytes: usize) -> Frame {
    let origin = Origin {
        layer: "edge".into(),
        node: node.into(),
        service: "imu".into(),
        ..Origin::default()
    };
    let header = Header {
        hops,
        ..Header::new("imu/data", origin, WriterId([writer; 16]), sequence, WALL)
    };
    Frame::new(&header, Bytes::from(vec![0; bytes])).unwrap()
}

fn bridge(from: Scope, to: Target) -> Bridge {
    Bridge {
        from,
        to,
        lane: lane_spec(),
    }
}

#[test]
fn a_message_of_this_node_goes_to_every_bridge_once() {
    let mut bench = Bench::new(vec![
        bridge(Scope::Node, Target::Layer),
        bridge(Scope::Node, to_cloud()),
    ]);
    let one = Content::Frame(frame(1, 1, "robot-1", 0, 10));
    bench.take(Scope::Node, vec![one.clone(), one]);
    assert_eq!(bench.link.submitted.len(), 1);
    let written = bench.out.frames.lock().clone();
    assert_eq!(written.len(), 1);
    assert_eq!(written[0].hops(), 1, "the flow that writes adds one");
    assert_eq!(bench.drops(), vec![(DropReason::Duplicate, 1)]);
}

#[test]
fn what_is_not_from_here_stays_here() {
    let mut bench = Bench::new(vec![bridge(Scope::Node, to_cloud()), bridge(Scope::Layer, to_cloud())]);
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 1, "edge-2", 0, 1))]);
    assert_eq!(
        bench.drops(),
        vec![(DropReason::ForeignOrigin, 1)],
        "another node's message on this node scope"
    );
    bench.take(Scope::Layer, vec![Content::Frame(frame(2, 1, "edge-2", 1, 1))]);
    assert!(
        bench.link.submitted.is_empty(),
        "what a flow wrote to the layer does not leave it"
    );
    bench.take(Scope::Layer, vec![Content::Frame(frame(2, 2, "edge-2", 0, 1))]);
    assert_eq!(
        bench.link.submitted.len(),
        1,
        "what a service of the layer published does"
    );
}

#[test]
fn an_own_write_that_comes_back_is_an_echo() {
    let mut bench = Bench::new(vec![
        bridge(Scope::Inter, Target::Layer),
        bridge(Scope::Layer, Target::Node { bare: false }),
    ]);
    let origin = Origin {
        layer: "fog".into(),
        node: "fog-1".into(),
        ..Origin::default()
    };
    let from_fog = Frame::new(
        &Header::new("imu/data", origin, WriterId([3; 16]), 5, WALL),
        Bytes::new(),
    )
    .unwrap();
    bench
        .core
        .deliver(bench.now, from_fog.clone().with_hops_and_age(1, 900), &mut bench.link);
    let written = bench.out.frames.lock()[0].clone();
    assert_eq!((written.hops(), written.age_us()), (2, 900));
    bench.take(Scope::Layer, vec![Content::Frame(written)]);
    assert_eq!(bench.drops(), vec![(DropReason::Echo, 1)]);
    assert_eq!(bench.out.frames.lock().len(), 1);
}

#[test]
fn bare_payloads_get_an_identity_of_this_life_of_the_flow() {
    let mut bench = Bench::new(vec![
        bridge(Scope::Node, to_cloud()),
        bridge(Scope::Node, Target::Node { bare: true }),
    ]);
    let info = TopicInfo {
        node: BareInfo {
            encoding: "application/json".into(),
            service: "imu".into(),
            ..BareInfo::default()
        },
        layer: BareInfo {
            service: "another".into(),
            ..BareInfo::default()
        },
        ..TopicInfo::default()
    };
    bench.apply(
        vec![
            bridge(Scope::Node, to_cloud()),
            bridge(Scope::Node, Target::Node { bare: true }),
        ],
        info,
    );
    let bare = |text: &'static str| Content::Bare {
        payload: Bytes::from_static(text.as_bytes()),
        identity: None,
    };
    bench.take(Scope::Node, vec![bare("a"), bare("a")]);
    let sent: Vec<_> = bench.link.submitted.iter().map(|(_, _, frame)| frame.clone()).collect();
    assert_eq!(
        sent.iter().map(Frame::sequence).collect::<Vec<_>>(),
        [1, 2],
        "equal payloads are two messages"
    );
    assert_eq!(sent[0].origin_node(), "robot-1");
    assert_eq!(
        (sent[0].origin_service(), sent[0].encoding()),
        ("imu", "application/json")
    );
    assert_eq!(bench.out.bare.lock().len(), 2);
}

#[test]
fn garbage_is_counted() {
    let mut bench = Bench::new(vec![bridge(Scope::Node, to_cloud())]);
    bench.take(
        Scope::Node,
        vec![Content::from_bytes(Bytes::from_static(b"BLZ1\xff\xff\xff\xff"))],
    );
    let mut other = frame(1, 1, "robot-1", 0, 1).to_bytes().to_vec();
    let place = other.windows(8).position(|w| w == b"imu/data").unwrap();
    other[place] = b'x';
    bench.take(Scope::Node, vec![Content::from_bytes(Bytes::from(other))]);
    assert_eq!(
        bench.drops(),
        vec![(DropReason::DecodeError, 2)],
        "no frame, and a frame of another topic"
    );
}

#[test]
fn a_lane_is_thinned_and_old_messages_are_dropped() {
    let lane = crate::plan::LaneSpec {
        max_rate_hz: Some(1.0),
        lifespan_ms: 100,
        ..lane_spec()
    };
    let mut bench = Bench::new(vec![Bridge {
        from: Scope::Node,
        to: to_cloud(),
        lane,
    }]);
    bench.take(
        Scope::Node,
        (1..=5).map(|n| Content::Frame(frame(1, n, "robot-1", 0, 1))).collect(),
    );
    let old = frame(1, 6, "robot-1", 0, 1).with_hops_and_age(0, 100_001);
    bench.take(Scope::Node, vec![Content::Frame(old)]);
    let stats = &bench.core.path(bench.topic).bridges[0].stats;
    assert_eq!(bench.link.submitted.len(), 2);
    assert_eq!(stats.dropped.get(DropReason::MaxRate), 3);
    assert_eq!(stats.dropped.get(DropReason::Lifespan), 1);
    assert_eq!(
        stats.taken.messages,
        stats.out.messages + stats.dropped.total() + stats.queued()
    );
}

#[test]
fn the_class_falls_when_a_large_message_comes_and_only_after_the_old_class_has_drained() {
    let mut bench = Bench::new(vec![bridge(Scope::Node, to_cloud())]);
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 1, "robot-1", 0, 10))]);
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 2, "robot-1", 0, 70_000))]);
    bench.link.waiting.clear();
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 3, "robot-1", 0, 10))]);
    let classes: Vec<_> = bench.link.submitted.iter().map(|(_, class, _)| *class).collect();
    assert_eq!(classes, [Priority::State, Priority::State, Priority::Bulk]);
}

#[test]
fn a_bridge_that_is_no_longer_planned_drains_and_comes_back_with_its_counters() {
    let mut bench = Bench::new(vec![bridge(Scope::Node, to_cloud())]);
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 1, "robot-1", 0, 1))]);
    bench.apply(Vec::new(), TopicInfo::default());
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 2, "robot-1", 0, 1))]);
    assert_eq!(bench.link.submitted.len(), 1, "it takes in nothing more");
    assert!(
        bench.core.drain(bench.now, &mut bench.link).is_some(),
        "something is still queued"
    );
    assert!(
        bench.core.drain(bench.now + DRAIN, &mut bench.link).is_none(),
        "the deadline ends it"
    );
    assert_eq!(bench.core.path(bench.topic).bridges[0].phase, Phase::Ended);
    bench.apply(vec![bridge(Scope::Node, to_cloud())], TopicInfo::default());
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 3, "robot-1", 0, 1))]);
    let bridges = &bench.core.path(bench.topic).bridges;
    assert_eq!((bridges.len(), bridges[0].stats.taken.messages), (1, 2));
}

#[test]
fn topics_are_bounded() {
    let mut bench = Bench::new(Vec::new());
    for n in 1..MAX_TOPICS {
        assert!(
            bench
                .core
                .intern(&format!("t{n}").parse().unwrap(), bench.now)
                .is_some()
        );
    }
    assert!(bench.core.intern(&"one-more".parse().unwrap(), bench.now).is_none());
    assert!(bench.core.intern(&"t5".parse().unwrap(), bench.now).is_some());
}

proptest! {
    /// Whatever comes in, each message is either written, dropped with a reason or waiting; none twice; order is kept.
    #[test]
    fn nothing_is_lost_without_a_count(
        messages in proptest::collection::vec((0u8..3, 1u64..40, any::<bool>(), 0u64..200_000), 1..200),
        refuse: bool,
        reliable: bool,
    ) {
        let lane = crate::plan::LaneSpec { lifespan_ms: 100, max_rate_hz: Some(50.0), reliable, ..lane_spec() };
        let mut bench = Bench::new(vec![
            Bridge { from: Scope::Node, to: to_cloud(), lane: lane.clone() },
            Bridge { from: Scope::Node, to: Target::Layer, lane },
        ]);
        bench.link.refuse = refuse;
        for (writer, sequence, here, age) in messages {
            let node = if here { "robot-1" } else { "edge-2" };
            let message = frame(writer, sequence, node, 0, 5).with_hops_and_age(0, age);
            bench.take(Scope::Node, vec![Content::Frame(message)]);
            bench.now += Duration::from_millis(7);
        }
        for bridge in &mut bench.core.path_mut(bench.topic).bridges {
            bridge.settle();
            let stats = &bridge.stats;
            prop_assert_eq!(stats.taken.messages, stats.out.messages + stats.dropped.total() + stats.queued());
        }
        let mut seen = std::collections::HashSet::new();
        for frame in bench.out.frames.lock().iter() {
            prop_assert!(seen.insert((frame.writer(), frame.sequence())), "written twice");
        }
    }
}
