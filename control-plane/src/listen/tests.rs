use std::convert::Infallible;
use std::fs;
use std::net::Ipv4Addr;
use std::path::PathBuf;

use axum::body::Body;
use axum::extract::{ConnectInfo, Extension};
use axum::routing::get;
use blaze_domain::node_file::TlsSection;
use bytes::Bytes;
use futures::stream;
use http_body_util::{BodyExt as _, Empty};
use hyper::client::conn::http2;
use hyper::{Request, StatusCode};
use hyper_util::rt::{TokioExecutor, TokioIo};
use rcgen::{BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair};
use rustls::crypto::aws_lc_rs::default_provider;
use rustls::{ClientConfig, RootCertStore};
use rustls_pki_types::pem::PemObject as _;
use rustls_pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::sync::Notify;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

use super::*;

const SOON: Duration = Duration::from_secs(10);
const SHORT: Duration = Duration::from_millis(200);
const GET: &[u8] = b"GET / HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n";

struct Served {
    supervisor: Supervisor,
    serving: Serving,
    metrics: ApiMetrics,
    /// `/wait` has begun, and may end.
    began: Arc<Notify>,
    go: Arc<Notify>,
}

fn router(began: &Arc<Notify>, go: &Arc<Notify>) -> Router {
    let (began, go) = (Arc::clone(began), Arc::clone(go));
    let wait = move || async move {
        began.notify_one();
        go.notified().await;
        "waited"
    };
    let endless = || async {
        Body::from_stream(stream::repeat_with(|| Ok::<_, Infallible>(Bytes::from(vec![7; 65_536]))))
    };
    let peer = |ConnectInfo(address): ConnectInfo<SocketAddr>, Extension(peer): Extension<Peer>| async move {
        assert!(address.ip().is_loopback());
        format!("encrypted={}", peer.encrypted)
    };
    let panic = || async {
        if true {
            panic!("handler")
        }
    };
    let refuse = || async { StatusCode::PAYLOAD_TOO_LARGE };
    Router::new()
        .route("/refuse", axum::routing::post(refuse))
        .route("/", get(peer))
        .route("/wait", get(wait))
        .route("/endless", get(endless))
        .route("/panic", get(panic))
}

async fn serve_with(limits: ListenLimits, protocols: Protocols, tls: Option<Tls>) -> Served {
    let supervisor = Supervisor::new("test");
    let any = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    let listener = Listener::bind("rest", any, tls, protocols, limits).await.unwrap();
    let (metrics, began, go) = (ApiMetrics::new().unwrap(), Arc::default(), Arc::default());
    let serving = listener.serve(&supervisor, router(&began, &go), &metrics);
    Served { supervisor, serving, metrics, began, go }
}

async fn serve(limits: ListenLimits) -> Served {
    serve_with(limits, Protocols::Both, None).await
}

impl Served {
    async fn connect(&self) -> TcpStream {
        TcpStream::connect(self.serving.local_addr()).await.unwrap()
    }

    fn count(&self, result: &str) -> u64 {
        self.value(&format!("_total{{listener=\"rest\",result=\"{result}\"}} "))
    }

    fn open(&self) -> u64 {
        self.value("{listener=\"rest\"} ")
    }

    fn value(&self, name: &str) -> u64 {
        let text = self.metrics.text();
        let name = format!("blaze_config_connections{name}");
        let value = text.lines().find_map(|line| line.strip_prefix(&name));
        value.unwrap().parse().unwrap()
    }

    async fn counted(&self, result: &str, least: u64) {
        let reached = async {
            while self.count(result) < least {
                tokio::time::sleep(Duration::from_millis(2)).await;
            }
        };
        let found = tokio::time::timeout(SOON, reached).await;
        assert!(found.is_ok(), "{result} does not reach {least}: {}", self.metrics.text());
    }

    async fn end(self) {
        assert!(self.supervisor.shutdown(SOON).await.is_clean());
        let closed = async {
            while self.open() > 0 {
                tokio::time::sleep(Duration::from_millis(2)).await;
            }
        };
        tokio::time::timeout(SOON, closed).await.unwrap();
    }
}

