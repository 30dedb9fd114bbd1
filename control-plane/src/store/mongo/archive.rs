//! What was, and what is written beside commits.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use blaze_domain::config::{Document as Config, Key, Timestamp};
use futures::{FutureExt as _, TryStreamExt as _};
use mongodb::bson::{DateTime, Document, doc};

use super::client::{QUICK, USUAL, limited, limited_steps};
use super::errors::{is_duplicate, store_error};
use super::rows;
use super::statements::RECORD_COMMITS;
use super::{MongoStore, collect};
use crate::store::encode::{corrupt, document, signed, unsigned};
use crate::store::rows::{AuditRow, IdempotencyRow, TokenRow, VersionRow};
use crate::store::upkeep::now;
use crate::store::{
    AUDIT_KEPT_MS, AuditEntry, AuditQuery, IdempotencyRecord, StoreError, TokenRecord, Version,
};

/// Between the time of an entry and that in its id, at most: they are taken one after the other.
const ID_SLACK_MS: i64 = 3_600_000;
/// Documents that one query names.
const NAMED: usize = 500;

impl MongoStore {
    /// From the log, and below the floor from what trimming has kept. First the log, then the
    /// floor, then what was kept: it is kept before the floor rises, and the log is cut after that.
    pub(super) async fn read_versions(
        &self,
        key: &Key,
        below: Option<u64>,
        limit: usize,
    ) -> Result<Vec<Version>, StoreError> {
        let tables = self.tables();
        if limit == 0 {
            return Ok(Vec::new());
        }
        let (key, below) = (key.to_string(), below.map_or(i64::MAX, signed));
        let matching = doc! { "docs.key": &key, "_id": { "$lt": below } };
        let find = tables
            .events
            .find(matching)
            .sort(doc! { "_id": -1 })
            // One more, for the record in the middle of which it begins may have later changes
            // alone.
            .limit(limit_of(limit.saturating_add(1)));
        let find = find.projection(only_of(&doc! { "$eq": ["$$doc.key", &key] }));
        let records = collect(find, rows::read_record).await?;
        let floor = signed(self.read_floor().await?);
        let kept = rows::versions_below(&key, below);
        let kept = tables.versions.find(kept).sort(doc! { "_id": -1 }).limit(limit_of(limit));
        let kept = collect(kept, rows::read_version).await?;
        let logged = records.into_iter().flat_map(|record| record.versions);
        let logged = logged.filter(|row| row.revision > floor && row.revision < below);
        let newest: BTreeMap<Reverse<i64>, VersionRow> =
            kept.into_iter().chain(logged).map(|row| (Reverse(row.revision), row)).collect();
        newest.into_values().take(limit).map(VersionRow::into_version).collect()
    }

