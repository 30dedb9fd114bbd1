//! The message path alone: a link that only takes notes, brokers that only collect.

mod allocation;
mod calls;
mod compress_stage;
mod convert;
mod load;
mod ros2;
mod succession;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use blaze_brokers::{Content, Later, PublishOutcome, Publisher, PublisherOptions};
use blaze_domain::{LayerName, Origin, Priority};
use blaze_proto::Header;
use bytes::Bytes;
use parking_lot::Mutex;
use proptest::prelude::*;

use super::*;
use crate::lane::path::{BareInfo, TopicInfo};
use crate::plan::{Bridge, Form, LaneSpec, TopicPlan};
use crate::testing::access;
use crate::types::TopicTypes;
use crate::world::LayerScopeId;

#[derive(Default)]
struct NotingLink {
    submitted: Vec<(LaneId, Priority, Frame)>,
    waiting: BTreeMap<LaneId, u64>,
    refuse: bool,
    told: Vec<(FlowId, Body)>,
    gone: Option<FlowId>,
    /// Messages that may wait when more are released; 0 = any number.
    room: u64,
    /// Flows that know nothing of compression.
    old: Vec<FlowId>,
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
    fn is_suspect(&self, _to: &FlowId) -> bool {
        self.refuse
    }
    fn answers(&self, to: &FlowId) -> bool {
        self.gone.as_ref() != Some(to)
    }
    fn has_room(&self, _to: &FlowId, _class: Priority, _bytes: usize) -> bool {
        self.room == 0 || self.waiting.values().sum::<u64>() < self.room
    }
    fn takes_lz4(&self, to: &FlowId) -> bool {
        !self.old.contains(to)
    }
    fn tell(&mut self, to: &FlowId, body: Body) -> bool {
        self.told.push((to.clone(), body));
        true
    }
}

#[derive(Default)]
struct Collector {
    frames: Mutex<Vec<Frame>>,
    bare: Mutex<Vec<Bytes>>,
    queued: AtomicU64,
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
    fn later(&self) -> Later {
        Later { queued: self.queued.load(Ordering::SeqCst), ..Later::default() }
    }
}

fn lane_spec() -> LaneSpec {
    LaneSpec { depth: 1, shared: Some(LayerScopeId::kafka("")), ..LaneSpec::default() }
}

fn lane_with(change: impl FnOnce(&mut LaneSpec)) -> LaneSpec {
    let mut lane = lane_spec();
    change(&mut lane);
    lane
}

fn planned(bridges: Vec<Bridge>) -> TopicPlan {
    TopicPlan { bridges, ..TopicPlan::default() }
}

fn writes_to(publisher: &Arc<impl Publisher + 'static>) -> Result<NewWriter, String> {
    Ok(NewWriter {
        publisher: Arc::clone(publisher) as Arc<dyn Publisher>,
        options: PublisherOptions::default(),
    })
}

fn to_cloud() -> Target {
    let layer: LayerName = "cloud".parse().unwrap();
    Target::Inter { receiver: "cloud/cloud-1".parse().unwrap(), layer }
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
        let mut bench = Self { core, link: NotingLink::default(), out: Arc::default(), topic, now };
        bench.apply(bridges, TopicInfo::default());
        bench
    }

    fn apply(&mut self, bridges: Vec<Bridge>, info: TopicInfo) {
        let out = Arc::clone(&self.out);
        let plan = planned(bridges);
        self.core.apply(self.now, self.topic, info, &plan, |_| writes_to(&out));
    }

    /// Another topic with these bridges.
    fn add(&mut self, topic: &str, bridges: Vec<Bridge>) -> TopicId {
        let id = self.core.intern(&topic.parse().unwrap(), self.now).unwrap();
        let first = std::mem::replace(&mut self.topic, id);
        self.apply(bridges, TopicInfo::default());
        std::mem::replace(&mut self.topic, first)
    }

    /// Whatever has changed.
    fn drain(&mut self) -> Option<Instant> {
        self.core.stirred = true;
        self.core.drain(self.now, &mut self.link)
    }

    fn take(&mut self, from: Scope, contents: Vec<Content>) {
        self.take_on(self.topic, from, contents);
    }

    fn take_on(&mut self, topic: TopicId, from: Scope, contents: Vec<Content>) {
        let mut batch: Vec<Received> =
            contents.into_iter().map(|content| received(content, self.now)).collect();
        self.core.ingest(self.now, WALL, topic, from, &mut batch, &mut self.link);
    }

    fn deliver(&mut self, frame: Frame) {
        self.core.deliver(self.now, frame, &mut self.link);
    }

    /// Sequences that the link got.
    fn submitted(&self) -> Vec<u64> {
        self.link.submitted.iter().map(|(_, _, frame)| frame.sequence()).collect()
    }

    /// Sequences that the brokers got.
    fn written(&self) -> Vec<u64> {
        self.out.frames.lock().iter().map(Frame::sequence).collect()
    }

    fn drops(&self) -> Vec<(DropReason, u64)> {
        self.core.path(self.topic).ingress_drops.iter().collect()
    }
}

