//! `flow`: bandwidth, compression and rules of topics.

use std::collections::BTreeMap;

use super::readers::{boolean, number, parsed, whole};
use super::walk::{Node, Section, from_empty};
use super::{AccessRules, AutoBool, MAX_BYTES, TopicPattern, auto_bool};
use crate::names::{LayerName, TopicName};
use crate::qos::{Priority, word_enum};

/// What one Mbit/s of the file is, in bytes per second: 1024² bit.
const BYTES_PER_MBIT: f64 = 1024.0 * 1024.0 / 8.0;
/// 64 KiB: unless the file says otherwise, a topic with payloads above it is large, and a payload
/// worth compressing.
pub const LARGE_BYTES: u32 = 65_536;
/// Longest lifespan: a day.
const MAX_LIFESPAN_MS: u32 = 86_400_000;
const MAX_MBPS: f64 = 1_000_000.0;

/// Everything that BlazeFlow reads besides its brokers; reloads while it runs.
#[derive(Debug, Clone, PartialEq)]
pub struct FlowSection {
    /// What the inter scope may carry.
    pub bandwidth: BandwidthSection,
    /// How payloads are compressed for the inter scope.
    pub compression: Compression,
    /// Rules of topics; see [`FlowSection::topic`].
    pub topics: Vec<TopicRule>,
    /// Who may advertise and request what.
    pub access: AccessRules,
    /// Threads for compression; 0: cores of the control group.
    pub pool_threads: u16,
    /// Whether this flow joins the inter scope for the others of a large layer.
    pub gateway: AutoBool,
}

impl Default for FlowSection {
    fn default() -> Self {
        from_empty(Self::section)
    }
}

impl FlowSection {
    pub(super) fn section(s: &mut Section<'_>) -> Self {
        Self {
            bandwidth: s.sub_or_empty("bandwidth", BandwidthSection::section),
            compression: s.sub_or_empty("compression", Compression::section),
            topics: s.list("topics", |node| node.section(TopicRule::section).flatten()),
            access: AccessRules::read(s),
            pool_threads: s.or("pool_threads", whole(0, 1024), 0),
            gateway: s.or("gateway", auto_bool, AutoBool::Auto),
        }
    }

    /// What the rules say of one topic: each value is that of the first matching rule that gives
    /// it.
    #[must_use]
    pub fn topic(&self, topic: &TopicName) -> TopicSettings {
        let values = TopicValues::of(&self.topics, topic);
        TopicSettings {
            priority: values.priority,
            max_rate_hz: values.max_rate_hz,
            lifespan_ms: values.lifespan_ms,
            compression: self.compression.with(values.compression),
        }
    }
}

/// `flow.bandwidth`.
#[derive(Debug, Clone, PartialEq)]
pub struct BandwidthSection {
    /// Budget of the inter scope in Mbit/s of 1024² bit; see
    /// [`BandwidthSection::limit_bytes_per_s`].
    pub limit_mbps: f64,
    /// β: what one topic may take of the budget, 0 to 1.
    pub per_message_share: f64,
    /// α: what a message grows by on the way, at least 1.
    pub overhead: f64,
    /// Rate below which no large topic is thinned, in Hz.
    pub min_rate_hz: f64,
    /// A topic with larger payloads is large.
    pub large_bytes: u32,
    /// How the budget is divided.
    pub share: SharePolicy,
    /// Whether the wire factor is measured.
    pub wire_overhead: WireOverhead,
    /// Whether the budget follows what the link really carries.
    pub adaptive: bool,
    /// Seconds, one to two times, after which the largest size of a topic is forgotten; 0: never.
    pub size_window_s: u32,
    /// Budgets per destination layer, besides the one of all.
    pub links: BTreeMap<LayerName, LinkLimit>,
}

impl Default for BandwidthSection {
    fn default() -> Self {
        from_empty(Self::section)
    }
}

impl BandwidthSection {
    pub(super) fn section(s: &mut Section<'_>) -> Self {
        Self {
            limit_mbps: s.or("limit_mbps", number(0.001, MAX_MBPS), 160.0),
            per_message_share: s.or("per_message_share", number(0.01, 1.0), 0.95),
            overhead: s.or("overhead", number(1.0, 10.0), 1.02),
            min_rate_hz: s.or("min_rate_hz", number(0.0, 1000.0), 2.0),
            large_bytes: s.or("large_bytes", whole(1, MAX_BYTES), LARGE_BYTES),
            share: s.or("share", parsed, SharePolicy::Paper),
            wire_overhead: s.or("wire_overhead", parsed, WireOverhead::Measured),
            adaptive: s.or("adaptive", boolean, true),
            size_window_s: s.or("size_window_s", whole(0, 86_400), 0),
            links: s.opt("links", links).unwrap_or_default(),
        }
    }

    /// The budget of all links together, in bytes per second (`docs/design/bandwidth.md`).
    #[must_use]
    pub fn limit_bytes_per_s(&self) -> f64 {
        self.limit_mbps * BYTES_PER_MBIT
    }

    /// The budget of the link to one layer, in bytes per second, if it has one of its own.
    #[must_use]
    pub fn link_limit_bytes_per_s(&self, layer: &LayerName) -> Option<f64> {
        self.links.get(layer).map(|link| link.limit_mbps * BYTES_PER_MBIT)
    }
}

/// Budget of the link to one layer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinkLimit {
    /// In Mbit/s of 1024² bit.
    pub limit_mbps: f64,
}

