//! `blaze.v1.SyncService`: a worker's stream in both directions.
//!
//! ```text
//! SyncRequest.hello (first) ─▶ core::sync ─▶ Welcome, Snapshot, Commit, Bookmark, GoAway ─▶ SyncResponse
//! SyncRequest.ack ───────────▶ core: what the worker has
//! ```

use std::future::ready;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::config::{Code, Problem};
use blaze_proto::v1;
use blaze_proto::v1::sync_request::Msg as Said;
use blaze_proto::v1::sync_response::Msg as Told;
use blaze_proto::v1::sync_service_server;
use futures::{Stream, StreamExt as _, stream};
use tonic::{Request, Response, Status, Streaming};

use super::gate::{self, Call};
use super::{outgoing, status};
use crate::api::limits::ApiLimits;
use crate::api::request::client_address;
use crate::core::{
    Acknowledged, ConfigService, OLDEST_SYNC_PROTOCOL, RolloutReport, Running, RunningState,
    SYNC_PROTOCOL, SyncHello, SyncItem, SyncStream, WorkerSession,
};
use crate::listen::Peer;
use crate::metrics::ApiMetrics;

/// How long a worker may take to say who it is.
const GREETING: Duration = Duration::from_secs(10);
/// When a worker that cannot be served is to come again, in ms: one of the two has to be updated
/// first.
const AGAIN_MS: u32 = 30_000;

/// `blaze.v1.SyncService`.
pub(super) struct Service {
    core: ConfigService,
    limits: Arc<ApiLimits>,
    metrics: Arc<ApiMetrics>,
}

impl Service {
    pub(super) fn new(
        core: ConfigService,
        limits: Arc<ApiLimits>,
        metrics: Arc<ApiMetrics>,
    ) -> Self {
        Self { core, limits, metrics }
    }

    fn refuse(&self, call: &Call, problem: &Problem) -> Status {
        let caller = &call.caller;
        if gate::is_denial(problem) {
            let claims = Some(caller.claims.as_ref());
            self.core.denied(
                claims,
                problem,
                call.action,
                None,
                &caller.request_id,
                caller.address,
            );
        }
        status::from_problem(problem, &caller.request_id)
    }

    async fn greet(
        &self,
        call: &Call,
        said: &mut Streaming<v1::SyncRequest>,
    ) -> Result<SyncHello, Status> {
        let first = tokio::time::timeout(GREETING, said.message()).await;
        let refuse =
            |detail: &str| Err(self.refuse(call, &Problem::new(Code::InvalidRequest, detail)));
        let Ok(first) = first else {
            return refuse("no Hello came within 10 s");
        };
        match first?.and_then(|request| request.msg) {
            Some(Said::Hello(hello)) => {
                read_hello(hello).map_err(|problem| self.refuse(call, &problem))
            }
            Some(Said::Ack(_)) | None => refuse("the first message must be Hello"),
        }
    }
}

/// What the worker gets, until the stream ends.
type Responses = Pin<Box<dyn Stream<Item = Result<v1::SyncResponse, Status>> + Send>>;

#[tonic::async_trait]
impl sync_service_server::SyncService for Service {
    type SyncStream = Responses;

    async fn sync(
        &self,
        request: Request<Streaming<v1::SyncRequest>>,
    ) -> Result<Response<Responses>, Status> {
        let peer = request.extensions().get::<Peer>();
        let is_safe = peer.is_some_and(|peer| peer.encrypted)
            || client_address(request.extensions()).is_loopback();
        let (call, mut said) = Call::open(request)?;
        let slot = self
            .limits
            .open_watch(&call.caller.claims.subject)
            .map_err(|problem| self.refuse(&call, &problem))?;
        let hello = self.greet(&call, &mut said).await?;
        if let Some(reason) = too_far_apart(&hello) {
            tracing::warn!(
                worker = hello.worker_id,
                version = hello.version,
                reason,
                "a worker is sent away"
            );
            return Ok(Response::new(sent_away(reason)));
        }
        let opened = self.core.sync(&call.caller, hello, is_safe).await;
        let opened = opened.map_err(|problem| self.refuse(&call, &problem))?;
        let held = (slot, self.metrics.watcher());
        Ok(Response::new(responses(self.core.clone(), opened, said, held, call.caller.request_id)))
    }
}

/// What goes on in the stream.
enum Event {
    Tell(SyncItem),
    /// The worker has acknowledged something.
    Heard,
    /// The worker has gone, or makes no sense.
    Over(Option<Status>),
}

/// `held` (what counts the stream as open) is dropped with it.
fn responses<H: Send + 'static>(
    core: ConfigService,
    opened: SyncStream,
    said: Streaming<v1::SyncRequest>,
    held: H,
    request_id: String,
) -> Responses {
    let (items, session) = opened.into_parts();
    let heard = said
        .map(move |said| hear(&core, &session, said))
        .chain(stream::once(ready(Event::Over(None))));
    // Whoever has much to be told is heard nevertheless: `select` takes turns.
    let events = stream::select(heard, items.map(Event::Tell));
    let told = events.scan((held, request_id, false), |(_, request_id, is_over), event| {
        if *is_over {
            return ready(None);
        }
        ready(match event {
            Event::Heard => Some(None),
            Event::Over(status) => {
                *is_over = true;
                status.map(|status| Some(Err(status)))
            }
            Event::Tell(item) => response(item, request_id).map(|response| {
                *is_over = response.is_err();
                Some(response)
            }),
        })
    });
    Box::pin(told.filter_map(ready))
}

