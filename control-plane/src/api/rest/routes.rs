//! Every operation under `/api/v1`, as a table.
//!
//! ```text
//! all() ─┬─▶ router     axum routes: the table's handler is `operation::run`
//!        └─▶ openapi    paths, parameters, bodies and answers of the document
//! ```
//!
//! Router and document come from the same rows, so that neither has an operation that the other
//! lacks.

use std::sync::Arc;

use axum::Router;
use axum::extract::Request;
use axum::routing::{MethodFilter, on};
use blaze_domain::config::Kind;

use super::query::Param;
use super::{Rest, operation};
use crate::auth::Right;

/// Method of a route. `HEAD` comes with `GET`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) enum Verb {
    Get,
    Put,
    Post,
    Delete,
    Patch,
}

impl Verb {
    /// As OpenAPI writes it.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Get => "get",
            Self::Put => "put",
            Self::Post => "post",
            Self::Delete => "delete",
            Self::Patch => "patch",
        }
    }

    fn filter(self) -> MethodFilter {
        match self {
            Self::Get => MethodFilter::GET,
            Self::Post => MethodFilter::POST,
            Self::Put => MethodFilter::PUT,
            Self::Patch => MethodFilter::PATCH,
            Self::Delete => MethodFilter::DELETE,
        }
    }

    /// Whether it may change something.
    pub(super) fn writes(self) -> bool {
        self != Self::Get
    }
}

/// What a route does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Action {
    List(Kind),
    Create(Kind),
    Get(Kind),
    Replace(Kind),
    Patch(Kind),
    Delete(Kind),
    History(Kind),
    Diff(Kind),
    Rollback(Kind),
    Promote,
    Abort,
    Apply,
    Revert,
    Effective,
    Watch,
    Topology,
    Live,
    Why,
    Problems,
    Topics,
    Series,
    Targets,
    Workers,
    Digest,
    Audit,
    Tokens,
    CreateToken,
    RevokeToken,
    Trim,
}

impl Action {
    /// The word in the audit, for what is refused.
    pub(super) fn audit_word(self) -> &'static str {
        match self {
            Self::List(_) => "list",
            Self::Create(_) => "create",
            Self::Get(_) => "get",
            Self::Replace(_) => "update",
            Self::Patch(_) => "patch",
            Self::Delete(_) => "delete",
            Self::History(_) => "history",
            Self::Diff(_) => "diff",
            Self::Rollback(_) => "rollback",
            Self::Promote => "rollout_promote",
            Self::Abort => "rollout_abort",
            Self::Apply => "apply",
            Self::Revert => "revert",
            Self::Effective => "effective",
            Self::Watch => "watch",
            Self::Topology => "topology",
            Self::Live => "live",
            Self::Why => "why",
            Self::Problems => "problems",
            Self::Topics => "topics",
            Self::Series => "series",
            Self::Targets => "targets",
            Self::Workers => "workers",
            Self::Digest => "digest",
            Self::Audit => "audit",
            Self::Tokens => "tokens",
            Self::CreateToken => "token_create",
            Self::RevokeToken => "token_revoke",
            Self::Trim => "trim",
        }
    }

    /// The kind of document whose path it is.
    pub(super) fn kind(self) -> Option<Kind> {
        match self {
            Self::List(kind)
            | Self::Create(kind)
            | Self::Get(kind)
            | Self::Replace(kind)
            | Self::Patch(kind)
            | Self::Delete(kind)
            | Self::History(kind)
            | Self::Diff(kind)
            | Self::Rollback(kind) => Some(kind),
            Self::Promote | Self::Abort => Some(Kind::Rollout),
            Self::Apply
            | Self::Revert
            | Self::Effective
            | Self::Watch
            | Self::Topology
            | Self::Live
            | Self::Why
            | Self::Problems
            | Self::Topics
            | Self::Series
            | Self::Targets
            | Self::Workers
            | Self::Digest
            | Self::Audit
            | Self::Tokens
            | Self::CreateToken
            | Self::RevokeToken
            | Self::Trim => None,
        }
    }
}

