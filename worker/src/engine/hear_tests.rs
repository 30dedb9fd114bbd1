//! Roll-outs that services judge, with and without a main service.

use std::collections::BTreeMap;

use blaze_runtime::Supervisor;

use super::*;
use crate::copy::fake::Fake;
use crate::copy::{LocalCopy, Target};
use crate::core::testing::labelled;

/// A roll-out of another rate of `slam` on `robot-1`, watched for 60 s.
pub(super) fn rollout(revision: u64, uid: &str, rate: u64) -> Document {
    let spec = json!({ "target": { "kind": "Service", "name": "slam" },
        "patch": { "config": { "rate_hz": rate } },
        "canary": { "node_selector": "canary=true" },
        "gate": { "window_s": 60, "max_unhealthy": 0 } });
    let mut out = document("Rollout/faster", revision, spec);
    out.uid = uid.to_owned();
    out.status = Some(json!({ "phase": "canary" }));
    out
}

pub(super) fn canary_documents() -> Vec<Document> {
    let mut out = documents(30);
    out.retain(|document| document.key.to_string() != "Node/robot-1");
    out.push(labelled("Node/robot-1", 2, json!({ "layer": "edge" }), ("canary", "true")));
    out
}

fn copies() -> (Supervisor, Arc<Fake>, Copies) {
    let supervisor = Supervisor::new("test");
    let fake = Arc::new(Fake::new("fake"));
    let target =
        Target { copy: Arc::clone(&fake) as Arc<dyn LocalCopy>, is_read: true, written: None };
    let copies = Copies::start(&supervisor, vec![target], &mpsc::channel(1).0);
    (supervisor, fake, copies)
}

fn beat(instance: &str, state: &str) -> Value {
    json!({ "layer": "edge", "node": "robot-1", "service": "slam", "instance": instance, "epoch": 1,
        "state": state,
        "config_revision": 2, "config_hash": "sha256:ab", "ttl_ms": 15000 })
}

impl World {
    /// With an instance of `slam` that has asked.
    async fn with_canary(mut self) -> Self {
        self.opens(canary_documents(), 2).await;
        self.slam().await;
        self.rest().await;
        self
    }

    async fn tries(&mut self, revision: u64, uid: &str, rate: u64) -> Vec<Value> {
        self.says(put(revision, rollout(revision, uid, rate))).await;
        self.rates().await
    }

    /// Rates that the instance `0` was told of.
    pub(super) async fn rates(&mut self) -> Vec<Value> {
        let seen = self.rest().await;
        let of_0 = noticed(&seen).filter(|(_, notice)| notice["instance"] == "0");
        of_0.map(|(_, notice)| notice["config"]["rate_hz"].clone()).collect()
    }

    pub(super) async fn acks(&self, instance: &str, hash: &Value, status: &str) {
        let ack = json!({ "service": "slam", "instance": instance, "node": "robot-1", "revision": 9,
            "hash": hash,
            "status": status, "detail": "too fast" });
        self.signs.send(Sign::Ack(Bytes::from(ack.to_string()))).await.unwrap();
    }

    async fn beats(&self, message: &Value) {
        self.signs.send(Sign::Beat(Bytes::from(message.to_string()))).await.unwrap();
    }

    async fn reported(&mut self, phase: &str) -> v1::RolloutReport {
        let is_it = |ack: &Option<v1::Ack>| {
            let ack = ack.as_ref();
            ack.is_some_and(|ack| ack.rollouts.first().is_some_and(|report| report.phase == phase))
        };
        let wait = self.acks.wait_for(is_it);
        let ack = tokio::time::timeout(Duration::from_secs(20), wait)
            .await
            .expect("a report within 20 s")
            .unwrap();
        ack.as_ref().unwrap().rollouts[0].clone()
    }
}

#[tokio::test(start_paused = true)]
async fn an_instance_that_asked_a_life_before_is_told_of_what_it_does_not_have() {
    let mut w = world();
    w.opens(documents(30), 2).await;
    w.rest().await;
    let rates_of_9 = async |w: &mut World| {
        let seen = w.rest().await;
        let of_9 = noticed(&seen).filter(|(_, notice)| notice["instance"] == "9");
        of_9.map(|(_, notice)| notice["config"]["rate_hz"].clone()).collect::<Vec<_>>()
    };
    // It has no document, and nobody noted that it asked.
    w.beats(&beat("9", "ready")).await;
    assert_eq!(rates_of_9(&mut w).await, [json!(30)]);
    w.beats(&beat("9", "ready")).await;
    assert_eq!(rates_of_9(&mut w).await, [json!(null); 0], "it is told once");
    w.says(slam(3, 31)).await;
    let seen = w.rest().await;
    let (_, told) = noticed(&seen).find(|(_, notice)| notice["instance"] == "9").unwrap();
    assert_eq!(told["config"]["rate_hz"], 31);
    // What it says may be older than what it has, and look right by chance.
    let mut old = beat("8", "ready");
    old["config_hash"] = told["hash"].clone();
    w.beats(&old).await;
    let seen = w.rest().await;
    assert!(noticed(&seen).any(|(_, notice)| notice["instance"] == "8"));
    // One that runs without a configuration of ours wants none.
    let mut other = beat("10", "ready");
    other["config_hash"] = json!("");
    w.beats(&other).await;
    assert!(noticed(&w.rest().await).next().is_none());
}

