//! Garbage on the control channel, with the answer, the event and the count of each.

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use blaze_brokers::{Broker, Content, SubscribeOptions, Subscription};
use blaze_tests::wait;
use serde_json::{Value, json};

use super::inside::{DEADLINE, Inside, LIVE_TOPIC, Traffic};
use super::random::Random;

const CONTROL: &str = "blaze/flow/control";
const REPLY: &str = "blaze/reply/hostile-0";

/// A service without SDK on the node hub, and what it hears.
struct Client<'a> {
    inside: &'a Inside,
    broker: blaze_brokers::memory::MemoryBroker,
    replies: Subscription,
    events: Subscription,
}

impl<'a> Client<'a> {
    async fn start(inside: &'a Inside) -> Self {
        let broker = inside.node.broker();
        let many = SubscribeOptions {
            max_messages: 100_000,
            ..SubscribeOptions::default()
        };
        let replies = broker.subscribe(&REPLY.parse().unwrap(), many).await.unwrap();
        let events = broker
            .subscribe(&"blaze/flow/events".parse().unwrap(), many)
            .await
            .unwrap();
        Self {
            inside,
            broker,
            replies,
            events,
        }
    }

    fn say(&self, payload: impl Into<bytes::Bytes>) {
        assert_eq!(
            self.inside.publish(CONTROL, payload),
            blaze_brokers::PublishOutcome::Taken
        );
    }

    /// Answers, until there are that many.
    async fn answers(&mut self, count: usize) -> Vec<Value> {
        heard(&mut self.replies, count).await
    }

    async fn ask(&mut self, message: &Value) -> Value {
        self.say(message.to_string());
        self.answers(1).await.remove(0)
    }

    /// The next event that says a control message was refused.
    async fn refusal(&mut self) -> Value {
        loop {
            let event = heard(&mut self.events, 1).await.remove(0);
            if event["event"] == "lease_refused" {
                return event;
            }
        }
    }

    fn refused(&self) -> u64 {
        self.inside
            .metric("blaze_flow_link_events_total", &["event=\"control_message_refused\""])
    }
}

async fn heard(subscription: &mut Subscription, count: usize) -> Vec<Value> {
    let mut found = Vec::new();
    let mut batch = Vec::new();
    while found.len() < count {
        let more = tokio::time::timeout(DEADLINE, subscription.receive(&mut batch, count - found.len())).await;
        assert!(
            more.is_ok_and(|more| more > 0),
            "{} of {count} came: {found:?}",
            found.len()
        );
        for received in batch.drain(..) {
            let Content::Bare { payload, .. } = received.content else {
                panic!("reserved channels carry JSON as it is")
            };
            found.push(serde_json::from_slice(&payload).expect("JSON"));
        }
    }
    found
}

/// A message that is in order, but for what `changes` put into it.
fn message(op: &str, changes: &Value) -> Value {
    let mut message = json!({"op": op, "topic": "a/b", "service": "hostile", "id": "7", "reply_to": REPLY});
    for (key, value) in changes.as_object().unwrap() {
        message[key] = value.clone();
    }
    message
}

