//! What is wrong right now, from one set of inputs.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::node_file::Thresholds;
use blaze_domain::{DropReason, Priority, WhyCode};

use super::codes::Scope;
use super::inputs::{FlowInput, Inputs, Link, ProgramInput, Summary, TopicInput, Vitals};
use super::limits::{
    LIMIT_USED, LOSSY, MAX_SILENCE, MAX_TOPICS, SILENT_MESSAGES, THROTTLED_RATIO, UDP_DROPS_PER_S,
};
use super::rate::Rate;
use super::tracker::Condition;

/// Reasons for which a message of any class is dropped on purpose.
const INTENDED: [DropReason; 5] = [
    DropReason::MaxRate,
    DropReason::Echo,
    DropReason::Duplicate,
    DropReason::NoDestination,
    DropReason::Shutdown,
];
/// Services behind the programs of this system: faults of their configuration are theirs.
const FLOW_SERVICE: &str = "blaze-flow/0";
const WORKER_SERVICE: &str = "blaze-worker/0";

/// Finds conditions; keeps the counters whose rates it needs.
#[derive(Debug, Default)]
pub(super) struct Finder {
    udp: Rate,
    throttled: Rate,
    /// By flow and topic.
    drops: BTreeMap<(String, String), Rate>,
    /// Topics whose drops are not watched, because there are too many.
    pub(super) unwatched: usize,
}

impl Finder {
    pub(super) fn find(
        &mut self,
        now: Instant,
        inputs: &Inputs,
        thresholds: &Thresholds,
    ) -> Vec<Condition> {
        let mut found = Vec::new();
        found.extend(of_values(&inputs.vitals, thresholds).into_iter().flatten());
        found.extend(of_clock(&inputs.vitals, thresholds.clock_error_ms / 1e3));
        found.extend(self.of_counters(now, &inputs.vitals).into_iter().flatten());
        if let Some(worker) = &inputs.worker {
            found.extend(of_program(worker, "worker_not_ready", WORKER_SERVICE));
        }
        for flow in &inputs.flows {
            found.extend(of_program(&flow.program, "flow_not_ready", FLOW_SERVICE));
            if let Some(summary) = &flow.summary {
                found.extend(of_links(&flow.program.name, summary));
            }
            found.extend(flow.topics.iter().filter_map(|topic| blocked(flow, topic)));
            found.extend(flow.topics.iter().filter_map(silent));
        }
        found.extend(self.of_drops(now, &inputs.flows));
        found
    }

    fn of_counters(&mut self, now: Instant, vitals: &Vitals) -> [Option<Condition>; 2] {
        let udp = vitals.udp_buffer_errors.map(|count| self.udp.read(now, count as f64));
        let udp = udp.filter(|rate| *rate >= UDP_DROPS_PER_S).and_then(|rate| {
            let detail = format!("{rate:.1} datagrams/s were dropped in the last 10 s");
            Condition::new(Scope::Node, "udp_drops", "udp", detail)
        });
        let throttled = vitals.throttled_s.map(|seconds| self.throttled.read(now, seconds));
        let throttled = throttled.filter(|ratio| *ratio >= THROTTLED_RATIO).and_then(|ratio| {
            let detail = format!("throttled for {} of the last 10 s", percent(ratio));
            Condition::new(Scope::Node, "cpu_throttled", "cgroup", detail)
        });
        [udp, throttled]
    }

    /// Drops of topics that must not lose anything.
    fn of_drops(&mut self, now: Instant, flows: &[FlowInput]) -> Vec<Condition> {
        let (mut found, mut rates) = (Vec::new(), BTreeMap::new());
        self.unwatched = 0;
        for flow in flows {
            for topic in flow.topics.iter().filter(|topic| is_important(topic)) {
                if rates.len() >= MAX_TOPICS {
                    self.unwatched += 1;
                    continue;
                }
                let key = (flow.program.name.clone(), topic.topic.clone());
                let mut rate = self.drops.remove(&key).unwrap_or_default();
                let counts: Vec<_> = unintended(topic).collect();
                let total: u64 = counts.iter().map(|(_, count)| **count).sum();
                let per_s = rate.read(now, total as f64);
                if per_s > 0.0 {
                    let detail = drops(&flow.program.name, per_s, &counts);
                    let name = &topic.topic;
                    found.extend(Condition::new(Scope::Topic, "priority_drops", name, detail));
                }
                rates.insert(key, rate);
            }
        }
        self.drops = rates;
        found
    }
}