/// What comes back until the other side closes; a reset is an end too.
async fn read_all(stream: &mut (impl AsyncRead + Unpin)) -> String {
    let mut answer = Vec::new();
    let read = tokio::time::timeout(SOON, stream.read_to_end(&mut answer)).await;
    assert!(read.is_ok(), "the port does not close: {}", String::from_utf8_lossy(&answer));
    String::from_utf8_lossy(&answer).into_owned()
}

async fn ask(stream: &mut (impl AsyncRead + AsyncWrite + Unpin), request: &[u8]) -> String {
    // The port may close before it has taken everything.
    let _ = stream.write_all(request).await;
    read_all(stream).await
}

type Sender = http2::SendRequest<Empty<Bytes>>;

async fn http2_client<S>(stream: S, supervisor: &Supervisor) -> Sender
where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let (sender, connection) =
        http2::handshake(TokioExecutor::new(), TokioIo::new(stream)).await.unwrap();
    supervisor.spawn("client", TaskPolicy::MayEnd, async move {
        let _ = connection.await;
    });
    sender
}

fn request(path: &str) -> Request<Empty<Bytes>> {
    Request::get(format!("http://localhost{path}")).body(Empty::new()).unwrap()
}

#[tokio::test]
async fn plaintext_speaks_both_versions() {
    let served = serve(ListenLimits::default()).await;
    let answer = ask(&mut served.connect().await, GET).await;
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    assert!(answer.ends_with("encrypted=false"), "{answer}");
    let mut sender = http2_client(served.connect().await, &served.supervisor).await;
    let answer = sender.send_request(request("/")).await.unwrap();
    assert_eq!(answer.status(), StatusCode::OK);
    let body = answer.into_body().collect().await.unwrap().to_bytes();
    assert_eq!(body, "encrypted=false");
    assert_eq!(served.open(), 1);
    assert_eq!(served.count("accepted"), 2);
    drop(sender);
    served.end().await;
}

#[tokio::test]
async fn a_port_for_http2_takes_nothing_else() {
    let served = serve_with(ListenLimits::default(), Protocols::Http2, None).await;
    let answer = ask(&mut served.connect().await, GET).await;
    assert!(!answer.contains("200 OK"), "{answer}");
    let mut sender = http2_client(served.connect().await, &served.supervisor).await;
    assert_eq!(sender.send_request(request("/")).await.unwrap().status(), StatusCode::OK);
    drop(sender);
    served.end().await;
}

#[tokio::test]
async fn connections_over_the_limit_are_closed_and_counted() {
    let limits = ListenLimits { connections: 1, ..ListenLimits::default() };
    let served = serve(limits).await;
    let mut first = served.connect().await;
    first.write_all(b"GET / HTTP/1.1\r\nhost: x\r\n\r\n").await.unwrap();
    let mut start = [0; 12];
    first.read_exact(&mut start).await.unwrap();
    assert_eq!(read_all(&mut served.connect().await).await, "");
    assert_eq!(served.count("refused"), 1);
    drop(first);
    // It takes a moment until the place is free.
    let answered =
        async { while !ask(&mut served.connect().await, GET).await.starts_with("HTTP/1.1 200") {} };
    tokio::time::timeout(SOON, answered).await.unwrap();
    served.end().await;
}

#[tokio::test]
async fn large_heads_reach_the_router_and_larger_ones_are_431() {
    let served = serve(ListenLimits::default()).await;
    for (bytes, status) in [(40 * 1024, "200"), (80 * 1024, "431")] {
        let head = format!(
            "GET / HTTP/1.1\r\nhost: x\r\nconnection: close\r\nx: {}\r\n\r\n",
            "y".repeat(bytes)
        );
        let answer = ask(&mut served.connect().await, head.as_bytes()).await;
        // What is not read when it closes can take the answer with it.
        let expected = answer.starts_with(&format!("HTTP/1.1 {status}"))
            || (status == "431" && answer.is_empty());
        assert!(expected, "{bytes}: {answer}");
    }
    served.end().await;
}

