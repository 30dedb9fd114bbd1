//! What one message costs in the message path of a flow: `cargo run --release -p blaze-flow --example message_path`.
//!
//! From the node scope to the layer scope with a writer that only counts, in batches as a source task takes them.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a measurement ends where something is wrong"
)]

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use blaze_brokers::{Content, Later, PublishOutcome, Publisher, PublisherOptions, Received};
use blaze_domain::{FlowId, Origin, Scope, TopicName, WriterId};
use blaze_flow::flow::plane::{Plane, wall_ns};
use blaze_flow::lane::core::{DataConfig, DataCore};
use blaze_flow::lane::path::TopicInfo;
use blaze_flow::lane::writer::NewWriter;
use blaze_flow::plan::{Bridge, LaneSpec, Target, TopicPlan};
use blaze_proto::{Frame, Header};
use bytes::Bytes;

const MESSAGES: u64 = 1_000_000;

#[derive(Default)]
struct Counter(AtomicU64);

impl Publisher for Counter {
    fn publish(&self, frame: &Frame, _: Option<Instant>) -> PublishOutcome {
        self.0.fetch_add(frame.payload().len() as u64, Ordering::Relaxed);
        PublishOutcome::Taken
    }
    fn publish_bare(&self, payload: &Bytes, _: Option<Instant>) -> PublishOutcome {
        self.0.fetch_add(payload.len() as u64, Ordering::Relaxed);
        PublishOutcome::Taken
    }
    fn later(&self) -> Later {
        Later::default()
    }
}

fn frame(me: &FlowId, topic: &TopicName, sequence: u64, payload: &Bytes) -> Content {
    let origin = Origin {
        layer: me.layer.to_string(),
        node: me.node.to_string(),
        service: "imu-driver".into(),
        ..Origin::default()
    };
    let header = Header::new(topic.as_str(), origin, WriterId([7; 16]), sequence, wall_ns());
    Content::Frame(Frame::new(&header, payload.clone()).unwrap())
}

/// Nanoseconds per message.
fn measure(batch_size: usize, bare: bool) -> f64 {
    let me: FlowId = "edge/robot-1".parse().unwrap();
    let topic: TopicName = "imu/data".parse().unwrap();
    let mut core = DataCore::new(DataConfig {
        me: me.clone(),
        epoch: 1,
        large_bytes: 65_536,
        salt: 1,
    });
    let now = Instant::now();
    let id = core.intern(&topic, now).unwrap();
    let lane = LaneSpec {
        depth: 1,
        ..LaneSpec::default()
    };
    let plan = TopicPlan {
        bridges: vec![Bridge {
            from: Scope::Node,
            to: Target::Layer,
            lane,
        }],
        ..TopicPlan::default()
    };
    let counter = Arc::new(Counter::default());
    core.apply(now, id, TopicInfo::default(), &plan, |_| {
        Ok(NewWriter {
            publisher: Arc::clone(&counter) as Arc<dyn Publisher>,
            options: PublisherOptions::default(),
        })
    });
    let plane = Plane::new(core, None);
    let payload = Bytes::from(vec![1; 1000]);
    let mut batch = Vec::with_capacity(batch_size);
    let mut spent = std::time::Duration::ZERO;
    let mut sequence = 0;
    while sequence < MESSAGES {
        for _ in 0..batch_size {
            sequence += 1;
            let content = if bare {
                Content::Bare {
                    payload: payload.clone(),
                    identity: None,
                }
            } else {
                frame(&me, &topic, sequence, &payload)
            };
            batch.push(Received {
                content,
                at: Instant::now(),
                broker_age_us: 0,
                kept: false,
                place: None,
            });
        }
        let start = Instant::now();
        plane.ingest(id, Scope::Node, &mut batch);
        spent += start.elapsed();
    }
    assert_eq!(
        counter.0.load(Ordering::Relaxed),
        sequence * 1000,
        "every message is written"
    );
    spent.as_nanos() as f64 / sequence as f64
}

fn main() {
    for (what, bare) in [("framed", false), ("bare", true)] {
        for batch in [1, 8, 64] {
            println!("{what}, batches of {batch}: {:.0} ns per message", measure(batch, bare));
        }
    }
}
