//! `blaze effective`.

use blaze_domain::{InstanceName, LayerName, NodeName, ServiceName};
use clap::Args;
use serde_json::Value;

use super::call::Call;
use super::client::Client;
use super::kinds::{BASE, key_of, name_of, parse_service};
use super::options::ServerOptions;
use super::text::{cell, compact, flag, joined, list, member, print, printable};
use super::yaml;
use crate::exit::{CliError, Exit};
use crate::output::{self, Align, Format, terminal_width};

/// Options of `blaze effective`.
#[derive(Debug, Args)]
pub struct EffectiveOptions {
    /// The service, or SERVICE/INSTANCE; without it the node's or layer's own configuration
    #[arg(value_name = "SERVICE", value_parser = parse_wanted,
        required_unless_present_any = ["node", "layer"])]
    pub wanted: Option<Wanted>,
    /// The instance of the service
    #[arg(long, value_name = "INSTANCE", requires = "wanted")]
    pub instance: Option<InstanceName>,
    /// As it is on this node; without --node and --layer where the instance is placed
    #[arg(long, value_name = "NODE", conflicts_with = "layer")]
    pub node: Option<NodeName>,
    /// As it is in this layer
    #[arg(long, value_name = "LAYER")]
    pub layer: Option<LayerName>,
    /// Where each value comes from, and what it overrides
    #[arg(long)]
    pub explain: bool,
    /// With the text of secrets; needs the role admin, and is written down
    #[arg(long)]
    pub reveal: bool,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// A service, perhaps with an instance.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Wanted {
    /// The service.
    pub service: ServiceName,
    /// The instance behind the slash.
    pub instance: Option<InstanceName>,
}

fn parse_wanted(text: &str) -> Result<Wanted, String> {
    let (service, instance) = match text.split_once('/') {
        Some((service, instance)) => {
            let name = instance.parse::<InstanceName>();
            (service, Some(name.map_err(|error| format!("instance {instance:?} {error}"))?))
        }
        None => (text, None),
    };
    Ok(Wanted { service: parse_service(service)?, instance })
}

/// Shows an effective configuration.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(options: &EffectiveOptions, format: Format) -> Result<Exit, CliError> {
    let client = Client::of(&options.server)?;
    let hint = "`blaze get services`, `get nodes` and `get layers` list what there is";
    let answer = client.send(&call(options)?).await;
    let answer = answer.map_err(|error| error.hinted("not_found", hint))?;
    print(&answer.body, format, text)
}

fn call(options: &EffectiveOptions) -> Result<Call, CliError> {
    let wanted = options.wanted.as_ref();
    let behind = wanted.and_then(|wanted| wanted.instance.as_ref());
    if behind.is_some() && options.instance.is_some() {
        return Err(CliError::Usage(
            "SERVICE/INSTANCE and --instance: give one of them".to_owned(),
        ));
    }
    Ok(Call::get(format!("{BASE}/effective"))
        .query_if("service", wanted.map(|wanted| wanted.service.as_str()))
        .query_if("instance", options.instance.as_ref().or(behind).map(InstanceName::as_str))
        .query_if("node", options.node.as_ref().map(NodeName::as_str))
        .query_if("layer", options.layer.as_ref().map(LayerName::as_str))
        .query_if("explain", options.explain.then_some("true"))
        .query_if("reveal", options.reveal.then_some("true")))
}

/// For people: for whom, then the configuration, or where each value comes from.
pub(super) fn text(answer: &Value) -> String {
    let mut text = format!("# {}\n", heading(answer));
    let config = answer.get("config").unwrap_or(&Value::Null);
    match answer.get("explain").and_then(Value::as_object) {
        Some(explain) => {
            let values: Vec<_> = explain.iter().collect();
            text.push_str(&output::table(
                &values,
                terminal_width(),
                &[
                    ("KEY", Align::Left, &|(path, _)| printable(path)),
                    ("VALUE", Align::Left, &|(path, entry)| match flag(entry, "removed") {
                        true => "(removed)".to_owned(),
                        false => config.pointer(path).map_or_else(|| "-".to_owned(), compact),
                    }),
                    ("FROM", Align::Left, &|(_, entry)| source(entry)),
                    ("OVERRIDES", Align::Left, &|(_, entry)| overridden(entry)),
                ],
            ));
        }
        None => text.push_str(&yaml::document(config)),
    }
    text
}

