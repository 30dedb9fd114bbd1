use serde_json::json;

use super::*;
use crate::config::endpoint::{ClientCertificate, parse_server};
use crate::config::stub::{Reply, Stub};

const NODES: &str = "/api/v1/nodes";

#[tokio::test]
async fn requests_carry_what_they_should() {
    let stub = Stub::start(|_, _| Reply::at(7, &json!({"name": "robot-1"}))).await;
    let client = stub.client_with(Some("abc.def"));
    let call =
        Call::get(NODES).query("label_selector", "a in (b, ü)").query_if("layer", None::<String>);
    let answer = client.send(&call).await.unwrap();
    assert_eq!((answer.revision, answer.etag.as_deref()), (Some(7), Some("\"7\"")));
    assert_eq!(answer.body["name"], "robot-1");
    let patch = Call::patch(format!("{NODES}/robot-1"), &json!({"spec": null}))
        .if_match(Some("\"7\"".to_owned()));
    client.send(&patch).await.unwrap();
    let asked = stub.asked();
    assert_eq!(asked[0].line(), "GET /api/v1/nodes?label_selector=a+in+%28b%2C+%C3%BC%29");
    assert_eq!(asked[0].header("authorization"), Some("Bearer abc.def"));
    assert_eq!(asked[0].header("if-match"), None);
    assert_eq!(asked[1].line(), "PATCH /api/v1/nodes/robot-1");
    assert_eq!(asked[1].header("if-match"), Some("\"7\""));
    assert_eq!(asked[1].header("content-type"), Some("application/merge-patch+json"));
    assert_eq!(asked[1].json(), json!({"spec": null}));
}

#[tokio::test]
async fn a_read_is_tried_again_once_and_a_write_never() {
    let stub =
        Stub::start(|_, before| if before == 0 { Reply::Cut } else { Reply::json(&json!({})) })
            .await;
    stub.client().send(&Call::get(NODES)).await.unwrap();
    assert_eq!(stub.asked().len(), 2);

    let dead = Stub::start(|_, _| Reply::Cut).await;
    let error = dead.client().send(&Call::get(NODES)).await.unwrap_err();
    assert_eq!((error.exit() as u8, dead.asked().len()), (3, 2));

    for call in [
        Call::post("/api/v1/apply", &json!([])),
        Call::put("/api/v1/nodes/a", &json!({})),
        Call::patch("/api/v1/nodes/a", &json!({})),
        Call::delete("/api/v1/nodes/a"),
    ] {
        let dead = Stub::start(|_, _| Reply::Cut).await;
        let error = dead.client().send(&call).await.unwrap_err();
        assert!(matches!(error, CliError::OutcomeUnknown { .. }), "{error}");
        assert_eq!((error.exit() as u8, dead.asked().len()), (1, 1));
        let error = dead.client().send(&call.harmless()).await.unwrap_err();
        assert!(matches!(error, CliError::NoServer { .. }), "{error}");
    }
}

#[tokio::test]
async fn refusals_are_problems_and_are_never_tried_again() {
    for (status, code, exit) in [
        (503, "outcome_unknown", 1),
        (503, "overloaded", 1),
        (404, "not_found", 4),
        (428, "precondition_required", 5),
        (403, "permission_denied", 6),
        (415, "unsupported_media_type", 7),
    ] {
        let stub = Stub::start(move |_, _| Reply::problem(status, code, "no")).await;
        let error = stub.client().send(&Call::get(NODES)).await.unwrap_err();
        assert_eq!((error.exit() as u8, stub.asked().len()), (exit, 1), "{code}");
        assert_eq!(error.to_json()["code"], code);
    }
}

#[tokio::test]
async fn nobody_there_means_exit_3_for_writes_too() {
    // Bound and closed again: nobody listens there.
    let address = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let client =
        Client::new(Endpoint::at(parse_server(&format!("http://{address}")).unwrap())).unwrap();
    for call in [Call::get(NODES), Call::delete("/api/v1/nodes/a")] {
        let error = client.send(&call).await.unwrap_err();
        assert_eq!(error.exit() as u8, 3, "{error}");
        assert!(error.to_string().contains("--server URL"), "{error}");
    }
}

