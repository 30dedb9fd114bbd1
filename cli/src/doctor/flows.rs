//! What the running programs and the flow say: `versions`, `leases` and `budget`.

use std::collections::BTreeMap;

use serde_json::Value;

use super::Node;
use super::check::Finding;
use super::limits::LEASES_WARN;
use super::programs::{Kind, rows, text, unanswered};

/// `versions`: those of all programs that run here.
pub(super) fn versions(node: &Node) -> Vec<Finding> {
    let programs = [&node.flow, &node.worker, &node.monitor, &node.main];
    if programs.iter().all(|program| program.object().is_none()) {
        return vec![node.flow.not_running(&node.name)];
    }
    let mut versions = vec![("blaze", env!("CARGO_PKG_VERSION"))];
    let running = programs.iter().filter(|program| program.object().is_some());
    for program in running {
        if let Some(version) = program.version() {
            versions.push((program.kind.program(), version));
        }
    }
    vec![judge_versions(&versions)]
}

fn judge_versions(versions: &[(&str, &str)]) -> Finding {
    let mut by_version: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (program, version) in versions {
        by_version.entry(version).or_default().push(program);
    }
    let shown: Vec<String> = by_version
        .iter()
        .map(|(version, programs)| format!("{} {version}", programs.join(", ")))
        .collect();
    match by_version.len() {
        0 | 1 => Finding::ok(shown.join("; ")),
        _ => Finding::warn(
            format!("several versions: {}", shown.join("; ")),
            "install one version of all packages, then restart each of these programs: systemctl \
             restart blaze-flow blaze-worker blaze-monitor",
        ),
    }
}

/// `leases`: what the registry refused.
pub(super) fn leases(node: &Node) -> Vec<Finding> {
    let flow = &node.flow;
    if flow.object().is_none() {
        return vec![flow.not_running(&node.name)];
    }
    let event = |name: &str| flow.sum("blaze_flow_link_events_total", &format!("event=\"{name}\""));
    judge_leases(
        flow.sum("blaze_flow_leases", ""),
        event("control_message_refused"),
        event("kept_lease_skipped"),
        event("topic_not_announced"),
    )
}

fn judge_leases(held: f64, refused: f64, skipped: f64, left_out: f64) -> Vec<Finding> {
    let mut findings = vec![Finding::ok(format!("{held} leases"))];
    let topics = "blaze topics -o json";
    if held > LEASES_WARN {
        findings.push(Finding::warn(
            format!("{held} leases, and at 10000 services are refused"),
            format!("{topics} shows the service that makes names: stop it"),
        ));
    }
    if refused > 0.0 {
        findings.push(Finding::warn(
            format!("{refused} control messages were refused since the flow started"),
            "redis-cli subscribe blaze/flow/events shows lease_refused with service and code; \
             blaze why TOPIC shows it for a topic. The count ends with: systemctl restart \
             blaze-flow",
        ));
    }
    if skipped > 0.0 {
        findings.push(Finding::warn(
            format!("{skipped} kept leases could not be read"),
            "redis-cli del blaze:flow:leases: services make them anew within their ttl_s",
        ));
    }
    if left_out > 0.0 {
        findings.push(Finding::fail(
            format!("{left_out} topics are not announced: 12000 are the most"),
            format!("{topics} shows them: withdraw those that nobody needs"),
        ));
    }
    findings
}

/// `budget`: whether what is published fits the limits.
pub(super) async fn budget(node: &Node) -> Vec<Finding> {
    if node.flow.object().is_none() {
        return vec![node.flow.not_running(&node.name)];
    }
    match node.flow.get("/v1/allocation").await {
        Ok(answer) => judge_budget(&answer, &node.name),
        Err(reason) => vec![unanswered(Kind::Flow, &reason)],
    }
}

/// Bytes a second of a limit of 1 Mbit/s.
const BYTES_PER_MBIT: f64 = 131_072.0;

