//! Answers of writes: made from the states before and after, and kept as JSON for requests that
//! come twice.

use std::sync::Arc;

use blaze_domain::config::diff::{Delta, document_diff};
use blaze_domain::config::{Document, Key, Timestamp};
use blaze_domain::{InstanceName, LayerName, NodeName, ServiceName};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::affected;
use super::evaluate::Evaluated;
use super::types::{ApplyAction, ApplyReport, ApplyResult, Place, Written};
use super::view::View;
use blaze_domain::config::effective::ConfigTarget;
use blaze_domain::config::state::State;

/// Places that are named in an answer.
const MAX_AFFECTED: usize = 1000;
/// Bytes of an answer that is kept whole. It is written beside the commit, where a store takes no
/// text of any size.
const MAX_KEPT_BYTES: usize = 4 * 1024 * 1024;

/// What a request did, and to what.
#[derive(Debug, Clone)]
pub(crate) struct Done {
    /// Of the commit; the present one if nothing changed.
    pub(crate) revision: u64,
    pub(crate) before: State,
    pub(crate) evaluated: Evaluated,
    /// Who asked, as far as the answer may tell.
    pub(crate) view: View,
    /// Places of each state that are looked at for `affected`, at most.
    pub(crate) places: usize,
}

/// What kind of answer a request gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum AnswerKind {
    /// The document of the first item.
    Document,
    /// All documents, differences, who is affected.
    Report,
}

impl Done {
    /// The first document after a write of one.
    pub(crate) fn written(&self) -> Option<Written> {
        let (key, action) = self.evaluated.results.first()?;
        let held = self.evaluated.after.get(key)?;
        Some(Written {
            document: Arc::clone(&held.shown),
            created: *action == ApplyAction::Created,
        })
    }

    /// The answer of `apply` and `revert`.
    pub(crate) fn report(&self, dry_run: bool) -> ApplyReport {
        let results = self.evaluated.results.iter().map(|(key, action)| {
            let (was, is) = (self.before.get(key), self.evaluated.after.get(key));
            let shown = |held: Option<&Arc<blaze_domain::config::state::Held>>| {
                held.map(|held| Arc::clone(&held.shown))
            };
            let (was, is) = (shown(was), shown(is));
            let revision = match (action, &is, &was) {
                (ApplyAction::Unchanged, Some(document), _) => document.revision,
                (ApplyAction::Unchanged, None, _) => 0,
                _ => self.revision,
            };
            ApplyResult {
                key: key.clone(),
                action: *action,
                revision: if dry_run {
                    is.as_ref()
                        .or(was.as_ref())
                        .map_or(0, |d| d.revision.min(self.before.revision()))
                } else {
                    revision
                },
                changes: match action {
                    ApplyAction::Unchanged => Vec::new(),
                    _ => document_diff(was.as_deref(), is.as_deref()),
                },
            }
        });
        let results = results.collect();
        let keys: Vec<Key> =
            self.evaluated.changes.iter().map(|change| change.document.key.clone()).collect();
        let affected =
            affected::changed(&self.before, &self.evaluated.after, &keys, &self.view, self.places);
        ApplyReport {
            dry_run,
            revision: if dry_run { self.before.revision() } else { self.revision },
            results,
            affected_total: affected.len() as u64,
            affected: affected.into_iter().take(MAX_AFFECTED).map(place).collect(),
        }
    }

    /// The answer as it is kept for a request that comes again; a large one without what changed.
    pub(crate) fn to_text(&self, kind: AnswerKind) -> String {
        match kind {
            AnswerKind::Document => {
                self.written().map(|written| written_text(&written)).unwrap_or_default()
            }
            AnswerKind::Report => {
                let mut report = self.report(false);
                let text = report_text(&report);
                if text.len() <= MAX_KEPT_BYTES {
                    return text;
                }
                report.results.iter_mut().for_each(|result| result.changes.clear());
                report_text(&report)
            }
        }
    }
}

pub(crate) fn place(at: ConfigTarget) -> Place {
    Place {
        service: at.service,
        instance: at.instance.as_ref().map(InstanceName::from),
        layer: at.layer,
        node: at.node,
    }
}

fn written_text(written: &Written) -> String {
    json!({ "created": written.created, "document": written.document.to_json() }).to_string()
}

/// A document's answer that was kept.
pub(crate) fn written_from(text: &str) -> Option<Written> {
    let value: Value = serde_json::from_str(text).ok()?;
    Some(Written {
        created: value.get("created")?.as_bool()?,
        document: Arc::new(document_from(value.get("document")?)?),
    })
}

fn document_from(value: &Value) -> Option<Document> {
    let text = |name: &str| value.get(name).and_then(Value::as_str);
    let time = |name: &str| text(name)?.parse::<Timestamp>().ok();
    let labels = |name: &str| {
        let members = value.get(name)?.as_object()?;
        members
            .iter()
            .map(|(name, value)| Some((name.clone(), value.as_str()?.to_owned())))
            .collect::<Option<_>>()
    };
    let service: Option<ServiceName> = match text("service") {
        Some(service) => Some(service.parse().ok()?),
        None => None,
    };
    Some(Document {
        key: Key::new(text("kind")?.parse().ok()?, service, text("name")?.parse().ok()?).ok()?,
        uid: text("uid")?.to_owned(),
        revision: value.get("revision")?.as_u64()?,
        create_time: time("create_time")?,
        update_time: time("update_time")?,
        updated_by: text("updated_by")?.to_owned(),
        labels: labels("labels")?,
        annotations: labels("annotations")?,
        spec: Arc::new(value.get("spec")?.clone()),
        status: value.get("status").cloned(),
    })
}

type KeptPlace = (Option<ServiceName>, Option<InstanceName>, Option<LayerName>, Option<NodeName>);

/// An answer of `apply` as it is kept.
#[derive(Serialize, Deserialize)]
struct Kept {
    revision: u64,
    results: Vec<KeptResult>,
    affected: Vec<KeptPlace>,
    affected_total: u64,
}

#[derive(Serialize, Deserialize)]
struct KeptResult {
    key: String,
    action: ApplyAction,
    revision: u64,
    changes: Vec<Value>,
}

fn report_text(report: &ApplyReport) -> String {
    let result = |result: &ApplyResult| KeptResult {
        key: result.key.to_string(),
        action: result.action,
        revision: result.revision,
        changes: result.changes.iter().map(Delta::to_json).collect(),
    };
    let places = report.affected.iter().cloned();
    let kept = Kept {
        revision: report.revision,
        results: report.results.iter().map(result).collect(),
        affected: places.map(|at| (at.service, at.instance, at.layer, at.node)).collect(),
        affected_total: report.affected_total,
    };
    json!(kept).to_string()
}

/// An answer of `apply` that was kept.
pub(crate) fn report_from(text: &str) -> Option<ApplyReport> {
    let kept: Kept = serde_json::from_str(text).ok()?;
    let result = |result: KeptResult| {
        Some(ApplyResult {
            key: result.key.parse().ok()?,
            action: result.action,
            revision: result.revision,
            changes: result.changes.iter().map(Delta::from_json).collect::<Option<_>>()?,
        })
    };
    let place = |(service, instance, layer, node)| Place { service, instance, layer, node };
    Some(ApplyReport {
        dry_run: false,
        revision: kept.revision,
        results: kept.results.into_iter().map(result).collect::<Option<_>>()?,
        affected: kept.affected.into_iter().map(place).collect(),
        affected_total: kept.affected_total,
    })
}
