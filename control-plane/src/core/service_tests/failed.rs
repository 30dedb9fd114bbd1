//! Roll-outs that fail on a canary, as its worker says.

use super::*;
use crate::core::{Acknowledged, RolloutReport, SYNC_PROTOCOL, SyncHello, WorkerSession};

/// Two canaries in layer `edge`, one in `fog`, and a roll-out of `s` on all of them.
async fn tried() -> (World, String) {
    let w = world().await;
    w.apply(vec![
        ("Layer/edge", json!({ "kind": "edge" })),
        ("Layer/fog", json!({ "kind": "fog" })),
        ("Service/s", json!({ "config": { "n": 1 } })),
    ])
    .await
    .unwrap();
    for (node, layer) in [("robot-1", "edge"), ("robot-2", "edge"), ("server", "fog")] {
        let mut node = input(&format!("Node/{node}"), json!({ "layer": layer }));
        node.labels.insert("canary".to_owned(), "true".to_owned());
        w.service.create(&w.admin, node, None).await.unwrap();
    }
    let spec = json!({
        "target": { "kind": "Service", "name": "s" }, "patch": { "config": { "n": 2 } },
        "canary": { "node_selector": "canary=true" }, "gate": {
            "window_s": 60,
            "max_unhealthy": 0,
        },
    });
    let started = w.service.create(&w.admin, input("Rollout/r", spec), None).await.unwrap();
    let uid = started.value.document.uid.clone();
    (w, uid)
}

fn report(uid: &str, node: &str, phase: &str, reason: &str) -> RolloutReport {
    RolloutReport {
        uid: uid.to_owned(),
        node: Some(node.parse().unwrap()),
        phase: phase.to_owned(),
        reason: reason.to_owned(),
    }
}

impl World {
    async fn session(&self, layer: &str, node: &str) -> Arc<WorkerSession> {
        let hello = SyncHello {
            protocol: SYNC_PROTOCOL,
            layer: layer.parse().unwrap(),
            node: Some(node.parse().unwrap()),
            worker_id: format!("{node}-1"),
            version: "0.1.0".to_owned(),
            store_id: String::new(),
            revision: 0,
            digest: String::new(),
            without_texts: false,
        };
        let opened =
            self.service.sync(&caller(&["worker"], Some(layer)), hello, true).await.unwrap();
        opened.into_parts().1
    }

    fn says(&self, session: &WorkerSession, reports: Vec<RolloutReport>) {
        let revision = self.service.revision();
        self.service.acknowledged(session, Acknowledged::new(revision, String::new(), [], reports));
    }

    async fn status_of_r(&self) -> Value {
        self.get("Rollout/r").await.unwrap().status.clone().unwrap()
    }

    async fn until_it_has_ended(&self) -> Value {
        let wait = async {
            loop {
                let status = self.status_of_r().await;
                if status["phase"] != "canary" {
                    return status;
                }
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        tokio::time::timeout(Duration::from_secs(10), wait).await.expect("it ends within 10 s")
    }
}

#[tokio::test]
async fn what_workers_report_is_shown_and_is_no_commit() {
    let (w, uid) = tried().await;
    let before = w.service.revision();
    let session = w.session("edge", "robot-1").await;
    let foreign = report(&uid, "server", "applied", "");
    w.says(
        &session,
        vec![
            report(&uid, "robot-1", "applied", ""),
            foreign,
            report("other", "robot-2", "applied", ""),
        ],
    );
    let line = json!({ "node": "robot-1", "phase": "applied", "revision": before, "reason": "" });
    let canaries = w.status_of_r().await["canaries"].clone();
    assert_eq!(canaries[0], line);
    assert_eq!(
        (&canaries[1]["phase"], &canaries[2]["phase"]),
        (&json!("pending"), &json!("pending"))
    );
    let query =
        ListQuery { kind: Some(blaze_domain::config::Kind::Rollout), ..ListQuery::default() };
    let listed =
        w.service.list(&w.admin, &query, &ReadOptions::default()).await.unwrap().value.items;
    assert_eq!(listed[0].status.as_ref().unwrap()["canaries"][0], line);
    assert_eq!(w.service.revision(), before);
    // A node that has become a canary since.
    let mut third = input("Node/robot-3", json!({ "layer": "edge" }));
    third.labels.insert("canary".to_owned(), "true".to_owned());
    w.service.create(&w.admin, third, None).await.unwrap();
    let session = w.session("edge", "robot-3").await;
    w.says(&session, vec![report(&uid, "robot-3", "applied", "")]);
    assert_eq!(w.status_of_r().await["canaries"][3]["node"], "robot-3");
}

#[tokio::test]
async fn a_failure_on_one_canary_ends_the_roll_out_in_one_commit_and_everywhere() {
    let (w, uid) = tried().await;
    let before = w.service.revision();
    let session = w.session("edge", "robot-1").await;
    let on = |node: &str| Place {
        service: Some("s".parse().unwrap()),
        node: Some(node.parse().unwrap()),
        ..Place::default()
    };
    assert_eq!(w.effective(on("server")).await.config["n"], 2);
    for _ in 0..5 {
        w.says(&session, vec![report(&uid, "robot-1", "failed", "s/0 rejected it")]);
    }
    let status = w.until_it_has_ended().await;
    assert_eq!(
        (&status["phase"], &status["reason"]),
        (&json!("failed"), &json!("robot-1: s/0 rejected it"))
    );
    let line = json!({
        "node": "robot-1",
        "phase": "failed",
        "revision": before,
        "reason": "s/0 rejected it",
    });
    assert_eq!(status["canaries"][0], line);
    assert_eq!(w.get("Rollout/r").await.unwrap().updated_by, "worker:edge/robot-1");
    assert_eq!(w.effective(on("server")).await.config["n"], 1);
    // Once more, when it is over: nothing happens.
    w.says(&session, vec![report(&uid, "robot-1", "failed", "again")]);
    w.put("Layer/fog", json!({ "kind": "fog", "config": { "a": 1 } })).await;
    assert_eq!(w.service.revision(), before + 2);
    assert_eq!(
        code(w.service.abort_rollout(&w.admin, &"r".parse().unwrap(), "", None).await),
        Code::RolloutState
    );
}

#[tokio::test]
async fn a_worker_ends_nothing_that_is_not_tried_in_its_layer() {
    let (w, uid) = tried().await;
    let before = w.service.revision();
    let session = w.session("edge", "robot-1").await;
    let nobody = RolloutReport { node: None, ..report(&uid, "robot-1", "failed", "") };
    let reports = [
        report(&uid, "server", "failed", "of another layer"),
        report(&uid, "nowhere", "failed", ""),
        report("another", "robot-1", "failed", ""),
        nobody,
    ];
    w.says(&session, reports.to_vec());
    w.put("Layer/fog", json!({ "kind": "fog", "config": { "a": 1 } })).await;
    assert_eq!(w.service.revision(), before + 1, "the committer takes one after the other");
    assert_eq!(w.status_of_r().await["phase"], "canary");
}
