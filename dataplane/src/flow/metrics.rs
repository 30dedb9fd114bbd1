//! `/metrics`: the counters of the flow in Prometheus' words. Made anew for each scrape from the state under its lock.

mod latency;

use std::collections::BTreeMap;
use std::time::Instant;

use blaze_domain::{Priority, Scope};
use prometheus::core::Collector;
use prometheus::{CounterVec, Encoder, GaugeVec, Opts, Registry, TextEncoder};

use super::inter::InterScope;
use super::routes::SourceState;
use super::{Shared, class_label};
use crate::codec::pool::CodecPool;
use crate::control::MoveReason;
use crate::lane::path::{Phase, TopicId, TopicPath};
use crate::registry::Terms;
use latency::Histogram;

/// Topics that have label values of their own; the rest share one.
const MAX_TOPICS: u32 = 1000;
const OTHER: &str = "_other";

/// The text of one scrape.
pub(super) fn render(shared: &Shared) -> String {
    let page = Page::new();
    match page.and_then(|page| {
        page.fill(shared);
        page.text()
    }) {
        Ok(text) => text,
        Err(error) => {
            tracing::error!(%error, "metrics");
            String::new()
        }
    }
}

struct Page {
    registry: Registry,
    messages: CounterVec,
    bytes: CounterVec,
    dropped: CounterVec,
    bridges: GaugeVec,
    queue_bytes: GaugeVec,
    rate: GaugeVec,
    budget: GaugeVec,
    feasible: GaugeVec,
    wire_factor: GaugeVec,
    wire_bytes: CounterVec,
    compression_bytes: CounterVec,
    compression_seconds: CounterVec,
    compression_level: GaugeVec,
    compression_pool: GaugeVec,
    compression_pool_seconds: CounterVec,
    peer_up: GaugeVec,
    peer_rtt: GaugeVec,
    leases: GaugeVec,
    link: CounterVec,
    load: GaugeVec,
    moves: CounterVec,
    build: GaugeVec,
    started: GaugeVec,
    latency: parking_lot::Mutex<String>,
}

fn counter(registry: &Registry, name: &str, help: &str, labels: &[&str]) -> prometheus::Result<CounterVec> {
    let metric = CounterVec::new(Opts::new(name, help), labels)?;
    register(registry, metric)
}

fn gauge(registry: &Registry, name: &str, help: &str, labels: &[&str]) -> prometheus::Result<GaugeVec> {
    let metric = GaugeVec::new(Opts::new(name, help), labels)?;
    register(registry, metric)
}

fn register<M: Collector + Clone + 'static>(registry: &Registry, metric: M) -> prometheus::Result<M> {
    registry.register(Box::new(metric.clone()))?;
    Ok(metric)
}

