//! All documents at one revision. A clone shares everything and costs nothing, so that readers keep
//! one as long as they like while commits go on.

use std::collections::BTreeSet;
use std::ops::Bound;
use std::sync::Arc;

use imbl::{OrdMap, OrdSet};

use super::placement::{Placement, is_active, placement, rollout_target};
use super::{Document, Key, Kind, MAX_EFFECTIVE_BYTES, secret};
use crate::{DocumentName, InstanceName, LayerName, NodeName, ServiceName};

/// Documents larger than this make an effective configuration that is too large possible (four
/// documents are merged, each perhaps with the change of a roll-out).
const BIG_BYTES: usize = MAX_EFFECTIVE_BYTES / 8;

/// A document as it is kept in memory.
#[derive(Debug, PartialEq)]
pub struct Held {
    /// As in the store, secrets encrypted.
    pub document: Arc<Document>,
    /// As users see it, secrets redacted; the same one if it has none.
    pub shown: Arc<Document>,
    /// Bytes of its spec as compact JSON.
    pub bytes: usize,
}

impl Held {
    /// The document, and what users see of it.
    #[must_use]
    pub fn new(document: Arc<Document>) -> Self {
        let shown = redacted(&document);
        let bytes = serde_json::to_string(&*document.spec).map_or(0, |text| text.len());
        Self { document, shown, bytes }
    }

    fn is_big(&self) -> bool {
        self.bytes > BIG_BYTES
    }

    /// A service's, or one that a roll-out tries.
    fn has_schema(&self) -> bool {
        let document = &self.document;
        match document.key.kind() {
            Kind::Service => document.spec_member("schema").is_some(),
            Kind::Rollout => is_active(document) && tries_schema(document),
            Kind::Layer | Kind::Node | Kind::Instance => false,
        }
    }
}

/// Whether the change of a roll-out brings a schema.
#[must_use]
pub fn tries_schema(rollout: &Document) -> bool {
    let schema = rollout.spec_member("patch").and_then(|patch| patch.get("schema"));
    schema.is_some_and(|schema| !schema.is_null())
}

/// The document as users see it.
#[must_use]
pub fn redacted(document: &Arc<Document>) -> Arc<Document> {
    let status_has = document.status.as_ref().is_some_and(secret::contains);
    if !secret::contains(&document.spec) && !status_has {
        return Arc::clone(document);
    }
    let mut shown = (**document).clone();
    shown.spec = Arc::new(secret::redact(&document.spec).into_owned());
    shown.status = document.status.as_ref().map(|status| secret::redact(status).into_owned());
    Arc::new(shown)
}

/// All documents at one revision.
#[derive(Debug, Clone, Default)]
pub struct State {
    revision: u64,
    documents: OrdMap<Key, Arc<Held>>,
    /// Nodes of a layer, and instances placed on it directly.
    in_layer: OrdSet<(DocumentName, Key)>,
    /// Instances placed on a node.
    on_node: OrdSet<(DocumentName, Key)>,
    /// Roll-outs by what they change, also those that have ended.
    aimed: OrdSet<(Key, Key)>,
    /// The same, those that are on their canaries now.
    active: OrdSet<(Key, Key)>,
    /// Documents that are large enough to matter for the size of effective configurations.
    big: usize,
    /// Services with a schema, and roll-outs that try one now.
    schemas: usize,
}

/// What a commit does to one document.
#[derive(Debug, Clone, PartialEq)]
pub enum Step {
    /// It is this from now on.
    Put(Arc<Document>),
    /// It is gone.
    Remove(Key),
}

impl Step {
    /// Which document.
    #[must_use]
    pub fn key(&self) -> &Key {
        match self {
            Self::Put(document) => &document.key,
            Self::Remove(key) => key,
        }
    }
}

/// What one commit did to one document, as far as watchers care.
#[derive(Debug, Clone)]
pub struct Effect {
    /// The document before and where it counted; `None` if it did not exist.
    pub before: Option<(Arc<Held>, Placement)>,
    /// The same after.
    pub after: Option<(Arc<Held>, Placement)>,
    /// The document itself did not change, only where it counts.
    pub moved_only: bool,
}

