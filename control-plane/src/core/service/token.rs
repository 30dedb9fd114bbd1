//! Tokens, refusals, audit.

use std::collections::HashMap;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use blaze_domain::config::{Code, FieldFault, Key, Problem, Timestamp};
use tokio::sync::oneshot;

use super::super::committer::{now, outcome_unknown, unavailable};
use super::super::page::Position;
use super::super::types::{Answer, Caller, Page, ReadOptions, TokenRequest};
use super::super::view::authorize_whole;
use super::ConfigService;
use crate::auth::{Claims, NewToken};
use crate::store::{AuditEntry, AuditQuery, StoreError, TOKEN_KEPT_MS, TokenRecord};

/// Refusals per address and second that are written to the audit; the rest is counted.
const DENIALS_PER_S: u32 = 10;
/// Addresses that are told apart at once.
const MAX_ADDRESSES: usize = 4096;
/// Longest life of a token, in seconds: a year.
const MAX_EXPIRES_S: u32 = 31_536_000;
/// Entries of a page of the audit.
const PAGE: usize = 100;
/// The same, at most.
const MAX_PAGE: usize = 1000;

/// What is handed to the task that writes refusals, in order.
pub(super) enum Denial {
    Entry(Box<AuditEntry>),
    /// Reads the audit, and is told once all before are in it, or were reported as missing.
    Reader(oneshot::Sender<()>),
}

/// How many refusals of an address are written in this second.
#[derive(Default)]
pub(super) struct DenialLimit {
    second: Option<Instant>,
    counts: HashMap<IpAddr, u32>,
    /// Refusals that were not written.
    pub(super) skipped: u64,
}

impl DenialLimit {
    fn admit(&mut self, address: IpAddr) -> bool {
        let now = Instant::now();
        if self.second.is_none_or(|since| now.duration_since(since) >= Duration::from_secs(1)) {
            self.second = Some(now);
            self.counts.clear();
        }
        let known = self.counts.len() < MAX_ADDRESSES || self.counts.contains_key(&address);
        let admitted = known && {
            let count = self.counts.entry(address).or_default();
            *count += 1;
            *count <= DENIALS_PER_S
        };
        self.skipped += u64::from(!admitted);
        admitted
    }
}

impl ConfigService {
    /// Notes a refusal (401, 403) for the audit: at most ten per address and second, the rest is
    /// counted.
    #[allow(clippy::too_many_arguments, reason = "each is a column of the audit")]
    pub fn denied(
        &self,
        claims: Option<&Claims>,
        problem: &Problem,
        action: &str,
        key: Option<&Key>,
        request_id: &str,
        address: IpAddr,
    ) {
        if !self.inner.denials.lock().admit(address) {
            return;
        }
        let entry = AuditEntry {
            id: uuid::Uuid::now_v7().to_string(),
            time: now(),
            revision: None,
            subject: claims.map(|claims| claims.subject.clone()).unwrap_or_default(),
            roles: claims.map(|claims| claims.roles.clone()).unwrap_or_default(),
            action: action.to_owned(),
            key: key.cloned(),
            allowed: false,
            code: Some(problem.code.as_str().to_owned()),
            paths: Vec::new(),
            request_id: request_id.to_owned(),
            address: address.to_string(),
            detail: problem.internal.clone(),
        };
        if self.inner.denied.try_send(Denial::Entry(Box::new(entry))).is_err() {
            self.inner.denials.lock().skipped += 1;
        }
    }

    /// Refusals that are not in the audit because there were too many.
    #[must_use]
    pub fn denials_skipped(&self) -> u64 {
        self.inner.denials.lock().skipped
    }

    /// Waits until refusals that were answered before are in the audit, so that who looks for one
    /// finds it.
    async fn denials_written(&self) {
        let (reader, written) = oneshot::channel();
        // Neither fails but at the end of the process, when the audit is as it is.
        if self.inner.denied.send(Denial::Reader(reader)).await.is_ok() {
            let _ = written.await;
        }
    }

