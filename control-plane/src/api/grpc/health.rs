//! `grpc.health.v1.Health`: whether the service does its work, as `/readyz` says it. Without a
//! token.

use std::future::ready;
use std::pin::Pin;

use blaze_runtime::Readiness;
use futures::{Stream, StreamExt as _, stream};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status};
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_server::Health;
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};

/// Names that can be asked for; the empty one is the whole process.
const SERVICES: [&str; 3] = ["", "blaze.v1.ConfigService", "blaze.v1.SyncService"];

/// Follows the readiness of the process.
pub(super) struct Readyz {
    pub(super) readiness: Readiness,
    /// Cancelled when streams shall end.
    pub(super) stopping: CancellationToken,
}

fn answer(status: ServingStatus) -> HealthCheckResponse {
    HealthCheckResponse { status: status.into() }
}

fn serving(is_ready: bool) -> ServingStatus {
    if is_ready { ServingStatus::Serving } else { ServingStatus::NotServing }
}

fn is_known(request: &Request<HealthCheckRequest>) -> bool {
    SERVICES.contains(&request.get_ref().service.as_str())
}

#[tonic::async_trait]
impl Health for Readyz {
    async fn check(
        &self,
        request: Request<HealthCheckRequest>,
    ) -> Result<Response<HealthCheckResponse>, Status> {
        if !is_known(&request) {
            return Err(Status::not_found("there is no service of that name here"));
        }
        Ok(Response::new(answer(serving(self.readiness.is_ready()))))
    }

    type WatchStream = Pin<Box<dyn Stream<Item = Result<HealthCheckResponse, Status>> + Send>>;

    async fn watch(
        &self,
        request: Request<HealthCheckRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let statuses = if is_known(&request) {
            changes(&self.readiness).map(serving).left_stream()
        } else {
            // As the protocol wants it: the service might come to be known.
            let unknown = stream::once(ready(ServingStatus::ServiceUnknown));
            unknown.chain(stream::pending()).right_stream()
        };
        let last = stream::once(ready(ServingStatus::NotServing));
        let all = statuses.take_until(self.stopping.clone().cancelled_owned()).chain(last);
        Ok(Response::new(Box::pin(all.map(|status| Ok(answer(status))))))
    }
}

/// Whether the process is ready, now and at every change.
fn changes(readiness: &Readiness) -> impl Stream<Item = bool> + Send + use<> {
    stream::unfold((readiness.changed(), None), |(mut changed, told)| async move {
        let is_ready = match told {
            None => *changed.borrow_and_update(),
            Some(told) => *changed.wait_for(|is_ready| *is_ready != told).await.ok()?,
        };
        Some((is_ready, (changed, Some(is_ready))))
    })
}

#[cfg(test)]
mod tests {
    use blaze_runtime::{CheckStatus, Gate};

    use super::*;

    fn health(readiness: &Readiness) -> Readyz {
        Readyz { readiness: readiness.clone(), stopping: CancellationToken::new() }
    }

    fn request(service: &str) -> Request<HealthCheckRequest> {
        Request::new(HealthCheckRequest { service: service.into() })
    }

    #[tokio::test]
    async fn health_is_what_readyz_says() {
        let readiness = Readiness::new();
        readiness.add("store", Gate::Decides, CheckStatus::Ok, "");
        let health = health(&readiness);
        for service in SERVICES {
            let status = health.check(request(service)).await.unwrap().into_inner().status();
            assert_eq!(status, ServingStatus::Serving);
        }
        readiness.set("store", CheckStatus::Failed, "gone");
        let status = health.check(request("")).await.unwrap().into_inner().status();
        assert_eq!(status, ServingStatus::NotServing);
        let refused = health.check(request("blaze.v1.Other")).await.unwrap_err();
        assert_eq!(refused.code(), tonic::Code::NotFound);
    }

    #[tokio::test]
    async fn a_watch_tells_each_change_once_and_ends_with_the_process() {
        let readiness = Readiness::new();
        readiness.add("store", Gate::Decides, CheckStatus::Ok, "");
        let health = health(&readiness);
        let mut stream = health.watch(request("")).await.unwrap().into_inner();
        assert_eq!(stream.next().await.unwrap().unwrap().status(), ServingStatus::Serving);
        readiness.set("store", CheckStatus::Ok, "other words");
        readiness.set("store", CheckStatus::Failed, "gone");
        assert_eq!(stream.next().await.unwrap().unwrap().status(), ServingStatus::NotServing);
        readiness.set("store", CheckStatus::Ok, "");
        assert_eq!(stream.next().await.unwrap().unwrap().status(), ServingStatus::Serving);

        let mut unknown = health.watch(request("blaze.v1.Other")).await.unwrap().into_inner();
        assert_eq!(unknown.next().await.unwrap().unwrap().status(), ServingStatus::ServiceUnknown);

        health.stopping.cancel();
        for stream in [&mut stream, &mut unknown] {
            assert_eq!(stream.next().await.unwrap().unwrap().status(), ServingStatus::NotServing);
            assert!(stream.next().await.is_none());
        }
    }
}
