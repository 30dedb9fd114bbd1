//! Reading the log and the documents.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::time::Duration;

use futures::TryStreamExt as _;
use mongodb::bson::{Document, doc, rawdoc};
use mongodb::error::Error;
use mongodb::{ClientSession, Database};
use tokio::time::Instant;

use super::MongoStore;
use super::client::{LONG, QUICK, Tables, USUAL, limited, limited_steps};
use super::errors::{is_snapshot_unavailable, store_error};
use super::fence::since_boot;
use super::rows::{self, FLOOR, Guard, Record};
use super::statements::RECORD_COMMITS;
use crate::store::encode::{corrupt, decode_commits, signed, unsigned};
use crate::store::rows::{DocumentRow, EventRow, VersionRow};
use crate::store::{CommitBatch, READ_BYTES, Snapshot, StoreError};

/// Just after collections were made there is no snapshot of them for a moment.
const NO_SNAPSHOT: Duration = Duration::from_secs(5);

/// Records that the database sends at once, at least.
const LEAST_BATCH: usize = 3;

/// Which commits are read together.
#[derive(Debug, Clone, Copy)]
pub(super) struct Part {
    /// Those with a revision above.
    pub(super) after: i64,
    /// At most so many records.
    pub(super) records: usize,
    /// At most so many bytes, about.
    pub(super) bytes: i64,
    /// With audit and answers.
    pub(super) whole: bool,
}

impl MongoStore {
    /// The newest revision that a majority has.
    pub(super) async fn read_head(&self) -> Result<u64, StoreError> {
        let tables = self.tables();
        let asked = since_boot();
        let head = newest(&tables).await?;
        self.fence.lock().newest_was(signed(head), asked, since_boot());
        Ok(head)
    }

    pub(super) async fn read_floor(&self) -> Result<u64, StoreError> {
        unsigned(self.read_guard().await?.floor)
    }

    pub(super) async fn has_guard(&self) -> Result<bool, StoreError> {
        let tables = self.tables();
        let found = limited(QUICK, tables.documents.find_one(doc! { "_id": FLOOR })).await?;
        Ok(found.is_some())
    }

    pub(super) async fn read_guard(&self) -> Result<Guard, StoreError> {
        let tables = self.tables();
        guard(&tables).await
    }

