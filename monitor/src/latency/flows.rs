//! What the flows' own figures say of the latency of a topic: passive rows, and the split by hop.
//!
//! ```text
//! publisher ─broker─► flow of `from` ──link──► flow here ─broker─► requester
//!             rest      latency_ms     rtt/2   latency_ms   rest        whole: age_ms, or measured
//! ```

use std::collections::BTreeMap;

use blaze_domain::FlowId;
use serde::{Deserialize, Serialize};

use crate::health::Link;

/// Scope of bridges that come from or go to other flows.
const INTER: &str = "inter";

/// Figures of one flow, from its admin port.
#[derive(Debug, Clone)]
pub struct FlowFigures {
    /// The flow.
    pub flow: FlowId,
    /// Whether it is one of this node; others only split the latency by hop.
    pub is_here: bool,
    /// Items of its `/v1/bridges`.
    pub bridges: Vec<Bridge>,
    /// Links of its `/v1/summary`.
    pub links: Vec<Link>,
    /// Nodes that advertise a topic, from its `/v1/topics`.
    pub publishers: BTreeMap<String, Vec<FlowId>>,
}

/// An item of `/v1/bridges`, as far as latency needs it.
#[derive(Debug, Clone, Deserialize)]
pub struct Bridge {
    /// Its topic.
    pub topic: String,
    /// Where it reads.
    pub from: End,
    /// Where it writes.
    pub to: End,
    /// Messages that it wrote.
    pub out: Count,
    /// Time of messages in its flow.
    #[serde(default)]
    pub latency_ms: Option<Quantiles>,
    /// Age of messages when they were written; `None` on the link.
    #[serde(default)]
    pub age_ms: Option<Quantiles>,
}

/// An end of a bridge.
#[derive(Debug, Clone, Deserialize)]
pub struct End {
    /// `node`, `layer`, `ros2` or `inter`.
    pub scope: String,
    /// The flow that gets the messages; none in `from`.
    #[serde(default)]
    pub flow: Option<FlowId>,
}

/// A count of messages.
#[derive(Debug, Clone, Copy, Deserialize)]
pub struct Count {
    /// Messages.
    pub messages: u64,
}

/// Quantiles in ms; `None` before the first message.
#[derive(Debug, Clone, Copy, PartialEq, Default, Deserialize, Serialize)]
pub struct Quantiles {
    /// Median.
    pub p50: Option<f64>,
    /// 99th percentile.
    pub p99: Option<f64>,
}

impl Quantiles {
    fn both(self) -> Option<(f64, f64)> {
        Some((self.p50?, self.p99?))
    }
}

/// A part of a latency. Quantiles of parts do not add up exactly to those of the whole.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Hop {
    /// `flow LAYER/NODE`, `link LAYER/NODE`, `brokers`; parts whose flow was not asked follow
    /// `brokers` with `and`.
    #[serde(rename = "where")]
    pub place: String,
    /// Median in ms.
    pub p50_ms: f64,
    /// 99th percentile in ms.
    pub p99_ms: f64,
}

/// What the flows know of a topic from one node.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Path {
    pub(super) messages: u64,
    pub(super) age_ms: Quantiles,
    pub(super) error_ms: f64,
    known: Vec<Hop>,
    unknown: Vec<String>,
}

impl Path {
    /// The way of a topic from a node (`None`: from any) to the flow here.
    pub(super) fn of(flows: &[FlowFigures], topic: &str, from: Option<&FlowId>) -> Option<Self> {
        let here = flows.iter().filter(|figures| figures.is_here);
        let fits = |figures: &FlowFigures, bridge: &&Bridge| {
            let crosses = from.map(|from| from.layer != figures.flow.layer);
            bridge.topic == topic
                && bridge.age_ms.is_some_and(|age| age.both().is_some())
                && crosses.is_none_or(|crosses| crosses == (bridge.from.scope == INTER))
        };
        let delivering = here.flat_map(|figures| {
            let bridges = figures.bridges.iter().filter(|bridge| fits(figures, bridge));
            bridges.map(move |bridge| (figures, bridge))
        });
        let (here, bridge) = delivering.max_by_key(|(_, bridge)| bridge.out.messages)?;
        let mut path = Self {
            messages: bridge.out.messages,
            age_ms: bridge.age_ms?,
            error_ms: 0.0,
            known: Vec::new(),
            unknown: Vec::new(),
        };
        if bridge.from.scope == INTER {
            path.cross(flows, here, topic, from);
        }
        path.add(format!("flow {}", here.flow), bridge.latency_ms.and_then(Quantiles::both));
        Some(path)
    }

    /// From the flow of the publisher over the link.
    fn cross(
        &mut self,
        flows: &[FlowFigures],
        here: &FlowFigures,
        topic: &str,
        from: Option<&FlowId>,
    ) {
        let half = |link: &Link| link.rtt_ms.map(|rtt| rtt / 2.0);
        let is_of = |link: &&Link| from.is_none_or(|from| link.flow.layer == from.layer);
        let bound = here.links.iter().filter(is_of).filter_map(half).fold(0.0, f64::max);
        self.error_ms = bound;
        let Some(from) = from else {
            self.unknown.push("the way to this flow".to_owned());
            return;
        };
        let is_sender = |bridge: &&Bridge| {
            bridge.topic == topic
                && bridge.to.scope == INTER
                && bridge.to.flow.as_ref() == Some(&here.flow)
        };
        let sender = flows.iter().find(|figures| figures.flow == *from);
        let sent = sender.and_then(|figures| figures.bridges.iter().find(is_sender));
        let time = sent.and_then(|bridge| bridge.latency_ms).and_then(Quantiles::both);
        self.add(format!("flow {from}"), time);
        let link = here.links.iter().find(|link| link.flow == *from).and_then(half);
        self.error_ms = link.unwrap_or(bound);
        self.add(format!("link {from}"), link.map(|half| (half, half)));
    }

    fn add(&mut self, place: String, time: Option<(f64, f64)>) {
        match time {
            Some((p50_ms, p99_ms)) => self.known.push(Hop { place, p50_ms, p99_ms }),
            None => self.unknown.push(place),
        }
    }

    /// The parts of a whole; the rest is the brokers'.
    pub(super) fn hops(&self, whole: Quantiles) -> Vec<Hop> {
        let Some((p50, p99)) = whole.both() else { return Vec::new() };
        let rest = |whole: f64, part: fn(&Hop) -> f64| {
            (whole - self.known.iter().map(part).sum::<f64>()).max(0.0)
        };
        let brokers = ["brokers"].into_iter().chain(self.unknown.iter().map(String::as_str));
        let rest = Hop {
            place: brokers.collect::<Vec<_>>().join(" and "),
            p50_ms: rest(p50, |hop| hop.p50_ms),
            p99_ms: rest(p99, |hop| hop.p99_ms),
        };
        let hops = self.known.iter().cloned().chain([rest]);
        hops.map(|hop| Hop { p50_ms: rounded(hop.p50_ms), p99_ms: rounded(hop.p99_ms), ..hop })
            .collect()
    }
}

/// To the microsecond.
pub(super) fn rounded(ms: f64) -> f64 {
    (ms * 1e3).round() / 1e3
}