fn received(content: Content, at: Instant) -> Received {
    Received { content, at, broker_age_us: 0, kept: false, place: None }
}

fn message(origin: [&str; 3], writer: u8, sequence: u64, depth: u32, bytes: usize) -> Frame {
    let origin = Origin {
        layer: origin[0].into(),
        node: origin[1].into(),
        service: origin[2].into(),
        ..Origin::default()
    };
    let header = Header {
        depth,
        encoding: "application/cdr; type=a/msg/B".into(),
        ..Header::new("imu/data", origin, WriterId([writer; 16]), sequence, WALL)
    };
    Frame::new(&header, Bytes::from(vec![0; bytes])).unwrap()
}

/// Of a service in the own layer.
fn frame(writer: u8, sequence: u64, node: &str, hops: u32, bytes: usize) -> Frame {
    message(["edge", node, "imu"], writer, sequence, 0, bytes).with_hops_and_age(hops, 0)
}

/// As it comes over the link, for late joiners too if `depth` is above 0.
fn from_fog(sequence: u64, depth: u32) -> Frame {
    message(["fog", "fog-1", ""], 3, sequence, depth, 0).with_hops_and_age(1, 0)
}

fn bare(payload: &'static str) -> Content {
    Content::Bare { payload: Bytes::from_static(payload.as_bytes()), identity: None }
}

fn bridge(from: Scope, to: Target) -> Bridge {
    Bridge { from, to, lane: lane_spec() }
}

#[test]
fn a_message_of_this_node_goes_to_every_bridge_once() {
    let mut bench = Bench::new(vec![
        bridge(Scope::Node, Target::Layer { json: false }),
        bridge(Scope::Node, to_cloud()),
    ]);
    let one = Content::Frame(frame(1, 1, "robot-1", 0, 10));
    bench.take(Scope::Node, vec![one.clone(), one]);
    assert_eq!(bench.link.submitted.len(), 1);
    assert_eq!(bench.link.submitted[0].2.hops(), 0, "the link adds its own");
    let written = bench.out.frames.lock().clone();
    assert_eq!(written.len(), 1);
    assert_eq!(written[0].hops(), 1, "the flow that writes adds one");
    assert_eq!(bench.drops(), vec![(DropReason::Duplicate, 1)]);
}

#[test]
fn what_is_not_from_here_stays_here() {
    let mut bench =
        Bench::new(vec![bridge(Scope::Node, to_cloud()), bridge(Scope::Layer, to_cloud())]);
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 1, "edge-2", 0, 1))]);
    assert_eq!(
        bench.drops(),
        vec![(DropReason::ForeignOrigin, 1)],
        "another node's message on this node scope"
    );
    bench.take(Scope::Layer, vec![Content::Frame(frame(2, 1, "edge-2", 1, 1))]);
    assert!(bench.link.submitted.is_empty(), "what a flow wrote to the layer does not leave it");
    bench.take(Scope::Layer, vec![Content::Frame(frame(2, 2, "edge-2", 0, 1))]);
    assert_eq!(bench.link.submitted.len(), 1, "what a service of the layer published does");
}