impl State {
    /// A state from documents.
    #[must_use]
    pub fn new(revision: u64, documents: impl IntoIterator<Item = Document>) -> Self {
        let mut state = Self { revision, ..Self::default() };
        for document in documents {
            state.put(Arc::new(document));
        }
        state
    }

    /// The newest commit that is part of it.
    #[must_use]
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// How many documents there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.documents.len()
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.documents.is_empty()
    }

    /// One document.
    #[must_use]
    pub fn get(&self, key: &Key) -> Option<&Arc<Held>> {
        self.documents.get(key)
    }

    /// Documents of a kind, in the order of their keys, those after a key.
    pub fn of_kind<'a>(
        &'a self,
        kind: Kind,
        after: Option<&Key>,
    ) -> impl Iterator<Item = (&'a Key, &'a Arc<Held>)> + use<'a> {
        let start = match after {
            Some(key) => Bound::Excluded(key.clone()),
            None => Bound::Included(first_key(kind)),
        };
        let range = self.documents.range::<_, Key>((start, Bound::Unbounded));
        range.take_while(move |(key, _)| key.kind() == kind)
    }

    /// All documents, in the order of their keys.
    pub fn all(&self) -> impl Iterator<Item = (&Key, &Arc<Held>)> {
        self.documents.iter()
    }

    /// Instances of a service.
    pub fn instances<'a>(
        &'a self,
        service: &ServiceName,
    ) -> impl Iterator<Item = (&'a Key, &'a Arc<Held>)> + use<'a> {
        let service = service.clone();
        let start = Key::instance(service.clone(), first_name());
        self.documents.range::<_, Key>(start..).take_while(move |(key, _)| {
            key.kind() == Kind::Instance && key.service_name() == Some(&service)
        })
    }

    /// Nodes of a layer and instances placed on it directly.
    pub fn in_layer<'a>(&'a self, layer: &LayerName) -> impl Iterator<Item = &'a Key> + use<'a> {
        indexed(&self.in_layer, layer.into())
    }

    /// Instances placed on a node.
    pub fn on_node<'a>(&'a self, node: &NodeName) -> impl Iterator<Item = &'a Key> + use<'a> {
        indexed(&self.on_node, node.into())
    }

    /// Roll-outs of a document, also those that have ended.
    fn aimed_at<'a>(&'a self, target: &Key) -> impl Iterator<Item = &'a Key> + use<'a> {
        of_target(&self.aimed, target.clone())
    }

    /// Roll-outs of a document that are on their canaries now.
    pub fn active_on<'a>(&'a self, target: &Key) -> impl Iterator<Item = &'a Arc<Held>> + use<'a> {
        of_target(&self.active, target.clone()).filter_map(|key| self.documents.get(key))
    }

    /// Whether an effective configuration can be too large at all.
    #[must_use]
    pub fn has_big(&self) -> bool {
        self.big > 0
    }

    /// Whether any service has a schema, be it on canaries alone.
    #[must_use]
    pub fn has_schemas(&self) -> bool {
        self.schemas > 0
    }

    /// Whether this one has.
    #[must_use]
    pub fn has_schema(&self, service: &ServiceName) -> bool {
        let key = Key::service(service);
        self.get(&key).is_some_and(|held| held.has_schema())
            || self.active_on(&key).any(|held| held.has_schema())
    }

    /// Puts a document, in place of the one of the same key.
    pub fn put(&mut self, document: Arc<Document>) {
        let held = Arc::new(Held::new(document));
        // Replaced where it stands: to take it out first costs as much again.
        if let Some(before) = self.documents.insert(held.document.key.clone(), Arc::clone(&held)) {
            self.forget(&before);
        }
        for (index, entry) in index_entries(&held.document) {
            self.index(index).insert(entry);
        }
        if let Some(entry) = aim(&held.document) {
            if is_active(&held.document) {
                self.active.insert(entry.clone());
            }
            self.aimed.insert(entry);
        }
        self.big += usize::from(held.is_big());
        self.schemas += usize::from(held.has_schema());
    }

    /// Takes a document away.
    pub fn remove(&mut self, key: &Key) -> Option<Arc<Held>> {
        let held = self.documents.remove(key)?;
        self.forget(&held);
        Some(held)
    }

    /// Takes away what is known of a document besides itself.
    fn forget(&mut self, held: &Held) {
        for (index, entry) in index_entries(&held.document) {
            self.index(index).remove(&entry);
        }
        if let Some(entry) = aim(&held.document) {
            self.active.remove(&entry);
            self.aimed.remove(&entry);
        }
        self.big -= usize::from(held.is_big());
        self.schemas -= usize::from(held.has_schema());
    }

    fn index(&mut self, index: Index) -> &mut OrdSet<(DocumentName, Key)> {
        match index {
            Index::Layer => &mut self.in_layer,
            Index::Node => &mut self.on_node,
        }
    }

    /// Takes one step; [`State::advance`] sets the revision.
    fn step(&mut self, step: &Step) {
        match step {
            Step::Put(document) => self.put(Arc::clone(document)),
            Step::Remove(key) => {
                self.remove(key);
            }
        }
    }

    /// Applies the steps of one commit.
    pub fn advance(&mut self, revision: u64, steps: impl IntoIterator<Item = Step>) {
        for step in steps {
            self.step(&step);
        }
        self.revision = revision;
    }

    /// Applies a commit, each step of another document, and says what it did, also to documents
    /// that only moved with another.
    pub fn apply(&mut self, revision: u64, steps: impl IntoIterator<Item = Step>) -> Vec<Effect> {
        let before = self.clone();
        let mut keys: Vec<Key> = Vec::new();
        for step in steps {
            self.step(&step);
            keys.push(step.key().clone());
        }
        self.revision = revision;
        let seen = |state: &Self, key: &Key| {
            let held = state.get(key)?;
            Some((Arc::clone(held), placement(state, &held.document)))
        };
        let mut effects: Vec<Effect> = Vec::with_capacity(keys.len());
        for key in &keys {
            effects.push(Effect {
                before: seen(&before, key),
                after: seen(self, key),
                moved_only: false,
            });
        }
        for key in moved_with(&before, self, &keys) {
            let (was, is) = (seen(&before, &key), seen(self, &key));
            let changed = match (&was, &is) {
                (Some((_, was)), Some((_, is))) => was != is,
                _ => false,
            };
            if changed {
                effects.push(Effect { before: was, after: is, moved_only: true });
            }
        }
        effects
    }

    /// Documents as they are now, to go back to with [`State::undo`].
    #[must_use]
    pub fn originals<'k>(
        &self,
        keys: impl IntoIterator<Item = &'k Key>,
    ) -> Vec<(Key, Option<Arc<Document>>)> {
        keys.into_iter()
            .map(|key| (key.clone(), self.get(key).map(|held| Arc::clone(&held.document))))
            .collect()
    }

    /// Goes back to what documents were before a commit.
    pub fn undo(&mut self, originals: &[(Key, Option<Arc<Document>>)], revision: u64) {
        for (key, original) in originals {
            match original {
                Some(document) => self.put(Arc::clone(document)),
                None => {
                    self.remove(key);
                }
            }
        }
        self.revision = revision;
    }

    /// Replaces what documents were, for the state at an older revision.
    pub fn overlay(&mut self, revision: u64, documents: Vec<(Key, Option<Document>)>) {
        for (key, document) in documents {
            match document {
                Some(document) => self.put(Arc::new(document)),
                None => {
                    self.remove(&key);
                }
            }
        }
        self.revision = revision;
    }
}

