//! BlazeMonitoring in the main service: the newest state of every node, outside the revision, and
//! what follows from all of them together.
//!
//! ```text
//! monitor ─▶ api::grpc::monitors ─▶ Hub ─┬▶ Fleet       newest summary of each node, states by age
//!    ▲           Interest, Query         └▶ Questions   to one node: few at once, answers shared
//!    └──────────────────────────────────────┘
//! REST ─▶ core::service::{fleet, live, asked} ─▶ picture, topics, why ─▶ Hub
//! ```
//!
//! `Fleet`, `Questions` and what makes pictures of them have no clock and do no I/O. A summary that
//! nobody looks at is kept as text, and a few values of it are read.

pub mod detail;
pub mod fleet;
pub mod health;
mod hub;
pub mod layer;
pub mod limits;
mod metrics;
pub mod patch;
pub mod picture;
pub mod questions;
pub mod summary;
pub mod topics;
pub mod why;

pub(crate) use hub::now;
pub use hub::{Failed, Hub, MonitorHello, Session, ToMonitor};
pub use metrics::StatusMetrics;

/// Why something of a monitor is not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// Its token is of another role or layer.
    Permission,
    /// Its node is not one of its layer in the configuration.
    UnknownNode,
    /// Its Hello makes no sense, or does not come first.
    BadHello,
    /// A newer monitor of the node reports.
    OlderEpoch,
    /// There are too many nodes.
    TooManyNodes,
    /// Too many streams of the subject have not said Hello yet.
    TooManyStreams,
    /// A message is too large.
    MessageTooLarge,
    /// A summary is too large.
    SummaryTooLarge,
    /// A summary is none.
    BadSummary,
    /// An answer that nobody waits for.
    UnknownAnswer,
}

impl Refusal {
    /// All of them.
    pub const ALL: &'static [Self] = &[
        Self::Permission,
        Self::UnknownNode,
        Self::BadHello,
        Self::OlderEpoch,
        Self::TooManyNodes,
        Self::TooManyStreams,
        Self::MessageTooLarge,
        Self::SummaryTooLarge,
        Self::BadSummary,
        Self::UnknownAnswer,
    ];

    /// Label of the metric.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Permission => "permission",
            Self::UnknownNode => "unknown_node",
            Self::BadHello => "bad_hello",
            Self::OlderEpoch => "older_epoch",
            Self::TooManyNodes => "too_many_nodes",
            Self::TooManyStreams => "too_many_streams",
            Self::MessageTooLarge => "message_too_large",
            Self::SummaryTooLarge => "summary_too_large",
            Self::BadSummary => "bad_summary",
            Self::UnknownAnswer => "unknown_answer",
        }
    }
}
