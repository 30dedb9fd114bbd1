//! `blaze why --server`: the way of a topic from the publisher to the consumer, by the flows of
//! both ends.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::dropped_text;
use super::why::Verdict;
use crate::config::text::printable;

/// What `GET /api/v1/why` answers.
#[derive(Debug, Deserialize)]
pub(super) struct Why {
    topic: String,
    to: Option<String>,
    pub(super) verdict: Verdict,
    #[serde(default, deserialize_with = "super::text_or_null")]
    code: String,
    #[serde(default, deserialize_with = "super::text_or_null")]
    remedy: String,
    #[serde(default)]
    hops: Vec<Hop>,
    #[serde(default)]
    asked: Vec<Asked>,
}

/// One part of the way; what the token may not see is absent.
#[derive(Debug, Deserialize)]
struct Hop {
    #[serde(rename = "where")]
    place: String,
    kind: String,
    ok: bool,
    #[serde(default, deserialize_with = "super::text_or_null")]
    code: String,
    #[serde(default, deserialize_with = "super::text_or_null")]
    detail: String,
    in_hz: Option<f64>,
    out_hz: Option<f64>,
    #[serde(default)]
    dropped: BTreeMap<String, u64>,
    age_ms: Option<f64>,
}

/// A flow that was asked.
#[derive(Debug, Deserialize)]
struct Asked {
    flow: String,
    status: u16,
    age_s: Option<f64>,
}

impl Hop {
    /// What is known of it beside its place.
    fn facts(&self) -> Vec<String> {
        let code = Some(self.code.clone()).filter(|code| code != "ok");
        let detail = Some(printable(&self.detail));
        let rate = |name: &str, hz: Option<f64>| hz.map(|hz| format!("{name} {hz:.1} Hz"));
        let dropped = self.dropped.values().any(|count| *count > 0);
        let facts = [
            code,
            detail,
            rate("in", self.in_hz),
            rate("out", self.out_hz),
            dropped.then(|| format!("dropped: {}", dropped_text(&self.dropped))),
            self.age_ms.map(|age| format!("age {age:.1} ms")),
        ];
        facts.into_iter().flatten().filter(|fact| !fact.is_empty()).collect()
    }
}

/// The answer for people: verdict, one line a hop, flows that did not answer, what to do.
pub(super) fn text(why: &Why) -> String {
    let what = match &why.to {
        Some(to) => format!("{} to {to}", why.topic),
        None => why.topic.clone(),
    };
    let mut text = why.verdict.sentence(&what, &why.code);
    let width = |part: fn(&Hop) -> &str| {
        why.hops.iter().map(|hop| part(hop).chars().count()).max().unwrap_or(0)
    };
    let (kind_width, place_width) = (width(|hop| &hop.kind), width(|hop| &hop.place));
    for hop in &why.hops {
        let mark = if hop.ok { "ok  " } else { "FAIL" };
        let line = format!(
            "  {mark} {:kind_width$}  {:place_width$}  {}",
            hop.kind,
            hop.place,
            hop.facts().join("  ")
        );
        text.push_str(line.trim_end());
        text.push('\n');
    }
    for asked in why.asked.iter().filter(|asked| asked.status != 200) {
        let age =
            asked.age_s.map(|age| format!(", last status {age:.0} s ago")).unwrap_or_default();
        text.push_str(&format!(
            "The flow {} did not answer (status {}{age}): its part is not known.\n",
            asked.flow, asked.status
        ));
    }
    if !why.remedy.is_empty() {
        text.push_str(&format!("What to do: {}\n", printable(&why.remedy)));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn each_hop_has_its_rates_and_who_did_not_answer_is_named() {
        let why = json!({"topic": "imu/data", "to": "cloud", "verdict": "degraded",
            "code": "rate_limited", "remedy": "Raise the limit.", "hops": [
                {"where": "edge/robot-1", "kind": "service", "ok": true, "code": "ok",
                    "detail": "imu-driver, 50 Hz", "dropped": {}},
                {"where": "edge/robot-1", "kind": "link", "ok": false, "code": "rate_limited",
                    "detail": "", "in_hz": 50, "out_hz": 9.96, "dropped": {"max_rate": 7},
                    "age_ms": 12.3},
                {"where": "cloud/cloud-1", "kind": "service", "ok": true, "code": "ok",
                    "dropped": {}}],
            "asked": [{"flow": "edge/robot-1", "status": 200, "age_s": 1},
                {"flow": "cloud/cloud-1", "status": 503, "age_s": 61}]});
        let why = Why::deserialize(&why).unwrap();
        assert!(why.verdict.flows());
        assert_eq!(
            text(&why),
            "imu/data to cloud is flowing, but not as asked (rate_limited)\n\
             \x20 ok   service  edge/robot-1   imu-driver, 50 Hz\n\
             \x20 FAIL link     edge/robot-1   rate_limited  in 50.0 Hz  out 10.0 Hz  dropped: max_rate 7  age 12.3 ms\n\
             \x20 ok   service  cloud/cloud-1\n\
             The flow cloud/cloud-1 did not answer (status 503, last status 61 s ago): its part is not known.\n\
             What to do: Raise the limit.\n"
        );
    }

    #[test]
    fn an_answer_without_hops_is_its_verdict() {
        let why = json!({"topic": "a", "to": null, "verdict": "not_flowing",
            "code": "no_request", "remedy": ""});
        let why = Why::deserialize(&why).unwrap();
        assert!(!why.verdict.flows());
        assert_eq!(text(&why), "a is NOT flowing (no_request)\n");
    }
}
