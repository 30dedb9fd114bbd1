//! `blaze.v1.StatusService`: a monitor's stream in both directions.
//!
//! ```text
//! ReportRequest.hello (first) ─▶ core::report ─▶ Interest, Query, GoAway ─▶ ReportResponse
//! ReportRequest.summary, answer ─▶ Session: newest state of the node, answers to queries
//! ```

use std::future::ready;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;

use blaze_domain::config::{Code, Problem};
use blaze_proto::v1;
use blaze_proto::v1::report_request::Msg as Reported;
use blaze_proto::v1::report_response::Msg as Sent;
use blaze_proto::v1::status_service_server;
use futures::{Stream, StreamExt as _, stream};
use rand::RngExt as _;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use super::gate::{self, Call};
use super::status;
use crate::api::limits::ApiLimits;
use crate::core::ConfigService;
use crate::status::limits::{AGAIN_MS, GREETING, MAX_WORD_BYTES};
use crate::status::{MonitorHello, Refusal, Session, StatusMetrics, ToMonitor, now};

/// Newest version of the protocol that is spoken here, and the oldest one.
const PROTOCOL: u32 = 1;
/// When a monitor is told to come again: not all at once.
const SOON_MS: std::ops::Range<u32> = 100..2000;

/// `blaze.v1.StatusService`.
pub(super) struct Service {
    core: ConfigService,
    limits: Arc<ApiLimits>,
}

/// What the monitor gets, until the stream ends.
type Responses = Pin<Box<dyn Stream<Item = Result<v1::ReportResponse, Status>> + Send>>;

impl Service {
    pub(super) fn new(core: ConfigService, limits: Arc<ApiLimits>) -> Self {
        Self { core, limits }
    }

    fn refuse(&self, call: &Call, reason: Refusal, problem: &Problem) -> Status {
        self.core.status_metrics().refused(reason);
        let caller = &call.caller;
        if gate::is_denial(problem) {
            let claims = Some(caller.claims.as_ref());
            let (id, address) = (&caller.request_id, caller.address);
            self.core.denied(claims, problem, call.action, None, id, address);
        }
        status::from_problem(problem, &caller.request_id)
    }

    async fn greet(
        &self,
        call: &Call,
        requests: &mut Streaming<v1::ReportRequest>,
    ) -> Result<v1::MonitorHello, Status> {
        let refuse = |detail: &str| {
            let problem = Problem::new(Code::InvalidRequest, detail);
            Err(self.refuse(call, Refusal::BadHello, &problem))
        };
        match tokio::time::timeout(GREETING, requests.message()).await {
            Err(_) => refuse("no Hello came within 10 s"),
            Ok(Err(status)) => {
                count_broken(self.core.status_metrics(), &status);
                Err(status)
            }
            Ok(Ok(first)) => match first.and_then(|request| request.msg) {
                Some(Reported::Hello(hello)) => Ok(hello),
                _ => refuse("the first message must be MonitorHello"),
            },
        }
    }
}

#[tonic::async_trait]
impl status_service_server::StatusService for Service {
    type ReportStream = Responses;

    async fn report(
        &self,
        request: Request<Streaming<v1::ReportRequest>>,
    ) -> Result<Response<Responses>, Status> {
        let (call, mut requests) = Call::open(request)?;
        // Until it has said which node it is of: then there is one stream a node.
        let greeting = self.limits.open_watch(&call.caller.claims.subject);
        let greeting =
            greeting.map_err(|problem| self.refuse(&call, Refusal::TooManyStreams, &problem))?;
        let hello = self.greet(&call, &mut requests).await?;
        if hello.protocol > PROTOCOL + 1 {
            self.core.status_metrics().refused(Refusal::BadHello);
            return Ok(Response::new(sent_away(hello.protocol)));
        }
        let hello =
            read_hello(hello).map_err(|problem| self.refuse(&call, Refusal::BadHello, &problem))?;
        let opened = self.core.report(&call.caller, &hello, now()).await;
        let (session, sent) =
            opened.map_err(|(reason, problem)| self.refuse(&call, reason, &problem))?;
        drop(greeting);
        tracing::info!(
            layer = %hello.layer, node = %hello.node, version = hello.version, epoch = hello.epoch,
            "a monitor has come"
        );
        let sent = ReceiverStream::new(sent).boxed();
        Ok(Response::new(responses(&self.core, call, session, requests, sent)))
    }
}

/// What goes on in the stream.
enum Event {
    Send(ToMonitor),
    /// Something was taken, or refused.
    Taken,
    /// It ends, well or not.
    Over(Option<Status>),
}

fn responses(
    core: &ConfigService,
    call: Call,
    session: Session,
    requests: Streaming<v1::ReportRequest>,
    sent: stream::BoxStream<'static, ToMonitor>,
) -> Responses {
    let metrics = core.status_metrics().clone();
    let taken = requests
        .map(move |request| take(&metrics, &session, request))
        .chain(stream::once(ready(Event::Over(None))));
    let sent = sent.map(Event::Send).chain(stream::once(ready(Event::Over(None))));
    let (core, claims) = (core.clone(), Arc::clone(&call.caller.claims));
    let request_id = call.caller.request_id;
    let end = stream::once(async move {
        let problem = core.stream_end(&claims).await;
        stream::iter(ending(problem.as_ref(), &request_id))
    })
    .flatten();
    let events = stream::select(stream::select(taken, sent), end.boxed());
    let responses = events.scan(false, |is_over, event| {
        if *is_over {
            return ready(None);
        }
        let response = |message| Some(Some(Ok(message_of(message))));
        ready(match event {
            Event::Taken => Some(None),
            Event::Send(message) => response(message),
            Event::Over(status) => {
                *is_over = true;
                status.map(|status| Some(Err(status)))
            }
        })
    });
    Box::pin(responses.filter_map(ready))
}