#[derive(Clone, Copy)]
enum Index {
    Layer,
    Node,
}

/// A roll-out with what it changes.
fn aim(document: &Document) -> Option<(Key, Key)> {
    if document.key.kind() != Kind::Rollout {
        return None;
    }
    Some((rollout_target(document)?, document.key.clone()))
}

fn of_target(index: &OrdSet<(Key, Key)>, target: Key) -> impl Iterator<Item = &Key> + use<'_> {
    let start = (target.clone(), first_key(Kind::Layer));
    index.range(start..).take_while(move |(found, _)| *found == target).map(|(_, key)| key)
}

fn index_entries(document: &Document) -> Vec<(Index, (DocumentName, Key))> {
    let entry = |index, name: Option<&str>| {
        let name: DocumentName = name?.parse().ok()?;
        Some((index, (name, document.key.clone())))
    };
    [entry(Index::Layer, document.spec_layer()), entry(Index::Node, document.spec_node())]
        .into_iter()
        .flatten()
        .collect()
}

fn indexed(
    index: &OrdSet<(DocumentName, Key)>,
    name: DocumentName,
) -> impl Iterator<Item = &Key> + use<'_> {
    let start = (name.clone(), first_key(Kind::Layer));
    index.range(start..).take_while(move |(found, _)| *found == name).map(|(_, key)| key)
}

