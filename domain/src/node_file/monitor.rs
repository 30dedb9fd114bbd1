//! Section `monitor`: what BlazeMonitoring measures on this node.

use super::TopicPattern;
use super::readers::{boolean, formed, number, parsed};
use super::walk::{Node, Section, from_empty};
use crate::names::TopicName;
use crate::qos::word_enum;

/// Longest list of rules or flows.
const MAX_ENTRIES: usize = 256;

/// `monitor`.
#[derive(Debug, Clone, PartialEq)]
pub struct MonitorSection {
    /// Between two samples of the node's values, in seconds.
    pub sample_period_s: f64,
    /// Between two rounds of pings, in seconds; 0: none.
    pub ping_period_s: f64,
    /// Topics whose latency is measured; the first rule that matches counts. Those of
    /// `latency_topics` come last.
    pub latency: Vec<LatencyRule>,
    /// `HOST:PORT` of the admin ports of the flows here; empty: that of `admin.flow`.
    pub flows: Vec<String>,
    /// Whether the monitor reports to `config.server`.
    pub report: bool,
    /// Values beyond which the node has a problem.
    pub thresholds: Thresholds,
}

impl Default for MonitorSection {
    fn default() -> Self {
        from_empty(Self::section)
    }
}

impl MonitorSection {
    pub(super) fn section(s: &mut Section<'_>) -> Self {
        let sample_period_s = s.or("sample_period_s", number(0.2, 60.0), 1.0);
        let ping_period_s = s.or("ping_period_s", ping_period, 60.0);
        let mut latency = s.list("latency", |node| node.section(LatencyRule::section).flatten());
        let topics: Vec<TopicPattern> = s.list("latency_topics", parsed);
        latency.extend(topics.into_iter().map(LatencyRule::of));
        let flows = s.list("flows", host_and_port);
        for (key, count) in [("latency and latency_topics", latency.len()), ("flows", flows.len())]
        {
            if count > MAX_ENTRIES {
                s.node.fault::<()>(format!(
                    "{key}: {count} entries, at most {MAX_ENTRIES} are allowed"
                ));
            }
        }
        Self {
            sample_period_s,
            ping_period_s,
            latency,
            flows,
            report: s.or("report", boolean, true),
            thresholds: s.sub_or_empty("thresholds", Thresholds::section),
        }
    }

    /// The rule for a topic, if one matches.
    #[must_use]
    pub fn latency_of(&self, topic: &TopicName) -> Option<&LatencyRule> {
        self.latency.iter().find(|rule| rule.pattern.matches(topic))
    }
}

word_enum!(
    /// How the latency of a topic is observed.
    Observe {
        /// From the ages that flows measure at delivery; no message more.
        Flow = "flow",
        /// By a subscriber of its own.
        Subscribe = "subscribe",
    }
);

word_enum!(
    /// From when on the latency of a message counts.
    Stamp {
        /// From its publishing.
        Publish = "publish",
        /// From the stamp of its `std_msgs/Header`, in JSON `/header/stamp`.
        Header = "header",
    }
);

/// How the latency of the topics of a pattern is measured.
#[derive(Debug, Clone, PartialEq)]
pub struct LatencyRule {
    /// `match`: which topics.
    pub pattern: TopicPattern,
    /// Passively or by a subscriber.
    pub observe: Observe,
    /// Rate of that subscriber in Hz, at most.
    pub max_rate_hz: Option<f64>,
    /// From when on it counts.
    pub stamp: Stamp,
}

impl LatencyRule {
    /// Passive, from publishing on.
    fn of(pattern: TopicPattern) -> Self {
        Self { pattern, observe: Observe::Flow, max_rate_hz: None, stamp: Stamp::Publish }
    }

