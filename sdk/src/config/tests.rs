//! The configuration of a service against a worker that answers as the contract says, on a clock
//! that stands still until all wait.

use std::sync::Arc;
use std::time::Duration;

use crate::{
    AckStatus, BaseConfiguration, BaseSource, CacheError, ConfigChange, ConfigError, ConfigScope,
    ConfigSource, SdkError, ServiceManager, ServiceOptions, ServiceState,
};
use blaze_brokers::memory::{MemoryBroker, MemoryHub};
use blaze_brokers::{Broker as _, Content, PublisherOptions, SubscribeOptions, Subscription};
use blaze_domain::Scope;
use blaze_domain::names::ChannelName;
use bytes::Bytes;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio::time::Instant;

pub(super) const LONG: Duration = Duration::from_secs(300);
const PERIOD: Duration = Duration::from_secs(60);

pub(super) struct PlayedWorker {
    broker: MemoryBroker,
    requests: Subscription,
    pub(super) acks: Subscription,
}

impl PlayedWorker {
    pub(super) async fn start(hub: &MemoryHub) -> Self {
        let broker = hub.broker();
        let requests = listen(&broker, "blaze/config/get").await;
        let acks = listen(&broker, "blaze/config/ack").await;
        Self { broker, requests, acks }
    }

    /// The next request and when it came.
    pub(super) async fn asked(&mut self) -> (Instant, Value) {
        let request = next(&mut self.requests).await;
        (Instant::now(), request)
    }

    pub(super) fn say(&self, channel: &str, value: &Value) {
        let channel: ChannelName = channel.parse().unwrap();
        let publisher = self.broker.publisher(&channel, PublisherOptions::default()).unwrap();
        publisher.publish_bare(&Bytes::from(value.to_string()), None);
    }

    fn answer(&self, request: &Value, rest: Value) {
        let mut answer = rest;
        answer["id"] = request["id"].clone();
        self.say(request["reply_to"].as_str().unwrap(), &answer);
    }

    pub(super) fn give(&self, request: &Value, revision: u64, config: &Value) {
        let rest = json!({"service": "slam", "instance": "0", "layer": "edge", "node": "robot-1",
            "revision": revision,
            "hash": hash(config), "config": config, "source": "main",
            "as_of": "2026-11-21T07:01:12.345Z", "age_s": 0.1,
            "rollout": null});
        self.answer(request, rest);
    }

    pub(super) fn tell(&self, revision: u64, config: &Value, scope: &str) {
        let notice = json!({"service": "slam", "instance": "0", "layer": "edge", "node": "robot-1",
            "revision": revision,
            "hash": hash(config), "previous_hash": null, "paths": ["/rate_hz"], "scopes": [scope],
            "config": config,
            "source": "main", "time": "2026-11-21T07:01:12.345Z"});
        self.say("blaze/config/changed/slam", &notice);
    }
}

async fn listen(broker: &MemoryBroker, channel: &str) -> Subscription {
    let channel: ChannelName = channel.parse().unwrap();
    broker.subscribe(&channel, SubscribeOptions::default()).await.unwrap()
}

pub(super) async fn next(subscription: &mut Subscription) -> Value {
    let mut batch = Vec::new();
    let wait = subscription.receive(&mut batch, 1);
    tokio::time::timeout(LONG, wait).await.expect("a message");
    let Content::Bare { payload, .. } = &batch[0].content else {
        panic!("they are JSON: {batch:?}");
    };
    serde_json::from_slice(payload).unwrap()
}

fn hash(config: &Value) -> String {
    format!("sha256:{config}")
}

fn options(hub: &MemoryHub, name: &str) -> ServiceOptions {
    let broker = Arc::new(hub.broker());
    let options =
        ServiceOptions::new("edge".parse().unwrap(), name.parse().unwrap(), broker, Scope::Node);
    options.on_node("robot-1".parse().unwrap())
}

pub(super) async fn slam(hub: &MemoryHub) -> ServiceManager {
    ServiceManager::start(options(hub, "slam")).await.unwrap()
}

#[derive(Debug, Deserialize, PartialEq)]
struct Settings {
    rate_hz: u32,
}

/// The next change, from a callback on a thread that knows nothing of the clock of the test.
async fn change(changes: &mut mpsc::Receiver<ConfigChange>) -> ConfigChange {
    changes.recv().await.expect("a change")
}

