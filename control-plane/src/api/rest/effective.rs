//! `GET /effective`: what a service, a node or a layer gets.

use axum::http::StatusCode;
use axum::response::Response;
use blaze_domain::config::Problem;

use super::operation::Call;
use super::query::Param;
use super::reply;
use crate::api::json;
use crate::core::Place;

/// `GET /effective`
pub(super) async fn get(call: &Call) -> Result<Response, Problem> {
    let place = Place {
        service: call.query.name(Param::Service)?,
        instance: call.query.name(Param::Instance)?,
        layer: call.query.name(Param::AtLayer)?,
        node: call.query.name(Param::AtNode)?,
    };
    let explain = call.query.flag(Param::Explain)?;
    let answer =
        call.service().effective(&call.caller, &place, explain, &call.read_options()?).await?;
    let body = json::effective(&answer.value, answer.revision);
    Ok(reply::json(StatusCode::OK, answer.revision, &body))
}
