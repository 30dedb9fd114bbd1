//! Answers of writes: made from the states before and after, and kept as JSON for requests that come twice.

use std::sync::Arc;

use blaze_domain::config::diff::{Delta, document_diff};
use blaze_domain::config::{Document, Key, Timestamp};
use blaze_domain::{InstanceName, LayerName, NodeName, ServiceName};
use serde_json::{Value, json};

use super::affected;
use super::evaluate::Evaluated;
use super::types::{ApplyAction, ApplyReport, ApplyResult, Place, Written};
use super::view::View;
use blaze_domain::config::effective::At;
use blaze_domain::config::state::State;

/// Places that are named in an answer.
const MAX_AFFECTED: usize = 1000;
/// Bytes of an answer that is kept whole. It is written beside the commit, where a store takes no text of any size.
const MAX_KEPT_BYTES: usize = 4 * 1024 * 1024;

/// What a request did, and to what.
#[derive(Debug, Clone)]
pub(crate) struct Done {
    /// Of the commit; the present one if nothing changed.
    pub(crate) revision: u64,
    pub(crate) before: State,
    pub(crate) after: State,
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
        let held = self.after.get(key)?;
        Some(Written {
            document: Arc::clone(&held.shown),
            created: *action == ApplyAction::Created,
        })
    }

    /// The answer of `apply` and `revert`.
    pub(crate) fn report(&self, dry_run: bool) -> ApplyReport {
        let results = self.evaluated.results.iter().map(|(key, action)| {
            let (was, is) = (self.before.get(key), self.after.get(key));
            let shown =
                |held: Option<&Arc<blaze_domain::config::state::Held>>| held.map(|held| Arc::clone(&held.shown));
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
        let keys: Vec<Key> = self
            .evaluated
            .changes
            .iter()
            .map(|change| change.document.key.clone())
            .collect();
        let affected = affected::changed(&self.before, &self.after, &keys, &self.view, self.places);
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
            AnswerKind::Document => self.written().map(|written| written_text(&written)).unwrap_or_default(),
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

pub(crate) fn place(at: At) -> Place {
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

fn report_text(report: &ApplyReport) -> String {
    let results: Vec<Value> = report
        .results
        .iter()
        .map(|result| {
            let changes: Vec<Value> = result.changes.iter().map(Delta::to_json).collect();
            json!({ "key": result.key.to_string(), "action": result.action.as_str(), "revision": result.revision, "changes": changes })
        })
        .collect();
    let affected: Vec<Value> = report
        .affected
        .iter()
        .map(|place| {
            json!([
                place.service.as_ref().map(ServiceName::as_str),
                place.instance.as_ref().map(InstanceName::as_str),
                place.layer.as_ref().map(LayerName::as_str),
                place.node.as_ref().map(NodeName::as_str),
            ])
        })
        .collect();
    json!({ "revision": report.revision, "results": results, "affected": affected, "affected_total": report.affected_total })
        .to_string()
}

/// An answer of `apply` that was kept.
pub(crate) fn report_from(text: &str) -> Option<ApplyReport> {
    let value: Value = serde_json::from_str(text).ok()?;
    let results = value
        .get("results")?
        .as_array()?
        .iter()
        .map(result_from)
        .collect::<Option<_>>()?;
    let affected = value
        .get("affected")?
        .as_array()?
        .iter()
        .map(place_from)
        .collect::<Option<_>>()?;
    Some(ApplyReport {
        dry_run: false,
        revision: value.get("revision")?.as_u64()?,
        results,
        affected,
        affected_total: value.get("affected_total")?.as_u64()?,
    })
}

fn result_from(value: &Value) -> Option<ApplyResult> {
    let actions = [
        ApplyAction::Created,
        ApplyAction::Updated,
        ApplyAction::Deleted,
        ApplyAction::Unchanged,
    ];
    let action = value.get("action")?.as_str()?;
    let changes = value.get("changes")?.as_array()?;
    Some(ApplyResult {
        key: value.get("key")?.as_str()?.parse().ok()?,
        action: actions.into_iter().find(|known| known.as_str() == action)?,
        revision: value.get("revision")?.as_u64()?,
        changes: changes
            .iter()
            .map(blaze_domain::config::diff::Delta::from_json)
            .collect::<Option<_>>()?,
    })
}

fn place_from(value: &Value) -> Option<Place> {
    fn name<T: std::str::FromStr>(value: &Value, index: usize) -> Option<T> {
        value.get(index)?.as_str()?.parse().ok()
    }
    value.is_array().then(|| Place {
        service: name(value, 0),
        instance: name(value, 1),
        layer: name(value, 2),
        node: name(value, 3),
    })
}
