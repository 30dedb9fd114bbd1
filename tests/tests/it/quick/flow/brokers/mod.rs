//! A whole flow with brokers that have a server: leases that outlive it, scopes that are another's,
//! writers that fail and messages that are dropped after they were taken.

mod fake;
mod json;

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::{
    Broker, BrokerKind, Content, Health, Later, PublishOutcome, PublisherOptions, Received,
    SubscribeOptions,
};
use blaze_domain::LayerKind;
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::FlowSection;
use blaze_flow::flow::settings::{FlowSettings, LiveSettings};
use blaze_flow::flow::{FlowOptions, LayerBroker, RunningFlow};
use blaze_flow::world::LayerScopeId;
use blaze_runtime::supervisor::Supervisor;
use bytes::Bytes;
use fake::{FakeBroker, Server};
use serde_json::{Value, json};

const DEADLINE: Duration = Duration::from_secs(10);

/// A flow and its connections.
struct Node {
    flow: RunningFlow,
    supervisor: Supervisor,
    node: Arc<FakeBroker>,
    layer: Arc<FakeBroker>,
}

impl Node {
    async fn start(me: &str, node: &Server, layer: &Server) -> Self {
        let supervisor = Supervisor::new(me.to_owned());
        let (node, layer) = (node.connect(), layer.connect());
        let settings = FlowSettings {
            gateway: blaze_domain::node_file::AutoBool::Auto,
            me: me.parse().unwrap(),
            kind: LayerKind::Fog,
            admin: "127.0.0.1:0".parse().unwrap(),
            inter: None,
            ros2: None,
            live: LiveSettings::from(&FlowSection::default()),
        };
        let options = FlowOptions {
            settings,
            node: Some(Arc::clone(&node) as Arc<dyn Broker>),
            layer: Some(LayerBroker {
                broker: Arc::clone(&layer) as Arc<dyn Broker>,
                id: LayerScopeId::kafka(""),
            }),
            state_dir: None,
        };
        let flow = blaze_flow::flow::start(options, supervisor.clone()).await.unwrap();
        Self { flow, supervisor, node, layer }
    }

    async fn started(me: &str, node: &Server, layer: &Server) -> Self {
        let started = Self::start(me, node, layer).await;
        tokio::time::timeout(DEADLINE, started.flow.ready()).await.unwrap();
        started
    }

    /// Ends the flow; fails if a task of it did.
    async fn end(self) {
        assert_eq!(self.supervisor.failure(), None);
        self.flow.shutdown().await;
    }

    fn get(&self, path: &str) -> Value {
        let mut stream = TcpStream::connect(self.flow.admin()).unwrap();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        let (_, body) = answer.split_once("\r\n\r\n").unwrap();
        serde_json::from_str(body).unwrap_or_else(|_| json!(body))
    }

    fn check(&self, name: &str) -> (String, String) {
        let check = &self.get("/readyz")["checks"][name];
        let text = |key: &str| check[key].as_str().unwrap_or_default().to_owned();
        (text("status"), text("detail"))
    }

    fn why(&self, topic: &str) -> (String, String) {
        let why = self.get(&format!("/v1/why?topic={topic}"));
        let failing = why["steps"].as_array().unwrap().iter().find(|step| step["ok"] == false);
        let detail = failing.map_or(Value::Null, |step| step["detail"].clone());
        (why["code"].as_str().unwrap().to_owned(), detail.as_str().unwrap_or_default().to_owned())
    }

    fn bridges(&self) -> Vec<Value> {
        self.get("/v1/bridges")["bridges"].as_array().unwrap().clone()
    }

    /// `id state` of each bridge.
    fn ways(&self) -> Vec<String> {
        let text = |row: &Value| {
            format!("{} {}", row["id"].as_str().unwrap(), row["state"].as_str().unwrap())
        };
        self.bridges().iter().map(text).collect()
    }
}