#[tokio::test]
async fn many_small_lines_of_a_head_reach_the_router() {
    let served = serve(ListenLimits::default()).await;
    for (lines, status) in [(1_000, "200"), (1_100, "431")] {
        let head = format!(
            "GET / HTTP/1.1\r\nhost: x\r\nconnection: close\r\n{}\r\n",
            "x: y\r\n".repeat(lines)
        );
        let answer = ask(&mut served.connect().await, head.as_bytes()).await;
        assert!(answer.starts_with(&format!("HTTP/1.1 {status}")), "{lines}: {answer}");
    }
    served.end().await;
}

/// Twelve times what fits into the buffers of a connection, as far as it is taken.
const LARGE: usize = 12 * 1024 * 1024;

#[tokio::test]
async fn who_sends_everything_first_gets_its_answer() {
    let served = serve(ListenLimits::default()).await;
    let mut stream = served.connect().await;
    let head = format!("POST /refuse HTTP/1.1\r\nhost: x\r\ncontent-length: {LARGE}\r\n\r\n");
    stream.write_all(head.as_bytes()).await.unwrap();
    stream.write_all(&vec![b'x'; LARGE]).await.unwrap();
    // The same connection takes the next request.
    stream.write_all(GET).await.unwrap();
    let answer = read_all(&mut stream).await;
    assert!(answer.starts_with("HTTP/1.1 413"), "{answer}");
    assert!(answer.contains("HTTP/1.1 200"), "{answer}");
    served.end().await;
}

#[tokio::test]
async fn a_stream_that_was_refused_early_is_not_reset_while_its_body_comes() {
    let served = serve(ListenLimits::default()).await;
    let (mut sender, connection) =
        http2::handshake(TokioExecutor::new(), TokioIo::new(served.connect().await)).await.unwrap();
    served.supervisor.spawn("client", TaskPolicy::MayEnd, async move {
        let _ = connection.await;
    });
    // The end of the body is taken only after all of it was: a reset would drop it before.
    let (whole, sent) = tokio::sync::oneshot::channel::<()>();
    let parts = stream::unfold((0, Some(whole)), |(at, whole)| async move {
        if at == LARGE {
            whole.map(|whole| whole.send(()));
            return None;
        }
        Some((Ok::<_, Infallible>(Bytes::from(vec![b'x'; 65_536])), (at + 65_536, whole)))
    });
    let request = Request::post("http://localhost/refuse").body(Body::from_stream(parts)).unwrap();
    let answer = sender.send_request(request).await.unwrap();
    assert_eq!(answer.status(), StatusCode::PAYLOAD_TOO_LARGE);
    tokio::time::timeout(SOON, sent).await.unwrap().unwrap();
    drop((answer, sender));
    served.end().await;
}

#[tokio::test]
async fn a_body_that_does_not_end_is_not_read_for_ever() {
    let limits =
        ListenLimits { unread_bytes: 1024 * 1024, unread_time: SHORT, ..ListenLimits::default() };
    let served = serve(limits).await;
    let mut slow = served.connect().await;
    slow.write_all(b"POST /refuse HTTP/1.1\r\nhost: x\r\ncontent-length: 9\r\n\r\nx")
        .await
        .unwrap();
    assert!(read_all(&mut slow).await.starts_with("HTTP/1.1 413"));
    let mut large = served.connect().await;
    let head = b"POST /refuse HTTP/1.1\r\nhost: x\r\ncontent-length: 999999999\r\n\r\n";
    large.write_all(head).await.unwrap();
    let part = vec![b'x'; 65_536];
    let cut = async { while large.write_all(&part).await.is_ok() {} };
    tokio::time::timeout(SOON, cut).await.unwrap();
    served.end().await;
}

#[tokio::test]
async fn who_waits_to_be_asked_for_a_body_is_not_asked() {
    let served = serve(ListenLimits::default()).await;
    let mut stream = served.connect().await;
    let head =
        b"POST /refuse HTTP/1.1\r\nhost: x\r\nexpect: 100-continue\r\ncontent-length: 9\r\n\r\n";
    let answer = ask(&mut stream, head).await;
    assert!(answer.starts_with("HTTP/1.1 413"), "{answer}");
    served.end().await;
}

