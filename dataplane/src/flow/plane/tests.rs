//! The pool at work: threads between two message paths, over a link that carries every datagram.

use std::sync::atomic::{AtomicBool, AtomicUsize};
use std::time::Duration;

use blaze_brokers::{Content, Later, PublishOutcome, Publisher, PublisherOptions};
use blaze_domain::node_file::{Codec, Compression};
use blaze_domain::{DropReason, FlowId, LayerKind, Origin, WriterId};
use blaze_proto::link::link_control::LayerScope;
use blaze_proto::{Frame, Header};
use bytes::Bytes;

use super::*;
use crate::lane::compress_stage::CompressionRules;
use crate::lane::core::DataConfig;
use crate::lane::path::TopicInfo;
use crate::lane::writer::NewWriter;
use crate::link::{EngineConfig, Limits};
use crate::plan::{Bridge, LaneSpec, Target, TopicPlan};
use crate::testing::{eventually, on_threads};

const BYTES: usize = 200_000;

#[derive(Default)]
struct Collector(Mutex<Vec<Frame>>);

impl Publisher for Collector {
    fn publish(&self, frame: &Frame, _: Option<Instant>) -> PublishOutcome {
        self.0.lock().push(frame.clone());
        PublishOutcome::Taken
    }
    fn publish_bare(&self, _: &Bytes, _: Option<Instant>) -> PublishOutcome {
        PublishOutcome::Taken
    }
    fn later(&self) -> Later {
        Later::default()
    }
}

/// A robot that publishes to a cloud.
struct Pair {
    robot: Arc<Plane>,
    cloud: Arc<Plane>,
    topic: TopicId,
    written: Arc<Collector>,
    sequence: u64,
}

fn plane(me: &str) -> Arc<Plane> {
    let me: FlowId = me.parse().unwrap();
    let mut core =
        DataCore::new(DataConfig { me: me.clone(), epoch: 1, large_bytes: 65_536, salt: 1 });
    core.set_compression(CompressionRules {
        base: Compression { codec: Codec::Lz4, level: 1, min_bytes: 65_536, adaptive: false },
        topics: Vec::new(),
    });
    let config = EngineConfig {
        me,
        kind: LayerKind::Edge,
        epoch: 1,
        layer_scope: (LayerScope::None, 0),
        max_datagram: 1300,
        limits: Limits::default(),
    };
    Plane::new(core, Some(Engine::new(config, Instant::now(), wall_ns())))
}

/// Gives a flow one bridge of the topic.
fn connect(plane: &Plane, from: Scope, to: Target, publisher: &Arc<Collector>) -> TopicId {
    let lane = LaneSpec { reliable: true, depth: 1, ..LaneSpec::default() };
    let plan = TopicPlan { bridges: vec![Bridge { from, to, lane }], ..TopicPlan::default() };
    plane.with(|state| {
        let now = Instant::now();
        let topic = state.core.intern(&"camera".parse().unwrap(), now).unwrap();
        state.core.apply(now, topic, TopicInfo::default(), &plan, |_| {
            Ok(NewWriter {
                publisher: Arc::clone(publisher) as Arc<dyn Publisher>,
                options: PublisherOptions::default(),
            })
        });
        topic
    })
}

/// Everything that one has to send to the other.
fn carry(from: &Plane, to: &Plane) {
    while let Next::Datagram(Transmit { class, datagram, .. }) = from.next_transmit() {
        to.transport_event(TransportEvent::Received { class, datagram });
    }
}

impl Pair {
    /// Both know one another; the robot's threads do this with a payload.
    fn new(run: Run) -> Self {
        let (robot, cloud) = (plane("edge/robot-1"), plane("cloud/cloud-1"));
        let written = Arc::<Collector>::default();
        let to = Target::Inter {
            layer: "cloud".parse().unwrap(),
            receiver: "cloud/cloud-1".parse().unwrap(),
        };
        let topic = connect(&robot, Scope::Node, to, &written);
        connect(&cloud, Scope::Inter, Target::Layer { json: false }, &written);
        for (plane, other) in [(&robot, "cloud/cloud-1"), (&cloud, "edge/robot-1")] {
            let flow = other.parse().unwrap();
            plane.transport_event(TransportEvent::Discovered(Endpoint { flow, epoch: 1 }));
        }
        robot.compress_by(1, on_threads(), run).unwrap();
        cloud.compress_with(2, on_threads()).unwrap();
        let pair = Self { robot, cloud, topic, written, sequence: 0 };
        let receiver: FlowId = "cloud/cloud-1".parse().unwrap();
        eventually(|| {
            pair.carry();
            let engine = |state: &mut PlaneState| {
                state.engine.as_ref().map(|engine| engine.takes_lz4(&receiver))
            };
            pair.robot.read(engine) == Some(true)
        });
        pair
    }

    fn carry(&self) {
        carry(&self.robot, &self.cloud);
        carry(&self.cloud, &self.robot);
    }

    /// One picture, all of this byte.
    fn publish(&mut self, byte: u8) {
        self.sequence += 1;
        let origin = Origin { layer: "edge".into(), node: "robot-1".into(), ..Origin::default() };
        let header = Header::new("camera", origin, WriterId([5; 16]), self.sequence, wall_ns());
        let received = Received {
            content: Content::Frame(Frame::new(&header, Bytes::from(vec![byte; BYTES])).unwrap()),
            at: Instant::now(),
            broker_age_us: 0,
            kept: false,
            place: None,
        };
        self.robot.ingest(self.topic, Scope::Node, &mut vec![received]);
    }

