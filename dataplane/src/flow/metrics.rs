//! `/metrics`: the counters of the flow in Prometheus' words. Made anew for each scrape from the
//! state under its lock.

mod latency;

use std::collections::BTreeMap;
use std::time::Instant;

use blaze_domain::{Priority, Scope};
use prometheus::{CounterVec, GaugeVec, Opts, Registry, TextEncoder};

use super::admin::ros2::rows;
use super::inter::InterScope;
use super::routes::SourceState;
use super::{Shared, class_label};
use crate::codec::pool::CodecPool;
use crate::control::MoveReason;
use crate::lane::path::{Phase, TopicId, TopicPath};
use crate::lane::stats::{BridgeStats, OTHER};
use crate::link::{Engine, PeerState};
use crate::registry::Terms;
use latency::Histogram;

/// Topics that have label values of their own; the rest share one.
const MAX_TOPICS: u32 = 1000;

/// The text of one scrape.
pub(super) fn render(shared: &Shared) -> String {
    let text = Page::new().and_then(|page| page.text(shared));
    text.unwrap_or_else(|error| {
        tracing::error!(%error, "metrics");
        String::new()
    })
}

/// Each metric: kind, name, labels (`-`: none) and help.
const METRICS: &str = "\
counter blaze_flow_messages_total topic,from,to,direction Messages through a bridge.
counter blaze_flow_bytes_total topic,from,to,direction Payload bytes through a bridge.
counter blaze_flow_dropped_total topic,to,reason Messages dropped.
gauge blaze_flow_bridges state Bridges by state.
histogram blaze_flow_bridge_latency_seconds topic,to Time of a message in this flow.
histogram blaze_flow_delivery_age_seconds topic,to,from_layer Age of a message when it was written \
    to the broker.
gauge blaze_flow_queue_bytes to,class Bytes that wait for the link or may have to be repaired.
gauge blaze_flow_rate_hertz topic,to,kind Rates of a topic.
gauge blaze_flow_budget_bytes_per_second to,kind Wire bytes per second.
gauge blaze_flow_feasible to 1 while what is published fits the budget at its lowest rates.
gauge blaze_flow_wire_factor - Wire bytes for each byte that the allocation reckons with.
counter blaze_flow_compression_bytes_total topic,stage Payload bytes before and after compression.
counter blaze_flow_compression_seconds_total topic Processor time of compression.
gauge blaze_flow_compression_level topic Level of now; 0: payloads go as they are.
gauge blaze_flow_compression_pool state Threads that compress, and what waits for them.
counter blaze_flow_compression_pool_seconds_total - Time that the threads were taken, all together.
counter blaze_flow_converted_total topic,form Messages that became JSON or CDR.
counter blaze_flow_convert_seconds_total topic Time that conversions took.
counter blaze_flow_wire_bytes_total to,class IP bytes sent on the inter scope.
gauge blaze_flow_peer_up peer 1 while the peer says Hello and acknowledges.
gauge blaze_flow_peer_rtt_seconds peer Round trip to the peer.
gauge blaze_ros2_endpoints kind,state Endpoints of the ROS 2 network.
gauge blaze_ros2_participants - Participants of the ROS 2 network that have endpoints.
counter blaze_ros2_calls_total outcome Calls of ROS 2 services, as they were answered.
gauge blaze_flow_leases kind Leases of local services.
counter blaze_flow_link_events_total event Things that happened on the link.
gauge blaze_flow_load_bytes_per_second direction Payload that the flow carries over the inter scope, \
    as the other flows of its layer are told.
counter blaze_flow_moves_total reason Topics that went to another flow of the layer.
gauge process_start_time_seconds - When the flow started, since 1970.
gauge blaze_build_info version,program 1, with the version as label.
";

/// Times of bridges, by their labels.
#[derive(Default)]
struct Histograms {
    latency: BTreeMap<String, Histogram>,
    age: BTreeMap<String, Histogram>,
}

