//! Leases against a flow that answers as the contract says, on a clock that stands still until all
//! wait.

use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::memory::{MemoryBroker, MemoryHub};
use blaze_brokers::{Broker as _, Content, PublisherOptions, SubscribeOptions, Subscription};
use blaze_domain::names::ChannelName;
use blaze_domain::{Durability, Reliability, Scope};
use blaze_sdk::{
    Advertise, FlowError, FlowEventKind, LeaseState, OriginFilter, Request, ServiceManager,
    ServiceOptions,
};
use bytes::Bytes;
use serde_json::{Value, json};
use tokio::time::Instant;

const TTL: Duration = Duration::from_secs(3);

struct FakeFlow {
    broker: MemoryBroker,
    control: Subscription,
    waiting: Vec<Value>,
}

impl FakeFlow {
    async fn start(hub: &MemoryHub) -> Self {
        let broker = hub.broker();
        let control =
            broker.subscribe(&ChannelName::control(), SubscribeOptions::default()).await.unwrap();
        Self { broker, control, waiting: Vec::new() }
    }

    /// The next control message and when it came.
    async fn next(&mut self) -> (Instant, Value) {
        while self.waiting.is_empty() {
            let mut batch = Vec::new();
            let wait = self.control.receive(&mut batch, 1);
            tokio::time::timeout(Duration::from_secs(60), wait).await.expect("a control message");
            let Content::Bare { payload, .. } = &batch[0].content else {
                panic!("control messages are JSON: {batch:?}");
            };
            match serde_json::from_slice(payload).unwrap() {
                Value::Array(objects) => self.waiting.extend(objects),
                object => self.waiting.push(object),
            }
        }
        (Instant::now(), self.waiting.remove(0))
    }

    /// As `next`, within a time in which there may be none.
    async fn next_within(&mut self, time: Duration) -> Option<(Instant, Value)> {
        tokio::time::timeout(time, self.next()).await.ok()
    }

    fn say(&self, channel: &str, value: &Value) {
        let channel: ChannelName = channel.parse().unwrap();
        let publisher = self.broker.publisher(&channel, PublisherOptions::default()).unwrap();
        publisher.publish_bare(&Bytes::from(value.to_string()), None);
    }

    fn agree(&self, to: &Value) {
        let answer =
            json!({"id": to["id"], "ok": true, "flow": "edge/robot-1", "lease_s": TTL.as_secs()});
        self.say(to["reply_to"].as_str().unwrap(), &answer);
    }

    fn started(&self) {
        self.say(
            "blaze/flow/events",
            &json!({
                "event": "flow_started",
                "flow": "edge/robot-1",
                "time": "2026-01-01T00:00:00Z",
            }),
        );
    }
}

async fn service(hub: &MemoryHub) -> ServiceManager {
    let options = ServiceOptions {
        lease_ttl: TTL,
        control_timeout: Duration::from_secs(10),
        epoch: 42,
        ..ServiceOptions::new(
            "edge".parse().unwrap(),
            "driver".parse().unwrap(),
            Arc::new(hub.broker()),
            Scope::Node,
        )
    };
    ServiceManager::start(options.on_node("robot-1".parse().unwrap())).await.unwrap()
}

fn imu() -> Advertise {
    Advertise {
        rate_hz: Some(50.0),
        max_bytes: Some(400),
        encoding: "application/json".to_owned(),
        reliability: Reliability::Reliable,
        durability: Durability::TransientLocal,
        depth: 3,
        lifespan: Duration::from_millis(500),
        ..Advertise::new("imu/data".parse().unwrap())
    }
}

/// Advertises, while the flow agrees.
async fn advertised(
    service: &ServiceManager,
    flow: &mut FakeFlow,
    advertise: Advertise,
) -> blaze_sdk::Lease {
    let (lease, ()) = tokio::join!(service.flow().advertise(advertise), async {
        let (_, sent) = flow.next().await;
        flow.agree(&sent);
    });
    lease.unwrap()
}