/// Last word, and end.
fn ending(problem: Option<&Problem>, request_id: &str) -> Vec<Event> {
    let leave = |reason: &str| {
        let go_away = ToMonitor::GoAway {
            retry_after_ms: rand::rng().random_range(SOON_MS),
            reason: reason.to_owned(),
        };
        vec![Event::Send(go_away), Event::Over(None)]
    };
    match problem {
        None => leave("the stream has been open for long"),
        Some(problem) if problem.code == Code::ShuttingDown => leave("the service is ending"),
        Some(problem) => vec![Event::Over(Some(status::from_problem(problem, request_id)))],
    }
}

fn take(
    metrics: &StatusMetrics,
    session: &Session,
    request: Result<v1::ReportRequest, Status>,
) -> Event {
    let taken = match request.map(|request| request.msg) {
        Ok(Some(Reported::Summary(summary))) => session.summary(summary.json, now()),
        Ok(Some(Reported::Answer(answer))) => {
            session.answer(answer.id, answer.status, answer.json, now())
        }
        // A message of a newer protocol.
        Ok(None) => Ok(()),
        Ok(Some(Reported::Hello(_))) => {
            metrics.refused(Refusal::BadHello);
            let text = "MonitorHello comes once, as the first message";
            return Event::Over(Some(Status::invalid_argument(text)));
        }
        Err(status) => {
            let was_refused = count_broken(metrics, &status);
            tracing::debug!(%status, node = %session.node(), "a monitor's stream broke off");
            return Event::Over(was_refused.then_some(status));
        }
    };
    if let Err(reason) = taken {
        metrics.refused(reason);
        tracing::debug!(node = %session.node(), reason = reason.as_str(), "a message is refused");
    }
    Event::Taken
}

/// Whether the library has refused a message for its size.
fn count_broken(metrics: &StatusMetrics, status: &Status) -> bool {
    let too_large =
        matches!(status.code(), tonic::Code::OutOfRange | tonic::Code::ResourceExhausted);
    if too_large {
        metrics.refused(Refusal::MessageTooLarge);
    }
    too_large
}

fn message_of(message: ToMonitor) -> v1::ReportResponse {
    let sent = match message {
        ToMonitor::Interest { period_ms } => Sent::Interest(v1::Interest { period_ms }),
        ToMonitor::Query { id, name } => Sent::Query(v1::Query { id, name }),
        ToMonitor::GoAway { retry_after_ms, reason } => {
            Sent::GoAway(v1::GoAway { retry_after_ms, reason })
        }
    };
    v1::ReportResponse { msg: Some(sent) }
}

/// Tells a monitor to come again later, and nothing else.
fn sent_away(protocol: u32) -> Responses {
    let reason = format!(
        "version {protocol} of the protocol of Report is not spoken here, but version {PROTOCOL}: \
         update the main service"
    );
    let go_away = ToMonitor::GoAway { retry_after_ms: AGAIN_MS, reason };
    Box::pin(stream::iter([Ok(message_of(go_away))]))
}

fn read_hello(hello: v1::MonitorHello) -> Result<MonitorHello, Problem> {
    let refuse = |member: &str, error: &dyn std::fmt::Display| {
        let detail = format!("MonitorHello: {member}: {error}");
        Problem::new(Code::InvalidRequest, detail)
    };
    if hello.protocol == 0 {
        return Err(refuse("protocol", &"there is none before 1"));
    }
    if hello.version.len().max(hello.metrics_address.len()) > MAX_WORD_BYTES {
        return Err(refuse("version, metrics_address", &"more than 256 bytes"));
    }
    if !is_address(&hello.metrics_address) {
        return Err(refuse("metrics_address", &"it is no HOST:PORT"));
    }
    Ok(MonitorHello {
        layer: hello.layer.parse().map_err(|error| refuse("layer", &error))?,
        node: hello.node.parse().map_err(|error| refuse("node", &error))?,
        version: hello.version,
        epoch: hello.epoch,
        metrics_address: hello.metrics_address,
    })
}

/// Empty, an address with port, or the name of a host with port.
fn is_address(text: &str) -> bool {
    let is_named = || {
        let (host, port) = text.rsplit_once(':')?;
        let fits = |byte: u8| byte.is_ascii_alphanumeric() || b"-.".contains(&byte);
        let is_port = port.parse::<u16>().is_ok_and(|port| port > 0);
        Some(!host.is_empty() && host.bytes().all(fits) && is_port)
    };
    text.is_empty() || text.parse::<SocketAddr>().is_ok() || is_named().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_of_metrics_are_host_and_port() {
        for good in ["", "10.0.1.7:9103", "[fd00::7]:9103", "robot-1.lab.example:9103"] {
            assert!(is_address(good), "{good}");
        }
        for bad in ["robot-1", "robot-1:", "robot-1:0", "a b:1", "http://x:1/", ":9103", "x:99999"]
        {
            assert!(!is_address(bad), "{bad}");
        }
    }
}
