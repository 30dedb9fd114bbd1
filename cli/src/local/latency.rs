//! `blaze latency --subscribe`: the command measures each message of a topic, as a service on the
//! local broker.
//!
//! ```text
//! broker ─► message ─► meter ─► once a second: table, samples to a file
//! /v1/ping of the monitor ─► offsets of clocks ─┘
//! ```

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use blaze_domain::FlowId;
use blaze_domain::control::rfc3339_millis;
use blaze_sdk::{Message, Request, SubscribeOptions, Subscription};
use parking_lot::Mutex;
use serde::Deserialize as _;
use serde_json::{Value, json};
use tokio::time::{Instant, MissedTickBehavior, interval_at, timeout};

use super::LocalService;
use super::meter::{Arrival, Meter, Peer, Sample};
use crate::args::FlowAddress;
use crate::config::text::note;
use crate::ends::interrupted;
use crate::exit::{CliError, Exit};
use crate::monitor::{
    CsvFile, Latency, LatencyOptions, Matrix, PingRow, latency_table, matrix, millis,
};
use crate::output::{self, Format, terminal_width};

/// Between two figures, and two questions for the offsets of clocks.
const EVERY: Duration = Duration::from_secs(1);
/// A monitor on this machine answers within this time; figures do not wait for a longer one.
const OFFSETS_WITHIN: Duration = Duration::from_millis(500);
/// Columns of `--csv`.
const HEADING: [&str; 6] = ["time", "from", "sequence", "latency_ms", "error_ms", "method"];

/// Measures until it is interrupted, or `--count` times.
///
/// # Errors
/// [`CliError`]: no broker, no flow, a monitor of another node, a file that cannot be written.
pub(crate) async fn run(options: &LatencyOptions, format: Format) -> Result<Exit, CliError> {
    let file = options.target.node_file()?;
    let own = file
        .flow_id()
        .ok_or_else(|| CliError::Invalid("the node file names no layer and node".to_owned()))?;
    let csv = options.csv.as_deref().map(|path| CsvFile::create(path, &HEADING)).transpose()?;
    let mut offsets = Offsets { monitor: &options.monitor.monitor, own: &own, is_away: false };
    let meter = Arc::new(Mutex::new(Meter::new(own.clone(), csv.is_some())));
    offsets.refresh(&meter, format).await?;
    let service = LocalService::start(&file, "latency").await?;
    let look = Look { options, format, meter, csv };
    let outcome = look.run(&service, &mut offsets).await;
    service.end().await;
    outcome.map(|()| Exit::Done)
}

/// Offsets of other clocks, from the monitor of this node.
struct Offsets<'o> {
    monitor: &'o FlowAddress,
    own: &'o FlowId,
    is_away: bool,
}

impl Offsets<'_> {
    /// Asks the monitor. Without one the age of messages counts, and people are told.
    async fn refresh(&mut self, meter: &Mutex<Meter>, format: Format) -> Result<(), CliError> {
        let answer = timeout(OFFSETS_WITHIN, matrix(self.monitor)).await;
        let answer = answer
            .map_err(|_| "the monitor does not answer in time".to_owned())
            .and_then(|answer| answer.map_err(|error| error.to_string()));
        let matrix = match answer {
            Ok(matrix) => matrix,
            Err(reason) => {
                // Clocks drift: what was known holds no longer.
                meter.lock().set_peers(BTreeMap::new());
                self.away(&reason, format);
                return Ok(());
            }
        };
        self.is_away = false;
        if !self.own.is_written(&format!("{}/{}", matrix.layer, matrix.node)) {
            return Err(CliError::Usage(format!(
                "the monitor at {} is that of {}/{}, the node file is that of {}: their clocks are \
                 not the same.\n  Name the monitor of this node with --monitor, or its node file \
                 with --config.",
                self.monitor, matrix.layer, matrix.node, self.own
            )));
        }
        meter.lock().set_peers(peers(&matrix));
        Ok(())
    }

    fn away(&mut self, reason: &str, format: Format) {
        if !std::mem::replace(&mut self.is_away, true) {
            note(format, &format!("latencies are ages, without offsets of clocks: {reason}"));
        }
    }
}

fn peers(matrix: &Matrix) -> BTreeMap<FlowId, Peer> {
    let peer = |row: &PingRow| {
        let clock_ms = row.clock_offset_ms.zip(row.clock_error_ms);
        Some((row.name().parse().ok()?, Peer { clock_ms, way_ms: row.latency_ms.p50 }))
    };
    matrix.nodes.iter().filter_map(peer).collect()
}

struct Look<'o> {
    options: &'o LatencyOptions,
    format: Format,
    meter: Arc<Mutex<Meter>>,
    csv: Option<CsvFile>,
}

