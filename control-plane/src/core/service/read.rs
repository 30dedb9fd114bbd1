//! Reads.

use std::sync::Arc;

use blaze_domain::config::{Code, Document, Key, Kind, Problem};
use blaze_domain::{DocumentName, LayerName, ServiceName};
use serde_json::Value;

use super::super::committer::unavailable;
use super::super::page::Position;
use super::super::report;
use super::super::secrets;
use super::super::types::{
    Answer, Caller, Effective, ListQuery, Page, Place, ReadOptions, WatchQuery,
};
use super::super::view::{may_reveal, view};
use super::super::watch::{Filter, WatchStream, is_in_layer, trimmed};
use super::{ConfigService, WAIT_FOR_REVISION, not_found, selector};
use crate::auth::Right;
use blaze_domain::config::effective::{ConfigTarget, Sources};
use blaze_domain::config::placement::{Placement, placement};
use blaze_domain::config::spec::PROGRAMS;
use blaze_domain::config::state::{State, redacted};

/// Entries of a page unless it is said.
const PAGE: u32 = 100;
/// The same, at most.
const MAX_PAGE: u32 = 1000;
/// A page ends with the document that makes it this large, in bytes of JSON: then it fits into a
/// message of gRPC.
pub(super) const PAGE_BYTES: usize = 8 * 1024 * 1024;
pub(super) fn answer<T>(state: &State, value: T) -> Answer<T> {
    Answer { revision: state.revision(), replayed: false, value }
}

pub(super) fn page_size(limit: Option<u32>) -> Result<usize, Problem> {
    match limit.unwrap_or(PAGE) {
        limit @ 1..=MAX_PAGE => Ok(limit as usize),
        other => Err(Problem::new(
            Code::InvalidRequest,
            format!("limit {other}: 1 to {MAX_PAGE} are allowed"),
        )),
    }
}

impl ConfigService {
    /// The state that a read shows: as new as every write acknowledged before it, unless older data
    /// is allowed.
    pub(super) async fn read_state(&self, read: &ReadOptions) -> Result<State, Problem> {
        // Where nobody else writes, a write is acknowledged after it can be read here.
        if !read.cached && !self.is_newest() {
            self.inner.barrier.revision().await?;
        }
        if let Some(wanted) = read.min_revision {
            self.wait_for(wanted).await?;
        }
        Ok(self.state())
    }

    /// Whether the state in memory is the newest for certain.
    fn is_newest(&self) -> bool {
        let above = self.inner.store.alone();
        above.is_some_and(|above| self.revision() >= above)
    }

    /// Waits up to five seconds until a revision is there.
    async fn wait_for(&self, wanted: u64) -> Result<(), Problem> {
        let mut head = self.inner.log.subscribe();
        let reached = head.wait_for(|revision| *revision >= wanted);
        match tokio::time::timeout(WAIT_FOR_REVISION, reached).await {
            Ok(Ok(_)) => Ok(()),
            _ => {
                let revision = self.revision();
                let detail = format!(
                    "the store is at revision {revision} and did not reach {wanted} within 5 s"
                );
                Err(Problem::new(Code::RevisionUnknown, detail).at(revision))
            }
        }
    }

    /// The state as it was at a revision.
    async fn state_at(&self, now: &State, revision: u64) -> Result<State, Problem> {
        if revision > now.revision() {
            let detail = format!("the store is at revision {}", now.revision());
            return Err(Problem::new(Code::RevisionUnknown, detail).at(now.revision()));
        }
        if revision == now.revision() {
            return Ok(now.clone());
        }
        if revision < self.inner.log.floor() {
            return Err(trimmed(self.inner.log.floor(), now.revision()));
        }
        if let Some(state) = self.inner.log.state_at(revision) {
            return Ok(state);
        }
        let past = self.inner.store.documents_at(revision, now.revision()).await;
        let past = past.map_err(|error| unavailable(&error))?;
        self.check_floor(now, revision).await?;
        let mut state = now.clone();
        state.overlay(revision, past);
        Ok(state)
    }

    /// Refuses a revision below the floor, as the store has it now: another process may have
    /// trimmed, or this one is about it. What was read of the past before is whole if this
    /// succeeds.
    pub(super) async fn check_floor(&self, now: &State, revision: u64) -> Result<(), Problem> {
        let batch = self.inner.store.commits_after(revision, 1).await;
        let floor = batch.map_err(|error| unavailable(&error))?.floor;
        self.inner.log.raise_floor(floor);
        if revision < floor {
            return Err(trimmed(floor, now.revision()));
        }
        Ok(())
    }

