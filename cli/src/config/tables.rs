//! Documents as tables: which columns each kind has.

use blaze_domain::config::Kind;
use serde_json::Value;

use super::text::{age, cell, member};
use crate::output::{Align, render_table};

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

/// One column: its heading, where its content stands, and what it shows of a document.
type Column = (&'static str, Align, fn(&Value) -> String);

fn left(name: &'static str, show: fn(&Value) -> String) -> Column {
    (name, Align::Left, show)
}

fn right(name: &'static str, show: fn(&Value) -> String) -> Column {
    (name, Align::Right, show)
}

/// A table of documents of one kind.
pub(crate) fn documents(kind: Kind, items: &[Value], layout: Layout) -> String {
    let mut columns: Vec<(&str, Align)> = own_columns(kind)
        .iter()
        .map(|(name, align, _)| (*name, *align))
        .collect();
    columns.extend([("REVISION", Align::Right), ("AGE", Align::Right)]);
    let wide = if layout.wide { wide_columns(kind) } else { Vec::new() };
    columns.extend(wide.iter().map(|(name, align, _)| (*name, *align)));
    if layout.wide {
        columns.extend([("LABELS", Align::Left), ("CHANGED", Align::Right), ("BY", Align::Left)]);
    }
    let row = |document: &Value| {
        let mut cells: Vec<String> = own_columns(kind).iter().map(|(_, _, show)| show(document)).collect();
        cells.push(cell(document.get("revision")));
        cells.push(age(document.get("create_time"), layout.now_ms));
        cells.extend(wide.iter().map(|(_, _, show)| show(document)));
        if layout.wide {
            cells.push(labels(document));
            cells.push(age(document.get("update_time"), layout.now_ms));
            cells.push(cell(document.get("updated_by")));
        }
        cells
    };
    render_table(&columns, items.iter().map(row).collect(), layout.width)
}

fn own_columns(kind: Kind) -> Vec<Column> {
    let name = left("NAME", |document| member(document, "name"));
    match kind {
        Kind::Layer => vec![name, left("KIND", |document| spec(document, "kind"))],
        Kind::Node => vec![
            name,
            left("LAYER", |document| spec(document, "layer")),
            left("TYPE", |document| match spec(document, "type").as_str() {
                "-" => "static".to_owned(),
                other => other.to_owned(),
            }),
        ],
        Kind::Service => vec![
            name,
            left("LAYERS", |document| match spec(document, "layers").as_str() {
                "-" => "all".to_owned(),
                other => other.to_owned(),
            }),
            left("SCHEMA", |document| {
                let has = document.pointer("/spec/schema").is_some_and(|schema| !schema.is_null());
                let word = if has { "yes" } else { "-" };
                word.to_owned()
            }),
        ],
        Kind::Instance => vec![
            left("SERVICE", |document| member(document, "service")),
            name,
            left("PLACED ON", placement),
        ],
        Kind::Rollout => vec![
            name,
            left("TARGET", target),
            left("PHASE", |document| cell(document.pointer("/status/phase"))),
            right("CANARIES", |document| {
                let canaries = document.pointer("/status/canaries").and_then(Value::as_array);
                canaries.map_or_else(|| "-".to_owned(), |canaries| canaries.len().to_string())
            }),
        ],
    }
}

fn wide_columns(kind: Kind) -> Vec<Column> {
    match kind {
        Kind::Layer | Kind::Instance => Vec::new(),
        Kind::Node => vec![
            left("ADDRESSES", |document| spec(document, "addresses")),
            left("RESOURCES", resources),
        ],
        Kind::Service => vec![left("DESCRIPTION", |document| spec(document, "description"))],
        Kind::Rollout => vec![left("CANARY", |document| {
            cell(document.pointer("/spec/canary/node_selector"))
        })],
    }
}

fn spec(document: &Value, name: &str) -> String {
    cell(document.get("spec").and_then(|spec| spec.get(name)))
}

/// Where an instance runs: `node/robot-1`, `layer/edge`, or anywhere.
pub(crate) fn placement(document: &Value) -> String {
    for kind in ["node", "layer"] {
        if let Some(name) = document
            .get("spec")
            .and_then(|spec| spec.get(kind))
            .and_then(Value::as_str)
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
    if parts.is_empty() {
        "-".to_owned()
    } else {
        parts.join(", ")
    }
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
                json!({"name": "slam", "spec": {"layers": ["edge", "fog"], "schema": {"type": "object"}}}),
                "NAME  LAYERS    SCHEMA  REVISION  AGE\nslam  edge,fog  yes          412   1h\n",
            ),
            (
                Kind::Instance,
                json!({"name": "0", "service": "slam", "spec": {"node": "robot-1"}}),
                "SERVICE  NAME  PLACED ON     REVISION  AGE\nslam     0     node/robot-1       412   1h\n",
            ),
            (
                Kind::Rollout,
                json!({"name": "slower", "spec": {"target": {"kind": "Instance", "service": "slam", "name": "0"}},
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
                "resources": {"cpus": 8, "memory_bytes": 34_359_738_368_u64, "gpus": 1, "arch": "arm64"}}});
        let text = documents(Kind::Node, &[stamped(document)], WIDE);
        let mut lines = text.lines();
        assert!(
            lines
                .next()
                .unwrap()
                .ends_with("ADDRESSES  RESOURCES                      LABELS                CHANGED  BY")
        );
        assert!(
            lines
                .next()
                .unwrap()
                .ends_with("10.0.1.7   8 CPU, 32.0 GiB, 1 GPU, arm64  site=lab,canary=true       1m  ops")
        );
    }

    #[test]
    fn what_is_missing_is_a_dash_and_never_a_failure() {
        for kind in Kind::ALL {
            let text = documents(*kind, &[json!({}), json!(7), json!({"spec": [], "status": 3})], WIDE);
            assert_eq!(text.lines().count(), 4, "{text}");
        }
    }
}