/// Faulty messages with the code and the pointer of the answer.
fn faulty() -> Vec<(Value, &'static str, &'static str)> {
    let long = "x".repeat(201);
    let advertise = |changes: Value| message("advertise", &changes);
    let request = |changes: Value| message("request", &changes);
    let mut all = vec![
        (message("subscribe", &json!({})), "unknown_op", "/op"),
        (advertise(json!({"op": null})), "unknown_op", "/op"),
        (advertise(json!({"op": 7})), "unknown_op", "/op"),
        (advertise(json!({"topic": null})), "invalid_topic", "/topic"),
        (advertise(json!({"topic": "/a"})), "invalid_topic", "/topic"),
        (advertise(json!({"topic": "a//b"})), "invalid_topic", "/topic"),
        (advertise(json!({"topic": "a b"})), "invalid_topic", "/topic"),
        (advertise(json!({"topic": ""})), "invalid_topic", "/topic"),
        (advertise(json!({"topic": long.as_str()})), "invalid_topic", "/topic"),
        (advertise(json!({"topic": "a/*"})), "invalid_topic", "/topic"),
        (advertise(json!({"topic": "ä"})), "invalid_topic", "/topic"),
        (
            advertise(json!({"topic": "blaze/flow/control"})),
            "reserved_topic",
            "/topic",
        ),
        (advertise(json!({"topic": "blaze/x"})), "reserved_topic", "/topic"),
        (advertise(json!({"topic": 3})), "invalid_value", "/topic"),
        (advertise(json!({"service": null})), "invalid_value", "/service"),
        (advertise(json!({"service": "Upper"})), "invalid_value", "/service"),
        (advertise(json!({"service": "-a"})), "invalid_value", "/service"),
        (advertise(json!({"instance": "a b"})), "invalid_value", "/instance"),
        (advertise(json!({"epoch": -1})), "invalid_value", "/epoch"),
        (advertise(json!({"epoch": 1.5})), "invalid_value", "/epoch"),
        (advertise(json!({"epoch": "1"})), "invalid_value", "/epoch"),
        (advertise(json!({"ttl_s": 86_401})), "invalid_value", "/ttl_s"),
        (advertise(json!({"ttl_s": -1})), "invalid_value", "/ttl_s"),
        (advertise(json!({"rate_hz": 0})), "invalid_value", "/rate_hz"),
        (advertise(json!({"rate_hz": -5})), "invalid_value", "/rate_hz"),
        (advertise(json!({"rate_hz": "fast"})), "invalid_value", "/rate_hz"),
        (advertise(json!({"max_bytes": -1})), "invalid_value", "/max_bytes"),
        (
            advertise(json!({"encoding": long.as_str()})),
            "invalid_value",
            "/encoding",
        ),
        (advertise(json!({"encoding": "a\nb"})), "invalid_value", "/encoding"),
        (advertise(json!({"type": long.as_str()})), "invalid_value", "/type"),
        (advertise(json!({"type_hash": 7})), "invalid_value", "/type_hash"),
        (
            advertise(json!({"reliability": "maybe"})),
            "invalid_value",
            "/reliability",
        ),
        (
            advertise(json!({"durability": "persistent"})),
            "invalid_value",
            "/durability",
        ),
        (advertise(json!({"depth": 0})), "invalid_value", "/depth"),
        (advertise(json!({"depth": 65_536})), "invalid_value", "/depth"),
        (advertise(json!({"priority": "urgent"})), "invalid_value", "/priority"),
        (advertise(json!({"lifespan_ms": -1})), "invalid_value", "/lifespan_ms"),
        (
            advertise(json!({"lifespan_ms": 4_294_967_296_u64})),
            "invalid_value",
            "/lifespan_ms",
        ),
        (advertise(json!({"layer": "fog"})), "source_mismatch", "/layer"),
        (advertise(json!({"node": "robot-2"})), "source_mismatch", "/node"),
        (request(json!({"max_rate_hz": 0})), "invalid_value", "/max_rate_hz"),
        (request(json!({"bare": "yes"})), "invalid_value", "/bare"),
        (request(json!({"from": "edge"})), "invalid_value", "/from"),
        (
            request(json!({"from": {"layer": "Edge"}})),
            "invalid_value",
            "/from/layer",
        ),
        (
            request(json!({"from": {"service": 1}})),
            "invalid_value",
            "/from/service",
        ),
        (message("withdraw", &json!({"kind": "both"})), "invalid_value", "/kind"),
    ];
    all.push((advertise(json!({"id": "x".repeat(257)})), "invalid_value", "/id"));
    all
}

