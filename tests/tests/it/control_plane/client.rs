//! One user of one process, over REST or gRPC, who knows of each change: yes, no, or unknown.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use blaze_proto::v1;
use blaze_proto::v1::config_service_client::ConfigServiceClient;
use reqwest::Method;
use serde_json::{Value, json};
use tonic::metadata::MetadataValue;
use tonic::transport::{Channel, Endpoint};
use tonic_types::StatusExt as _;

use super::stage::Main;

/// Longer than the service itself takes for any request.
const PATIENCE: Duration = Duration::from_secs(40);

/// What a change insists on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Must {
    /// Nothing.
    Nothing,
    /// That there is none.
    BeAbsent,
    /// That there is one.
    BeThere,
    /// That it has this revision.
    HaveRevision(u64),
}

/// What a client was told of a change.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Told {
    /// It took effect, with this revision.
    Yes(u64),
    /// It was refused by its content, with this code: it did not take effect.
    Refused(String),
    /// Something was in the way, and it did not take effect.
    No(String),
    /// Nobody knows.
    Unknown(String),
}

/// Which interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Via {
    Rest,
    Grpc,
}

/// A document as a client sees it: revision, and `spec.config`.
pub(crate) type Seen = (u64, Value);

/// A user. All documents are services: what they refer to is nothing.
#[derive(Clone)]
pub(crate) struct Client {
    pub(crate) via: Via,
    pub(crate) main: Arc<Main>,
    pub(crate) rest: Rest,
    grpc: Arc<tokio::sync::Mutex<Option<(SocketAddr, Channel)>>>,
}

impl Client {
    pub(crate) fn new(via: Via, main: &Arc<Main>, token: &str) -> Self {
        Self { via, main: Arc::clone(main), rest: Rest::new(token), grpc: Arc::default() }
    }

    /// The same user at the same or another process, by the same or another interface. gRPC has a
    /// connection of its own.
    pub(crate) fn at(&self, via: Via, main: &Arc<Main>) -> Self {
        Self { via, main: Arc::clone(main), rest: self.rest.clone(), grpc: Arc::default() }
    }

    /// The same user with other connections of REST.
    pub(crate) fn over(&self, http: reqwest::Client) -> Self {
        let mut other = self.at(self.via, &self.main);
        other.rest.http = http;
        other
    }

    /// Gives up the connection of gRPC.
    pub(crate) async fn disconnect(&self) {
        *self.grpc.lock().await = None;
    }

    /// Replaces or makes service `name` with this `spec.config`.
    pub(crate) async fn put(&self, name: &str, config: &Value, must: Must) -> Told {
        match self.via {
            Via::Rest => {
                let path = format!("/api/v1/services/{name}");
                let body = json!({ "spec": { "config": config } });
                let answer = self.send(Method::PUT, &path, must, Some(&body)).await;
                told(answer, |answer| answer.body["revision"].as_u64())
            }
            Via::Grpc => {
                let request = v1::ReplaceRequest {
                    document: Some(service(name, config)),
                    precondition: precondition(must),
                };
                let answer = match self.grpc().await {
                    Ok(mut client) => client.replace(self.signed(request)).await,
                    Err(reason) => return Told::No(reason),
                };
                told_grpc(answer.map(|document| document.into_inner().revision))
            }
        }
    }

    pub(crate) async fn delete(&self, name: &str, must: Must) -> Told {
        match self.via {
            Via::Rest => {
                let path = format!("/api/v1/services/{name}");
                let answer = self.send(Method::DELETE, &path, must, None).await;
                told(answer, |answer| answer.revision)
            }
            Via::Grpc => {
                let request = v1::DeleteRequest {
                    r#ref: Some(reference(name)),
                    precondition: precondition(must),
                    cascade: false,
                };
                let answer = match self.grpc().await {
                    Ok(mut client) => client.delete(self.signed(request)).await,
                    Err(reason) => return Told::No(reason),
                };
                told_grpc(answer.map(|deleted| deleted.into_inner().revision))
            }
        }
    }

