//! What was, and what is written beside commits.

use std::collections::BTreeMap;

use blaze_domain::config::{Document as Config, Key, Timestamp};
use futures::FutureExt as _;
use mongodb::bson::{DateTime, Document, doc};
use mongodb::options::ReturnDocument;

use super::client::{QUICK, USUAL, limited};
use super::errors::is_duplicate;
use super::rows::{self, FLOOR};
use super::{MongoStore, collect};
use crate::store::encode::{corrupt, document, signed, unsigned};
use crate::store::rows::{AuditRow, TokenRow};
use crate::store::{AuditEntry, AuditQuery, IdempotencyRecord, StoreError, TokenRecord, Version};

/// Documents that one query names.
const NAMED: usize = 500;

impl MongoStore {
    pub(super) async fn read_versions(
        &self,
        key: &Key,
        below: Option<u64>,
        limit: usize,
    ) -> Result<Vec<Version>, StoreError> {
        if limit == 0 {
            return Ok(Vec::new());
        }
        let filter = rows::versions_below(&key.to_string(), below.map_or(i64::MAX, signed));
        let find = self
            .tables
            .versions
            .find(filter)
            .sort(doc! { "_id": -1 })
            .limit(limit_of(limit));
        collect(find, |found| rows::read_version(found)?.into_version()).await
    }

    pub(super) async fn read_documents_at(
        &self,
        revision: u64,
        until: u64,
    ) -> Result<Vec<(Key, Option<Config>)>, StoreError> {
        // The first change after the revision says which version was there before it.
        let range = doc! { "revision": { "$gt": signed(revision), "$lte": signed(until) } };
        let fields = doc! { "_id": 1, "previous": 1 };
        let find = self
            .tables
            .versions
            .find(range)
            .sort(doc! { "revision": 1 })
            .projection(fields);
        let changes = collect(find, |found| {
            let id = rows::text(found, "_id")?;
            let key = rows::split_version_id(&id)?.0.to_owned();
            Ok((key, rows::integer(found, "previous").ok()))
        })
        .await?;
        let mut first: BTreeMap<String, Option<i64>> = BTreeMap::new();
        for (key, previous) in changes {
            first.entry(key).or_insert(previous);
        }
        let wanted = first
            .iter()
            .filter_map(|(key, previous)| Some(rows::version_id(key, (*previous)?)));
        let before = self.read_texts(wanted.collect()).await?;
        let floor = self.read_floor().await?;
        let mut documents = Vec::new();
        for (text, previous) in first {
            let key: Key = text
                .parse()
                .map_err(|error| corrupt(format_args!("a version: {error}")))?;
            let found = previous.and_then(|previous| before.get(&rows::version_id(&text, previous)));
            if previous.is_some() && found.is_none() && revision >= floor {
                return Err(corrupt(format_args!(
                    "{key} of revision {previous:?} is missing from its history"
                )));
            }
            let before = found.map(|found| document(key.clone(), found)).transpose()?;
            documents.push((key, before));
        }
        Ok(documents)
    }

    async fn read_texts(&self, ids: Vec<String>) -> Result<BTreeMap<String, String>, StoreError> {
        let mut texts = BTreeMap::new();
        for some in ids.chunks(NAMED) {
            let find = self
                .tables
                .versions
                .find(doc! { "_id": { "$in": some } })
                .projection(doc! { "document": 1 });
            let found = collect(find, |found| {
                Ok((rows::text(found, "_id")?, rows::text(found, "document")?))
            });
            texts.extend(found.await?);
        }
        Ok(texts)
    }

    /// Times rise with revisions, but for the differences of the processes' clocks.
    pub(super) async fn find_revision_before(&self, time: Timestamp) -> Result<u64, StoreError> {
        let floor = signed(self.read_floor().await?);
        let (mut before, mut after) = (floor, signed(self.read_head().await?) + 1);
        while after - before > 1 {
            let middle = before + (after - before) / 2;
            let find = self
                .tables
                .events
                .find_one(doc! { "_id": middle })
                .projection(doc! { "time": 1 });
            let found = limited(QUICK, find).await?;
            // What was trimmed away meanwhile is old.
            let old = match found {
                Some(event) => rows::integer(&event, "time")? < time.as_millis(),
                None => true,
            };
            match old {
                true => before = middle,
                false => after = middle,
            }
        }
        match before == floor {
            true => Ok(0),
            false => unsigned(before),
        }
    }

    /// Raises the floor and gives it.
    pub(super) async fn raise_floor(&self, floor: i64) -> Result<i64, StoreError> {
        let raise = doc! { "$max": { FLOOR: floor } };
        let raised = self.tables.documents.find_one_and_update(doc! { "_id": FLOOR }, raise);
        let raised = limited(USUAL, raised.return_document(ReturnDocument::After)).await?;
        let raised = raised.ok_or_else(|| corrupt("the floor is missing"))?;
        rows::integer(&raised, FLOOR)
    }

