//! What is looked at before an operation: sizes, where the path leads, and who asks.

use std::sync::Arc;

use axum::Router;
use axum::extract::{MatchedPath, Request};
use axum::http::header::HOST;
use axum::http::{HeaderMap, Uri, Version};
use axum::response::Response;
use blaze_domain::config::{Code, Problem};
use tower::ServiceExt;

use super::frame::{Visit, challenge, note};
use super::headers::BLAZE_REVISION;
use super::{MAX_HEADER_BYTES, MAX_URI_BYTES, Rest, frame, reply, routes};
use crate::api::request::{bearer, check_dev};
use crate::auth::Claims;

/// Who asks; set on requests that are let through to an operation.
#[derive(Debug, Clone)]
pub(super) struct Known(pub(super) Arc<Claims>);

/// Lets a request through to where its path leads, or refuses it.
pub(super) async fn pass(
    rest: &Rest,
    api: Router,
    pages: Router,
    visit: &Visit,
    request: Request,
) -> Response {
    let refuse = |problem: &Problem| reply::problem(problem, &visit.path, &visit.request_id);
    if let Err(problem) = sizes(&request).and_then(|()| one_host(&request)) {
        return refuse(&problem);
    }
    if rest.options.dev
        && let Err(problem) = check_dev(request.uri(), request.headers())
    {
        rest.service.denied(None, &problem, "request", None, &visit.request_id, visit.address);
        return refuse(&problem);
    }
    if !visit.path.starts_with("/api/") {
        return route(pages, request).await;
    }
    let limits = &rest.options.limits;
    if let Err(problem) = limits.check_address(visit.address) {
        return refuse(&problem);
    }
    let token = bearer(request.headers());
    let claims = match rest.service.authenticate(token, visit.address) {
        Ok(claims) => claims,
        Err(problem) => {
            let mut response = refuse(&problem);
            if problem.code == Code::Unauthenticated {
                challenge(&mut response, token.is_some());
                if token.is_some() {
                    limits.count_refused_token(visit.address);
                }
                rest.service.denied(
                    None,
                    &problem,
                    "authenticate",
                    None,
                    &visit.request_id,
                    visit.address,
                );
            }
            return response;
        }
    };
    let mut response =
        within_limits(rest, api, &claims, request).await.unwrap_or_else(|problem| refuse(&problem));
    if !response.headers().contains_key(BLAZE_REVISION) {
        reply::set(&mut response, BLAZE_REVISION, &rest.service.revision().to_string());
    }
    note(&mut response, |served| served.subject = Some(claims.subject.clone()));
    response
}

async fn within_limits(
    rest: &Rest,
    api: Router,
    claims: &Arc<Claims>,
    mut request: Request,
) -> Result<Response, Problem> {
    rest.options.limits.count_request(&claims.subject)?;
    request.extensions_mut().insert(Known(Arc::clone(claims)));
    Ok(route(api, request).await)
}

async fn route(router: Router, request: Request) -> Response {
    match router.oneshot(request).await {
        Ok(response) => response,
        Err(never) => match never {},
    }
}

/// 431, then 414.
fn sizes(request: &Request) -> Result<(), Problem> {
    let bytes = header_bytes(request.headers());
    if bytes > MAX_HEADER_BYTES {
        let detail =
            format!("the headers have {bytes} bytes, at most {MAX_HEADER_BYTES} are allowed");
        return Err(Problem::new(Code::HeadersTooLarge, detail));
    }
    let uri = request.uri().path_and_query().map_or(0, |path| path.as_str().len());
    if uri > MAX_URI_BYTES {
        let detail =
            format!("path and query have {uri} bytes, at most {MAX_URI_BYTES} are allowed");
        return Err(Problem::new(Code::UriTooLong, detail));
    }
    Ok(())
}

/// Two parties between client and service must not take different hosts for the one that is meant
/// (RFC 9112, 3.2).
fn one_host(request: &Request) -> Result<(), Problem> {
    let hosts = request.headers().get_all(HOST).iter().count();
    // HTTP/2 has it in `:authority`, HTTP/1.0 knows none.
    if hosts > 1 || (hosts == 0 && request.version() == Version::HTTP_11) {
        let detail = format!("the request has {hosts} Host headers; it needs one");
        return Err(Problem::new(Code::InvalidHeader, detail));
    }
    Ok(())
}