    /// All of them in one commit, or none.
    pub(crate) async fn apply(&self, documents: &[(String, Value)]) -> Told {
        match self.via {
            Via::Rest => {
                let one = |(name, config): &(String, Value)| {
                    json!({
                        "kind": "Service",
                        "name": name,
                        "spec": { "config": config },
                    })
                };
                let body = Value::Array(documents.iter().map(one).collect());
                let answer =
                    self.send(Method::POST, "/api/v1/apply", Must::Nothing, Some(&body)).await;
                told(answer, |answer| answer.body["revision"].as_u64())
            }
            Via::Grpc => {
                let one = |(name, config): &(String, Value)| v1::ApplyItem {
                    document: Some(service(name, config)),
                    delete: false,
                };
                let request = v1::ApplyRequest {
                    items: documents.iter().map(one).collect(),
                    ..v1::ApplyRequest::default()
                };
                let answer = match self.grpc().await {
                    Ok(mut client) => client.apply(self.signed(request)).await,
                    Err(reason) => return Told::No(reason),
                };
                told_grpc(answer.map(|report| report.into_inner().revision))
            }
        }
    }

    /// What it is now.
    ///
    /// # Errors
    /// Why there was no answer.
    pub(crate) async fn get(&self, name: &str) -> Result<Option<Seen>, String> {
        match self.via {
            Via::Rest => {
                let path = format!("/api/v1/services/{name}");
                let answer = self.rest.get(self.main.at().rest, &path).await;
                let answer = answer.map_err(|lost| lost.reason)?;
                match answer.status {
                    200 => {
                        let revision = answer.body["revision"].as_u64().unwrap();
                        Ok(Some((revision, answer.body["spec"]["config"].clone())))
                    }
                    404 => Ok(None),
                    status => Err(format!("{status} {}", answer.body)),
                }
            }
            Via::Grpc => {
                let request = v1::GetRequest { r#ref: Some(reference(name)), read: None };
                match self.grpc().await?.get(self.signed(request)).await {
                    Ok(document) => {
                        let document = document.into_inner();
                        let spec: Value = serde_json::from_str(&document.spec_json).unwrap();
                        Ok(Some((document.revision, spec["config"].clone())))
                    }
                    Err(status) if status.code() == tonic::Code::NotFound => Ok(None),
                    Err(status) => Err(status.to_string()),
                }
            }
        }
    }

    /// A client of the generated code, connected.
    ///
    /// # Errors
    /// When nobody listens.
    pub(crate) async fn grpc(&self) -> Result<ConfigServiceClient<Channel>, String> {
        let at = self.main.at().grpc;
        let mut kept = self.grpc.lock().await;
        if let Some((address, channel)) = &*kept
            && *address == at
        {
            return Ok(ConfigServiceClient::new(channel.clone()));
        }
        let endpoint = Endpoint::from_shared(format!("http://{at}")).unwrap().timeout(PATIENCE);
        // The smallest window: what is not read stays with the service.
        let endpoint = endpoint.initial_stream_window_size(65_535);
        let channel = endpoint.connect().await.map_err(|error| format!("{error:?}"))?;
        *kept = Some((at, channel.clone()));
        Ok(ConfigServiceClient::new(channel))
    }

    /// A request with the token.
    pub(crate) fn signed<T>(&self, message: T) -> tonic::Request<T> {
        let mut request = tonic::Request::new(message);
        let value = MetadataValue::try_from(format!("Bearer {}", self.rest.token)).unwrap();
        request.metadata_mut().insert("authorization", value);
        request
    }

    async fn send(
        &self,
        method: Method,
        path: &str,
        must: Must,
        body: Option<&Value>,
    ) -> Result<Answer, Lost> {
        let header = match must {
            Must::Nothing => None,
            Must::BeAbsent => Some(("if-none-match", "*".to_owned())),
            Must::BeThere => Some(("if-match", "*".to_owned())),
            Must::HaveRevision(revision) => Some(("if-match", format!("\"{revision}\""))),
        };
        let headers: Vec<(&str, String)> = header.into_iter().collect();
        self.rest.send(self.main.at().rest, method, path, &headers, body).await
    }
}

fn reference(name: &str) -> v1::Ref {
    v1::Ref { kind: v1::Kind::Service.into(), name: name.to_owned(), service: String::new() }
}

fn service(name: &str, config: &Value) -> v1::Document {
    v1::Document {
        r#ref: Some(reference(name)),
        spec_json: json!({ "config": config }).to_string(),
        ..v1::Document::default()
    }
}

fn precondition(must: Must) -> Option<v1::Precondition> {
    use v1::precondition::Is;
    let is = match must {
        Must::Nothing => return None,
        Must::BeAbsent => Is::Absent(true),
        Must::BeThere => Is::Any(true),
        Must::HaveRevision(revision) => Is::Revision(revision),
    };
    Some(v1::Precondition { is: Some(is) })
}

fn told(answer: Result<Answer, Lost>, revision: impl Fn(&Answer) -> Option<u64>) -> Told {
    let answer = match answer {
        Ok(answer) => answer,
        Err(lost) if lost.never_sent => return Told::No(lost.reason),
        Err(lost) => return Told::Unknown(lost.reason),
    };
    if answer.status < 300 {
        return Told::Yes(revision(&answer).expect("every write tells its revision"));
    }
    let code = answer.code();
    let applied = answer.body["applied"].as_str().unwrap_or_default().to_owned();
    of_refusal(&code, &applied, answer.status >= 500, &answer.body.to_string())
}

fn told_grpc(answer: Result<u64, tonic::Status>) -> Told {
    let status = match answer {
        Ok(revision) => return Told::Yes(revision),
        Err(status) => status,
    };
    let Some(info) = status.get_details_error_info() else {
        // Not from the service: the connection broke.
        return Told::Unknown(status.to_string());
    };
    let member = |name: &str| info.metadata.get(name).cloned().unwrap_or_default();
    let of_server = matches!(
        status.code(),
        tonic::Code::Unavailable
            | tonic::Code::Unknown
            | tonic::Code::Internal
            | tonic::Code::DeadlineExceeded
    );
    of_refusal(&member("code"), &member("applied"), of_server, &status.to_string())
}

fn of_refusal(code: &str, applied: &str, of_server: bool, whole: &str) -> Told {
    match applied {
        "unknown" => Told::Unknown(whole.to_owned()),
        "no" if of_server => Told::No(whole.to_owned()),
        "no" => Told::Refused(code.to_owned()),
        _ => panic!("a refusal says whether it took effect: {whole}"),
    }
}

/// An answer of REST.
#[derive(Debug, Clone)]
pub(crate) struct Answer {
    pub(crate) status: u16,
    /// `Blaze-Revision`.
    pub(crate) revision: Option<u64>,
    /// `null` if it was no JSON.
    pub(crate) body: Value,
    pub(crate) text: String,
}

impl Answer {
    /// The code of a problem, or nothing.
    pub(crate) fn code(&self) -> String {
        self.body["code"].as_str().unwrap_or_default().to_owned()
    }
}

/// Why there was no answer.
#[derive(Debug)]
pub(crate) struct Lost {
    /// Nobody was there to take the request.
    pub(crate) never_sent: bool,
    pub(crate) reason: String,
}

/// REST with a token; an empty one is not sent.
#[derive(Clone)]
pub(crate) struct Rest {
    pub(crate) http: reqwest::Client,
    pub(crate) token: String,
}

impl Rest {
    pub(crate) fn new(token: &str) -> Self {
        let http = reqwest::Client::builder().no_proxy().timeout(PATIENCE).build().unwrap();
        Self { http, token: token.to_owned() }
    }

