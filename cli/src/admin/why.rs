//! `blaze why`.

use serde::Deserialize;
use serde_json::Value;

/// What `GET /v1/why` answers.
#[derive(Debug, Deserialize)]
pub(super) struct Why {
    topic: String,
    to: Option<Value>,
    verdict: Verdict,
    #[serde(default, deserialize_with = "super::text_or_null")]
    pub(super) code: String,
    remedy: Option<String>,
    #[serde(default)]
    steps: Vec<Step>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Verdict {
    Flowing,
    Degraded,
    NotFlowing,
}

impl Verdict {
    /// Whether messages arrive, be it fewer or weaker than asked.
    pub(super) fn flows(self) -> bool {
        self != Self::NotFlowing
    }

    /// The first line for people; `what` is the topic and where it should arrive.
    pub(super) fn sentence(self, what: &str, code: &str) -> String {
        match self {
            Self::Flowing => format!("{what} is flowing\n"),
            Self::Degraded => format!("{what} is flowing, but not as asked ({code})\n"),
            Self::NotFlowing => format!("{what} is NOT flowing ({code})\n"),
        }
    }
}

#[derive(Debug, Deserialize)]
struct Step {
    #[serde(default, deserialize_with = "super::text_or_null")]
    flow: String,
    step: String,
    ok: bool,
    #[serde(default, deserialize_with = "super::text_or_null")]
    code: String,
    detail: Option<String>,
}

impl Why {
    /// Whether messages arrive, be it fewer or weaker than asked.
    pub(super) fn flows(&self) -> bool {
        self.verdict.flows()
    }
}

/// The answer for people: verdict, one line a step, what to do.
pub(super) fn text(why: &Why) -> String {
    let to = match &why.to {
        Some(Value::String(to)) if !to.is_empty() => format!(" to {to}"),
        _ => String::new(),
    };
    let mut text = why.verdict.sentence(&format!("{}{to}", why.topic), &why.code);
    let width = |part: fn(&Step) -> &str| {
        why.steps.iter().map(|step| part(step).chars().count()).max().unwrap_or(0)
    };
    let (step_width, flow_width) = (width(|step| &step.step), width(|step| &step.flow));
    for step in &why.steps {
        let mark = if step.ok { "ok  " } else { "FAIL" };
        let mut line = format!("  {mark} {:step_width$}  {:flow_width$}", step.step, step.flow);
        let code = Some(step.code.as_str()).filter(|code| *code != "ok");
        for part in code.into_iter().chain(step.detail.as_deref()).filter(|part| !part.is_empty()) {
            line.push_str("  ");
            line.push_str(part);
        }
        text.push_str(line.trim_end());
        text.push('\n');
    }
    if let Some(remedy) = why.remedy.as_deref().filter(|remedy| !remedy.is_empty()) {
        text.push_str(&format!("What to do: {remedy}\n"));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn parse(value: Value) -> Why {
        Why::deserialize(value).unwrap()
    }

    #[test]
    fn a_failure_shows_where_and_what_to_do() {
        let why = parse(json!({"topic": "imu/data", "to": "cloud", "verdict": "not_flowing",
                "code": "no_request",
            "remedy": "Start a service that requests imu/data in cloud.", "steps": [
                {
                    "flow": "edge/robot-1",
                    "step": "advertise",
                    "ok": true,
                    "code": "ok",
                    "detail": "imu-driver, 50 Hz",
                },
                {"flow": "cloud/cloud-1", "step": "request", "ok": false, "code": "no_request",
                    "detail": ""}]}));
        assert!(!why.flows());
        assert_eq!(
            text(&why),
            "imu/data to cloud is NOT flowing (no_request)\n\
             \x20 ok   advertise  edge/robot-1   imu-driver, 50 Hz\n\
             \x20 FAIL request    cloud/cloud-1  no_request\n\
             What to do: Start a service that requests imu/data in cloud.\n"
        );
    }

    #[test]
    fn degraded_counts_as_flowing() {
        let why = parse(json!({
            "topic": "a",
            "to": null,
            "verdict": "degraded",
            "code": "rate_limited",
            "remedy": null,
            "steps": [],
        }));
        assert!(why.flows());
        assert_eq!(text(&why), "a is flowing, but not as asked (rate_limited)\n");
    }
}
