use std::net::Ipv4Addr;

use axum::routing::{get, post};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::*;

const SOON: Duration = Duration::from_secs(10);

struct Served {
    supervisor: Supervisor,
    readiness: Readiness,
    address: SocketAddr,
}

async fn serve(limits: AdminLimits) -> Served {
    let supervisor = Supervisor::new("test");
    let readiness = Readiness::new();
    let extra = Router::new()
        .route("/v1/topics", get(|| async { "topics" }))
        .route("/v1/echo", post(|body: String| async move { body }))
        .route(
            "/v1/panic",
            get(|| async {
                if true {
                    panic!("handler")
                }
            }),
        );
    let any = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    let metrics: MetricsText = Arc::new(|| "blaze_test 1\n".to_owned());
    let server =
        AdminServer::bind_with(any, extra, readiness.clone(), metrics, limits).await.unwrap();
    let address = server.address();
    server.serve(&supervisor);
    Served { supervisor, readiness, address }
}

/// What comes back until the other side closes; a reset is an end too.
async fn read_all(stream: &mut TcpStream) -> String {
    let mut answer = Vec::new();
    let read = tokio::time::timeout(SOON, stream.read_to_end(&mut answer)).await;
    assert!(read.is_ok(), "the port does not close: {}", String::from_utf8_lossy(&answer));
    String::from_utf8_lossy(&answer).into_owned()
}

impl Served {
    async fn send(&self, bytes: &[u8]) -> String {
        let mut stream = TcpStream::connect(self.address).await.unwrap();
        // The port may close before it has taken everything.
        let _ = stream.write_all(bytes).await;
        let _ = stream.shutdown().await;
        read_all(&mut stream).await
    }

    /// Status, content type and body.
    async fn request(&self, method: &str, path: &str, body: &str) -> (u16, String, String) {
        let head = format!("{method} {path} HTTP/1.1\r\nhost: x\r\nconnection: close\r\n");
        let request = format!("{head}content-length: {}\r\n\r\n{body}", body.len());
        let mut stream = TcpStream::connect(self.address).await.unwrap();
        let _ = stream.write_all(request.as_bytes()).await;
        let answer = read_all(&mut stream).await;
        let (head, body) = answer.split_once("\r\n\r\n").unwrap_or((&answer, ""));
        let status = head.split(' ').nth(1).and_then(|status| status.parse().ok()).unwrap_or(0);
        let content_type =
            head.lines().find_map(|line| line.strip_prefix("content-type: ")).unwrap_or_default();
        (status, content_type.to_owned(), body.to_owned())
    }

    async fn json(&self, method: &str, path: &str) -> (u16, Value) {
        let (status, content_type, body) = self.request(method, path, "").await;
        assert_eq!(content_type, "application/json");
        (status, serde_json::from_str(&body).unwrap())
    }

    /// The port's own counter.
    async fn count(&self, result: &str) -> u64 {
        let (_, _, metrics) = self.request("GET", "/metrics", "").await;
        let name = format!("blaze_admin_connections_total{{result=\"{result}\"}} ");
        metrics.lines().find_map(|line| line.strip_prefix(&name)).unwrap().parse().unwrap()
    }

    async fn count_reaches(&self, result: &str, least: u64) {
        let reached = async {
            while self.count(result).await < least {
                tokio::task::yield_now().await;
            }
        };
        assert!(
            tokio::time::timeout(SOON, reached).await.is_ok(),
            "{result} does not reach {least}"
        );
    }
}

#[tokio::test]
async fn readiness_reads_as_documented() {
    let served = serve(AdminLimits::default()).await;
    served.readiness.add("node_broker", Gate::Decides, CheckStatus::Failed, "connecting");
    served.readiness.add("config", Gate::Shows, CheckStatus::Ok, "");
    let (status, report) = served.json("GET", "/readyz").await;
    assert_eq!(status, 503);
    assert_eq!(
        report,
        json!({ "status": "not_ready", "checks": {
            "config": { "status": "ok", "detail": "", "since_s": 0 },
            "node_broker": { "status": "failed", "detail": "connecting", "since_s": 0 },
        } })
    );
    let waiting = served.readiness.clone();
    let ready = tokio::time::timeout(SOON, async { waiting.ready().await });
    served.readiness.set("node_broker", CheckStatus::Ok, "redis 7.0.15");
    ready.await.unwrap();
    served.readiness.set("config", CheckStatus::Failed, "blaze.yaml:3: …");
    let (status, report) = served.json("GET", "/readyz").await;
    assert_eq!((status, &report["status"]), (200, &json!("ready")));
    assert_eq!(report["checks"]["config"]["status"], "failed");
    assert!(served.readiness.is_ready());
    let mut changed = served.readiness.changed();
    changed.mark_unchanged();
    served.readiness.stop();
    assert!(changed.has_changed().unwrap() && !*changed.borrow());
    assert_eq!(served.json("GET", "/readyz").await.0, 503);
    assert_eq!(served.json("GET", "/livez").await.0, 200);
}

