//! Removing what nobody needs any more. What expires by itself (audit, answers, tokens) is removed
//! by the server.
//!
//! ```text
//! documents brought to the floor ─▶ step by step, each one transaction: what outlives the log is copied, the floor rises
//!                                ─▶ versions to spare are removed ─▶ records below the floor are removed, later
//! ```
//!
//! Readers take the log first and what was copied last, so they miss nothing; what is below the
//! floor they take from the copies alone.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use mongodb::bson::{Document, doc};

use super::archive::time_in;
use super::client::{LONG, USUAL, limited};
use super::fold::advance;
use super::read::Part;
use super::rows::{Guard, Record};
use super::statements::{RECORD_COMMITS, update_command};
use super::{MongoStore, collect_within, rows};
use crate::store::encode::{signed, unsigned};
use crate::store::retain::{self, Trimmed, to_spare};
use crate::store::rows::VersionRow;
use crate::store::upkeep::now;
use crate::store::{AUDIT_KEPT_MS, READ_BYTES, StoreError};

/// Where the time by which records expire is kept.
const EXPIRY: &str = "expiry";
/// Records that one step moves, and versions that one command removes.
const STEP: usize = 1_000;
/// Documents whose versions are looked for at once.
const KEYS: usize = 100;
/// Records of the log that are read for them at once.
const LOGGED: usize = 200;
/// Revisions that are looked through before that is noted.
const PIECE: i64 = 10_000;
/// Bytes of the rows of one command, about.
const BYTES: usize = 8 * 1024 * 1024;

/// Revisions of documents.
type Revisions = BTreeMap<String, BTreeSet<i64>>;

impl MongoStore {
    /// Raises the floor, which readers see before anything goes, then removes.
    pub(super) async fn trim_to(&self, floor: u64, keep: u32) -> Result<u64, StoreError> {
        let head = signed(self.read_head().await?);
        let wanted = signed(floor).min(head);
        let expiry = self.expiry().await?.unwrap_or_else(|| now().as_millis());
        let mut guard = self.fold_until(wanted).await?;
        while guard.floor < wanted {
            self.move_some(guard, wanted, keep, expiry).await?;
            guard = self.read_guard().await?;
        }
        let now = Trimmed { floor: guard.floor, head, keep };
        self.remove_versions(now).await?;
        self.remove_records(guard.floor).await?;
        unsigned(guard.floor)
    }

    /// One step. If another process was faster, it has done nothing.
    async fn move_some(
        &self,
        guard: Guard,
        wanted: i64,
        keep: u32,
        expiry: i64,
    ) -> Result<(), StoreError> {
        let part = Part { after: guard.floor, records: STEP, bytes: READ_BYTES, whole: true };
        let (records, _) = self.read_records(part).await?;
        let floor = records.last().map_or(wanted, |record| record.last.min(wanted));
        let mut commands = vec![advance(guard.not_raised(floor), doc! { rows::FLOOR: floor })];
        commands.extend(copies(records, (guard.floor, floor), keep, expiry));
        self.guarded(commands).await?;
        Ok(())
    }

    /// In pieces, each of which is noted, so that a long history is got through at last.
    async fn remove_versions(&self, now: Trimmed) -> Result<(), StoreError> {
        let before = self.read_note().await?;
        let is_anew = before.keep != now.keep;
        for (number, (above, until)) in before.ranges_until(now).into_iter().enumerate() {
            let mut place = above;
            while let Some(next) = self.next_change(place).await?.filter(|next| *next <= until) {
                let end = until.min(next.saturating_add(PIECE));
                self.remove_versions_of(self.changed_keys(place, end).await?, now).await?;
                place = end;
                self.write_note(match (is_anew, number) {
                    (true, _) => Trimmed { floor: place.min(now.floor), head: place, ..now },
                    (false, 0) if above == before.floor => Trimmed { floor: place, ..before },
                    (false, _) => Trimmed { head: place, ..now },
                })
                .await?;
            }
        }
        self.write_note(now).await
    }

    async fn remove_versions_of(
        &self,
        keys: BTreeSet<String>,
        now: Trimmed,
    ) -> Result<(), StoreError> {
        let keys: Vec<String> = keys.into_iter().collect();
        for some in keys.chunks(KEYS) {
            let mut doomed = Vec::new();
            for (key, revisions) in self.revisions_of(some, now).await? {
                let revisions: Vec<i64> = revisions.into_iter().rev().collect();
                let gone = to_spare(&revisions, now.floor, now.keep);
                doomed.extend(gone.into_iter().map(|revision| rows::version_id(&key, revision)));
                if doomed.len() >= STEP {
                    self.remove_named(std::mem::take(&mut doomed)).await?;
                }
            }
            self.remove_named(doomed).await?;
        }
        Ok(())
    }

