//! `docs/monitor-metrics.md` is made of the tables of the code. After a change of these:
//! `BLAZE_WRITE_DOCS=1 cargo test -p blaze-monitor docs`.

use std::fmt::Write as _;
use std::path::Path;

use crate::health::CODES;

const HEAD: &str = "# Metrics of the monitor

Made of the tables in the code. `layer` and `node` are labels of the scrape target. What a machine lacks has no series. At
most 256 values of a label, 2,000 pairs of topic and node; the rest is `_other`. With `/metrics?all=1` the metrics of
[flow, worker and main service](metrics.md) come with them.

| metric | type | labels | unit | meaning |
|---|---|---|---|---|
";

const CODES_HEAD: &str = "
## Codes of health

What a node finds itself; what to do stands in [runbook.md](runbook.md) and in the answers. `monitor_silent`, `node_gone`,
`no_ready_flow` and `nodes_down` are found by the main service.

| scope | code | state | after | meaning |
|---|---|---|---|---|
";

fn page() -> String {
    let mut out = HEAD.to_owned();
    for metric in crate::all_metrics() {
        let labels: Vec<String> = metric.labels.iter().map(|name| format!("`{name}`")).collect();
        let labels = if labels.is_empty() { "–".to_owned() } else { labels.join(", ") };
        let (name, kind) = (metric.name, metric.kind.as_str());
        writeln!(out, "| `{name}` | {kind} | {labels} | {} | {} |", metric.unit, metric.help)
            .unwrap();
    }
    out.push_str(CODES_HEAD);
    for code in CODES {
        let (scope, state) = (code.scope.as_str(), code.state.as_str());
        let after = code.after.as_secs();
        writeln!(out, "| {scope} | `{}` | {state} | {after} s | {} |", code.code, code.meaning)
            .unwrap();
    }
    out
}

#[test]
fn the_page_of_metrics_is_that_of_the_code() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/monitor-metrics.md");
    if std::env::var_os("BLAZE_WRITE_DOCS").is_some() {
        std::fs::write(&file, page()).unwrap();
    }
    assert_eq!(std::fs::read_to_string(&file).unwrap_or_default(), page());
}

#[test]
fn each_metric_has_a_name_of_its_kind() {
    for metric in crate::all_metrics() {
        let is_counter = metric.kind == crate::metric::Kind::Counter;
        assert_eq!(metric.name.ends_with("_total"), is_counter, "{}", metric.name);
        assert!(metric.name.starts_with("blaze_") && metric.help.ends_with('.'), "{}", metric.name);
    }
}
