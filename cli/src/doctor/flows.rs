//! What the running programs say: `peers`, `versions`, `leases`, `budget`, `config_sync` and
//! `collectors`.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr};

use serde_json::Value;
use tokio::net::lookup_host;

use super::Node;
use super::check::{Finding, named};
use super::limits::LEASES_WARN;
use super::programs::{Answer, Kind, Program};

/// An IPv4 address with or without a port.
pub(super) fn address(text: &str) -> Option<Ipv4Addr> {
    let bare = text.split_once(':').map_or(text, |(host, _)| host);
    bare.parse().ok()
}

fn rows<'v>(value: &'v Value, name: &str) -> &'v [Value] {
    value[name].as_array().map_or(&[][..], Vec::as_slice)
}

fn text<'v>(value: &'v Value, name: &str) -> &'v str {
    value[name].as_str().unwrap_or_default()
}

fn unanswered(program: Kind, reason: &str) -> Finding {
    let name = program.program();
    Finding::warn(format!("{name} gives no answer: {reason}"), "see the check ports")
}

/// `peers`: every flow that the file names, and those of `monitor.flows`.
pub(super) async fn peers(node: &Node) -> Vec<Finding> {
    let mut findings = named_flows(node).await;
    let Some(inter) = &node.file.brokers.inter else {
        findings.push(Finding::skipped(
            "the node file has no brokers.inter: the flow has no peers",
            format!("nothing to do; to reach other layers set brokers.inter.dds in {}", node.name),
        ));
        return findings;
    };
    if node.flow.object().is_none() {
        findings.push(node.flow.not_running(&node.name));
        return findings;
    }
    let configured: Vec<Ipv4Addr> =
        inter.peers.iter().copied().filter(|peer| *peer != inter.listen).collect();
    match node.flow.get("/v1/peers").await {
        Ok(answer) => findings.extend(judge_peers(&answer, &configured, inter.domain, &node.name)),
        Err(reason) => findings.push(unanswered(Kind::Flow, &reason)),
    }
    findings
}

/// Flows that the file says the monitor has to find.
async fn named_flows(node: &Node) -> Vec<Finding> {
    let asked = node.file.monitor.flows.iter().map(|flow| async move {
        let found: Vec<SocketAddr> = match lookup_host(flow.as_str()).await {
            Ok(found) => found.collect(),
            Err(error) => {
                let remedy = format!("correct monitor.flows in {}", node.name);
                return vec![Finding::fail(format!("monitor.flows {flow}: {error}"), remedy)];
            }
        };
        let all = found.iter().map(|address| Program::ask(Kind::Flow, *address));
        let all = futures::future::join_all(all).await;
        all.iter().map(|program| judge_named(flow, program, &node.name)).collect()
    });
    futures::future::join_all(asked).await.concat()
}

fn judge_named(flow: &str, program: &Program, file: &str) -> Finding {
    let address = program.address;
    match &program.answer {
        Answer::Object(_) => {
            Finding::ok(format!("{} at {flow}", program.identity().unwrap_or_default()))
        }
        Answer::Starting(detail) => Finding::warn(
            format!("monitor.flows {flow}: the flow at {address} is starting: {detail}"),
            format!("wait for it: curl -s http://{address}/readyz"),
        ),
        Answer::Nobody(reason) | Answer::Foreign(reason) => Finding::fail(
            format!("monitor.flows names {flow}, and no flow answers at {address}: {reason}"),
            format!("start blaze-flow there, or take {flow} out of monitor.flows in {file}"),
        ),
    }
}

fn judge_peers(answer: &Value, configured: &[Ipv4Addr], domain: u16, file: &str) -> Vec<Finding> {
    if answer["link"].is_null() {
        let gateways = rows(&answer["gateway"], "gateways");
        let gateways: Vec<String> =
            gateways.iter().filter_map(Value::as_str).map(str::to_owned).collect();
        return vec![match gateways.is_empty() {
            false => Finding::ok(format!("other layers are reached over {}", named(&gateways))),
            true => Finding::fail(
                "the flow is not on the inter scope, and no gateway of its layer lives",
                format!("set flow.gateway: auto in {file}, then restart blaze-flow"),
            ),
        }];
    }
    let seen = rows(answer, "peers");
    let mut findings: Vec<Finding> = seen.iter().map(|row| judge_peer(row, domain)).collect();
    let known: Vec<Option<Ipv4Addr>> =
        seen.iter().map(|row| row["address"].as_str().and_then(address)).collect();
    let is_certain = known.iter().all(Option::is_some);
    let missing = configured.iter().filter(|peer| !known.contains(&Some(**peer)));
    for peer in missing {
        let detail = format!("no flow is seen at {peer} (brokers.inter.dds.peers)");
        let remedy = remedy_of(&peer.to_string(), domain);
        findings.push(match (is_certain, seen.is_empty()) {
            (true, _) | (_, true) => Finding::fail(detail, remedy),
            // Which of those that are seen it is, nobody says.
            (false, false) => Finding::ok(format!("{} flows are seen", seen.len())),
        });
    }
    if findings.is_empty() {
        findings.push(Finding::skipped(
            "no peers are configured, and none is seen",
            format!("set brokers.inter.dds.peers: [ADDRESS] in {file}"),
        ));
    }
    findings
}

