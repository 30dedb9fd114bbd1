//! One operation: what is checked before the core is asked, in the order of the contract, and how
//! it is answered.

use std::sync::Arc;

use axum::extract::Request;
use axum::http::{HeaderMap, HeaderName};
use axum::response::Response;
use blaze_domain::config::{Applied, Code, Key, Kind, Problem};
use blaze_domain::{DocumentName, ServiceName};
use bytes::Bytes;
use serde::de::DeserializeOwned;
use serde_json::Value;
use sha2::{Digest, Sha256};
use tokio::time::timeout_at;

use super::body::{self, Media};
use super::frame::{Visit, note};
use super::gate::{Known, unknown};
use super::query::Query;
use super::routes::{Action, Route, Verb};
use super::{
    Rest, documents, effective, headers, history, live, many, monitoring, negotiate, reply,
    requests, system, tokens, watch,
};
use crate::auth::Right;
use crate::core::{Caller, ConfigService, Idempotency, ReadOptions};

const ACCEPT_PATCH: HeaderName = HeaderName::from_static("accept-patch");
/// Longest id of a token in a path, in characters.
const MAX_TOKEN_ID: usize = 128;

/// The names that stand in a path.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct Names {
    /// `{service}`; `None` also for `-`, which is all services.
    pub(super) service: Option<ServiceName>,
    /// `{name}`.
    pub(super) name: Option<DocumentName>,
    /// `{id}` of a token.
    pub(super) id: Option<String>,
}

impl Names {
    /// Takes the names out of a path that matches the route; `None` if one breaks its rules, so
    /// that nothing can be there.
    fn of(route: &Route, path: &str) -> Option<Self> {
        let mut names = Self::default();
        for (pattern, segment) in route.path.split('/').zip(path.split('/')) {
            match pattern {
                "{service}" if segment == "-" && matches!(route.action, Action::List(_)) => {}
                "{service}" => names.service = Some(segment.parse().ok()?),
                "{name}" => names.name = Some(segment.parse().ok()?),
                "{id}" => names.id = Some(token_id(segment)?),
                _ => {}
            }
        }
        Some(names)
    }

    fn key(&self, kind: Kind) -> Option<Key> {
        Key::new(kind, self.service.clone(), self.name.clone()?).ok()
    }
}

fn token_id(segment: &str) -> Option<String> {
    let fits = segment.len() <= MAX_TOKEN_ID
        && segment.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"._~-".contains(&byte))
        && segment.starts_with(|first: char| first.is_ascii_alphanumeric());
    fits.then(|| segment.to_owned())
}

/// A request that was let through, with everything that was read of it.
pub(super) struct Call {
    rest: Arc<Rest>,
    pub(super) visit: Visit,
    pub(super) caller: Caller,
    pub(super) names: Names,
    pub(super) query: Query,
    pub(super) headers: HeaderMap,
    body: Option<(Media, Bytes)>,
    /// The query as it came: another one is another request.
    query_text: String,
}

impl Call {
    pub(super) fn service(&self) -> &ConfigService {
        &self.rest.service
    }

    pub(super) fn rest(&self) -> &Rest {
        &self.rest
    }

    /// The document that the path names.
    pub(super) fn key(&self, kind: Kind) -> Result<Key, Problem> {
        self.names
            .key(kind)
            .ok_or_else(|| Problem::new(Code::NotFound, "the path names no document"))
    }

    /// How a read is to be answered. Secrets as text need a right of their own.
    pub(super) fn read_options(&self) -> Result<ReadOptions, Problem> {
        let options = self.query.read_options()?;
        if options.reveal {
            self.rest.service.authorize(&self.caller.claims, Right::Admin)?;
        }
        Ok(options)
    }

    /// Type and bytes of the body.
    pub(super) fn body(&self) -> (Media, &Bytes) {
        static NONE: Bytes = Bytes::new();
        match &self.body {
            Some((media, bytes)) => (*media, bytes),
            None => (Media::Json, &NONE),
        }
    }

    /// A small body.
    pub(super) fn read<T: DeserializeOwned>(&self) -> Result<T, Problem> {
        requests::read(&self.json()?)
    }

    /// The body as strict JSON.
    pub(super) fn json(&self) -> Result<Value, Problem> {
        body::json(self.body().1)
    }

    /// The key of a request that may come twice, with what makes it the same request.
    pub(super) fn idempotency(&self) -> Result<Option<Idempotency>, Problem> {
        let Some(key) = headers::idempotency_key(&self.headers)? else {
            return Ok(None);
        };
        let (media, bytes) = self.body();
        let mut hash = Sha256::new();
        for part in [self.query_text.as_bytes(), media.as_str().as_bytes(), bytes] {
            hash.update((part.len() as u64).to_be_bytes());
            hash.update(part);
        }
        Ok(Some(Idempotency {
            key,
            path: self.visit.path.to_string(),
            body: hash.finalize().into(),
        }))
    }
}