impl Look<'_> {
    async fn run(
        mut self,
        service: &LocalService,
        offsets: &mut Offsets<'_>,
    ) -> Result<(), CliError> {
        let topic = &self.options.target.topic;
        let (noted, own) = (Arc::clone(&self.meter), offsets.own.clone());
        let wanted = self.options.from.clone();
        let take = move |message: Message| {
            let arrival = arrival(&message, &own);
            if wanted.as_ref().is_none_or(|wanted| *wanted == arrival.from) {
                noted.lock().take(arrival);
            }
        };
        let request = Request::new(topic.clone());
        let (subscription, lease) =
            service.listen(SubscribeOptions::default(), request, take).await?;
        let outcome = self.figures(&subscription, offsets).await;
        let _ = lease.withdraw().await;
        outcome?;
        self.write_samples()?;
        let dropped = self.meter.lock().dropped_samples();
        if dropped > 0 {
            eprintln!("blaze: {dropped} samples came too fast for the file and are not in it");
        }
        Ok(())
    }

    async fn figures(
        &mut self,
        subscription: &Subscription,
        offsets: &mut Offsets<'_>,
    ) -> Result<(), CliError> {
        let interruption = interrupted();
        tokio::pin!(interruption);
        let mut seconds = interval_at(Instant::now() + EVERY, EVERY);
        seconds.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut printed = 0;
        while self.options.count.is_none_or(|count| printed < count) {
            tokio::select! {
                stopped = &mut interruption => return stopped,
                _ = seconds.tick() => {}
            }
            self.write_samples()?;
            self.print(subscription)?;
            printed += 1;
            offsets.refresh(&self.meter, self.format).await?;
        }
        Ok(())
    }

    fn write_samples(&mut self) -> Result<(), CliError> {
        let Some(csv) = &mut self.csv else { return Ok(()) };
        let samples = self.meter.lock().take_samples();
        for sample in &samples {
            csv.line(&csv_line(sample))?;
        }
        csv.flush()
    }

    fn print(&self, subscription: &Subscription) -> Result<(), CliError> {
        let topic = self.options.target.topic.as_str();
        let (rows, of_further_nodes) = self.meter.lock().rows(topic);
        let stats = subscription.stats();
        let value = json!({
            "topics": rows, "received": stats.received, "lost": stats.lost,
            "of_further_nodes": of_further_nodes,
        });
        output::print_look(&value, self.format, |value| table(topic, value))
    }
}

fn table(topic: &str, value: &Value) -> Result<String, CliError> {
    let mut text = format!("{topic}: {} received, {} lost\n", value["received"], value["lost"]);
    if value["of_further_nodes"] != 0 {
        text.push_str(&format!("of further nodes: {}\n", value["of_further_nodes"]));
    }
    let latency =
        Latency::deserialize(value).map_err(|error| CliError::Failed(error.to_string()))?;
    text.push_str(&latency_table(&latency, terminal_width()));
    Ok(text)
}

fn arrival(message: &Message, own: &FlowId) -> Arrival {
    let received_ns = nanos(SystemTime::now());
    let origin = message.origin();
    let from = match (origin.layer.parse(), origin.node.parse()) {
        (Ok(layer), Ok(node)) => FlowId::new(layer, node),
        // A message without a header is of this broker.
        _ => own.clone(),
    };
    // A flow wrote an age, or publisher and command share a clock.
    let is_aged = message.hops() > 0 || from == *own;
    Arrival {
        sequence: message.sequence().unwrap_or(0),
        published_ns: message.publish_time().map(nanos),
        received_ns,
        age: is_aged.then(|| message.age()),
        from,
    }
}

fn nanos(at: SystemTime) -> i64 {
    let since = at.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}

fn csv_line(sample: &Sample) -> String {
    let measured = sample.measured;
    format!(
        "{},{},{},{},{},{}",
        rfc3339_millis(u64::try_from(sample.received_ns / 1_000_000).unwrap_or(0)),
        sample.from,
        sample.sequence,
        millis(measured.map(|measured| measured.latency_ms)),
        millis(measured.and_then(|measured| measured.error_ms)),
        measured.map_or("", |measured| measured.method.as_str()),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_is_one_line_and_an_unknown_latency_empty() {
        use super::super::meter::{Measured, Method};
        let measured =
            Measured { latency_ms: 12.3456, error_ms: Some(0.41), method: Method::Clock };
        let sample = Sample {
            received_ns: 1_795_244_472_345_678_901,
            from: "edge/robot-1".parse().unwrap(),
            sequence: 42,
            measured: Some(measured),
        };
        assert_eq!(
            csv_line(&sample),
            "2026-11-21T07:01:12.345Z,edge/robot-1,42,12.346,0.410,clock"
        );
        let unknown = Sample { measured: None, ..sample };
        assert_eq!(csv_line(&unknown), "2026-11-21T07:01:12.345Z,edge/robot-1,42,,,");
    }

    #[test]
    fn figures_are_a_table_under_what_was_received() {
        let value = json!({"topics": [{"topic": "imu/data", "from": "fog/fog-1", "method": "age",
                "messages": 10, "latency_ms": {"p50": 12.5, "p99": 20}, "error_ms": 4,
                "unknown": 1}],
            "received": 10, "lost": 2, "of_further_nodes": 3});
        assert_eq!(
            table("imu/data", &value).unwrap(),
            "imu/data: 10 received, 2 lost\n\
             of further nodes: 3\n\
             FROM       MESSAGES  p50/ms  p99/ms   ±/ms  BY   UNKNOWN  LOST\n\
             fog/fog-1        10   12.50   20.00  4.000  age        1     -\n"
        );
    }
}
