//! Tokens that the service gives out and takes back.

use axum::http::StatusCode;
use axum::response::Response;
use blaze_domain::config::{Code, Problem};

use super::operation::Call;
use super::{reply, requests};
use crate::api::json;
use crate::auth::Role;
use crate::core::{Page, TokenRequest};

/// `GET /tokens`
pub(super) async fn list(call: &Call) -> Result<Response, Problem> {
    let answer = call.service().tokens(&call.caller, &call.read_options()?).await?;
    let page = Page { items: answer.value, next_page_token: String::new() };
    let body = json::page(&page, answer.revision, json::token);
    Ok(reply::json(StatusCode::OK, answer.revision, &body))
}

/// `POST /tokens`; a second one like it makes a second token.
pub(super) async fn create(call: &Call) -> Result<Response, Problem> {
    let request = request(call.read()?)?;
    let answer = call.service().create_token(&call.caller, request).await?;
    let (record, text) = &answer.value;
    let body = json::new_token(record, text);
    Ok(reply::json(StatusCode::CREATED, answer.revision, &body))
}

/// `DELETE /tokens/{id}`
pub(super) async fn revoke(call: &Call) -> Result<Response, Problem> {
    let Some(id) = &call.names.id else {
        return Err(Problem::new(Code::NotFound, "the path names no token"));
    };
    let answer = call.service().revoke_token(&call.caller, id).await?;
    Ok(reply::empty(StatusCode::NO_CONTENT, answer.revision))
}

fn request(asked: requests::TokenRequest) -> Result<TokenRequest, Problem> {
    let roles = asked.roles;
    if roles.is_empty() {
        return Err(requests::fault("/roles", "is empty"));
    }
    for (index, role) in roles.iter().enumerate() {
        let is_known = Role::ALL.iter().any(|known| known.as_str() == role);
        if !is_known || roles[..index].contains(role) {
            let known: Vec<&str> = Role::ALL.iter().map(|role| role.as_str()).collect();
            let detail = format!("comes twice, or is not one of {}", known.join(", "));
            return Err(requests::fault(&format!("/roles/{index}"), &detail));
        }
    }
    Ok(TokenRequest {
        subject: asked.subject,
        roles,
        layer: asked.layer.map(|layer| layer.to_string()),
        expires_in_s: u32::try_from(asked.expires_in_s).unwrap_or(u32::MAX),
    })
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;
    use crate::api::DEFAULT_TOKEN_LIFE_S;

    fn request(body: &Value) -> Result<TokenRequest, Problem> {
        super::request(requests::read(body)?)
    }

    #[test]
    fn a_request_is_read_strictly() {
        let body =
            json!({ "subject": "ops", "roles": ["operator"], "layer": null, "expires_in_s": 60 });
        let read = request(&body).unwrap();
        assert_eq!((read.subject.as_str(), read.layer, read.expires_in_s), ("ops", None, 60));
        let short = request(&json!({ "subject": "ops", "roles": ["viewer"] })).unwrap();
        assert_eq!(short.expires_in_s, DEFAULT_TOKEN_LIFE_S);
        for (body, pointer) in [
            (json!({ "subject": "", "roles": ["viewer"] }), "/subject"),
            (json!({ "subject": "ops" }), "/roles"),
            (json!({ "subject": "ops", "roles": [] }), "/roles"),
            (json!({ "subject": "ops", "roles": "admin" }), "/roles"),
            (json!({ "subject": "ops", "roles": [1] }), "/roles/0"),
            (json!({ "subject": "ops", "roles": ["root"] }), "/roles/0"),
            (json!({ "subject": "ops", "roles": ["admin", "admin"] }), "/roles/1"),
            (json!({ "subject": "ops", "roles": ["viewer"], "layer": "Edge" }), "/layer"),
            (json!({ "subject": "ops", "roles": ["viewer"], "expires_in_s": 0 }), "/expires_in_s"),
            (
                json!({ "subject": "ops", "roles": ["viewer"], "expires_in_s": 31_536_001 }),
                "/expires_in_s",
            ),
            (json!({ "subject": "ops", "roles": ["viewer"], "token": "x" }), "/token"),
        ] {
            let problem = request(&body).unwrap_err();
            assert_eq!(
                (problem.code, problem.errors[0].pointer.as_str()),
                (Code::ValidationFailed, pointer),
                "{body}"
            );
        }
    }
}
