//! REST: HTTP with JSON over the core.
//!
//! ```text
//! request ─▶ frame     request id, time, panic, log, metrics, headers of every answer
//!              └▶ gate      431, 414, Host, --dev's 403 ┬─ outside /api/ ─▶ pages       livez … docs, else 404
//!                           429, 401, limits      └─ routes ─▶ 404, 405, else
//!                   └▶ operation  name 404, 406, 403, body 413/415, 400, a place among those at work
//!                          └▶ documents, history, apply, effective, system, tokens, watch, live,
//!                                 monitoring ─▶ core
//! ```
//!
//! The checks come in this order for every request; what a document may be is the core's matter.
//! `routes` is the table of all operations, and the OpenAPI document is made from the same table.

mod body;
mod documents;
mod effective;
mod error_pages;
mod frame;
mod gate;
mod headers;
mod history;
mod live;
mod many;
mod monitoring;
mod negotiate;
mod openapi;
mod operation;
mod pages;
mod query;
mod reply;
mod requests;
mod routes;
mod system;
#[cfg(test)]
mod tests;
mod tokens;
mod watch;

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::Request;
use blaze_runtime::Readiness;

use super::limits::ApiLimits;
use crate::core::ConfigService;
use crate::metrics::ApiMetrics;

pub use openapi::{openapi_3_0_json, openapi_json};

/// Longest path with query, in bytes.
const MAX_URI_BYTES: usize = 8 * 1024;
/// Largest head of a request without its first line, in bytes. The listener must let through a
/// little more, or it answers by itself and without a problem object.
const MAX_HEADER_BYTES: usize = 32 * 1024;
/// From the head of a request to the head of its answer.
const DEADLINE: Duration = Duration::from_secs(30);

/// What the interface needs besides the core.
#[derive(Clone)]
pub struct RestOptions {
    /// `--dev`: no token needed, and only from this machine.
    pub dev: bool,
    /// What one client may take, shared with gRPC.
    pub limits: Arc<ApiLimits>,
    /// For `/readyz`.
    pub readiness: Readiness,
    /// Where requests are counted.
    pub metrics: Arc<ApiMetrics>,
}

/// All that handlers share.
struct Rest {
    service: ConfigService,
    options: RestOptions,
}

/// The whole interface. Peers' addresses are taken from `ConnectInfo<SocketAddr>` of the requests.
pub fn router(service: ConfigService, options: RestOptions) -> Router {
    let rest = Arc::new(Rest { service, options });
    let api = routes::router(&rest)
        .fallback(gate::unknown)
        .method_not_allowed_fallback(gate::wrong_method);
    let pages = pages::router(&rest);
    Router::new().fallback(move |request: Request| {
        let (rest, api, pages) = (Arc::clone(&rest), api.clone(), pages.clone());
        async move { frame::serve(&rest, api, pages, request).await }
    })
}