    pub(super) async fn write_audit(&self, entries: &[AuditEntry]) -> Result<(), StoreError> {
        let entries: Vec<Document> = entries
            .iter()
            .map(|entry| Ok(rows::audit(&AuditRow::encode(entry)?)))
            .collect::<Result<_, StoreError>>()?;
        if entries.is_empty() {
            return Ok(());
        }
        // Unordered, so that those that are there already do not keep out the others.
        let insert = async {
            match self.tables.audit.insert_many(entries).ordered(false).await {
                Err(error) if !is_duplicate(&error) => Err(error),
                Ok(_) | Err(_) => Ok(()),
            }
        };
        limited(USUAL, insert).await
    }

    pub(super) async fn read_audit(&self, query: &AuditQuery) -> Result<Vec<AuditEntry>, StoreError> {
        if query.limit == 0 {
            return Ok(Vec::new());
        }
        let find = self
            .tables
            .audit
            .find(audit_filter(query))
            .sort(doc! { "_id": -1 })
            .limit(limit_of(query.limit));
        collect(find, |found| rows::read_audit(found)?.decode()).await
    }

    pub(super) async fn read_answer(&self, id: &str, now: Timestamp) -> Result<Option<IdempotencyRecord>, StoreError> {
        let filter = doc! { "_id": id, "expires": { "$gt": DateTime::from_millis(now.as_millis()) } };
        let found = limited(QUICK, self.tables.idempotency.find_one(filter)).await?;
        found.map(|found| rows::read_idempotency(&found)?.decode()).transpose()
    }

    pub(super) async fn write_token(&self, token: &TokenRecord, audit: &AuditEntry) -> Result<(), StoreError> {
        let token = rows::token(&TokenRow::encode(token)?);
        let audit = rows::audit(&AuditRow::encode(audit)?);
        self.in_transaction(|tables, session| {
            let (token, audit) = (token.clone(), audit.clone());
            async move {
                tables.tokens.insert_one(token).session(&mut *session).await?;
                tables.audit.insert_one(audit).session(&mut *session).await?;
                Ok(true)
            }
            .boxed()
        })
        .await?;
        Ok(())
    }

    pub(super) async fn write_revocation(
        &self,
        id: &str,
        time: Timestamp,
        audit: &AuditEntry,
    ) -> Result<bool, StoreError> {
        let audit = rows::audit(&AuditRow::encode(audit)?);
        // A pipeline, because it depends on what is there: the first time stays.
        let first = doc! { "$set": { "revoke_time": { "$ifNull": ["$revoke_time", time.as_millis()] } } };
        self.in_transaction(|tables, session| {
            let (which, first, audit) = (doc! { "_id": id }, first.clone(), audit.clone());
            async move {
                let revoke = tables.tokens.update_one(which, vec![first]);
                if revoke.session(&mut *session).await?.matched_count == 0 {
                    return Ok(false);
                }
                tables.audit.insert_one(audit).session(&mut *session).await?;
                Ok(true)
            }
            .boxed()
        })
        .await
    }

    pub(super) async fn read_tokens(&self, now: Timestamp) -> Result<Vec<TokenRecord>, StoreError> {
        let filter = doc! { "expire_time": { "$gt": DateTime::from_millis(now.as_millis()) } };
        let find = self
            .tables
            .tokens
            .find(filter)
            .sort(doc! { "create_time": -1, "_id": -1 });
        collect(find, |found| rows::read_token(found)?.decode()).await
    }
}

fn audit_filter(query: &AuditQuery) -> Document {
    let mut filter = Document::new();
    for (name, value) in [
        ("subject", &query.subject),
        ("kind", &query.kind),
        ("name", &query.name),
        ("action", &query.action),
    ] {
        if let Some(value) = value {
            filter.insert(name, value);
        }
    }
    if let Some(allowed) = query.allowed {
        filter.insert("allowed", allowed);
    }
    let mut time = Document::new();
    if let Some(since) = query.since {
        time.insert("$gte", DateTime::from_millis(since.as_millis()));
    }
    if let Some(until) = query.until {
        time.insert("$lt", DateTime::from_millis(until.as_millis()));
    }
    if !time.is_empty() {
        filter.insert("time", time);
    }
    if let Some(below) = &query.below {
        filter.insert("_id", doc! { "$lt": below });
    }
    filter
}

fn limit_of(limit: usize) -> i64 {
    i64::try_from(limit).unwrap_or(i64::MAX)
}
