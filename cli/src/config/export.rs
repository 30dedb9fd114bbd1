//! `blaze export`: all documents in a form that `apply` takes.

use std::collections::BTreeMap;

use blaze_domain::LayerName;
use blaze_domain::config::placement::placement;
use blaze_domain::config::state::State;
use blaze_domain::config::{Document, Key, Kind};
use clap::Args;
use serde_json::Value;

use super::api::{Filter, clean};
use super::client::Client;
use super::kinds::{document_of, key_of};
use super::options::ServerOptions;
use super::stream::changes_between;
use super::text::json_pretty;
use super::yaml;
use crate::exit::{CliError, Exit};
use crate::output::{self, Format};

/// How often all is read again when the history is trimmed meanwhile.
const TRIES: usize = 5;
/// What is exported.
const KINDS: [Kind; 4] = [Kind::Layer, Kind::Node, Kind::Service, Kind::Instance];

/// Options of `blaze export`.
#[derive(Debug, Args)]
pub struct ExportOptions {
    /// Only what a worker of this layer needs: the layer, its nodes, the services that it may see,
    /// and their instances there
    #[arg(long, value_name = "LAYER")]
    pub layer: Option<LayerName>,
    /// With roll-outs. Applied elsewhere, they begin there
    #[arg(long)]
    pub rollouts: bool,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Exports. Secrets stay redacted, which keeps the stored text where it is applied again.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(options: &ExportOptions, format: Format) -> Result<Exit, CliError> {
    let client = Client::of(&options.server)?;
    if let Some(layer) = &options.layer {
        // A layer that does not exist is no empty one.
        client.document(&Key::layer(layer), None).await?;
    }
    let (mut all, revision) = read(&client, options.rollouts).await?;
    if let Some(layer) = &options.layer {
        all = seen_by(layer, all);
    }
    let documents: Vec<Value> = all.into_values().map(clean).collect();
    output::print(&match format {
        Format::Table | Format::Yaml => {
            format!("# {}, revision {revision}\n{}", client.server(), yaml::documents(&documents))
        }
        Format::Json => json_pretty(&documents)?,
    })?;
    Ok(Exit::Done)
}

/// All documents as they were at one revision. The lists of the kinds come one after the other;
/// what was written between them is taken from the watch.
async fn read(client: &Client, rollouts: bool) -> Result<(BTreeMap<Key, Value>, u64), CliError> {
    for _ in 0..TRIES {
        let mut all = BTreeMap::new();
        let mut listed = BTreeMap::new();
        for kind in KINDS.into_iter().chain(rollouts.then_some(Kind::Rollout)) {
            let listing = client.list(kind, &Filter::default()).await?;
            let revision = listing.revision.ok_or_else(|| client.odd("a list has no revision"))?;
            listed.insert(kind, revision);
            for document in listing.items {
                let key = key_of(&document)
                    .map_err(|reason| client.odd(format!("a document {reason}")))?;
                all.insert(key, document);
            }
        }
        if let Some(revision) = catch_up(client, &mut all, &listed).await? {
            return Ok((all, revision));
        }
    }
    Err(CliError::Failed(format!(
        "the history was trimmed away while the configuration was read, {TRIES} times; try again"
    )))
}

/// Brings lists to the newest of their revisions, and says which that is; `None` where the history
/// does not reach back.
async fn catch_up(
    client: &Client,
    all: &mut BTreeMap<Key, Value>,
    listed: &BTreeMap<Kind, u64>,
) -> Result<Option<u64>, CliError> {
    let oldest = listed.values().copied().min().unwrap_or(0);
    let newest = listed.values().copied().max().unwrap_or(0);
    if oldest == newest {
        return Ok(Some(newest));
    }
    let is_told = changes_between(client, oldest, newest, |revision, change| {
        let key = key_of(change).map_err(|reason| client.odd(format!("a change {reason}")))?;
        if listed.get(&key.kind()).is_some_and(|list| revision > *list) {
            put(all, key, change);
        }
        Ok(())
    });
    Ok(is_told.await?.then_some(newest))
}

fn put(all: &mut BTreeMap<Key, Value>, key: Key, change: &Value) {
    match (change.get("op").and_then(Value::as_str), change.get("document")) {
        (Some("create" | "update"), Some(document)) => {
            all.insert(key, document.clone());
        }
        _ => {
            all.remove(&key);
        }
    }
}

/// What a worker of one layer holds: the rule of its digest.
fn seen_by(layer: &LayerName, mut all: BTreeMap<Key, Value>) -> BTreeMap<Key, Value> {
    let state = State::new(0, all.values().filter_map(|value| document_of(value).ok()));
    let sees = |document: &Document| placement(&state, document).visible.contains(layer);
    all.retain(|key, _| state.get(key).is_some_and(|held| sees(&held.document)));
    all
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::config::kinds::name_of;
    use crate::config::stub::{Asked, Reply, Stub};

    fn all() -> BTreeMap<Key, Value> {
        let documents = [
            json!({"kind": "Layer", "name": "edge", "spec": {"kind": "edge"}}),
            json!({"kind": "Layer", "name": "fog", "spec": {"kind": "fog"}}),
            json!({"kind": "Node", "name": "robot-1", "spec": {"layer": "edge"}}),
            json!({"kind": "Node", "name": "fog-1", "spec": {"layer": "fog"}}),
            json!({"kind": "Service", "name": "slam", "spec": {"layers": ["edge"]}}),
            json!({"kind": "Service", "name": "log", "spec": {}}),
            json!({"kind": "Service", "name": "map", "spec": {"layers": ["fog"]}}),
            json!({
                "kind": "Instance",
                "service": "slam",
                "name": "0",
                "spec": {"node": "robot-1"},
            }),
            json!({"kind": "Instance", "service": "log", "name": "0", "spec": {"node": "fog-1"}}),
            json!({"kind": "Instance", "service": "log", "name": "1", "spec": {"layer": "edge"}}),
            json!({"kind": "Instance", "service": "log", "name": "2", "spec": {}}),
            json!({"kind": "Instance", "service": "map", "name": "0", "spec": {}}),
            json!({
                "kind": "Rollout",
                "name": "a",
                "spec": {"target": {"kind": "Instance", "service": "log", "name": "1"}},
            }),
            json!({
                "kind": "Rollout",
                "name": "b",
                "spec": {"target": {"kind": "Instance", "service": "log", "name": "0"}},
            }),
            json!({
                "kind": "Rollout",
                "name": "c",
                "spec": {"target": {"kind": "Rollout", "name": "c"}},
            }),
        ];
        documents.into_iter().map(|document| (key_of(&document).unwrap(), document)).collect()
    }

    #[test]
    fn a_layer_gets_what_it_may_see() {
        let seen = seen_by(&"edge".parse().unwrap(), all());
        let seen: Vec<String> = seen.keys().map(name_of).collect();
        assert_eq!(
            seen,
            [
                "layer/edge",
                "node/robot-1",
                "service/log",
                "service/slam",
                "instance/log/1",
                "instance/log/2",
                "instance/slam/0",
                "rollout/a"
            ]
        );
    }

    fn list(items: &Value, revision: u64) -> Reply {
        Reply::json(&json!({"items": items, "revision": revision, "next_page_token": ""}))
    }

    #[tokio::test]
    async fn what_is_written_between_the_lists_is_in_the_export_whole() {
        let node = |name: &str, revision: u64| {
            json!({
                "kind": "Node",
                "name": name,
                "spec": {},
                "revision": revision,
            })
        };
        let stub = Stub::start(move |asked: &Asked, _| {
            // Layers are listed at 410; nodes and the rest at 412: commit 411 made a layer and
            // changed a node, 412 deleted a layer, 413 is later.
            let change = |op: &str, kind: &str, name: &str| {
                json!({
                    "op": op,
                    "kind": kind,
                    "name": name,
                    "document": {"kind": kind, "name": name, "spec": {}},
                })
            };
            let event = |revision: u64, changes: Value| {
                let data = json!({"revision": revision, "changes": changes});
                format!("id: {revision}\nevent: change\ndata: {data}\n\n")
            };
            match asked.target.as_str() {
                target if target.starts_with("/api/v1/layers") => {
                    list(&json!([{"kind": "Layer", "name": "old", "spec": {}}]), 410)
                }
                target if target.starts_with("/api/v1/nodes") => {
                    list(&json!([node("a", 411)]), 412)
                }
                "/api/v1/watch?since=410" => Reply::Events(format!(
                    "{}{}{}",
                    event(
                        411,
                        json!([change("create", "Layer", "new"), change("update", "Node", "a")]),
                    ),
                    event(412, json!([change("delete", "Layer", "old")])),
                    event(413, json!([change("create", "Layer", "later")])),
                )),
                _ => list(&json!([]), 412),
            }
        })
        .await;
        let (all, revision) = read(&stub.client(), false).await.unwrap();
        assert_eq!(revision, 412);
        let names: Vec<String> = all.keys().map(name_of).collect();
        assert_eq!(names, ["layer/new", "node/a"]);
        // The node was listed after its change: it is as the list showed it.
        assert_eq!(all.values().nth(1).unwrap()["revision"], 411);
    }

    #[tokio::test]
    async fn a_quiet_store_needs_no_watch_and_a_trimmed_one_is_read_again() {
        let quiet = Stub::start(|_, _| list(&json!([]), 7)).await;
        assert_eq!(read(&quiet.client(), true).await.unwrap().1, 7);
        assert_eq!(quiet.asked().len(), 5);
        let busy = Stub::start(|asked: &Asked, before| {
            if asked.target.starts_with("/api/v1/watch") {
                return Reply::problem(410, "revision_trimmed", "gone");
            }
            list(&json!([]), before as u64)
        })
        .await;
        let error = read(&busy.client(), false).await.unwrap_err();
        assert!(error.to_string().contains("trimmed away"), "{error}");
        assert_eq!(busy.asked().len(), 5 * TRIES);
    }
}