#[tokio::test(start_paused = true)]
async fn an_advertise_says_what_the_contract_asks_for_and_renews_itself() {
    let hub = MemoryHub::new("t");
    let mut flow = FakeFlow::start(&hub).await;
    let service = service(&hub).await;
    let (lease, sent) = tokio::join!(service.flow().advertise(imu()), async {
        let (_, sent) = flow.next().await;
        flow.agree(&sent);
        sent
    });
    let lease = lease.unwrap();
    assert_eq!(lease.state(), LeaseState::Held);
    for (field, value) in [
        ("op", json!("advertise")),
        ("topic", json!("imu/data")),
        ("service", json!("driver")),
        ("instance", json!("0")),
        ("layer", json!("edge")),
        ("node", json!("robot-1")),
        ("epoch", json!(42)),
        ("ttl_s", json!(3)),
        ("rate_hz", json!(50.0)),
        ("max_bytes", json!(400)),
        ("encoding", json!("application/json")),
        ("reliability", json!("reliable")),
        ("durability", json!("transient_local")),
        ("depth", json!(3)),
        ("lifespan_ms", json!(500)),
    ] {
        assert_eq!(sent[field], value, "{field}");
    }
    let mut last = Instant::now();
    for _ in 0..5 {
        let (at, renewal) = flow.next().await;
        assert_eq!(renewal, sent, "a renewal says the same");
        flow.agree(&renewal);
        let pause = at - last;
        assert!(pause.abs_diff(TTL / 3) <= Duration::from_millis(30), "{pause:?}");
        last = at;
    }
    drop(lease);
}

#[tokio::test(start_paused = true)]
async fn a_request_names_the_origin_that_it_wants() {
    let hub = MemoryHub::new("t");
    let mut flow = FakeFlow::start(&hub).await;
    let service = service(&hub).await;
    let request = Request {
        max_rate_hz: Some(10.0),
        from: OriginFilter { layer: Some("cloud".parse().unwrap()), ..OriginFilter::default() },
        ..Request::new("cmd".parse().unwrap())
    };
    let (lease, sent) = tokio::join!(service.flow().request(request), async {
        let (_, sent) = flow.next().await;
        flow.agree(&sent);
        sent
    });
    assert_eq!(lease.unwrap().topic().as_str(), "cmd");
    assert_eq!((&sent["op"], &sent["max_rate_hz"]), (&json!("request"), &json!(10.0)));
    assert_eq!(sent["from"], json!({"layer": "cloud"}));
    assert!(sent.get("rate_hz").is_none() && sent.get("bare").is_none());
}

#[tokio::test(start_paused = true)]
async fn a_started_flow_hears_of_all_leases_within_250_ms() {
    let hub = MemoryHub::new("t");
    let mut flow = FakeFlow::start(&hub).await;
    let service = service(&hub).await;
    let mut events = service.flow().events();
    let mut leases = Vec::new();
    for number in 0..5 {
        let advertise = Advertise::new(format!("t/{number}").parse().unwrap());
        leases.push(advertised(&service, &mut flow, advertise).await);
    }
    flow.started();
    let start = Instant::now();
    let mut topics = Vec::new();
    for _ in 0..5 {
        let (at, sent) = flow.next().await;
        assert!(at - start <= Duration::from_millis(250), "{:?}", at - start);
        flow.agree(&sent);
        topics.push(sent["topic"].as_str().unwrap().to_owned());
    }
    topics.sort();
    assert_eq!(topics, ["t/0", "t/1", "t/2", "t/3", "t/4"]);
    let event = events.next().await.unwrap();
    assert_eq!((event.kind, event.flow.as_str()), (FlowEventKind::FlowStarted, "edge/robot-1"));
    assert_eq!(event.time, "2026-01-01T00:00:00Z");
}

#[tokio::test(start_paused = true)]
async fn after_an_outage_of_the_broker_leases_are_sent_at_once() {
    let hub = MemoryHub::new("t");
    let mut flow = FakeFlow::start(&hub).await;
    let service = service(&hub).await;
    let _lease = advertised(&service, &mut flow, imu()).await;
    hub.cut();
    tokio::time::sleep(Duration::from_secs(20)).await;
    assert!(flow.next_within(Duration::from_millis(1)).await.is_none());
    hub.restore();
    let back = Instant::now();
    let (at, sent) = flow.next().await;
    assert_eq!(sent["topic"], "imu/data");
    assert!(at - back <= Duration::from_millis(250), "{:?}", at - back);
}