    /// The next revision that has versions, or a record in the log that reaches it.
    async fn next_change(&self, above: i64) -> Result<Option<i64>, StoreError> {
        let tables = self.tables();
        let kept = tables.versions.find_one(doc! { "revision": { "$gt": above } });
        let kept = kept.sort(doc! { "revision": 1 }).projection(doc! { "revision": 1 });
        let kept = limited(USUAL, kept).await?;
        let kept = kept.map(|found| rows::integer(&found, "revision")).transpose()?;
        let near = doc! {
            "_id": { "$gt": above.saturating_sub(RECORD_COMMITS) },
            "last": { "$gt": above },
        };
        let logged = tables.events.find_one(near).sort(doc! { "_id": 1 });
        let logged = limited(USUAL, logged.projection(doc! { "_id": 1 })).await?;
        let logged = logged.map(|found| rows::integer(&found, "_id")).transpose()?;
        let logged = logged.map(|first| first.max(above + 1));
        Ok(kept.into_iter().chain(logged).min())
    }

    /// Revisions of the versions of those documents that may have some to spare; of those in the
    /// log, at least as many of the newest as are kept.
    async fn revisions_of(&self, keys: &[String], now: Trimmed) -> Result<Revisions, StoreError> {
        let mut revisions = self.kept_revisions(keys).await?;
        // Of those up to the floor the newest holds there: one alone is not to spare, however many
        // follow.
        revisions.retain(|_, kept| kept.range(..=now.floor).nth(1).is_some());
        let count = usize::try_from(now.keep).unwrap_or(usize::MAX).max(1);
        let keys: Vec<&String> = revisions.keys().collect();
        let (mut logged, records) = self.logged_revisions(&keys, now, LOGGED).await?;
        if records >= LOGGED {
            // There may be older ones.
            for key in keys {
                if logged.get(key).is_none_or(|some| some.len() < count) {
                    logged.extend(self.logged_revisions(&[key], now, count).await?.0);
                }
            }
        }
        for (key, logged) in logged {
            revisions.entry(key).or_default().extend(logged);
        }
        Ok(revisions)
    }

    async fn kept_revisions(&self, keys: &[String]) -> Result<Revisions, StoreError> {
        let tables = self.tables();
        let each: Vec<Document> =
            keys.iter().map(|key| rows::versions_below(key, i64::MAX)).collect();
        let find = tables.versions.find(doc! { "$or": each }).projection(doc! { "_id": 1 });
        let mut kept = Revisions::new();
        collect_within(LONG, find, |found| {
            let id = rows::text(found, "_id")?;
            let (key, revision) = rows::split_version_id(&id)?;
            kept.entry(key.to_owned()).or_default().insert(revision);
            Ok(())
        })
        .await?;
        Ok(kept)
    }

    /// Revisions above the floor at which documents changed, in so many of the newest records of
    /// the log that hold any of them; and how many records these were.
    async fn logged_revisions(
        &self,
        keys: &[&String],
        now: Trimmed,
        most: usize,
    ) -> Result<(Revisions, usize), StoreError> {
        let tables = self.tables();
        let mut logged = Revisions::new();
        if keys.is_empty() {
            return Ok((logged, 0));
        }
        let find = tables
            .events
            .find(doc! {
                "docs.key": { "$in": keys },
                "_id": { "$gt": now.floor - RECORD_COMMITS },
                "last": { "$gt": now.floor },
            })
            .sort(doc! { "_id": -1 })
            .limit(i64::try_from(most).unwrap_or(i64::MAX))
            .projection(doc! { "docs.key": 1, "docs.revision": 1 });
        let records = collect_within(LONG, find, |found| {
            for change in rows::members(found, "docs") {
                let change = change?;
                let (key, revision) =
                    (rows::text(change, "key")?, rows::integer(change, "revision")?);
                if revision > now.floor && keys.binary_search(&&key).is_ok() {
                    logged.entry(key).or_default().insert(revision);
                }
            }
            Ok(())
        });
        let records = records.await?.len();
        Ok((logged, records))
    }

    async fn remove_named(&self, ids: Vec<String>) -> Result<(), StoreError> {
        let tables = self.tables();
        if !ids.is_empty() {
            limited(USUAL, tables.versions.delete_many(doc! { "_id": { "$in": ids } })).await?;
        }
        Ok(())
    }

    /// Documents that changed above one revision and up to another.
    async fn changed_keys(&self, above: i64, until: i64) -> Result<BTreeSet<String>, StoreError> {
        let tables = self.tables();
        let range = doc! { "revision": { "$gt": above, "$lte": until } };
        let find = tables.versions.find(range).projection(doc! { "_id": 1 });
        let kept = collect_within(LONG, find, |found| {
            Ok(rows::split_version_id(&rows::text(found, "_id")?)?.0.to_owned())
        });
        let mut keys: BTreeSet<String> = kept.await?.into_iter().collect();
        let range = doc! { "_id": { "$gt": above.saturating_sub(RECORD_COMMITS), "$lte": until } };
        let find = tables.events.find(range).projection(doc! { "docs.key": 1 });
        let logged = collect_within(LONG, find, |found| {
            let docs = rows::members(found, "docs");
            docs.map(|change| rows::text(change?, "key")).collect::<Result<Vec<_>, _>>()
        });
        keys.extend(logged.await?.into_iter().flatten());
        Ok(keys)
    }