/// Bytes of the headers as they stand in a request of HTTP/1.1: name, colon, blank, value, line
/// end.
fn header_bytes(headers: &HeaderMap) -> usize {
    headers.iter().map(|(name, value)| name.as_str().len() + value.len() + 4).sum()
}

/// A path that no route has.
pub(super) async fn unknown(request: Request) -> Response {
    let Some(visit) = request.extensions().get::<Visit>() else {
        return reply::problem(
            &Problem::new(Code::NotFound, "there is nothing here"),
            request.uri().path(),
            "",
        );
    };
    let problem = Problem::new(Code::NotFound, where_to_look(request.uri()));
    reply::problem(&problem, &visit.path, &visit.request_id)
}

fn where_to_look(uri: &Uri) -> String {
    let path = uri.path();
    let hint = if path.len() > 1 && path.ends_with('/') {
        "; paths have no slash at the end"
    } else if path.contains("//") {
        "; paths have no double slash"
    } else if path.contains('%') {
        "; no path of the service needs percent-encoding"
    } else if path.bytes().any(|byte| byte.is_ascii_uppercase()) {
        "; all paths are lower case"
    } else {
        "; /docs lists all paths"
    };
    format!("there is nothing at this path{hint}")
}

/// A path that does not take the method.
pub(super) async fn wrong_method(request: Request) -> Response {
    let path =
        request.extensions().get::<MatchedPath>().map(MatchedPath::as_str).unwrap_or_default();
    let methods = routes::allow(path);
    let problem = Problem::new(
        Code::MethodNotAllowed,
        format!("{} is not for this path; {methods} are", request.method()),
    );
    let (path, id) = match request.extensions().get::<Visit>() {
        Some(visit) => (&*visit.path, &*visit.request_id),
        None => (request.uri().path(), ""),
    };
    let mut response = reply::problem(&problem, path, id);
    frame::allow(&mut response, &methods);
    response
}

#[cfg(test)]
mod tests {
    use axum::body::Body;

    use super::*;

    fn sized(uri: &str, header: usize) -> Option<Code> {
        let request = Request::builder()
            .uri(uri)
            .header("x", "y".repeat(header))
            .body(Body::empty())
            .unwrap();
        sizes(&request).err().map(|problem| problem.code)
    }

    #[test]
    fn headers_are_measured_before_the_path() {
        assert_eq!(sized("/api/v1/nodes", 100), None);
        assert_eq!(sized(&format!("/{}", "a".repeat(MAX_URI_BYTES)), 1), Some(Code::UriTooLong));
        assert_eq!(sized(&format!("/{}", "a".repeat(MAX_URI_BYTES - 1)), 1), None);
        let too_many = MAX_HEADER_BYTES - 4;
        assert_eq!(sized("/", too_many), Some(Code::HeadersTooLarge));
        assert_eq!(sized("/", too_many - 1), None);
        assert_eq!(
            sized(&format!("/{}", "a".repeat(MAX_URI_BYTES)), too_many),
            Some(Code::HeadersTooLarge)
        );
    }

    #[test]
    fn a_request_has_one_host() {
        let code = |version, hosts: &[&str]| {
            let mut request = Request::builder().version(version);
            for host in hosts {
                request = request.header(HOST, *host);
            }
            let request = request.body(Body::empty()).unwrap();
            one_host(&request).err().map(|problem| problem.code)
        };
        assert_eq!(code(Version::HTTP_11, &["a"]), None);
        assert_eq!(code(Version::HTTP_11, &[]), Some(Code::InvalidHeader));
        assert_eq!(code(Version::HTTP_11, &["a", "a"]), Some(Code::InvalidHeader));
        assert_eq!(code(Version::HTTP_10, &[]), None);
        assert_eq!(code(Version::HTTP_10, &["a", "b"]), Some(Code::InvalidHeader));
        assert_eq!(code(Version::HTTP_2, &[]), None);
        assert_eq!(code(Version::HTTP_2, &["a", "b"]), Some(Code::InvalidHeader));
    }

    #[test]
    fn an_unknown_path_says_what_may_be_wrong() {
        let hint = |path: &str| where_to_look(&path.parse().unwrap());
        assert!(hint("/api/v1/nodes/").contains("slash at the end"));
        assert!(hint("/api/v1//nodes").contains("double slash"));
        assert!(hint("/api/v1/nodes/%72").contains("percent-encoding"));
        assert!(hint("/api/v1/Nodes").contains("lower case"));
        assert!(hint("/api/v1/node").contains("/docs"));
    }
}