#[tokio::test(start_paused = true)]
async fn a_bad_value_is_undone_without_the_main_service_and_stays_away_after_a_restart() {
    let (_supervisor, fake, copies) = copies();
    let mut w = world_with(None, true, Some(copies.clone())).with_canary().await;
    assert_eq!(w.tries(3, "u-1", 500).await, [json!(500)]);
    assert_eq!(w.reported("applied").await.uid, "u-1");
    w.closes().await;
    let bad = w.slam().await;
    assert_eq!((&bad["config"]["rate_hz"], &bad["rollout"]), (&json!(500), &json!("faster")));
    w.acks("0", &bad["hash"], "rejected").await;
    assert_eq!(w.rates().await, [json!(30)]);
    let status = w.status().await;
    let told = &status.json["rollouts"][0];
    assert_eq!(
        (&told["phase"], &told["node"], &told["name"]),
        (&json!("failed"), &json!("robot-1"), &json!("faster"))
    );
    assert!(told["reason"].as_str().unwrap().contains("too fast"), "{told}");
    assert_eq!(status.counts.failed_rollouts, 1);

    assert!(copies.flush(Duration::from_secs(60)).await);
    drop(w);
    let loaded = fake.load().await.unwrap().unwrap();
    assert!(loaded.notes.failed.contains(&"u-1".to_owned()));
    let mut w = world_with(Some(loaded), true, Some(copies));
    assert_eq!(w.rates().await, [] as [Value; 0], "it was told already");
    let good = w.slam().await;
    assert_eq!((&good["config"]["rate_hz"], &good["rollout"]), (&json!(30), &json!(null)));
    // The main service is back and does not know yet.
    let mut documents = canary_documents();
    documents.push(rollout(3, "u-1", 500));
    w.opens(documents.clone(), 3).await;
    assert_eq!(w.reported("failed").await.node, "robot-1");
    assert_eq!(w.rates().await, [json!(30)], "every place once, none with the bad value");
    // Another one of the same name may be tried.
    assert_eq!(w.tries(4, "u-2", 40).await, [json!(40)]);
    assert_eq!(w.reported("applied").await.uid, "u-2");
}

#[tokio::test(start_paused = true)]
async fn a_lost_watchdog_fails_it() {
    let mut w = world().with_canary().await;
    w.beats(&beat("0", "ready")).await;
    assert_eq!(w.tries(3, "u-1", 500).await, [json!(500)]);
    w.beats(&beat("0", "ready")).await;
    let ack = w.acks.wait_for(|ack| ack.as_ref().is_some_and(|ack| !ack.services.is_empty())).await;
    let services = ack.unwrap().as_ref().unwrap().services.clone();
    assert_eq!((services[0].service.as_str(), services[0].state.as_str()), ("slam", "ready"));
    assert_eq!((services[0].config_revision, services[0].node.as_str()), (2, "robot-1"));
    // It counts for 15 s.
    for _ in 0..2 {
        assert_eq!(w.rates().await, [] as [Value; 0]);
    }
    assert_eq!(w.notice().await.1["config"]["rate_hz"], 30);
    assert!(w.reported("failed").await.reason.contains("lost its watchdog"));
}