fn judge_budget(answer: &Value, file: &str) -> Vec<Finding> {
    let limit = answer["limit_mbps"].as_f64().unwrap_or_default();
    let links = rows(answer, "links");
    let load = |row: &Value| row["load_bytes_per_s"].as_f64().unwrap_or_default();
    // A tenth more, so that it fits, and at least more than now.
    let enough = |bytes: f64, now: f64| (bytes * 1.1 / BYTES_PER_MBIT).max(now * 1.1).ceil();
    let mut findings = Vec::new();
    let narrow = links.iter().filter(|row| row["feasible"] == false);
    for row in narrow {
        let layer = text(row, "layer");
        let now = row["limit_bytes_per_s"].as_f64().map_or(limit, |bytes| bytes / BYTES_PER_MBIT);
        let needed = enough(load(row), now);
        findings.push(Finding::fail(
            format!("the link to {layer} cannot carry what is published at its lowest rates"),
            format!(
                "set flow.bandwidth.links.{layer}.limit_mbps: {needed} in {file}, or publish less"
            ),
        ));
    }
    if answer["feasible"] == false && findings.is_empty() {
        let needed = enough(links.iter().map(load).sum(), limit);
        findings.push(Finding::fail(
            format!("{limit} Mbit/s do not carry what is published at its lowest rates"),
            format!("set flow.bandwidth.limit_mbps: {needed} in {file}, or publish less"),
        ));
    }
    if findings.is_empty() {
        findings.push(Finding::ok(format!("{limit} Mbit/s are enough")));
    }
    findings
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::check::{Check, Outcome};
    use super::*;

    fn outcome(findings: &[Finding]) -> Outcome {
        Check::of("x", findings).result
    }

    #[test]
    fn several_versions_are_named() {
        let same = judge_versions(&[("blaze", "0.1.0"), ("blaze-flow", "0.1.0")]);
        assert_eq!((same.result, same.detail.as_str()), (Outcome::Ok, "blaze, blaze-flow 0.1.0"));
        let mixed = judge_versions(&[("blaze", "0.2.0"), ("blaze-flow", "0.1.0")]);
        assert_eq!(mixed.result, Outcome::Warn);
        assert!(mixed.detail.contains("blaze-flow 0.1.0; blaze 0.2.0"), "{mixed:?}");
    }

    #[test]
    fn refused_leases_are_counted() {
        assert_eq!(outcome(&judge_leases(12.0, 0.0, 0.0, 0.0)), Outcome::Ok);
        assert_eq!(outcome(&judge_leases(9_500.0, 0.0, 0.0, 0.0)), Outcome::Warn);
        assert_eq!(outcome(&judge_leases(12.0, 3.0, 0.0, 0.0)), Outcome::Warn);
        assert_eq!(outcome(&judge_leases(12.0, 0.0, 1.0, 0.0)), Outcome::Warn);
        assert_eq!(outcome(&judge_leases(12.0, 0.0, 0.0, 5.0)), Outcome::Fail);
    }

    #[test]
    fn a_budget_that_is_too_small_says_how_much_is_needed() {
        let answer = |feasible: bool, link: bool, load: f64| {
            json!({"limit_mbps": 2.0, "feasible": feasible, "links": [
                {"layer": "cloud", "feasible": link, "limit_bytes_per_s": null,
                 "load_bytes_per_s": load}]})
        };
        assert_eq!(outcome(&judge_budget(&answer(true, true, 0.0), "f")), Outcome::Ok);
        let whole = judge_budget(&answer(false, true, 1_310_720.0), "blaze.yaml");
        assert_eq!(whole[0].result, Outcome::Fail);
        let set = "set flow.bandwidth.limit_mbps: 11 in blaze.yaml, or publish less";
        assert_eq!(whole[0].remedy, set);
        let link = judge_budget(&answer(false, false, 0.0), "f");
        assert_eq!(link.len(), 1);
        assert!(link[0].remedy.starts_with("set flow.bandwidth.links.cloud.limit_mbps: 3 in f"));
    }
}