    /// Moves on the time by which records expire.
    pub(super) async fn move_expiry(&self, clock: i64, most: Duration) -> Result<i64, StoreError> {
        let tables = self.tables();
        let before = match self.expiry().await? {
            None => self.newest_time().await?,
            before => before,
        };
        let time = retain::expiry_time(clock, before, most);
        let set = doc! { "$set": { "time": time } };
        let set = tables.meta.update_one(doc! { "_id": EXPIRY }, set).upsert(true);
        limited(USUAL, set).await?;
        Ok(time)
    }

    async fn expiry(&self) -> Result<Option<i64>, StoreError> {
        let tables = self.tables();
        let found = limited(USUAL, tables.meta.find_one(doc! { "_id": EXPIRY })).await?;
        found.map(|found| rows::integer(&found, "time")).transpose()
    }

    /// Time of the newest commit.
    async fn newest_time(&self) -> Result<Option<i64>, StoreError> {
        let tables = self.tables();
        let find = tables.events.find_one(doc! {}).sort(doc! { "_id": -1 });
        let find = find.projection(doc! { "commits.time": 1, "last": 1 });
        let Some(record) = limited(USUAL, find).await? else { return Ok(None) };
        let last = rows::integer(&record, "last")?;
        time_in(&record, last)
    }

    async fn write_note(&self, done: Trimmed) -> Result<(), StoreError> {
        let tables = self.tables();
        let note = doc! { "$set": { "floor": done.floor, "head": done.head,
        "keep": i64::from(done.keep) } };
        let note = tables.meta.update_one(doc! { "_id": "trimmed" }, note).upsert(true);
        limited(USUAL, note).await?;
        Ok(())
    }

    /// How far the last trimming came; what is not there means that everything is looked at.
    async fn read_note(&self) -> Result<Trimmed, StoreError> {
        let tables = self.tables();
        let found = limited(USUAL, tables.meta.find_one(doc! { "_id": "trimmed" })).await?;
        Ok(found.as_ref().and_then(note).unwrap_or_default())
    }
}

/// Commands that copy what outlives the commits above one revision and up to another. What has
/// expired at `now` does not.
fn copies(records: Vec<Record>, (above, until): (i64, i64), keep: u32, now: i64) -> Vec<Document> {
    let mut tables: BTreeMap<&str, Vec<Document>> = BTreeMap::new();
    let mut versions = Vec::new();
    for record in records {
        // Both are moved with the end of their record, so that each is moved once.
        if record.last <= until {
            let audit = record.audit.iter().filter(|row| row.time > now - AUDIT_KEPT_MS);
            tables.entry("audit").or_default().extend(audit.map(|row| {
                let mut new = rows::audit(row);
                new.remove("_id");
                doc! { "q": { "_id": &row.id }, "u": new, "upsert": true }
            }));
            let answers = record.answers.iter().filter(|row| row.expires > now);
            tables.entry("idempotency").or_default().extend(answers.map(|row| {
                let mut new = rows::idempotency(row);
                new.remove("_id");
                doc! { "q": { "_id": &row.id }, "u": new, "upsert": true }
            }));
        }
        versions.extend(record.versions);
    }
    versions.retain(|row| row.revision > above && row.revision <= until);
    let updates = worth_keeping(&versions, keep).into_iter().map(|row| {
        let mut new = rows::version(row);
        new.remove("_id");
        doc! { "q": { "_id": rows::version_id(&row.key, row.revision) }, "u": new, "upsert": true }
    });
    tables.insert("versions", updates.collect());
    let mut commands = Vec::new();
    for (table, updates) in tables {
        commands.extend(chunks(updates).into_iter().map(|some| update_command(table, some)));
    }
    commands
}

/// The newest of each document: those before them are to spare as soon as these are below the
/// floor.
fn worth_keeping(versions: &[VersionRow], keep: u32) -> Vec<&VersionRow> {
    let most = usize::try_from(keep).unwrap_or(usize::MAX).max(1);
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    let newest = versions.iter().rev().filter(|row| {
        let count = counts.entry(row.key.as_str()).or_default();
        *count += 1;
        *count <= most
    });
    newest.collect()
}

/// Updates in commands below the limit of the server.
fn chunks(updates: Vec<Document>) -> Vec<Vec<Document>> {
    super::upkeep::chunks(updates, BYTES)
}

fn note(found: &Document) -> Option<Trimmed> {
    Some(Trimmed {
        floor: rows::integer(found, "floor").ok()?,
        head: rows::integer(found, "head").ok()?,
        keep: u32::try_from(rows::integer(found, "keep").ok()?).ok()?,
    })
}