/// Answers a request whose path and method are those of a route.
pub(super) async fn run(rest: &Arc<Rest>, route: &'static Route, request: Request) -> Response {
    let extensions = request.extensions();
    let (Some(visit), Some(Known(claims))) =
        (extensions.get::<Visit>().cloned(), extensions.get::<Known>().cloned())
    else {
        // The gate sets both: without them nobody may come in.
        return reply::problem(
            &Problem::new(Code::Internal, "the request came past the gate"),
            request.uri().path(),
            "",
        );
    };
    let Some(names) = Names::of(route, &visit.path) else {
        return unknown(request).await;
    };
    let caller =
        Caller { claims, request_id: visit.request_id.to_string(), address: visit.address };
    let answer = answer(rest, route, &visit, &names, &caller, request).await;
    let mut response = answer.unwrap_or_else(|problem| {
        if matches!(problem.code, Code::PermissionDenied | Code::Unauthenticated) {
            let key = route.action.kind().and_then(|kind| names.key(kind));
            let (id, address) = (&caller.request_id, caller.address);
            rest.service.denied(
                Some(&caller.claims),
                &problem,
                route.action.audit_word(),
                key.as_ref(),
                id,
                address,
            );
        }
        let mut response = reply::problem(&problem, &visit.path, &visit.request_id);
        if problem.code == Code::UnsupportedMediaType && route.verb == Verb::Patch {
            let taken: Vec<&str> =
                route.payload.media().iter().map(|media| media.as_str()).collect();
            reply::set(&mut response, ACCEPT_PATCH, &taken.join(", "));
        }
        response
    });
    note(&mut response, |served| served.operation = Some(route.operation));
    response
}

async fn answer(
    rest: &Arc<Rest>,
    route: &'static Route,
    visit: &Visit,
    names: &Names,
    caller: &Caller,
    request: Request,
) -> Result<Response, Problem> {
    negotiate::check(request.headers(), route.action)?;
    rest.service.authorize(&caller.claims, route.right)?;
    let (parts, body) = request.into_parts();
    let body = rest.options.limits.metered(body);
    let read = body::read(route.payload, &parts.headers, body);
    let body = timeout_at(visit.deadline, read).await.map_err(|_| too_late(false))??;
    let call = Call {
        query: Query::parse(route.query, parts.uri.query())?,
        query_text: parts.uri.query().unwrap_or_default().to_owned(),
        rest: Arc::clone(rest),
        visit: visit.clone(),
        caller: caller.clone(),
        names: names.clone(),
        headers: parts.headers,
        body,
    };
    // Held until the answer begins; what streams has a limit of its own.
    let _place = rest.options.limits.enter()?;
    match timeout_at(visit.deadline, perform(&call, route.action)).await {
        Ok(answer) => answer,
        // The core goes on with a write whose caller has left.
        Err(_) => Err(too_late(route.verb.writes())),
    }
}

fn too_late(writes: bool) -> Problem {
    let problem = Problem::new(Code::DeadlineExceeded, "there was no answer within 30 s");
    if writes { problem.applied(Applied::Unknown) } else { problem }
}

async fn perform(call: &Call, action: Action) -> Result<Response, Problem> {
    match action {
        Action::List(kind) => documents::list(call, kind).await,
        Action::Create(kind) => documents::create(call, kind).await,
        Action::Get(kind) => documents::get(call, kind).await,
        Action::Replace(kind) => documents::replace(call, kind).await,
        Action::Patch(kind) => documents::patch(call, kind).await,
        Action::Delete(kind) => documents::delete(call, kind).await,
        Action::History(kind) => history::list(call, kind).await,
        Action::Diff(kind) => history::diff(call, kind).await,
        Action::Rollback(kind) => history::rollback(call, kind).await,
        Action::Promote => documents::promote(call).await,
        Action::Abort => documents::abort(call).await,
        Action::Apply => many::apply(call).await,
        Action::Revert => many::revert(call).await,
        Action::Effective => effective::get(call).await,
        Action::Watch => watch::open(call).await,
        Action::Topology => system::topology(call).await,
        Action::Live => live::open(call).await,
        Action::Why => monitoring::why(call).await,
        Action::Problems => monitoring::problems(call).await,
        Action::Topics => monitoring::topics(call).await,
        Action::Series => monitoring::series(call).await,
        Action::Targets => monitoring::targets(call).await,
        Action::Workers => system::workers(call).await,
        Action::Digest => system::digest(call).await,
        Action::Audit => system::audit(call).await,
        Action::Trim => system::trim(call).await,
        Action::Tokens => tokens::list(call).await,
        Action::CreateToken => tokens::create(call).await,
        Action::RevokeToken => tokens::revoke(call).await,
    }
}

#[cfg(test)]
mod tests {
    use super::super::routes;
    use super::*;

    fn names(operation: &str, path: &str) -> Option<Names> {
        let route = routes::all().find(|route| route.operation == operation).unwrap();
        Names::of(route, path)
    }

    #[test]
    fn a_path_names_a_document() {
        let found = names("get_instance", "/api/v1/services/slam/instances/0").unwrap();
        assert_eq!(found.key(Kind::Instance).unwrap().to_string(), "Instance/slam/0");
        let found = names("list_instances", "/api/v1/services/-/instances").unwrap();
        assert_eq!(found, Names::default());
        assert_eq!(names("get_instance", "/api/v1/services/-/instances/0"), None);
        assert_eq!(names("create_instance", "/api/v1/services/-/instances"), None);
        for bad in ["Robot", "robot%2d1", ".", "-a", &"a".repeat(64)] {
            assert_eq!(names("get_node", &format!("/api/v1/nodes/{bad}")), None, "{bad}");
        }
    }

    #[test]
    fn ids_of_tokens_need_no_encoding() {
        let id = "0197c1d2-7f3a-7b64-9c1e-2f6f0a4e8d11";
        assert_eq!(
            names("revoke_token", &format!("/api/v1/tokens/{id}")).unwrap().id.as_deref(),
            Some(id)
        );
        for bad in ["..", "a%20b", "", &"a".repeat(129)] {
            assert_eq!(names("revoke_token", &format!("/api/v1/tokens/{bad}")), None, "{bad}");
        }
    }

    #[test]
    fn a_late_write_may_have_taken_effect() {
        assert_eq!(too_late(true).applied, Applied::Unknown);
        assert_eq!(too_late(false).applied, Applied::No);
    }
}