    pub(super) async fn read_documents_at(
        &self,
        revision: u64,
        until: u64,
    ) -> Result<Vec<(Key, Option<Config>)>, StoreError> {
        // The first change after the revision says which version was there before it.
        let (after, until) = (signed(revision), signed(until));
        let first = self.first_changes(after, until).await?;
        let wanted: BTreeMap<&str, i64> = first
            .iter()
            .filter_map(|(key, (_, previous))| Some((key.as_str(), (*previous)?)))
            .collect();
        let before = self.read_texts(&wanted).await?;
        let floor = self.read_floor().await?;
        let mut documents = Vec::new();
        for (text, (_, previous)) in &first {
            let key: Key =
                text.parse().map_err(|error| corrupt(format_args!("a version: {error}")))?;
            let found = previous.and_then(|_| before.get(text));
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

    /// By key, the first change in a range: its revision and the version before it.
    async fn first_changes(
        &self,
        after: i64,
        until: i64,
    ) -> Result<BTreeMap<String, (i64, Option<i64>)>, StoreError> {
        let tables = self.tables();
        let mut first: BTreeMap<String, (i64, Option<i64>)> = BTreeMap::new();
        // There may be many more changes than documents, so they are not collected before.
        let mut note = |key: &str, changed: i64, previous: Option<i64>| {
            if changed <= after || changed > until {
                return;
            }
            match first.get_mut(key) {
                Some(known) if known.0 <= changed => {}
                Some(known) => *known = (changed, previous),
                None => {
                    first.insert(key.to_owned(), (changed, previous));
                }
            }
        };
        let range = doc! {
            "_id": { "$gt": after - RECORD_COMMITS, "$lte": until },
            "last": { "$gt": after },
        };
        let fields = doc! { "docs.key": 1, "docs.revision": 1, "docs.previous": 1 };
        let logged = tables.events.find(range).projection(fields);
        collect(logged, |found| {
            for change in rows::members(found, "docs") {
                let change = change?;
                let previous = rows::integer(change, "previous").ok();
                note(&rows::text(change, "key")?, rows::integer(change, "revision")?, previous);
            }
            Ok(())
        })
        .await?;
        let range = doc! { "revision": { "$gt": after, "$lte": until } };
        let fields = doc! { "_id": 1, "previous": 1 };
        let kept = tables.versions.find(range).projection(fields);
        collect(kept, |found| {
            let id = rows::text(found, "_id")?;
            let (key, revision) = rows::split_version_id(&id)?;
            note(key, revision, rows::integer(found, "previous").ok());
            Ok(())
        })
        .await?;
        Ok(first)
    }

    /// Texts of one version of each document: from the log, or what trimming has kept of it.
    async fn read_texts(
        &self,
        wanted: &BTreeMap<&str, i64>,
    ) -> Result<BTreeMap<String, String>, StoreError> {
        let mut texts = BTreeMap::new();
        let all: Vec<(&str, i64)> =
            wanted.iter().map(|(key, revision)| (*key, *revision)).collect();
        // Most commits begin a record; those that do not are looked for one by one.
        for chunk in all.chunks(NAMED) {
            let revisions: Vec<i64> = chunk.iter().map(|(_, revision)| *revision).collect();
            let matching = doc! { "_id": { "$in": revisions } };
            self.read_logged(matching, wanted, &mut texts).await?;
            self.read_kept(chunk, wanted, &mut texts).await?;
        }
        let rest: Vec<(&str, i64)> =
            all.into_iter().filter(|(key, _)| !texts.contains_key(*key)).collect();
        for chunk in rest.chunks(NAMED / 5) {
            let around = chunk.iter().map(|(key, revision)| {
                let near = doc! { "$gt": revision - RECORD_COMMITS, "$lte": revision };
                doc! { "docs.key": key, "_id": near, "last": { "$gte": revision } }
            });
            let matching = doc! { "$or": around.collect::<Vec<_>>() };
            self.read_logged(matching, wanted, &mut texts).await?;
            // Last of all, for what has left the log meanwhile.
            self.read_kept(chunk, wanted, &mut texts).await?;
        }
        Ok(texts)
    }

    async fn read_logged(
        &self,
        matching: Document,
        wanted: &BTreeMap<&str, i64>,
        texts: &mut BTreeMap<String, String>,
    ) -> Result<(), StoreError> {
        let tables = self.tables();
        let revisions: BTreeSet<i64> = wanted.values().copied().collect();
        let find = tables.events.find(matching).projection(doc! { "audit": 0, "answers": 0 });
        let logged = collect(find, |found| {
            let mut versions = rows::read_record(found)?.versions;
            versions.retain(|row| revisions.contains(&row.revision));
            Ok(versions)
        });
        keep_wanted(logged.await?.into_iter().flatten(), wanted, texts);
        Ok(())
    }

    async fn read_kept(
        &self,
        some: &[(&str, i64)],
        wanted: &BTreeMap<&str, i64>,
        texts: &mut BTreeMap<String, String>,
    ) -> Result<(), StoreError> {
        let tables = self.tables();
        let ids = some.iter().filter(|(key, _)| !texts.contains_key(*key));
        let ids: Vec<String> =
            ids.map(|(key, revision)| rows::version_id(key, *revision)).collect();
        if !ids.is_empty() {
            let kept = tables.versions.find(doc! { "_id": { "$in": ids } });
            keep_wanted(collect(kept, rows::read_version).await?, wanted, texts);
        }
        Ok(())
    }

    /// Times rise with revisions, but for the differences of the processes' clocks.
    pub(super) async fn find_revision_before(&self, time: Timestamp) -> Result<u64, StoreError> {
        let tables = self.tables();
        let floor = signed(self.read_floor().await?);
        let (mut before, mut after) = (floor, signed(self.read_head().await?) + 1);
        while after - before > 1 {
            let middle = before + (after - before) / 2;
            let find = tables
                .events
                .find_one(doc! { "_id": { "$lte": middle } })
                .sort(doc! { "_id": -1 })
                .projection(doc! { "commits.time": 1, "last": 1 });
            let found = limited(QUICK, find).await?;
            // What was trimmed away meanwhile is old.
            let old = match found {
                Some(record) => {
                    time_in(&record, middle)?.is_none_or(|found| found < time.as_millis())
                }
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

    pub(super) async fn write_audit(&self, entries: &[AuditEntry]) -> Result<(), StoreError> {
        let tables = self.tables();
        let entries: Vec<Document> = entries
            .iter()
            .map(|entry| Ok(rows::audit(&AuditRow::encode(entry)?)))
            .collect::<Result<_, StoreError>>()?;
        if entries.is_empty() {
            return Ok(());
        }
        // Unordered, so that those that are there already do not keep out the others.
        let insert = async {
            match tables.audit.insert_many(entries).ordered(false).await {
                Err(error) if !is_duplicate(&error) => Err(error),
                Ok(_) | Err(_) => Ok(()),
            }
        };
        limited(USUAL, insert).await
    }

    pub(super) async fn read_audit(
        &self,
        query: &AuditQuery,
    ) -> Result<Vec<AuditEntry>, StoreError> {
        let tables = self.tables();
        if query.limit == 0 {
            return Ok(Vec::new());
        }
        // First the log, then what trimming has moved out of it: nothing is missed, and what is
        // seen twice has one id.
        let mut newest = self.audit_of_the_log(query).await?;
        let find = tables
            .audit
            .find(audit_filter(query))
            .sort(doc! { "_id": -1 })
            .limit(limit_of(query.limit));
        let apart = collect(find, rows::read_audit).await?;
        newest.extend(apart.into_iter().map(|row| (row.id.clone(), row)));
        let newest = newest.into_values().rev().take(query.limit);
        newest.map(AuditRow::decode).collect()
    }

    /// The newest entries beside commits that a query asks for, by id. Records come by their newest
    /// entry, and may overlap.
    async fn audit_of_the_log(
        &self,
        query: &AuditQuery,
    ) -> Result<BTreeMap<String, AuditRow>, StoreError> {
        let tables = self.tables();
        // Below the floor they were moved.
        let floor = signed(self.read_floor().await?);
        let (first, last) = ids_of(query);
        let mut matching = doc! { "audit_last": { "$gt": first }, "last": { "$gt": floor } };
        if let Some(last) = last {
            matching.insert("audit_first", doc! { "$lt": last });
        }
        let entry = audit_filter(query);
        if !entry.is_empty() {
            matching.insert("audit", doc! { "$elemMatch": entry });
        }
        let oldest = now().as_millis() - AUDIT_KEPT_MS;
        let find = tables.events.find(matching).sort(doc! { "audit_last": -1 });
        let find = find.projection(doc! { "audit": 1, "audit_last": 1 });
        limited_steps(USUAL, async {
            let mut newest = BTreeMap::new();
            let mut cursor = find.await.map_err(store_error)?;
            while let Some(found) = cursor.try_next().await.map_err(store_error)? {
                let full = newest.len() >= query.limit;
                let least = newest.first_key_value().map(|(id, _): (&String, _)| id.as_str());
                if full && least >= found.get_str("audit_last").ok() {
                    break;
                }
                for entry in rows::members(&found, "audit") {
                    let row = rows::read_audit(entry?)?;
                    if row.time >= oldest && is_asked_for(&row, query) {
                        newest.insert(row.id.clone(), row);
                    }
                }
                while newest.len() > query.limit {
                    newest.pop_first();
                }
            }
            Ok(newest)
        })
        .await
    }

    pub(super) async fn read_answer(
        &self,
        id: &str,
        now: Timestamp,
    ) -> Result<Option<IdempotencyRecord>, StoreError> {
        let known = self.read_answers(&[id]).await?;
        let valid = known.into_iter().filter(|row| row.expires > now.as_millis());
        valid.max_by_key(|row| row.revision).map(IdempotencyRow::decode).transpose()
    }

    /// All answers of these ids, also expired ones. First the log, then what trimming has moved out
    /// of it.
    pub(super) async fn read_answers(
        &self,
        ids: &[&str],
    ) -> Result<Vec<IdempotencyRow>, StoreError> {
        let tables = self.tables();
        // What is below the floor was moved; a record that is still there may be one that came too
        // late.
        let floor = signed(self.read_floor().await?);
        let find =
            tables.events.find(doc! { "answers._id": { "$in": ids }, "last": { "$gt": floor } });
        let asked = doc! { "$filter": { "input": "$answers", "as": "answer",
        "cond": { "$in": ["$$answer._id", ids] } } };
        let find = find.projection(doc! { "answers": asked });
        let logged = collect(find, |found| {
            let answers =
                rows::members(found, "answers").map(|answer| rows::read_idempotency(answer?));
            answers.collect::<Result<Vec<_>, _>>()
        });
        let mut answers: Vec<IdempotencyRow> = logged.await?.into_iter().flatten().collect();
        answers.retain(|row| ids.contains(&row.id.as_str()));
        let find = tables.idempotency.find(doc! { "_id": { "$in": ids } });
        answers.extend(collect(find, rows::read_idempotency).await?);
        Ok(answers)
    }

    pub(super) async fn write_token(
        &self,
        token: &TokenRecord,
        audit: &AuditEntry,
    ) -> Result<(), StoreError> {
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
        let first =
            doc! { "$set": { "revoke_time": { "$ifNull": ["$revoke_time", time.as_millis()] } } };
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
        let tables = self.tables();
        let filter = doc! { "expire_time": { "$gt": DateTime::from_millis(now.as_millis()) } };
        let find = tables.tokens.find(filter).sort(doc! { "create_time": -1, "_id": -1 });
        collect(find, |found| rows::read_token(found)?.decode()).await
    }
}

fn keep_wanted(
    found: impl IntoIterator<Item = VersionRow>,
    wanted: &BTreeMap<&str, i64>,
    texts: &mut BTreeMap<String, String>,
) {
    let those = found.into_iter().filter(|row| wanted.get(row.key.as_str()) == Some(&row.revision));
    texts.extend(those.map(|row| (row.key, row.document)));
}

/// A projection that leaves those of a record's changes that are asked for.
fn only_of(condition: &Document) -> Document {
    let docs = doc! { "$filter": { "input": "$docs", "as": "doc", "cond": condition } };
    doc! { "last": 1, "batch": 1, "commits": 1, "docs": docs }
}

/// When a record wrote a revision; none if it is not in it.
pub(super) fn time_in(record: &Document, revision: i64) -> Result<Option<i64>, StoreError> {
    let first = rows::integer(record, "_id")?;
    let place = usize::try_from(revision - first).unwrap_or(usize::MAX);
    let commit = rows::members(record, "commits").nth(place).transpose()?;
    commit.map(|commit| rows::integer(commit, "time")).transpose()
}

/// Ids of entries are made in the order of their times, by the same clock: all that a query asks
/// for have an id above the first one, and below the last one.
fn ids_of(query: &AuditQuery) -> (String, Option<String>) {
    let oldest = now().as_millis() - AUDIT_KEPT_MS;
    let since = query.since.map_or(oldest, |since| since.as_millis().max(oldest));
    let until = query.until.map(|until| id_at(until.as_millis() + ID_SLACK_MS));
    let last = match (query.below.clone(), until) {
        (Some(below), Some(until)) => Some(below.min(until)),
        (below, until) => below.or(until),
    };
    (id_at(since - ID_SLACK_MS), last)
}

/// The least UUIDv7 of a time.
fn id_at(milliseconds: i64) -> String {
    let time = u64::try_from(milliseconds).unwrap_or(0).min((1 << 48) - 1);
    let digits = format!("{time:012x}");
    let (high, low) = digits.split_at(8);
    format!("{high}-{low}")
}

/// As [`audit_filter`], for one entry of several in a record.
fn is_asked_for(row: &AuditRow, query: &AuditQuery) -> bool {
    let is = |wanted: &Option<String>, found: Option<&str>| {
        wanted.is_none() || wanted.as_deref() == found
    };
    is(&query.subject, Some(&row.subject))
        && is(&query.kind, row.kind.as_deref())
        && is(&query.name, row.name.as_deref())
        && is(&query.action, Some(&row.action))
        && query.allowed.is_none_or(|allowed| allowed == row.allowed)
        && query.since.is_none_or(|since| row.time >= since.as_millis())
        && query.until.is_none_or(|until| row.time < until.as_millis())
        && query.below.as_ref().is_none_or(|below| row.id < *below)
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