#[tokio::test(start_paused = true)]
async fn an_unanswered_advertise_is_sent_again_with_one_id_and_fails_in_time() {
    let hub = MemoryHub::new("t");
    let mut flow = FakeFlow::start(&hub).await;
    let service = service(&hub).await;
    let start = Instant::now();
    let error = service.flow().advertise(imu()).await.unwrap_err();
    assert_eq!(start.elapsed().as_secs(), 10);
    let FlowError::NoAnswer { attempts } = error else {
        panic!("{error}");
    };
    assert!((5..=8).contains(&attempts), "{attempts}");
    let mut ids = Vec::new();
    for _ in 0..attempts {
        ids.push(flow.next().await.1["id"].clone());
    }
    ids.dedup();
    assert_eq!(ids.len(), 1);
    assert_eq!(flow.next().await.1["op"], "withdraw", "it may have taken effect");
}

#[tokio::test(start_paused = true)]
async fn dropping_a_lease_withdraws_it_and_so_does_not_waiting_for_it() {
    let hub = MemoryHub::new("t");
    let mut flow = FakeFlow::start(&hub).await;
    let service = service(&hub).await;
    let lease = advertised(&service, &mut flow, imu()).await;
    drop(lease);
    let (_, sent) = flow.next().await;
    assert_eq!(
        (&sent["op"], &sent["kind"], &sent["topic"]),
        (&json!("withdraw"), &json!("advertise"), &json!("imu/data"))
    );
    flow.agree(&sent);
    assert!(flow.next_within(TTL * 3).await.is_none(), "it is not renewed any more");

    let asking = tokio::time::timeout(Duration::from_millis(10), service.flow().advertise(imu()));
    assert!(asking.await.is_err());
    assert_eq!(flow.next().await.1["op"], "advertise");
    assert_eq!(flow.next().await.1["op"], "withdraw");
}

#[tokio::test(start_paused = true)]
async fn shutdown_withdraws_all_and_ends_all_tasks() {
    let hub = MemoryHub::new("t");
    let tasks = || tokio::runtime::Handle::current().metrics().num_alive_tasks();
    let before = tasks();
    let mut flow = FakeFlow::start(&hub).await;
    let service = service(&hub).await;
    let one = advertised(&service, &mut flow, imu()).await;
    let _two = advertised(&service, &mut flow, Advertise::new("b".parse().unwrap())).await;
    let manager = service.flow().clone();
    let ((), topics) = tokio::join!(service.shutdown(), async {
        let mut topics = Vec::new();
        for _ in 0..2 {
            let (_, sent) = flow.next().await;
            assert_eq!(sent["op"], "withdraw");
            flow.agree(&sent);
            topics.push(sent["topic"].as_str().unwrap().to_owned());
        }
        topics.sort();
        topics
    });
    assert_eq!(topics, ["b", "imu/data"]);
    assert_eq!(one.state(), LeaseState::Ended);
    assert_eq!(tasks(), before);
    assert_eq!(manager.advertise(imu()).await.unwrap_err(), FlowError::Closed);
    drop(one);
    assert!(flow.next_within(TTL * 3).await.is_none());
}

#[tokio::test(start_paused = true)]
async fn values_that_cannot_be_are_refused_without_a_message() {
    let hub = MemoryHub::new("t");
    let mut flow = FakeFlow::start(&hub).await;
    let service = service(&hub).await;
    let advertise = Advertise { rate_hz: Some(0.0), ..imu() };
    let refused = service.flow().advertise(advertise).await.unwrap_err();
    assert!(matches!(refused, FlowError::Invalid { field: "rate_hz", .. }), "{refused}");
    let request = Request { depth: 0, ..Request::new("a".parse().unwrap()) };
    let refused = service.flow().request(request).await.unwrap_err();
    assert!(matches!(refused, FlowError::Invalid { field: "depth", .. }), "{refused}");
    assert!(flow.next_within(TTL).await.is_none());
}
