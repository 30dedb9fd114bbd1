//! What `--cascade` takes along.
//!
//! ```text
//! before: all documents ─► what refers to it, and what to that, … ─► the question
//! after:  revision of the deletion ─► watch from just before it ─► that commit ─► what went
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use blaze_domain::config::placement::is_active;
use blaze_domain::config::spec::references;
use blaze_domain::config::{Document, Key, Kind};
use tokio::time::timeout;

use super::api::Filter;
use super::client::Client;
use super::kinds::{document_of, key_of};
use super::stream::changes_between;
use super::text::member;
use crate::exit::CliError;

/// How long the commit of a deletion is waited for. It is written already.
const LONGEST: Duration = Duration::from_secs(10);

/// What refers to some documents now, and what to that in turn, in the order of kinds and names.
///
/// # Errors
/// As [`Client::list`].
pub(super) async fn referrers(client: &Client, roots: &[Key]) -> Result<Vec<Key>, CliError> {
    let mut documents = Vec::new();
    for kind in kinds_above(roots) {
        for document in client.list(kind, &Filter::default()).await?.items {
            documents.push(
                document_of(&document)
                    .map_err(|reason| client.odd(format!("a document {reason}")))?,
            );
        }
    }
    Ok(closure(roots, &documents))
}

/// Kinds of documents that can refer to some, directly or not.
fn kinds_above(roots: &[Key]) -> Vec<Kind> {
    let has = |kind: Kind| roots.iter().any(|key| key.kind() == kind);
    let mut kinds = Vec::new();
    if has(Kind::Layer) {
        kinds.extend([Kind::Node, Kind::Service]);
    }
    if has(Kind::Layer) || has(Kind::Node) || has(Kind::Service) {
        kinds.push(Kind::Instance);
    }
    if !kinds.is_empty() || has(Kind::Instance) {
        kinds.push(Kind::Rollout);
    }
    kinds
}

fn closure(roots: &[Key], documents: &[Document]) -> Vec<Key> {
    let mut referrers: BTreeMap<Key, Vec<&Key>> = BTreeMap::new();
    // A roll-out that has ended holds nobody back.
    let holds = |document: &&Document| document.key.kind() != Kind::Rollout || is_active(document);
    for document in documents.iter().filter(holds) {
        for (_, target) in references(document) {
            referrers.entry(target).or_default().push(&document.key);
        }
    }
    let mut seen: BTreeSet<&Key> = roots.iter().collect();
    let mut open: Vec<&Key> = roots.iter().collect();
    let mut found: Vec<Key> = Vec::new();
    while let Some(key) = open.pop() {
        for referrer in referrers.get(key).into_iter().flatten().copied() {
            if seen.insert(referrer) {
                found.push(referrer.clone());
                open.push(referrer);
            }
        }
    }
    found.sort();
    found
}

/// What the commits of some revisions deleted; `None` where that cannot be told any more.
pub(super) async fn deleted(client: &Client, revisions: &BTreeSet<u64>) -> Option<Vec<Key>> {
    timeout(LONGEST, read(client, revisions)).await.ok()?.ok().flatten()
}