impl Histograms {
    fn add(&mut self, topic: &str, to: &str, stats: &BridgeStats) {
        let labels = format!("topic=\"{topic}\",to=\"{to}\"");
        for (layer, ages) in stats.ages.iter() {
            let labels = format!("{labels},from_layer=\"{layer}\"");
            self.age.entry(labels).or_default().add(ages);
        }
        self.latency.entry(labels).or_default().add(&stats.latency);
    }
}

/// All metrics, without values at first.
struct Page {
    registry: Registry,
    metrics: BTreeMap<&'static str, Metric>,
}

enum Metric {
    Counter(CounterVec),
    Gauge(GaugeVec),
    /// Written by hand, from the histograms of the bridges.
    Histogram(&'static str),
}

impl Page {
    fn new() -> prometheus::Result<Self> {
        let mut page = Self { registry: Registry::new(), metrics: BTreeMap::new() };
        for line in METRICS.lines() {
            let mut words = line.splitn(4, ' ');
            let mut word = || words.next().unwrap_or_default();
            let (kind, name, labels, help) = (word(), word(), word(), word());
            let labels: Vec<&str> = labels.split(',').filter(|label| *label != "-").collect();
            let metric = if kind == "counter" {
                let counter = CounterVec::new(Opts::new(name, help), &labels)?;
                page.registry.register(Box::new(counter.clone()))?;
                Metric::Counter(counter)
            } else if kind == "histogram" {
                Metric::Histogram(help)
            } else {
                let gauge = GaugeVec::new(Opts::new(name, help), &labels)?;
                page.registry.register(Box::new(gauge.clone()))?;
                Metric::Gauge(gauge)
            };
            page.metrics.insert(name, metric);
        }
        Ok(page)
    }

    /// Adds to the value of one set of labels.
    fn add(&self, name: &str, labels: &[&str], value: f64) {
        let added = match self.metrics.get(name) {
            Some(Metric::Counter(counter)) => {
                counter.get_metric_with_label_values(labels).map(|counter| counter.inc_by(value))
            }
            Some(Metric::Gauge(gauge)) => {
                gauge.get_metric_with_label_values(labels).map(|gauge| gauge.add(value))
            }
            Some(Metric::Histogram(_)) | None => {
                Err(prometheus::Error::Msg("it is not in the table".to_owned()))
            }
        };
        debug_assert!(added.is_ok(), "{name} {labels:?}: {added:?}");
        if let Err(error) = added {
            tracing::error!(name, ?labels, %error, "metrics");
        }
    }

    /// Counts things that happened.
    fn count(&self, events: &[(&str, u64)]) {
        for (event, count) in events {
            self.add("blaze_flow_link_events_total", &[event], *count as f64);
        }
    }

    fn text(&self, shared: &Shared) -> prometheus::Result<String> {
        self.add("process_start_time_seconds", &[], shared.started_s);
        self.add("blaze_build_info", &[env!("CARGO_PKG_VERSION"), "blaze-flow"], 1.0);
        let latencies = self.fill_topics(shared);
        self.fill_link(shared);
        self.fill_compression(shared);
        self.fill_control(shared);
        self.fill_ros2(shared);
        let text = TextEncoder::new().encode_to_string(&self.registry.gather())?;
        Ok(text + &latencies)
    }

    /// Returns the text of the latencies.
    fn fill_topics(&self, shared: &Shared) -> String {
        let now = Instant::now();
        let sources = shared.routes.source_states();
        let mut histograms = Histograms::default();
        shared.plane.read(|state| {
            for (reason, count) in state.core.unattributed.iter() {
                self.add("blaze_flow_dropped_total", &["", "", reason.as_str()], count as f64);
            }
            for (id, path) in state.core.topics_mut() {
                let topic =
                    if id.0 < MAX_TOPICS { path.name.to_string() } else { OTHER.to_owned() };
                self.fill_topic(now, (&topic, id), path, &sources, &mut histograms);
            }
        });
        let mut text = String::new();
        for (name, histograms) in [
            ("blaze_flow_bridge_latency_seconds", histograms.latency),
            ("blaze_flow_delivery_age_seconds", histograms.age),
        ] {
            let Some(Metric::Histogram(help)) = self.metrics.get(name) else { continue };
            if !histograms.is_empty() {
                text.push_str(&format!("# HELP {name} {help}\n# TYPE {name} histogram\n"));
            }
            for (labels, histogram) in histograms {
                histogram.write(name, &labels, &mut text);
            }
        }
        text
    }