#[tokio::test]
async fn slow_heads_and_silence_end_the_connection() {
    let limits = ListenLimits { head_timeout: SHORT, ..ListenLimits::default() };
    let served = serve(limits).await;
    for start in [&b""[..], b"GET / HT", b"PRI * HTTP/2.0\r\n"] {
        let mut stream = served.connect().await;
        assert_eq!(ask(&mut stream, start).await, "", "{start:?}");
    }
    // One that answers every PING, and asks nothing.
    let mut sender = http2_client(served.connect().await, &served.supervisor).await;
    let closed = async {
        while sender.ready().await.is_ok() && !sender.is_closed() {
            tokio::time::sleep(SHORT).await;
        }
    };
    tokio::time::timeout(SOON, closed).await.unwrap();
    served.counted("timeout", 4).await;
    served.end().await;
}

#[tokio::test]
async fn a_silent_client_does_not_hold_up_the_end() {
    let served = serve_with(ListenLimits::default(), Protocols::Http2, None).await;
    let mut silent = served.connect().await;
    served.counted("accepted", 1).await;
    let begin = std::time::Instant::now();
    served.end().await;
    assert!(begin.elapsed() < Duration::from_secs(5), "{:?}", begin.elapsed());
    // Settings of HTTP/2, and the end.
    read_all(&mut silent).await;
}

#[tokio::test]
async fn a_head_of_http2_that_does_not_end_is_ended_by_the_keep_alive() {
    let limits = ListenLimits {
        keep_alive_interval: SHORT,
        keep_alive_timeout: SHORT,
        ..ListenLimits::default()
    };
    let served = serve(limits).await;
    let mut stream = served.connect().await;
    stream.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n").await.unwrap();
    // SETTINGS, then HEADERS of stream 1 without END_HEADERS: the rest never comes.
    stream.write_all(&[0, 0, 0, 4, 0, 0, 0, 0, 0]).await.unwrap();
    stream.write_all(&[0, 0, 1, 1, 1, 0, 0, 0, 1, 0x82]).await.unwrap();
    read_all(&mut stream).await;
    served.end().await;
}

#[tokio::test]
async fn a_client_that_does_not_read_loses_its_connection() {
    let limits = ListenLimits { write_stall: SHORT, ..ListenLimits::default() };
    let served = serve(limits).await;
    let mut stream = served.connect().await;
    stream.write_all(b"GET /endless HTTP/1.1\r\nhost: x\r\n\r\n").await.unwrap();
    served.counted("stalled", 1).await;
    drop(stream);
    served.end().await;
}

#[tokio::test]
async fn stopping_lets_requests_end() {
    let served = serve(ListenLimits::default()).await;
    let mut waiting = served.connect().await;
    waiting.write_all(b"GET /wait HTTP/1.1\r\nhost: x\r\n\r\n").await.unwrap();
    served.began.notified().await;
    let mut sender = http2_client(served.connect().await, &served.supervisor).await;
    let also_waiting = sender.send_request(request("/wait"));
    let stopping = async {
        served.began.notified().await;
        let silent = served.connect().await;
        let shutdown = served.supervisor.shutdown(SOON);
        let then = async {
            // The port closes although two requests wait.
            while TcpStream::connect(served.serving.local_addr()).await.is_ok() {}
            served.go.notify_waiters();
        };
        let (report, ()) = tokio::join!(shutdown, then);
        drop(silent);
        report
    };
    let (answer, report) = tokio::join!(also_waiting, stopping);
    assert_eq!(answer.unwrap().into_body().collect().await.unwrap().to_bytes(), "waited");
    assert!(read_all(&mut waiting).await.ends_with("waited"));
    assert!(report.is_clean(), "{report:?}");
    served.serving.drained().await;
    assert_eq!(served.open(), 0);
}

#[tokio::test]
async fn what_does_not_end_is_cut_at_the_deadline() {
    let limits = ListenLimits { drain_timeout: SHORT, ..ListenLimits::default() };
    let served = serve(limits).await;
    let mut waiting = served.connect().await;
    waiting.write_all(b"GET /wait HTTP/1.1\r\nhost: x\r\n\r\n").await.unwrap();
    served.began.notified().await;
    served.end().await;
    assert_eq!(read_all(&mut waiting).await, "");
}

