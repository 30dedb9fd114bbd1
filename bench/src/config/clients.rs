//! One connection to etcd or BlazeConfig, as a program of a user has it.

use std::net::SocketAddr;

use anyhow::Context as _;
use blaze_proto::v1;
use blaze_proto::v1::config_service_client::ConfigServiceClient;
use bytes::Bytes;
use serde_json::Value;
use tonic::Request;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::transport::{Channel, Endpoint};

use super::documents::name;
use super::etcd;
use super::etcd::kv_client::KvClient;
use super::etcd::watch_client::WatchClient;
use super::watches::Watch;

/// Before the name of a document in etcd.
const PREFIX: &str = "/blaze/services/";
/// The first key after all those.
const PREFIX_END: &str = "/blaze/services0";

/// How a server is reached.
#[derive(Debug, Clone)]
pub(crate) enum Way {
    Etcd(SocketAddr),
    Grpc { at: SocketAddr, token: String },
    Rest { at: SocketAddr, token: String },
}

/// A connection; clones share it.
#[derive(Clone)]
pub(crate) enum Connection {
    Etcd { keys: KvClient<Channel>, watch: WatchClient<Channel> },
    Grpc { client: ConfigServiceClient<Channel>, token: MetadataValue<Ascii> },
    Rest { http: reqwest::Client, base: String, token: String },
}

/// A document as it was read.
pub(crate) struct Found {
    pub(crate) revision: u64,
    body: Body,
}

enum Body {
    /// The spec alone.
    Spec(Bytes),
    /// A whole document, as REST has it.
    Envelope(Bytes),
}

impl Found {
    /// Its spec.
    ///
    /// # Errors
    /// When it is no JSON.
    pub(crate) fn spec(&self) -> anyhow::Result<Value> {
        match &self.body {
            Body::Spec(text) => Ok(serde_json::from_slice(text)?),
            Body::Envelope(text) => {
                let mut whole: Value = serde_json::from_slice(text)?;
                Ok(whole.get_mut("spec").context("no spec")?.take())
            }
        }
    }
}

impl Way {
    /// A new connection.
    ///
    /// # Errors
    /// When nobody listens.
    pub(crate) async fn connect(&self) -> anyhow::Result<Connection> {
        Ok(match self {
            Self::Etcd(at) => {
                let channel = channel(*at).await?;
                Connection::Etcd {
                    keys: KvClient::new(channel.clone()),
                    watch: WatchClient::new(channel),
                }
            }
            Self::Grpc { at, token } => Connection::Grpc {
                client: ConfigServiceClient::new(channel(*at).await?),
                token: format!("Bearer {token}").parse()?,
            },
            Self::Rest { at, token } => Connection::Rest {
                http: reqwest::Client::builder()
                    .no_proxy()
                    .http1_only()
                    .tcp_nodelay(true)
                    .pool_max_idle_per_host(1)
                    .build()?,
                base: format!("http://{at}/api/v1"),
                token: token.clone(),
            },
        })
    }
}

async fn channel(at: SocketAddr) -> anyhow::Result<Channel> {
    let endpoint = Endpoint::from_shared(format!("http://{at}"))?.tcp_nodelay(true);
    endpoint.connect().await.with_context(|| format!("connecting to {at}"))
}