/// What is refused leaves no trace in the duplicate window: its high number would make the real
/// writer's ones old.
#[test]
fn a_foreign_message_does_not_silence_the_writer_whose_name_it_bears() {
    let bridges = || vec![bridge(Scope::Node, to_cloud())];
    let mut bench = Bench::new(bridges());
    bench.apply(bridges(), refusing(&["edge/robot-1/camera"]));
    let foreign = frame(1, 1_000_000, "edge-2", 0, 1);
    let denied = message(["edge", "robot-1", "camera"], 1, 1_000_000, 0, 1);
    bench.take(Scope::Node, vec![Content::Frame(foreign), Content::Frame(denied)]);
    assert_eq!(bench.drops(), [(DropReason::ForeignOrigin, 2)]);
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 1, "robot-1", 0, 1))]);
    assert_eq!(bench.submitted(), [1]);
}

#[test]
fn an_own_write_that_comes_back_is_an_echo() {
    let mut bench = Bench::new(vec![
        bridge(Scope::Inter, Target::Layer { json: false }),
        bridge(Scope::Layer, Target::Node(Form::Framed)),
    ]);
    bench.deliver(from_fog(5, 0).with_hops_and_age(1, 900));
    let written = bench.out.frames.lock()[0].clone();
    assert_eq!((written.hops(), written.age_us()), (2, 900));
    bench.take(Scope::Layer, vec![Content::Frame(written)]);
    assert_eq!(bench.drops(), vec![(DropReason::Echo, 1)]);
    assert_eq!(bench.out.frames.lock().len(), 1);
}

/// A flow that has just begun gets newer messages from one carrier, and then what the next one
/// sends again.
#[test]
fn what_comes_over_the_link_behind_newer_messages_is_dropped() {
    let mut bench = Bench::new(vec![bridge(Scope::Inter, Target::Layer { json: false })]);
    for sequence in [8, 9, 5, 6, 7, 8, 9, 10] {
        bench.deliver(from_fog(sequence, 0));
    }
    assert_eq!(bench.written(), [8, 9, 10]);
    assert_eq!(bench.drops(), [(DropReason::Duplicate, 5)]);
    // The first carrier could not send 11 to 13, and the next one begins with them.
    for sequence in [14, 15, 11, 12, 13, 14, 15, 16] {
        bench.deliver(from_fog(sequence, 0));
    }
    assert_eq!(bench.written(), [8, 9, 10, 14, 15, 16]);
}

#[test]
fn bare_payloads_get_an_identity_of_this_life_of_the_flow() {
    let bridges =
        vec![bridge(Scope::Node, to_cloud()), bridge(Scope::Node, Target::Node(Form::Bare))];
    let mut bench = Bench::new(Vec::new());
    let of_service = |service: &str| BareInfo {
        encoding: "application/json".into(),
        service: service.into(),
        ..BareInfo::default()
    };
    let info =
        TopicInfo { node: of_service("imu"), layer: of_service("another"), ..TopicInfo::default() };
    bench.apply(bridges, info);
    bench.take(Scope::Node, vec![bare("a"), bare("a")]);
    let sent: Vec<_> = bench.link.submitted.iter().map(|(_, _, frame)| frame.clone()).collect();
    assert_eq!(bench.submitted(), [1, 2], "equal payloads are two messages");
    assert_eq!(sent[0].origin_node(), "robot-1");
    assert_eq!((sent[0].origin_service(), sent[0].encoding()), ("imu", "application/json"));
    assert_eq!(bench.out.bare.lock().len(), 2);
}

/// What rules say of the topic that do not let these publish it.
fn refusing(origins: &[&str]) -> TopicInfo {
    let rules = access(&serde_json::json!([{"match": "imu/**", "advertise": {"deny": origins}}]));
    TopicInfo {
        node: BareInfo { service: "imu".into(), ..BareInfo::default() },
        access: rules.of(&"imu/data".parse().unwrap()),
        ..TopicInfo::default()
    }
}

