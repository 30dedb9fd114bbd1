//! Requests for JSON, whatever is published.

use std::fs;

use blaze_brokers::Subscription;
use blaze_brokers::memory::MemoryBroker;
use blaze_domain::node_file::{Ros2Live, TopicPattern};
use blaze_domain::{Origin, WriterId};
use blaze_proto::{Frame, Header};

use super::*;

/// An advertisement of CDR of a type.
fn advertise_cdr(topic: &str, type_name: &str) -> Value {
    let mut message = lease("advertise", topic);
    message["encoding"] = json!("application/cdr");
    message["type"] = json!(type_name);
    message
}

fn request_json(topic: &str) -> Value {
    let mut message = lease("request", topic);
    message["json"] = json!(true);
    message
}

/// A client that reads a channel.
struct Client {
    subscription: Subscription,
    _broker: MemoryBroker,
}

async fn listen(server: &Server, channel: &str) -> Client {
    let broker = server.hub.broker();
    let channel = channel.parse().unwrap();
    let subscription = broker.subscribe(&channel, SubscribeOptions::default()).await.unwrap();
    Client { subscription, _broker: broker }
}

async fn text(client: &mut Client) -> String {
    match receive(&mut client.subscription).await.content {
        Content::Bare { payload, .. } => String::from_utf8(payload.to_vec()).unwrap(),
        other => panic!("{other:?}"),
    }
}

/// A flow with a publisher of CDR on its node, and a request for JSON on its layer.
async fn started(topic: &str, type_name: &str) -> (Node, Server, Server) {
    let (redis, kafka) = (Server::new(BrokerKind::Redis), Server::new(BrokerKind::Kafka));
    let node = Node::started("fog/fog-1", &redis, &kafka).await;
    control(&redis, &advertise_cdr(topic, type_name));
    control(&kafka, &request_json(topic));
    let expected = format!("{topic}|node>layer|fog|json up");
    until("the bridge is up", || node.ways().contains(&expected)).await;
    assert!(kafka.channels().contains(&format!("blaze/json/{topic}")));
    (node, redis, kafka)
}