#[tokio::test]
async fn a_panic_ends_its_request_alone() {
    let served = serve(ListenLimits::default()).await;
    let answer = ask(&mut served.connect().await, b"GET /panic HTTP/1.1\r\nhost: x\r\n\r\n").await;
    assert_eq!(answer, "");
    let mut sender = http2_client(served.connect().await, &served.supervisor).await;
    assert!(sender.send_request(request("/panic")).await.is_err());
    assert_eq!(sender.send_request(request("/")).await.unwrap().status(), StatusCode::OK);
    drop(sender);
    served.end().await;
}

/// An authority, and what it has signed.
struct Authority {
    folder: tempfile::TempDir,
    issuer: Issuer<'static, KeyPair>,
}

impl Authority {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::new(Vec::new()).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        fs::write(folder.path().join("ca.pem"), params.self_signed(&key).unwrap().pem()).unwrap();
        let issuer = Issuer::new(params, key);
        Self { folder, issuer }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes `name.pem` and `name.key`; gives the certificate.
    fn sign(&self, name: &str) -> CertificateDer<'static> {
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        let certificate = params.signed_by(&key, &self.issuer).unwrap();
        fs::write(self.path(&format!("{name}.key")), key.serialize_pem()).unwrap();
        fs::write(self.path(&format!("{name}.pem")), certificate.pem()).unwrap();
        certificate.der().clone()
    }

    fn section(&self, with_clients: bool) -> TlsSection {
        TlsSection {
            cert_file: Some(self.path("server.pem")),
            key_file: Some(self.path("server.key")),
            client_ca_file: with_clients.then(|| self.path("ca.pem")),
            allow_plaintext: false,
        }
    }

    fn tls(&self, with_clients: bool) -> Tls {
        Tls::load(&self.section(with_clients)).unwrap().unwrap()
    }

    /// A client that trusts this authority and shows the certificate of that name.
    async fn client(
        &self,
        served: &Served,
        own: Option<&str>,
        alpn: &[&str],
    ) -> io::Result<TlsStream<TcpStream>> {
        let mut roots = RootCertStore::empty();
        roots.add(CertificateDer::from_pem_file(self.path("ca.pem")).unwrap()).unwrap();
        let builder = ClientConfig::builder_with_provider(Arc::new(default_provider()))
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_root_certificates(roots);
        let mut config = match own {
            None => builder.with_no_client_auth(),
            Some(name) => {
                let chain =
                    vec![CertificateDer::from_pem_file(self.path(&format!("{name}.pem"))).unwrap()];
                let key = PrivateKeyDer::from_pem_file(self.path(&format!("{name}.key"))).unwrap();
                builder.with_client_auth_cert(chain, key).unwrap()
            }
        };
        config.alpn_protocols = alpn.iter().map(|name| name.as_bytes().to_vec()).collect();
        let name = ServerName::try_from("localhost").unwrap();
        TlsConnector::from(Arc::new(config)).connect(name, served.connect().await).await
    }
}

fn shown(stream: &TlsStream<TcpStream>) -> CertificateDer<'static> {
    stream.get_ref().1.peer_certificates().unwrap()[0].clone().into_owned()
}

#[tokio::test]
async fn tls_speaks_what_alpn_says() {
    let authority = Authority::new();
    authority.sign("server");
    let both =
        serve_with(ListenLimits::default(), Protocols::Both, Some(authority.tls(false))).await;
    let mut stream = authority.client(&both, None, &["http/1.1"]).await.unwrap();
    let answer = ask(&mut stream, GET).await;
    assert!(answer.ends_with("encrypted=true"), "{answer}");
    let stream = authority.client(&both, None, &["h2", "http/1.1"]).await.unwrap();
    assert_eq!(stream.get_ref().1.alpn_protocol(), Some(&b"h2"[..]));
    let mut sender = http2_client(stream, &both.supervisor).await;
    assert_eq!(sender.send_request(request("/")).await.unwrap().status(), StatusCode::OK);
    drop(sender);
    // No TLS at all.
    let answer = ask(&mut both.connect().await, GET).await;
    assert!(!answer.contains("HTTP"), "{answer}");
    both.counted("handshake_failed", 1).await;
    both.end().await;
    let http2 =
        serve_with(ListenLimits::default(), Protocols::Http2, Some(authority.tls(false))).await;
    assert!(authority.client(&http2, None, &["http/1.1"]).await.is_err());
    http2.end().await;
}