fn of_values(vitals: &Vitals, thresholds: &Thresholds) -> Vec<Option<Condition>> {
    let node = |code, name: &str, detail| Condition::new(Scope::Node, code, name, detail);
    let full = vitals.disks.iter().filter(|(_, free)| *free < thresholds.disk_free_ratio);
    let mut found: Vec<_> = full
        .map(|(mount, free)| {
            let least = percent(thresholds.disk_free_ratio);
            let detail = format!("{} of {mount} is free, less than {least}", percent(*free));
            node("disk_full", mount, detail)
        })
        .collect();
    let low = |available: &f64| *available < thresholds.memory_free_ratio;
    found.extend(vitals.memory_available.filter(low).map(|available| {
        let least = percent(thresholds.memory_free_ratio);
        let detail = format!("{} is available, less than {least}", percent(available));
        node("memory_low", "memory", detail)
    }));
    let hot = vitals.hottest.iter().filter(|(_, celsius)| *celsius > thresholds.celsius);
    found.extend(hot.map(|(sensor, celsius)| {
        let detail = format!("{sensor} has {celsius:.1} °C, above {:.1} °C", thresholds.celsius);
        node("hot", sensor, detail)
    }));
    found
}

/// By the kernel's word, else by the other nodes: a clock that differs from most of them.
fn of_clock(vitals: &Vitals, limit_s: f64) -> Option<Condition> {
    let ms = |seconds: f64| format!("{:.1} ms", seconds * 1e3);
    let detail = match vitals.clock_error_s {
        Some(error) if error > limit_s => {
            format!("the kernel allows for an error of {}, above {}", ms(error), ms(limit_s))
        }
        _ => {
            let offsets = &vitals.offsets;
            let far: Vec<_> =
                offsets.iter().filter(|o| o.offset_s.abs() - o.error_s > limit_s).collect();
            let worst = far.iter().max_by(|a, b| a.offset_s.abs().total_cmp(&b.offset_s.abs()))?;
            if far.len() * 2 <= offsets.len() {
                return None;
            }
            format!(
                "differs from {} of {} nodes, from {} by {} ± {}",
                far.len(),
                offsets.len(),
                worst.node,
                ms(worst.offset_s),
                ms(worst.error_s)
            )
        }
    };
    Condition::new(Scope::Node, "clock_skew", "clock", detail)
}

fn of_program(program: &ProgramInput, code: &str, service: &str) -> Vec<Condition> {
    let detail = match (program.is_reachable, program.detail.as_str()) {
        (_, detail) if !detail.is_empty() => detail.to_owned(),
        (false, _) => "its admin port does not answer".to_owned(),
        (true, _) => "it is not ready".to_owned(),
    };
    let is_ready = program.is_reachable && program.is_ready;
    let not_ready = (!is_ready).then(|| Condition::new(Scope::Node, code, &program.name, detail));
    let fault = program.config_fault.as_ref().map(|fault| {
        let detail = format!("{}: {fault}", program.name);
        Condition::new(Scope::Service, "config_rejected", service, detail)
    });
    not_ready.into_iter().chain(fault).flatten().collect()
}

fn of_links(flow: &str, summary: &Summary) -> Vec<Condition> {
    let mut found: Vec<Condition> =
        summary.links.iter().flat_map(|link| of_link(flow, link)).flatten().collect();
    if !summary.feasible {
        let detail = format!("{flow} cannot keep the minimum rates within its limits");
        found.extend(Condition::new(Scope::Link, "budget_infeasible", flow, detail));
    }
    found
}