#[test]
fn what_the_rules_refuse_is_told_apart_by_scope_and_from_what_is_of_elsewhere() {
    let bridges = || {
        vec![bridge(Scope::Node, to_cloud()), bridge(Scope::Inter, Target::Layer { json: false })]
    };
    let mut bench = Bench::new(bridges());
    bench.apply(bridges(), refusing(&["edge/robot-1/imu", "fog"]));
    let (denied, foreign) = (frame(1, 1, "robot-1", 0, 1), frame(2, 1, "edge-2", 0, 1));
    bench.take(Scope::Node, vec![Content::Frame(denied), Content::Frame(foreign), bare("a")]);
    for sequence in 1..=3 {
        bench.deliver(from_fog(sequence, 0));
    }
    assert_eq!(
        bench.drops(),
        [(DropReason::ForeignOrigin, 6)],
        "the contract has one reason for both"
    );
    assert!(bench.link.submitted.is_empty() && bench.written().is_empty());
    let lately = |bench: &Bench, from| {
        let refused = bench.core.path(bench.topic).refused_lately(from);
        (refused.denied, refused.foreign)
    };
    assert_eq!(lately(&bench, Scope::Node), (2, 1));
    assert_eq!(lately(&bench, Scope::Inter), (3, 0));
    assert_eq!(lately(&bench, Scope::Layer), (0, 0));
    bench.core.mark();
    bench.core.mark();
    assert_eq!(lately(&bench, Scope::Inter), (0, 0), "that was long ago");
    bench.apply(bridges(), TopicInfo::default());
    bench.take(Scope::Node, vec![bare("a")]);
    assert_eq!(bench.link.submitted.len(), 1, "without rules everybody may");
}

#[test]
fn what_is_kept_of_origins_that_may_not_publish_any_more_goes_nowhere() {
    for (info, copies) in [(TopicInfo::default(), 2), (refusing(&["fog"]), 1)] {
        let durable =
            |to| Bridge { lane: lane_with(|lane| lane.durable = true), ..bridge(Scope::Inter, to) };
        let mut bench = Bench::new(vec![durable(Target::Layer { json: false })]);
        bench.core.deliver_waiting(bench.now, bench.topic, &mut bench.link);
        bench.deliver(from_fog(1, 1));
        assert_eq!(bench.out.frames.lock().len(), 1);
        bench.apply(
            vec![durable(Target::Layer { json: false }), durable(Target::Node(Form::Framed))],
            info,
        );
        bench.core.deliver_waiting(bench.now, bench.topic, &mut bench.link);
        assert_eq!(bench.out.frames.lock().len(), copies);
    }
}

#[test]
fn garbage_is_counted() {
    let mut bench = Bench::new(vec![bridge(Scope::Node, to_cloud())]);
    bench.take(Scope::Node, vec![Content::from_bytes(Bytes::from_static(b"BLZ1\xff\xff\xff\xff"))]);
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
    let lane = lane_with(|lane| (lane.max_rate_hz, lane.lifespan_ms) = (Some(1.0), 100));
    let mut bench = Bench::new(vec![Bridge { from: Scope::Node, to: to_cloud(), lane }]);
    bench
        .take(Scope::Node, (1..=5).map(|n| Content::Frame(frame(1, n, "robot-1", 0, 1))).collect());
    let old = frame(1, 6, "robot-1", 0, 1).with_hops_and_age(0, 100_001);
    bench.take(Scope::Node, vec![Content::Frame(old)]);
    let stats = &bench.core.path(bench.topic).bridges[0].stats;
    assert_eq!(bench.link.submitted.len(), 2);
    assert_eq!(stats.dropped.get(DropReason::MaxRate), 3);
    assert_eq!(stats.dropped.get(DropReason::Lifespan), 1);
    assert_eq!(stats.taken.messages, stats.out.messages + stats.dropped.total() + stats.queued());
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
fn brokers_make_room_for_large_messages_before_one_has_come() {
    let mut bench = Bench::new(vec![bridge(Scope::Node, to_cloud())]);
    let topic: TopicName = "imu/data".parse().unwrap();
    let published = |name: &str| {
        let published = Some(MessageType { name: name.into(), hash: String::new() });
        TopicInfo {
            types: TopicTypes { published, ..TopicTypes::default() },
            ..TopicInfo::default()
        }
    };
    let advertised = TopicInfo { max_bytes: Some(70_000), ..TopicInfo::default() };
    let is_large = |bench: &Bench, info| bench.core.is_large(&topic, &info);
    assert!(is_large(&bench, published("sensor_msgs/msg/Image")));
    assert!(is_large(&bench, advertised));
    assert!(!is_large(&bench, published("sensor_msgs/msg/Imu")));
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 1, "robot-1", 0, 70_000))]);
    assert!(is_large(&bench, TopicInfo::default()), "one has come");
}

