//! What monitors know: problems, topics, series, why a topic does not arrive, targets.

use axum::body::Body;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::Response;
use blaze_domain::config::{Code, Problem};
use blaze_domain::{LayerName, NodeName};

use super::headers::BLAZE_REVISION;
use super::operation::Call;
use super::query::Param;
use super::reply;
use crate::api::json as answers;
use crate::core::{ProblemsQuery, TopicsQuery, WhyQuery};
use crate::status::health::Health;

/// Longest `names` and `prefix`, in bytes.
pub(super) const MAX_TEXT: usize = 1024;

fn missing(name: &str) -> Problem {
    Problem::new(Code::InvalidRequest, format!("query parameter {name} is missing"))
}

fn short(call: &Call, param: Param) -> Result<&str, Problem> {
    match call.query.text(param).unwrap_or_default() {
        text if text.len() <= MAX_TEXT => Ok(text),
        _ => {
            let detail = format!("query parameter {} has more than {MAX_TEXT} bytes", param.name());
            Err(Problem::new(Code::InvalidRequest, detail))
        }
    }
}

/// `GET /why`
pub(super) async fn why(call: &Call) -> Result<Response, Problem> {
    let query = WhyQuery {
        topic: call.query.topic(Param::WhyTopic)?.ok_or_else(|| missing("topic"))?,
        to: call.query.parsed(Param::WhyTo)?,
        from: call.query.parsed(Param::WhyFrom)?,
    };
    let answer = call.service().why(&call.caller, &query, &call.read_options()?).await?;
    Ok(reply::json(StatusCode::OK, answer.revision, &answer.value))
}

/// `GET /problems`
pub(super) async fn problems(call: &Call) -> Result<Response, Problem> {
    let state = call.query.word(Param::HealthState, Health::WORDS)?;
    let query = ProblemsQuery {
        layer: call.query.name::<LayerName>(Param::Layer)?,
        state: state.map(Health::of_word),
    };
    let answer = call.service().problems(&call.caller, &query, &call.read_options()?).await?;
    Ok(reply::json(StatusCode::OK, answer.revision, &answer.value))
}

/// `GET /topics`
pub(super) async fn topics(call: &Call) -> Result<Response, Problem> {
    let query = TopicsQuery {
        prefix: short(call, Param::Prefix)?.to_owned(),
        limit: call.query.limit()?,
        page_token: call.query.page_token().to_owned(),
    };
    let answer = call.service().topics(&call.caller, &query, &call.read_options()?).await?;
    let body = answers::page(&answer.value, answer.revision, Clone::clone);
    Ok(reply::json(StatusCode::OK, answer.revision, &body))
}

/// `GET /series`
pub(super) async fn series(call: &Call) -> Result<Response, Problem> {
    let node = call.query.name::<NodeName>(Param::SeriesNode)?.ok_or_else(|| missing("node"))?;
    let names = short(call, Param::Names)?;
    let read = call.read_options()?;
    let answer = call.service().series(&call.caller, &node, names, &read).await?;
    let mut response = Response::new(Body::from(answer.value.json.to_string()));
    reply::set(&mut response, CONTENT_TYPE, reply::JSON);
    reply::set(&mut response, BLAZE_REVISION, &answer.revision.to_string());
    Ok(response)
}

/// `GET /targets`
pub(super) async fn targets(call: &Call) -> Result<Response, Problem> {
    let answer = call.service().targets(&call.caller, &call.read_options()?).await?;
    Ok(reply::json(StatusCode::OK, answer.revision, &answer.value))
}
