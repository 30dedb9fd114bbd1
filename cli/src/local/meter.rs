//! Latency of messages as they arrive: by the clocks where their offset is known well enough, else
//! by the age that flows have added up. Pure; the rules are those of the monitor.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use blaze_domain::FlowId;
use serde_json::{Value, json};

/// Last values of a node that quantiles are made from.
const WINDOW: usize = 1_000;
/// Publishing nodes with figures of their own; messages of further ones are counted.
const MAX_NODES: usize = 256;
/// Samples that wait to be written, about a second of the fastest topics; the rest is counted.
const MAX_SAMPLES: usize = 100_000;
/// Error in ms below which a clock is good enough whatever the latency is.
const GOOD_ERROR_MS: f64 = 1.0;
/// Part of the latency that the error may be beyond that.
const ERROR_PART: f64 = 0.5;

/// What is known of another node.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Peer {
    /// Its clock minus ours, and the bound of the error, in ms.
    pub(super) clock_ms: Option<(f64, f64)>,
    /// Time on one way in ms: half a round trip, the bound of the error of an age.
    pub(super) way_ms: Option<f64>,
}

/// A message as it arrived.
#[derive(Debug, Clone)]
pub(super) struct Arrival {
    /// Node that published it.
    pub(super) from: FlowId,
    /// Its number, per writer; 0 where there is none.
    pub(super) sequence: u64,
    /// When it was published by the clock of `from`, in ns since 1970.
    pub(super) published_ns: Option<i64>,
    /// When it was received by our clock, in ns since 1970.
    pub(super) received_ns: i64,
    /// Its age; `None` where no flow wrote one.
    pub(super) age: Option<Duration>,
}

/// How a latency was measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Method {
    Clock,
    Age,
}

impl Method {
    /// The word in answers and files.
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Clock => "clock",
            Self::Age => "age",
        }
    }
}

/// A latency, and the bound of its error where there is one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Measured {
    pub(super) latency_ms: f64,
    pub(super) error_ms: Option<f64>,
    pub(super) method: Method,
}

/// A raw sample; `None`: the latency is unknown.
#[derive(Debug, Clone)]
pub(super) struct Sample {
    pub(super) received_ns: i64,
    pub(super) from: FlowId,
    pub(super) sequence: u64,
    pub(super) measured: Option<Measured>,
}

/// Figures of one publishing node.
#[derive(Debug, Default)]
struct Figures {
    messages: u64,
    unknown: u64,
    /// Last values in ms, oldest first.
    values: VecDeque<f64>,
    last: Option<Measured>,
}

/// Measures messages of one topic.
#[derive(Debug)]
pub(super) struct Meter {
    own: FlowId,
    peers: BTreeMap<FlowId, Peer>,
    nodes: BTreeMap<FlowId, Figures>,
    /// Only where they are wanted.
    samples: Option<Vec<Sample>>,
    dropped_samples: u64,
    of_further_nodes: u64,
}

impl Meter {
    /// A meter on a node; with `keeps_samples` they wait for [`Self::take_samples`].
    pub(super) fn new(own: FlowId, keeps_samples: bool) -> Self {
        Self {
            own,
            peers: BTreeMap::new(),
            nodes: BTreeMap::new(),
            samples: keeps_samples.then(Vec::new),
            dropped_samples: 0,
            of_further_nodes: 0,
        }
    }

    /// Replaces what is known of other nodes.
    pub(super) fn set_peers(&mut self, peers: BTreeMap<FlowId, Peer>) {
        self.peers = peers;
    }

    /// Measures a message.
    pub(super) fn take(&mut self, arrival: Arrival) {
        let peer = match arrival.from == self.own {
            true => Peer { clock_ms: Some((0.0, 0.0)), way_ms: Some(0.0) },
            false => self.peers.get(&arrival.from).copied().unwrap_or_default(),
        };
        let measured = by_clock(&arrival, &peer).unwrap_or_else(|WrongOffset| {
            self.peers.entry(arrival.from.clone()).and_modify(|peer| peer.clock_ms = None);
            None
        });
        let measured = measured.or_else(|| by_age(&arrival, &peer));
        let has_room = self.nodes.len() < MAX_NODES || self.nodes.contains_key(&arrival.from);
        match has_room {
            true => self.nodes.entry(arrival.from.clone()).or_default().take(measured),
            false => self.of_further_nodes += 1,
        }
        let Some(samples) = &mut self.samples else { return };
        if samples.len() >= MAX_SAMPLES {
            self.dropped_samples += 1;
            return;
        }
        let Arrival { from, sequence, received_ns, .. } = arrival;
        samples.push(Sample { received_ns, from, sequence, measured });
    }

