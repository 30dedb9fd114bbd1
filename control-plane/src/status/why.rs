//! `why` over several flows: the answers of the publisher's and of the consumer's flow as one way
//! of hops, with the rates that their bridges had meanwhile. Pure.
//!
//! ```text
//! /v1/why of each flow ─▶ steps ─▶ hops, once each; what a flow says of itself counts
//! /v1/bridges, twice ───▶ rates of the hops that leave the flow, or are written there
//! ```

use std::collections::BTreeMap;
use std::time::Duration;

use blaze_domain::{FlowId, LayerName};
use serde::Deserialize;
use serde_json::{Map, Value, json};

use super::patch::{rounded, without_nulls};

/// Hops in an answer.
const MAX_HOPS: usize = 128;

/// What one flow answered.
#[derive(Debug, Clone)]
pub struct FlowAnswer {
    /// Which flow.
    pub flow: FlowId,
    /// Its `/v1/why`.
    pub why: String,
    /// Its bridges of the topic, and so much later again.
    pub bridges: Option<(String, String, Duration)>,
}

/// What is asked about.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Asked<'a> {
    /// Topic.
    pub topic: &'a str,
    /// Whom it should reach.
    pub to: Option<&'a str>,
    /// The layer that the token is bound to.
    pub bound: Option<&'a LayerName>,
}

#[derive(Deserialize)]
struct Verdict {
    verdict: String,
    code: String,
    #[serde(default)]
    remedy: String,
    #[serde(default)]
    steps: Vec<Step>,
}

#[derive(Deserialize)]
struct Step {
    flow: String,
    step: String,
    ok: bool,
    code: String,
    #[serde(default)]
    detail: String,
}

impl Verdict {
    fn badness(&self) -> usize {
        ["flowing", "degraded", "not_flowing"].iter().position(|v| *v == self.verdict).unwrap_or(2)
    }
}

/// Steps in the order of a message's way, and what each is a hop of.
const STEPS: [(&str, &str); 7] = [
    ("advertise", "service"),
    ("plan", "flow"),
    ("bridge", "broker"),
    ("admit", "flow"),
    ("link", "link"),
    ("deliver", "broker"),
    ("request", "service"),
];

/// The answers as one; `None` if none can be read.
#[must_use]
pub fn merge(asked: &Asked<'_>, answers: &[FlowAnswer]) -> Option<Map<String, Value>> {
    let read: Vec<(&FlowAnswer, Verdict)> = answers
        .iter()
        .filter_map(|answer| Some((answer, serde_json::from_str(&answer.why).ok()?)))
        .collect();
    // Of equals the publisher's, which comes first.
    let worst = read.iter().rev().max_by_key(|(_, verdict)| verdict.badness())?;
    let (verdict, code, remedy) = (&worst.1.verdict, &worst.1.code, &worst.1.remedy);
    let members = json!({
        "topic": asked.topic, "to": asked.to, "verdict": verdict, "code": code, "remedy": remedy,
        "hops": hops(asked, &read),
    });
    match members {
        Value::Object(members) => Some(members),
        _ => None,
    }
}

fn hops(asked: &Asked<'_>, read: &[(&FlowAnswer, Verdict)]) -> Vec<Value> {
    let mut hops: BTreeMap<(usize, usize), Value> = BTreeMap::new();
    let mut known: BTreeMap<(usize, String), (usize, bool)> = BTreeMap::new();
    for (answer, verdict) in read {
        for step in &verdict.steps {
            let Some(rank) = STEPS.iter().position(|(name, _)| *name == step.step) else {
                continue;
            };
            let is_own = answer.flow.is_written(&step.flow);
            let next = known.len();
            let held = known.entry((rank, step.flow.clone())).or_insert((next, false));
            let is_new = held.0 == next;
            // Only itself knows it for certain.
            if (is_new && next < MAX_HOPS) || (is_own && !held.1) {
                held.1 |= is_own;
                hops.insert((rank, held.0), hop(asked, answer, step, STEPS[rank].1, is_own));
            }
        }
    }
    hops.into_values().take(MAX_HOPS).collect()
}

