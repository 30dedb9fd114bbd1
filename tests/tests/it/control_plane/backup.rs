//! A backup is taken while many write, and restored elsewhere: the documents are those of its
//! revision, and all watchers list again.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use blaze_proto::v1;
use serde_json::json;
use tokio::task::JoinSet;

use blaze_tests::wait;

use super::client::{Client, Via};
use super::count;
use super::stage::{Main, Stage, blocking, within};
use super::watcher::{Watcher, state_of};
use super::writer::Writer;

/// What a restored store's revision is higher by, as the contract has it.
const RAISED_BY: u64 = 1_000_000;
const KINDS: [v1::Kind; 5] =
    [v1::Kind::Layer, v1::Kind::Node, v1::Kind::Service, v1::Kind::Instance, v1::Kind::Rollout];
const SECRET: &str = "kept-across-a-restore";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_under_load_is_restored_elsewhere_from_sqlite() {
    restored_elsewhere(Stage::sqlite()).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_under_load_is_restored_elsewhere_from_mongodb() {
    restored_elsewhere(Stage::mongo()).await;
}

async fn restored_elsewhere(stage: Stage) {
    let limit = Duration::from_secs(if blaze_tests::long() { 600 } else { 60 });
    let stage = Arc::new(stage);
    let mut mains = vec![stage.start("one")];
    if stage.is_shared() {
        mains.push(stage.start("two"));
    }
    let client = Client::new(Via::Rest, &mains[0], &stage.admin_token());
    prepare(&client).await;
    let mut watchers = Vec::new();
    for via in [Via::Rest, Via::Grpc] {
        for main in &mains {
            watchers.push(Watcher::start(vec![client.at(via, main)]).await);
        }
    }
    let (file, revision, last) =
        within("the backup", limit, back_up(&stage, &mains, &client)).await;
    assert!(revision < last, "{revision}: nobody wrote after the backup");
    for watcher in &mut watchers {
        within("the watchers", limit, watcher.catch_up(last)).await;
    }

    let elsewhere = Arc::new(stage.elsewhere());
    let (main, said) = {
        let elsewhere = Arc::clone(&elsewhere);
        blocking(move || {
            let said = elsewhere.command(&["restore", file.to_str().unwrap()]).unwrap();
            (elsewhere.start("restored"), said)
        })
        .await
    };
    let restored = client.at(Via::Rest, &main);
    let at = main.at().rest;
    println!("{}", said.trim());
    let (now, services) = restored.rest.list(at, "services").await;
    assert_eq!(now, revision + RAISED_BY);
    assert_ne!(
        word_after(&said, "restored as store "),
        store_of(&stage).await,
        "it is another store"
    );

    let expected = documents(&client, Some(revision)).await;
    let found = documents(&restored, None).await;
    assert!(expected.len() > 100, "there is something to compare");
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (key, document) in &expected {
        assert_eq!(found[key], *document, "{key:?}");
    }
    let secret = restored.rest.get(at, "/api/v1/services/with-secret?reveal=true").await.unwrap();
    assert_eq!(
        secret.body.pointer("/spec/config/key/$secret/text"),
        Some(&json!(SECRET)),
        "{}",
        secret.text
    );

    // Whatever a watcher knew, it knows nothing of this store: it lists, and goes on from there.
    let mut writer = Writer::new(restored.clone(), "later", 3, 0);
    for watcher in &mut watchers {
        let lists = watcher.tally.lists;
        let via = watcher.via();
        watcher.move_to(vec![restored.at(via, &main)]).await;
        within("a watcher", limit, watcher.open()).await;
        assert_eq!((watcher.tally.lists, watcher.cursor >= now), (lists + 1, true));
    }
    assert_eq!(watchers[0].state, state_of(&services));
    let mut last = 0;
    for _ in 0..5 {
        last = writer.write().await;
    }
    let (_, services) = restored.rest.list(at, "services").await;
    for watcher in &mut watchers {
        within("a watcher", limit, watcher.catch_up(last)).await;
        assert_eq!(watcher.state, state_of(&services));
    }
}

/// Documents of all kinds that the layer sees.
async fn prepare(client: &Client) {
    let documents = json!([
        {
            "kind": "Layer",
            "name": "edge",
            "spec": { "kind": "edge", "config": { "log": { "level": "info" } } },
        },
        {
            "kind": "Node",
            "name": "robot-1",
            "labels": { "canary": "true" },
            "spec": { "layer": "edge" },
        },
        {
            "kind": "Service",
            "name": "with-secret",
            "spec": { "config": { "key": { "$secret": SECRET } } },
        },
        {
            "kind": "Instance",
            "service": "with-secret",
            "name": "0",
            "spec": { "node": "robot-1", "config": { "a": 1 } },
        },
    ]);
    let at = client.main.at().rest;
    client.rest.post(at, "/api/v1/apply", &documents).await;
    let rollout = json!({ "name": "slower", "spec": {
        "target": {
            "kind": "Service",
            "name": "with-secret",
        }, "patch": { "config": { "rate": 1 } },
        "canary": { "node_selector": "canary=true" }, "gate": {
            "window_s": 60,
            "max_unhealthy": 0,
        },
    } });
    client.rest.post(at, "/api/v1/rollouts", &rollout).await;
}

/// Backs up in the middle of writes. The file, its revision, and the revision of the last write.
async fn back_up(stage: &Arc<Stage>, mains: &[Arc<Main>], client: &Client) -> (PathBuf, u64, u64) {
    let (over, head) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let mut writing = JoinSet::new();
    for index in 0..4 {
        let via = if index % 2 == 0 { Via::Rest } else { Via::Grpc };
        let mut writer = Writer::new(
            client.at(via, &mains[index / 2 % mains.len()]),
            &format!("w{index}"),
            50,
            0,
        );
        let (over, head) = (Arc::clone(&over), Arc::clone(&head));
        writing.spawn(async move {
            head.fetch_max(writer.put_all().await, Ordering::AcqRel);
            while !over.load(Ordering::Acquire) {
                head.fetch_max(writer.write().await, Ordering::AcqRel);
            }
        });
    }
    let file = stage.path("backup");
    let (of_stage, path, head_seen) = (Arc::clone(stage), file.clone(), Arc::clone(&head));
    let grown = count(5_000, 100) as u64;
    let (said, before, after) = blocking(move || {
        let head = || head_seen.load(Ordering::Acquire);
        let written = |least: u64| {
            wait::until(
                "writes",
                Duration::from_secs(120),
                || head() >= least,
                || format!("{} of {least}", head()),
            )
            .unwrap();
            head()
        };
        let before = written(grown);
        let said = of_stage.command(&["backup", path.to_str().unwrap()]).unwrap();
        let after = head();
        // They go on after it, too.
        written(after + 20);
        (said, before, after)
    })
    .await;
    over.store(true, Ordering::Release);
    writing.join_all().await;
    let revision: u64 = word_after(&said, "revision ").parse().unwrap();
    println!("{} (writers had been told {before} before it and {after} after it)", said.trim());
    // A commit of each writer may be in the backup before that one hears of it.
    assert!(
        (before..=after + 4).contains(&revision) && after > before,
        "{before} {revision} {after}"
    );
    (file, revision, head.load(Ordering::Acquire))
}

fn word_after<'a>(text: &'a str, before: &str) -> &'a str {
    let (_, rest) =
        text.split_once(before).unwrap_or_else(|| panic!("{before:?} is not in {text}"));
    rest.split([' ', ':']).next().unwrap()
}