    fn fill_topic(
        &self,
        now: Instant,
        (topic, id): (&str, TopicId),
        path: &mut TopicPath,
        sources: &BTreeMap<(TopicId, Scope), SourceState>,
        histograms: &mut Histograms,
    ) {
        for (reason, count) in path.ingress_drops.iter() {
            self.add("blaze_flow_dropped_total", &[topic, "", reason.as_str()], count as f64);
        }
        let stats = &path.compress_stats;
        if stats.messages > 0 {
            for (stage, bytes) in [("before", stats.before), ("after", stats.after)] {
                self.add("blaze_flow_compression_bytes_total", &[topic, stage], bytes as f64);
            }
            self.add("blaze_flow_compression_seconds_total", &[topic], stats.seconds);
            // Topics that share a label have no level in common.
            if topic != OTHER {
                self.add("blaze_flow_compression_level", &[topic], f64::from(path.level()));
            }
        }
        let stats = &path.convert_stats;
        for (form, count) in [("json", stats.json), ("cdr", stats.cdr)] {
            if count > 0 {
                self.add("blaze_flow_converted_total", &[topic, form], count as f64);
            }
        }
        if stats.json + stats.cdr > 0 {
            self.add("blaze_flow_convert_seconds_total", &[topic], stats.seconds);
        }
        let measured = path.in_rate.rate(now).0;
        let granted = path.granted.map(|granted| granted.advertised_hz);
        let advertised = granted.or(path.info.rate_hz).unwrap_or(measured);
        let mut receivers = Vec::new();
        let mut local = Vec::new();
        for bridge in &mut path.bridges {
            let to = bridge.to_label();
            let from = bridge.from.as_str();
            bridge.settle();
            let stats = &bridge.stats;
            for (direction, count) in [("in", stats.taken), ("out", stats.out)] {
                self.add(
                    "blaze_flow_messages_total",
                    &[topic, from, &to, direction],
                    count.messages as f64,
                );
                self.add(
                    "blaze_flow_bytes_total",
                    &[topic, from, &to, direction],
                    count.bytes as f64,
                );
            }
            for (reason, count) in stats.dropped.iter() {
                self.add("blaze_flow_dropped_total", &[topic, &to, reason.as_str()], count as f64);
            }
            histograms.add(topic, &to, stats);
            let source = sources.get(&(id, bridge.from));
            let state = match (bridge.phase, source) {
                (Phase::Failed { .. }, _) | (Phase::Up { .. }, Some(SourceState::Failed(_))) => {
                    "failed"
                }
                (Phase::Up { .. }, Some(SourceState::Subscribed)) => "up",
                (Phase::Up { .. }, _) if bridge.from == Scope::Inter => "up",
                (Phase::Up { .. }, _) => "starting",
                (Phase::Draining { .. }, _) => "draining",
                (Phase::Ended, _) => continue,
            };
            self.add("blaze_flow_bridges", &[state], 1.0);
            let rate =
                |kind: &str, hz: f64| self.add("blaze_flow_rate_hertz", &[topic, &to, kind], hz);
            rate("actual", bridge.out_rate.rate(now).0);
            // What goes to one flow is one lane, on whatever scope it was published.
            let counts = match bridge.receiver() {
                Some((_, receiver)) => {
                    matches!(bridge.phase, Phase::Up { .. }) && !receivers.contains(receiver)
                }
                // Nor does it count twice what several bridges write to one broker.
                None => bridge.from != Scope::Inter && !local.contains(&to),
            };
            if counts {
                if bridge.receiver().is_none() {
                    local.push(to.clone());
                }
                receivers.extend(bridge.receiver().map(|(_, receiver)| receiver.clone()));
                rate("advertised", advertised);
                if let Some(allocated) = bridge.allocated_hz {
                    rate("allocated", allocated);
                }
            }
        }
    }