fn hop(asked: &Asked<'_>, answer: &FlowAnswer, step: &Step, kind: &str, is_own: bool) -> Value {
    let mut hop = json!({
        "where": step.flow, "kind": kind, "ok": step.ok, "code": step.code, "dropped": {},
    });
    let layer = step.flow.split('/').next().unwrap_or_default();
    if asked.bound.is_some_and(|bound| bound.as_str() != layer) {
        return hop;
    }
    hop["detail"] = step.detail.as_str().into();
    let leaves = match step.step.as_str() {
        "admit" | "link" => true,
        "deliver" => false,
        _ => return hop,
    };
    if let (true, Some(counts)) = (is_own, counts(asked, answer, leaves)) {
        counts.write(&mut hop);
    }
    without_nulls(hop)
}

/// Sums over the bridges of one flow.
#[derive(Debug, Default)]
struct Counts {
    in_hz: f64,
    out_hz: f64,
    dropped: BTreeMap<String, u64>,
    age_ms: Option<f64>,
}

impl Counts {
    fn write(self, hop: &mut Value) {
        hop["in_hz"] = rounded(self.in_hz).unwrap_or_default();
        hop["out_hz"] = rounded(self.out_hz).unwrap_or_default();
        hop["dropped"] = json!(self.dropped);
        hop["age_ms"] = self.age_ms.and_then(rounded).unwrap_or_default();
    }
}

#[derive(Deserialize)]
struct Bridges {
    #[serde(default)]
    bridges: Vec<Bridge>,
}

#[derive(Deserialize)]
struct Bridge {
    id: String,
    to: Scope,
    #[serde(rename = "in")]
    taken: Messages,
    #[serde(rename = "out")]
    given: Messages,
    #[serde(default)]
    dropped: BTreeMap<String, u64>,
    #[serde(default)]
    age_ms: Option<Quantiles>,
}

#[derive(Deserialize)]
struct Scope {
    scope: String,
    #[serde(default)]
    layer: Option<String>,
}

#[derive(Deserialize)]
struct Messages {
    messages: u64,
}

#[derive(Deserialize)]
struct Quantiles {
    p50: f64,
}