/// What the body of a request is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Payload {
    /// None; one that comes is not read.
    None,
    /// One document.
    Document(Kind),
    /// A merge patch of labels, annotations and spec.
    MergePatch,
    /// Many documents.
    Documents,
    /// `{"revision"}`.
    Rollback,
    /// `{"revision","force"}`.
    Revert,
    /// `{"before"}`.
    Trim,
    /// A request for a token.
    Token,
    /// `{"reason"}`.
    Abort,
}

/// One operation.
#[derive(Debug)]
pub(super) struct Route {
    pub(super) verb: Verb,
    /// As axum and OpenAPI write it.
    pub(super) path: &'static str,
    /// `operationId`.
    pub(super) operation: &'static str,
    pub(super) action: Action,
    /// What the token must allow.
    pub(super) right: Right,
    pub(super) query: &'static [Param],
    pub(super) payload: Payload,
    /// Statuses beyond those that every operation has ([`openapi`] adds them).
    pub(super) statuses: &'static [u16],
}

const LIST: &[Param] = &[
    Param::Limit,
    Param::PageToken,
    Param::LabelSelector,
    Param::Layer,
    Param::Node,
    Param::Reveal,
    Param::MinRevision,
    Param::Consistency,
];
const GET: &[Param] = &[Param::Revision, Param::Reveal, Param::MinRevision, Param::Consistency];
const HISTORY: &[Param] =
    &[Param::Limit, Param::PageToken, Param::View, Param::MinRevision, Param::Consistency];
const DIFF: &[Param] = &[Param::From, Param::To, Param::MinRevision, Param::Consistency];
const EFFECTIVE: &[Param] = &[
    Param::Service,
    Param::Instance,
    Param::AtNode,
    Param::AtLayer,
    Param::Explain,
    Param::Reveal,
    Param::MinRevision,
    Param::Consistency,
];
const WATCH: &[Param] = &[
    Param::Since,
    Param::Kind,
    Param::Name,
    Param::Service,
    Param::Layer,
    Param::LabelSelector,
    Param::TimeoutS,
    Param::MinRevision,
    Param::Consistency,
];
const READ: &[Param] = &[Param::MinRevision, Param::Consistency];
const LIVE: &[Param] = &[
    Param::LiveView,
    Param::LiveNode,
    Param::LiveTopic,
    Param::Layer,
    Param::LabelSelector,
    Param::PeriodMs,
    Param::TimeoutS,
    Param::MinRevision,
    Param::Consistency,
];
const WHY: &[Param] =
    &[Param::WhyTopic, Param::WhyTo, Param::WhyFrom, Param::MinRevision, Param::Consistency];
const PROBLEMS: &[Param] =
    &[Param::Layer, Param::HealthState, Param::MinRevision, Param::Consistency];
const TOPICS: &[Param] =
    &[Param::Prefix, Param::Limit, Param::PageToken, Param::MinRevision, Param::Consistency];
const SERIES: &[Param] = &[Param::SeriesNode, Param::Names, Param::MinRevision, Param::Consistency];
const DIGEST: &[Param] = &[Param::DigestLayer, Param::MinRevision, Param::Consistency];
const AUDIT: &[Param] = &[
    Param::Subject,
    Param::Kind,
    Param::AuditName,
    Param::Action,
    Param::Outcome,
    Param::SinceTime,
    Param::UntilTime,
    Param::Limit,
    Param::PageToken,
    Param::MinRevision,
    Param::Consistency,
];

/// One row; what is left out is as in most rows.
macro_rules! row {
    ($verb:ident $path:expr, $operation:expr, $action:expr, $right:ident, $query:expr,
        $payload:expr, $statuses:expr $(,)?) => {
        Route {
            verb: Verb::$verb,
            path: $path,
            operation: $operation,
            action: $action,
            right: Right::$right,
            query: $query,
            payload: $payload,
            statuses: $statuses,
        }
    };
}