impl Page {
    fn new() -> prometheus::Result<Self> {
        let r = Registry::new();
        Ok(Self {
            messages: counter(
                &r,
                "blaze_flow_messages_total",
                "Messages through a bridge.",
                &["topic", "from", "to", "direction"],
            )?,
            bytes: counter(
                &r,
                "blaze_flow_bytes_total",
                "Payload bytes through a bridge.",
                &["topic", "from", "to", "direction"],
            )?,
            dropped: counter(
                &r,
                "blaze_flow_dropped_total",
                "Messages dropped.",
                &["topic", "to", "reason"],
            )?,
            bridges: gauge(&r, "blaze_flow_bridges", "Bridges by state.", &["state"])?,
            queue_bytes: gauge(
                &r,
                "blaze_flow_queue_bytes",
                "Bytes that wait for the link or may have to be repaired.",
                &["to", "class"],
            )?,
            rate: gauge(
                &r,
                "blaze_flow_rate_hertz",
                "Rates of a topic.",
                &["topic", "to", "kind"],
            )?,
            budget: gauge(
                &r,
                "blaze_flow_budget_bytes_per_second",
                "Wire bytes per second.",
                &["to", "kind"],
            )?,
            feasible: gauge(
                &r,
                "blaze_flow_feasible",
                "1 while what is published fits the budget at its lowest rates.",
                &["to"],
            )?,
            wire_factor: gauge(
                &r,
                "blaze_flow_wire_factor",
                "Wire bytes for each byte that the allocation reckons with.",
                &[],
            )?,
            compression_bytes: counter(
                &r,
                "blaze_flow_compression_bytes_total",
                "Payload bytes before and after compression.",
                &["topic", "stage"],
            )?,
            compression_seconds: counter(
                &r,
                "blaze_flow_compression_seconds",
                "Processor time of compression.",
                &["topic"],
            )?,
            compression_level: gauge(
                &r,
                "blaze_flow_compression_level",
                "Level of now; 0: payloads go as they are.",
                &["topic"],
            )?,
            compression_pool: gauge(
                &r,
                "blaze_flow_compression_pool",
                "Threads that compress, and what waits for them.",
                &["state"],
            )?,
            compression_pool_seconds: counter(
                &r,
                "blaze_flow_compression_pool_seconds",
                "Time that the threads were taken, all together.",
                &[],
            )?,
            wire_bytes: counter(
                &r,
                "blaze_flow_wire_bytes_total",
                "IP bytes sent on the inter scope.",
                &["to", "class"],
            )?,
            peer_up: gauge(
                &r,
                "blaze_flow_peer_up",
                "1 while the peer says Hello and acknowledges.",
                &["peer"],
            )?,
            peer_rtt: gauge(&r, "blaze_flow_peer_rtt_seconds", "Round trip to the peer.", &["peer"])?,
            leases: gauge(&r, "blaze_flow_leases", "Leases of local services.", &["kind"])?,
            link: counter(
                &r,
                "blaze_flow_link_events_total",
                "Things that happened on the link.",
                &["event"],
            )?,
            load: gauge(
                &r,
                "blaze_flow_load_bytes_per_second",
                "Payload that the flow carries over the inter scope, as the other flows of its layer are told.",
                &["direction"],
            )?,
            moves: counter(
                &r,
                "blaze_flow_moves_total",
                "Topics that went to another flow of the layer.",
                &["reason"],
            )?,
            started: gauge(
                &r,
                "process_start_time_seconds",
                "When the flow started, since 1970.",
                &[],
            )?,
            build: gauge(
                &r,
                "blaze_build_info",
                "1, with the version as label.",
                &["version", "program"],
            )?,
            latency: parking_lot::Mutex::default(),
            registry: r,
        })
    }

    fn fill(&self, shared: &Shared) {
        self.started.with_label_values::<&str>(&[]).set(shared.started_s);
        self.build
            .with_label_values(&[env!("CARGO_PKG_VERSION"), "blaze-flow"])
            .set(1.0);
        self.fill_topics(shared);
        self.fill_link(shared);
        self.fill_compression(shared);
        self.fill_control(shared);
    }

    fn fill_topics(&self, shared: &Shared) {
        let now = Instant::now();
        let sources = shared.routes.source_states();
        let mut histograms: BTreeMap<(String, String), Histogram> = BTreeMap::new();
        shared.plane.read(|state| {
            for (reason, count) in state.core.unattributed.iter() {
                self.dropped
                    .with_label_values(&["", "", reason.as_str()])
                    .inc_by(count as f64);
            }
            for (id, path) in state.core.topics_mut() {
                let topic = if id.0 < MAX_TOPICS {
                    path.name.to_string()
                } else {
                    OTHER.to_owned()
                };
                self.fill_topic(now, (&topic, id), path, &sources, &mut histograms);
            }
        });
        let mut text = String::new();
        if !histograms.is_empty() {
            text.push_str("# HELP blaze_flow_bridge_latency_seconds Time of a message in this flow.\n");
            text.push_str("# TYPE blaze_flow_bridge_latency_seconds histogram\n");
        }
        for ((topic, to), histogram) in histograms {
            histogram.write(&topic, &to, &mut text);
        }
        *self.latency.lock() = text;
    }