/// No name comes before it: `0` is the first character of the alphabet of names that may stand at
/// the beginning.
fn first_name() -> DocumentName {
    (&InstanceName::first()).into()
}

fn first_key(kind: Kind) -> Key {
    let service = (kind == Kind::Instance).then(|| ServiceName::from(&first_name()));
    // With a service exactly for instances this cannot fail; `rollout` is only there to have a
    // value.
    Key::new(kind, service, first_name()).unwrap_or_else(|_| Key::rollout(first_name()))
}

/// Documents that may count elsewhere although they did not change: instances with their node or
/// service, roll-outs with their target.
fn moved_with(before: &State, after: &State, changed: &[Key]) -> Vec<Key> {
    let keys: BTreeSet<&Key> = changed.iter().collect();
    let mut out: Vec<Key> = Vec::new();
    for key in changed {
        let is_moved = match (before.get(key), after.get(key)) {
            (Some(was), Some(is)) => {
                placement(before, &was.document) != placement(after, &is.document)
            }
            _ => true,
        };
        if !is_moved {
            continue;
        }
        match key.kind() {
            Kind::Node => out.extend(after.on_node(&NodeName::from(key.name())).cloned()),
            Kind::Service => out.extend(
                after.instances(&ServiceName::from(key.name())).map(|(key, _)| key.clone()),
            ),
            Kind::Layer | Kind::Instance | Kind::Rollout => {}
        }
    }
    let touched = keys.iter().copied().chain(&out);
    let rollouts: BTreeSet<Key> =
        touched.flat_map(|target| after.aimed_at(target)).cloned().collect();
    out.extend(rollouts);
    out.retain(|key| !keys.contains(key));
    out.sort();
    out.dedup();
    out
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn documents(specs: [Value; 4], phase: &str) -> Vec<Document> {
        let keys = ["Node/n", "Instance/s/i", "Service/s", "Rollout/r"];
        let new = |(key, spec): (&str, Value)| Document::new(key.parse().unwrap(), spec);
        let mut all: Vec<Document> = keys.into_iter().zip(specs).map(new).collect();
        all[3].status = Some(json!({ "phase": phase }));
        all
    }

    #[test]
    fn what_is_put_again_leaves_nothing_of_before() {
        let target = json!({ "target": { "kind": "Service", "name": "s" } });
        let large = json!({ "config": { "text": "x".repeat(2 * BIG_BYTES) }, "schema": {} });
        let states = [
            documents(
                [json!({ "layer": "a" }), json!({ "layer": "a" }), json!({}), target],
                "canary",
            ),
            documents(
                [
                    json!({ "layer": "a", "config": {} }),
                    json!({ "node": "n" }),
                    large,
                    json!({ "target": { "kind": "Service", "name": "t" } }),
                ],
                "aborted",
            ),
        ];
        let shown = |state: &State| {
            format!(
                "{:?} {:?} {:?} {:?} {} {}",
                state.in_layer, state.on_node, state.aimed, state.active, state.big, state.schemas
            )
        };
        let mut state = State::new(1, states[0].clone());
        for documents in [&states[1], &states[0], &states[0], &states[1]] {
            state.advance(2, documents.iter().cloned().map(Arc::new).map(Step::Put));
            assert_eq!(shown(&state), shown(&State::new(2, documents.clone())));
        }
        state.advance(3, states[1].iter().map(|document| Step::Remove(document.key.clone())));
        assert_eq!(shown(&state), shown(&State::new(3, [])));
    }
}
