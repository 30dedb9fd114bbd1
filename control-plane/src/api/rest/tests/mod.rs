//! The interface from outside, on a core with a store in memory.

mod documents;
mod order;
mod pages;
mod watching;

use std::net::SocketAddr;
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::extract::ConnectInfo;
use axum::http::{HeaderMap, StatusCode};
use blaze_domain::node_file::{ControlPlaneSection, LimitsSection};
use blaze_runtime::{Readiness, Supervisor};
use http_body_util::BodyExt;
use serde_json::{Value, json};
use tower::ServiceExt;

use super::*;
use crate::auth::{Authenticator, Revocations};
use crate::core::{CoreOptions, testing};
use crate::secrets::Keyring;
use crate::store::SqliteStore;

const SOON: Duration = Duration::from_secs(10);
const NO_LIMITS: LimitsSection = LimitsSection {
    in_flight: 512,
    watches_per_subject: 2,
    requests_per_s: 0,
    auth_failures_per_s: 0,
};

struct Api {
    router: Router,
    metrics: Arc<ApiMetrics>,
    _supervisor: Supervisor,
}

struct Reply {
    status: StatusCode,
    headers: HeaderMap,
    body: Bytes,
}

impl Reply {
    fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or(Value::Null)
    }

    fn code(&self) -> (u16, String) {
        (self.status.as_u16(), self.json()["code"].as_str().unwrap_or_default().to_owned())
    }

    fn header(&self, name: &str) -> &str {
        self.headers.get(name).and_then(|value| value.to_str().ok()).unwrap_or_default()
    }
}

fn api(supervisor: Supervisor, service: ConfigService, limits: &LimitsSection) -> Api {
    let metrics = Arc::new(ApiMetrics::new().unwrap());
    let options = RestOptions {
        dev: true,
        limits: Arc::new(ApiLimits::new(limits)),
        readiness: Readiness::new(),
        metrics: Arc::clone(&metrics),
    };
    Api { router: router(service, options), metrics, _supervisor: supervisor }
}

/// Everybody is an administrator.
async fn open() -> Api {
    open_with(&NO_LIMITS).await
}

async fn open_with(limits: &LimitsSection) -> Api {
    let supervisor = Supervisor::new("test");
    let service = testing::service(&supervisor).await.unwrap();
    api(supervisor, service, limits)
}

/// Nobody has a token that is accepted.
async fn locked(limits: &LimitsSection) -> Api {
    guarded(limits, None).await
}

/// Tokens of these keys are accepted.
async fn guarded(limits: &LimitsSection, authenticator: Option<Arc<Authenticator>>) -> Api {
    let supervisor = Supervisor::new("test");
    let options = CoreOptions {
        store: Arc::new(SqliteStore::in_memory(&supervisor).await.unwrap()),
        authenticator,
        dev: false,
        revocations: Revocations::new(),
        keyring: Arc::new(Keyring::with_keys(&[("e1", [7; 32])]).unwrap()),
        history: ControlPlaneSection::default().history,
        on_commit: Arc::new(|_| {}),
        readiness: Readiness::new(),
    };
    let service = ConfigService::start(&supervisor, options).await.unwrap();
    api(supervisor, service, limits)
}

impl Api {
    async fn call(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &str) -> Reply {
        let mut request =
            Request::builder().method(method).uri(path).header("host", "localhost:8080");
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let peer: SocketAddr = "127.0.0.1:40000".parse().unwrap();
        let request =
            request.extension(ConnectInfo(peer)).body(Body::from(body.to_owned())).unwrap();
        let response = self.router.clone().oneshot(request).await.unwrap();
        let (parts, body) = response.into_parts();
        let collected = tokio::time::timeout(SOON, body.collect()).await;
        Reply {
            status: parts.status,
            headers: parts.headers,
            body: collected.map(|body| body.unwrap().to_bytes()).unwrap_or_default(),
        }
    }

    async fn get(&self, path: &str) -> Reply {
        self.call("GET", path, &[], "").await
    }

    async fn send(&self, method: &str, path: &str, body: &Value) -> Reply {
        self.send_with(method, path, &[], body).await
    }

    async fn send_with(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: &Value,
    ) -> Reply {
        let mut headers = headers.to_vec();
        headers.push(("content-type", "application/json"));
        self.call(method, path, &headers, &body.to_string()).await
    }

    async fn with_layer(self) -> Self {
        let made = self.send("POST", "/api/v1/layers", &layer()).await;
        assert_eq!(made.status, 201, "{:?}", made.json());
        self
    }
}

fn layer() -> Value {
    json!({ "name": "edge", "spec": { "kind": "edge" } })
}

/// A path of a route with names that fit.
fn path_of(route: &routes::Route) -> String {
    route.path.replace("{service}", "slam").replace("{name}", "edge").replace("{id}", "0197c1d2")
}
