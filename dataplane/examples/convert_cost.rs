//! Cost of a message through a flow's message path, as it is and as JSON:
//! `cargo run --release -p blaze-flow --example convert_cost`.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a measurement stops")]

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use blaze_brokers::{Content, Later, PublishOutcome, Publisher, PublisherOptions, Received};
use blaze_domain::{Origin, Scope, WriterId};
use blaze_flow::flow::plane::PlaneState;
use blaze_flow::lane::core::{DataConfig, DataCore};
use blaze_flow::lane::path::TopicInfo;
use blaze_flow::lane::writer::NewWriter;
use blaze_flow::plan::{Bridge, Form, LaneSpec, Target, TopicPlan};
use blaze_flow::types::{MessageType, TopicTypes, Types, Wanted};
use blaze_proto::{Frame, Header};
use bytes::Bytes;

const MESSAGES: u64 = 20_000;
const WALL_NS: u64 = 1_700_000_000_000_000_000;

/// Counts bytes.
#[derive(Default)]
struct Sink(AtomicU64);

impl Publisher for Sink {
    fn publish(&self, frame: &Frame, _: Option<Instant>) -> PublishOutcome {
        self.publish_bare(frame.payload(), None)
    }
    fn publish_bare(&self, payload: &Bytes, _: Option<Instant>) -> PublishOutcome {
        self.0.fetch_add(payload.len() as u64, Ordering::Relaxed);
        PublishOutcome::Taken
    }
    fn later(&self) -> Later {
        Later::default()
    }
}

/// Mean time of a message on one thread, and the bytes that were written of it.
fn measure(to: &Target, info: TopicInfo, encoding: &str, payload: &Bytes) -> (Duration, u64) {
    let config =
        DataConfig { me: "edge/r".parse().unwrap(), epoch: 1, large_bytes: 65_536, salt: 1 };
    let (mut core, now) = (DataCore::new(config), Instant::now());
    let topic = core.intern(&"odom".parse().unwrap(), now).unwrap();
    let bridge = Bridge { from: Scope::Node, to: to.clone(), lane: LaneSpec::default() };
    let plan = TopicPlan { bridges: vec![bridge], ..TopicPlan::default() };
    let sink = Arc::<Sink>::default();
    core.apply(now, topic, info, &plan, |_| {
        let publisher = Arc::clone(&sink) as Arc<dyn Publisher>;
        Ok(NewWriter { publisher, options: PublisherOptions::default() })
    });
    let mut plane = PlaneState { core, engine: None };
    let origin = Origin { layer: "edge".into(), node: "r".into(), ..Origin::default() };
    let frame = |sequence| {
        let header = Header {
            encoding: encoding.to_owned(),
            ..Header::new("odom", origin.clone(), WriterId([1; 16]), sequence, WALL_NS)
        };
        Received::live(Content::Frame(Frame::new(&header, payload.clone()).unwrap()), now)
    };
    let mut batches: Vec<Vec<Received>> = (1..=MESSAGES).map(|n| vec![frame(n)]).collect();
    let began = Instant::now();
    for batch in &mut batches {
        plane.ingest(now, WALL_NS, topic, Scope::Node, batch);
    }
    (began.elapsed() / u32::try_from(MESSAGES).unwrap(), sink.0.load(Ordering::Relaxed) / MESSAGES)
}

fn main() {
    let name = "nav_msgs/msg/Odometry";
    let covariance: Vec<String> =
        (0..36).map(|at| format!("{}", f64::from(at) * 0.01237 + 1e-9)).collect();
    let covariance = covariance.join(",");
    let json = format!(
        r#"{{"header":{{"stamp":{{"sec":1764325012,"nanosec":123456789}},"frame_id":"odom"}},
        "child_frame_id":"base_link","pose":{{"pose":{{"position":{{"x":12.3456789,"y":-0.98765}},
        "orientation":{{"x":0.0012,"y":-0.0034,"z":0.70710678,"w":0.70710678}}}},
        "covariance":[{covariance}]}},"twist":{{"twist":{{"linear":{{"x":0.45678}},
        "angular":{{"z":0.1234567}}}},"covariance":[{covariance}]}}}}"#
    );
    let (types, began) = (Types::default(), Instant::now());
    let ty = types.get(began, MessageType { name, hash: "" }).unwrap();
    println!("first type, with all that is built in: {:?}", began.elapsed());
    let mut cdr = Vec::new();
    ty.program.to_cdr(json.as_bytes(), &mut cdr).unwrap();
    let (cdr, json) = (Bytes::from(cdr), Bytes::from(json));
    let encoding = format!("application/cdr; type={name}");
    let ty = MessageType { name: name.to_owned(), hash: String::new() };
    let types = TopicTypes { wanted: Wanted::Type(ty), published: None };
    let wanted = || TopicInfo { types: types.clone(), ..TopicInfo::default() };
    let layer = Target::Layer { json: false };
    for (what, to, encoding, payload) in [
        ("CDR as it is", &layer, encoding.as_str(), &cdr),
        ("CDR to JSON", &Target::Node(Form::Json), &encoding, &cdr),
        ("JSON as JSON", &Target::Node(Form::Json), "application/json", &json),
        ("JSON to CDR", &Target::Ros2, "application/json", &json),
        ("CDR to ROS 2", &Target::Ros2, &encoding, &cdr),
    ] {
        let (time, bytes) = measure(to, wanted(), encoding, payload);
        println!("{what}: {} bytes in, {bytes} out, {time:?} a message", payload.len());
    }
}