#[tokio::test(start_paused = true)]
async fn a_record_that_is_gone_from_redis_fails_it_and_an_outage_does_not() {
    let mut w = world().with_canary().await;
    let members: BTreeMap<String, String> = beat("0", "ready")
        .as_object()
        .unwrap()
        .iter()
        .map(|(name, value)| {
            (name.clone(), value.as_str().map_or_else(|| value.to_string(), str::to_owned))
        })
        .collect();
    let scan = |records: Vec<(String, BTreeMap<String, String>)>, is_whole| Sign::Scan {
        records,
        is_whole,
    };
    let one = || {
        let strange = ("blaze:watchdog:slam:robot-1:7".to_owned(), members.clone());
        vec![("blaze:watchdog:slam:robot-1:0".to_owned(), members.clone()), strange]
    };
    w.signs.send(scan(one(), true)).await.unwrap();
    assert_eq!(w.tries(3, "u-1", 500).await, [json!(500)]);
    let status = w.status().await;
    let slam = status.json["services"]
        .as_array()
        .unwrap()
        .iter()
        .find(|row| row["instance"] == "0")
        .unwrap();
    assert_eq!((&slam["state"], &slam["config_hash"]), (&json!("ready"), &json!("sha256:ab")));
    assert_eq!((status.counts.signs, status.counts.misunderstood), (1, 1));
    w.signs.send(scan(Vec::new(), false)).await.unwrap();
    assert_eq!(w.rates().await, [] as [Value; 0]);
    w.signs.send(scan(Vec::new(), true)).await.unwrap();
    assert_eq!(w.rates().await, [json!(30)]);
}

#[tokio::test(start_paused = true)]
async fn its_window_begins_when_services_are_told_of_it_and_not_before() {
    let mut w = world().with_canary().await;
    w.up.send_replace(false);
    assert_eq!(w.tries(3, "u-1", 500).await, [] as [Value; 0]);
    tokio::time::sleep(Duration::from_secs(120)).await;
    assert_eq!(w.status().await.json["rollouts"][0]["phase"], "pending");
    w.up.send_replace(true);
    assert_eq!(w.rates().await, [json!(500)]);
    assert_eq!(w.reported("applied").await.uid, "u-1");
    tokio::time::sleep(Duration::from_secs(40)).await;
    w.acks("0", &json!(null), "rejected").await;
    assert_eq!(w.rates().await, [json!(30)]);
}

#[tokio::test(start_paused = true)]
async fn its_window_does_not_begin_in_a_new_life_that_has_notified_nobody() {
    let mut documents = canary_documents();
    documents.push(document("Instance/slam/0", 2, json!({ "node": "robot-1" })));
    documents.push(rollout(2, "u-1", 500));
    let mut w = world_from(Some(copy_of("s", 2, documents.clone())), true);
    w.rest().await;
    assert_eq!(w.status().await.json["rollouts"][0]["phase"], "pending");
    w.opens(documents, 2).await;
    assert_eq!(w.rates().await, [json!(500)]);
    assert_eq!(w.status().await.json["rollouts"][0]["phase"], "applied");
}

#[tokio::test(start_paused = true)]
async fn a_new_leader_opens_windows_when_the_broker_has_its_first_notices() {
    let mut w = world_from(None, false);
    let mut documents = canary_documents();
    documents.push(document("Instance/slam/0", 2, json!({ "node": "robot-1" })));
    w.opens(documents, 2).await;
    assert_eq!(w.tries(3, "u-1", 500).await, [] as [Value; 0]);
    w.says(put(4, document("Service/nav", 4, json!({ "config": { "speed": 2 } })))).await;
    w.rest().await;
    w.up.send_replace(false);
    w.leader.send_replace(Some(1));
    w.rest().await;
    assert_eq!(w.status().await.json["rollouts"][0]["phase"], "pending");
    w.up.send_replace(true);
    assert_eq!(w.rates().await, [json!(500)]);
    assert_eq!(w.status().await.json["rollouts"][0]["phase"], "applied");
}

#[tokio::test(start_paused = true)]
async fn a_new_life_writes_no_copy_that_is_as_it_should_be() {
    let (_supervisor, fake, copies) = copies();
    let mut w = world_with(None, true, Some(copies.clone())).with_canary().await;
    w.rest().await;
    assert!(copies.flush(Duration::from_secs(60)).await);
    drop(w);
    let loaded = fake.load().await.unwrap().unwrap();
    let written = copies.counts()[0].written;
    let mut w = world_with(Some(loaded), true, Some(copies.clone()));
    w.rest().await;
    assert_eq!(copies.counts()[0].written, written);
}

#[tokio::test(start_paused = true)]
async fn where_nobody_leads_a_window_begins_with_the_next_leader() {
    let mut w = world_from(None, false);
    let mut documents = canary_documents();
    documents.push(document("Instance/slam/0", 2, json!({ "node": "robot-1" })));
    w.opens(documents, 2).await;
    assert_eq!(w.tries(3, "u-1", 500).await, [] as [Value; 0]);
    tokio::time::sleep(Duration::from_secs(120)).await;
    w.leader.send_replace(Some(1));
    assert_eq!(w.rates().await, [json!(500)]);
    w.acks("0", &json!(null), "rejected").await;
    assert_eq!(w.rates().await, [json!(30)]);
}