    /// The samples since the last call.
    pub(super) fn take_samples(&mut self) -> Vec<Sample> {
        self.samples.as_mut().map(std::mem::take).unwrap_or_default()
    }

    /// Samples that had no room.
    pub(super) fn dropped_samples(&self) -> u64 {
        self.dropped_samples
    }

    /// Rows of the form of `/v1/latency`, and messages of nodes that have none.
    pub(super) fn rows(&self, topic: &str) -> (Vec<Value>, u64) {
        let rows = self.nodes.iter().map(|(from, figures)| figures.row(topic, from));
        (rows.collect(), self.of_further_nodes)
    }
}

impl Figures {
    fn take(&mut self, measured: Option<Measured>) {
        self.messages += 1;
        let Some(measured) = measured else {
            self.unknown += 1;
            return;
        };
        if self.values.len() == WINDOW {
            self.values.pop_front();
        }
        self.values.push_back(measured.latency_ms);
        self.last = Some(measured);
    }

    fn row(&self, topic: &str, from: &FlowId) -> Value {
        let mut values: Vec<f64> = self.values.iter().copied().collect();
        values.sort_unstable_by(f64::total_cmp);
        json!({
            "topic": topic, "from": from, "observe": "subscribe", "stamp": "publish",
            "method": self.last.map(|last| last.method.as_str()), "messages": self.messages,
            "latency_ms": {"p50": quantile(&values, 0.5), "p99": quantile(&values, 0.99)},
            "error_ms": self.last.and_then(|last| last.error_ms).map(rounded),
            "unknown": self.unknown,
        })
    }
}

/// The smallest value that is not below this part of all; they are sorted.
fn quantile(values: &[f64], part: f64) -> Option<f64> {
    let rank = (part * values.len() as f64).ceil() as usize;
    values.get(rank.saturating_sub(1)).copied().map(rounded)
}

fn rounded(ms: f64) -> f64 {
    (ms * 1e3).round() / 1e3
}

/// A message came before it was sent by more than the offset's error.
struct WrongOffset;

fn by_clock(arrival: &Arrival, peer: &Peer) -> Result<Option<Measured>, WrongOffset> {
    let (Some(published_ns), Some((offset_ms, error_ms))) = (arrival.published_ns, peer.clock_ms)
    else {
        return Ok(None);
    };
    let difference = i128::from(arrival.received_ns) - i128::from(published_ns);
    let latency_ms = difference as f64 / 1e6 + offset_ms;
    if latency_ms < -error_ms {
        return Err(WrongOffset);
    }
    let latency_ms = latency_ms.max(0.0);
    let is_good = error_ms <= GOOD_ERROR_MS.max(ERROR_PART * latency_ms);
    let measured = Measured { latency_ms, error_ms: Some(error_ms), method: Method::Clock };
    Ok(is_good.then_some(measured))
}