    fn section(s: &mut Section<'_>) -> Option<Self> {
        let pattern = s.need("match", parsed);
        let observe = s.or("observe", parsed, Observe::Flow);
        let max_rate_hz = s.opt("max_rate_hz", number(0.001, 1_000_000.0));
        let stamp = s.or("stamp", parsed, Stamp::Publish);
        if observe == Observe::Flow && (max_rate_hz.is_some() || stamp == Stamp::Header) {
            return s.node.fault("max_rate_hz and stamp: header need observe: subscribe");
        }
        Some(Self { pattern: pattern?, observe, max_rate_hz, stamp })
    }
}

/// `monitor.thresholds`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thresholds {
    /// A file system with less free than this share of it is `disk_full`.
    pub disk_free_ratio: f64,
    /// A node with less memory available than this share of it is `memory_low`.
    pub memory_free_ratio: f64,
    /// A node with a sensor above this temperature, in °C, is `hot`.
    pub celsius: f64,
    /// A clock that may be wrong by more than this, in ms, is `clock_skew`.
    pub clock_error_ms: f64,
}

impl Thresholds {
    fn section(s: &mut Section<'_>) -> Self {
        Self {
            disk_free_ratio: s.or("disk_free_ratio", number(0.0, 1.0), 0.05),
            memory_free_ratio: s.or("memory_free_ratio", number(0.0, 1.0), 0.05),
            celsius: s.or("celsius", number(0.0, 200.0), 90.0),
            clock_error_ms: s.or("clock_error_ms", number(0.1, 1_000_000.0), 50.0),
        }
    }
}

/// 0, or seconds that are not so few that the pings themselves are a load.
fn ping_period(node: &Node<'_>) -> Option<f64> {
    match number(0.0, 86_400.0)(node)? {
        seconds if seconds == 0.0 || seconds >= 1.0 => Some(seconds),
        seconds => node.fault(format!("{seconds} is neither 0 (off) nor from 1 to 86400")),
    }
}

fn host_and_port(node: &Node<'_>) -> Option<String> {
    formed("a host with a port, such as 127.0.0.1:9101 or flows.edge:9101", |text| {
        let (host, port) = text.rsplit_once(':')?;
        let is_host = !host.is_empty() && !host.contains(['/', '@', ' ']);
        (is_host && port.parse::<u16>().is_ok_and(|port| port != 0)).then(|| text.to_owned())
    })(node)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::NodeFile;
    use super::*;

    #[test]
    fn the_first_rule_that_matches_counts_and_topics_are_short_for_rules() {
        let (file, _) = NodeFile::read(&json!({ "monitor": {
            "latency": [
                { "match": "camera/**", "observe": "subscribe", "max_rate_hz": 10, "stamp": "header" },
            ],
            "latency_topics": ["imu/data", "camera/info"],
            "flows": ["127.0.0.1:9101", "[::1]:9101"],
        } }))
        .unwrap();
        let of = |topic: &str| file.monitor.latency_of(&topic.parse().unwrap()).map(|r| r.observe);
        assert_eq!(of("camera/info"), Some(Observe::Subscribe));
        assert_eq!(of("imu/data"), Some(Observe::Flow));
        assert_eq!(of("odom"), None);
    }

    #[test]
    fn faults_are_named_with_their_place() {
        let faults = NodeFile::read(&json!({ "monitor": {
            "sample_period_s": 0.1,
            "ping_period_s": 0.5,
            "latency": [{ "match": "a", "max_rate_hz": 1 }, { "observe": "flow" }],
            "flows": ["no port", "host:0"],
            "thresholds": { "celsius": 900 },
        } }))
        .unwrap_err();
        let places: Vec<&str> = faults.iter().map(|fault| fault.path.as_str()).collect();
        assert_eq!(
            places,
            [
                "monitor.sample_period_s",
                "monitor.ping_period_s",
                "monitor.latency[0]",
                "monitor.latency[1].match",
                "monitor.flows[0]",
                "monitor.flows[1]",
                "monitor.thresholds.celsius",
            ]
        );
    }
}
