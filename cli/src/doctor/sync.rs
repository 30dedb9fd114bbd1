//! What worker and monitor say: `config_sync` and `collectors`.

use std::net::SocketAddr;

use serde_json::Value;

use super::Node;
use super::check::{Finding, named};
use super::programs::{Answer, rows, text};

/// `config_sync`: whether the worker serves the newest configuration, and services have it.
pub(super) fn config_sync(node: &Node) -> Vec<Finding> {
    let worker = &node.worker;
    match (worker.object(), &node.file.config) {
        (Some(status), config) => judge_sync(status, config.is_some(), worker.address),
        (None, None) if matches!(worker.answer, Answer::Nobody(_)) => vec![Finding::skipped(
            "the node file has no config: this node takes no configuration from a main service",
            format!("nothing to do; for a worker set config.server in {}", node.name),
        )],
        (None, _) => vec![worker.not_running(&node.name)],
    }
}

fn judge_sync(status: &Value, has_main: bool, worker: SocketAddr) -> Vec<Finding> {
    let revision = status["revision"].as_u64().unwrap_or_default();
    let source = text(status, "source");
    let reason = match text(status, "reason") {
        "" => "not connected yet",
        reason => reason,
    };
    let mut findings = Vec::new();
    let is_connected = status["connected"] == true;
    let advice = "blaze workers, and curl -s http://MAIN_SERVICE:9104/readyz there; the address is \
                  config.server, the token config.token_file";
    match (is_connected, has_main, source) {
        (true, ..) => findings.push(Finding::ok(format!("connected, revision {revision}"))),
        (false, false, _) => {
            findings.push(Finding::ok(format!("no main service, revision {revision}")));
        }
        (false, true, "") => findings.push(Finding::fail(
            format!("no main service and nothing to serve: {reason}"),
            format!("{advice}; until then set worker.defaults_file"),
        )),
        (false, true, _) => findings.push(Finding::warn(
            format!("no main service, revision {revision} is served from {source}: {reason}"),
            advice,
        )),
    }
    let behind = rows(status, "services").iter().filter(|row| {
        let (sent, used) = (text(row, "hash"), text(row, "config_hash"));
        !sent.is_empty() && !used.is_empty() && sent != used
    });
    let behind: Vec<String> = behind
        .map(|row| match text(row, "instance") {
            "" => text(row, "service").to_owned(),
            instance => format!("{}/{instance}", text(row, "service")),
        })
        .collect();
    if let Some(first) = behind.first() {
        findings.push(Finding::warn(
            format!("other than the newest configuration is used by {}", named(&behind)),
            format!("blaze effective {first} --explain; restart it where it does not follow"),
        ));
    }
    if status["leader"] == false {
        findings.push(Finding::ok(format!("another worker of the layer leads, {worker} follows")));
    }
    findings
}

/// `collectors`: what the monitor cannot read.
pub(super) fn collectors(node: &Node) -> Vec<Finding> {
    match node.monitor.object() {
        Some(answer) => judge_collectors(answer),
        None => vec![node.monitor.not_running(&node.name)],
    }
}

fn judge_collectors(answer: &Value) -> Vec<Finding> {
    let all = rows(answer, "collectors");
    let failed = all.iter().filter(|row| row["up"] == false);
    let mut findings: Vec<Finding> = failed
        .map(|row| {
            let (name, detail) = (text(row, "collector"), text(row, "detail"));
            let remedy = match detail.to_ascii_lowercase().contains("permission") {
                true => {
                    "usermod -aG video,render blaze; chmod a+r the file that it names; then \
                         systemctl restart blaze-monitor"
                }
                false => "repair what it names, then systemctl restart blaze-monitor",
            };
            Finding::warn(format!("{name}: {detail}"), remedy)
        })
        .collect();
    if findings.is_empty() {
        findings.push(Finding::ok(format!("{} collectors", all.len())));
    }
    findings
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use serde_json::json;

    use super::super::check::{Check, Outcome};
    use super::*;

    fn outcome(findings: &[Finding]) -> Outcome {
        Check::of("x", findings).result
    }

    #[test]
    fn a_worker_without_a_main_service_serves_or_not() {
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, 9102));
        let status = |connected: bool, source: Value| {
            json!({"connected": connected, "source": source, "revision": 7, "leader": true,
                   "reason": "no connection", "services": [
                    {"service": "slam", "instance": "0", "hash": "a", "config_hash": "a"}]})
        };
        let judge = |status: &Value, main| outcome(&judge_sync(status, main, address));
        assert_eq!(judge(&status(true, json!("main")), true), Outcome::Ok);
        assert_eq!(judge(&status(false, json!("file")), false), Outcome::Ok);
        assert_eq!(judge(&status(false, json!("copy")), true), Outcome::Warn);
        assert_eq!(judge(&status(false, Value::Null), true), Outcome::Fail);
        let mut behind = status(true, json!("main"));
        behind["services"][0]["config_hash"] = json!("b");
        let check = Check::of("config_sync", &judge_sync(&behind, true, address));
        assert_eq!(check.result, Outcome::Warn);
        assert!(check.detail.contains("slam/0") && check.remedy.contains("effective slam/0"));
    }

    #[test]
    fn collectors_that_cannot_read_are_named() {
        let up = json!({"collectors": [{"collector": "gpu", "up": true, "detail": ""}]});
        assert_eq!(outcome(&judge_collectors(&up)), Outcome::Ok);
        let down = json!({"collectors": [
            {"collector": "gpu", "up": false, "detail": "/dev/nvidia0: Permission denied"}]});
        let found = judge_collectors(&down);
        assert_eq!(found[0].result, Outcome::Warn);
        assert!(found[0].remedy.starts_with("usermod"), "{found:?}");
    }
}