    /// Everything in one snapshot.
    pub(super) async fn read_all(&self) -> Result<Snapshot, StoreError> {
        let until = Instant::now() + NO_SNAPSHOT;
        loop {
            match limited_steps(LONG, async { Ok(self.read_snapshot().await) }).await? {
                Ok(snapshot) => return snapshot,
                Err(error) if is_snapshot_unavailable(&error) && Instant::now() < until => {
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
                Err(error) => return Err(store_error(error)),
            }
        }
    }

    async fn read_snapshot(&self) -> Result<Result<Snapshot, StoreError>, Error> {
        let tables = self.tables();
        // A snapshot session brings its read concern; one of the collection would stand in its way.
        let plain = tables.client.database(tables.database.name());
        let mut session = tables.client.start_session().snapshot(true).await?;
        let meta = plain.collection::<Document>("meta");
        let meta = meta.find_one(doc! { "_id": "store" }).session(&mut session).await?;
        let documents = plain.collection::<Document>("documents");
        let mut cursor = documents.find(doc! {}).session(&mut session).await?;
        let mut found = Vec::new();
        while let Some(document) = cursor.next(&mut session).await.transpose()? {
            found.push(document);
        }
        let parts = match parts(meta.as_ref(), &found) {
            Ok(parts) => parts,
            Err(error) => return Ok(Err(error)),
        };
        match records_in(&plain, &mut session, parts.guard.folded).await? {
            Ok(records) => Ok(parts.with(records)),
            Err(error) => Ok(Err(error)),
        }
    }

    /// Commits after a revision, then the floor.
    pub(super) async fn read_commits(
        &self,
        after: u64,
        limit: usize,
    ) -> Result<CommitBatch, StoreError> {
        let asked = since_boot();
        let part =
            Part { after: signed(after), records: limit.max(1), bytes: READ_BYTES, whole: false };
        let (records, all) = self.read_records(part).await?;
        let floor = self.read_floor().await?;
        if floor > after {
            // Some of it may have been removed while it was read.
            return Ok(CommitBatch { commits: Vec::new(), floor });
        }
        if let Some(last) = records.last().filter(|_| all) {
            self.fence.lock().newest_was(last.last, asked, since_boot());
        }
        let (mut events, mut versions) = (Vec::new(), Vec::new());
        for record in records {
            events.extend(record.events);
            versions.extend(record.versions);
        }
        events.retain(|event| event.revision > signed(after));
        versions.retain(|version| version.revision > signed(after));
        shorten(&mut events, limit.max(1));
        let last = events.last().map_or(0, |event| event.revision);
        versions.retain(|version| version.revision <= last);
        Ok(CommitBatch { commits: decode_commits(after, events, versions)?, floor })
    }

    /// Records with commits after a revision, ascending, as many as may be but at least one; and
    /// whether these are all. The first one may begin with older commits.
    pub(super) async fn read_records(&self, part: Part) -> Result<(Vec<Record>, bool), StoreError> {
        let next = doc! { "_id": { "$gt": part.after } };
        let (mut records, all) = self.find_records(next, part).await?;
        if records.first().is_none_or(|record| record.first != part.after + 1) {
            // The next commit is in the middle of a record, or there is none.
            records.splice(0..0, self.find_around(part.after).await?);
        }
        self.complete(&mut records).await?;
        Ok((records, all))
    }

    /// The record that has both a revision and the next one.
    async fn find_around(&self, revision: i64) -> Result<Vec<Record>, StoreError> {
        let tables = self.tables();
        let pipeline = [
            doc! { "$match": { "_id": { "$lte": revision } } },
            doc! { "$sort": { "_id": -1 } },
            doc! { "$limit": 1 },
            doc! { "$match": { "last": { "$gt": revision } } },
        ];
        super::collect(tables.events.aggregate(pipeline), rows::read_record).await
    }

    async fn find_records(
        &self,
        filter: Document,
        part: Part,
    ) -> Result<(Vec<Record>, bool), StoreError> {
        let tables = self.tables();
        let mut find = tables.events.find(filter).sort(doc! { "_id": 1 });
        find = find.batch_size(batch(part, self.record_bytes.load(Ordering::Relaxed)));
        if !part.whole {
            find = find.projection(doc! { "audit": 0, "answers": 0 });
        }
        limited_steps(USUAL, async {
            let mut cursor = find.await.map_err(store_error)?;
            let mut records: Vec<Record> = Vec::new();
            let (mut bytes, mut count) = (0, 0);
            while let Some(found) = cursor.try_next().await.map_err(store_error)? {
                let record = rows::read_record(&found)?;
                bytes += record.bytes();
                count += 1;
                self.record_bytes.store(bytes / count, Ordering::Relaxed);
                let is_full = records.len() >= part.records || bytes > part.bytes;
                records.push(record);
                // One more tells whether there are more, and whether the last one came too late.
                if is_full && records.len() > 1 {
                    drop_late(&mut records);
                    if records.len() > 1 {
                        records.pop();
                        return Ok((records, false));
                    }
                }
            }
            drop_late(&mut records);
            Ok((records, true))
        })
        .await
    }

    /// Adds the changes that records had no room for.
    async fn complete(&self, records: &mut [Record]) -> Result<(), StoreError> {
        let tables = self.tables();
        let lacking: Vec<i64> = records.iter().flat_map(Record::incomplete).collect();
        if lacking.is_empty() {
            return Ok(());
        }
        let find = tables.versions.find(doc! { "revision": { "$in": lacking } });
        fill(records, super::collect(find, rows::read_version).await?);
        Ok(())
    }
}

/// How many records the database shall send at once, if they are as large as those before:
/// otherwise it sends a hundred and one, or 16 MiB of them, however few are wanted. If they are
/// small after large ones, a few at once still do.
fn batch(part: Part, record_bytes: i64) -> u32 {
    let within = usize::try_from(part.bytes / record_bytes.max(1)).unwrap_or(usize::MAX);
    let one_more = within.max(LEAST_BATCH).min(part.records).saturating_add(1);
    u32::try_from(one_more).unwrap_or(u32::MAX)
}

/// The newest revision that a majority has.
pub(super) async fn newest(tables: &Tables) -> Result<u64, StoreError> {
    // An index has all of it: the record itself may be large, and this is asked for by nearly every
    // read. Not the largest `last`: that may be of a record that came too late, and lies under
    // others.
    let newest = rawdoc! {
        "find": "events", "filter": {}, "projection": { "_id": 0, "last": 1 },
        "sort": { "_id": -1 }, "limit": 1,
        "hint": "newest", "singleBatch": true, "readConcern": { "level": "majority" },
    };
    let answer = limited(QUICK, tables.database.run_raw_command(newest)).await?;
    let batch = answer.get_document("cursor").ok();
    let found = batch.and_then(|batch| rows::members(batch, "firstBatch").next());
    match found.transpose()? {
        Some(found) => unsigned(rows::integer(found, "last")?),
        // All commits up to the floor are gone, and none came after it.
        None => unsigned(guard(tables).await?.floor),
    }
}

async fn guard(tables: &Tables) -> Result<Guard, StoreError> {
    let found = limited(QUICK, tables.documents.find_one(doc! { "_id": FLOOR })).await?;
    Guard::read(&found.ok_or_else(|| corrupt("the floor is missing"))?)
}

/// Puts changes into the records of their commits. A copy of one that is there already changes
/// nothing.
fn fill(records: &mut [Record], found: Vec<VersionRow>) {
    for version in found {
        let place = records
            .iter_mut()
            .find(|record| (record.first..=record.last).contains(&version.revision));
        if let Some(record) = place {
            record.versions.push(version);
        }
    }
    for record in records {
        record.versions.sort_by_key(|version| (version.revision, version.position));
        record.versions.dedup_by_key(|version| (version.revision, version.position));
    }
}

/// The first `limit`, and about [`READ_BYTES`] of them.
fn shorten(events: &mut Vec<EventRow>, limit: usize) {
    let mut bytes = 0;
    let within = |event: &&EventRow| {
        bytes += event.bytes;
        bytes <= READ_BYTES
    };
    let fitting = events.iter().take_while(within).count();
    events.truncate(fitting.max(1).min(limit));
}

/// All records after a revision, as a snapshot has them.
pub(super) async fn records_in(
    plain: &Database,
    session: &mut ClientSession,
    after: i64,
) -> Result<Result<Vec<Record>, StoreError>, Error> {
    let events = plain.collection::<Document>("events");
    let find =
        events.find(doc! { "last": { "$gt": after }, "_id": { "$gt": after - RECORD_COMMITS } });
    let mut cursor = find.sort(doc! { "_id": 1 }).session(&mut *session).await?;
    let mut records = Vec::new();
    while let Some(found) = cursor.next(&mut *session).await.transpose()? {
        match rows::read_record(&found) {
            Ok(record) => records.push(record),
            Err(error) => return Ok(Err(error)),
        }
    }
    drop_late(&mut records);
    let lacking: Vec<i64> = records.iter().flat_map(Record::incomplete).collect();
    if !lacking.is_empty() {
        let versions = plain.collection::<Document>("versions");
        let find = versions.find(doc! { "revision": { "$in": lacking } });
        let mut cursor = find.session(&mut *session).await?;
        let mut rest = Vec::new();
        while let Some(found) = cursor.next(&mut *session).await.transpose()? {
            match rows::read_version(&found) {
                Ok(version) => rest.push(version),
                Err(error) => return Ok(Err(error)),
            }
        }
        fill(&mut records, rest);
    }
    Ok(Ok(records))
}

/// Leaves out records under which others lie, which came too late: see [`super::fence`].
fn drop_late(records: &mut Vec<Record>) {
    let mut next = i64::MAX;
    let mut kept: Vec<Record> = Vec::with_capacity(records.len());
    for record in records.drain(..).rev() {
        if record.last < next {
            next = record.first;
            kept.push(record);
        }
    }
    kept.reverse();
    *records = kept;
}

/// What a snapshot is made of, but for the commits that the documents lack.
struct Parts {
    store_id: String,
    guard: Guard,
    documents: BTreeMap<String, DocumentRow>,
}

fn parts(meta: Option<&Document>, found: &[Document]) -> Result<Parts, StoreError> {
    let meta = meta.ok_or_else(|| corrupt("the store's identity is missing"))?;
    let mut guard = None;
    let mut documents = BTreeMap::new();
    for document in found {
        match document.get_str("_id") {
            Ok(FLOOR) => guard = Some(Guard::read(document)?),
            _ => {
                let row = rows::read_document(document)?;
                documents.insert(row.key.clone(), row);
            }
        }
    }
    Ok(Parts {
        store_id: rows::text(meta, "store_id")?,
        guard: guard.ok_or_else(|| corrupt("the floor is missing"))?,
        documents,
    })
}

impl Parts {
    fn with(mut self, records: Vec<Record>) -> Result<Snapshot, StoreError> {
        let newest = records.last().map_or(self.guard.folded, |record| record.last);
        let versions = records.into_iter().flat_map(|record| record.versions);
        for version in versions.filter(|version| version.revision > self.guard.folded) {
            match version.is_deletion() {
                true => self.documents.remove(&version.key),
                false => self.documents.insert(version.key.clone(), version.into_current()),
            };
        }
        let documents = self.documents.into_values().map(DocumentRow::into_document);
        Ok(Snapshot {
            store_id: self.store_id,
            floor: unsigned(self.guard.floor)?,
            revision: unsigned(newest.max(self.guard.floor))?,
            documents: documents.collect::<Result<_, _>>()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_database_sends_about_as_much_as_is_wanted() {
        let part = |records, bytes| Part { after: 0, records, bytes, whole: false };
        assert_eq!(batch(part(1_000, 1 << 20), 16 << 10), 65);
        assert_eq!(batch(part(1_000, 1 << 20), 1), 1_001);
        assert_eq!(batch(part(1, 8 << 20), 16 << 10), 2);
        assert_eq!(batch(part(1_000, 1 << 20), 9 << 20), 4, "small ones may follow");
        assert_eq!(batch(part(usize::MAX, i64::MAX), 0), u32::MAX);
    }

    fn version(key: &str, revision: i64, op: &str) -> VersionRow {
        VersionRow {
            key: key.to_owned(),
            revision,
            position: 0,
            op: op.to_owned(),
            previous: None,
            time: 0,
            subject: String::new(),
            request_id: String::new(),
            paths: "[]".to_owned(),
            document: crate::store::encode::document_text(&crate::store::samples::node("x", 1))
                .unwrap(),
        }
    }

    #[test]
    fn a_store_without_commits_is_at_its_floor() {
        let meta = doc! { "_id": "store", "store_id": "s" };
        let floor = doc! {
            "_id": FLOOR,
            "floor": 9_i64,
            "folded": 9_i64,
            "turn": 0_i64,
            "rewrites": 0_i64,
        };
        let found = parts(Some(&meta), std::slice::from_ref(&floor)).unwrap();
        let found = found.with(Vec::new()).unwrap();
        assert_eq!((found.revision, found.floor, found.documents.len()), (9, 9, 0));
        assert!(parts(Some(&meta), &[]).is_err());
        assert!(parts(None, &[floor]).is_err());
    }

    #[test]
    fn commits_that_the_documents_lack_are_added() {
        let meta = doc! { "_id": "store", "store_id": "s" };
        let text = version("", 0, "").document;
        let found = [
            doc! {
                "_id": FLOOR,
                "floor": 2_i64,
                "folded": 5_i64,
                "turn": 0_i64,
                "rewrites": 0_i64,
            },
            doc! { "_id": "Node/a", "revision": 5_i64, "document": &text },
            doc! { "_id": "Node/b", "revision": 5_i64, "document": &text },
        ];
        let record = Record {
            first: 5,
            last: 8,
            versions: vec![
                version("Node/z", 5, "create"),
                version("Node/c", 6, "create"),
                version("Node/a", 7, "delete"),
                version("Node/c", 8, "delete"),
                version("Node/d", 8, "create"),
            ],
            ..Record::default()
        };
        let found = parts(Some(&meta), &found).unwrap().with(vec![record]).unwrap();
        let keys: Vec<String> =
            found.documents.iter().map(|document| document.key.to_string()).collect();
        assert_eq!(keys, ["Node/b", "Node/d"]);
        assert_eq!((found.revision, found.floor), (8, 2));
    }

    #[test]
    fn a_record_under_others_came_too_late() {
        let record = |(first, last)| Record { first, last, ..Record::default() };
        for (found, left) in [
            (vec![(1, 2), (3, 3), (4, 9)], vec![1, 3, 4]),
            (vec![(1, 5), (3, 3), (4, 9)], vec![3, 4]),
            (vec![(2, 3), (3, 3)], vec![3]),
            (vec![(1, 2), (3, 7), (5, 7)], vec![1, 5]),
            (vec![], vec![]),
        ] {
            let mut records: Vec<Record> = found.into_iter().map(record).collect();
            drop_late(&mut records);
            let firsts: Vec<i64> = records.iter().map(|record| record.first).collect();
            assert_eq!(firsts, left);
        }
    }

    #[test]
    fn what_was_read_twice_is_there_once() {
        let mut records = [Record {
            first: 1,
            last: 2,
            versions: vec![version("Node/a", 1, "create")],
            ..Record::default()
        }];
        let mut second = version("Node/b", 1, "create");
        second.position = 1;
        fill(
            &mut records,
            vec![second.clone(), version("Node/a", 1, "create"), version("Node/a", 2, "update")],
        );
        let keys: Vec<&str> =
            records[0].versions.iter().map(|version| version.key.as_str()).collect();
        assert_eq!(keys, ["Node/a", "Node/b", "Node/a"]);
    }
}