#[tokio::test(flavor = "multi_thread", worker_threads = 3)]
async fn faulty_control_messages_are_answered_with_code_and_pointer() {
    let inside = Inside::start().await;
    let traffic = Traffic::start(&inside).await;
    let mut client = Client::start(&inside).await;
    let mut refused = client.refused();

    for (message, code, pointer) in faulty() {
        let answer = client.ask(&message).await;
        assert_eq!(answer["ok"], false, "{message}: {answer}");
        assert_eq!(
            (&answer["error"]["code"], &answer["error"]["pointer"]),
            (&json!(code), &json!(pointer)),
            "{message}: {answer}"
        );
        assert!(
            answer["error"]["detail"]
                .as_str()
                .is_some_and(|detail| !detail.is_empty()),
            "{answer}"
        );
        if pointer != "/id" {
            assert_eq!(answer["id"], "7", "{message}: {answer}");
        }
        let event = client.refusal().await;
        assert_eq!(
            (&event["code"], &event["flow"]),
            (&json!(code), &json!("edge/robot-1")),
            "{event}"
        );
        refused += 1;
        assert_eq!(client.refused(), refused, "{message} is counted once");
    }

    // A newer life holds the lease; after its withdrawal the older one may have it.
    let lease = |epoch: u64| message("advertise", &json!({"epoch": epoch}));
    assert_eq!(
        client.ask(&lease(5)).await,
        json!({"id": "7", "ok": true, "flow": "edge/robot-1", "lease_s": 15})
    );
    let stale = client.ask(&lease(4)).await;
    assert_eq!(
        (&stale["error"]["code"], &stale["error"]["pointer"]),
        (&json!("stale_epoch"), &json!("/epoch"))
    );
    assert_eq!(client.ask(&message("withdraw", &json!({"epoch": 5}))).await["ok"], true);
    assert_eq!(client.ask(&lease(4)).await["ok"], true);
    assert_eq!(
        client.ask(&message("request", &json!({"ttl_s": 0}))).await["lease_s"],
        0
    );

    // Of an array each object has an answer of its own, and faults do not spread.
    let array = json!([
        lease(9),
        message("advertise", &json!({"topic": "a//b"})),
        17,
        lease(9),
        message("x", &json!({}))
    ]);
    client.say(array.to_string());
    let answers = client.answers(4).await;
    let told: Vec<(bool, &str)> = answers
        .iter()
        .map(|answer| (answer["ok"] == true, answer["error"]["pointer"].as_str().unwrap_or("")))
        .collect();
    assert_eq!(
        told,
        [(true, ""), (false, "/1/topic"), (true, ""), (false, "/4/op")],
        "{answers:?}"
    );

    traffic.end().await;
    inside.end().await;
}

/// Payloads that cannot be answered, with the code of the event.
fn unanswerable() -> Vec<(Vec<u8>, &'static str)> {
    let good = message("advertise", &json!({})).to_string();
    let many: Vec<Value> = (0..201).map(|_| message("advertise", &json!({}))).collect();
    let mut long = good.trim_end_matches('}').to_owned();
    write!(long, ",\"pad\":\"{}\"}}", "x".repeat(64 * 1024 + 1 - long.len() - 10)).unwrap();
    assert_eq!(long.len(), 64 * 1024 + 1);
    let deep = format!("{{\"op\":{}{}}}", "[".repeat(30_000), "]".repeat(30_000));
    let deep_array = format!("{}{}", "[".repeat(32_000), "]".repeat(32_000));
    vec![
        (b"".to_vec(), "invalid_json"),
        (b"{".to_vec(), "invalid_json"),
        (b"\xff\xfe\xfd".to_vec(), "invalid_json"),
        (b"{\"op\":\"advertise\xff\"}".to_vec(), "invalid_json"),
        (b"{}{}".to_vec(), "invalid_json"),
        (b"[{},]".to_vec(), "invalid_json"),
        (vec![0; 4096], "invalid_json"),
        (good.as_bytes()[..good.len() - 1].to_vec(), "invalid_json"),
        (deep.into_bytes(), "invalid_json"),
        (deep_array.into_bytes(), "invalid_json"),
        (b"{\"op\":1e999999}".to_vec(), "invalid_json"),
        (b"null".to_vec(), "invalid_value"),
        (b"7".to_vec(), "invalid_value"),
        (b"\"text\"".to_vec(), "invalid_value"),
        (b"BLZ1".to_vec(), "invalid_json"),
        (long.into_bytes(), "invalid_value"),
        (serde_json::to_vec(&many).unwrap(), "invalid_value"),
        // In order, but the answer would go to a place that is not for answers.
        (
            message("advertise", &json!({"reply_to": LIVE_TOPIC}))
                .to_string()
                .into_bytes(),
            "invalid_value",
        ),
        (
            message("advertise", &json!({"reply_to": CONTROL}))
                .to_string()
                .into_bytes(),
            "invalid_value",
        ),
        (
            message("advertise", &json!({"reply_to": "blaze/reply/"}))
                .to_string()
                .into_bytes(),
            "invalid_value",
        ),
        (
            message("advertise", &json!({"reply_to": "blaze/reply/../x y"}))
                .to_string()
                .into_bytes(),
            "invalid_value",
        ),
        (
            message("advertise", &json!({"reply_to": 7})).to_string().into_bytes(),
            "invalid_value",
        ),
    ]
}