/// The CDR of a `std_msgs/msg/String`.
fn string(text: &str) -> Vec<u8> {
    let mut cdr = vec![0, 1, 0, 0];
    cdr.extend((text.len() as u32 + 1).to_le_bytes());
    cdr.extend(text.as_bytes());
    cdr.push(0);
    cdr
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn ros_messages_become_json() {
    let (node, redis, kafka) = started("cmd_vel", "geometry_msgs/msg/Twist").await;
    let mut copies = listen(&kafka, "blaze/json/cmd_vel").await;
    let mut cdr = vec![0, 1, 0, 0];
    for value in [0.5_f64, 0.0, 0.0, 0.0, 0.0, -0.25] {
        cdr.extend(value.to_le_bytes());
    }
    send(&redis, "cmd_vel", cdr.clone());
    let twist = r#"{"linear":{"x":0.5,"y":0.0,"z":0.0},"angular":{"x":0.0,"y":0.0,"z":-0.25}}"#;
    assert_eq!(text(&mut copies).await, twist);

    let mut events = listen(&redis, "blaze/flow/events").await;
    send(&redis, "cmd_vel", cdr[..20].to_vec());
    let event: Value = serde_json::from_str(&text(&mut events).await).unwrap();
    assert_eq!(event["event"], "convert_failed");
    assert_eq!((&event["topic"], &event["code"]), (&json!("cmd_vel"), &json!("convert_error")));
    let detail = "/linear/z: the CDR ends: 8 bytes wanted, 0 left";
    assert_eq!(event["detail"], detail);
    let why = node.get("/v1/why?topic=cmd_vel");
    assert_eq!((&why["code"], &why["verdict"]), (&json!("convert_error"), &json!("degraded")));
    let steps = why["steps"].as_array().unwrap();
    assert!(steps.iter().any(|step| step["detail"] == detail), "{steps:?}");
    assert_eq!(node.bridges()[0]["dropped"], json!({"convert_error": 1}));
    send(&redis, "cmd_vel", cdr);
    assert_eq!(text(&mut copies).await, twist, "the next one passes");
    let metrics = node.get("/metrics").to_string();
    let counted = r#"blaze_flow_converted_total{form=\"json\",topic=\"cmd_vel\"} 2"#;
    assert!(metrics.contains(counted), "{metrics}");
    assert!(metrics.contains("blaze_flow_convert_seconds_total"));
    node.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn json_goes_as_it_is_to_bare_and_json_requests() {
    let (redis, kafka) = (Server::new(BrokerKind::Redis), Server::new(BrokerKind::Kafka));
    let node = Node::started("fog/fog-1", &redis, &kafka).await;
    let mut advertise = lease("advertise", "odom");
    advertise["encoding"] = json!("application/json");
    control(&redis, &advertise);
    let mut both = request_json("odom");
    both["bare"] = json!(true);
    control(&redis, &both);
    until("both bridges are up", || {
        node.ways() == ["odom|node>node|fog|bare up", "odom|node>node|fog|json up"]
    })
    .await;
    let mut bare = listen(&redis, "blaze/bare/odom").await;
    let mut copies = listen(&redis, "blaze/json/odom").await;
    let odd = r#"{ "x" : 1e3,  "y": null}"#;
    send(&redis, "odom", odd);
    assert_eq!((text(&mut bare).await.as_str(), text(&mut copies).await.as_str()), (odd, odd));
    node.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn small_and_large_messages_of_a_writer_stay_in_order() {
    const MESSAGES: u64 = 400;
    let (node, redis, kafka) = started("log", "std_msgs/msg/String").await;
    let mut copies = listen(&kafka, "blaze/json/log").await;
    let client = redis.hub.broker();
    let publisher = client.publisher(&"log".parse().unwrap(), PublisherOptions::default()).unwrap();
    let origin = Origin { layer: "fog".into(), node: "fog-1".into(), ..Origin::default() };
    for sequence in 1..=MESSAGES {
        let length = if sequence.is_multiple_of(3) { 30_000 } else { 10 };
        let header = Header {
            encoding: "application/cdr; type=std_msgs/msg/String".into(),
            ..Header::new("log", origin.clone(), WriterId([7; 16]), sequence, 1)
        };
        let payload = string(&format!("{sequence} {}", "x".repeat(length)));
        let frame = Frame::new(&header, payload.into()).unwrap();
        assert_eq!(publisher.publish(&frame, None), PublishOutcome::Taken);
    }
    for sequence in 1..=MESSAGES {
        let text = text(&mut copies).await;
        assert!(text.starts_with(&format!(r#"{{"data":"{sequence} x"#)), "{}", &text[..20]);
    }
    assert_eq!(node.bridges()[0]["dropped"], json!({}));
    node.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_type_of_a_folder_is_known_once_the_folder_is_named() {
    let (node, redis, kafka) = started("level", "tank_msgs/msg/Level").await;
    let mut copies = listen(&kafka, "blaze/json/level").await;
    let mut events = listen(&redis, "blaze/flow/events").await;
    let seven = [0, 1, 0, 0, 7, 0, 0, 0];
    send(&redis, "level", seven.to_vec());
    let event: Value = serde_json::from_str(&text(&mut events).await).unwrap();
    assert_eq!(
        (&event["event"], &event["code"]),
        (&json!("convert_failed"), &json!("type_unknown"))
    );
    assert_eq!(event["detail"], "no definition of tank_msgs/msg/Level");
    assert_eq!(
        node.why("level"),
        ("type_unknown".into(), "no definition of tank_msgs/msg/Level".into())
    );

    let home = tempfile::tempdir().unwrap();
    fs::create_dir_all(home.path().join("tank_msgs/msg")).unwrap();
    fs::write(home.path().join("tank_msgs/msg/Level.msg"), "int32 litres\n").unwrap();
    let ros2 = Ros2Live {
        allow: vec![TopicPattern::all()],
        deny: Vec::new(),
        system: false,
        announce: true,
        interfaces: vec!["/no/such/folder".into(), home.path().to_owned()],
    };
    let live = LiveSettings { ros2: Some(ros2), ..LiveSettings::from(&FlowSection::default()) };
    node.flow.reload(live);
    send(&redis, "level", seven.to_vec());
    assert_eq!(text(&mut copies).await, r#"{"litres":7}"#);
    node.end().await;
}
