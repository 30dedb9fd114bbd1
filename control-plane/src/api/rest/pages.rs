//! What is open to everybody: health, version, and the documentation, without anything from
//! elsewhere.

use std::borrow::Cow;
use std::future::ready;
use std::sync::Arc;

use axum::Router;
use axum::body::Body;
use axum::extract::Request;
use axum::http::StatusCode;
use axum::http::header::{CONTENT_SECURITY_POLICY, CONTENT_TYPE};
use axum::middleware::{self, Next};
use axum::response::Response;
use axum::routing::get;
use blaze_domain::config::{Code, Problem};
use bytes::Bytes;
use serde_json::{Value, json};
use utoipa_swagger_ui::Config;

use super::frame::{Served, Visit, allow, note};
use super::query::Query;
use super::{Rest, error_pages, gate, openapi, reply};

/// Pages with a look of their own, and nothing else.
const PAGE_POLICY: &str =
    "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; frame-ancestors 'none'";
/// The page that shows the OpenAPI document: its scripts, its styles, its pictures, and requests to
/// this service.
const UI_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; \
                         img-src 'self' data:; \
                         font-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action \
                         'none'; frame-ancestors 'none'";
const HTML: &str = "text/html; charset=utf-8";
const UI: &str = "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<title>BlazeConfig API</title>\n\
    <link rel=\"stylesheet\" href=\"/docs/ui/swagger-ui.css\">\n<link rel=\"icon\" type=\"image/png\" href=\"/docs/ui/favicon-32x32.png\">\n\
    </head>\n<body>\n<div id=\"swagger-ui\"></div>\n<script src=\"/docs/ui/swagger-ui-bundle.js\"></script>\n\
    <script src=\"/docs/ui/start.js\"></script>\n</body>\n</html>\n";
const START: &str = "window.ui = SwaggerUIBundle({\n  url: \"/openapi.json\",\n  dom_id: \"#swagger-ui\",\n  deepLinking: true,\n\
    \x20 validatorUrl: null,\n  presets: [SwaggerUIBundle.presets.apis],\n  layout: \"BaseLayout\"\n});\n";
/// Files of Swagger UI that the page needs.
const UI_FILES: &[&str] = &["swagger-ui.css", "swagger-ui-bundle.js", "favicon-32x32.png"];

/// All open routes.
pub(super) fn router(rest: &Arc<Rest>) -> Router {
    let newest = Bytes::from(openapi::openapi_json());
    let older = Bytes::from(openapi::openapi_3_0_json());
    let readiness = rest.options.readiness.clone();
    Router::new()
        .route(
            "/livez",
            get(|| ready(value(StatusCode::OK, "livez", &json!({ "status": "alive" })))),
        )
        .route("/readyz", get(move || ready(readyz(&readiness))))
        .route("/version", get(|| ready(value(StatusCode::OK, "version", &version()))))
        .route("/openapi.json", get(move || ready(bytes("openapi", reply::JSON, newest.clone()))))
        .route(
            "/openapi-3.0.json",
            get(move || ready(bytes("openapi", reply::JSON, older.clone()))),
        )
        .route("/docs", get(|| ready(html(UI.to_owned(), UI_POLICY))))
        .route("/docs/ui/{file}", get(ui_file))
        .route("/docs/errors", get(|| ready(html(error_pages::index(), PAGE_POLICY))))
        .route("/docs/errors/{code}", get(error_page))
        .route_layer(middleware::from_fn(without_query))
        .fallback(gate::unknown)
        .method_not_allowed_fallback(wrong_method)
}

fn version() -> Value {
    json!({ "name": "blaze-config", "version": env!("CARGO_PKG_VERSION"), "api": ["v1"] })
}

fn named(mut response: Response, operation: &'static str) -> Response {
    note(&mut response, |served| served.operation = Some(operation));
    response
}

fn value(status: StatusCode, operation: &'static str, value: &Value) -> Response {
    let mut response = bytes(operation, reply::JSON, Bytes::from(value.to_string()));
    *response.status_mut() = status;
    response
}

fn bytes(operation: &'static str, media: &str, bytes: impl Into<Body>) -> Response {
    let mut response = Response::new(bytes.into());
    reply::set(&mut response, CONTENT_TYPE, media);
    named(response, operation)
}

fn html(text: String, policy: &str) -> Response {
    let mut response = bytes("docs", HTML, text);
    reply::set(&mut response, CONTENT_SECURITY_POLICY, policy);
    response
}

fn readyz(readiness: &blaze_runtime::Readiness) -> Response {
    let report = readiness.report();
    let status = match report.status {
        blaze_runtime::admin::ReadinessStatus::Ready => StatusCode::OK,
        blaze_runtime::admin::ReadinessStatus::NotReady => StatusCode::SERVICE_UNAVAILABLE,
    };
    let body = serde_json::to_value(&report).unwrap_or(Value::Null);
    value(status, "readyz", &body)
}

/// The last segment of a path, as it came.
fn last_segment(request: &Request) -> &str {
    request.uri().path().rsplit('/').next().unwrap_or_default()
}

async fn ui_file(request: Request) -> Response {
    let name = last_segment(&request);
    if name == "start.js" {
        return bytes("docs", "text/javascript; charset=utf-8", START);
    }
    let config: Arc<Config<'static>> = Arc::new(Config::default());
    let known = UI_FILES.iter().find(|file| **file == name);
    match known.and_then(|name| utoipa_swagger_ui::serve(name, config).ok().flatten()) {
        Some(file) => {
            let content = match file.bytes {
                Cow::Borrowed(content) => Bytes::from_static(content),
                Cow::Owned(content) => Bytes::from(content),
            };
            bytes("docs", &file.content_type, content)
        }
        None => gate::unknown(request).await,
    }
}

async fn error_page(request: Request) -> Response {
    match last_segment(&request).parse::<Code>() {
        Ok(code) => html(error_pages::page(code), PAGE_POLICY),
        Err(_) => gate::unknown(request).await,
    }
}

/// No page takes a parameter; that there is no such page, or not with this method, comes first.
async fn without_query(request: Request, next: Next) -> Response {
    let Err(problem) = Query::parse(&[], request.uri().query()) else {
        return next.run(request).await;
    };
    let visit = request.extensions().get::<Visit>().cloned();
    let response = next.run(request).await;
    let missed = [StatusCode::NOT_FOUND, StatusCode::METHOD_NOT_ALLOWED];
    let (Some(visit), false) = (visit, missed.contains(&response.status())) else {
        return response;
    };
    let operation = response.extensions().get::<Served>().and_then(|served| served.operation);
    let mut refused = reply::problem(&problem, &visit.path, &visit.request_id);
    note(&mut refused, |served| served.operation = operation);
    refused
}

async fn wrong_method(request: Request) -> Response {
    let problem = Problem::new(
        Code::MethodNotAllowed,
        format!("{} is not for this path; GET, HEAD are", request.method()),
    );
    let (path, id) = match request.extensions().get::<Visit>() {
        Some(visit) => (&*visit.path, &*visit.request_id),
        None => (request.uri().path(), ""),
    };
    let mut response = reply::problem(&problem, path, id);
    allow(&mut response, "GET, HEAD");
    response
}