#[tokio::test]
async fn a_token_is_shown_nowhere() {
    let stub = Stub::start(|asked, _| {
        let sent = asked.header("authorization").unwrap_or_default().to_owned();
        Reply::problem(401, "unauthenticated", &sent)
    })
    .await;
    let client = stub.client_with(Some("open.sesame"));
    let error = client.send(&Call::get(NODES)).await.unwrap_err();
    let shown = format!("{error} {error:?} {} {client:?}", error.to_json());
    assert!(!shown.contains("sesame") && shown.contains("token inspect"), "{shown}");
    assert_eq!(error.exit() as u8, 6);
    let error = stub.client().send(&Call::get(NODES)).await.unwrap_err();
    assert!(error.to_string().contains("no token was sent"), "{error}");
}

#[tokio::test]
async fn redirects_are_not_followed() {
    let stub = Stub::start(|_, _| {
        Reply::Full(
            307,
            vec![("location", "http://127.0.0.1:1/api/v1/nodes".to_owned())],
            String::new(),
        )
    })
    .await;
    let error = stub.client_with(Some("abc")).send(&Call::get(NODES)).await.unwrap_err();
    assert_eq!(error.exit() as u8, 1);
    assert!(error.to_string().contains("Redirects are not followed"), "{error}");
    assert_eq!(stub.asked().len(), 1);
}

#[tokio::test]
async fn answers_that_are_no_json_are_told() {
    let stub = Stub::start(|_, _| Reply::Full(200, Vec::new(), "<html>".to_owned())).await;
    let error = stub.client().send(&Call::get(NODES)).await.unwrap_err();
    assert!(error.to_string().contains("not as BlazeConfig does"), "{error}");
    let error = stub.client().open(&Call::get("/api/v1/watch")).await.unwrap_err();
    assert!(error.to_string().contains("no stream of events"), "{error}");
    let empty = Stub::start(|_, _| Reply::Full(204, Vec::new(), String::new())).await;
    assert_eq!(empty.client().send(&Call::delete(NODES)).await.unwrap().body, Value::Null);
}

#[test]
fn authorities_are_read_before_anything_is_sent() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("ca.pem");
    let endpoint = Endpoint {
        ca_file: Some(file.clone()),
        ..Endpoint::at(parse_server("https://127.0.0.1:1").unwrap())
    };
    assert_eq!(Client::new(endpoint.clone()).unwrap_err().exit() as u8, 1);
    std::fs::write(&file, "no certificate").unwrap();
    let error = Client::new(endpoint).unwrap_err();
    assert_eq!(error.exit() as u8, 7);
    assert!(error.to_string().contains("ca.pem"), "{error}");
}

/// A server of TLS with a certificate for `localhost` and 127.0.0.1, and the file of its authority.
/// With an authority of clients it takes only those that show a certificate of it.
async fn tls_server(
    directory: &std::path::Path,
    clients: Option<rustls::RootCertStore>,
) -> (String, std::path::PathBuf, tokio::task::JoinSet<()>) {
    use std::sync::Arc;
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    let names = ["localhost".to_owned(), "127.0.0.1".to_owned()];
    let made = rcgen::generate_simple_self_signed(names).unwrap();
    let file = directory.join("ca.pem");
    std::fs::write(&file, made.cert.pem()).unwrap();
    let key = rustls::pki_types::PrivatePkcs8KeyDer::from(made.signing_key.serialize_der());
    let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
    let builder = rustls::ServerConfig::builder_with_provider(Arc::clone(&provider))
        .with_safe_default_protocol_versions()
        .unwrap();
    let builder = match clients {
        Some(roots) => {
            let verifier = rustls::server::WebPkiClientVerifier::builder_with_provider(
                Arc::new(roots),
                provider,
            );
            builder.with_client_cert_verifier(verifier.build().unwrap())
        }
        None => builder.with_no_client_auth(),
    };
    let config = builder.with_single_cert(vec![made.cert.der().clone()], key.into()).unwrap();
    let acceptor = tokio_rustls::TlsAcceptor::from(Arc::new(config));
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("https://{}", listener.local_addr().unwrap());
    let mut task = tokio::task::JoinSet::new();
    task.spawn(async move {
        loop {
            let (stream, _) = listener.accept().await.unwrap();
            match acceptor.accept(stream).into_fallible().await {
                Ok(mut stream) => {
                    let mut request = [0_u8; 4096];
                    let _ = stream.read(&mut request).await;
                    let answer =
                        "HTTP/1.1 200 OK\r\nconnection: close\r\ncontent-length: 2\r\n\r\n{}";
                    let _ = stream.write_all(answer.as_bytes()).await;
                    let _ = stream.shutdown().await;
                }
                // What the client has sent already is read: else the system resets the connection,
                // and the alert may be lost.
                Err((_, mut stream)) => {
                    let _ = stream.shutdown().await;
                    let _ = tokio::io::copy(&mut stream, &mut tokio::io::sink()).await;
                }
            }
        }
    });
    (url, file, task)
}

