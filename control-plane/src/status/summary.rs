//! One summary of a node: the text as it came, the few values that every evaluation needs, and the
//! rest, which is read when somebody asks for it.
//!
//! ```text
//! text ─▶ Head     state, ready flows, sums: at arrival, one pass that keeps no names
//!      ├▶ seen_up  hashes of flows whose link is up: when some node is late
//!      └▶ Detail   problems, services, links: when somebody looks
//! ```

use std::fmt;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::OnceLock;

use blaze_domain::LayerName;
use serde::Deserialize;
use serde::de::{Deserializer, IgnoredAny, MapAccess, Visitor};

use super::detail::Detail;
use super::health::{Health, Now};
use super::limits::MAX_FLOWS;

/// A summary, and when it came.
#[derive(Debug)]
pub struct Report {
    text: Box<str>,
    /// When it came.
    pub arrived: Now,
    /// What is looked at of every summary.
    pub head: Head,
    seen_up: OnceLock<Box<[u64]>>,
    detail: OnceLock<Detail>,
}

/// What is looked at of every summary.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Head {
    /// State of the node, as its monitor says.
    pub state: Health,
    /// CPU in use, 0 to 1.
    pub cpu_ratio: Option<f64>,
    /// Memory in use, 0 to 1.
    pub memory_ratio: Option<f64>,
    /// The hottest sensor.
    pub celsius: Option<f64>,
    /// Flows that answered.
    pub flows: usize,
    /// Those of them that are ready.
    pub ready_flows: usize,
    /// Topics that the flows know.
    pub topics: u64,
    /// Messages since the flows started.
    pub sums: Sums,
}

/// Messages since the flows started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Sums {
    /// Taken in.
    pub taken: u64,
    /// Given out.
    pub given: u64,
    /// Dropped.
    pub dropped: u64,
}

/// A summary that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the summary cannot be read: {0}")]
pub struct BadSummary(String);

impl Report {
    /// Reads what every evaluation needs.
    ///
    /// # Errors
    /// If it is no summary.
    pub fn read(text: String, arrived: Now) -> Result<Self, BadSummary> {
        let read: QuickText<'_> =
            serde_json::from_str(&text).map_err(|error| BadSummary(error.to_string()))?;
        let head = read.head();
        Ok(Self {
            text: text.into_boxed_str(),
            arrived,
            head,
            seen_up: OnceLock::new(),
            detail: OnceLock::new(),
        })
    }

    /// The text, as it came.
    #[must_use]
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Flows to which a flow of this node has a link that is up, as [`flow_hash`].
    pub fn seen_up(&self) -> &[u64] {
        self.seen_up.get_or_init(|| {
            let links: LinksText<'_> = serde_json::from_str(&self.text).unwrap_or_default();
            let links = links.flows.into_iter().flatten().flat_map(|flow| flow.links);
            links.filter(|link| link.state == "up").map(|link| flow_hash(&link.flow)).collect()
        })
    }

    /// Problems, services and links; `layer` is that of the node: flows of others are not its
    /// matter.
    pub fn detail(&self, layer: &LayerName) -> &Detail {
        self.detail.get_or_init(|| Detail::read(&self.text, layer))
    }

    /// What was read for somebody who looked.
    #[must_use]
    pub fn known_detail(&self) -> Option<&Detail> {
        self.detail.get()
    }
}

/// A flow's name as it is compared.
#[must_use]
pub fn flow_hash(flow: &str) -> u64 {
    let mut hasher = DefaultHasher::new();
    flow.hash(&mut hasher);
    hasher.finish()
}

// --- what is read at arrival ---

#[derive(Deserialize)]
struct QuickText<'a> {
    #[serde(borrow)]
    health: StateText<'a>,
    #[serde(default)]
    node: Option<NodeText>,
    #[serde(default)]
    flows: Vec<Option<FlowText<'a>>>,
}

#[derive(Deserialize)]
struct StateText<'a> {
    #[serde(borrow)]
    state: std::borrow::Cow<'a, str>,
}

#[derive(Deserialize, Default)]
struct NodeText {
    cpu_ratio: Option<f64>,
    memory_ratio: Option<f64>,
    celsius: Option<f64>,
}

#[derive(Deserialize)]
struct FlowText<'a> {
    #[serde(borrow, default)]
    state: Option<std::borrow::Cow<'a, str>>,
    #[serde(default)]
    topics: Sum,
    #[serde(default, rename = "in")]
    taken: Option<MessagesText>,
    #[serde(default, rename = "out")]
    given: Option<MessagesText>,
    #[serde(default)]
    dropped: Sum,
}

#[derive(Deserialize)]
struct MessagesText {
    #[serde(default)]
    messages: u64,
}

/// The sum of an object's numbers; its names are not kept.
#[derive(Default)]
struct Sum(u64);

impl<'de> Deserialize<'de> for Sum {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct OfMap;
        impl<'de> Visitor<'de> for OfMap {
            type Value = Sum;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object of counts")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Sum, A::Error> {
                let mut sum = 0_u64;
                while let Some((_, count)) = map.next_entry::<IgnoredAny, u64>()? {
                    sum = sum.saturating_add(count);
                }
                Ok(Sum(sum))
            }
            fn visit_unit<E>(self) -> Result<Sum, E> {
                Ok(Sum(0))
            }
        }
        deserializer.deserialize_any(OfMap)
    }
}

impl QuickText<'_> {
    fn head(&self) -> Head {
        let node = self.node.as_ref();
        let mut head = Head {
            state: Health::of_word(&self.health.state),
            cpu_ratio: node.and_then(|node| node.cpu_ratio),
            memory_ratio: node.and_then(|node| node.memory_ratio),
            celsius: node.and_then(|node| node.celsius),
            ..Head::default()
        };
        for flow in self.flows.iter().flatten().take(MAX_FLOWS) {
            head.flows += 1;
            head.ready_flows += usize::from(flow.state.as_deref() == Some("ready"));
            head.topics = head.topics.saturating_add(flow.topics.0);
            let messages = |part: &Option<MessagesText>| part.as_ref().map_or(0, |p| p.messages);
            let sums = &mut head.sums;
            sums.taken = sums.taken.saturating_add(messages(&flow.taken));
            sums.given = sums.given.saturating_add(messages(&flow.given));
            sums.dropped = sums.dropped.saturating_add(flow.dropped.0);
        }
        head
    }
}

// --- what is read when a node is late ---

#[derive(Deserialize, Default)]
struct LinksText<'a> {
    #[serde(borrow, default)]
    flows: Vec<Option<LinksOfFlow<'a>>>,
}

#[derive(Deserialize)]
struct LinksOfFlow<'a> {
    #[serde(borrow, default)]
    links: Vec<LinkState<'a>>,
}

#[derive(Deserialize)]
struct LinkState<'a> {
    #[serde(borrow)]
    flow: std::borrow::Cow<'a, str>,
    #[serde(borrow)]
    state: std::borrow::Cow<'a, str>,
}