fn by_age(arrival: &Arrival, peer: &Peer) -> Option<Measured> {
    let latency_ms = arrival.age?.as_secs_f64() * 1e3;
    Some(Measured { latency_ms, error_ms: peer.way_ms, method: Method::Age })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(name: &str) -> FlowId {
        name.parse().unwrap()
    }

    /// Published at 1 s by its clock, received so many ms later by ours.
    fn arrival(from: &str, after_ms: f64, age_ms: Option<u64>) -> Arrival {
        Arrival {
            from: node(from),
            sequence: 7,
            published_ns: Some(1_000_000_000),
            received_ns: 1_000_000_000 + (after_ms * 1e6) as i64,
            age: age_ms.map(Duration::from_millis),
        }
    }

    fn meter(clock_ms: Option<(f64, f64)>) -> Meter {
        let mut meter = Meter::new(node("edge/robot-1"), true);
        let peer = Peer { clock_ms, way_ms: Some(4.0) };
        meter.set_peers([(node("fog/fog-1"), peer)].into());
        meter
    }

    fn measured(meter: &mut Meter, arrival: Arrival) -> Option<Measured> {
        meter.take(arrival);
        meter.take_samples().pop().unwrap().measured
    }

    fn found(latency_ms: f64, error_ms: Option<f64>, method: Method) -> Option<Measured> {
        Some(Measured { latency_ms, error_ms, method })
    }

    #[test]
    fn a_good_clock_counts_and_a_bad_one_gives_way_to_the_age() {
        // Their clock is 3 s ahead: the message seems to come 2.98 s before it was sent.
        let early = || arrival("fog/fog-1", -2_980.0, Some(25));
        let by_clock = measured(&mut meter(Some((3_000.0, 0.5))), early());
        assert_eq!(by_clock, found(20.0, Some(0.5), Method::Clock));
        // Half of the value is the most.
        let at_half = measured(&mut meter(Some((3_000.0, 10.0))), early());
        assert_eq!(at_half, found(20.0, Some(10.0), Method::Clock));
        let by_age = found(25.0, Some(4.0), Method::Age);
        assert_eq!(measured(&mut meter(Some((3_000.0, 10.1))), early()), by_age);
        assert_eq!(measured(&mut meter(None), early()), by_age);
        assert_eq!(measured(&mut meter(None), arrival("fog/fog-1", 5.0, None)), None);
    }

    #[test]
    fn nothing_is_negative_and_a_wrong_offset_is_dropped() {
        let mut meter = meter(Some((0.0, 0.5)));
        let within = measured(&mut meter, arrival("fog/fog-1", -0.4, None));
        assert_eq!(within, found(0.0, Some(0.5), Method::Clock));
        assert_eq!(measured(&mut meter, arrival("fog/fog-1", -0.6, None)), None);
        // The offset is gone until the monitor has one again.
        assert_eq!(measured(&mut meter, arrival("fog/fog-1", 0.6, None)), None);
    }

    #[test]
    fn this_node_needs_no_monitor_and_an_unknown_one_has_no_error() {
        let mut meter = meter(None);
        let own = measured(&mut meter, arrival("edge/robot-1", 1.5, None));
        assert_eq!(own, found(1.5, Some(0.0), Method::Clock));
        let other = measured(&mut meter, arrival("cloud/cloud-1", 1.5, Some(9)));
        assert_eq!(other, found(9.0, None, Method::Age));
    }

    #[test]
    fn rows_have_the_form_of_the_monitors() {
        let mut meter = meter(Some((0.0, 0.1)));
        for after_ms in 1..=100 {
            meter.take(arrival("fog/fog-1", f64::from(after_ms), None));
        }
        meter.take(arrival("edge/robot-2", 3.0, None));
        let (rows, of_further_nodes) = meter.rows("imu/data");
        assert_eq!(of_further_nodes, 0);
        assert_eq!(
            rows[1],
            json!({"topic": "imu/data", "from": "fog/fog-1", "observe": "subscribe",
                "stamp": "publish", "method": "clock", "messages": 100,
                "latency_ms": {"p50": 50.0, "p99": 99.0}, "error_ms": 0.1, "unknown": 0})
        );
        assert_eq!((&rows[0]["unknown"], &rows[0]["method"]), (&json!(1), &Value::Null));
    }

    #[test]
    fn nodes_and_samples_are_bounded_and_counted() {
        let mut meter = Meter::new(node("edge/robot-1"), true);
        for count in 0..MAX_NODES + 2 {
            meter.take(arrival(&format!("edge/n-{count}"), 1.0, None));
        }
        let (rows, of_further_nodes) = meter.rows("a");
        assert_eq!((rows.len(), of_further_nodes), (MAX_NODES, 2));
        for _ in 0..MAX_SAMPLES {
            meter.take(arrival("edge/n-1", 1.0, None));
        }
        assert_eq!(meter.dropped_samples(), MAX_NODES as u64 + 2);
        assert_eq!(meter.take_samples().len(), MAX_SAMPLES);
    }
}
