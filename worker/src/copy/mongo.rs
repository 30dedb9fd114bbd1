//! The copy in a MongoDB, standalone or replica set: no transactions.
//!
//! ```text
//! replace   rows of a new generation ─▶ head: this generation, turn 1 ─▶ delete rows of earlier generations
//! advance   rows at turn n+1         ─▶ head: turn n to n+1           ─▶ delete rows of these keys before n+1
//!           (deletions as rows without text)                             ─▶ delete the rows without text
//! load      head ─▶ rows of its generation; of each key the one with the highest turn up to the head's ─▶ head again
//! ```
//!
//! The head moves by one update of one document, which MongoDB does wholly or not at all. Before it, a reader takes the old
//! rows, for the new ones have a generation or turn that the head does not name; after it, the new ones, for of two rows
//! of one key the later counts. Deleting only removes what no head names any more, the rows without text last: a row that
//! is still there is never again the newest of its key.
//!
//! A write whose answer is lost may reach the server late. So after a failure, and after a start, the next write is a
//! `replace`, with a generation of its own: rows that come late belong to one that counts no more, and a head that comes
//! late finds a newer generation and changes nothing. Generations begin with the time, later than that of the head.
//!
//! A head that names a later revision of the same store stays: another process wrote it, or this one in an earlier life.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use async_trait::async_trait;
use blaze_domain::config::{self, Key};
use blaze_domain::node_file::SecretText;
use blaze_domain::{LayerName, NodeName};
use futures::TryStreamExt as _;
use mongodb::bson::{Document, doc};
use mongodb::options::{ReadPreference, SelectionCriteria};
use tokio::sync::Mutex;

use super::mongo_client::{Server, Tables, is_duplicate};
use super::mongo_rows::{self as rows, Head, NOTES, Row};
use super::steps::Steps;
use super::{CopyError, Loaded, LocalCopy, Notes, Position, Vault, json, progress};

/// Rows and bytes of one insertion.
const ROWS: usize = 500;
const BYTES: usize = 4 * 1024 * 1024;
/// Keys whose old rows one operation deletes.
const KEYS: usize = 200;
/// How often the rows are read again when the head moves meanwhile.
const TRIES: usize = 3;
/// The copy in a MongoDB. It is connected to at the first use. Several workers may share a database: each has a copy of its
/// own, by layer and node.
pub struct MongoCopy {
    server: Server,
    copy: String,
    place: String,
    layer: LayerName,
    vault: Vault,
    steps: Steps,
    rows_at_once: usize,
    /// Held during a write. What this process wrote last; none at the start and after a failure.
    written: Mutex<Option<Written>>,
}

struct Written {
    generation: String,
    turn: i64,
    keys: BTreeSet<Key>,
}

impl MongoCopy {
    /// The copy of a layer's worker, or of the worker of one of its nodes.
    ///
    /// # Errors
    /// [`CopyError::Refused`] for a name that no database can have.
    pub fn new(
        uri: SecretText,
        database: &str,
        layer: LayerName,
        node: Option<&NodeName>,
        vault: Vault,
    ) -> Result<Self, CopyError> {
        // Names have no dot and no slash, so no two copies have the same name and none begins as another's rows do.
        let copy = node.map_or_else(|| layer.to_string(), |node| format!("{layer}.{node}"));
        let place = format!("MongoDB {database}, copy {copy}");
        Ok(Self {
            server: Server::new(uri, database, &copy, &place)?,
            place,
            copy,
            layer,
            vault,
            steps: Steps::default(),
            rows_at_once: ROWS,
            written: Mutex::new(None),
        })
    }

    #[cfg(test)]
    pub(super) fn crashing_after(mut self, steps: usize) -> Self {
        self.steps = Steps::crash_after(steps);
        self.rows_at_once = 1;
        self
    }

    fn broken(&self, detail: impl std::fmt::Display) -> CopyError {
        CopyError::Broken {
            place: self.place.clone(),
            detail: detail.to_string(),
        }
    }

    /// The head record. `preference` is who may answer: at the start also a member that is not the primary.
    async fn head(&self, tables: &Tables, preference: ReadPreference) -> Result<Option<Document>, CopyError> {
        let find = tables.head.find_one(doc! { "_id": &self.copy });
        self.server
            .limited(find.selection_criteria(SelectionCriteria::ReadPreference(preference)))
            .await
    }

    async fn insert(&self, tables: &Tables, generation: &str, turn: i64, all: &[Row]) -> Result<(), CopyError> {
        let mut left = all;
        while !left.is_empty() {
            let mut bytes = 0;
            let fits = |row: &&Row| {
                bytes += row.text.as_ref().map_or(0, String::len) + 256;
                bytes <= BYTES
            };
            let count = left.iter().take(self.rows_at_once).take_while(fits).count().max(1);
            let (now, rest) = left.split_at(count.min(left.len()));
            left = rest;
            self.steps.pass()?;
            let documents = now.iter().map(|row| rows::write_row(&self.copy, generation, turn, row));
            self.server
                .limited(tables.documents.insert_many(documents).ordered(false))
                .await?;
        }
        Ok(())
    }

