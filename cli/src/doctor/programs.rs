//! The programs of the node, asked at their admin ports.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use serde_json::Value;
use tokio::time::timeout;

use super::check::Finding;
use super::limits::PROGRAM;
use crate::args::FlowAddress;
use crate::exit::CliError;
use crate::http::{get_json, get_text};

/// A program of the product.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Flow,
    Worker,
    Monitor,
    Main,
}

impl Kind {
    /// Name of the executable.
    pub(super) fn program(self) -> &'static str {
        match self {
            Self::Flow => "blaze-flow",
            Self::Worker => "blaze-worker",
            Self::Monitor => "blaze-monitor",
            Self::Main => "blaze-config",
        }
    }

    /// Key of its admin port in the node file.
    pub(super) fn key(self) -> &'static str {
        match self {
            Self::Flow => "admin.flow",
            Self::Worker => "admin.worker",
            Self::Monitor => "admin.monitor",
            Self::Main => "control_plane.admin.listen",
        }
    }

    /// What only this program answers, and cheaply.
    fn path(self) -> &'static str {
        match self {
            Self::Flow => "/v1/summary",
            Self::Worker => "/v1/status",
            Self::Monitor => "/v1/node",
            Self::Main => "/readyz",
        }
    }
}

/// What came back.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Answer {
    /// The program answered.
    Object(Value),
    /// It answers that it is starting or ending.
    Starting(String),
    /// Nobody listens there.
    Nobody(String),
    /// Another program listens there.
    Foreign(String),
}

/// One program at its admin port.
#[derive(Debug, Clone)]
pub(super) struct Program {
    pub(super) kind: Kind,
    pub(super) address: SocketAddr,
    pub(super) answer: Answer,
    /// What `/metrics` answered; empty without an answer.
    pub(super) metrics: String,
}

impl Program {
    /// Asks it.
    pub(super) async fn ask(kind: Kind, address: SocketAddr) -> Self {
        let to = FlowAddress::from(reachable(address));
        let silent = || Answer::Foreign(format!("no answer within {} s", PROGRAM.as_secs()));
        let answer = match timeout(PROGRAM, get_json(&to, kind.path())).await {
            Ok(answered) => answer_of(kind, answered),
            Err(_) => silent(),
        };
        let mut metrics = String::new();
        if matches!(answer, Answer::Object(_))
            && let Ok(Ok(text)) = timeout(PROGRAM, get_text(&to, "/metrics")).await
        {
            metrics = text;
        }
        Self { kind, address, answer, metrics }
    }

    /// What it answered, if it runs.
    pub(super) fn object(&self) -> Option<&Value> {
        match &self.answer {
            Answer::Object(value) => Some(value),
            Answer::Starting(_) | Answer::Nobody(_) | Answer::Foreign(_) => None,
        }
    }

    /// `layer/node` of the program that answers.
    pub(super) fn identity(&self) -> Option<String> {
        let value = self.object()?;
        if let Some(flow) = value.get("flow").and_then(Value::as_str) {
            return Some(flow.to_owned());
        }
        let (layer, node) = (value.get("layer")?.as_str()?, value.get("node")?.as_str()?);
        Some(format!("{layer}/{node}"))
    }

    /// One more answer of a program that runs.
    pub(super) async fn get(&self, path: &str) -> Result<Value, String> {
        let to = FlowAddress::from(reachable(self.address));
        match timeout(PROGRAM, get_json(&to, path)).await {
            Ok(answered) => answered.map_err(|error| words(&error)),
            Err(_) => Err(format!("no answer within {} s", PROGRAM.as_secs())),
        }
    }

    /// A check that needs the program, which does not run.
    pub(super) fn not_running(&self, file: &str) -> Finding {
        let Self { kind, address, .. } = self;
        let (program, key) = (kind.program(), kind.key());
        match &self.answer {
            Answer::Starting(detail) => Finding::skipped(
                format!("{program} is starting or ending: {detail}"),
                format!("wait for it: curl -s http://{address}/readyz"),
            ),
            Answer::Nobody(_) => Finding::skipped(
                format!("{program} does not run: nobody listens at {address} ({key})"),
                format!("{program} --config {file}"),
            ),
            Answer::Foreign(detail) => Finding::skipped(
                format!("no {program} answers at {address} ({key}): {detail}"),
                format!("see the check ports, then {program} --config {file}"),
            ),
            // Not called for one that runs.
            Answer::Object(_) => Finding::ok(format!("{program} runs")),
        }
    }

    /// Version in its metrics.
    pub(super) fn version(&self) -> Option<&str> {
        let labels = sample_lines(&self.metrics, "blaze_build_info").next()?.0;
        labels.split_once("version=\"")?.1.split('"').next()
    }

    /// Sum of a metric over all series whose labels contain `label`.
    pub(super) fn sum(&self, metric: &str, label: &str) -> f64 {
        let lines = sample_lines(&self.metrics, metric);
        lines.filter(|(labels, _)| labels.contains(label)).map(|(_, value)| value).sum()
    }
}

/// The entries of a list in an answer.
pub(super) fn rows<'v>(value: &'v Value, name: &str) -> &'v [Value] {
    value[name].as_array().map_or(&[][..], Vec::as_slice)
}

/// A text in an answer; empty where there is none.
pub(super) fn text<'v>(value: &'v Value, name: &str) -> &'v str {
    value[name].as_str().unwrap_or_default()
}