fn judge_peer(row: &Value, domain: u16) -> Finding {
    let (flow, state) = (text(row, "flow"), text(row, "state"));
    let place = row["address"].as_str().unwrap_or(flow);
    match state {
        "up" => Finding::ok(format!("{flow} up")),
        "suspect" => Finding::warn(
            format!("{flow} is suspect: it does not acknowledge"),
            format!("ping -c 5 {place}; where packets are lost, lower flow.bandwidth.limit_mbps"),
        ),
        _ => Finding::fail(format!("{flow} is {state}"), remedy_of(place, domain)),
    }
}

fn remedy_of(place: &str, domain: u16) -> String {
    let first = blaze_brokers::dds::announcement_port(domain, 0);
    let last = blaze_brokers::dds::announcement_port(domain, 3) + 1;
    format!(
        "systemctl start blaze-flow on {place}, with brokers.inter.dds.domain: {domain}; let UDP \
         pass both ways: nft insert rule inet filter input udp dport {first}-{last} accept"
    )
}

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
    use serde_json::json;

    use super::super::check::{Check, Outcome};
    use super::super::programs::tests::{absent, running};
    use super::*;

    fn outcome(findings: &[Finding]) -> Outcome {
        Check::of("x", findings).result
    }

    fn seen(rows: Value) -> Value {
        json!({"peers": rows, "link": {"endpoints": 1}, "gateway": {"gateways": []}})
    }

    #[test]
    fn each_configured_peer_has_to_be_up() {
        let configured = [Ipv4Addr::new(10, 0, 3, 1)];
        let judge = |rows: Value| judge_peers(&seen(rows), &configured, 20, "blaze.yaml");
        let row =
            |state, address: &str| json!([{"flow": "fog/a", "state": state, "address": address}]);
        assert_eq!(outcome(&judge(row("up", "10.0.3.1"))), Outcome::Ok);
        assert_eq!(outcome(&judge(row("up", "10.0.3.1:12410"))), Outcome::Ok);
        assert_eq!(outcome(&judge(row("suspect", "10.0.3.1"))), Outcome::Warn);
        assert_eq!(outcome(&judge(row("down", "10.0.3.1"))), Outcome::Fail);
        // Another flow is up, not the one that is named.
        let other = judge(row("up", "10.0.4.1"));
        assert_eq!(outcome(&other), Outcome::Fail);
        let none = Check::of("peers", &judge(json!([])));
        assert!(none.detail.contains("10.0.3.1") && none.remedy.contains("dport 12410-12417"));
        // Without addresses nobody can tell.
        let unknown = json!([{"flow": "fog/a", "state": "up", "address": null}]);
        assert_eq!(outcome(&judge(unknown)), Outcome::Ok);
        assert_eq!(outcome(&judge_peers(&seen(json!([])), &[], 20, "f")), Outcome::Skipped);
    }

    #[test]
    fn a_member_of_a_group_needs_a_gateway() {
        let judge = |gateways: Value| {
            let answer = json!({"peers": [], "link": null, "gateway": {"gateways": gateways}});
            judge_peers(&answer, &[Ipv4Addr::LOCALHOST], 20, "f")
        };
        assert_eq!(outcome(&judge(json!(["edge/b"]))), Outcome::Ok);
        assert_eq!(outcome(&judge(json!([]))), Outcome::Fail);
    }

    #[test]
    fn a_flow_that_the_file_names_must_answer() {
        let found = judge_named("h:1", &absent(Kind::Flow), "blaze.yaml");
        assert_eq!(found.result, Outcome::Fail);
        assert!(found.remedy.contains("monitor.flows in blaze.yaml"), "{found:?}");
        let up = running(Kind::Flow, json!({"flow": "edge/a"}), "");
        assert_eq!(judge_named("h:1", &up, "f").result, Outcome::Ok);
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