impl Connection {
    /// What a document is now.
    ///
    /// # Errors
    /// When it is refused or not there.
    pub(crate) async fn get(&mut self, number: usize) -> anyhow::Result<Found> {
        match self {
            Self::Etcd { keys, .. } => {
                let request = etcd::RangeRequest { key: key(number), range_end: Bytes::new() };
                let mut kvs = keys.range(request).await?.into_inner().kvs;
                let one = kvs.pop().with_context(|| format!("no {}", name(number)))?;
                anyhow::ensure!(
                    kvs.is_empty() && one.key == key(number),
                    "{:?} was not asked for",
                    one.key
                );
                Ok(Found { revision: one.mod_revision.try_into()?, body: Body::Spec(one.value) })
            }
            Self::Grpc { client, token } => {
                let request = v1::GetRequest { r#ref: Some(reference(number)), read: None };
                let one = client.get(signed(request, token)).await?.into_inner();
                let named = one.r#ref.context("no ref")?.name;
                anyhow::ensure!(named == name(number), "{named} was not asked for");
                Ok(Found { revision: one.revision, body: Body::Spec(one.spec_json.into()) })
            }
            Self::Rest { http, base, token } => {
                let url = format!("{base}/services/{}", name(number));
                let response = http.get(url).bearer_auth(token).send().await?;
                let (revision, body) = answer(response).await?;
                Ok(Found { revision, body: Body::Envelope(body) })
            }
        }
    }

    /// Replaces a document, whatever its revision; gives the new one.
    ///
    /// # Errors
    /// When it is refused.
    pub(crate) async fn put(&mut self, number: usize, spec: String) -> anyhow::Result<u64> {
        match self {
            Self::Etcd { keys, .. } => {
                let answer = keys.put(put_request(number, spec)).await?.into_inner();
                header_revision(answer.header.as_ref())
            }
            Self::Grpc { client, token } => {
                let request = v1::ReplaceRequest {
                    document: Some(document(number, spec)),
                    precondition: Some(v1::Precondition {
                        is: Some(v1::precondition::Is::Any(true)),
                    }),
                };
                Ok(client.replace(signed(request, token)).await?.into_inner().revision)
            }
            Self::Rest { http, base, token } => {
                let request = http.put(format!("{base}/services/{}", name(number)));
                let request = request.bearer_auth(token).header("if-match", "*");
                let request = request.header("content-type", "application/json");
                let response = request.body(format!("{{\"spec\":{spec}}}")).send().await?;
                Ok(answer(response).await?.0)
            }
        }
    }

    /// Makes or replaces many documents in one revision, and gives it.
    ///
    /// # Errors
    /// When it is refused.
    pub(crate) async fn apply(&mut self, documents: Vec<(usize, String)>) -> anyhow::Result<u64> {
        let count = documents.len();
        match self {
            Self::Etcd { keys, .. } => {
                let one = |(number, spec)| etcd::RequestOp {
                    request: Some(etcd::request_op::Request::RequestPut(put_request(number, spec))),
                };
                let success = documents.into_iter().map(one).collect();
                let answer = keys.txn(etcd::TxnRequest { success }).await?.into_inner();
                let done = answer.responses.len();
                anyhow::ensure!(answer.succeeded && done == count, "{done} of {count} were put");
                header_revision(answer.header.as_ref())
            }
            Self::Grpc { client, token } => {
                let one = |(number, spec)| v1::ApplyItem {
                    document: Some(document(number, spec)),
                    delete: false,
                };
                let request = v1::ApplyRequest {
                    items: documents.into_iter().map(one).collect(),
                    ..v1::ApplyRequest::default()
                };
                let answer = client.apply(signed(request, token)).await?.into_inner();
                let done =
                    answer.results.iter().filter(|result| result.revision == answer.revision);
                let done = done.count();
                anyhow::ensure!(done == count, "{done} of {count} were applied");
                Ok(answer.revision)
            }
            Self::Rest { http, base, token } => {
                let items: Vec<String> = documents
                    .iter()
                    .map(|(number, spec)| {
                        format!(
                            "{{\"kind\":\"Service\",\"name\":\"{}\",\"spec\":{spec}}}",
                            name(*number)
                        )
                    })
                    .collect();
                let request = http.post(format!("{base}/apply")).bearer_auth(token);
                let request = request.header("content-type", "application/json");
                let response = request.body(format!("[{}]", items.join(","))).send().await?;
                let body = succeeded(response).await?.bytes().await?;
                applied(&body, count)
            }
        }
    }

    /// Tells of all changes from now on.
    ///
    /// # Errors
    /// When it is refused.
    pub(crate) async fn watch(&mut self) -> anyhow::Result<Watch> {
        match self {
            Self::Etcd { watch, .. } => {
                let create = etcd::WatchCreateRequest {
                    key: Bytes::from_static(PREFIX.as_bytes()),
                    range_end: Bytes::from_static(PREFIX_END.as_bytes()),
                };
                Watch::of_etcd(watch, create).await
            }
            Self::Grpc { client, token } => {
                let request = v1::WatchRequest {
                    kind: v1::Kind::Service.into(),
                    ..v1::WatchRequest::default()
                };
                Ok(Watch::Grpc(client.watch(signed(request, token)).await?.into_inner()))
            }
            Self::Rest { http, base, token } => {
                let url = format!("{base}/watch?kind=Service");
                let response = http.get(url).bearer_auth(token).send().await?;
                Ok(Watch::of_rest(succeeded(response).await?))
            }
        }
    }
}

fn key(number: usize) -> Bytes {
    format!("{PREFIX}{}", name(number)).into()
}

fn put_request(number: usize, spec: String) -> etcd::PutRequest {
    etcd::PutRequest { key: key(number), value: spec.into() }
}

fn header_revision(header: Option<&etcd::ResponseHeader>) -> anyhow::Result<u64> {
    Ok(header.context("no header")?.revision.try_into()?)
}

fn reference(number: usize) -> v1::Ref {
    v1::Ref { kind: v1::Kind::Service.into(), name: name(number), service: String::new() }
}

fn document(number: usize, spec: String) -> v1::Document {
    v1::Document { r#ref: Some(reference(number)), spec_json: spec, ..v1::Document::default() }
}

fn signed<T>(message: T, token: &MetadataValue<Ascii>) -> Request<T> {
    let mut request = Request::new(message);
    request.metadata_mut().insert("authorization", token.clone());
    request
}

async fn succeeded(response: reqwest::Response) -> anyhow::Result<reqwest::Response> {
    let status = response.status();
    if status.is_success() {
        return Ok(response);
    }
    anyhow::bail!("{status}: {}", response.text().await?)
}

/// Revision, from the ETag, and body.
async fn answer(response: reqwest::Response) -> anyhow::Result<(u64, Bytes)> {
    let response = succeeded(response).await?;
    let tag = response.headers().get("etag").context("no ETag")?.to_str()?;
    let revision = tag.trim_matches('"').parse().with_context(|| format!("ETag {tag}"))?;
    Ok((revision, response.bytes().await?))
}

/// Revision of an answer of `/apply`, all of whose documents must have it.
fn applied(body: &[u8], count: usize) -> anyhow::Result<u64> {
    #[derive(serde::Deserialize)]
    struct Answer {
        revision: u64,
        results: Vec<One>,
    }
    #[derive(serde::Deserialize)]
    struct One {
        revision: u64,
    }
    let answer: Answer = serde_json::from_slice(body)?;
    let done = answer.results.iter().filter(|one| one.revision == answer.revision);
    let done = done.count();
    anyhow::ensure!(done == count, "{done} of {count} were applied");
    Ok(answer.revision)
}
