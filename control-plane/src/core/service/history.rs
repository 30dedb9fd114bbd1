//! Reads of the past of one document.

use std::sync::Arc;

use blaze_domain::config::diff::{Delta, document_diff};
use blaze_domain::config::{Code, Document, Key, Problem};

use super::super::committer::unavailable;
use super::super::page::Position;
use super::super::types::{Answer, Caller, HistoryEntry, Page, ReadOptions};
use super::super::view::view;
use super::read::{PAGE_BYTES, answer, page_size};
use super::{ConfigService, not_found};
use crate::auth::Right;
use crate::store::{Op, Version};
use blaze_domain::config::state::{Held, State, redacted};

/// Versions that are taken from the store at once: each may be a whole document.
const VERSIONS_AT_ONCE: usize = 32;

/// What changed between two revisions of a document.
#[derive(Debug, Clone, PartialEq)]
pub struct DiffReport {
    /// From this revision.
    pub from: u64,
    /// To this one.
    pub to: u64,
    /// Secrets redacted.
    pub changes: Vec<Delta>,
}

impl ConfigService {
    /// The same, refused where what it held then is outside of the token's view.
    pub(super) async fn seen_version(
        &self,
        caller: &Caller,
        state: &State,
        key: &Key,
        revision: u64,
    ) -> Result<Version, Problem> {
        let version = self.version_at(state, key, revision).await?;
        let view = view(&caller.claims);
        match view.sees_document(state, &version.change.document) {
            true => Ok(version),
            false => Err(view.outside(&format!("{key} at revision {revision}"))),
        }
    }

    /// The version of a document that held at a revision.
    pub(super) async fn version_at(
        &self,
        state: &State,
        key: &Key,
        revision: u64,
    ) -> Result<Version, Problem> {
        if revision > state.revision() {
            let detail = format!("the store is at revision {}", state.revision());
            return Err(Problem::new(Code::RevisionUnknown, detail).at(state.revision()));
        }
        let found = self.inner.store.versions(key, Some(revision.saturating_add(1)), 1).await;
        let found = found.map_err(|error| unavailable(&error))?.into_iter().next();
        match found {
            Some(version) if version.change.op != Op::Delete => Ok(version),
            Some(_) => Err(Problem::new(
                Code::NotFound,
                format!("{key} did not exist at revision {revision}"),
            )),
            None => {
                self.check_floor(state, revision).await?;
                Err(Problem::new(
                    Code::NotFound,
                    format!("{key} did not exist at revision {revision}"),
                ))
            }
        }
    }

    /// What was done to a document, newest first, also after its deletion.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn history(
        &self,
        caller: &Caller,
        key: &Key,
        limit: Option<u32>,
        page_token: &str,
        full: bool,
        read: &ReadOptions,
    ) -> Result<Answer<Page<HistoryEntry>>, Problem> {
        self.authorize(&caller.claims, Right::Read)?;
        let limit = page_size(limit)?;
        let bound = format!("history {key} {full} {:?}", caller.claims.layer);
        let position = match page_token {
            "" => None,
            token => Some(self.inner.pages.position(&bound, token)?),
        };
        let state = self.read_state(read).await?;
        view(&caller.claims).check_key(&state, key)?;
        let below = position.as_ref().and_then(|position| position.after.parse().ok());
        let shown_at = position.map_or(state.revision(), |position| position.revision);
        let below = below.unwrap_or(shown_at.saturating_add(1));
        let own = view(&caller.claims);
        let is_seen = |document: &Document| own.sees_document(&state, document);
        let (versions, more) = self.versions_below(key, below, limit, full, is_seen).await?;
        if versions.is_empty() && page_token.is_empty() && state.get(key).is_none() {
            return Err(not_found(key, &state));
        }
        let next = versions
            .last()
            .filter(|_| more)
            .map(|version| Position { revision: shown_at, after: version.revision.to_string() });
        let items = versions.into_iter().map(|version| HistoryEntry {
            revision: version.revision,
            op: version.change.op,
            time: version.time,
            subject: version.subject,
            request_id: version.request_id,
            paths: version.change.paths,
            document: (full && version.change.op != Op::Delete)
                .then(|| redacted(&version.change.document)),
        });
        let page = Page {
            items: items.collect(),
            next_page_token: next
                .map(|position| self.inner.pages.token(&bound, &position))
                .unwrap_or_default(),
        };
        Ok(answer(&state, page))
    }

    /// Versions of a document before a revision, newest first, and whether there are more: up to
    /// `limit`, and with the documents (`full`) a page's bytes of them. Without `full` a version
    /// comes without what its document holds. What is not seen is passed over, as if it had not
    /// been.
    async fn versions_below(
        &self,
        key: &Key,
        mut below: u64,
        limit: usize,
        full: bool,
        is_seen: impl Fn(&Document) -> bool,
    ) -> Result<(Vec<Version>, bool), Problem> {
        let mut found: Vec<Version> = Vec::new();
        let mut bytes = 0;
        loop {
            let some = self.inner.store.versions(key, Some(below), VERSIONS_AT_ONCE).await;
            let some = some.map_err(|error| unavailable(&error))?;
            let all = some.len() < VERSIONS_AT_ONCE;
            for mut version in some {
                if !is_seen(&version.change.document) {
                    below = version.revision;
                    continue;
                }
                if found.len() == limit || bytes >= PAGE_BYTES {
                    return Ok((found, true));
                }
                below = version.revision;
                match full {
                    true => bytes += Held::new(Arc::clone(&version.change.document)).bytes,
                    false => Arc::make_mut(&mut version.change.document).spec = Arc::default(),
                }
                found.push(version);
            }
            if all {
                return Ok((found, false));
            }
        }
    }

    /// What changed in a document between two revisions; it counts as empty where it did not exist.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn diff(
        &self,
        caller: &Caller,
        key: &Key,
        from: u64,
        to: Option<u64>,
        read: &ReadOptions,
    ) -> Result<Answer<DiffReport>, Problem> {
        self.authorize(&caller.claims, Right::Read)?;
        let state = self.read_state(read).await?;
        view(&caller.claims).check_key(&state, key)?;
        let to = to.unwrap_or_else(|| state.revision());
        let side =
            async |revision: u64| match self.seen_version(caller, &state, key, revision).await {
                Ok(version) => Ok(Some(redacted(&version.change.document))),
                Err(problem) if problem.code == Code::NotFound => Ok(None),
                Err(problem) => Err(problem),
            };
        let (old, new) = (side(from).await?, side(to).await?);
        if old.is_none() && new.is_none() {
            return Err(match state.get(key) {
                Some(_) => Problem::new(
                    Code::NotFound,
                    format!("{key} existed neither at revision {from} nor at {to}"),
                ),
                None => not_found(key, &state),
            });
        }
        let changes = document_diff(old.as_deref(), new.as_deref());
        Ok(answer(&state, DiffReport { from, to, changes }))
    }
}