    /// The same connections with another token.
    pub(crate) fn with_token(&self, token: &str) -> Self {
        Self { http: self.http.clone(), token: token.to_owned() }
    }

    pub(crate) async fn send(
        &self,
        at: SocketAddr,
        method: Method,
        path: &str,
        headers: &[(&str, String)],
        body: Option<&Value>,
    ) -> Result<Answer, Lost> {
        let mut request = self.http.request(method, format!("http://{at}{path}"));
        if !self.token.is_empty() {
            request = request.bearer_auth(&self.token);
        }
        for (name, value) in headers {
            request = request.header(*name, value);
        }
        if let Some(body) = body {
            request = request.json(body);
        }
        let lost = |error: reqwest::Error| Lost {
            never_sent: error.is_connect(),
            reason: format!("{error:?}"),
        };
        let response = request.send().await.map_err(lost)?;
        let revision = response.headers().get("blaze-revision");
        let revision = revision.and_then(|value| value.to_str().ok()?.parse().ok());
        let status = response.status().as_u16();
        // Half an answer is none: what it said is not known.
        let text = response.text().await.map_err(lost)?;
        Ok(Answer { status, revision, body: serde_json::from_str(&text).unwrap_or_default(), text })
    }

    pub(crate) async fn get(&self, at: SocketAddr, path: &str) -> Result<Answer, Lost> {
        self.send(at, Method::GET, path, &[], None).await
    }