#[test]
fn a_bridge_that_is_no_longer_planned_drains_and_comes_back_with_its_counters() {
    let mut bench = Bench::new(vec![bridge(Scope::Node, to_cloud())]);
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 1, "robot-1", 0, 1))]);
    bench.apply(Vec::new(), TopicInfo::default());
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 2, "robot-1", 0, 1))]);
    assert_eq!(bench.link.submitted.len(), 1, "it takes in nothing more");
    assert!(bench.drain().is_some(), "something is still queued");
    assert!(bench.core.drain(bench.now + DRAIN, &mut bench.link).is_none(), "the deadline ends it");
    assert_eq!(bench.core.path(bench.topic).bridges[0].phase, Phase::Ended);
    bench.apply(vec![bridge(Scope::Node, to_cloud())], TopicInfo::default());
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 3, "robot-1", 0, 1))]);
    let bridges = &bench.core.path(bench.topic).bridges;
    assert_eq!((bridges.len(), bridges[0].stats.taken.messages), (1, 2));
}

proptest! {
    /// Whatever comes in, each message is either written, dropped with a reason or waiting; none
    /// twice; order is kept.
    #[test]
    fn nothing_is_lost_without_a_count(
        messages in proptest::collection::vec((0u8..3, 1u64..40, any::<bool>(), 0u64..200_000),
            1..200),
        refuse: bool,
        reliable: bool,
    ) {
        let lane = LaneSpec { lifespan_ms: 100, max_rate_hz: Some(50.0), reliable, ..lane_spec() };
        let mut bench = Bench::new(vec![
            Bridge { from: Scope::Node, to: to_cloud(), lane: lane.clone() },
            Bridge { from: Scope::Node, to: Target::Layer { json: false }, lane },
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
            prop_assert_eq!(
                stats.taken.messages,
                stats.out.messages + stats.dropped.total() + stats.queued(),
            );
        }
        let mut seen = std::collections::HashSet::new();
        for frame in bench.out.frames.lock().iter() {
            prop_assert!(seen.insert((frame.writer(), frame.sequence())), "written twice");
        }
    }
}

/// A broker's adapter that takes everything, and later does with it as it is told.
#[derive(Default)]
struct Adapter {
    later: Mutex<Later>,
    taken: Mutex<u64>,
}

impl Adapter {
    /// Drops or delivers of what is queued.
    fn settle(&self, delivered: u64, too_large: u64, lifespan: u64) {
        let mut later = self.later.lock();
        let mut take = |wanted: u64| {
            let part = wanted.min(later.queued);
            later.queued -= part;
            part
        };
        take(delivered);
        let (too_large, lifespan) = (take(too_large), take(lifespan));
        later.too_large += too_large;
        later.lifespan += lifespan;
    }
}

impl Publisher for Adapter {
    fn publish(&self, _: &Frame, _: Option<Instant>) -> PublishOutcome {
        self.later.lock().queued += 1;
        *self.taken.lock() += 1;
        PublishOutcome::Taken
    }
    fn publish_bare(&self, _: &Bytes, _: Option<Instant>) -> PublishOutcome {
        self.later.lock().queued += 1;
        *self.taken.lock() += 1;
        PublishOutcome::Taken
    }
    fn later(&self) -> Later {
        *self.later.lock()
    }
}

impl Bench {
    /// Applies one bridge from node to layer with this writer.
    fn write_with(&mut self, writer: Result<&Arc<Adapter>, &str>) {
        let plan = planned(vec![bridge(Scope::Node, Target::Layer { json: false })]);
        self.core.apply(self.now, self.topic, TopicInfo::default(), &plan, |_| {
            writer.map_err(str::to_owned).and_then(writes_to)
        });
    }

    fn publish(&mut self, sequences: std::ops::RangeInclusive<u64>) {
        let frames = sequences.map(|n| Content::Frame(frame(1, n, "robot-1", 0, 100)));
        self.take(Scope::Node, frames.collect());
    }

    /// Taken, out, too large, lifespan and queued of the only bridge.
    fn counts(&mut self) -> (u64, u64, u64, u64, u64) {
        let bridge = &mut self.core.path_mut(self.topic).bridges[0];
        bridge.settle();
        let stats = &bridge.stats;
        let dropped = |reason| stats.dropped.get(reason);
        assert_eq!(
            stats.taken.messages,
            stats.out.messages + stats.dropped.total() + stats.queued()
        );
        let (too_large, lifespan) = (dropped(DropReason::TooLarge), dropped(DropReason::Lifespan));
        (stats.taken.messages, stats.out.messages, too_large, lifespan, stats.queued())
    }
}

#[test]
fn what_the_broker_drops_later_is_not_out() {
    let mut bench = Bench::new(Vec::new());
    let adapter = Arc::new(Adapter::default());
    bench.write_with(Ok(&adapter));
    bench.publish(1..=10);
    assert_eq!(bench.counts(), (10, 0, 0, 0, 10));
    adapter.settle(4, 1, 0);
    assert_eq!(bench.counts(), (10, 4, 1, 0, 5));
    assert_eq!(bench.core.path(bench.topic).bridges[0].stats.out.bytes, 400);
    adapter.settle(0, 0, 2);
    bench.publish(11..=12);
    assert_eq!(bench.counts(), (12, 4, 1, 2, 5));
    adapter.settle(5, 0, 0);
    assert_eq!(bench.counts(), (12, 9, 1, 2, 0));
    assert_eq!(bench.core.path(bench.topic).bridges[0].stats.out.bytes, 900);
}

#[test]
fn a_replaced_writer_ends_its_account() {
    let mut bench = Bench::new(Vec::new());
    let (first, second) = (Arc::new(Adapter::default()), Arc::new(Adapter::default()));
    bench.write_with(Ok(&first));
    bench.publish(1..=4);
    bench.write_with(Ok(&second));
    bench.publish(5..=6);
    assert_eq!((*first.taken.lock(), *second.taken.lock()), (4, 2));
    first.settle(1, 0, 3);
    assert_eq!(bench.counts(), (6, 1, 0, 3, 2));
    assert_eq!(Arc::strong_count(&first), 1, "nobody needs it any more");
    second.settle(2, 0, 0);
    assert_eq!(bench.counts(), (6, 3, 0, 3, 0));
    // However often it is replaced, what is kept is bounded and the counts hold.
    let many: Vec<_> = (0..20).map(|_| Arc::new(Adapter::default())).collect();
    for (n, adapter) in (7..).zip(&many) {
        bench.write_with(Ok(adapter));
        bench.publish(n..=n);
    }
    let (taken, out, .., queued) = bench.counts();
    assert_eq!((taken, out, queued), (26, 18, 5));
}

#[test]
fn a_bridge_that_ends_keeps_its_writer_until_all_is_delivered() {
    let mut bench = Bench::new(Vec::new());
    let adapter = Arc::new(Adapter::default());
    bench.write_with(Ok(&adapter));
    bench.publish(1..=4);
    bench.apply(Vec::new(), TopicInfo::default());
    assert!(bench.drain().is_some(), "it still waits");
    assert!(bench.core.drain(bench.now + DRAIN, &mut bench.link).is_none());
    let ended = |bench: &Bench| bench.core.path(bench.topic).bridges[0].is_over();
    assert!(!ended(&bench) && Arc::strong_count(&adapter) == 2);
    let name: TopicName = "imu/data".parse().unwrap();
    let held = bench.core.writer_of(&name, Scope::Node, &Target::Layer { json: false }).cloned();
    assert!(held.is_some(), "if it comes back it goes on with the same queue, in order");
    drop(held);
    adapter.settle(3, 1, 0);
    bench.core.mark();
    assert!(ended(&bench) && Arc::strong_count(&adapter) == 1);
    assert_eq!(bench.counts(), (4, 3, 1, 0, 0));
}

#[test]
fn a_bridge_without_a_writer_has_failed_and_reads_nothing() {
    let mut bench = Bench::new(Vec::new());
    bench.write_with(Err("no such name"));
    let failed = bench.core.path(bench.topic).bridges[0].phase;
    assert!(
        matches!(failed, Phase::Failed { .. }) && !bench.core.path(bench.topic).reads(Scope::Node)
    );
    bench.now += Duration::from_secs(5);
    bench.write_with(Err("still none"));
    let found = &bench.core.path(bench.topic).bridges[0];
    assert_eq!((found.phase, found.failure.as_deref()), (failed, Some("still none")));
    let adapter = Arc::new(Adapter::default());
    bench.write_with(Ok(&adapter));
    bench.publish(1..=2);
    assert_eq!(bench.counts().0, 2);
    bench.write_with(Err("not now"));
    bench.publish(3..=3);
    assert_eq!(*adapter.taken.lock(), 3, "the one that works is kept");
    // Neither planned nor ever made: it ends at once.
    let mut bench = Bench::new(Vec::new());
    bench.write_with(Err("no such name"));
    bench.apply(Vec::new(), TopicInfo::default());
    assert!(bench.core.path(bench.topic).bridges[0].is_over());
}

#[test]
fn bare_copies_are_made_of_what_comes_from_anywhere() {
    let bridges = [Scope::Node, Scope::Layer, Scope::Inter]
        .map(|from| bridge(from, Target::Node(Form::Bare)));
    let mut bench = Bench::new(bridges.into());
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 1, "robot-1", 0, 1))]);
    bench.take(Scope::Layer, vec![Content::Frame(frame(2, 1, "edge-2", 1, 2))]);
    bench.deliver(message(["fog", "fog-1", ""], 3, 5, 0, 3).with_hops_and_age(1, 900));
    let sizes: Vec<usize> = bench.out.bare.lock().iter().map(Bytes::len).collect();
    assert_eq!(sizes, [1, 2, 3]);
    assert!(bench.out.frames.lock().is_empty());
}