fn of_link(flow: &str, link: &Link) -> Vec<Option<Condition>> {
    let name = format!("{flow}>{}", link.flow);
    let one = |code, detail| vec![Condition::new(Scope::Link, code, &name, detail)];
    match link.state.as_str() {
        "down" => return one("peer_down", format!("{} is down", link.flow)),
        "suspect" => return one("peer_suspect", format!("{} does not answer now", link.flow)),
        _ => {}
    }
    let mut found = Vec::new();
    if link.loss >= LOSSY {
        let rtt = link.rtt_ms.map_or(String::new(), |rtt| format!(", round trip {rtt:.1} ms"));
        let detail = format!("{} of the datagrams are lost{rtt}", percent(link.loss));
        found.push(Condition::new(Scope::Link, "link_lossy", &name, detail));
    }
    let limit = link.limit_bytes_per_s;
    if limit > 0.0 && link.wire_bytes_per_s >= LIMIT_USED * limit {
        let mbps = |bytes: f64| bytes * 8.0 / 1e6;
        let detail =
            format!("{:.1} of {:.1} Mbit/s are used", mbps(link.wire_bytes_per_s), mbps(limit));
        found.push(Condition::new(Scope::Link, "limit_reached", &name, detail));
    }
    found
}

/// A topic with both ends that does not flow as asked for.
fn blocked(flow: &FlowInput, topic: &TopicInput) -> Option<Condition> {
    let is_pair = topic.is_advertised && topic.is_requested;
    // Thinning of bulk topics is what a limit is for.
    let is_intended = topic.code == WhyCode::RateLimited && topic.priority == Priority::Bulk;
    if !is_pair || is_intended || is_explained(flow, topic.code) {
        return None;
    }
    let detail = match topic.detail.as_str() {
        "" => format!("{} of {}", topic.code, flow.program.name),
        detail => detail.to_owned(),
    };
    Condition::new(Scope::Topic, topic.code.as_str(), &topic.topic, detail)
}

/// Whether another problem has the cause: one lost link is one problem, not one for each topic.
fn is_explained(flow: &FlowInput, code: WhyCode) -> bool {
    match code {
        WhyCode::BrokerDown | WhyCode::ScopeInUse => !flow.program.is_ready,
        WhyCode::PeerDown | WhyCode::PeerSuspect => {
            let mut links = flow.summary.iter().flat_map(|summary| &summary.links);
            links.any(|link| link.state != "up")
        }
        _ => false,
    }
}

fn silent(topic: &TopicInput) -> Option<Condition> {
    let (advertised, measured) = (topic.advertised_hz?, topic.rate_hz?);
    let is_pair = topic.is_advertised && topic.is_requested && topic.code == WhyCode::Ok;
    let patience = Duration::try_from_secs_f64(SILENT_MESSAGES / advertised).ok()?;
    if !is_pair || measured > 0.0 || patience > MAX_SILENCE {
        return None;
    }
    let detail = format!("no message came; {advertised} Hz are advertised");
    let found = Condition::new(Scope::Topic, "topic_silent", &topic.topic, detail)?;
    Some(found.lasting(patience))
}

fn is_important(topic: &TopicInput) -> bool {
    topic.priority != Priority::Bulk
}

fn unintended(topic: &TopicInput) -> impl Iterator<Item = (&String, &u64)> {
    let is_intended = |reason: &str| INTENDED.iter().any(|intended| intended.as_str() == reason);
    topic.dropped.iter().filter(move |(reason, _)| !is_intended(reason))
}

fn drops(flow: &str, per_s: f64, counts: &[(&String, &u64)]) -> String {
    let mut counts = counts.to_vec();
    counts.sort_by_key(|(_, count)| std::cmp::Reverse(**count));
    let parts: Vec<String> =
        counts.iter().take(3).map(|(reason, count)| format!("{reason} {count}")).collect();
    format!("{flow} drops {per_s:.1} messages/s; since its start: {}", parts.join(", "))
}

fn percent(ratio: f64) -> String {
    format!("{:.1} %", ratio * 100.0)
}