fn to(heard: &mpsc::Sender<ConfigChange>) -> impl Fn(&ConfigChange) + Send + Sync + 'static {
    let heard = heard.clone();
    move |change| heard.try_send(change.clone()).expect("room")
}

#[tokio::test(start_paused = true)]
async fn it_asks_each_second_until_there_is_an_answer_and_each_minute_with_the_hash() {
    let hub = MemoryHub::new("node");
    let mut worker = PlayedWorker::start(&hub).await;
    let service = slam(&hub).await;
    let silent = tokio::time::timeout(PERIOD, worker.asked()).await;
    assert!(silent.is_err(), "nobody wanted a configuration yet");
    let config = service.config();
    let (first, request) = worker.asked().await;
    assert_eq!(
        (&request["service"], &request["instance"], &request["node"]),
        (&json!("slam"), &json!("0"), &json!("robot-1"))
    );
    assert!(request["reply_to"].as_str().unwrap().starts_with("blaze/reply/slam-0-"));
    let not_yet = config.ready(Duration::from_millis(10)).await;
    assert!(matches!(not_yet, Err(ConfigError::NotReady { .. })), "{not_yet:?}");
    let (second, again) = worker.asked().await;
    assert_eq!(second - first, Duration::from_secs(1));
    assert_ne!(request["id"], again["id"]);
    worker.give(&again, 431, &json!({"rate_hz": 10}));
    config.ready(LONG).await.unwrap();
    assert_eq!(config.typed::<Settings>(), Ok(Settings { rate_hz: 10 }));
    assert_eq!((config.revision(), config.source()), (Some(431), Some(ConfigSource::Main)));
    let (third, with_hash) = worker.asked().await;
    assert_eq!(third - second, PERIOD);
    assert_eq!(with_hash["hash"], hash(&json!({"rate_hz": 10})).as_str());
    worker.answer(
        &with_hash,
        json!({"unchanged": true, "revision": 431, "hash": with_hash["hash"], "source": "copy"}),
    );
    let (fourth, _) = worker.asked().await;
    assert_eq!(fourth - third, PERIOD);
    assert_eq!(config.source(), Some(ConfigSource::Copy));
    service.shutdown().await;
}

#[tokio::test]
async fn callbacks_hear_of_their_scopes_in_order_and_never_of_what_is_older() {
    let hub = MemoryHub::new("node");
    let mut worker = PlayedWorker::start(&hub).await;
    let service = slam(&hub).await;
    let (all, mut hears_all) = mpsc::channel(64);
    let (of_node, mut hears_node) = mpsc::channel(64);
    let (of_service, mut hears_service) = mpsc::channel(64);
    let config = service.config();
    let listeners = [
        config.on_change(to(&all)),
        config.on_node_change(to(&of_node)),
        config.on_service_change(to(&of_service)),
    ];
    let (_, request) = worker.asked().await;
    worker.give(&request, 5, &json!({"rate_hz": 10}));
    let first = change(&mut hears_all).await;
    assert_eq!((first.old, first.revision, first.scopes.len()), (None, 5, 0));
    // It may come from anywhere.
    assert_eq!(
        (change(&mut hears_node).await.revision, change(&mut hears_service).await.revision),
        (5, 5)
    );
    worker.tell(6, &json!({"rate_hz": 20}), "node");
    worker.tell(4, &json!({"rate_hz": 1}), "node");
    worker.tell(6, &json!({"rate_hz": 20}), "node");
    worker.tell(7, &json!({"rate_hz": 30}), "instance");
    let (second, third) = (change(&mut hears_all).await, change(&mut hears_all).await);
    assert_eq!((second.revision, third.revision), (6, 7));
    assert_eq!(second.scopes, [ConfigScope::Node]);
    assert_eq!(third.old, second.new);
    assert_eq!(change(&mut hears_node).await.revision, 6);
    assert_eq!(change(&mut hears_service).await.revision, 7);
    let gone = json!({"service": "slam", "instance": "0", "layer": "edge", "node": "robot-1",
        "revision": 8, "hash": null,
        "paths": [], "scopes": [], "config": null, "deleted": true, "source": "main"});
    worker.say("blaze/config/changed/slam", &gone);
    assert!(change(&mut hears_all).await.deleted);
    assert_eq!(config.value(), None);
    assert_eq!(config.typed::<Settings>(), Err(ConfigError::Deleted { revision: 8 }));
    assert_eq!(config.counts().older, 1);
    drop(listeners);
    service.shutdown().await;
}