#[test]
fn topics_that_nobody_uses_make_room_for_others() {
    let mut bench = Bench::new(vec![bridge(Scope::Node, to_cloud())]);
    let used = bench.topic;
    let mut now = bench.now;
    let idle: Vec<TopicId> = (1..MAX_TOPICS)
        .map(|n| bench.core.intern(&format!("t{n}").parse().unwrap(), now).unwrap())
        .collect();
    bench.core.forget_unused(now);
    now += FORGET - Duration::from_secs(1);
    assert_eq!(bench.core.forget_unused(now), 0);
    assert!(bench.core.intern(&"new".parse().unwrap(), now).is_none());
    now += Duration::from_secs(1);
    assert_eq!(bench.core.forget_unused(now), MAX_TOPICS - 1);
    assert_eq!(bench.core.topics().map(|(id, _)| id).collect::<Vec<_>>(), [used]);
    assert_eq!(bench.core.find("t5"), None);
    for n in 1..MAX_TOPICS {
        let id = bench.core.intern(&format!("u{n}").parse().unwrap(), now).unwrap();
        assert!(idle.contains(&id) && bench.core.path(id).bridges.is_empty());
    }
    assert!(bench.core.intern(&"one-more".parse().unwrap(), now).is_none());
    assert_eq!(bench.core.forget_unused(now), 0, "those have just come");
}

