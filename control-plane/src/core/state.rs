//! All documents at one revision. A clone shares everything and costs nothing, so that readers keep one as long as they
//! like while commits go on.

use std::collections::BTreeSet;
use std::ops::Bound;
use std::sync::Arc;

use blaze_domain::config::{Document, Key, Kind, secret};
use blaze_domain::{DocumentName, LayerName, NodeName, ServiceName};
use imbl::{OrdMap, OrdSet};

use super::placement::{Placement, is_active, placement, rollout_target};
use crate::store::{Change, Commit, Op};

/// Documents larger than this make an effective configuration that is too large possible (four documents are merged, each
/// perhaps with the change of a roll-out).
const BIG_BYTES: usize = blaze_domain::config::MAX_EFFECTIVE_BYTES / 8;

/// A document as it is kept in memory.
#[derive(Debug, PartialEq)]
pub(crate) struct Held {
    /// As in the store, secrets encrypted.
    pub(crate) document: Arc<Document>,
    /// As users see it, secrets redacted; the same one if it has none.
    pub(crate) shown: Arc<Document>,
    /// Bytes of its spec as compact JSON.
    pub(crate) bytes: usize,
}

impl Held {
    pub(crate) fn new(document: Arc<Document>) -> Self {
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
pub(crate) fn tries_schema(rollout: &Document) -> bool {
    let schema = rollout.spec_member("patch").and_then(|patch| patch.get("schema"));
    schema.is_some_and(|schema| !schema.is_null())
}

/// The document as users see it.
pub(crate) fn redacted(document: &Arc<Document>) -> Arc<Document> {
    let status_has = document.status.as_ref().is_some_and(secret::contains);
    if !secret::contains(&document.spec) && !status_has {
        return Arc::clone(document);
    }
    let mut shown = (**document).clone();
    shown.spec = Arc::new(secret::redact(&document.spec).into_owned());
    shown.status = document
        .status
        .as_ref()
        .map(|status| secret::redact(status).into_owned());
    Arc::new(shown)
}

/// All documents at one revision.
#[derive(Debug, Clone, Default)]
pub(crate) struct State {
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

/// What one commit did to one document, as far as watchers care.
#[derive(Debug, Clone)]
pub(crate) struct Effect {
    /// The document before and where it counted; `None` if it did not exist.
    pub(crate) before: Option<(Arc<Document>, Placement)>,
    /// The same after.
    pub(crate) after: Option<(Arc<Document>, Placement)>,
    /// The document itself did not change, only where it counts.
    pub(crate) moved_only: bool,
}

impl State {
    /// A state from documents.
    pub(crate) fn new(revision: u64, documents: impl IntoIterator<Item = Document>) -> Self {
        let mut state = Self {
            revision,
            ..Self::default()
        };
        for document in documents {
            state.put(Arc::new(document));
        }
        state
    }

    /// The newest commit that is part of it.
    pub(crate) fn revision(&self) -> u64 {
        self.revision
    }

    /// How many documents there are.
    pub(crate) fn len(&self) -> usize {
        self.documents.len()
    }

    /// One document.
    pub(crate) fn get(&self, key: &Key) -> Option<&Arc<Held>> {
        self.documents.get(key)
    }

    /// Documents of a kind, in the order of their keys, those after a key.
    pub(crate) fn of_kind<'a>(
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
    pub(crate) fn all(&self) -> impl Iterator<Item = (&Key, &Arc<Held>)> {
        self.documents.iter()
    }

    /// Instances of a service.
    pub(crate) fn instances<'a>(
        &'a self,
        service: &ServiceName,
    ) -> impl Iterator<Item = (&'a Key, &'a Arc<Held>)> + use<'a> {
        let service = service.clone();
        let start = Key::instance(service.clone(), first_name());
        self.documents
            .range::<_, Key>(start..)
            .take_while(move |(key, _)| key.kind() == Kind::Instance && key.service_name() == Some(&service))
    }

    /// Nodes of a layer and instances placed on it directly.
    pub(crate) fn in_layer<'a>(&'a self, layer: &LayerName) -> impl Iterator<Item = &'a Key> + use<'a> {
        indexed(&self.in_layer, layer.into())
    }