    async fn delete(&self, tables: &Tables, filter: Document) -> Result<(), CopyError> {
        self.steps.pass()?;
        self.server
            .limited(tables.documents.delete_many(filter))
            .await
            .map(|_| ())
    }

    fn row(&self, document: &Arc<config::Document>) -> Result<Row, CopyError> {
        Ok(Row {
            key: document.key.to_string(),
            text: Some(self.vault.seal(document)?.to_json().to_string()),
        })
    }

    async fn write_whole(&self, whole: &Loaded) -> Result<Written, CopyError> {
        let mut all = vec![notes_row(&whole.notes)];
        for document in &whole.documents {
            all.push(self.row(document)?);
        }
        let tables = self.server.tables().await?;
        let present = self.head(&tables, ReadPreference::Primary).await?;
        match present.as_ref().map(|present| rows::read_head(present, &self.place)) {
            // An older version would lose what the newer one keeps there.
            Some(Err(error @ CopyError::NewerFormat { .. })) => return Err(error),
            Some(Ok(held)) => progress::check_whole(Some(&held.position), &whole.position, &self.place)?,
            Some(Err(_)) | None => {}
        }
        let present = present.as_ref().and_then(|present| present.get_str("generation").ok());
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let generation = rows::new_generation(u64::try_from(now.as_millis()).unwrap_or(0), present);
        self.insert(&tables, &generation, 1, &all).await?;
        let head = Head {
            generation: generation.clone(),
            turn: 1,
            documents: count(whole.documents.len()),
            position: whole.position.clone(),
        };
        self.steps.pass()?;
        let update = doc! { "$set": rows::write_head(&head) };
        let older = rows::older_head(&self.copy, &head);
        let moved = tables.head.update_one(older, update).upsert(true);
        match self.server.within(moved).await? {
            Err(error) if is_duplicate(&error) => return Err(self.taken(&whole.position)),
            moved => moved.map_err(|error| self.server.failed(&error)).map(|_| ())?,
        }
        self.delete(&tables, rows::of_earlier(&self.copy, &generation)).await?;
        Ok(Written {
            generation,
            turn: 1,
            keys: whole.documents.iter().map(|document| document.key.clone()).collect(),
        })
    }

    /// Another process writes this copy.
    fn taken(&self, position: &Position) -> CopyError {
        CopyError::Behind {
            place: self.place.clone(),
            revision: position.revision,
            detail: "another worker of this layer and node has written it meanwhile".to_owned(),
        }
    }

    async fn write_commits(
        &self,
        mut written: Written,
        position: &Position,
        (puts, removes): (&[Arc<config::Document>], &[Key]),
        notes: Option<&Notes>,
    ) -> Result<Written, CopyError> {
        let mut all: Vec<Row> = notes.map(notes_row).into_iter().collect();
        for document in puts {
            all.push(self.row(document)?);
            written.keys.insert(document.key.clone());
        }
        let is_put: BTreeSet<&Key> = puts.iter().map(|document| &document.key).collect();
        let mut gone = Vec::new();
        for key in removes.iter().filter(|key| !is_put.contains(key)) {
            // What was not there needs no row.
            if written.keys.remove(key) {
                let (key, text) = (key.to_string(), None);
                gone.push(Row { key, text });
            }
        }
        let gone_at = all.len();
        all.append(&mut gone);
        let tables = self.server.tables().await?;
        let (generation, turn) = (written.generation.as_str(), written.turn + 1);
        self.insert(&tables, generation, turn, &all).await?;
        let head = Head {
            generation: generation.to_owned(),
            turn,
            documents: count(written.keys.len()),
            position: position.clone(),
        };
        self.steps.pass()?;
        let here = doc! { "_id": &self.copy, "generation": generation, "turn": written.turn };
        let update = doc! { "$set": rows::write_head(&head) };
        let moved = self.server.limited(tables.head.update_one(here, update)).await?;
        if moved.matched_count != 1 {
            return Err(self.taken(position));
        }
        for some in all.chunks(KEYS) {
            let old = some
                .iter()
                .map(|row| rows::before_turn(&self.copy, generation, &row.key, turn));
            self.delete(&tables, doc! { "$or": old.collect::<Vec<_>>() }).await?;
        }
        // Only now: before, one of them may have hidden an older row.
        for some in all.get(gone_at..).unwrap_or_default().chunks(KEYS) {
            let ids = some
                .iter()
                .map(|row| rows::row_id(&self.copy, generation, &row.key, turn));
            self.delete(&tables, doc! { "_id": { "$in": ids.collect::<Vec<_>>() } })
                .await?;
        }
        written.turn = turn;
        Ok(written)
    }