/// Waits until a condition holds. The flow runs on other threads.
async fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let start = Instant::now();
    while !tokio::task::block_in_place(&mut holds) {
        assert!(start.elapsed() < DEADLINE, "{what}");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

fn send(server: &Server, channel: &str, payload: impl Into<Bytes>) {
    let client = server.hub.broker();
    let publisher =
        client.publisher(&channel.parse().unwrap(), PublisherOptions::default()).unwrap();
    assert_eq!(publisher.publish_bare(&payload.into(), None), PublishOutcome::Taken);
}

fn control(server: &Server, json: &Value) {
    send(server, "blaze/flow/control", json.to_string());
}

fn lease(op: &str, topic: &str) -> Value {
    json!({"op": op, "topic": topic, "service": "svc", "ttl_s": 60})
}

/// A publisher on the node scope and a consumer on the layer scope.
async fn make_route(node: &Node, of_node: &Server, of_layer: &Server, topic: &str) {
    control(of_node, &lease("advertise", topic));
    control(of_layer, &lease("request", topic));
    let expected = format!("{topic}|node>layer|fog up");
    until("the bridge is up", || node.ways().contains(&expected)).await;
}

async fn receive(subscription: &mut blaze_brokers::Subscription) -> Received {
    let mut batch = Vec::new();
    tokio::time::timeout(DEADLINE, subscription.receive(&mut batch, 1)).await.unwrap();
    batch.remove(0)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn leases_survive_a_restart_of_the_flow() {
    let (redis, kafka) = (Server::new(BrokerKind::Redis), Server::new(BrokerKind::Kafka));
    let first = Node::started("fog/fog-1", &redis, &kafka).await;
    make_route(&first, &redis, &kafka, "imu/data").await;
    control(&redis, &lease("request", "gone"));
    control(&redis, &lease("withdraw", "gone"));
    until("the leases are kept", || redis.leases().len() == 1 && kafka.leases().len() == 1).await;
    assert_eq!(kafka.leases().keys().next().unwrap(), "request|imu/data|fog||svc|0");
    assert!(kafka.channels().contains("imu/data"));
    until("what was withdrawn is not kept", || redis.writes() == 3).await;
    control(&redis, &lease("advertise", "imu/data"));
    control(&redis, &lease("request", "last"));
    until("the last is kept", || redis.leases().len() == 2).await;
    assert_eq!(redis.writes(), 4, "a renewal is not written");
    control(&redis, &lease("withdraw", "last"));
    until("it is gone", || redis.leases().len() == 1).await;
    first.end().await;

    redis.put_lease("request|x|fog|fog-1|svc|0", "{ no json");
    redis.put_lease("request|x|fog|fog-2|svc|0", &lease("request", "x").to_string());
    redis.set_mute(true);
    let second = Node::start("fog/fog-1", &redis, &kafka).await;
    until("it says what it waits for", || {
        let (status, detail) = second.check("node_broker");
        status == "failed" && detail.ends_with("reading leases")
    })
    .await;
    assert!(second.ways().is_empty());
    redis.set_mute(false);
    tokio::time::timeout(DEADLINE, second.flow.ready()).await.unwrap();
    until("nobody said anything and it flows", || second.ways() == ["imu/data|node>layer|fog up"])
        .await;
    let metrics = second.get("/metrics").to_string();
    assert!(
        metrics.contains("blaze_flow_link_events_total{event=\\\"kept_lease_skipped\\\"} 1"),
        "{metrics}"
    );
    assert!(
        redis.leases().contains_key("request|x|fog|fog-2|svc|0"),
        "another node's is left alone"
    );

    let consumer = kafka.hub.broker();
    let channel: ChannelName = "imu/data".parse().unwrap();
    let mut subscription = consumer.subscribe(&channel, SubscribeOptions::default()).await.unwrap();
    send(&redis, "imu/data", "{}");
    let Content::Frame(frame) = receive(&mut subscription).await.content else {
        panic!("a flow writes frames to Kafka");
    };
    assert_eq!((frame.hops(), frame.origin_service(), frame.origin_instance()), (1, "svc", "0"));
    second.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_other_flows_say_faster_than_it_can_be_read_is_counted() {
    let (redis, kafka) = (Server::new(BrokerKind::Redis), Server::new(BrokerKind::Kafka));
    let node = Node::started("fog/fog-1", &redis, &kafka).await;
    let client = kafka.hub.broker();
    let publisher = client
        .publisher(&"blaze/flow/peers".parse().unwrap(), PublisherOptions::default())
        .unwrap();
    let counted = |node: &Node| {
        let metrics = node.get("/metrics").to_string();
        let (_, rest) = metrics.split_once("event=\\\"replica_message_overrun\\\"} ").unwrap();
        rest.starts_with(|digit: char| ('1'..='9').contains(&digit))
    };
    assert!(!counted(&node));
    // More than wait at a time, and longer than are looked at.
    let message = Bytes::from(vec![0; 5_000]);
    until("the overrun is counted", || {
        for _ in 0..50_000 {
            assert_eq!(publisher.publish_bare(&message, None), PublishOutcome::Taken);
        }
        counted(&node)
    })
    .await;
    node.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_scope_of_another_flow_is_told_and_not_bridged() {
    let (redis, kafka) = (Server::new(BrokerKind::Redis), Server::new(BrokerKind::Kafka));
    let node = Node::started("fog/fog-1", &redis, &kafka).await;
    make_route(&node, &redis, &kafka, "imu/data").await;
    node.node.set_health(Health::InUse, "scope_in_use: edge/robot-7 holds it");
    until("the bridge ends", || node.ways().is_empty()).await;
    until("/readyz says whose it is", || {
        node.check("node_broker") == ("failed".into(), "scope_in_use: edge/robot-7 holds it".into())
    })
    .await;
    let (code, detail) = node.why("imu/data");
    assert_eq!(code, "scope_in_use");
    assert!(detail.contains("edge/robot-7"), "{detail}");
    node.node.set_health(Health::Up, "redis 7.0.15");
    until("it is back", || node.ways() == ["imu/data|node>layer|fog up"]).await;

    node.layer.set_health(Health::Down, "connection refused");
    until("broker_down", || node.why("imu/data").0 == "broker_down").await;
    let (_, detail) = node.why("imu/data");
    assert!(detail.contains("connection refused"), "{detail}");
    node.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_two_layers_on_one_kafka_the_later_stands_back() {
    let kafka = Server::new(BrokerKind::Kafka);
    let redis = [Server::new(BrokerKind::Redis), Server::new(BrokerKind::Redis)];
    let first = Node::started("fog/fog-1", &redis[0], &kafka).await;
    let second = Node::start("cloud/cloud-1", &redis[1], &kafka).await;
    until("the later one stands back", || {
        second.layer.standing_back().as_deref() == Some("fog/fog-1")
    })
    .await;
    until("/readyz says so", || {
        second.check("layer_broker") == ("failed".into(), "fog/fog-1 uses it".into())
    })
    .await;
    assert_eq!(first.layer.standing_back(), None);
    assert_eq!(first.check("layer_broker").0, "ok");
    control(&redis[1], &lease("advertise", "imu/data"));
    until("why says so", || second.why("imu/data").0 == "scope_in_use").await;
    first.end().await;
    tokio::time::timeout(DEADLINE, second.flow.ready()).await.unwrap();
    assert_eq!(second.layer.standing_back(), None);
    second.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bridge_without_a_writer_has_failed_and_is_tried_again() {
    let (redis, kafka) = (Server::new(BrokerKind::Redis), Server::new(BrokerKind::Kafka));
    let node = Node::started("fog/fog-1", &redis, &kafka).await;
    kafka.refuse("imu/data", true);
    control(&redis, &lease("advertise", "imu/data"));
    control(&kafka, &lease("request", "imu/data"));
    until("it has failed", || node.ways() == ["imu/data|node>layer|fog failed"]).await;
    assert!(node.bridges()[0]["detail"].as_str().unwrap().contains("no such names"));
    let (code, detail) = node.why("imu/data");
    assert_eq!(code, "bridge_failed");
    assert!(detail.contains("no such names"), "{detail}");
    let metrics = node.get("/metrics").to_string();
    assert!(metrics.contains("blaze_flow_bridges{state=\\\"failed\\\"} 1"), "{metrics}");
    kafka.refuse("imu/data", false);
    until("it works", || node.ways() == ["imu/data|node>layer|fog up"]).await;
    node.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_broker_drops_later_is_counted_and_explained() {
    let (redis, kafka) = (Server::new(BrokerKind::Redis), Server::new(BrokerKind::Kafka));
    let node = Node::started("fog/fog-1", &redis, &kafka).await;
    make_route(&node, &redis, &kafka, "camera").await;
    let later = Later { queued: 3, too_large: 2, lifespan: 1, ..Later::default() };
    kafka.set_later("camera", later);
    for _ in 0..10 {
        send(&redis, "camera", vec![7; 1000]);
    }
    // What the broker says of later is there at once, what it is about comes one by one.
    until("all came in", || node.bridges()[0]["in"]["messages"] == 10).await;
    let counts = || {
        let row = node.bridges().remove(0);
        let number = |key: &str, part: &str| row[key][part].as_u64().unwrap_or(0);
        assert_eq!(
            number("in", "messages"),
            number("out", "messages")
                + number("dropped", "too_large")
                + number("dropped", "lifespan")
                + row["queued"].as_u64().unwrap()
        );
        (
            number("in", "messages"),
            number("out", "messages"),
            number("out", "bytes"),
            row["queued"].as_u64().unwrap(),
        )
    };
    assert_eq!(counts(), (10, 4, 4000, 3));
    until("too large", || node.why("camera").0 == "too_large").await;
    kafka.set_later("camera", Later { queued: 0, too_large: 5, ..later });
    assert_eq!(counts(), (10, 4, 4000, 0));

    // A plan that is made anew keeps the writer, and its account.
    control(
        &kafka,
        &json!({
            "op": "request",
            "topic": "camera",
            "service": "other",
            "max_rate_hz": 1000,
            "ttl_s": 60,
        }),
    );
    control(
        &kafka,
        &json!({
            "op": "request",
            "topic": "camera",
            "service": "svc",
            "max_rate_hz": 1000,
            "ttl_s": 60,
        }),
    );
    until("the lane has the new rate", || node.bridges()[0]["max_rate_hz"] == 1000.0).await;
    assert_eq!(kafka.publishers("camera"), 1);
    assert_eq!(counts(), (10, 4, 4000, 0));
    node.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_summary_says_what_the_lists_say_and_a_question_may_be_about_one_topic() {
    let (redis, kafka) = (Server::new(BrokerKind::Redis), Server::new(BrokerKind::Kafka));
    let node = Node::started("fog/fog-1", &redis, &kafka).await;
    make_route(&node, &redis, &kafka, "imu/data").await;
    make_route(&node, &redis, &kafka, "odom").await;
    control(&redis, &lease("advertise", "lonely"));
    send(&redis, "imu/data", vec![1; 100]);
    until("the summary agrees", || {
        let summary = node.get("/v1/summary");
        summary["topics"] == json!({"flowing": 2, "no_request": 1})
            && summary["bridges"] == json!({"up": 2})
            && summary["out"] == json!({"messages": 1, "bytes": 100})
    })
    .await;
    let summary = node.get("/v1/summary");
    assert_eq!((&summary["state"], &summary["feasible"]), (&json!("ready"), &json!(true)));

    let rows = node.get("/v1/bridges?topic=imu/data");
    assert_eq!(rows["bridges"].as_array().unwrap().len(), 1);
    assert!(rows["bridges"][0]["age_ms"]["p50"].is_number(), "{rows}");
    let topics = node.get("/v1/topics?topic=lonely");
    assert_eq!(
        (topics["topics"].as_array().unwrap().len(), &topics["topics"][0]["state"]),
        (1, &json!("no_request"))
    );
    let metrics = node.get("/metrics").to_string();
    let age = "blaze_flow_delivery_age_seconds_count{topic=\\\"imu/data\\\",to=\\\"layer\\\",from_layer=\\\"fog\\\"} 1";
    assert!(metrics.contains(age), "{metrics}");

    // What ended stays in the sums.
    control(&redis, &json!({"op": "withdraw", "topic": "lonely", "service": "svc"}));
    control(&redis, &json!({"op": "withdraw", "topic": "imu/data", "service": "svc"}));
    until("states follow", || {
        node.get("/v1/summary")["topics"] == json!({"flowing": 1, "no_advertise": 1})
    })
    .await;
    assert_eq!(node.get("/v1/summary")["out"]["messages"], 1);
    node.end().await;
}
