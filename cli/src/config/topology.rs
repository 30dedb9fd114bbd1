//! `blaze topology` and `blaze digest`: where everything runs, and what the worker of a layer
//! should hold.

use blaze_domain::LayerName;
use clap::Args;
use serde_json::Value;

use super::call::Call;
use super::client::Client;
use super::kinds::BASE;
use super::options::ServerOptions;
use super::text::{cell, joined, list, member, note, print};
use crate::exit::{CliError, Exit};
use crate::output::{self, Align, Format, terminal_width};

/// Options of `blaze digest`.
#[derive(Debug, Args)]
pub struct DigestOptions {
    /// The layer
    #[arg(value_name = "LAYER")]
    pub layer: LayerName,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Shows layers, their nodes, and what runs there.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(server: &ServerOptions, format: Format) -> Result<Exit, CliError> {
    let client = Client::of(server)?;
    let answer = client.send(&Call::get(format!("{BASE}/topology"))).await?.body;
    let layers = answer
        .get("layers")
        .and_then(Value::as_array)
        .ok_or_else(|| client.odd("the topology has no `layers`"))?;
    if layers.is_empty() && format == Format::Table {
        note(format, "there are no layers");
        return Ok(Exit::Done);
    }
    print(&answer, format, |answer| table(answer, terminal_width()))
}

/// Shows the digest of what a layer sees.
///
/// # Errors
/// [`CliError`].
pub(super) async fn digest(options: &DigestOptions, format: Format) -> Result<Exit, CliError> {
    let client = Client::of(&options.server)?;
    let call = Call::get(format!("{BASE}/digest")).query("layer", options.layer.as_str());
    let answer = client.send(&call).await?.body;
    if answer.get("digest").is_none_or(|digest| !digest.is_string()) {
        return Err(client.odd("the answer has no `digest`"));
    }
    print(&answer, format, |answer| {
        format!(
            "{}  layer/{} at revision {}\n",
            member(answer, "digest"),
            options.layer,
            cell(answer.get("revision"))
        )
    })
}

/// One line per node; below it the links between nodes, where some are known.
fn table(answer: &Value, width: Option<u16>) -> String {
    let mut nodes: Vec<(&Value, Option<&Value>)> = Vec::new();
    for layer in list(answer, "layers") {
        let of_layer = list(layer, "nodes");
        nodes.extend(of_layer.iter().map(|node| (layer, Some(node))));
        // A layer without nodes has a line, too.
        nodes.extend(of_layer.is_empty().then_some((layer, None)));
    }
    let at =
        |node: &Option<&Value>, pointer: &str| cell(node.and_then(|node| node.pointer(pointer)));
    let mut text = output::table(
        &nodes,
        width,
        &[
            ("LAYER", Align::Left, &|(layer, _)| cell(layer.get("name"))),
            ("KIND", Align::Left, &|(layer, _)| cell(layer.get("kind"))),
            ("NODE", Align::Left, &|(_, node)| at(node, "/name")),
            ("TYPE", Align::Left, &|(_, node)| at(node, "/type")),
            ("WORKER", Align::Left, &|(_, node)| {
                worker(node.and_then(|node| node.get("worker"))).to_owned()
            }),
            ("REVISION", Align::Right, &|(_, node)| at(node, "/worker/revision")),
            ("RUNS", Align::Left, &|(_, node)| runs(node.unwrap_or(&Value::Null))),
        ],
    );
    let links = list(answer, "links");
    if !links.is_empty() {
        text.push('\n');
        text.push_str(&output::table(
            links,
            width,
            &[
                ("FROM", Align::Left, &|link| cell(link.get("from_node"))),
                ("TO", Align::Left, &|link| cell(link.get("to_node"))),
                ("LATENCY MS", Align::Right, &|link| cell(link.get("latency_ms"))),
                ("LOSS", Align::Right, &|link| cell(link.get("loss"))),
            ],
        ));
    }
    text
}

fn worker(worker: Option<&Value>) -> &'static str {
    let flag = |name: &str| worker.and_then(|worker| worker.get(name)?.as_bool());
    match (flag("connected"), flag("in_sync")) {
        (Some(true), Some(true)) => "in sync",
        (Some(true), Some(false) | None) => "connected",
        (Some(false), _) => "away",
        (None, _) => "-",
    }
}

/// `slam/0, detector/0 (unhealthy)`: what runs on a node, with its state where that is known and
/// not `ready`.
fn runs(node: &Value) -> String {
    let services: Vec<String> = list(node, "services")
        .iter()
        .map(|service| {
            let name =
                format!("{}/{}", cell(service.get("service")), cell(service.get("instance")));
            match member(service, "state").as_str() {
                "" | "ready" => name,
                state => format!("{name} ({state})"),
            }
        })
        .collect();
    joined(&services, ", ")
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_topology_has_a_line_per_node() {
        let answer = json!({"revision": 6, "links": [], "layers": [
            {"name": "edge", "kind": "edge", "nodes": [
                {"name": "robot-1", "type": "mobile",
                    "worker": {"connected": true, "revision": 6, "in_sync": true,
                    "last_seen": null},
                 "services": [{"service": "slam", "instance": "0", "state": "ready"},
                     {"service": "log", "instance": "0", "state": "unhealthy"}]},
                {"name": "robot-2", "type": "static",
                    "worker": {"connected": null, "revision": null}, "services": []}]},
            {"name": "fog", "kind": "fog", "nodes": []}]});
        assert_eq!(
            table(&answer, None),
            "LAYER  KIND  NODE     TYPE    WORKER   REVISION  RUNS\n\
             edge   edge  robot-1  mobile  in sync         6  slam/0, log/0 (unhealthy)\n\
             edge   edge  robot-2  static  -               -  -\n\
             fog    fog   -        -       -               -  -\n"
        );
        let linked = json!({
            "layers": [],
            "links": [{"from_node": "a", "to_node": "b", "latency_ms": 1.5, "loss": null}],
        });
        assert!(
            table(&linked, None)
                .ends_with("\nFROM  TO  LATENCY MS  LOSS\na     b          1.5     -\n")
        );
    }

    #[test]
    fn what_is_missing_is_a_dash_and_never_a_failure() {
        for answer in
            [json!({}), json!({"layers": [7, {"nodes": [{}, 3]}], "links": [{}]}), json!([])]
        {
            let _ = table(&answer, Some(20));
        }
    }
}