    fn fill_link(&self, shared: &Shared) {
        let now = Instant::now();
        let said = |engine: &Engine| (engine.peers(), engine.counters());
        let (peers, counters) =
            shared.plane.read(|state| state.engine.as_ref().map(said).unwrap_or_default());
        for peer in &peers {
            let name = peer.flow.to_string();
            let up = f64::from(u8::from(peer.state == PeerState::Up));
            self.add("blaze_flow_peer_up", &[&name], up);
            if let Some(rtt) = peer.rtt {
                self.add("blaze_flow_peer_rtt_seconds", &[&name], rtt.as_secs_f64());
            }
            let to = format!("inter/{}", peer.flow.layer);
            for (index, bytes) in peer.queue_bytes.iter().enumerate() {
                self.add("blaze_flow_queue_bytes", &[&to, class_label(index)], *bytes as f64);
            }
        }
        self.count(&[
            ("decode_error", counters.decode_errors),
            ("unknown_sender", counters.unknown_senders),
            ("stale", counters.stale),
            ("duplicate", counters.duplicates),
            ("reassembly_timeout", counters.reassembly_timeouts),
            ("reassembly_evicted", counters.reassembly_evicted),
            ("overrun", counters.overrun),
            ("peer_refused", counters.peers_refused),
            ("control_refused", counters.control_refused),
            ("repair", counters.repairs),
            ("probe", counters.probes),
            ("news_dropped", shared.plane.news_dropped()),
        ]);
        if let Some(status) = shared.inter.as_ref().and_then(InterScope::status) {
            self.count(&[
                ("participant_rebuilt", status.rebuilds),
                ("not_sent", status.not_sent),
                ("dropped_by_kernel", status.dropped_by_kernel),
                ("malformed_sample", status.malformed),
            ]);
        }
        self.fill_budgets(now, shared);
    }

    fn fill_budgets(&self, now: Instant, shared: &Shared) {
        let budget = |to: &str, kind: &str, bytes: f64| {
            self.add("blaze_flow_budget_bytes_per_second", &[to, kind], bytes);
        };
        let mut used = 0.0;
        for (layer, mut traffic) in shared.egress.traffic().by_layer {
            let to = format!("inter/{layer}");
            for (index, bytes) in traffic.wire_bytes.iter().enumerate() {
                self.add("blaze_flow_wire_bytes_total", &[&to, class_label(index)], *bytes as f64);
            }
            let rate = traffic.rate.rate(now).1;
            used += rate;
            budget(&to, "used", rate);
        }
        budget("inter", "limit", shared.egress.budget());
        budget("inter", "used", used);
        let limiter = shared.limiter.lock();
        let feasible = |to: &str, feasible: bool| {
            let value = f64::from(u8::from(feasible));
            self.add("blaze_flow_feasible", &[to], value);
        };
        let last = limiter.last();
        feasible("inter", last.is_none_or(|last| last.process_feasible));
        if let Some(measured) = limiter.measured_bytes_per_s(None) {
            budget("inter", "measured", measured);
        }
        for layer in limiter.layers() {
            let to = format!("inter/{layer}");
            if let Some(limit) = limiter.bandwidth().link_limit_bytes_per_s(&layer) {
                budget(&to, "limit", limit);
            }
            if let Some(measured) = limiter.measured_bytes_per_s(Some(&layer)) {
                budget(&to, "measured", measured);
            }
            feasible(&to, last.is_none_or(|last| !last.infeasible_links.contains(&layer)));
        }
        if let Some(factor) = limiter.wire_factor(None) {
            self.add("blaze_flow_wire_factor", &[], factor);
        }
    }