    /// The document as it may be shown: redacted, or in clear where that is asked and allowed.
    async fn shown(
        &self,
        caller: &Caller,
        document: &Arc<Document>,
        reveal: bool,
    ) -> Result<Arc<Document>, Problem> {
        if !reveal {
            return Ok(redacted(document));
        }
        self.check_reveal(caller, &[&document.key]).await?;
        let mut clear = (**document).clone();
        clear.spec =
            Arc::new(secrets::revealed(&self.inner.evaluator.keyring, document, &document.spec));
        Ok(Arc::new(clear))
    }

    /// Revealing is for administrators, and audited before it happens.
    async fn check_reveal(&self, caller: &Caller, keys: &[&Key]) -> Result<(), Problem> {
        self.authorize(&caller.claims, Right::Admin)?;
        if !may_reveal(&caller.claims) {
            return Err(Problem::new(Code::PermissionDenied, "only an admin may reveal secrets"));
        }
        let entries: Vec<_> =
            keys.iter().map(|key| Self::entry(caller, "reveal", Some(key))).collect();
        let written = self.inner.store.append_audit(&entries).await;
        written.map_err(|error| unavailable(&error))
    }

    /// One document.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn get(
        &self,
        caller: &Caller,
        key: &Key,
        read: &ReadOptions,
    ) -> Result<Answer<Arc<Document>>, Problem> {
        self.authorize(&caller.claims, Right::Read)?;
        let state = self.read_state(read).await?;
        view(&caller.claims).check_key(&state, key)?;
        if let Some(revision) = read.at_revision {
            let version = self.seen_version(caller, &state, key, revision).await?;
            let document = self.shown(caller, &version.change.document, read.reveal).await?;
            return Ok(answer(&state, document));
        }
        let held = state.get(key).ok_or_else(|| not_found(key, &state))?;
        let document = match read.reveal {
            true => self.shown(caller, &held.document, true).await?,
            false => Arc::clone(&held.shown),
        };
        Ok(answer(&state, self.with_canaries(&state, document)))
    }

    /// Documents by name, bytewise; all pages show the state of the first one.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn list(
        &self,
        caller: &Caller,
        query: &ListQuery,
        read: &ReadOptions,
    ) -> Result<Answer<Page<Arc<Document>>>, Problem> {
        self.authorize(&caller.claims, Right::Read)?;
        let limit = page_size(query.limit)?;
        let labels = query.label_selector.as_deref().map(selector).transpose()?;
        let bound = bound_query(caller, query);
        let position = match query.page_token.as_str() {
            "" => None,
            token => Some(self.inner.pages.position(&bound, token)?),
        };
        let now = self.read_state(read).await?;
        let state = match &position {
            Some(position) => self.state_at(&now, position.revision).await?,
            None => match read.at_revision {
                Some(revision) => self.state_at(&now, revision).await?,
                None => now,
            },
        };
        let after: Option<Key> = match &position {
            Some(position) => Some(position.after.parse().map_err(|_| {
                Problem::new(Code::InvalidPageToken, "the page token is not one of this query")
            })?),
            None => None,
        };
        if let (Some(service), Some(Kind::Instance)) = (&query.service, query.kind) {
            let key = Key::service(service);
            // A service outside the view is refused like one that does not exist.
            view(&caller.claims).check_key(&state, &key)?;
            if state.get(&key).is_none() && position.is_none() {
                return Err(not_found(&key, &state));
            }
        }
        let view = view(&caller.claims);
        let narrow = query.layer.is_some() || query.node.is_some() || view.layer().is_some();
        let matches = |document: &Document| {
            query
                .service
                .as_ref()
                .is_none_or(|service| document.key.service_name() == Some(service))
                && labels.as_ref().is_none_or(|labels| labels.matches(&document.labels))
                && (!narrow
                    || is_placed(&placement(&state, document), document, query)
                        && view.sees_document(&state, document))
        };
        let mut found = found_documents(&state, query.kind, after.as_ref())
            .filter(|(_, held)| matches(&held.document));
        let mut items: Vec<Arc<Document>> = Vec::new();
        let mut bytes = 0;
        for (_, held) in found.by_ref() {
            items.push(Arc::clone(if read.reveal { &held.document } else { &held.shown }));
            bytes += held.bytes;
            if items.len() == limit || bytes >= PAGE_BYTES {
                break;
            }
        }
        let more = found.next().is_some();
        drop(found);
        if read.reveal {
            items = self.reveal_all(caller, items).await?;
        }
        if read.at_revision.is_none() {
            items = items.into_iter().map(|item| self.with_canaries(&state, item)).collect();
        }
        let next = items.last().filter(|_| more).map(|document| Position {
            revision: state.revision(),
            after: document.key.to_string(),
        });
        let page = Page {
            next_page_token: next
                .map(|position| self.inner.pages.token(&bound, &position))
                .unwrap_or_default(),
            items,
        };
        Ok(answer(&state, page))
    }

    async fn reveal_all(
        &self,
        caller: &Caller,
        items: Vec<Arc<Document>>,
    ) -> Result<Vec<Arc<Document>>, Problem> {
        let keys: Vec<&Key> = items.iter().map(|document| &document.key).collect();
        self.check_reveal(caller, &keys).await?;
        let clear = items.iter().map(|document| {
            let mut clear = (**document).clone();
            clear.spec = Arc::new(secrets::revealed(
                &self.inner.evaluator.keyring,
                document,
                &document.spec,
            ));
            Arc::new(clear)
        });
        Ok(clear.collect())
    }

    /// The effective configuration at a place.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn effective(
        &self,
        caller: &Caller,
        asked: &Place,
        explain: bool,
        read: &ReadOptions,
    ) -> Result<Answer<Effective>, Problem> {
        self.authorize(&caller.claims, Right::Read)?;
        let now = self.read_state(read).await?;
        let state = match read.at_revision {
            Some(revision) => self.state_at(&now, revision).await?,
            None => now,
        };
        let state = without_foreign_instance(caller, state, asked)?;
        let at = self.resolve(caller, &state, asked)?;
        let sources = Sources::at(&state, &at);
        if read.reveal {
            let keys: Vec<Key> =
                sources.parts().iter().map(|(document, _, _)| document.key.clone()).collect();
            self.check_reveal(caller, &keys.iter().collect::<Vec<_>>()).await?;
        }
        let keyring = Arc::clone(&self.inner.evaluator.keyring);
        let form = |document: &Document, value: &Value| match read.reveal {
            true => secrets::revealed(&keyring, document, value),
            false => blaze_domain::config::secret::redact(value).into_owned(),
        };
        let effective = Effective {
            hash: sources.hash(),
            rollout: sources.rollout.as_ref().map(ToString::to_string),
            config: sources.merged_with(form),
            explain: explain.then(|| sources.explain(form)),
            place: report::place(at),
        };
        Ok(answer(&state, effective))
    }

    /// The place that is meant: names must exist, and what is absent is taken from what is there.
    fn resolve(
        &self,
        caller: &Caller,
        state: &State,
        asked: &Place,
    ) -> Result<ConfigTarget, Problem> {
        let view = view(&caller.claims);
        let exists = |key: Key| {
            view.check_key(state, &key)?;
            state.get(&key).cloned().ok_or_else(|| not_found(&key, state))
        };
        let invalid = |detail: &str| Err(Problem::new(Code::InvalidRequest, detail));
        if asked.service.is_none() && asked.instance.is_some() {
            return invalid("instance needs service");
        }
        if asked.service.is_none() && asked.node.is_none() && asked.layer.is_none() {
            return invalid("say for which service, node or layer");
        }
        let mut at = ConfigTarget {
            service: asked.service.clone(),
            instance: asked.instance.as_ref().map(DocumentName::from),
            layer: asked.layer.clone(),
            node: asked.node.clone(),
        };
        // Programs are there also without a document, as for workers.
        let has_no_document = |service: &ServiceName| {
            PROGRAMS.contains(&service.as_str()) && state.get(&Key::service(service)).is_none()
        };
        let service = match &asked.service {
            Some(service) if !has_no_document(service) => Some(exists(Key::service(service))?),
            Some(_) | None => None,
        };
        if let Some(layer) = &asked.layer {
            exists(Key::layer(layer))?;
        }
        if let Some(node) = &asked.node {
            let held = exists(Key::node(node))?;
            let own: Option<LayerName> =
                held.document.spec_layer().and_then(|layer| layer.parse().ok());
            if asked.layer.is_some() && asked.layer != own {
                return invalid(&format!("node {node} is in another layer"));
            }
            at.layer = own;
        }
        if asked.node.is_none()
            && asked.layer.is_none()
            && let (Some(service), Some(instance)) = (&at.service, &at.instance)
            && let Some(held) = state.get(&Key::instance(service.clone(), instance.clone()))
        {
            at = Sources::placed(state, service, &held.document);
        }
        if let Some(layer) = &at.layer {
            view.check_layer(layer)?;
            if let Some(service) =
                service.filter(|held| !held.document.is_for_layer(layer.as_str()))
            {
                let detail = format!("{} is not for layer {layer}", service.document.key);
                return Err(Problem::new(Code::NotFound, detail));
            }
        }
        Ok(at)
    }

    /// Changes from a revision on.
    ///
    /// # Errors
    /// [`Code::RevisionTrimmed`], [`Code::RevisionUnknown`]: list, then watch. Other [`Problem`]s.
    pub async fn watch(
        &self,
        caller: &Caller,
        query: &WatchQuery,
    ) -> Result<Answer<WatchStream>, Problem> {
        self.watch_with(caller, query, &ReadOptions::default()).await
    }

    /// The same, with `cached` also without the database, and from `min_revision` on.
    ///
    /// # Errors
    /// As [`Self::watch`].
    pub async fn watch_with(
        &self,
        caller: &Caller,
        query: &WatchQuery,
        read: &ReadOptions,
    ) -> Result<Answer<WatchStream>, Problem> {
        self.authorize(&caller.claims, Right::Read)?;
        if query.timeout_s.is_some_and(|timeout| !(1..=3600).contains(&timeout)) {
            return Err(Problem::new(Code::InvalidRequest, "timeout_s: 1 to 3600 are allowed"));
        }
        let filter = Filter::new(query, caller)?;
        if let Some(layer) = &query.layer {
            view(&caller.claims).check_layer(layer)?;
        }
        let state = self.read_state(read).await?;
        let since = query.since.unwrap_or_else(|| state.revision());
        if since > state.revision() {
            self.wait_for(since).await?;
        }
        let floor = self.inner.log.floor();
        if since < floor {
            return Err(trimmed(floor, state.revision()));
        }
        if self.inner.log.after(since, 1).is_none() {
            // It begins in the store, which may have been trimmed by another process.
            self.check_floor(&state, since).await?;
        }
        let stream = self.inner.watches.open(caller, filter, since, query.timeout_s);
        Ok(answer(&state, stream))
    }
}

