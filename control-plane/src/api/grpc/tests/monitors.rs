//! Streams of monitors, and what REST shows of them.

use std::pin::Pin;

use axum::extract::ConnectInfo;
use blaze_proto::v1::report_request::Msg as Reported;
use blaze_proto::v1::report_response::Msg as Sent;
use blaze_proto::v1::status_service_client::StatusServiceClient;
use futures::Stream;
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio_stream::wrappers::ReceiverStream;
use tonic::codec::CompressionEncoding;
use tonic::{Status, Streaming};

use super::*;

const SOON: Duration = Duration::from_secs(10);

struct Monitor {
    requests: mpsc::Sender<v1::ReportRequest>,
    responses: mpsc::Receiver<Result<Sent, Status>>,
    /// Reads, as a connection would: without that nothing moves in either direction.
    _reading: JoinSet<()>,
}

async fn read(
    mut stream: Streaming<v1::ReportResponse>,
    responses: mpsc::Sender<Result<Sent, Status>>,
) {
    while let Some(message) = stream.message().await.transpose() {
        if responses.send(message.map(|message| message.msg.unwrap())).await.is_err() {
            return;
        }
    }
}

fn hello(layer: &str, node: &str, epoch: u64) -> v1::MonitorHello {
    v1::MonitorHello {
        protocol: 1,
        layer: layer.into(),
        node: node.into(),
        version: "1.0".into(),
        epoch,
        metrics_address: format!("{node}:9103"),
    }
}

fn summary(state: &str, problems: &Value) -> String {
    json!({
        "health": { "state": state, "since": "2026-01-01T00:00:00.000Z", "problems": problems },
        "node": { "cpu_ratio": 0.25 },
        "flows": [{ "flow": "edge/robot-1", "state": "ready", "links": [] }],
    })
    .to_string()
}

impl Monitor {
    async fn open(
        fixture: &Fixture,
        token: Option<&str>,
        hello: v1::MonitorHello,
    ) -> Result<Self, Status> {
        let (requests, receiver) = mpsc::channel(16);
        let first = v1::ReportRequest { msg: Some(Reported::Hello(hello)) };
        requests.send(first).await.unwrap();
        let origin = "http://localhost:50051".parse().unwrap();
        let mut client = StatusServiceClient::with_origin(fixture.router.clone(), origin)
            .send_compressed(CompressionEncoding::Gzip);
        let mut request = Request::new(ReceiverStream::new(receiver));
        if let Some(token) = token {
            let value = format!("Bearer {token}").parse().unwrap();
            request.metadata_mut().insert("authorization", value);
        }
        let (sender, responses) = mpsc::channel(16);
        let mut reading = JoinSet::new();
        reading.spawn(read(client.report(request).await?.into_inner(), sender));
        Ok(Self { requests, responses, _reading: reading })
    }

    async fn send(&self, message: Reported) {
        self.requests.send(v1::ReportRequest { msg: Some(message) }).await.unwrap();
    }

    async fn summary(&self, json: String) {
        self.send(Reported::Summary(v1::Summary { json })).await;
    }

    async fn next(&mut self) -> Option<Result<Sent, Status>> {
        tokio::time::timeout(SOON, self.responses.recv()).await.unwrap()
    }
}

/// Layers edge and cloud, a node in each.
async fn with_nodes(fixture: &Fixture) {
    let item = |kind, name: &str, spec: Value| v1::ApplyItem {
        document: Some(v1::Document {
            r#ref: reference(kind, name),
            spec_json: spec.to_string(),
            ..Default::default()
        }),
        delete: false,
    };
    let items = vec![
        item(v1::Kind::Layer, "edge", json!({ "kind": "edge" })),
        item(v1::Kind::Layer, "cloud", json!({ "kind": "cloud" })),
        item(v1::Kind::Node, "robot-1", json!({ "layer": "edge" })),
        item(v1::Kind::Node, "cloud-1", json!({ "layer": "cloud" })),
    ];
    let request = v1::ApplyRequest { items, ..Default::default() };
    let mut request = Request::new(request);
    let value = format!("Bearer {}", fixture.token("admin", 3600)).parse().unwrap();
    request.metadata_mut().insert("authorization", value);
    fixture.client().apply(request).await.unwrap();
}