fn hear(
    core: &ConfigService,
    session: &WorkerSession,
    said: Result<v1::SyncRequest, Status>,
) -> Event {
    match said.map(|request| request.msg) {
        Ok(Some(Said::Ack(ack))) => {
            core.acknowledged(session, read_ack(ack));
            Event::Heard
        }
        // A message of a newer protocol.
        Ok(None) => Event::Heard,
        Ok(Some(Said::Hello(_))) => {
            Event::Over(Some(Status::invalid_argument("Hello comes once, as the first message")))
        }
        Err(status) => {
            tracing::debug!(%status, worker = session.name().id, "a worker's stream broke off");
            Event::Over(None)
        }
    }
}

/// `None`: the stream ends well.
fn response(item: SyncItem, request_id: &str) -> Option<Result<v1::SyncResponse, Status>> {
    let told = match item {
        SyncItem::Welcome { protocol, store_id, revision, resumed } => {
            Told::Welcome(v1::Welcome { protocol, store_id, revision, resumed })
        }
        SyncItem::Snapshot { revision, documents, last } => Told::Snapshot(v1::Snapshot {
            revision,
            documents: documents.iter().map(|document| outgoing::document(document)).collect(),
            last,
        }),
        SyncItem::Commit(commit) => Told::Commit(outgoing::commit(&commit)),
        SyncItem::Bookmark { revision, digest, beside } => {
            Told::Bookmark(v1::Bookmark { revision, digest, beside })
        }
        SyncItem::GoAway { retry_after_ms, reason } => {
            Told::GoAway(v1::GoAway { retry_after_ms, reason })
        }
        SyncItem::End(None) => return None,
        SyncItem::End(Some(problem)) => {
            return Some(Err(status::from_problem(&problem, request_id)));
        }
    };
    Some(Ok(v1::SyncResponse { msg: Some(told) }))
}

fn read_hello(hello: v1::Hello) -> Result<SyncHello, Problem> {
    let refuse = |member: &str, error: String| {
        let detail = format!("Hello: {member}: {error}");
        Problem::new(Code::InvalidRequest, detail)
    };
    let node = match hello.node.as_str() {
        "" => None,
        node => Some(node.parse().map_err(|error| refuse("node", format!("{error}")))?),
    };
    Ok(SyncHello {
        protocol: hello.protocol,
        layer: hello.layer.parse().map_err(|error| refuse("layer", format!("{error}")))?,
        node,
        worker_id: hello.worker_id,
        version: hello.version,
        store_id: hello.store_id,
        revision: hello.revision,
        digest: hello.digest,
        without_texts: hello.without_texts,
    })
}

/// Why a worker cannot be served: it may be one version older than this service, or one newer, for
/// then it speaks this version, too. Others could be misunderstood.
fn too_far_apart(hello: &SyncHello) -> Option<String> {
    let (oldest, newest) = (OLDEST_SYNC_PROTOCOL, SYNC_PROTOCOL + 1);
    let is_served = hello.protocol == 0 || (oldest..=newest).contains(&hello.protocol);
    (!is_served).then(|| {
        format!(
            "version {} of the protocol of Sync is not spoken here, but those of workers from \
             {oldest} to {newest}: update \
             the older of the two",
            hello.protocol
        )
    })
}

/// Tells a worker to come again later, and nothing else.
fn sent_away(reason: String) -> Responses {
    let go_away = SyncItem::GoAway { retry_after_ms: AGAIN_MS, reason };
    Box::pin(stream::iter(response(go_away, "")))
}

/// What it says, without what has names that are none: a worker that is newer may know more.
fn read_ack(ack: v1::Ack) -> Acknowledged {
    let services = ack.services.into_iter().filter_map(|told| {
        let running = Running {
            service: told.service.parse().ok()?,
            instance: told.instance.parse().ok()?,
            node: optional_node(&told.node)?,
        };
        let state = RunningState {
            state: told.state,
            config_revision: told.config_revision,
            config_hash: told.config_hash,
        };
        Some((running, state))
    });
    let rollouts = ack.rollouts.into_iter().filter_map(|told| {
        Some(RolloutReport {
            node: optional_node(&told.node)?,
            uid: told.uid,
            phase: told.phase,
            reason: told.reason,
        })
    });
    Acknowledged::new(ack.revision, ack.digest, services, rollouts)
}

/// `None`: it is no name.
#[expect(clippy::option_option, reason = "no node and no name are two things")]
fn optional_node(text: &str) -> Option<Option<blaze_domain::NodeName>> {
    match text {
        "" => Some(None),
        text => text.parse().ok().map(Some),
    }
}