    pub(super) fn entry(caller: &Caller, action: &str, key: Option<&Key>) -> AuditEntry {
        AuditEntry {
            id: uuid::Uuid::now_v7().to_string(),
            time: now(),
            revision: None,
            subject: caller.claims.subject.clone(),
            roles: caller.claims.roles.clone(),
            action: action.to_owned(),
            key: key.cloned(),
            allowed: true,
            code: None,
            paths: Vec::new(),
            request_id: caller.request_id.clone(),
            address: caller.address.to_string(),
            detail: None,
        }
    }

    /// The audit, newest first.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn audit(
        &self,
        caller: &Caller,
        mut query: AuditQuery,
        page_token: &str,
        read: &ReadOptions,
    ) -> Result<Answer<Page<AuditEntry>>, Problem> {
        authorize_whole(&caller.claims)?;
        let state = self.read_state(read).await?;
        let bound = format!("audit {query:?}");
        if !page_token.is_empty() {
            query.below = Some(self.inner.pages.position(&bound, page_token)?.after);
        }
        let limit = match query.limit {
            0 => PAGE,
            limit if limit <= MAX_PAGE => limit,
            _ => return Err(Problem::new(Code::InvalidRequest, format!("limit: 1 to {MAX_PAGE}"))),
        };
        query.limit = limit + 1;
        self.denials_written().await;
        let mut items =
            self.inner.store.audit(&query).await.map_err(|error| unavailable(&error))?;
        let more = items.len() > limit;
        items.truncate(limit);
        // A commit that is not in the state yet is not told of, or a read that follows would be
        // older than this one.
        items.retain(|entry| entry.revision.is_none_or(|revision| revision <= state.revision()));
        let next = items
            .last()
            .filter(|_| more)
            .map(|entry| Position { revision: state.revision(), after: entry.id.clone() });
        Ok(Answer {
            revision: state.revision(),
            replayed: false,
            value: Page {
                next_page_token: next
                    .map(|position| self.inner.pages.token(&bound, &position))
                    .unwrap_or_default(),
                items,
            },
        })
    }

    /// Gives out a token. Its text is kept nowhere.
    ///
    /// # Errors
    /// [`Problem`]; [`Code::SigningDisabled`] without a key to sign with.
    pub async fn create_token(
        &self,
        caller: &Caller,
        request: TokenRequest,
    ) -> Result<Answer<(TokenRecord, String)>, Problem> {
        authorize_whole(&caller.claims)?;
        check_token(&request)?;
        let disabled = || {
            let detail = "no key with sign: true is configured (control_plane.auth.keys)";
            Problem::new(Code::SigningDisabled, detail).at(self.revision())
        };
        let authenticator = self.inner.authenticator.as_ref().ok_or_else(disabled)?;
        let time = now();
        let expires = time.as_millis() / 1000 + i64::from(request.expires_in_s);
        let record = TokenRecord {
            id: uuid::Uuid::now_v7().to_string(),
            subject: request.subject,
            roles: request.roles,
            layer: request.layer,
            create_time: time,
            expire_time: Timestamp::from_millis(expires * 1000),
            revoke_time: None,
        };
        let token = NewToken {
            subject: &record.subject,
            roles: &record.roles,
            layer: record.layer.as_deref(),
            issued_s: time.as_millis() / 1000,
            expires_s: expires,
            id: &record.id,
        };
        let text = authenticator.sign(&token).ok_or_else(disabled)?;
        let text = text.map_err(|error| {
            tracing::error!(%error, "a token could not be signed");
            Problem::new(
                Code::Internal,
                "the token could not be signed; see the log of the service",
            )
        })?;
        let entry = Self::entry(caller, "token_create", None);
        let added = self.inner.store.add_token(&record, &entry).await;
        added.map_err(|error| outcome_unknown(&error))?;
        Ok(Answer { revision: self.revision(), replayed: false, value: (record, text) })
    }

    /// Tokens that were given out and have not run out.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn tokens(
        &self,
        caller: &Caller,
        read: &ReadOptions,
    ) -> Result<Answer<Vec<TokenRecord>>, Problem> {
        authorize_whole(&caller.claims)?;
        let state = self.read_state(read).await?;
        let tokens = self.inner.store.tokens(now()).await.map_err(|error| unavailable(&error))?;
        Ok(Answer { revision: state.revision(), replayed: false, value: tokens })
    }

    /// Takes a token back: it is refused everywhere within five seconds and its streams end.
    ///
    /// # Errors
    /// [`Code::NotFound`] for an id that was not given out here, or other [`Problem`]s.
    pub async fn revoke_token(&self, caller: &Caller, id: &str) -> Result<Answer<()>, Problem> {
        authorize_whole(&caller.claims)?;
        let entry = Self::entry(caller, "token_revoke", None);
        let revoked = self.inner.store.revoke_token(id, now(), &entry).await;
        if !revoked.map_err(|error| outcome_unknown(&error))? {
            return Err(Problem::new(Code::NotFound, format!("no token has the id {id:?}")));
        }
        if let Err(error) = self.refresh_tokens().await {
            // It is revoked; the next periodic reading learns of it.
            tracing::warn!(%error, "revoked tokens were not read");
        }
        Ok(Answer { revision: self.revision(), replayed: false, value: () })
    }

    /// Reads which tokens are revoked.
    pub(super) async fn refresh_tokens(&self) -> Result<(), StoreError> {
        // A token is accepted for a while after it has run out, for clocks differ.
        let since = Timestamp::from_millis(now().as_millis() - TOKEN_KEPT_MS);
        let tokens = self.inner.store.tokens(since).await?;
        let revoked = tokens.into_iter().filter(|token| token.revoke_time.is_some());
        let entries = revoked.map(|token| (token.id, token.expire_time.as_millis() / 1000));
        self.inner.revocations.learn(entries, now().as_millis() / 1000);
        Ok(())
    }
}