#[tokio::test]
async fn the_age_of_a_check_begins_with_its_state() {
    let readiness = Readiness::new();
    readiness.set("inter", CheckStatus::Failed, "a".repeat(2000));
    assert!(!readiness.is_ready());
    assert_eq!(readiness.report().checks["inter"].detail.chars().count(), 513);
    readiness.set("inter", CheckStatus::Ok, "up");
    assert!(readiness.is_ready());
    assert_eq!(readiness.report().checks["inter"].since_s, 0);
}

#[tokio::test]
async fn the_rest_is_answered_as_json() {
    let served = serve(AdminLimits::default()).await;
    assert_eq!(served.request("GET", "/v1/topics", "").await.2, "topics");
    let (status, error) = served.json("GET", "/nothing").await;
    assert_eq!(
        (status, error),
        (404, json!({ "error": { "code": "not_found", "detail": "no /nothing" } }))
    );
    for path in ["/readyz", "/v1/topics"] {
        let (status, error) = served.json("POST", path).await;
        assert_eq!(
            (status, &error["error"]["code"]),
            (405, &json!("method_not_allowed")),
            "{path}"
        );
    }
    let (status, content_type, body) = served.request("GET", "/metrics", "").await;
    assert_eq!((status, content_type.as_str()), (200, "text/plain; version=0.0.4"));
    assert!(body.starts_with("blaze_test 1\n# HELP blaze_admin_connections_total "), "{body}");
}

#[tokio::test]
async fn garbage_is_counted_and_the_port_lives_on() {
    let served = serve(AdminLimits::default()).await;
    let long = format!("GET / HTTP/1.1\r\nx: {}\r\n\r\n", "a".repeat(100_000));
    let many = format!("GET / HTTP/1.1\r\n{}\r\n", "x: y\r\n".repeat(500));
    let cases: [&[u8]; 7] = [
        b"\x00\xff\xfe garbage\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET / HTTP/1.1\r\ncontent-length: -5\r\n\r\n",
        long.as_bytes(),
        many.as_bytes(),
    ];
    for case in cases {
        let answer = served.send(case).await;
        assert!(!answer.contains(" 200 "), "{answer}");
    }
    served.count_reaches("malformed", 7).await;
    assert_eq!(served.json("GET", "/livez").await.0, 200);
    assert_eq!(served.supervisor.failure(), None);
}

#[tokio::test]
async fn a_panic_in_a_handler_costs_one_connection() {
    let served = serve(AdminLimits::default()).await;
    assert_eq!(served.send(b"GET /v1/panic HTTP/1.1\r\nhost: x\r\n\r\n").await, "");
    served.count_reaches("panicked", 1).await;
    assert_eq!(served.supervisor.failure(), None);
}

#[tokio::test]
async fn slow_heads_and_idle_connections_are_closed() {
    let limits = AdminLimits { head_timeout: Duration::from_millis(100), ..AdminLimits::default() };
    let served = serve(limits).await;
    for start in ["", "GET /livez HT", "GET /livez HTTP/1.1\r\nhost: x\r\n\r\n"] {
        let mut stream = TcpStream::connect(served.address).await.unwrap();
        stream.write_all(start.as_bytes()).await.unwrap();
        read_all(&mut stream).await;
    }
}

#[tokio::test]
async fn large_bodies_are_refused() {
    let served = serve(AdminLimits::default()).await;
    assert_eq!(served.request("POST", "/v1/echo", "hello").await.2, "hello");
    assert_eq!(served.request("POST", "/v1/echo", &"a".repeat(70_000)).await.0, 413);
}

#[tokio::test]
async fn connections_are_bounded() {
    let limits = AdminLimits { connections: 4, ..AdminLimits::default() };
    let served = serve(limits).await;
    let mut held = Vec::new();
    for _ in 0..4 {
        held.push(TcpStream::connect(served.address).await.unwrap());
    }
    let mut fifth = TcpStream::connect(served.address).await.unwrap();
    assert_eq!(read_all(&mut fifth).await, "");
    held.clear();
    // Their places become free when the port has seen them close.
    let lives = async { while served.request("GET", "/livez", "").await.0 != 200 {} };
    tokio::time::timeout(SOON, lives).await.unwrap();
    assert!(served.count("refused").await > 0);
}

#[tokio::test]
async fn the_port_closes_with_the_supervisor() {
    let served = serve(AdminLimits::default()).await;
    let mut idle = TcpStream::connect(served.address).await.unwrap();
    served.count_reaches("accepted", 2).await;
    assert!(served.supervisor.shutdown(SOON).await.is_clean());
    read_all(&mut idle).await;
    assert!(TcpStream::connect(served.address).await.is_err());
}

#[tokio::test]
async fn a_taken_port_is_named() {
    let served = serve(AdminLimits::default()).await;
    let metrics: MetricsText = Arc::new(String::new);
    let error = AdminServer::bind(served.address, Router::new(), Readiness::new(), metrics)
        .await
        .unwrap_err();
    assert!(error.to_string().starts_with(&format!("admin port {}: ", served.address)), "{error}");
}