/// The nine rows that all collections share.
macro_rules! collection {
    ($kind:ident, $word:literal, $plural:literal, $path:literal) => {
        [
            row!(
                Get $path,
                concat!("list_", $plural),
                Action::List(Kind::$kind),
                Read,
                LIST,
                Payload::None,
                &[200, 410],
            ),
            row!(Post $path, concat!("create_", $word), Action::Create(Kind::$kind), Write, &[],
                Payload::Document(Kind::$kind), &[201, 409, 413, 415, 422]),
            row!(Get concat!($path, "/{name}"), concat!("get_", $word), Action::Get(Kind::$kind),
                Read, GET,
                Payload::None, &[200, 304, 410]),
            row!(Put concat!($path, "/{name}"), concat!("replace_", $word),
                Action::Replace(Kind::$kind), Write, &[],
                Payload::Document(Kind::$kind), &[200, 201, 409, 412, 413, 415, 422, 428]),
            row!(Patch concat!($path, "/{name}"), concat!("patch_", $word),
                Action::Patch(Kind::$kind), Write, &[],
                Payload::MergePatch, &[200, 409, 412, 413, 415, 422, 428]),
            row!(Delete concat!($path, "/{name}"), concat!("delete_", $word),
                Action::Delete(Kind::$kind), Write,
                &[Param::Cascade], Payload::None, &[204, 409, 412, 422, 428]),
            row!(Get concat!($path, "/{name}/history"), concat!("list_", $word, "_history"),
                Action::History(Kind::$kind),
                Read, HISTORY, Payload::None, &[200, 410]),
            row!(Get concat!($path, "/{name}/diff"), concat!("diff_", $word),
                Action::Diff(Kind::$kind), Read, DIFF,
                Payload::None, &[200, 410]),
            row!(Post concat!($path, "/{name}/rollback"), concat!("rollback_", $word),
                Action::Rollback(Kind::$kind),
                Write, &[], Payload::Rollback, &[200, 409, 410, 412, 413, 415, 422]),
        ]
    };
}

static LAYERS: [Route; 9] = collection!(Layer, "layer", "layers", "/api/v1/layers");
static NODES: [Route; 9] = collection!(Node, "node", "nodes", "/api/v1/nodes");
static SERVICES: [Route; 9] = collection!(Service, "service", "services", "/api/v1/services");
static INSTANCES: [Route; 9] =
    collection!(Instance, "instance", "instances", "/api/v1/services/{service}/instances");
static ROLLOUTS: [Route; 9] = collection!(Rollout, "rollout", "rollouts", "/api/v1/rollouts");