#[tokio::test]
async fn a_handshake_must_not_take_long() {
    let authority = Authority::new();
    authority.sign("server");
    let limits = ListenLimits { handshake_timeout: SHORT, ..ListenLimits::default() };
    let served = serve_with(limits, Protocols::Both, Some(authority.tls(false))).await;
    assert_eq!(read_all(&mut served.connect().await).await, "");
    served.counted("handshake_timeout", 1).await;
    served.end().await;
}

#[tokio::test]
async fn where_clients_need_certificates_others_are_refused() {
    let (authority, stranger) = (Authority::new(), Authority::new());
    for name in ["server", "client"] {
        authority.sign(name);
    }
    // Another authority's certificate; the stranger trusts the server all the same.
    stranger.sign("client");
    fs::copy(authority.path("ca.pem"), stranger.path("ca.pem")).unwrap();
    let served =
        serve_with(ListenLimits::default(), Protocols::Both, Some(authority.tls(true))).await;
    let mut stream = authority.client(&served, Some("client"), &["http/1.1"]).await.unwrap();
    let answer = ask(&mut stream, GET).await;
    assert!(answer.ends_with("encrypted=true"), "{answer}");
    for (who, own) in [(&authority, None), (&stranger, Some("client"))] {
        // In TLS 1.3 the client learns of it only when it reads.
        if let Ok(mut stream) = who.client(&served, own, &["http/1.1"]).await {
            assert_eq!(ask(&mut stream, GET).await, "");
        }
    }
    served.counted("handshake_failed", 2).await;
    served.end().await;
}

#[tokio::test]
async fn a_new_certificate_is_used_and_a_faulty_one_is_not() {
    let authority = Authority::new();
    let first = authority.sign("server");
    let tls = authority.tls(false);
    let served = serve_with(ListenLimits::default(), Protocols::Both, Some(tls.clone())).await;
    tls.watch_every(&served.supervisor, Duration::from_millis(10));
    let mut open = authority.client(&served, None, &["http/1.1"]).await.unwrap();
    assert_eq!(shown(&open), first);
    let second = authority.sign("server");
    let becomes = async |wanted: &CertificateDer<'_>| {
        let seen = async {
            while shown(&authority.client(&served, None, &["http/1.1"]).await.unwrap()) != *wanted {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        tokio::time::timeout(SOON, seen).await.unwrap();
    };
    becomes(&second).await;
    // A connection that was open before goes on.
    assert!(ask(&mut open, GET).await.starts_with("HTTP/1.1 200"));
    let good = fs::read(authority.path("server.pem")).unwrap();
    fs::write(authority.path("server.pem"), "-----BEGIN CERTIFICATE-----\nnone\n").unwrap();
    assert!(Tls::load(&authority.section(false)).is_err());
    becomes(&second).await;
    fs::write(authority.path("server.pem"), good).unwrap();
    let third = authority.sign("server");
    becomes(&third).await;
    served.end().await;
}

#[test]
fn faulty_files_are_named() {
    let authority = Authority::new();
    authority.sign("server");
    authority.sign("other");
    assert!(
        Tls::load(&TlsSection {
            cert_file: None,
            key_file: None,
            client_ca_file: None,
            allow_plaintext: false,
        })
        .unwrap()
        .is_none()
    );
    let pem = |name: &str| Some(authority.path(name));
    type Change<'a> = &'a dyn Fn(&mut TlsSection);
    let changes: [(Change, &str); 5] = [
        (&|tls| tls.cert_file = pem("gone.pem"), "gone.pem"),
        (&|tls| tls.cert_file = pem("server.key"), "server.key"),
        (&|tls| tls.key_file = pem("server.pem"), "server.pem"),
        (&|tls| tls.key_file = pem("other.key"), "do not go together"),
        (&|tls| tls.client_ca_file = pem("server.key"), "server.key"),
    ];
    for (change, named) in changes {
        let mut section = authority.section(true);
        change(&mut section);
        let faults = Tls::load(&section).unwrap_err();
        assert!(faults.len() == 1 && faults[0].contains(named), "{faults:?}");
        assert!(faults[0].starts_with("control_plane.tls."), "{faults:?}");
    }
    install_crypto_provider();
    install_crypto_provider();
}