async fn eventually(what: &str, mut is_so: impl AsyncFnMut() -> bool) {
    let waiting = async {
        while !is_so().await {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    assert!(tokio::time::timeout(SOON, waiting).await.is_ok(), "{what}");
}

fn counted(fixture: &Fixture, reason: &str) -> u64 {
    let refused = fixture.core.status_metrics();
    refused.count(reason)
}

#[tokio::test]
async fn only_the_monitor_of_a_known_node_of_its_layer_reports() {
    let fixture = Fixture::guarded().await;
    with_nodes(&fixture).await;
    let worker = fixture.token_for("worker", Some("edge"), 3600);
    let admin = fixture.token("admin", 3600);
    for (token, hello, code, reason) in [
        (None, hello("edge", "robot-1", 1), tonic::Code::Unauthenticated, None),
        (Some(&admin), hello("edge", "robot-1", 1), tonic::Code::PermissionDenied, None),
        (
            Some(&worker),
            hello("cloud", "cloud-1", 1),
            tonic::Code::PermissionDenied,
            Some("permission"),
        ),
        (
            Some(&worker),
            hello("edge", "cloud-1", 1),
            tonic::Code::PermissionDenied,
            Some("unknown_node"),
        ),
        (
            Some(&worker),
            hello("edge", "robot-9", 1),
            tonic::Code::PermissionDenied,
            Some("unknown_node"),
        ),
        (Some(&worker), hello("edge", "No", 1), tonic::Code::InvalidArgument, Some("bad_hello")),
    ] {
        let before = reason.map_or(0, |reason| counted(&fixture, reason));
        let refused = Monitor::open(&fixture, token.map(String::as_str), hello).await;
        assert_eq!(refused.err().map(|status| status.code()), Some(code), "{reason:?}");
        if let Some(reason) = reason {
            assert_eq!(counted(&fixture, reason), before + 1, "{reason}");
        }
    }
    assert!(Monitor::open(&fixture, Some(&worker), hello("edge", "robot-1", 1)).await.is_ok());
}

#[tokio::test]
async fn what_a_monitor_says_is_shown() {
    let fixture = Fixture::open().await;
    with_nodes(&fixture).await;
    let monitor = Monitor::open(&fixture, None, hello("edge", "robot-1", 1)).await.unwrap();
    let hot = json!([{
        "code": "hot", "scope": "node", "name": "robot-1", "state": "degraded",
        "since": "2026-01-01T00:00:00.000Z", "detail": "94 °C", "remedy": "Cool it.",
    }]);
    monitor.summary(summary("degraded", &hot)).await;
    eventually("the problem is listed", async || {
        fixture.rest("/api/v1/problems").await["total"] == 1
    })
    .await;
    let problems = fixture.rest("/api/v1/problems?layer=edge&state=degraded").await;
    let item = &problems["items"][0];
    assert_eq!(
        (&item["code"], &item["layer"], &item["node"], &item["remedy"]),
        (&json!("hot"), &json!("edge"), &json!("robot-1"), &json!("Cool it."))
    );
    assert_eq!(fixture.rest("/api/v1/problems?layer=cloud").await["total"], 0);
    let topology = fixture.rest("/api/v1/topology").await;
    let node = &topology["layers"][1]["nodes"][0];
    assert_eq!((&node["name"], &node["health"]["state"]), (&json!("robot-1"), &json!("degraded")));
    assert_eq!(node["health"]["codes"], json!(["hot"]));
    let targets = fixture.rest("/api/v1/targets").await;
    assert_eq!(targets[0]["targets"], json!(["robot-1:9103"]));
}

#[tokio::test]
async fn what_is_too_large_or_no_summary_is_refused_and_counted() {
    let fixture = Fixture::open().await;
    with_nodes(&fixture).await;
    let mut monitor = Monitor::open(&fixture, None, hello("edge", "robot-1", 1)).await.unwrap();
    let padded = |bytes: usize| {
        format!("{{\"health\":{{\"state\":\"ok\"}},\"x\":\"{}\"}}", "x".repeat(bytes))
    };
    monitor.summary(padded(256 * 1024)).await;
    monitor.summary("no JSON".to_owned()).await;
    let answer = v1::QueryAnswer { id: 7, status: 200, json: String::new() };
    monitor.send(Reported::Answer(answer)).await;
    for reason in ["summary_too_large", "bad_summary", "unknown_answer"] {
        eventually(reason, async || counted(&fixture, reason) == 1).await;
    }
    // The stream went on; a message above the limit ends it, also if it is small on its way.
    monitor.summary(padded(1024 * 1024)).await;
    assert!(monitor.next().await.is_some_and(|end| end.is_err()));
    assert_eq!(counted(&fixture, "message_too_large"), 1);
    assert!(fixture.rest("/api/v1/problems").await["items"].as_array().unwrap().is_empty());
}

#[tokio::test]
async fn the_newest_stream_of_a_node_counts() {
    let fixture = Fixture::open().await;
    with_nodes(&fixture).await;
    let mut old = Monitor::open(&fixture, None, hello("edge", "robot-1", 5)).await.unwrap();
    let refused = Monitor::open(&fixture, None, hello("edge", "robot-1", 4)).await.err().unwrap();
    assert_eq!((refused.code(), counted(&fixture, "older_epoch")), (tonic::Code::Aborted, 1));
    let new = Monitor::open(&fixture, None, hello("edge", "robot-1", 6)).await.unwrap();
    assert!(matches!(old.next().await, Some(Ok(Sent::GoAway(_)))));
    assert!(old.next().await.is_none());
    drop(new);
    // Once it is gone, a monitor whose clock was set back may come.
    eventually("the stream is forgotten", async || {
        Monitor::open(&fixture, None, hello("edge", "robot-1", 1)).await.is_ok()
    })
    .await;
}

#[tokio::test]
async fn a_query_goes_to_the_node_and_its_answer_is_shared() {
    let fixture = Fixture::open().await;
    with_nodes(&fixture).await;
    let path = "/api/v1/series?node=robot-1&names=a%20b";
    let (status, problem) = fixture.rest_any(path).await;
    assert_eq!((status, &problem["code"]), (503, &json!("node_unreachable")));
    let mut monitor = Monitor::open(&fixture, None, hello("edge", "robot-1", 1)).await.unwrap();
    let answering = async {
        let Some(Ok(Sent::Query(query))) = monitor.next().await else { panic!("no query") };
        assert_eq!(query.name, "monitor /v1/series?names=a%20b");
        let json = r#"{"step_s":10,"series":{}}"#.to_owned();
        monitor.send(Reported::Answer(v1::QueryAnswer { id: query.id, status: 200, json })).await;
    };
    let (first, second, ()) =
        tokio::join!(fixture.rest_any(path), fixture.rest_any(path), answering);
    assert_eq!(first, (200, json!({ "step_s": 10, "series": {} })));
    assert_eq!(first, second);
    // It was one query: nothing else comes before the interest of a reader.
    let mut live = fixture.events("/api/v1/live?period_ms=500").await;
    assert_eq!(live.next_event().await.0, "snapshot");
    let sent = monitor.next().await.unwrap().unwrap();
    assert!(matches!(sent, Sent::Interest(v1::Interest { period_ms: 500 })), "{sent:?}");
}

#[tokio::test]
async fn a_live_view_is_a_snapshot_and_what_changes() {
    let fixture = Fixture::open().await;
    with_nodes(&fixture).await;
    let monitor = Monitor::open(&fixture, None, hello("edge", "robot-1", 1)).await.unwrap();
    let mut live = fixture.events("/api/v1/live?period_ms=500&layer=edge&timeout_s=20").await;
    let (name, mut shown) = live.next_event().await;
    assert_eq!((name.as_str(), &shown["missing"]), ("snapshot", &json!([])));
    assert_eq!(shown["nodes"].as_object().unwrap().keys().collect::<Vec<_>>(), ["robot-1"]);
    monitor.summary(summary("ok", &json!([]))).await;
    while shown["nodes"]["robot-1"]["state"] != "ok" {
        let (name, patch) = live.next_event().await;
        assert_eq!(name, "delta");
        blaze_domain::config::merge::merge_patch(&mut shown, &patch);
    }
    assert_eq!(shown["nodes"]["robot-1"]["cpu_ratio"], 0.25);
}

#[tokio::test]
async fn what_cannot_be_answered_is_refused() {
    let fixture = Fixture::open().await;
    with_nodes(&fixture).await;
    for (path, status) in [
        ("/api/v1/live?view=node", 400),
        ("/api/v1/live?view=topic", 400),
        ("/api/v1/live?view=node&node=robot-9", 404),
        ("/api/v1/live?period_ms=499", 400),
        ("/api/v1/why", 400),
        ("/api/v1/why?topic=imu/data", 503),
        ("/api/v1/why?topic=imu/data&to=edge/robot-1", 503),
        ("/api/v1/why?topic=imu/data&to=edge/robot-9", 404),
        ("/api/v1/why?topic=imu/data&to=a/b/c/d", 400),
        ("/api/v1/series?node=robot-9", 404),
        ("/api/v1/problems?state=bad", 400),
        ("/api/v1/topics", 200),
        ("/api/v1/targets", 200),
    ] {
        assert_eq!(fixture.rest_any(path).await.0, status, "{path}");
    }
}

/// A flow as its monitor answers for it.
async fn answer_as_flow(monitor: &mut Monitor, queries: usize) -> Vec<String> {
    let mut names = Vec::new();
    while names.len() < queries {
        let Some(Ok(sent)) = monitor.next().await else { panic!("the stream ended") };
        let Sent::Query(query) = sent else { continue };
        let json = match query.name.split(['?', ' ']).nth(1).unwrap() {
            "/v1/topics" => json!({ "topics": [{
                "topic": "imu/data",
                "advertised": [{ "layer": "edge", "node": "robot-1", "service": "imu" }],
                "requested": [],
            }] }),
            "/v1/why" => json!({
                "verdict": "not_flowing", "code": "no_request", "remedy": "Start a service.",
                "steps": [
                    { "flow": "edge/robot-1", "step": "advertise", "ok": true, "code": "ok" },
                    {
                        "flow": "cloud/cloud-1", "step": "request", "ok": false,
                        "code": "no_request",
                    },
                ],
            }),
            _ => json!({ "bridges": [] }),
        };
        names.push(query.name);
        let answer = v1::QueryAnswer { id: query.id, status: 200, json: json.to_string() };
        monitor.send(Reported::Answer(answer)).await;
    }
    names
}

#[tokio::test]
async fn why_and_topics_ask_the_flows() {
    let fixture = Fixture::open().await;
    with_nodes(&fixture).await;
    let mut monitor = Monitor::open(&fixture, None, hello("edge", "robot-1", 1)).await.unwrap();
    monitor.summary(summary("ok", &json!([]))).await;
    eventually("the flow is ready", async || {
        fixture.core.status().read(|fleet| {
            fleet.entry(&"robot-1".parse().unwrap()).is_some_and(|entry| entry.report.is_some())
        })
    })
    .await;
    let (topics, names) =
        tokio::join!(fixture.rest("/api/v1/topics?prefix=imu"), answer_as_flow(&mut monitor, 1));
    assert_eq!(names, ["edge/robot-1 /v1/topics"]);
    assert_eq!(topics["items"][0]["publishers"][0]["node"], "robot-1");

    let path = "/api/v1/why?topic=imu/data&to=cloud";
    let (why, names) = tokio::join!(fixture.rest(path), answer_as_flow(&mut monitor, 4));
    assert!(
        names.contains(&"edge/robot-1 /v1/why?topic=imu/data&to=cloud".to_owned()),
        "{names:?}"
    );
    assert_eq!((&why["verdict"], &why["code"]), (&json!("not_flowing"), &json!("no_request")));
    let hops = why["hops"].as_array().unwrap();
    assert_eq!(hops.len(), 2);
    assert_eq!((&hops[1]["where"], &hops[1]["ok"]), (&json!("cloud/cloud-1"), &json!(false)));
    assert_eq!(why["asked"][0]["flow"], "edge/robot-1");
    assert_eq!(why["asked"][0]["status"], 200);
}

#[tokio::test]
async fn a_reader_that_does_not_read_costs_nothing() {
    let fixture = Fixture::open().await;
    with_nodes(&fixture).await;
    let mut monitor = Monitor::open(&fixture, None, hello("edge", "robot-1", 1)).await.unwrap();
    let mut live = fixture.events("/api/v1/live?period_ms=500").await;
    assert_eq!(live.next_event().await.0, "snapshot");
    assert!(matches!(monitor.next().await, Some(Ok(Sent::Interest(_)))));
    // It reads no more: no interest is renewed, though ten seconds would ask for it.
    let quiet = tokio::time::timeout(Duration::from_secs(12), monitor.responses.recv()).await;
    assert!(quiet.is_err(), "{quiet:?}");
    // When it reads on, it gets one delta with the newest, not one for each period.
    for state in ["ok", "down", "degraded"] {
        monitor.summary(summary(state, &json!([]))).await;
    }
    eventually("all were taken", async || {
        let summaries = "blaze_config_status_summaries_total 3";
        fixture.status_text().contains(summaries)
    })
    .await;
    let (mut name, mut patch) = live.next_event().await;
    if name == "bookmark" {
        (name, patch) = live.next_event().await;
    }
    assert_eq!((name.as_str(), &patch["nodes"]["robot-1"]["state"]), ("delta", &json!("degraded")));
}

/// Events of a stream of REST.
pub(super) struct Events {
    body: Pin<Box<dyn Stream<Item = bytes::Bytes> + Send>>,
    text: String,
}

impl Events {
    pub(super) async fn next_event(&mut self) -> (String, Value) {
        loop {
            if let Some((event, rest)) = self.text.split_once("\n\n") {
                let line = |name: &str| {
                    let mut lines = event.lines();
                    lines.find_map(|line| line.strip_prefix(name)).unwrap().to_owned()
                };
                let read = (line("event: "), serde_json::from_str(&line("data: ")).unwrap());
                self.text = rest.to_owned();
                return read;
            }
            let bytes = tokio::time::timeout(SOON, self.body.next()).await.unwrap().unwrap();
            self.text.push_str(std::str::from_utf8(&bytes).unwrap());
        }
    }
}

impl Fixture {
    fn status_text(&self) -> String {
        let registry = prometheus::Registry::new();
        for collector in self.core.status_metrics().collectors() {
            registry.register(collector).unwrap();
        }
        prometheus::TextEncoder::new().encode_to_string(&registry.gather()).unwrap()
    }

    async fn events(&self, path: &str) -> Events {
        let response = self.rest_response(path).await;
        assert_eq!(response.status(), 200, "{path}");
        let body = response.into_body().into_data_stream().map(Result::unwrap);
        Events { body: body.boxed(), text: String::new() }
    }

    async fn rest_any(&self, path: &str) -> (u16, Value) {
        let response = self.rest_response(path).await;
        let status = response.status().as_u16();
        let body = http_body_util::BodyExt::collect(response.into_body()).await.unwrap();
        (status, serde_json::from_slice(&body.to_bytes()).unwrap())
    }

    async fn rest_response(&self, path: &str) -> axum::response::Response {
        let peer: std::net::SocketAddr = "127.0.0.1:40000".parse().unwrap();
        let request = axum::http::Request::get(path)
            .header("host", "localhost:8080")
            .extension(ConnectInfo(peer))
            .body(axum::body::Body::empty());
        tower::ServiceExt::oneshot(self.rest.clone(), request.unwrap()).await.unwrap()
    }
}
