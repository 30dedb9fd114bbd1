//! Which documents refer to which.

use blaze_domain::config::{Code, Document, FieldFault, Key, Kind, spec};
use blaze_domain::{LayerName, NodeName, ServiceName};

use blaze_domain::config::state::State;

/// References of a document to what does not exist, at most so many.
pub(crate) fn missing(state: &State, key: &Key, most: usize) -> Vec<FieldFault> {
    state.get(key).map(|held| missing_of(state, &held.document, most)).unwrap_or_default()
}

/// The same of a document that need not be part of the state.
pub(crate) fn missing_of(state: &State, document: &Document, most: usize) -> Vec<FieldFault> {
    spec::references(document)
        .into_iter()
        .filter(|(_, target)| state.get(target).is_none())
        // Before a near name is looked for, which takes longer than all the rest.
        .take(most)
        .map(|(pointer, target)| FieldFault {
            pointer,
            code: Code::ReferenceNotFound,
            detail: format!("there is no {target}{}", suggestion(state, &target)),
            document: None,
        })
        .collect()
}

/// `; did you mean Service/slam?` if there is a name that is nearly the same.
fn suggestion(state: &State, target: &Key) -> String {
    let name = target.name().as_str();
    let near = state
        .of_kind(target.kind(), None)
        .take(1000)
        .filter(|(key, _)| key.service_name() == target.service_name())
        .filter(|(key, _)| key.name().as_str().len().abs_diff(name.len()) <= 2)
        .map(|(key, _)| (strsim::damerau_levenshtein(key.name().as_str(), name), key))
        .min_by_key(|(distance, _)| *distance);
    match near {
        Some((distance, key)) if distance <= 2 => format!("; did you mean {key}?"),
        _ => String::new(),
    }
}

/// Documents that refer to one, in the order of their keys; at most `limit`. A roll-out that has
/// ended is history and holds nobody back.
pub(crate) fn referrers(state: &State, key: &Key, limit: usize) -> Vec<Key> {
    let mut out: Vec<Key> = Vec::new();
    match key.kind() {
        Kind::Layer => {
            let layer = LayerName::from(key.name());
            out.extend(state.in_layer(&layer).take(limit).cloned());
            let services = state.of_kind(Kind::Service, None).filter(|(_, held)| {
                held.document.spec_member("layers").is_some()
                    && held.document.is_for_layer(layer.as_str())
            });
            out.extend(services.take(limit).map(|(key, _)| key.clone()));
        }
        Kind::Node => out.extend(state.on_node(&NodeName::from(key.name())).take(limit).cloned()),
        Kind::Service => {
            let instances = state.instances(&ServiceName::from(key.name()));
            out.extend(instances.take(limit).map(|(key, _)| key.clone()));
        }
        Kind::Instance | Kind::Rollout => {}
    }
    let rollouts = state.active_on(key).take(limit);
    out.extend(rollouts.map(|held| held.document.key.clone()));
    out.sort();
    out.truncate(limit);
    out
}
