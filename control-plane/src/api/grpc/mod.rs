//! gRPC: `blaze.v1.ConfigService`, `blaze.v1.SyncService` and `blaze.v1.StatusService` on the core,
//! health, reflection.
//!
//! ```text
//! axum::Router ─┬─ blaze.v1.ConfigService ─ gate ─▶ service ─▶ operations ─▶ core::ConfigService
//!               │                                     └─ incoming, outgoing, watch, status
//!               ├─ blaze.v1.SyncService ─── gate ─▶ sync ─────────────────▶ core::ConfigService
//!               ├─ blaze.v1.StatusService ─ gate ─▶ monitors ─────────────▶ core::ConfigService
//!               ├─ grpc.health.v1.Health            without a token, follows readiness
//!               └─ grpc.reflection.v1, v1alpha      without a token, only if it is switched on
//! ```
//!
//! Streams per connection, keepalive and the sizes of frames belong to the listener that serves the
//! router.

mod gate;
mod health;
mod incoming;
mod methods;
mod monitors;
mod operations;
mod outgoing;
mod service;
mod status;
mod sync;
#[cfg(test)]
mod tests;
mod watch;

use std::sync::Arc;

use axum::{Router, middleware};
use blaze_proto::CONFIG_DESCRIPTORS;
use blaze_proto::v1::config_service_server::ConfigServiceServer;
use blaze_proto::v1::status_service_server::StatusServiceServer;
use blaze_proto::v1::sync_service_server::SyncServiceServer;
use blaze_runtime::Readiness;
use tokio_util::sync::CancellationToken;
use tonic::codec::CompressionEncoding;
use tonic::service::Routes;
use tonic_health::pb::health_server::HealthServer;
use tonic_reflection::server::Builder as Reflection;

use super::limits::ApiLimits;
use crate::core::ConfigService;
use crate::metrics::ApiMetrics;
use crate::status::limits::MAX_MESSAGE_BYTES as MAX_REPORT_BYTES;

/// Largest message, in bytes, in and out (16 MiB).
pub const MAX_MESSAGE_BYTES: usize = 16 * 1024 * 1024;
/// Largest request of `Apply`, in bytes (8 MiB), as the body in REST.
pub const MAX_APPLY_BYTES: usize = 8 * 1024 * 1024;
/// Largest request of health and reflection, in bytes: they have no token.
const MAX_OPEN_BYTES: usize = 4096;

/// What the interface needs besides the core.
#[derive(Clone)]
pub struct GrpcOptions {
    /// `--dev`: no token needed, and only from this machine.
    pub dev: bool,
    /// Shared with REST.
    pub limits: Arc<ApiLimits>,
    /// Shared with REST.
    pub metrics: Arc<ApiMetrics>,
    /// What health says.
    pub readiness: Readiness,
    /// Whether reflection is served: `grpc.reflection: true`, or `--dev`.
    pub reflection: bool,
    /// Cancelled when streams of health shall end. Watches end by the core.
    pub stopping: CancellationToken,
}

/// All services. What is none of them is answered with UNIMPLEMENTED. The listener must put the
/// client's address into each request as `ConnectInfo<SocketAddr>`.
pub fn router(service: ConfigService, options: GrpcOptions) -> Router {
    let gate = Arc::new(gate::Gate {
        core: service.clone(),
        limits: Arc::clone(&options.limits),
        metrics: Arc::clone(&options.metrics),
        dev: options.dev,
    });
    let workers = sync::Service::new(
        service.clone(),
        Arc::clone(&options.limits),
        Arc::clone(&options.metrics),
    );
    let workers = SyncServiceServer::new(workers).max_decoding_message_size(MAX_MESSAGE_BYTES);
    let monitors = monitors::Service::new(service.clone(), Arc::clone(&options.limits));
    let monitors = StatusServiceServer::new(monitors)
        .max_decoding_message_size(MAX_REPORT_BYTES)
        .accept_compressed(CompressionEncoding::Gzip);
    let config =
        ConfigServiceServer::new(service::Service::new(service, options.limits, options.metrics))
            .max_decoding_message_size(MAX_MESSAGE_BYTES);
    let config = Routes::new(config)
        .add_service(workers)
        .add_service(monitors)
        .into_axum_router()
        .reset_fallback()
        .route_layer(middleware::from_fn_with_state(Arc::clone(&gate), gate::gate));

    let health = health::Readyz { readiness: options.readiness, stopping: options.stopping };
    let open = Routes::new(HealthServer::new(health).max_decoding_message_size(MAX_OPEN_BYTES));
    let open = if options.reflection { with_reflection(open) } else { open };
    open.into_axum_router().layer(middleware::from_fn_with_state(gate, gate::open)).merge(config)
}

fn with_reflection(routes: Routes) -> Routes {
    let descriptors = || {
        Reflection::configure()
            .register_encoded_file_descriptor_set(CONFIG_DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    match (descriptors().build_v1(), descriptors().build_v1alpha()) {
        (Ok(v1), Ok(v1alpha)) => routes
            .add_service(v1.max_decoding_message_size(MAX_OPEN_BYTES))
            .add_service(v1alpha.max_decoding_message_size(MAX_OPEN_BYTES)),
        // The descriptors are part of the program, and a test reads them.
        (Err(error), _) | (_, Err(error)) => {
            tracing::error!(%error, "no reflection: the descriptors cannot be read");
            routes
        }
    }
}
