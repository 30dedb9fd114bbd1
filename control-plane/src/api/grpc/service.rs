//! The generated trait: every method is opened, done and closed in the same way.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use blaze_domain::config::{Applied, Code, Key, Problem};
use blaze_proto::v1::config_service_server;
use blaze_proto::{Message, v1};
use tokio::sync::OwnedSemaphorePermit;
use tonic::metadata::MetadataValue;
use tonic::{Request, Response, Status};

use super::gate::{self, Call};
use super::operations::{Done, Operations};
use super::{MAX_MESSAGE_BYTES, incoming, status, watch};
use crate::api::limits::ApiLimits;
use crate::core::{Answer, ConfigService, ReadOptions};
use crate::metrics::ApiMetrics;

/// `blaze.v1.ConfigService`.
pub(super) struct Service {
    operations: Operations,
    limits: Arc<ApiLimits>,
    metrics: Arc<ApiMetrics>,
}

impl Call {
    /// The caller that the gate let through, and the message.
    pub(super) fn open<T>(request: Request<T>) -> Result<(Self, T), Status> {
        let (_, mut extensions, message) = request.into_parts();
        match extensions.remove::<Self>() {
            Some(call) => {
                call.begun.store(true, Ordering::Relaxed);
                Ok((call, message))
            }
            // Served around the gate: nobody knows who asks.
            None => Err(Status::unauthenticated(Code::Unauthenticated.title())),
        }
    }

    /// Notes what the call is about.
    pub(super) fn about(&mut self, key: Key) -> Key {
        self.key = Some(key.clone());
        key
    }

    /// Notes that the call asks for secrets, if it does.
    pub(super) fn reveals(&mut self, read: &ReadOptions) {
        if read.reveal {
            self.action = "reveal";
        }
    }
}

impl Service {
    /// The caller that the gate let through, the message, and a place to work on it.
    fn open<T>(&self, request: Request<T>) -> Result<(Call, T, OwnedSemaphorePermit), Status> {
        let (call, message) = Call::open(request)?;
        match self.limits.enter() {
            Ok(place) => Ok((call, message, place)),
            Err(problem) => Err(self.refuse(&call, &problem)),
        }
    }

    pub(super) fn new(
        core: ConfigService,
        limits: Arc<ApiLimits>,
        metrics: Arc<ApiMetrics>,
    ) -> Self {
        Self { operations: Operations { core }, limits, metrics }
    }

    fn close<T: Message>(&self, call: &Call, done: Done<T>) -> Result<Response<T>, Status> {
        let done = match done.map(bounded) {
            // By now a write has taken effect.
            Ok(Err(problem)) if call.method.writes => Err(problem.applied(Applied::Unknown)),
            Ok(checked) => checked,
            Err(problem) => Err(problem),
        };
        done.map(respond).map_err(|problem| self.refuse(call, &problem))
    }

    fn refuse(&self, call: &Call, problem: &Problem) -> Status {
        let caller = &call.caller;
        if gate::is_denial(problem) {
            let (claims, key) = (Some(caller.claims.as_ref()), call.key.as_ref());
            let core = &self.operations.core;
            core.denied(claims, problem, call.action, key, &caller.request_id, caller.address);
        }
        status::from_problem(problem, &caller.request_id)
    }

    async fn open_watch(&self, call: &Call, request: v1::WatchRequest) -> Done<watch::Responses> {
        let query = incoming::watch(request)?;
        let slot = self.limits.open_watch(&call.caller.claims.subject)?;
        let answer = self.operations.core.watch(&call.caller, &query).await?;
        Ok(Answer {
            revision: answer.revision,
            replayed: answer.replayed,
            value: watch::responses(
                answer.value,
                (slot, self.metrics.watcher()),
                call.caller.request_id.clone(),
            ),
        })
    }
}

/// An answer that a client can take.
fn bounded<T: Message>(answer: Answer<T>) -> Done<T> {
    let bytes = answer.value.encoded_len();
    if bytes > MAX_MESSAGE_BYTES {
        let detail = format!(
            "the answer has {bytes} bytes and a message {MAX_MESSAGE_BYTES}; ask with a smaller \
             page"
        );
        return Err(Problem::new(Code::LimitExceeded, detail));
    }
    Ok(answer)
}

fn respond<T>(answer: Answer<T>) -> Response<T> {
    let mut response = Response::new(answer.value);
    let metadata = response.metadata_mut();
    metadata.insert(gate::REVISION, MetadataValue::from(answer.revision));
    if answer.replayed {
        metadata.insert("idempotent-replayed", MetadataValue::from_static("true"));
    }
    response
}

/// The attribute must see the methods, so the macro makes the whole `impl`.
macro_rules! methods {
    ($($name:ident($request:ident) -> $response:ident;)+) => {
        #[tonic::async_trait]
        impl config_service_server::ConfigService for Service {
            $(async fn $name(&self,
                request: Request<v1::$request>) -> Result<Response<v1::$response>, Status> {
                let (mut call, message, _place) = self.open(request)?;
                let done = self.operations.$name(&mut call, message).await;
                self.close(&call, done)
            })+

            type WatchStream = watch::Responses;

            async fn watch(&self,
                request: Request<v1::WatchRequest>) -> Result<Response<watch::Responses>, Status> {
                // Its stream needs no place any more.
                let (call, message, _place) = self.open(request)?;
                let opened = self.open_watch(&call, message).await;
                opened.map(respond).map_err(|problem| self.refuse(&call, &problem))
            }
        }
    };
}

methods! {
    list(ListRequest) -> ListResponse;
    get(GetRequest) -> Document;
    create(CreateRequest) -> Document;
    replace(ReplaceRequest) -> Document;
    patch(PatchRequest) -> Document;
    delete(DeleteRequest) -> DeleteResponse;
    apply(ApplyRequest) -> ApplyResponse;
    get_effective(GetEffectiveRequest) -> Effective;
    list_history(ListHistoryRequest) -> ListHistoryResponse;
    diff(DiffRequest) -> DiffResponse;
    rollback(RollbackRequest) -> Document;
    set_rollout(SetRolloutRequest) -> Document;
    get_topology(GetTopologyRequest) -> JsonResponse;
    list_workers(ListWorkersRequest) -> JsonResponse;
    list_audit(ListAuditRequest) -> JsonResponse;
    create_token(CreateTokenRequest) -> CreateTokenResponse;
    revoke_token(RevokeTokenRequest) -> RevokeTokenResponse;
    list_tokens(ListTokensRequest) -> JsonResponse;
    get_digest(GetDigestRequest) -> JsonResponse;
    trim(TrimRequest) -> JsonResponse;
    revert(RevertRequest) -> ApplyResponse;
}