fn heading(answer: &Value) -> String {
    let mut text = member(answer, "service");
    let instance = member(answer, "instance");
    if !instance.is_empty() {
        text.push_str(&format!("/{instance}"));
    }
    for (name, word) in [("node", "on node"), ("layer", "in layer")] {
        let value = member(answer, name);
        if !value.is_empty() {
            let space = if text.is_empty() { "" } else { " " };
            text.push_str(&format!("{space}{word} {value}"));
        }
    }
    text.push_str(&format!(", revision {}", cell(answer.get("revision"))));
    let rollout = member(answer, "rollout");
    if !rollout.is_empty() {
        text.push_str(&format!(", with the roll-out {rollout}"));
    }
    text
}

fn overridden(entry: &Value) -> String {
    let part = |part: &Value| {
        let value = part.get("value").map(|value| format!("{} ", compact(value)));
        format!("{}of {}", value.unwrap_or_default(), source(part))
    };
    let parts: Vec<String> = list(entry, "overridden").iter().map(part).collect();
    joined(&parts, "; ")
}

/// `instance/slam/0 @88`, with a note where it comes from `overrides`.
fn source(part: &Value) -> String {
    let name = key_of(part).map_or_else(|_| cell(part.get("kind")), |key| name_of(&key));
    let overrides = if flag(part, "override") { " (overrides)" } else { "" };
    format!("{name} @{}{overrides}", cell(part.get("revision")))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn answer() -> Value {
        json!({"service": "slam", "instance": "0", "layer": "edge", "node": "robot-1",
            "revision": 412, "hash": "sha256:x",
            "rollout": null, "config": {"camera": {"rate_hz": 10}}})
    }

    #[test]
    fn a_configuration_is_yaml_under_a_heading() {
        assert_eq!(
            text(&answer()),
            "# slam/0 on node robot-1 in layer edge, revision 412\ncamera:\n  rate_hz: 10\n"
        );
        let layer = json!({
            "service": null,
            "layer": "edge",
            "revision": 3,
            "rollout": "slower",
            "config": {},
        });
        assert_eq!(text(&layer), "# in layer edge, revision 3, with the roll-out slower\n{}\n");
    }

    #[test]
    fn an_explanation_says_where_each_value_comes_from() {
        let mut answer = answer();
        answer["explain"] = json!({
            "/camera/rate_hz": {"kind": "Instance", "service": "slam", "name": "0", "revision": 88,
                "overridden": [{"kind": "Service", "name": "slam", "revision": 3, "value": 30}]},
            "/log": {
                "removed": true,
                "kind": "Layer",
                "name": "edge",
                "revision": 5,
                "override": true,
            },
        });
        let text = text(&answer);
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[2].contains(" 10 ") && lines[2].contains(" instance/slam/0 @88 "), "{text}");
        assert!(lines[2].ends_with(" 30 of service/slam @3"), "{text}");
        assert!(
            lines[3].contains("(removed)") && lines[3].contains("layer/edge @5 (overrides)"),
            "{text}"
        );
    }

    #[test]
    fn a_service_may_name_its_instance() {
        let wanted = parse_wanted("slam/0").unwrap();
        assert_eq!(wanted.instance.unwrap().as_str(), "0");
        assert!(parse_wanted("slam").unwrap().instance.is_none());
        assert!(parse_wanted("Slam").unwrap_err().contains("did you mean slam?"));
        assert!(parse_wanted("slam/A").is_err());
    }
}
