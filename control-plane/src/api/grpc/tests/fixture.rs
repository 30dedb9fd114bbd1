//! A service without a network, and what tests say to it.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use axum::Router;
use axum::body::Body;
use axum::extract::ConnectInfo;
use axum::http::{HeaderMap, Request as HttpRequest};
use blaze_domain::config::Code;
use blaze_domain::node_file::ControlPlaneSection;
use blaze_proto::v1;
use blaze_proto::v1::config_service_client::ConfigServiceClient;
use blaze_runtime::{Readiness, Supervisor};
use bytes::{BufMut as _, Bytes, BytesMut};
use http_body_util::BodyExt as _;
use serde_json::Value;
use tonic::Status;
use tower::ServiceExt as _;

use super::super::{GrpcOptions, router, status};
use crate::api::limits::ApiLimits;
use crate::api::rest::{self, RestOptions};
use crate::auth::{Algorithm, Authenticator, NamedKey, NewToken, Realm, Revocations, read_key};
use crate::core::{ConfigService, CoreOptions};
use crate::metrics::ApiMetrics;
use crate::secrets::Keyring;
use crate::store::SqliteStore;

/// A service, its clients' view of it, and what signs tokens for it.
pub(super) struct Fixture {
    pub(super) router: Router,
    /// The other interface of the same service.
    pub(super) rest: Router,
    pub(super) readiness: Readiness,
    pub(super) metrics: Arc<ApiMetrics>,
    pub(super) core: ConfigService,
    keys: Authenticator,
    _supervisor: Supervisor,
}

impl Fixture {
    /// Nobody needs a token.
    pub(super) async fn open() -> Self {
        Self::new(false).await
    }

    /// Everybody needs a token.
    pub(super) async fn guarded() -> Self {
        Self::new(true).await
    }

    async fn new(guarded: bool) -> Self {
        let key = NamedKey {
            id: "k1".into(),
            key: read_key(Algorithm::Hs256, &[b'k'; 32], true).unwrap(),
            sign: true,
        };
        let keys = Authenticator::with_keys(Realm::default(), vec![key]);
        let supervisor = Supervisor::new("test");
        let readiness = Readiness::new();
        let section = ControlPlaneSection::default();
        let core = ConfigService::start(
            &supervisor,
            CoreOptions {
                store: Arc::new(SqliteStore::in_memory(&supervisor).await.unwrap()),
                authenticator: Some(Arc::new(keys.clone())),
                dev: !guarded,
                revocations: Revocations::new(),
                keyring: Arc::new(Keyring::with_keys(&[("e1", [7; 32])]).unwrap()),
                history: section.history.clone(),
                on_commit: Arc::new(|_| {}),
                readiness: readiness.clone(),
            },
        );
        let core = core.await.unwrap();
        let metrics = Arc::new(ApiMetrics::new().unwrap());
        let mut limits = section.limits;
        limits.auth_failures_per_s = 0;
        let limits = Arc::new(ApiLimits::new(&limits));
        let options = RestOptions {
            dev: !guarded,
            limits: Arc::clone(&limits),
            readiness: readiness.clone(),
            metrics: Arc::clone(&metrics),
        };
        let rest = rest::router(core.clone(), options);
        let options = GrpcOptions {
            dev: !guarded,
            limits,
            metrics: Arc::clone(&metrics),
            readiness: readiness.clone(),
            reflection: !guarded,
            stopping: supervisor.stopping_token(),
        };
        Self {
            router: router(core.clone(), options),
            core,
            rest,
            readiness,
            metrics,
            keys,
            _supervisor: supervisor,
        }
    }

    pub(super) fn client(&self) -> ConfigServiceClient<Router> {
        ConfigServiceClient::with_origin(
            self.router.clone(),
            "http://localhost:50051".parse().unwrap(),
        )
    }

    /// A token that runs out after some seconds, or did so before.
    pub(super) fn token(&self, role: &str, expires_in_s: i64) -> String {
        self.token_for(role, None, expires_in_s)
    }

    /// A token of one layer, or of all.
    pub(super) fn token_for(&self, role: &str, layer: Option<&str>, expires_in_s: i64) -> String {
        let now_s = now_s();
        let roles = [role.to_owned()];
        let token = NewToken {
            subject: "ops",
            roles: &roles,
            layer,
            issued_s: now_s.min(now_s + expires_in_s - 1),
            expires_s: now_s + expires_in_s,
            id: "t1",
        };
        self.keys.sign(&token).unwrap().unwrap()
    }

    /// What REST answers, in development.
    pub(super) async fn rest(&self, path: &str) -> Value {
        let peer: SocketAddr = "127.0.0.1:40000".parse().unwrap();
        let request =
            HttpRequest::get(path).header("host", "localhost:8080").extension(ConnectInfo(peer));
        let response = self.rest.clone().oneshot(request.body(Body::empty()).unwrap());
        let (parts, body) = response.await.unwrap().into_parts();
        let body = body.collect().await.unwrap().to_bytes();
        assert_eq!(parts.status, 200, "{path}: {body:?}");
        serde_json::from_slice(&body).unwrap()
    }

    /// Sends one message by hand.
    pub(super) async fn post(
        &self,
        path: &str,
        headers: &[(&str, &str)],
        message: &[u8],
    ) -> Posted {
        self.post_frame(path, headers, frame(message)).await
    }

    pub(super) async fn post_frame(
        &self,
        path: &str,
        headers: &[(&str, &str)],
        frame: Bytes,
    ) -> Posted {
        let mut request = HttpRequest::post(format!("http://localhost{path}"))
            .header("content-type", "application/grpc");
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let response =
            self.router.clone().oneshot(request.body(Body::from(frame)).unwrap()).await.unwrap();
        let headers = response.headers().clone();
        let body = response.into_body().collect().await.unwrap();
        let status =
            Status::from_header_map(&headers).or_else(|| Status::from_header_map(body.trailers()?));
        Posted { status: status.unwrap(), headers, body: body.to_bytes() }
    }
}

pub(super) fn now_s() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs() as i64
}

pub(super) struct Posted {
    pub(super) status: Status,
    pub(super) headers: HeaderMap,
    pub(super) body: Bytes,
}

fn frame(message: &[u8]) -> Bytes {
    let mut frame = BytesMut::new();
    frame.put_u8(0);
    frame.put_u32(message.len().try_into().unwrap());
    frame.put_slice(message);
    frame.freeze()
}

pub(super) fn code(status: &Status) -> Code {
    status::code_of(status).unwrap_or_else(|| panic!("{status:?} has no code"))
}

pub(super) fn reference(kind: v1::Kind, name: &str) -> Option<v1::Ref> {
    Some(v1::Ref { kind: kind.into(), name: name.into(), service: String::new() })
}

pub(super) fn layer(name: &str, spec: &str) -> Option<v1::Document> {
    Some(v1::Document {
        r#ref: reference(v1::Kind::Layer, name),
        spec_json: spec.into(),
        ..Default::default()
    })
}

pub(super) fn create(name: &str, request_id: &str) -> v1::CreateRequest {
    v1::CreateRequest { document: layer(name, r#"{"kind":"edge"}"#), request_id: request_id.into() }
}

pub(super) fn exactly(revision: u64) -> Option<v1::Precondition> {
    Some(v1::Precondition { is: Some(v1::precondition::Is::Revision(revision)) })
}