fn links(node: &Node<'_>) -> Option<BTreeMap<LayerName, LinkLimit>> {
    let read = |(key, node): (&str, Node<'_>)| {
        let layer = match key.parse::<LayerName>() {
            Ok(layer) => Some(layer),
            Err(error) => node.fault(format!("the name of a layer {error}")),
        };
        let limit = node.section(|s| s.need("limit_mbps", number(0.001, MAX_MBPS))).flatten();
        Some((layer?, LinkLimit { limit_mbps: limit? }))
    };
    Some(node.entries().into_iter().filter_map(read).collect())
}

word_enum!(
    /// How the budget is divided among large topics.
    SharePolicy {
        /// Largest demand first (the original algorithm).
        Paper = "paper",
        /// By max-min fairness in bytes per second.
        Fair = "fair",
    }
);

word_enum!(
    /// Whether the allocation counts what the wire adds.
    WireOverhead {
        /// By the measured factor.
        Measured = "measured",
        /// Not at all.
        Off = "off",
    }
);

word_enum!(
    /// How payloads are compressed.
    Codec {
        /// LZ4 blocks.
        Lz4 = "lz4",
        /// Not at all.
        None = "none",
    }
);

/// How payloads are compressed for the inter scope.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Compression {
    /// Which codec.
    pub codec: Codec,
    /// 1–2 LZ4 fast, 3–12 high compression.
    pub level: u8,
    /// Smaller payloads go as they are.
    pub min_bytes: u32,
    /// Whether a lower level is taken while the pool cannot keep up at this one.
    pub adaptive: bool,
}

impl Default for Compression {
    fn default() -> Self {
        from_empty(Self::section)
    }
}

impl Compression {
    const DEFAULT: Self =
        Self { codec: Codec::Lz4, level: 10, min_bytes: LARGE_BYTES, adaptive: true };

    fn section(s: &mut Section<'_>) -> Self {
        Self::DEFAULT.with(CompressionOverride::section(s))
    }

    /// This with what `change` gives.
    #[must_use]
    pub fn with(self, change: CompressionOverride) -> Self {
        Self {
            codec: change.codec.unwrap_or(self.codec),
            level: change.level.unwrap_or(self.level),
            min_bytes: change.min_bytes.unwrap_or(self.min_bytes),
            adaptive: change.adaptive.unwrap_or(self.adaptive),
        }
    }
}

/// Parts of [`Compression`] that a rule changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CompressionOverride {
    /// Which codec.
    pub codec: Option<Codec>,
    /// 1–2 LZ4 fast, 3–12 high compression.
    pub level: Option<u8>,
    /// Smaller payloads go as they are.
    pub min_bytes: Option<u32>,
    /// Whether a lower level is taken while the pool cannot keep up.
    pub adaptive: Option<bool>,
}

impl CompressionOverride {
    fn section(s: &mut Section<'_>) -> Self {
        Self {
            codec: s.opt("codec", parsed),
            level: s.opt("level", whole(1, 12)),
            min_bytes: s.opt("min_bytes", whole(0, MAX_BYTES)),
            adaptive: s.opt("adaptive", boolean),
        }
    }

    fn or(self, other: Self) -> Self {
        Self {
            codec: self.codec.or(other.codec),
            level: self.level.or(other.level),
            min_bytes: self.min_bytes.or(other.min_bytes),
            adaptive: self.adaptive.or(other.adaptive),
        }
    }
}

/// One rule: what it says of the topics that fit its pattern.
#[derive(Debug, Clone, PartialEq)]
pub struct TopicRule {
    /// `match`: which topics.
    pub pattern: TopicPattern,
    /// What it says.
    pub values: TopicValues,
}

/// The values that rules may give; what is absent is left to the next rule that matches, in the end
/// to the defaults.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TopicValues {
    /// Class on the inter scope.
    pub priority: Option<Priority>,
    /// Rate on the inter scope, at most, in Hz.
    pub max_rate_hz: Option<f64>,
    /// Age above which a message is dropped, in ms; 0: none.
    pub lifespan_ms: Option<u32>,
    /// Compression of these topics.
    pub compression: CompressionOverride,
}

impl TopicValues {
    /// What rules say of a topic: each value is that of the first matching rule that gives it.
    #[must_use]
    pub fn of(rules: &[TopicRule], topic: &TopicName) -> Self {
        rules
            .iter()
            .filter(|rule| rule.pattern.matches(topic))
            .fold(Self::default(), |given, rule| given.or(rule.values))
    }

    fn or(self, other: Self) -> Self {
        Self {
            priority: self.priority.or(other.priority),
            max_rate_hz: self.max_rate_hz.or(other.max_rate_hz),
            lifespan_ms: self.lifespan_ms.or(other.lifespan_ms),
            compression: self.compression.or(other.compression),
        }
    }
}

impl TopicRule {
    fn section(s: &mut Section<'_>) -> Option<Self> {
        let pattern = s.need("match", parsed);
        let values = TopicValues {
            priority: s.opt("priority", parsed),
            max_rate_hz: s.opt("max_rate_hz", number(0.001, 1_000_000.0)),
            lifespan_ms: s.opt("lifespan_ms", whole(0, MAX_LIFESPAN_MS)),
            compression: s.sub_or_empty("compression", CompressionOverride::section),
        };
        Some(Self { pattern: pattern?, values })
    }
}

/// What all rules together say of one topic.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TopicSettings {
    /// Class on the inter scope, if a rule gives one.
    pub priority: Option<Priority>,
    /// Highest rate on the inter scope in Hz, if a rule gives one.
    pub max_rate_hz: Option<f64>,
    /// Age above which a message is dropped in ms, if a rule gives one; 0: none.
    pub lifespan_ms: Option<u32>,
    /// How its payloads are compressed.
    pub compression: Compression,
}