static OTHERS: [Route; 20] = [
    row!(
        Post "/api/v1/rollouts/{name}/promote",
        "promote_rollout",
        Action::Promote,
        Write,
        &[],
        Payload::None,
        &[200, 409, 422],
    ),
    row!(Post "/api/v1/rollouts/{name}/abort", "abort_rollout", Action::Abort, Write, &[],
        Payload::Abort,
        &[200, 409, 413, 415, 422]),
    row!(Post "/api/v1/apply", "apply", Action::Apply, Write,
        &[Param::DryRun, Param::Prune, Param::PruneConfirm],
        Payload::Documents, &[200, 404, 409, 413, 415, 422]),
    row!(Post "/api/v1/revert", "revert", Action::Revert, Write, &[], Payload::Revert,
        &[200, 404, 409, 410, 413, 415, 422]),
    row!(
        Get "/api/v1/effective",
        "get_effective",
        Action::Effective,
        Read,
        EFFECTIVE,
        Payload::None,
        &[200, 404, 410],
    ),
    row!(Get "/api/v1/watch", "watch", Action::Watch, Read, WATCH, Payload::None, &[200, 410]),
    row!(
        Get "/api/v1/topology",
        "get_topology",
        Action::Topology,
        Read,
        READ,
        Payload::None,
        &[200, 410],
    ),
    row!(Get "/api/v1/live", "live", Action::Live, Read, LIVE, Payload::None, &[200, 404, 410]),
    row!(Get "/api/v1/why", "why", Action::Why, Read, WHY, Payload::None, &[200, 404, 410]),
    row!(
        Get "/api/v1/problems",
        "list_problems",
        Action::Problems,
        Read,
        PROBLEMS,
        Payload::None,
        &[200, 410],
    ),
    row!(
        Get "/api/v1/topics",
        "list_topics",
        Action::Topics,
        Read,
        TOPICS,
        Payload::None,
        &[200, 410],
    ),
    row!(
        Get "/api/v1/series",
        "get_series",
        Action::Series,
        Read,
        SERIES,
        Payload::None,
        &[200, 404, 410],
    ),
    row!(
        Get "/api/v1/targets",
        "list_targets",
        Action::Targets,
        Read,
        READ,
        Payload::None,
        &[200, 410],
    ),
    row!(
        Get "/api/v1/workers",
        "list_workers",
        Action::Workers,
        Read,
        READ,
        Payload::None,
        &[200, 410],
    ),
    row!(
        Get "/api/v1/digest",
        "get_digest",
        Action::Digest,
        Read,
        DIGEST,
        Payload::None,
        &[200, 404, 410],
    ),
    row!(
        Get "/api/v1/audit",
        "list_audit",
        Action::Audit,
        Admin,
        AUDIT,
        Payload::None,
        &[200, 410],
    ),
    row!(
        Get "/api/v1/tokens",
        "list_tokens",
        Action::Tokens,
        Admin,
        READ,
        Payload::None,
        &[200, 410],
    ),
    row!(Post "/api/v1/tokens", "create_token", Action::CreateToken, Admin, &[], Payload::Token,
        &[201, 409, 413, 415, 422]),
    row!(
        Delete "/api/v1/tokens/{id}",
        "revoke_token",
        Action::RevokeToken,
        Admin,
        &[],
        Payload::None,
        &[204],
    ),
    row!(
        Post "/api/v1/trim",
        "trim",
        Action::Trim,
        Admin,
        &[],
        Payload::Trim,
        &[200, 409, 413, 415, 422],
    ),
];

/// All rows.
pub(super) fn all() -> impl Iterator<Item = &'static Route> {
    [&LAYERS, &NODES, &SERVICES, &INSTANCES, &ROLLOUTS]
        .into_iter()
        .flat_map(|rows| rows.iter())
        .chain(&OTHERS)
}

/// The routes of all rows.
pub(super) fn router(rest: &Arc<Rest>) -> Router {
    all().fold(Router::new(), |router, route| {
        let rest = Arc::clone(rest);
        let handler = move |request: Request| {
            let rest = Arc::clone(&rest);
            async move { operation::run(&rest, route, request).await }
        };
        router.route(route.path, on(route.verb.filter(), handler))
    })
}

/// The methods of a path, as `Allow` has them; `path` as axum knows it.
pub(super) fn allow(path: &str) -> String {
    let mut methods: Vec<&str> = Vec::new();
    for route in all().filter(|route| route.path == path) {
        methods.push(match route.verb {
            Verb::Get => "GET, HEAD",
            Verb::Post => "POST",
            Verb::Put => "PUT",
            Verb::Patch => "PATCH",
            Verb::Delete => "DELETE",
        });
    }
    methods.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_path_and_method_comes_once() {
        let mut pairs: Vec<(&str, Verb)> = all().map(|route| (route.path, route.verb)).collect();
        let count = pairs.len();
        pairs.sort_unstable();
        pairs.dedup();
        assert_eq!(pairs.len(), count);
        assert_eq!(count, 65);
    }

    #[test]
    fn rights_follow_the_method() {
        for route in all() {
            let needs_admin =
                ["audit", "token", "trim"].iter().any(|word| route.operation.contains(word));
            let expected = match (needs_admin, route.verb.writes()) {
                (true, _) => Right::Admin,
                (false, true) => Right::Write,
                (false, false) => Right::Read,
            };
            assert_eq!(route.right, expected, "{}", route.operation);
        }
    }

    #[test]
    fn allow_names_every_method_of_a_path() {
        assert_eq!(allow("/api/v1/nodes"), "GET, HEAD, POST");
        assert_eq!(allow("/api/v1/nodes/{name}"), "GET, HEAD, PUT, PATCH, DELETE");
        assert_eq!(allow("/api/v1/watch"), "GET, HEAD");
    }
}