#[tokio::test(flavor = "multi_thread", worker_threads = 3)]
async fn payloads_that_cannot_be_answered_show_as_event_and_count() {
    let inside = Inside::start().await;
    let traffic = Traffic::start(&inside).await;
    let mut client = Client::start(&inside).await;
    let before = client.refused();
    let payloads = unanswerable();
    for (index, (payload, code)) in payloads.iter().enumerate() {
        client.say(payload.clone());
        let event = client.refusal().await;
        let text = String::from_utf8_lossy(&payload[..payload.len().min(80)]).into_owned();
        assert_eq!(event["code"], *code, "{text}: {event}");
        assert_eq!(client.refused(), before + index as u64 + 1, "{text}");
    }
    // Noise, as fast as it goes. Nothing of it is a lease.
    let mut random = Random::new(11);
    let good = message("advertise", &json!({"topic": "noise"}))
        .to_string()
        .into_bytes();
    for _ in 0..2000 {
        let mut noise = good.clone();
        let at = random.below(noise.len());
        noise[at] ^= 1 << random.below(8);
        noise.truncate(random.below(noise.len()));
        client.say(noise);
    }
    wait::until(
        "noise counted",
        DEADLINE,
        || client.refused() == before + payloads.len() as u64 + 2000,
        || format!("{} counted", client.refused() - before),
    )
    .unwrap();
    // A frame where only JSON may be.
    let frame = super::inside::frame_bytes(&super::inside::header(LIVE_TOPIC, 1, 1), b"x");
    client.say(frame);
    assert_eq!(
        client.refusal_count_after(before + payloads.len() as u64 + 2001),
        Ok(())
    );
    drop(client.broker);
    traffic.end().await;
    inside.end().await;
}

impl Client<'_> {
    fn refusal_count_after(&self, expected: u64) -> Result<(), String> {
        wait::until(
            "the count",
            DEADLINE,
            || self.refused() == expected,
            || format!("{}", self.refused()),
        )
        .map(|_| ())
        .map_err(|error| error.to_string())
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 3)]
async fn the_10_001st_lease_is_refused_and_the_others_stay() {
    let inside = Inside::start().await;
    let traffic = Traffic::start(&inside).await;
    let mut client = Client::start(&inside).await;
    // The traffic holds two.
    let leases = |range: std::ops::Range<usize>| -> Value {
        let one = |number: usize| {
            message(
                "advertise",
                &json!({"topic": format!("flood/t{number}"), "id": number.to_string()}),
            )
        };
        range.map(one).collect()
    };
    let begin = Instant::now();
    for from in (0..9800).step_by(200) {
        client.say(leases(from..from + 200).to_string());
    }
    client.say(leases(9800..9998).to_string());
    let answers = client.answers(9998).await;
    assert!(answers.iter().all(|answer| answer["ok"] == true), "room for 10,000");
    let taken = begin.elapsed();
    let answer = client.ask(&leases(9998..9999)[0]).await;
    assert_eq!(
        (&answer["id"], &answer["error"]["code"]),
        (&json!("9998"), &json!("too_many_leases")),
        "{answer}"
    );
    client.say(leases(9998..10_000).to_string());
    let answers = client.answers(2).await;
    assert_eq!(answers[1]["error"]["pointer"], "/1", "{answers:?}");
    // One that is there may be renewed.
    assert_eq!(client.ask(&leases(17..18)[0]).await["ok"], true);
    let metric = |kind: &str| inside.metric("blaze_flow_leases", &[&format!("kind=\"{kind}\"")]);
    assert_eq!((metric("advertise"), metric("request")), (9999, 1));
    traffic.flows();
    assert!(taken < Duration::from_secs(10), "9,998 leases took {taken:?}");

    // Room again once one is withdrawn.
    assert_eq!(
        client.ask(&message("withdraw", &json!({"topic": "flood/t17"}))).await["ok"],
        true
    );
    assert_eq!(client.ask(&leases(9998..9999)[0]).await["ok"], true);
    eprintln!("9,998 leases in {taken:?}");
    traffic.end().await;
    inside.end().await;
}
