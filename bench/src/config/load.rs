//! What is asked of each server.

use super::clients::Way;
use super::figures::{Bar, Measured, Timing};
use super::subject::Subject;
use super::{closed, fan_out};

/// Documents of one `apply`: etcd takes 128 puts in a transaction, at most.
pub(crate) const APPLIED: usize = 100;

/// What each connection does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Work {
    /// Reads any document; sees every write that was acknowledged before.
    Get,
    /// Replaces any document, whatever its revision.
    Put,
    /// Replaces 100 documents in one revision.
    Apply,
}

/// A load.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Load {
    /// Connections that each do one thing after another, as fast as it is answered.
    Closed { work: Work, connections: usize },
    /// Changes at a rate, each told to all watchers.
    FanOut { watchers: usize, rate_hz: f64 },
}

impl Load {
    pub(crate) fn all(connections: &[usize], watchers: usize, rate_hz: f64) -> Vec<Self> {
        let each = |work| {
            let count = connections.iter();
            count.map(move |connections| Self::Closed { work, connections: *connections })
        };
        let closed = [Work::Get, Work::Put, Work::Apply].into_iter().flat_map(each);
        closed.chain([Self::FanOut { watchers, rate_hz }]).collect()
    }

    pub(crate) fn name(&self) -> String {
        match self {
            Self::Closed { work, connections } => match work {
                Work::Get => format!("get, {connections} conn"),
                Work::Put => format!("put, {connections} conn"),
                Work::Apply => format!("apply {APPLIED}, {connections} conn"),
            },
            Self::FanOut { watchers, rate_hz } => format!("watch, {watchers} at {rate_hz} Hz"),
        }
    }

    /// What BlazeConfig must reach, over gRPC, with this store.
    pub(crate) fn bar(&self, is_sqlite: bool) -> Option<Bar> {
        let of = |sqlite, mongodb| if is_sqlite { sqlite } else { mongodb };
        match self {
            Self::Closed { work: Work::Get, .. } => Some(Bar::AtLeast(1.8)),
            Self::Closed { work: Work::Put, .. } => Some(Bar::AtLeast(of(0.6, 0.3))),
            Self::Closed { work: Work::Apply, .. } => None,
            Self::FanOut { .. } => Some(Bar::AtMost(of(1.2, 2.0))),
        }
    }

    pub(crate) async fn run(
        &self,
        subject: &Subject,
        way: &Way,
        timing: &Timing,
    ) -> anyhow::Result<Measured> {
        match *self {
            Self::Closed { work, connections } => {
                closed::run(work, connections, subject, way, timing).await
            }
            Self::FanOut { watchers, rate_hz } => {
                fan_out::run(watchers, rate_hz, subject, way, timing).await
            }
        }
    }
}