/// Rates of the bridges to the inter scope, towards the layer that is asked about, or of those to
/// brokers. `None` without bridges.
fn counts(asked: &Asked<'_>, answer: &FlowAnswer, leaves: bool) -> Option<Counts> {
    let (before, after, time) = answer.bridges.as_ref()?;
    let read = |text: &str| serde_json::from_str::<Bridges>(text).ok();
    let (before, after) = (read(before)?, read(after)?);
    let to_layer = asked.to.and_then(|to| to.split('/').next());
    let matches = |bridge: &Bridge| {
        let is_inter = bridge.to.scope == "inter";
        let layer = bridge.to.layer.as_deref();
        is_inter == leaves && (!is_inter || to_layer.is_none() || layer == to_layer)
    };
    let seconds = time.as_secs_f64();
    let per_s = |new: u64, old: Option<u64>| {
        let old = old.filter(|old| *old <= new).unwrap_or(new);
        if seconds > 0.0 { (new - old) as f64 / seconds } else { 0.0 }
    };
    let mut counts = None::<Counts>;
    for bridge in after.bridges.iter().filter(|bridge| matches(bridge)) {
        let old = before.bridges.iter().find(|old| old.id == bridge.id);
        let sums = counts.get_or_insert_default();
        sums.in_hz += per_s(bridge.taken.messages, old.map(|old| old.taken.messages));
        sums.out_hz += per_s(bridge.given.messages, old.map(|old| old.given.messages));
        for (reason, count) in bridge.dropped.iter().filter(|(_, count)| **count > 0) {
            *sums.dropped.entry(reason.clone()).or_default() += count;
        }
        let age = bridge.age_ms.as_ref().map(|age| age.p50);
        sums.age_ms = [sums.age_ms, age].into_iter().flatten().reduce(f64::max);
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(flow: &str, step: &str, ok: bool, code: &str, detail: &str) -> Value {
        json!({ "flow": flow, "step": step, "ok": ok, "code": code, "detail": detail })
    }

    fn answer(flow: &str, verdict: &str, code: &str, steps: &[Value]) -> FlowAnswer {
        let why = json!({
            "verdict": verdict, "code": code, "remedy": format!("remedy of {code}"), "steps": steps,
        });
        FlowAnswer { flow: flow.parse().unwrap(), why: why.to_string(), bridges: None }
    }

    fn bridges(sent: u64, dropped: u64) -> String {
        let bridge = json!({
            "id": "imu/data|node>inter|cloud", "to": { "scope": "inter", "layer": "cloud" },
            "in": { "messages": sent + dropped }, "out": { "messages": sent },
            "dropped": { "queue_full": 0, "max_rate": dropped }, "age_ms": null,
        });
        json!({ "bridges": [bridge] }).to_string()
    }

    const ASKED: Asked<'static> = Asked { topic: "imu/data", to: Some("cloud"), bound: None };

    #[test]
    fn what_a_flow_says_of_itself_counts() {
        let mut publisher = answer(
            "edge/robot-1",
            "flowing",
            "ok",
            &[
                step("edge/robot-1", "advertise", true, "ok", "imu-driver, 50 Hz"),
                step("cloud/cloud-1", "request", true, "ok", "as announced"),
                step("edge/robot-1", "admit", true, "ok", ""),
                step("cloud/cloud-1", "deliver", true, "ok", "as announced"),
            ],
        );
        publisher.bridges = Some((bridges(100, 5), bridges(200, 10), Duration::from_secs(2)));
        let consumer = answer(
            "cloud/cloud-1",
            "not_flowing",
            "broker_down",
            &[
                step("cloud/cloud-1", "deliver", false, "broker_down", "redis does not answer"),
                step("edge/robot-1", "advertise", true, "ok", "from afar"),
            ],
        );
        let merged = merge(&ASKED, &[publisher, consumer]).unwrap();
        assert_eq!(merged["verdict"], "not_flowing");
        assert_eq!(
            (&merged["code"], &merged["remedy"]),
            (&json!("broker_down"), &json!("remedy of broker_down"))
        );
        let hops = merged["hops"].as_array().unwrap();
        let shown: Vec<_> = hops
            .iter()
            .map(|hop| {
                (
                    hop["where"].as_str().unwrap(),
                    hop["kind"].as_str().unwrap(),
                    hop["ok"].as_bool().unwrap(),
                )
            })
            .collect();
        assert_eq!(
            shown,
            [
                ("edge/robot-1", "service", true),
                ("edge/robot-1", "flow", true),
                ("cloud/cloud-1", "broker", false),
                ("cloud/cloud-1", "service", true),
            ]
        );
        assert_eq!(hops[0]["detail"], "imu-driver, 50 Hz");
        assert_eq!(hops[2]["detail"], "redis does not answer");
        assert_eq!((&hops[1]["in_hz"], &hops[1]["out_hz"]), (&json!(52.5), &json!(50.0)));
        assert_eq!(hops[1]["dropped"], json!({ "max_rate": 10 }));
    }

    #[test]
    fn a_bound_token_sees_no_details_of_other_layers() {
        let edge = "edge".parse().unwrap();
        let asked = Asked { bound: Some(&edge), ..ASKED };
        let answer = answer(
            "edge/robot-1",
            "not_flowing",
            "no_request",
            &[
                step("edge/robot-1", "advertise", true, "ok", "imu-driver"),
                step("cloud/cloud-1", "request", false, "no_request", "names of cloud"),
            ],
        );
        let merged = merge(&asked, &[answer]).unwrap();
        assert_eq!(merged["hops"][0]["detail"], "imu-driver");
        assert!(!Value::Object(merged).to_string().contains("names of cloud"));
    }

    #[test]
    fn answers_that_are_none_are_left_out() {
        let odd = |why: &str| FlowAnswer {
            flow: "edge/robot-1".parse().unwrap(),
            why: why.to_owned(),
            bridges: Some((String::new(), "{}".to_owned(), Duration::ZERO)),
        };
        assert!(merge(&ASKED, &[odd(""), odd("[]"), odd("{}")]).is_none());
        assert!(merge(&ASKED, &[]).is_none());
    }
}