fn check_token(request: &TokenRequest) -> Result<(), Problem> {
    let invalid = |pointer: &str, detail: String| {
        Problem::faults(vec![FieldFault {
            pointer: pointer.to_owned(),
            code: Code::ValidationFailed,
            detail,
            document: None,
        }])
    };
    if !(1..=MAX_EXPIRES_S).contains(&request.expires_in_s) {
        return Err(invalid("/expires_in_s", format!("1 to {MAX_EXPIRES_S} are allowed")));
    }
    // The rules of a token are those of who signs it, here and on the command line.
    let token = NewToken {
        subject: &request.subject,
        roles: &request.roles,
        layer: request.layer.as_deref(),
        issued_s: 0,
        expires_s: i64::from(request.expires_in_s),
        id: "0",
    };
    token.check().map_err(|detail| {
        let pointer = ["subject", "layer"].into_iter().find(|member| detail.starts_with(member));
        invalid(&format!("/{}", pointer.unwrap_or("roles")), detail)
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use blaze_runtime::Supervisor;

    use super::*;
    use crate::core::testing;
    use crate::store::{SqliteStore, Store, TokenStore};

    #[tokio::test]
    async fn a_revoked_token_that_has_just_run_out_stays_revoked_after_a_restart() {
        let supervisor = Supervisor::new("test");
        let store = Arc::new(SqliteStore::in_memory(&supervisor).await.unwrap());
        let entry = AuditEntry {
            id: "a".to_owned(),
            time: now(),
            revision: None,
            subject: "ops".to_owned(),
            roles: Vec::new(),
            action: "token_create".to_owned(),
            key: None,
            allowed: true,
            code: None,
            paths: Vec::new(),
            request_id: "r".to_owned(),
            address: "127.0.0.1".to_owned(),
            detail: None,
        };
        let ago = |seconds: i64| Timestamp::from_millis(now().as_millis() - seconds * 1000);
        for (id, expire_time) in [("late", ago(10)), ("old", ago(100))] {
            let token = TokenRecord {
                id: id.to_owned(),
                subject: "ops".to_owned(),
                roles: vec!["viewer".to_owned()],
                layer: None,
                create_time: ago(1000),
                expire_time,
                revoke_time: None,
            };
            let made = AuditEntry { id: format!("a-{id}"), ..entry.clone() };
            store.add_token(&token, &made).await.unwrap();
            let again = AuditEntry { id: format!("b-{id}"), ..entry.clone() };
            assert!(store.revoke_token(id, ago(500), &again).await.unwrap());
        }
        let shared = Arc::clone(&store) as Arc<dyn Store>;
        let service = testing::service_on(&supervisor, shared, &[("e1", [7; 32])]).await.unwrap();
        let revocations = &service.inner.revocations;
        assert!(revocations.is_revoked("late") && !revocations.is_revoked("old"));
    }
}