    fn fill_topic(
        &self,
        now: Instant,
        (topic, id): (&str, TopicId),
        path: &mut TopicPath,
        sources: &BTreeMap<(TopicId, Scope), SourceState>,
        histograms: &mut BTreeMap<(String, String), Histogram>,
    ) {
        for (reason, count) in path.ingress_drops.iter() {
            self.dropped
                .with_label_values(&[topic, "", reason.as_str()])
                .inc_by(count as f64);
        }
        let press = &path.press;
        if press.messages > 0 {
            for (stage, bytes) in [("before", press.before), ("after", press.after)] {
                self.compression_bytes
                    .with_label_values(&[topic, stage])
                    .inc_by(bytes as f64);
            }
            self.compression_seconds
                .with_label_values(&[topic])
                .inc_by(press.seconds);
            // Topics that share a label have no level in common.
            if topic != OTHER {
                self.compression_level
                    .with_label_values(&[topic])
                    .set(f64::from(path.level()));
            }
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
                self.messages
                    .with_label_values(&[topic, from, &to, direction])
                    .inc_by(count.messages as f64);
                self.bytes
                    .with_label_values(&[topic, from, &to, direction])
                    .inc_by(count.bytes as f64);
            }
            for (reason, count) in stats.dropped.iter() {
                self.dropped
                    .with_label_values(&[topic, &to, reason.as_str()])
                    .inc_by(count as f64);
            }
            histograms
                .entry((topic.to_owned(), to.clone()))
                .or_default()
                .add(bridge);
            let source = sources.get(&(id, bridge.from));
            let state = match (bridge.phase, source) {
                (Phase::Failed { .. }, _) | (Phase::Up { .. }, Some(SourceState::Failed(_))) => "failed",
                (Phase::Up { .. }, Some(SourceState::Subscribed)) => "up",
                (Phase::Up { .. }, _) if bridge.from == Scope::Inter => "up",
                (Phase::Up { .. }, _) => "starting",
                (Phase::Draining { .. }, _) => "draining",
                (Phase::Ended, _) => continue,
            };
            self.bridges.with_label_values(&[state]).inc();
            let rate = |kind: &str| self.rate.with_label_values(&[topic, &to, kind]);
            rate("actual").add(bridge.out_rate.rate(now).0);
            // What goes to one flow is one lane, on whatever scope it was published.
            let counts = match bridge.receiver() {
                Some((_, receiver)) => matches!(bridge.phase, Phase::Up { .. }) && !receivers.contains(receiver),
                // Nor does it count twice what several bridges write to one broker.
                None => bridge.from != Scope::Inter && !local.contains(&to),
            };
            if counts {
                if bridge.receiver().is_none() {
                    local.push(to.clone());
                }
                receivers.extend(bridge.receiver().map(|(_, receiver)| receiver.clone()));
                rate("advertised").add(advertised);
                if let Some(allocated) = bridge.allocated_hz {
                    rate("allocated").add(allocated);
                }
            }
        }
    }

    fn fill_link(&self, shared: &Shared) {
        let now = Instant::now();
        let (peers, counters) = shared.plane.read(|state| {
            state
                .engine
                .as_ref()
                .map(|engine| (engine.peers(), engine.counters()))
                .unwrap_or_default()
        });
        for peer in &peers {
            let name = peer.flow.to_string();
            let up = f64::from(u8::from(peer.state == crate::link::PeerState::Up));
            self.peer_up.with_label_values(&[&name]).set(up);
            if let Some(rtt) = peer.rtt {
                self.peer_rtt.with_label_values(&[&name]).set(rtt.as_secs_f64());
            }
            let to = format!("inter/{}", peer.flow.layer);
            for (index, bytes) in peer.queue_bytes.iter().enumerate() {
                self.queue_bytes
                    .with_label_values(&[&to, class_label(index)])
                    .add(*bytes as f64);
            }
        }
        for (event, count) in [
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
        ] {
            self.link.with_label_values(&[event]).inc_by(count as f64);
        }
        if let Some(status) = shared.inter.as_ref().and_then(InterScope::status) {
            self.link
                .with_label_values(&["participant_rebuilt"])
                .inc_by(status.rebuilds as f64);
            self.link
                .with_label_values(&["not_sent"])
                .inc_by(status.not_sent as f64);
            self.link
                .with_label_values(&["dropped_by_kernel"])
                .inc_by(status.dropped_by_kernel as f64);
            self.link
                .with_label_values(&["malformed_sample"])
                .inc_by(status.malformed as f64);
        }
        self.fill_budgets(now, shared);
    }

    fn fill_budgets(&self, now: Instant, shared: &Shared) {
        let mut used = 0.0;
        for (layer, mut traffic) in shared.egress.traffic().by_layer {
            let to = format!("inter/{layer}");
            for (index, bytes) in traffic.wire_bytes.iter().enumerate() {
                self.wire_bytes
                    .with_label_values(&[&to, class_label(index)])
                    .inc_by(*bytes as f64);
            }
            let rate = traffic.rate.rate(now).1;
            used += rate;
            self.budget.with_label_values(&[&to, "used"]).set(rate);
        }
        self.budget
            .with_label_values(&["inter", "limit"])
            .set(shared.egress.budget());
        self.budget.with_label_values(&["inter", "used"]).set(used);
        let limiter = shared.limiter.lock();
        let feasible = |to: &str, feasible: bool| {
            let value = f64::from(u8::from(feasible));
            self.feasible.with_label_values(&[to]).set(value);
        };
        let last = limiter.last();
        feasible("inter", last.is_none_or(|last| last.process_feasible));
        if let Some(measured) = limiter.measured_bytes_per_s(None) {
            self.budget.with_label_values(&["inter", "measured"]).set(measured);
        }
        for layer in limiter.layers() {
            let to = format!("inter/{layer}");
            let budget = |kind: &str| self.budget.with_label_values(&[to.as_str(), kind]);
            if let Some(limit) = limiter.bandwidth().link_limit_bytes_per_s(&layer) {
                budget("limit").set(limit);
            }
            if let Some(measured) = limiter.measured_bytes_per_s(Some(&layer)) {
                budget("measured").set(measured);
            }
            feasible(&to, last.is_none_or(|last| !last.infeasible_links.contains(&layer)));
        }
        if let Some(factor) = limiter.wire_factor(None) {
            self.wire_factor.with_label_values::<&str>(&[]).set(factor);
        }
    }

    fn fill_compression(&self, shared: &Shared) {
        let Some(pool) = shared.plane.codec().map(CodecPool::counters) else {
            return;
        };
        let press = shared.plane.read(|state| state.core.press_counters());
        for (state, value) in [
            ("threads", pool.threads),
            ("busy", pool.working),
            ("waiting", press.waiting),
            ("waiting_bytes", press.waiting_bytes),
        ] {
            self.compression_pool.with_label_values(&[state]).set(value as f64);
        }
        self.compression_pool_seconds
            .with_label_values::<&str>(&[])
            .inc_by(pool.busy.as_secs_f64());
        for (event, count) in [
            ("compression_refused", press.refused),
            ("compression_failed", press.failed),
        ] {
            self.link.with_label_values(&[event]).inc_by(count as f64);
        }
    }

    fn fill_control(&self, shared: &Shared) {
        let control = shared.control.lock();
        for kind in ["advertise", "request"] {
            self.leases.with_label_values(&[kind]).set(0.0);
        }
        for lease in control.registry().leases() {
            let kind = match lease.terms {
                Terms::Advertise { .. } => "advertise",
                Terms::Request { .. } => "request",
            };
            self.leases.with_label_values(&[kind]).inc();
        }
        self.link
            .with_label_values(&["control_message_overrun"])
            .inc_by(control.overrun as f64);
        self.link
            .with_label_values(&["control_message_refused"])
            .inc_by(control.refused as f64);
        self.link
            .with_label_values(&["kept_lease_skipped"])
            .inc_by(control.skipped_leases as f64);
        let (load, moves) = (control.load(), control.moves());
        for (direction, bytes_per_s) in [("out", load.out_bytes_per_s), ("in", load.in_bytes_per_s)] {
            self.load.with_label_values(&[direction]).set(bytes_per_s as f64);
        }
        for (reason, count) in [
            (MoveReason::Load.as_str(), moves.by_load),
            (MoveReason::Settled.as_str(), moves.settled),
            ("taken_back", moves.taken_back),
        ] {
            self.moves.with_label_values(&[reason]).inc_by(count as f64);
        }
        let (handed_over, taken_over) = control.handovers();
        for (event, count) in [
            ("topic_handed_over", handed_over),
            ("topic_taken_over", taken_over),
            ("replica_message_refused", control.refused_replica_messages()),
            ("replica_message_overrun", control.replica_overrun()),
            ("topic_not_announced", control.registry().faults().left_out_topics),
        ] {
            self.link.with_label_values(&[event]).inc_by(count as f64);
        }
    }

    fn text(&self) -> prometheus::Result<String> {
        let mut text = Vec::new();
        TextEncoder::new().encode(&self.registry.gather(), &mut text)?;
        let mut text = String::from_utf8_lossy(&text).into_owned();
        text.push_str(&self.latency.lock());
        Ok(text)
    }
}

const _: () = assert!(Priority::ALL.len() == 3, "classes have one label each");