    /// The first byte of each picture that the cloud has written, and the sequences are those that
    /// follow one another.
    fn arrived(&self) -> Vec<u8> {
        let frames = self.written.0.lock();
        let ascend = frames.windows(2).all(|pair| pair[0].sequence() < pair[1].sequence());
        assert!(ascend, "{:?}", frames.iter().map(Frame::sequence).collect::<Vec<u64>>());
        let first = frames.iter().map(|frame| {
            let payload = frame.payload();
            assert!(payload.len() == BYTES && payload.iter().all(|byte| *byte == payload[0]));
            payload[0]
        });
        first.collect()
    }

    fn dropped(&self, reason: DropReason) -> u64 {
        let topic = self.topic;
        self.robot.read(|state| state.core.path(topic).bridges[0].stats.dropped.get(reason))
    }
}

#[test]
fn pictures_cross_the_link_compressed_while_threads_come_and_go() {
    let mut pair = Pair::new(Work::run);
    for byte in 0..60 {
        pair.publish(byte);
        pair.robot.codec().unwrap().resize(1 + usize::from(byte % 3)).unwrap();
        pair.cloud.codec().unwrap().resize(1 + usize::from(byte % 2)).unwrap();
        // A publisher that the pool keeps up with: what waits for it is bounded, and what is beyond
        // that would be dropped.
        let waiting = |plane: &Plane| plane.read(|state| state.core.compress_counters().waiting);
        eventually(|| {
            pair.carry();
            waiting(&pair.robot) < 2 && waiting(&pair.cloud) < 2
        });
    }
    eventually(|| {
        pair.carry();
        pair.arrived().len() == 60
    });
    assert_eq!(pair.arrived(), (0..60).collect::<Vec<u8>>());
    let topic = pair.topic;
    let stats = pair.robot.read(|state| state.core.path(topic).compress_stats);
    assert_eq!(stats.before, 60 * BYTES as u64);
    assert!(stats.after < stats.before / 50, "{stats:?}");
    let waiting = pair.cloud.read(|state| state.core.compress_counters().waiting);
    assert_eq!(waiting, 0);
}

/// The thread goes on, and the picture goes as it is.
#[test]
fn a_codec_that_panics_costs_no_message() {
    fn fails(work: &Work, payload: &[u8]) -> Done {
        assert!(payload[0] != 7, "as it is meant to");
        work.run(payload)
    }
    let mut pair = Pair::new(fails);
    for byte in 6..9 {
        pair.publish(byte);
    }
    eventually(|| {
        pair.carry();
        pair.arrived() == [6, 7, 8]
    });
    assert_eq!(pair.robot.read(|state| state.core.compress_counters().failed), 1);
    assert_eq!(pair.robot.codec().unwrap().counters().threads, 1);
}

#[test]
fn stopped_with_pictures_that_wait_it_counts_them_and_the_rest_goes_as_it_is() {
    static MAY_END: AtomicBool = AtomicBool::new(false);
    fn slow(work: &Work, payload: &[u8]) -> Done {
        while !MAY_END.load(Ordering::SeqCst) {
            std::thread::sleep(Duration::from_millis(1));
        }
        work.run(payload)
    }
    let mut pair = Pair::new(slow);
    for byte in 0..5 {
        pair.publish(byte);
    }
    eventually(|| pair.robot.read(|state| state.core.compress_counters().waiting) == 4);
    pair.robot.stop_compression();
    assert_eq!(pair.dropped(DropReason::Shutdown), 4);
    pair.publish(5);
    MAY_END.store(true, Ordering::SeqCst);
    eventually(|| {
        pair.carry();
        pair.arrived() == [0, 5]
    });
    eventually(|| pair.robot.codec().unwrap().counters().threads == 0);
    assert_eq!(pair.dropped(DropReason::Shutdown), 4);
}

/// They hold it only while they run a job.
#[test]
fn the_threads_end_with_the_message_path() {
    let ended = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&ended);
    let spawner: Spawner = Box::new(move |name, run| {
        let ended = Arc::clone(&counted);
        let whole = move || {
            run();
            ended.fetch_add(1, Ordering::SeqCst);
        };
        std::thread::Builder::new().name(name).spawn(whole).map(|_| ())
    });
    let robot = plane("edge/robot-1");
    robot.compress_with(3, spawner).unwrap();
    drop(robot);
    eventually(|| ended.load(Ordering::SeqCst) == 3);
}

#[test]
fn what_is_brought_is_sent_by_who_brought_it() {
    let mut pair = Pair::new(Work::run);
    let sent = Arc::new(Mutex::new(Vec::new()));
    let (cloud, sends) = (Arc::clone(&pair.cloud), Arc::clone(&sent));
    pair.robot.send_by(Box::new(move |robot| {
        // Not under the lock.
        carry(robot, &cloud);
        sends.lock().push(std::thread::current().id());
        false
    }));
    let topic = pair.topic;
    pair.robot.read(|state| state.core.path_mut(topic).compression.codec = Codec::None);
    pair.publish(1);
    assert_eq!(*sent.lock(), [std::thread::current().id()]);
    eventually(|| {
        pair.carry();
        pair.arrived() == [1]
    });
}
