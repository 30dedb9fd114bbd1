//! Questions of the main service about this node: `TARGET PATH`, of a closed set.

use std::collections::BTreeMap;

use blaze_domain::FlowId;
use blaze_runtime::http::{GetError, GetLimits, get};
use serde_json::json;

use crate::limits::{ANSWER, MAX_ANSWER_BYTES, QUERY};

/// What may be asked of each program.
const OF_MONITOR: &[&str] = &["/v1/node", "/v1/ping", "/v1/latency", "/v1/health", "/v1/series"];
const OF_WORKER: &[&str] = &["/v1/status"];
const OF_FLOW: &[&str] = &[
    "/v1/topics",
    "/v1/bridges",
    "/v1/peers",
    "/v1/allocation",
    "/v1/ros2",
    "/v1/ros2/types",
    "/v1/summary",
    "/v1/why",
];
/// Longest path with its query, in bytes.
const MAX_PATH: usize = 2048;

/// Where the programs of this node are asked, `HOST:PORT`.
#[derive(Debug, Clone, Default)]
pub struct Targets {
    /// The monitor itself.
    pub monitor: String,
    /// The worker.
    pub worker: String,
    /// The flows by name.
    pub flows: BTreeMap<FlowId, String>,
}

impl Targets {
    /// Address of a question's target, and the path; `None`: it is not of the set.
    fn of<'a>(&self, question: &'a str) -> Option<(&str, &'a str)> {
        let (target, path) = question.split_once(' ')?;
        let is_text = path.len() <= MAX_PATH && path.bytes().all(|byte| byte.is_ascii_graphic());
        let (address, paths) = match target {
            "monitor" => (&self.monitor, OF_MONITOR),
            "worker" => (&self.worker, OF_WORKER),
            flow => (self.flows.get(&flow.parse::<FlowId>().ok()?)?, OF_FLOW),
        };
        let bare = path.split('?').next().unwrap_or_default();
        (is_text && paths.contains(&bare)).then_some((address.as_str(), path))
    }
}

/// Status and body of an answer.
pub(super) async fn answer(targets: &Targets, question: &str) -> (u32, String) {
    let Some((address, path)) = targets.of(question) else {
        return refusal(404, "not_found", "no program of this node answers that");
    };
    let limits = GetLimits { answer: QUERY, bytes: MAX_ANSWER_BYTES, ..ANSWER };
    match get(address, path, limits).await {
        Ok((status, body)) => match String::from_utf8(body.to_vec()) {
            Ok(json) => (status.into(), json),
            Err(_) => refusal(502, "no_answer", "the answer is no text"),
        },
        Err(GetError::TooLarge(_)) => refusal(413, "too_large", "the answer is above 1 MiB"),
        Err(error) => refusal(503, "no_answer", &format!("{address}: {error}")),
    }
}

pub(super) fn refusal(status: u32, code: &str, detail: &str) -> (u32, String) {
    (status, json!({"error": {"code": code, "detail": detail}}).to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_closed_set_is_asked() {
        let flow: FlowId = "edge/robot-1".parse().unwrap();
        let targets = Targets {
            monitor: "m".to_owned(),
            worker: "w".to_owned(),
            flows: [(flow, "f".to_owned())].into(),
        };
        for (question, expected) in [
            ("monitor /v1/health", Some(("m", "/v1/health"))),
            ("monitor /v1/series?names=a,b", Some(("m", "/v1/series?names=a,b"))),
            ("worker /v1/status", Some(("w", "/v1/status"))),
            ("edge/robot-1 /v1/why?topic=a", Some(("f", "/v1/why?topic=a"))),
            ("edge/robot-2 /v1/why?topic=a", None),
            ("monitor /metrics", None),
            ("monitor /v1/health/../../metrics", None),
            ("worker /v1/health", None),
            ("edge/robot-1 /v1/why?topic=a b", None),
            ("edge/robot-1 /v1/why?topic=a\r\nHost: x", None),
            ("monitor", None),
            ("", None),
        ] {
            assert_eq!(targets.of(question), expected, "{question:?}");
        }
        assert_eq!(targets.of(&format!("monitor /v1/health?{}", "x".repeat(MAX_PATH))), None);
    }
}
