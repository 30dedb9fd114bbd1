//! `blaze describe`.

use blaze_domain::config::{Key, Kind};
use clap::Args;
use serde_json::{Value, json};

use super::api::clean;
use super::call::Call;
use super::client::Client;
use super::effective;
use super::history;
use super::kinds::{BASE, document_path, name_of};
use super::options::{DocumentOptions, ServerOptions};
use super::text::{age, cell, flag, list, member, now_ms, print, whole};
use super::yaml;
use crate::exit::{CliError, Exit};
use crate::output::{self, Align, Format, terminal_width};

/// Changes that are shown.
const CHANGES: u64 = 5;

/// Options of `blaze describe`.
#[derive(Debug, Args)]
pub struct DescribeOptions {
    /// Which document.
    #[command(flatten)]
    pub document: DocumentOptions,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Describes.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(options: &DescribeOptions, format: Format) -> Result<Exit, CliError> {
    let key = options.document.key()?;
    let client = Client::of(&options.server)?;
    let description = describe(&client, &key).await?;
    print(&description, format, |description| text(&key, description, now_ms()))
}

/// Everything about one document: `document`, `effective` (`null` for a roll-out), `workers` that
/// it concerns with `applied`, and the last changes as `history`.
async fn describe(client: &Client, key: &Key) -> Result<Value, CliError> {
    let document = client.document(key, None).await?.body;
    let call = Call::get(format!("{}/history", document_path(key)));
    let history = client.pages(&call, Some(CHANGES)).await?.items;
    let effective = match effective_call(key) {
        Some(call) => unless_hidden(client.send(&call).await)?.map(|answer| answer.body),
        None => None,
    };
    let workers = unless_hidden(client.workers().await)?.unwrap_or(Value::Null);
    Ok(json!({
        "document": document,
        "effective": effective,
        "workers": concerned(key, &document, effective.as_ref(), &workers),
        "history": history,
    }))
}

/// What a token does not show is left out: the rest is still of use.
fn unless_hidden<T>(answer: Result<T, CliError>) -> Result<Option<T>, CliError> {
    match answer {
        Ok(answer) => Ok(Some(answer)),
        Err(CliError::Problem(refusal)) if matches!(refusal.status, 403 | 404) => Ok(None),
        Err(error) => Err(error),
    }
}

fn effective_call(key: &Key) -> Option<Call> {
    let call = Call::get(format!("{BASE}/effective"));
    let name = key.name().as_str();
    match (key.kind(), key.service_name()) {
        (Kind::Layer, _) => Some(call.query("layer", name)),
        (Kind::Node, _) => Some(call.query("node", name)),
        (Kind::Service, _) => Some(call.query("service", name)),
        (Kind::Instance, Some(service)) => {
            Some(call.query("service", service.as_str()).query("instance", name))
        }
        (Kind::Instance, None) | (Kind::Rollout, _) => None,
    }
}

/// The workers of the layers that a document concerns, each with whether it has the document as it
/// is now.
fn concerned(
    key: &Key,
    document: &Value,
    effective: Option<&Value>,
    workers: &Value,
) -> Vec<Value> {
    let revision = whole(document, "revision");
    let text = |pointer: &str| document.pointer(pointer).and_then(Value::as_str);
    let one: Option<&str> = match key.kind() {
        Kind::Layer => Some(key.name().as_str()),
        Kind::Node => text("/spec/layer"),
        // The effective configuration knows the layer of the node that it is placed on.
        Kind::Instance => text("/spec/layer").or_else(|| effective?.get("layer")?.as_str()),
        Kind::Service | Kind::Rollout => None,
    };
    let listed = document.pointer("/spec/layers").and_then(Value::as_array);
    let is_concerned = |layer: &str| match (one, listed) {
        (Some(one), _) => one == layer,
        (None, Some(listed)) => listed.iter().any(|known| known.as_str() == Some(layer)),
        (None, None) => true,
    };
    let workers = list(workers, "items").iter();
    let concerned = workers.filter(|worker| is_concerned(&member(worker, "layer")));
    concerned
        .map(|worker| {
            let mut worker = worker.clone();
            let has = whole(&worker, "revision") >= revision;
            if let Some(members) = worker.as_object_mut() {
                members.insert("applied".to_owned(), has.into());
            }
            worker
        })
        .collect()
}

fn text(key: &Key, description: &Value, now_ms: i64) -> String {
    let null = Value::Null;
    let part = |name: &str| description.get(name).unwrap_or(&null);
    let entries = |name: &str| list(description, name);
    let document = part("document");
    let mut out = format!(
        "{}, revision {}, changed {} ago by {}, made {} ago\n\n",
        name_of(key),
        cell(document.get("revision")),
        age(document.get("update_time"), now_ms),
        cell(document.get("updated_by")),
        age(document.get("create_time"), now_ms),
    );
    out.push_str(&yaml::document(&clean(document.clone())));
    if let Some(status) = document.get("status").filter(|status| !status.is_null()) {
        out.push_str("\nStatus\n");
        out.push_str(&yaml::document(status));
    }
    if !part("effective").is_null() {
        out.push_str("\nEffective configuration\n");
        out.push_str(&effective::text(part("effective")));
    }
    if !entries("workers").is_empty() {
        out.push_str("\nWorkers\n");
        out.push_str(&workers_table(entries("workers"), terminal_width()));
    }
    out.push_str("\nLast changes\n");
    out.push_str(&history::table(entries("history"), now_ms, terminal_width()));
    out
}

fn workers_table(workers: &[Value], width: Option<u16>) -> String {
    let yes =
        |worker: &Value, name: &str| (if flag(worker, name) { "yes" } else { "no" }).to_owned();
    output::table(
        workers,
        width,
        &[
            ("WORKER", Align::Left, &|worker| {
                format!("{}/{}", member(worker, "layer"), cell(worker.get("node")))
            }),
            ("CONNECTED", Align::Left, &|worker| yes(worker, "connected")),
            ("REVISION", Align::Right, &|worker| cell(worker.get("revision"))),
            ("HAS IT", Align::Left, &|worker| yes(worker, "applied")),
        ],
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::kinds::parse_key;
    use crate::config::stub::{Asked, Reply, Stub};

    fn node() -> Value {
        json!({"kind": "Node", "name": "robot-1", "labels": {}, "annotations": {},
            "spec": {"layer": "edge"}, "uid": "u",
            "revision": 412, "create_time": "2026-11-21T06:01:12.345Z",
            "update_time": "2026-11-21T07:00:12.345Z",
            "updated_by": "ops"})
    }

    #[tokio::test]
    async fn everything_about_a_document_is_asked_for() {
        let stub = Stub::start(|asked: &Asked, _| match asked.target.as_str() {
            "/api/v1/nodes/robot-1" => Reply::json(&node()),
            "/api/v1/nodes/robot-1/history?limit=5" => {
                Reply::json(&json!({"items": [{"revision": 412, "op": "update"}],
                "revision": 412, "next_page_token": ""}))
            }
            "/api/v1/effective?node=robot-1" => Reply::json(
                &json!({"layer": "edge", "node": "robot-1", "revision": 412, "config": {}}),
            ),
            "/api/v1/workers" => Reply::json(&json!({"items": [
                {"layer": "edge", "node": "robot-1", "connected": true, "revision": 412},
                {"layer": "edge", "node": "robot-2", "connected": true, "revision": 411},
                {"layer": "fog", "node": null, "connected": true, "revision": 412}]})),
            other => panic!("{other}"),
        })
        .await;
        let key = parse_key(Kind::Node, "robot-1").unwrap();
        let description = describe(&stub.client(), &key).await.unwrap();
        let applied: Vec<&Value> =
            description["workers"].as_array().unwrap().iter().map(|w| &w["applied"]).collect();
        assert_eq!(applied, [&json!(true), &json!(false)]);
        let text = text(&key, &description, 1_795_244_472_345);
        for part in [
            "node/robot-1, revision 412, changed 1m ago by ops, made 1h ago\n",
            "\nspec:\n  layer: edge\n",
            "\nEffective configuration\n# on node robot-1 in layer edge, revision 412\n{}\n",
            "\nWorkers\nWORKER",
            "\nLast changes\nREVISION",
        ] {
            assert!(text.contains(part), "{part:?} in {text}");
        }
    }

    #[tokio::test]
    async fn what_a_token_may_not_see_is_left_out() {
        let stub = Stub::start(|asked: &Asked, _| match asked.target.as_str() {
            "/api/v1/nodes/robot-1" => Reply::json(&node()),
            target if target.contains("history") => {
                Reply::json(&json!({"items": [], "next_page_token": ""}))
            }
            _ => Reply::problem(403, "permission_denied", "no"),
        })
        .await;
        let key = parse_key(Kind::Node, "robot-1").unwrap();
        let description = describe(&stub.client(), &key).await.unwrap();
        assert_eq!(
            (&description["effective"], &description["workers"]),
            (&Value::Null, &json!([]))
        );
        assert!(!text(&key, &description, 0).contains("Effective"));
    }
}