#[tokio::test(start_paused = true)]
async fn a_notice_that_was_lost_with_the_broker_is_asked_for_when_it_is_back() {
    let hub = MemoryHub::new("node");
    let mut worker = PlayedWorker::start(&hub).await;
    let service = slam(&hub).await;
    let config = service.config();
    let (_, request) = worker.asked().await;
    worker.give(&request, 5, &json!({"rate_hz": 10}));
    config.ready(LONG).await.unwrap();
    hub.cut();
    worker.tell(6, &json!({"rate_hz": 20}), "node");
    tokio::time::sleep(Duration::from_secs(5)).await;
    hub.restore();
    let back = Instant::now();
    let (asked, request) = worker.asked().await;
    assert!(asked - back < Duration::from_secs(1));
    worker.give(&request, 6, &json!({"rate_hz": 20}));
    while config.revision() != Some(6) {
        assert!(back.elapsed() < LONG);
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    service.shutdown().await;
}

#[tokio::test(start_paused = true)]
async fn an_acknowledgement_names_what_the_service_has() {
    let hub = MemoryHub::new("node");
    let mut worker = PlayedWorker::start(&hub).await;
    let service = slam(&hub).await;
    let config = service.config();
    let (_, request) = worker.asked().await;
    worker.give(&request, 5, &json!({"rate_hz": 10}));
    config.ready(LONG).await.unwrap();
    config.ack(AckStatus::Rejected, "rate_hz: too low").unwrap();
    let ack = next(&mut worker.acks).await;
    let expected = json!({"service": "slam", "instance": "0", "node": "robot-1", "revision": 5,
        "hash": hash(&json!({"rate_hz": 10})), "status": "rejected", "detail": "rate_hz: too low"});
    assert_eq!(ack, expected);
    service.shutdown().await;
}

#[tokio::test(start_paused = true)]
async fn what_the_worker_says_lies_over_the_mounted_file() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("slam.yaml");
    std::fs::write(&path, "rate_hz: 5\ncamera: { width: 640, height: 480 }\n").unwrap();
    let hub = MemoryHub::new("node");
    let mut worker = PlayedWorker::start(&hub).await;
    let service = slam(&hub).await;
    let base = BaseConfiguration::read(&path).unwrap().with(service.config());
    assert_eq!(base.typed::<Settings>(), Ok(Settings { rate_hz: 5 }));
    assert_eq!(base.source(), BaseSource::File);
    let (_, request) = worker.asked().await;
    worker.give(&request, 5, &json!({"rate_hz": 10, "camera": {"width": 320}}));
    service.config().ready(LONG).await.unwrap();
    assert_eq!(base.value(), json!({"rate_hz": 10, "camera": {"width": 320, "height": 480}}));
    assert_eq!(base.source(), BaseSource::Worker(ConfigSource::Main));
    service.shutdown().await;
}

#[tokio::test(start_paused = true)]
async fn a_service_starts_when_those_that_it_waits_for_are_ready() {
    let hub = MemoryHub::new("node");
    let watches = hub.broker();
    let mut signs = listen(&watches, "blaze/watchdog").await;
    let waits_for = |service: &str| ServiceOptions {
        wait_for: vec![service.parse().unwrap()],
        ..options(&hub, "slam")
    };
    let alone = ServiceManager::start(waits_for("blaze-flow")).await;
    let Err(SdkError::Wait(CacheError::NotReady { services, .. })) = alone else {
        panic!("there is no blaze-flow");
    };
    assert_eq!(services, ["blaze-flow".parse().unwrap()]);
    assert_eq!(next(&mut signs).await["state"], "starting");
    let flow = ServiceManager::start(options(&hub, "blaze-flow")).await.unwrap();
    flow.cache().set_state(ServiceState::Ready);
    let service = ServiceManager::start(waits_for("blaze-flow")).await.unwrap();
    flow.shutdown().await;
    let last = loop {
        let sign = next(&mut signs).await;
        if sign["service"] == "blaze-flow" && sign["state"] != "ready" {
            break sign;
        }
    };
    assert_eq!((&last["state"], &last["ttl_ms"]), (&json!("stopping"), &json!(1)));
    service.shutdown().await;
}