/// A program that runs, and does not answer what it should.
pub(super) fn unanswered(program: Kind, reason: &str) -> Finding {
    let name = program.program();
    Finding::warn(format!("{name} gives no answer: {reason}"), "see the check ports")
}

/// Labels and values of a metric in the text format of Prometheus.
fn sample_lines<'m>(text: &'m str, metric: &'m str) -> impl Iterator<Item = (&'m str, f64)> {
    text.lines().filter_map(move |line| {
        let rest = line.strip_prefix(metric)?;
        let (labels, value) = match rest.strip_prefix('{') {
            Some(rest) => rest.rsplit_once('}')?,
            None if rest.starts_with(' ') => ("", rest),
            None => return None,
        };
        Some((labels, value.trim().parse().ok()?))
    })
}

/// Where a program that listens on all addresses is reached on this machine.
fn reachable(address: SocketAddr) -> SocketAddr {
    let ip = match address.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => IpAddr::V4(Ipv4Addr::LOCALHOST),
        IpAddr::V6(ip) if ip.is_unspecified() => IpAddr::V6(Ipv6Addr::LOCALHOST),
        ip => ip,
    };
    SocketAddr::new(ip, address.port())
}

fn answer_of(kind: Kind, answered: Result<Value, CliError>) -> Answer {
    match answered {
        // The main service has no identity; its readiness has no flow in it.
        Ok(value) if kind == Kind::Main || value.get("flow").or(value.get("layer")).is_some() => {
            Answer::Object(value)
        }
        Ok(_) => Answer::Foreign("its answer names no layer and node".to_owned()),
        Err(CliError::CannotConnect { reason, .. }) => Answer::Nobody(reason),
        Err(CliError::Refused { status: 503, detail, .. }) => Answer::Starting(detail),
        Err(error) => Answer::Foreign(words(&error)),
    }
}

/// The reason of a failure, without the advice about flows.
fn words(error: &CliError) -> String {
    match error {
        CliError::CannotConnect { reason, .. } | CliError::Answer { reason, .. } => reason.clone(),
        CliError::Refused { status, detail, .. } => format!("status {status} {detail}"),
        other => other.to_string(),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use serde_json::json;

    use super::*;

    /// A program that runs and answers this.
    pub(in crate::doctor) fn running(kind: Kind, value: Value, metrics: &str) -> Program {
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, 9101));
        Program { kind, address, answer: Answer::Object(value), metrics: metrics.to_owned() }
    }

    /// One that does not run.
    pub(in crate::doctor) fn absent(kind: Kind) -> Program {
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, 9101));
        let answer = Answer::Nobody("connection refused".to_owned());
        Program { kind, address, answer, metrics: String::new() }
    }

    #[test]
    fn metrics_are_read_by_name_and_label() {
        let text = "# TYPE blaze_build_info gauge\n\
                    blaze_build_info{program=\"blaze-flow\",version=\"0.1.0\"} 1\n\
                    blaze_flow_leases{kind=\"advertise\"} 3\n\
                    blaze_flow_leases{kind=\"request\"} 4\n\
                    blaze_flow_leases_more 9\nplain 2.5\n";
        let flow = running(Kind::Flow, json!({"flow": "edge/a"}), text);
        assert_eq!(flow.version(), Some("0.1.0"));
        assert_eq!(flow.sum("blaze_flow_leases", ""), 7.0);
        assert_eq!(flow.sum("blaze_flow_leases", "kind=\"request\""), 4.0);
        assert_eq!(flow.sum("plain", ""), 2.5);
    }

    #[test]
    fn a_program_is_known_by_what_it_answers() {
        let flow = running(Kind::Flow, json!({"flow": "edge/a"}), "");
        assert_eq!(flow.identity().as_deref(), Some("edge/a"));
        let worker = running(Kind::Worker, json!({"layer": "edge", "node": "b"}), "");
        assert_eq!(worker.identity().as_deref(), Some("edge/b"));
        let foreign = answer_of(Kind::Flow, Ok(json!({"hello": 1})));
        assert!(matches!(foreign, Answer::Foreign(_)));
        let refused = |status| CliError::Refused {
            address: String::new(),
            status,
            detail: "starting".to_owned(),
        };
        assert!(matches!(answer_of(Kind::Worker, Err(refused(503))), Answer::Starting(_)));
        assert!(matches!(answer_of(Kind::Worker, Err(refused(404))), Answer::Foreign(_)));
    }

    #[test]
    fn what_does_not_run_is_skipped_with_the_command_that_starts_it() {
        let found = absent(Kind::Worker).not_running("/etc/blaze/blaze.yaml");
        assert_eq!(found.result, super::super::check::Outcome::Skipped);
        assert_eq!(found.remedy, "blaze-worker --config /etc/blaze/blaze.yaml");
        assert!(found.detail.contains("admin.worker"), "{found:?}");
    }

    #[test]
    fn a_port_on_all_addresses_is_asked_on_loopback() {
        let asked = |text: &str| reachable(text.parse().unwrap()).to_string();
        assert_eq!(asked("0.0.0.0:1"), "127.0.0.1:1");
        assert_eq!(asked("[::]:1"), "[::1]:1");
        assert_eq!(asked("10.0.0.1:1"), "10.0.0.1:1");
    }
}