/// To a token that is bound to a layer, an instance with a document elsewhere is what one without a
/// document is, for the one must not be told from the other: none where a place is asked for,
/// outside of the view where its own place is.
fn without_foreign_instance(
    caller: &Caller,
    mut state: State,
    asked: &Place,
) -> Result<State, Problem> {
    if let (Some(service), Some(instance)) = (&asked.service, &asked.instance) {
        let key = Key::instance(service.clone(), DocumentName::from(instance));
        let view = view(&caller.claims);
        let is_seen = state.get(&key).map(|held| view.sees_document(&state, &held.document));
        if view.is_bound() && is_seen != Some(true) && asked.node.is_none() && asked.layer.is_none()
        {
            return Err(view.outside(&key.to_string()));
        }
        if is_seen == Some(false) {
            state.remove(&key);
        }
    }
    Ok(state)
}

/// Everything that the next page's request must repeat.
fn bound_query(caller: &Caller, query: &ListQuery) -> String {
    let ListQuery { kind, service, layer, node, label_selector, limit: _, page_token: _ } = query;
    let bound = &caller.claims.layer;
    format!("list {kind:?} {service:?} {layer:?} {node:?} {label_selector:?} {bound:?}")
}

fn is_placed(placement: &Placement, document: &Document, query: &ListQuery) -> bool {
    query.layer.as_ref().is_none_or(|layer| is_in_layer(&document.key, placement, layer))
        && query.node.as_ref().is_none_or(|node| placement.node.as_ref() == Some(node))
}

fn found_documents<'a>(
    state: &'a State,
    kind: Option<Kind>,
    after: Option<&Key>,
) -> Box<dyn Iterator<Item = (&'a Key, &'a Arc<blaze_domain::config::state::Held>)> + Send + 'a> {
    match kind {
        Some(kind) => Box::new(state.of_kind(kind, after)),
        None => {
            let after = after.cloned();
            Box::new(
                state.all().filter(move |(key, _)| after.as_ref().is_none_or(|after| *key > after)),
            )
        }
    }
}
