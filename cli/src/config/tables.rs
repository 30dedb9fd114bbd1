//! Documents as tables: which columns each kind has.

use blaze_domain::config::Kind;
use serde_json::Value;

use super::text::{age, cell, joined, member};
use crate::output::{Align, Column, table};

/// How a table is laid out.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Layout {
    /// More columns.
    pub(crate) wide: bool,
    /// Columns of the terminal; `None`: lines are not wrapped.
    pub(crate) width: Option<u16>,
    /// Now, in milliseconds since 1970.
    pub(crate) now_ms: i64,
}

const NAME: Column<'_, Value> = ("NAME", Align::Left, &|document| member(document, "name"));

const LAYER: &[Column<'_, Value>] =
    &[NAME, ("KIND", Align::Left, &|document| spec(document, "kind"))];

const NODE: &[Column<'_, Value>] = &[
    NAME,
    ("LAYER", Align::Left, &|document| spec(document, "layer")),
    ("TYPE", Align::Left, &|document| or(spec(document, "type"), "static")),
];

const SERVICE: &[Column<'_, Value>] = &[
    NAME,
    ("LAYERS", Align::Left, &|document| or(spec(document, "layers"), "all")),
    ("SCHEMA", Align::Left, &|document| {
        let has = document.pointer("/spec/schema").is_some_and(|schema| !schema.is_null());
        (if has { "yes" } else { "-" }).to_owned()
    }),
];

const INSTANCE: &[Column<'_, Value>] = &[
    ("SERVICE", Align::Left, &|document| member(document, "service")),
    NAME,
    ("PLACED ON", Align::Left, &placement),
];

const ROLLOUT: &[Column<'_, Value>] = &[
    NAME,
    ("TARGET", Align::Left, &target),
    ("PHASE", Align::Left, &|document| cell(document.pointer("/status/phase"))),
    ("CANARIES", Align::Right, &|document| {
        let canaries = document.pointer("/status/canaries").and_then(Value::as_array);
        canaries.map_or_else(|| "-".to_owned(), |canaries| canaries.len().to_string())
    }),
];

const WIDE_NODE: &[Column<'_, Value>] = &[
    ("ADDRESSES", Align::Left, &|document| spec(document, "addresses")),
    ("RESOURCES", Align::Left, &resources),
];

const WIDE_SERVICE: &[Column<'_, Value>] =
    &[("DESCRIPTION", Align::Left, &|document| spec(document, "description"))];

const WIDE_ROLLOUT: &[Column<'_, Value>] =
    &[("CANARY", Align::Left, &|document| cell(document.pointer("/spec/canary/node_selector")))];

/// The columns of a kind, and those that a wide table has beside them.
fn columns_of(kind: Kind) -> [&'static [Column<'static, Value>]; 2] {
    match kind {
        Kind::Layer => [LAYER, &[]],
        Kind::Node => [NODE, WIDE_NODE],
        Kind::Service => [SERVICE, WIDE_SERVICE],
        Kind::Instance => [INSTANCE, &[]],
        Kind::Rollout => [ROLLOUT, WIDE_ROLLOUT],
    }
}

fn or(cell: String, absent: &str) -> String {
    if cell == "-" { absent.to_owned() } else { cell }
}

/// A table of documents of one kind.
pub(crate) fn documents(kind: Kind, items: &[Value], layout: Layout) -> String {
    let made = |document: &Value| age(document.get("create_time"), layout.now_ms);
    let changed = |document: &Value| age(document.get("update_time"), layout.now_ms);
    let common: [Column<'_, Value>; 2] = [
        ("REVISION", Align::Right, &|document| cell(document.get("revision"))),
        ("AGE", Align::Right, &made),
    ];
    let always: [Column<'_, Value>; 3] = [
        ("LABELS", Align::Left, &labels),
        ("CHANGED", Align::Right, &changed),
        ("BY", Align::Left, &|document| cell(document.get("updated_by"))),
    ];
    let [own, wide] = columns_of(kind);
    let mut columns = [own, &common].concat();
    if layout.wide {
        columns.extend(wide);
        columns.extend(always);
    }
    table(items, layout.width, &columns)
}

fn spec(document: &Value, name: &str) -> String {
    cell(document.get("spec").and_then(|spec| spec.get(name)))
}

/// Where an instance runs: `node/robot-1`, `layer/edge`, or anywhere.
pub(crate) fn placement(document: &Value) -> String {
    for kind in ["node", "layer"] {
        if let Some(name) =
            document.get("spec").and_then(|spec| spec.get(kind)).and_then(Value::as_str)
        {
            return format!("{kind}/{}", super::text::printable(name));
        }
    }
    "anywhere".to_owned()
}

/// What a roll-out changes: `service/slam`.
pub(crate) fn target(document: &Value) -> String {
    let Some(target) = document.pointer("/spec/target") else {
        return "-".to_owned();
    };
    let mut text = member(target, "kind").to_ascii_lowercase();
    for part in ["service", "name"] {
        let part = member(target, part);
        if !part.is_empty() {
            text.push('/');
            text.push_str(&part);
        }
    }
    text
}

fn resources(document: &Value) -> String {
    let Some(resources) = document.pointer("/spec/resources") else {
        return "-".to_owned();
    };
    let mut parts = Vec::new();
    if let Some(cpus) = resources.get("cpus").and_then(Value::as_f64) {
        parts.push(format!("{cpus} CPU"));
    }
    if let Some(memory) = resources.get("memory_bytes").and_then(Value::as_f64) {
        parts.push(crate::output::bytes(memory));
    }
    if let Some(gpus) = resources.get("gpus").and_then(Value::as_f64).filter(|gpus| *gpus > 0.0) {
        parts.push(format!("{gpus} GPU"));
    }
    let arch = member(resources, "arch");
    if !arch.is_empty() {
        parts.push(arch);
    }
    joined(&parts, ", ")
}

fn labels(document: &Value) -> String {
    let labels = document.get("labels").and_then(Value::as_object);
    let pairs: Vec<String> = labels
        .into_iter()
        .flatten()
        .map(|(name, value)| format!("{name}={}", value.as_str().unwrap_or_default()))
        .collect();
    cell(Some(&Value::from(pairs)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    const LAYOUT: Layout = Layout {
        wide: false,
        width: None,
        // 2026-11-21T07:01:12.345Z
        now_ms: 1_795_244_472_345,
    };
    const WIDE: Layout = Layout { wide: true, ..LAYOUT };

    fn stamped(mut document: Value) -> Value {
        for (name, value) in [
            ("revision", json!(412)),
            ("create_time", json!("2026-11-21T06:01:12.345Z")),
            ("update_time", json!("2026-11-21T07:00:12.345Z")),
            ("updated_by", json!("ops")),
        ] {
            document[name] = value;
        }
        document
    }

    #[test]
    fn each_kind_has_its_columns() {
        for (kind, document, expected) in [
            (
                Kind::Layer,
                json!({"name": "edge", "spec": {"kind": "edge"}}),
                "NAME  KIND  REVISION  AGE\nedge  edge       412   1h\n",
            ),
            (
                Kind::Node,
                json!({"name": "robot-1", "spec": {"layer": "edge"}}),
                "NAME     LAYER  TYPE    REVISION  AGE\nrobot-1  edge   static       412   1h\n",
            ),
            (
                Kind::Service,
                json!({
                    "name": "slam",
                    "spec": {"layers": ["edge", "fog"], "schema": {"type": "object"}},
                }),
                "NAME  LAYERS    SCHEMA  REVISION  AGE\nslam  edge,fog  yes          412   1h\n",
            ),
            (
                Kind::Instance,
                json!({"name": "0", "service": "slam", "spec": {"node": "robot-1"}}),
                "SERVICE  NAME  PLACED ON     REVISION  AGE\nslam     0     node/robot-1       412   1h\n",
            ),
            (
                Kind::Rollout,
                json!({"name": "slower",
                    "spec": {"target": {"kind": "Instance", "service": "slam", "name": "0"}},
                    "status": {"phase": "canary", "canaries": [{}]}}),
                "NAME    TARGET           PHASE   CANARIES  REVISION  AGE\nslower  instance/slam/0  canary         1       412   1h\n",
            ),
        ] {
            assert_eq!(documents(kind, &[stamped(document)], LAYOUT), expected);
        }
    }

    #[test]
    fn wide_tables_tell_more() {
        let document = json!({"name": "robot-1", "labels": {"site": "lab", "canary": "true"},
            "spec": {"layer": "edge", "type": "mobile", "addresses": ["10.0.1.7"],
                "resources": {"cpus": 8, "memory_bytes": 34_359_738_368_u64, "gpus": 1,
                    "arch": "arm64"}}});
        let text = documents(Kind::Node, &[stamped(document)], WIDE);
        let mut lines = text.lines();
        assert!(lines.next().unwrap().ends_with(
            "ADDRESSES  RESOURCES                      LABELS                CHANGED  BY"
        ));
        assert!(lines.next().unwrap().ends_with(
            "10.0.1.7   8 CPU, 32.0 GiB, 1 GPU, arm64  site=lab,canary=true       1m  ops"
        ));
    }

    #[test]
    fn what_is_missing_is_a_dash_and_never_a_failure() {
        for kind in Kind::ALL {
            let text =
                documents(*kind, &[json!({}), json!(7), json!({"spec": [], "status": 3})], WIDE);
            assert_eq!(text.lines().count(), 4, "{text}");
        }
    }
}