#[test]
fn a_forgotten_topic_leaves_its_lanes_and_windows_to_others() {
    let mut bench = Bench::new(vec![bridge(Scope::Node, to_cloud())]);
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 1, "robot-1", 0, 1))]);
    let (lane, _, _) = bench.link.submitted[0];
    bench.link.waiting.clear();
    bench.apply(Vec::new(), TopicInfo::default());
    bench.drain();
    bench.core.forget_unused(bench.now);
    bench.now += FORGET;
    assert_eq!(bench.core.forget_unused(bench.now), 1);
    bench.core.lane_out(lane, 1, 1);
    bench.topic = bench.core.intern(&"imu/data".parse().unwrap(), bench.now).unwrap();
    bench.apply(vec![bridge(Scope::Node, to_cloud())], TopicInfo::default());
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 1, "robot-1", 0, 1))]);
    assert_eq!(bench.link.submitted.len(), 2, "the window of the topic that was is gone");
    assert_eq!(bench.link.submitted[1].0, lane);
    bench.core.lane_out(lane, 1, 1);
    assert_eq!(bench.core.path(bench.topic).bridges[0].stats.out.messages, 1);
}

#[test]
fn bare_messages_of_a_topic_that_was_forgotten_have_another_writer() {
    let mut bench = Bench::new(vec![bridge(Scope::Node, to_cloud())]);
    bench.take(Scope::Node, vec![bare("a"), bare("a")]);
    bench.link.waiting.clear();
    bench.apply(Vec::new(), TopicInfo::default());
    bench.drain();
    bench.core.forget_unused(bench.now);
    bench.now += FORGET;
    assert_eq!(bench.core.forget_unused(bench.now), 1);
    bench.topic = bench.core.intern(&"imu/data".parse().unwrap(), bench.now).unwrap();
    bench.apply(vec![bridge(Scope::Node, to_cloud())], TopicInfo::default());
    bench.take(Scope::Node, vec![bare("a")]);
    assert_eq!(bench.submitted(), [1, 2, 1]);
    let sent: Vec<_> = bench.link.submitted.iter().map(|(_, _, frame)| frame).collect();
    assert_eq!(sent[0].writer(), sent[1].writer());
    assert_ne!(sent[1].writer(), sent[2].writer(), "its numbers begin again");
}