/// The id of the store that a backup of now names.
async fn store_of(stage: &Arc<Stage>) -> String {
    let (stage, path) = (Arc::clone(stage), stage.path("second"));
    let said = blocking(move || stage.command(&["backup", path.to_str().unwrap()]).unwrap()).await;
    word_after(&said, "of store ").to_owned()
}

/// Every document with all that it has, by kind, service and name; as it was at a revision, or as
/// it is.
async fn documents(
    client: &Client,
    revision: Option<u64>,
) -> BTreeMap<(i32, String, String), v1::Document> {
    let client = client.at(Via::Grpc, &client.main);
    let mut grpc = client.grpc().await.unwrap();
    let mut all = BTreeMap::new();
    for kind in KINDS {
        let mut page_token = String::new();
        loop {
            let request = v1::ListRequest {
                kind: kind.into(),
                page: Some(v1::Page { limit: 100, page_token: page_token.clone() }),
                read: Some(v1::ReadOptions {
                    at_revision: revision.unwrap_or(0),
                    ..v1::ReadOptions::default()
                }),
                ..v1::ListRequest::default()
            };
            let list = grpc.list(client.signed(request)).await.unwrap().into_inner();
            for document in list.items {
                let name = document.r#ref.clone().unwrap();
                all.insert((name.kind, name.service, name.name), document);
            }
            page_token = list.next_page_token;
            if page_token.is_empty() {
                break;
            }
        }
    }
    all
}