async fn read(client: &Client, revisions: &BTreeSet<u64>) -> Result<Option<Vec<Key>>, CliError> {
    let (Some(first), Some(last)) = (revisions.first(), revisions.last()) else {
        return Ok(None);
    };
    let mut keys = Vec::new();
    let is_told = changes_between(client, first.saturating_sub(1), *last, |revision, change| {
        if revisions.contains(&revision) && member(change, "op") == "delete" {
            keys.extend(key_of(change));
        }
        Ok(())
    });
    Ok(is_told.await?.then_some(keys))
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;
    use crate::config::kinds::{name_of, parse_target};
    use crate::config::stub::{Asked, Reply, Stub};

    fn key(name: &str) -> Key {
        parse_target(name).unwrap().key(None).unwrap()
    }

    fn names(keys: &[Key]) -> Vec<String> {
        keys.iter().map(name_of).collect()
    }

    #[tokio::test]
    async fn what_refers_to_a_document_is_found_through_others() {
        let stub = Stub::start(|asked: &Asked, _| {
            let rollout = |name: &str, phase: &str, target: Value| {
                json!({
                    "kind": "Rollout",
                    "name": name,
                    "spec": {"target": target},
                    "status": {"phase": phase},
                })
            };
            let items = match asked.target.as_str() {
                "/api/v1/nodes?limit=1000" => json!([
                    {"kind": "Node", "name": "robot-1", "spec": {"layer": "edge"}},
                    {"kind": "Node", "name": "fog-1", "spec": {"layer": "fog"}}]),
                "/api/v1/services?limit=1000" => json!([
                    {"kind": "Service", "name": "slam", "spec": {"layers": ["edge", "fog"]}},
                    {"kind": "Service", "name": "log", "spec": {}}]),
                "/api/v1/services/-/instances?limit=1000" => json!([
                    {
                        "kind": "Instance",
                        "service": "log",
                        "name": "0",
                        "spec": {"node": "robot-1"},
                    },
                    {"kind": "Instance", "service": "log", "name": "1", "spec": {"node": "fog-1"}},
                    {"kind": "Instance", "service": "log", "name": "2", "spec": {"layer": "edge"}},
                    {"kind": "Instance", "service": "slam", "name": "0", "spec": {}}]),
                "/api/v1/rollouts?limit=1000" => json!([
                    rollout(
                        "active",
                        "canary",
                        json!({"kind": "Instance", "service": "log", "name": "0"}),
                    ),
                    rollout(
                        "ended",
                        "promoted",
                        json!({"kind": "Instance", "service": "log", "name": "0"}),
                    ),
                    rollout("other", "canary", json!({"kind": "Node", "name": "fog-1"}))
                ]),
                other => panic!("{other}"),
            };
            Reply::json(&json!({"items": items, "revision": 7, "next_page_token": ""}))
        })
        .await;
        let client = stub.client();
        let found = referrers(&client, &[key("layer/edge")]).await.unwrap();
        assert_eq!(
            names(&found),
            [
                "node/robot-1",
                "service/slam",
                "instance/log/0",
                "instance/log/2",
                "instance/slam/0",
                "rollout/active"
            ]
        );
        let found = referrers(&client, &[key("node/fog-1"), key("inst/log/1")]).await.unwrap();
        assert_eq!(names(&found), ["rollout/other"]);
        let asked = stub.asked().len();
        assert!(referrers(&client, &[key("rollout/active")]).await.unwrap().is_empty());
        assert_eq!(stub.asked().len(), asked);
    }

    #[tokio::test]
    async fn what_went_is_read_from_the_commit() {
        let stub = Stub::start(|_, _| {
            let change = |op: &str, name: &str| json!({"op": op, "kind": "Node", "name": name});
            let event = |revision: u64, changes: Value| {
                let data = json!({"revision": revision, "changes": changes});
                format!("retry: 1\nid: {revision}\nevent: change\ndata: {data}\n\n")
            };
            Reply::Events(format!(
                "id: 411\nevent: bookmark\ndata: {{\"revision\":411}}\n\n{}{}{}",
                event(
                    412,
                    json!([change("delete", "a"), change("update", "b"), change("delete", "c")])
                ),
                event(413, json!([change("delete", "by-others")])),
                event(414, json!([change("delete", "d")])),
            ))
        })
        .await;
        let client = stub.client();
        let gone = deleted(&client, &BTreeSet::from([412, 414])).await.unwrap();
        assert_eq!(names(&gone), ["node/a", "node/c", "node/d"]);
        assert_eq!(stub.lines(), ["GET /api/v1/watch?since=411"]);
        assert_eq!(deleted(&client, &BTreeSet::new()).await, None);
        let trimmed = Stub::start(|_, _| Reply::problem(410, "revision_trimmed", "gone")).await;
        assert_eq!(deleted(&trimmed.client(), &BTreeSet::from([9])).await, None);
    }
}