    /// The rows that count, by key.
    async fn rows(&self, tables: &Tables, head: &Head) -> Result<BTreeMap<String, String>, CopyError> {
        let read = async {
            let find = tables.documents.find(rows::of_generation(&self.copy, &head.generation));
            let nearest = SelectionCriteria::ReadPreference(primary_preferred());
            let mut cursor = find.sort(doc! { "_id": 1 }).selection_criteria(nearest).await?;
            let mut found = BTreeMap::new();
            let mut strange = 0_usize;
            while let Some(row) = cursor.try_next().await? {
                match rows::read_row(&row, &self.copy, &head.generation) {
                    Some((_, turn, _)) if turn > head.turn => {}
                    // They come in the order of their turns.
                    Some((key, _, Some(text))) => drop(found.insert(key.to_owned(), text.to_owned())),
                    Some((key, _, None)) => drop(found.remove(key)),
                    None => strange += 1,
                }
            }
            Ok((found, strange))
        };
        match self.server.limited(read).await? {
            (found, 0) => Ok(found),
            (_, strange) => Err(self.broken(format_args!("{strange} rows have another form"))),
        }
    }

    fn read(&self, head: Head, mut found: BTreeMap<String, String>) -> Result<Loaded, CopyError> {
        let notes = found
            .remove(NOTES)
            .ok_or_else(|| self.broken("its notes are missing"))?;
        if count(found.len()) != head.documents {
            return Err(self.broken(format_args!("it has {} documents of {}", found.len(), head.documents)));
        }
        let notes = json::value_from_text(notes.as_bytes()).and_then(json::notes_from_json);
        let mut documents = Vec::with_capacity(found.len());
        let mut lost = 0;
        for text in found.into_values() {
            let document = json::document_from_text(text.as_bytes()).map_err(|error| self.broken(error))?;
            let (document, unopened) = self.vault.open(document);
            lost += unopened;
            documents.push(Arc::new(document));
        }
        if lost > 0 {
            tracing::warn!(copy = self.place, lost, "secrets of the local database do not open");
        }
        documents.sort_by(|one, other| one.key.cmp(&other.key));
        Ok(Loaded {
            position: head.position,
            documents,
            notes: Arc::new(notes.map_err(|error| self.broken(error))?),
        })
    }
}

#[async_trait]
impl LocalCopy for MongoCopy {
    async fn load(&self) -> Result<Option<Loaded>, CopyError> {
        let tables = self.server.tables().await?;
        let mut before = self.head(&tables, primary_preferred()).await?;
        for _ in 0..TRIES {
            let Some(found) = before else { return Ok(None) };
            let head = rows::read_head(&found, &self.place)?;
            if head.position.layer != self.layer {
                return Err(CopyError::OtherLayer {
                    place: self.place.clone(),
                    found: head.position.layer,
                    wanted: self.layer.clone(),
                });
            }
            let all = self.rows(&tables, &head).await;
            // Rows that the head names are deleted only after it has moved.
            let after = self.head(&tables, primary_preferred()).await?;
            if after.as_ref() == Some(&found) {
                return self.read(head, all?).map(Some);
            }
            before = after;
        }
        Err(CopyError::Away {
            place: self.place.clone(),
            detail: "it is written all the time".to_owned(),
        })
    }

    async fn replace(&self, whole: &Loaded) -> Result<(), CopyError> {
        let mut written = self.written.lock().await;
        // Also when this future is dropped halfway, the next write has a generation of its own.
        *written = None;
        *written = Some(self.write_whole(whole).await?);
        Ok(())
    }

    async fn advance(
        &self,
        position: &Position,
        puts: &[Arc<config::Document>],
        removes: &[Key],
        notes: Option<&Notes>,
    ) -> Result<(), CopyError> {
        let mut held = self.written.lock().await;
        let Some(written) = held.take() else {
            return Err(CopyError::Behind {
                place: self.place.clone(),
                revision: position.revision,
                detail: "the first write, and the one after a failure, writes everything".to_owned(),
            });
        };
        let tables = self.server.tables().await?;
        let head = self.head(&tables, ReadPreference::Primary).await?;
        let head = head.map(|head| rows::read_head(&head, &self.place)).transpose()?;
        progress::check(head.as_ref().map(|head| &head.position), position, &self.place)?;
        *held = Some(self.write_commits(written, position, (puts, removes), notes).await?);
        Ok(())
    }

    fn describe(&self) -> String {
        self.place.clone()
    }
}

fn primary_preferred() -> ReadPreference {
    ReadPreference::PrimaryPreferred { options: None }
}

fn notes_row(notes: &Notes) -> Row {
    Row {
        key: NOTES.to_owned(),
        text: Some(json::notes_to_json(notes).to_string()),
    }
}

fn count(length: usize) -> i64 {
    i64::try_from(length).unwrap_or(i64::MAX)
}

#[cfg(test)]
#[path = "mongo_tests.rs"]
mod tests;