    /// Instances placed on a node.
    pub(crate) fn on_node<'a>(&'a self, node: &NodeName) -> impl Iterator<Item = &'a Key> + use<'a> {
        indexed(&self.on_node, node.into())
    }

    /// Roll-outs of a document, also those that have ended.
    fn aimed_at<'a>(&'a self, target: &Key) -> impl Iterator<Item = &'a Key> + use<'a> {
        of_target(&self.aimed, target.clone())
    }

    /// Roll-outs of a document that are on their canaries now.
    pub(crate) fn active_on<'a>(&'a self, target: &Key) -> impl Iterator<Item = &'a Arc<Held>> + use<'a> {
        of_target(&self.active, target.clone()).filter_map(|key| self.documents.get(key))
    }

    /// Whether an effective configuration can be too large at all.
    pub(crate) fn has_big(&self) -> bool {
        self.big > 0
    }

    /// Whether any service has a schema, be it on canaries alone.
    pub(crate) fn has_schemas(&self) -> bool {
        self.schemas > 0
    }

    /// Whether this one has.
    pub(crate) fn has_schema(&self, service: &ServiceName) -> bool {
        let key = Key::service(service);
        self.get(&key).is_some_and(|held| held.has_schema()) || self.active_on(&key).any(|held| held.has_schema())
    }

    /// Puts a document, in place of the one of the same key.
    pub(crate) fn put(&mut self, document: Arc<Document>) {
        let held = Arc::new(Held::new(document));
        self.remove(&held.document.key);
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
        self.documents.insert(held.document.key.clone(), held);
    }

    /// Takes a document away.
    pub(crate) fn remove(&mut self, key: &Key) -> Option<Arc<Held>> {
        let held = self.documents.remove(key)?;
        for (index, entry) in index_entries(&held.document) {
            self.index(index).remove(&entry);
        }
        if let Some(entry) = aim(&held.document) {
            self.active.remove(&entry);
            self.aimed.remove(&entry);
        }
        self.big -= usize::from(held.is_big());
        self.schemas -= usize::from(held.has_schema());
        Some(held)
    }

    fn index(&mut self, index: Index) -> &mut OrdSet<(DocumentName, Key)> {
        match index {
            Index::Layer => &mut self.in_layer,
            Index::Node => &mut self.on_node,
        }
    }

    /// Applies changes as one revision.
    pub(crate) fn advance(&mut self, revision: u64, changes: &[Change]) {
        for change in changes {
            match change.op {
                Op::Delete => {
                    self.remove(&change.document.key);
                }
                Op::Create | Op::Update | Op::Rollback => self.put(Arc::clone(&change.document)),
            }
        }
        self.revision = revision;
    }

    /// Applies a commit and says what it did, also to documents that only moved with another.
    pub(crate) fn apply(&mut self, commit: &Commit) -> Vec<Effect> {
        let before = self.clone();
        self.advance(commit.revision, &commit.changes);
        let seen = |state: &Self, key: &Key| {
            let held = state.get(key)?;
            Some((Arc::clone(&held.shown), placement(state, &held.document)))
        };
        let mut effects: Vec<Effect> = Vec::with_capacity(commit.changes.len());
        for change in &commit.changes {
            let key = &change.document.key;
            effects.push(Effect {
                before: seen(&before, key),
                after: seen(self, key),
                moved_only: false,
            });
        }
        for key in moved_with(&before, self, commit) {
            let (was, is) = (seen(&before, &key), seen(self, &key));
            let changed = match (&was, &is) {
                (Some((_, was)), Some((_, is))) => was != is,
                _ => false,
            };
            if changed {
                effects.push(Effect {
                    before: was,
                    after: is,
                    moved_only: true,
                });
            }
        }
        effects
    }

    /// The documents that a commit is about to change, as they are now.
    pub(crate) fn originals(&self, commit: &Commit) -> Vec<(Key, Option<Arc<Document>>)> {
        let keys = commit.changes.iter().map(|change| &change.document.key);
        keys.map(|key| (key.clone(), self.get(key).map(|held| Arc::clone(&held.document))))
            .collect()
    }

    /// Goes back to what documents were before a commit.
    pub(crate) fn undo(&mut self, originals: &[(Key, Option<Arc<Document>>)], revision: u64) {
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
    pub(crate) fn overlay(&mut self, revision: u64, documents: Vec<(Key, Option<Document>)>) {
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
    index
        .range(start..)
        .take_while(move |(found, _)| *found == target)
        .map(|(_, key)| key)
}

fn index_entries(document: &Document) -> Vec<(Index, (DocumentName, Key))> {
    let entry = |index, name: Option<&str>| {
        let name: DocumentName = name?.parse().ok()?;
        Some((index, (name, document.key.clone())))
    };
    [
        entry(Index::Layer, document.spec_layer()),
        entry(Index::Node, document.spec_node()),
    ]
    .into_iter()
    .flatten()
    .collect()
}

fn indexed(index: &OrdSet<(DocumentName, Key)>, name: DocumentName) -> impl Iterator<Item = &Key> + use<'_> {
    let start = (name.clone(), first_key(Kind::Layer));
    index
        .range(start..)
        .take_while(move |(found, _)| *found == name)
        .map(|(_, key)| key)
}

/// No name comes before it: `0` is the first character of the alphabet of names that may stand at the beginning.
fn first_name() -> DocumentName {
    (&blaze_domain::InstanceName::first()).into()
}

fn first_key(kind: Kind) -> Key {
    let service = (kind == Kind::Instance).then(|| ServiceName::from(&first_name()));
    // With a service exactly for instances this cannot fail; `rollout` is only there to have a value.
    Key::new(kind, service, first_name()).unwrap_or_else(|_| Key::rollout(first_name()))
}

/// Documents that may count elsewhere although they did not change: instances with their node or service, roll-outs with
/// their target.
fn moved_with(before: &State, after: &State, commit: &Commit) -> Vec<Key> {
    let keys: BTreeSet<&Key> = commit.changes.iter().map(|change| &change.document.key).collect();
    let mut out: Vec<Key> = Vec::new();
    for change in &commit.changes {
        let key = &change.document.key;
        let is_moved = match (before.get(key), after.get(key)) {
            (Some(was), Some(is)) => placement(before, &was.document) != placement(after, &is.document),
            _ => true,
        };
        if !is_moved {
            continue;
        }
        match key.kind() {
            Kind::Node => out.extend(after.on_node(&NodeName::from(key.name())).cloned()),
            Kind::Service => out.extend(
                after
                    .instances(&ServiceName::from(key.name()))
                    .map(|(key, _)| key.clone()),
            ),
            Kind::Layer | Kind::Instance | Kind::Rollout => {}
        }
    }
    let touched = keys.iter().copied().chain(&out);
    let rollouts: BTreeSet<Key> = touched.flat_map(|target| after.aimed_at(target)).cloned().collect();
    out.extend(rollouts);
    out.retain(|key| !keys.contains(key));
    out.sort();
    out.dedup();
    out
}
