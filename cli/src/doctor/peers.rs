//! `peers`.

use std::net::{Ipv4Addr, SocketAddr};

use serde_json::Value;
use tokio::net::lookup_host;

use super::Node;
use super::check::{Finding, named};
use super::programs::{Answer, Kind, Program, rows, text, unanswered};

/// An IPv4 address with or without a port.
pub(super) fn address(text: &str) -> Option<Ipv4Addr> {
    let bare = text.split_once(':').map_or(text, |(host, _)| host);
    bare.parse().ok()
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

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::check::{Check, Outcome};
    use super::super::programs::tests::{absent, running};
    use super::*;

    fn outcome(findings: &[Finding]) -> Outcome {
        Check::of("x", findings).result
    }

    fn seen(rows: &Value) -> Value {
        json!({"peers": rows, "link": {"endpoints": 1}, "gateway": {"gateways": []}})
    }

    #[test]
    fn each_configured_peer_has_to_be_up() {
        let configured = [Ipv4Addr::new(10, 0, 3, 1)];
        let judge = |rows: Value| judge_peers(&seen(&rows), &configured, 20, "blaze.yaml");
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
        assert_eq!(outcome(&judge_peers(&seen(&json!([])), &[], 20, "f")), Outcome::Skipped);
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
}