    /// `POST`, and nothing but success.
    pub(crate) async fn post(&self, at: SocketAddr, path: &str, body: &Value) -> Answer {
        let answer = self.send(at, Method::POST, path, &[], Some(body)).await.unwrap();
        assert!(answer.status < 300, "POST {path}: {} {}", answer.status, answer.text);
        answer
    }

    /// `PUT` whatever there is, and nothing but success.
    pub(crate) async fn put(&self, at: SocketAddr, path: &str, body: &Value) -> Answer {
        let there = self.get(at, path).await.unwrap().status == 200;
        let headers = if there { vec![("if-match", "*".to_owned())] } else { Vec::new() };
        let answer = self.send(at, Method::PUT, path, &headers, Some(body)).await.unwrap();
        assert!(answer.status < 300, "PUT {path}: {} {}", answer.status, answer.text);
        answer
    }

    /// Every document of a collection, and the revision that the list shows. `None` when its pages
    /// were trimmed away while it was read.
    pub(crate) async fn try_list(
        &self,
        at: SocketAddr,
        collection: &str,
    ) -> Option<(u64, Vec<Value>)> {
        match self.try_pages(at, &format!("/api/v1/{collection}")).await {
            Ok(list) => Some(list),
            Err(answer) => {
                assert_eq!(answer.status, 410, "{}", answer.text);
                None
            }
        }
    }

    /// All entries of what comes in pages.
    pub(crate) async fn pages(&self, at: SocketAddr, path: &str) -> Vec<Value> {
        match self.try_pages(at, path).await {
            Ok((_, items)) => items,
            Err(answer) => panic!("{path}: {} {}", answer.status, answer.text),
        }
    }

    async fn try_pages(&self, at: SocketAddr, path: &str) -> Result<(u64, Vec<Value>), Answer> {
        let path = format!("{path}{}limit=1000", if path.contains('?') { '&' } else { '?' });
        let (mut items, mut next) = (Vec::new(), path.clone());
        loop {
            let answer = self.get(at, &next).await.unwrap();
            if answer.status != 200 {
                return Err(answer);
            }
            items.extend(answer.body["items"].as_array().unwrap().iter().cloned());
            let page = answer.body["next_page_token"].as_str().unwrap();
            if page.is_empty() {
                return Ok((answer.body["revision"].as_u64().unwrap(), items));
            }
            next = format!("{path}&page_token={page}");
        }
    }

    /// As [`Rest::try_list`], again and again while it is trimmed away.
    pub(crate) async fn list(&self, at: SocketAddr, collection: &str) -> (u64, Vec<Value>) {
        for _ in 0..100 {
            if let Some(list) = self.try_list(at, collection).await {
                return list;
            }
        }
        panic!("a hundred lists of {collection} were trimmed away");
    }
}
