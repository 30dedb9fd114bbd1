//! The latency of one message: by clocks where they are good enough, else by its age.

use blaze_domain::node_file::Stamp;
use blaze_domain::{FlowId, TopicName, WriterId};
use serde::Serialize;

use super::limits::{ERROR_PART, GOOD_ERROR_S, MAX_LATENCY_S};

/// How a latency was measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Reception − stamp + offset of the clocks.
    Clock,
    /// The age that flows have added up.
    Age,
}

impl Method {
    /// The word in answers and labels.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Clock => "clock",
            Self::Age => "age",
        }
    }
}

/// Another clock against ours.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Offset {
    /// Theirs minus ours, in seconds.
    pub offset_s: f64,
    /// Bound of its error, in seconds.
    pub error_s: f64,
}

/// A message as a subscriber received it.
#[derive(Debug, Clone)]
pub struct Message<'a> {
    /// Its topic.
    pub topic: &'a TopicName,
    /// Node that published it.
    pub from: &'a FlowId,
    /// Its writer.
    pub writer: WriterId,
    /// Its number, per writer.
    pub sequence: u64,
    /// When it counts from by the clock of `from`, in ns since 1970: its publishing, or the stamp
    /// of its header.
    pub stamp_ns: Option<i64>,
    /// When it was published by the clock of `from`, in ns since 1970.
    pub published_ns: Option<i64>,
    /// When it was received by our clock, in ns since 1970.
    pub received_ns: i64,
    /// Its age when it was received, in ns; `None` where no flow wrote one.
    pub age_ns: Option<u64>,
    /// Clock of `from` against ours; 0 ± 0 on one node.
    pub offset: Option<Offset>,
}

/// A latency.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// In seconds; never negative.
    pub latency_s: f64,
    /// Bound of its error, in seconds.
    pub error_s: f64,
    /// How it was measured.
    pub method: Method,
}

/// What became of a message.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Outcome {
    /// Its latency; `None`: unknown, and counted as such.
    pub measured: Option<Measured>,
    /// The offset cannot be right, because the message came before it was sent by more than its
    /// error: drop it and measure anew.
    pub drop_offset: bool,
}

/// Measures one message. `age_error_s`: half the round trips on its way.
pub(super) fn measure(message: &Message<'_>, stamp: Stamp, age_error_s: f64) -> Outcome {
    let by_clock = by_clock(message);
    let measured = by_clock.unwrap_or(None).or_else(|| {
        let latency_s = by_age(message, stamp)?;
        Some(Measured { latency_s, error_s: age_error_s, method: Method::Age })
    });
    Outcome { measured, drop_offset: by_clock.is_err() }
}

/// A message came before it was sent by more than the offset's error.
#[derive(Clone, Copy)]
struct WrongOffset;

fn by_clock(message: &Message<'_>) -> Result<Option<Measured>, WrongOffset> {
    let (Some(stamp_ns), Some(Offset { offset_s, error_s })) = (message.stamp_ns, message.offset)
    else {
        return Ok(None);
    };
    let latency_s = seconds(message.received_ns, stamp_ns) + offset_s;
    if !latency_s.is_finite() || !error_s.is_finite() || error_s < 0.0 {
        return Ok(None);
    }
    if latency_s < -error_s {
        return Err(WrongOffset);
    }
    let latency_s = latency_s.max(0.0);
    let is_good = error_s <= GOOD_ERROR_S.max(ERROR_PART * latency_s);
    let measured = Measured { latency_s, error_s, method: Method::Clock };
    Ok((is_good && latency_s <= MAX_LATENCY_S).then_some(measured))
}

/// The age counts from publishing; from there to the stamp of the header it is one clock's
/// difference.
fn by_age(message: &Message<'_>, stamp: Stamp) -> Option<f64> {
    let age_s = message.age_ns? as f64 / 1e9;
    let latency_s = match stamp {
        Stamp::Publish => age_s,
        Stamp::Header => age_s + seconds(message.published_ns?, message.stamp_ns?),
    };
    (0.0..=MAX_LATENCY_S).contains(&latency_s).then_some(latency_s)
}

fn seconds(later_ns: i64, earlier_ns: i64) -> f64 {
    (i128::from(later_ns) - i128::from(earlier_ns)) as f64 / 1e9
}