    fn fill_compression(&self, shared: &Shared) {
        let Some(pool) = shared.plane.codec().map(CodecPool::counters) else {
            return;
        };
        let stage = shared.plane.read(|state| state.core.compress_counters());
        for (state, value) in [
            ("threads", pool.threads),
            ("busy", pool.working),
            ("waiting", stage.waiting),
            ("waiting_bytes", stage.waiting_bytes),
        ] {
            self.add("blaze_flow_compression_pool", &[state], value as f64);
        }
        self.add("blaze_flow_compression_pool_seconds_total", &[], pool.busy.as_secs_f64());
        self.count(&[("compression_refused", stage.refused), ("compression_failed", stage.failed)]);
    }

    fn fill_ros2(&self, shared: &Shared) {
        for (outcome, count) in shared.control.lock().call_outcomes() {
            self.add("blaze_ros2_calls_total", &[outcome], *count as f64);
        }
        let Some(ros2) = &shared.ros2 else { return };
        for row in rows(&ros2.seen(), &shared.control.lock()) {
            self.add("blaze_ros2_endpoints", &[row.kind, row.state], 1.0);
        }
        let participants = ros2.broker.network().borrow().participants;
        self.add("blaze_ros2_participants", &[], participants as f64);
    }

    fn fill_control(&self, shared: &Shared) {
        let control = shared.control.lock();
        for kind in ["advertise", "request"] {
            self.add("blaze_flow_leases", &[kind], 0.0);
        }
        for lease in control.registry().leases() {
            let kind = match lease.terms {
                Terms::Advertise { .. } => "advertise",
                Terms::Request { .. } => "request",
            };
            self.add("blaze_flow_leases", &[kind], 1.0);
        }
        self.count(&[
            ("control_message_overrun", control.overrun),
            ("control_message_refused", control.refused),
            ("kept_lease_skipped", control.skipped_leases),
        ]);
        let (load, moves) = (control.load(), control.moves());
        for (direction, bytes_per_s) in [("out", load.out_bytes_per_s), ("in", load.in_bytes_per_s)]
        {
            self.add("blaze_flow_load_bytes_per_second", &[direction], bytes_per_s as f64);
        }
        for (reason, count) in [
            (MoveReason::Load.as_str(), moves.by_load),
            (MoveReason::Settled.as_str(), moves.settled),
            ("taken_back", moves.taken_back),
        ] {
            self.add("blaze_flow_moves_total", &[reason], count as f64);
        }
        let (handed_over, taken_over) = control.handovers();
        self.count(&[
            ("topic_handed_over", handed_over),
            ("topic_taken_over", taken_over),
            ("replica_message_refused", control.refused_replica_messages()),
            ("replica_message_overrun", control.replica_overrun()),
            ("topic_not_announced", control.registry().faults().left_out_topics),
        ]);
    }
}

const _: () = assert!(Priority::ALL.len() == 3, "classes have one label each");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_what_is_written_and_the_page_of_the_documentation_has_the_table() {
        let page = Page::new().unwrap();
        for name in include_str!("metrics.rs").split('"').filter(|text| {
            text.starts_with("blaze_flow_")
                && text.chars().all(|letter| letter.is_ascii_lowercase() || letter == '_')
        }) {
            assert!(name == "blaze_flow_" || page.metrics.contains_key(name), "{name}");
        }
        let documentation = include_str!("../../../docs/metrics.md");
        for line in METRICS.lines().filter(|line| line.contains(" blaze_flow_")) {
            let words: Vec<&str> = line.splitn(4, ' ').collect();
            let head = format!("| `{}` | {} | ", words[1], words[0]);
            let row = documentation.lines().find_map(|row| row.strip_prefix(&head));
            let documented = row.and_then(|row| row.split(" | ").next());
            let labels = match words[2] {
                "-" => "–".to_owned(),
                labels => labels
                    .split(',')
                    .map(|label| format!("`{label}`"))
                    .collect::<Vec<_>>()
                    .join(" "),
            };
            assert!(
                documented.is_some_and(|documented| documented == labels || documented == "same"),
                "{head}{documented:?}"
            );
        }
    }
}