#[test]
fn a_bridge_takes_the_place_of_one_that_ended_long_ago() {
    let to = |n: usize| Target::Inter {
        layer: "cloud".parse().unwrap(),
        receiver: format!("cloud/cloud-{n}").parse().unwrap(),
    };
    let mut bench = Bench::new(vec![bridge(Scope::Node, to(0))]);
    for n in 1..100 {
        bench.now += FORGET;
        bench.apply(vec![bridge(Scope::Node, to(n))], TopicInfo::default());
        bench.drain();
    }
    assert!(bench.core.path(bench.topic).bridges.len() <= 3);
    // The receivers before it never say that they have written what they got.
    bench.now += FORGET;
    bench.drain();
    bench.take(Scope::Node, vec![Content::Frame(frame(1, 1, "robot-1", 0, 1))]);
    let (lane, _, _) = bench.link.submitted[0];
    bench.core.lane_out(lane, 1, 1);
    let live = bench.core.path(bench.topic).bridges.iter().find(|bridge| bridge.target == to(99));
    assert_eq!(live.unwrap().stats.out.messages, 1);
}

proptest! {
    /// Whatever an adapter does with what it took, everything is counted once and nothing that was
    /// out comes back.
    #[test]
    fn late_drops_keep_the_counts(
        steps in proptest::collection::vec((0u64..20, 0u64..20, 0u64..5, 0u64..5, any::<bool>()),
            1..60),
    ) {
        let mut bench = Bench::new(Vec::new());
        let mut adapters = vec![Arc::new(Adapter::default())];
        bench.write_with(Ok(&adapters[0]));
        let (mut next, mut out) = (1, 0);
        for (publish, delivered, too_large, lifespan, replace) in steps {
            if publish > 0 {
                bench.publish(next..=next + publish - 1);
            }
            next += publish;
            for adapter in &adapters {
                adapter.settle(delivered, too_large, lifespan);
            }
            if replace && adapters.len() < 4 {
                adapters.push(Arc::new(Adapter::default()));
                bench.write_with(Ok(adapters.last().unwrap()));
            }
            let counts = bench.counts();
            prop_assert_eq!(counts.0, next - 1);
            prop_assert!(counts.1 >= out);
            out = counts.1;
            let queued: u64 = adapters.iter().map(|adapter| adapter.later().queued).sum();
            prop_assert_eq!(counts.4, queued);
        }
    }
}