#[tokio::test]
async fn a_server_may_ask_for_a_certificate() {
    let directory = tempfile::tempdir().unwrap();
    let made = rcgen::generate_simple_self_signed(["client".to_owned()]).unwrap();
    let mut roots = rustls::RootCertStore::empty();
    roots.add(made.cert.der().clone()).unwrap();
    let (url, ca_file, _task) = tls_server(directory.path(), Some(roots)).await;
    let cert_file = directory.path().join("client.pem");
    let key_file = directory.path().join("client.key");
    std::fs::write(&cert_file, made.cert.pem()).unwrap();
    std::fs::write(&key_file, made.signing_key.serialize_pem()).unwrap();
    let endpoint = |client_certificate| Endpoint {
        ca_file: Some(ca_file.clone()),
        client_certificate,
        ..Endpoint::at(parse_server(&url).unwrap())
    };
    let shown =
        ClientCertificate { cert_file: cert_file.clone(), key_file: Some(key_file.clone()) };
    let client = Client::new(endpoint(Some(shown.clone()))).unwrap();
    client.send(&Call::get(NODES)).await.unwrap();
    client.send(&Call::delete("/api/v1/nodes/a")).await.unwrap();

    let error = Client::new(endpoint(None)).unwrap().send(&Call::get(NODES)).await.unwrap_err();
    assert_eq!(error.exit() as u8, 3, "{error}");
    let text = error.to_string();
    assert!(text.contains("--client-cert FILE --client-key FILE"), "{text}");
    assert!(!text.contains("--server URL"), "{text}");

    let other = rcgen::generate_simple_self_signed(["client".to_owned()]).unwrap();
    std::fs::write(&key_file, other.signing_key.serialize_pem()).unwrap();
    let error = Client::new(endpoint(Some(shown))).unwrap_err();
    assert_eq!(error.exit() as u8, 7, "{error}");
    assert!(error.to_string().contains("do not belong together"), "{error}");
}

#[tokio::test]
async fn tls_needs_the_authority_that_signed() {
    let directory = tempfile::tempdir().unwrap();
    let (url, ca_file, _task) = tls_server(directory.path(), None).await;
    let client = |url: &str, ca_file| {
        let endpoint = Endpoint {
            ca_file,
            token: Some(TokenSource::Variable(Token::of("abc"))),
            ..Endpoint::at(parse_server(url).unwrap())
        };
        Client::new(endpoint).unwrap()
    };
    client(&url, Some(ca_file.clone())).send(&Call::get(NODES)).await.unwrap();
    let other = rcgen::generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    std::fs::write(&ca_file, other.cert.pem()).unwrap();
    let error = client(&url, Some(ca_file)).send(&Call::get(NODES)).await.unwrap_err();
    assert_eq!(error.exit() as u8, 3, "{error}");
    assert!(error.to_string().contains("--ca-file FILE names the authority"), "{error}");
    // Spoken to without TLS, it is no such server, and the advice says what may be wrong.
    let plain = client(&url.replace("https", "http"), None);
    let error = plain.send(&Call::get(NODES)).await.unwrap_err();
    assert!(error.to_string().contains("https://"), "{error}");
}
