//! The copy in a MongoDB, standalone or replica set: no transactions.
//!
//! ```text
//! replace   delete what earlier tries left ─▶ chunks of a new generation ─▶ head: from the old generation to this one
//!           ─▶ delete chunks of earlier ones
//! load      head ─▶ chunks of its generation ─▶ head again
//! ```
//!
//! The head moves by one update of one document, which MongoDB does wholly or not at all, and only
//! from the generation that was there before. So a write that reaches the server late changes
//! nothing, and of two workers that write at once one tries again. Deleting only removes
//! generations that no head names any more. Generations begin with the time, later than that of the
//! head.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use async_trait::async_trait;
use blaze_domain::config::Timestamp;
use blaze_domain::node_file::MongoSection;
use blaze_domain::{LayerName, NodeName};
use futures::TryStreamExt as _;
use mongodb::bson::spec::BinarySubtype;
use mongodb::bson::{Binary, Bson, Document, doc};
use mongodb::options::{ReadPreference, SelectionCriteria};

use super::mongo_client::{Server, Tables, is_duplicate};
use super::{CopyError, Loaded, LocalCopy, Position, Vault, format};

/// Bytes of a chunk: each must arrive within the time of one operation, also over a slow link.
const CHUNK_BYTES: usize = 1024 * 1024;
/// Limit for all chunks of a write.
const CHUNKS_WITHIN: Duration = Duration::from_secs(300);
/// Age of a generation without a head that is deleted; twice the time that its chunks may take.
const LEFT_BEHIND: Duration = Duration::from_secs(600);
/// How often the chunks are read again when the head moves meanwhile.
const TRIES: usize = 3;

/// The copy in a MongoDB. It is connected to at the first use. Several workers may share a
/// database: each has a copy of its own, by layer and node.
pub struct MongoCopy {
    server: Server,
    copy: String,
    place: String,
    layer: LayerName,
    vault: Arc<Vault>,
}

impl MongoCopy {
    /// The copy of a layer's worker, or of the worker of one of its nodes.
    #[must_use]
    pub fn new(
        section: MongoSection,
        layer: LayerName,
        node: Option<&NodeName>,
        vault: Vault,
    ) -> Self {
        // Names have no dot and no slash: no two copies have one name, and no name begins as the
        // chunks of another copy do.
        let copy = node.map_or_else(|| layer.to_string(), |node| format!("{layer}.{node}"));
        let place = format!("MongoDB {}, copy {copy}", section.database);
        Self {
            server: Server::new(section, &copy, &place),
            place,
            copy,
            layer,
            vault: Arc::new(vault),
        }
    }

    /// The head record. `preference`: which members may answer; at the start also one that is not
    /// the primary.
    async fn head(
        &self,
        tables: &Tables,
        preference: ReadPreference,
    ) -> Result<Option<Document>, CopyError> {
        let find = tables.head.find_one(doc! { "_id": &self.copy });
        self.server
            .limited(find.selection_criteria(SelectionCriteria::ReadPreference(preference)))
            .await
    }

    /// Whether a copy with this head may be replaced.
    fn check(&self, head: &Document, next: &Position) -> Result<(), CopyError> {
        let number = |name: &str| integer(head, name).and_then(|number| u64::try_from(number).ok());
        let format = number("format").unwrap_or(0);
        // An older version would lose what the newer one keeps there.
        if format > format::FORMAT {
            return Err(CopyError::NewerFormat {
                place: self.place.clone(),
                found: format,
                known: format::FORMAT,
            });
        }
        let held = Position {
            store_id: head.get_str("store_id").unwrap_or_default().to_owned(),
            layer: next.layer.clone(),
            revision: number("revision").unwrap_or(0),
            as_of: Timestamp::default(),
        };
        held.check_replaced_by(next, &self.place)
    }

    async fn chunks(&self, tables: &Tables, generation: &str) -> Result<Vec<u8>, CopyError> {
        let read = async {
            let nearest = SelectionCriteria::ReadPreference(primary_preferred());
            let find = tables.chunks.find(of_generation(&self.copy, generation));
            let mut cursor = find.sort(doc! { "_id": 1 }).selection_criteria(nearest).await?;
            let mut content = Vec::new();
            while let Some(chunk) = cursor.try_next().await? {
                // What is missing or has another form does not fit the hash.
                content.extend_from_slice(
                    chunk.get_binary_generic("data").map_or(&[][..], |data| data),
                );
            }
            Ok(content)
        };
        self.server.limited(read).await
    }

    async fn put_chunks(
        &self,
        tables: &Tables,
        generation: &str,
        content: &[u8],
    ) -> Result<(), CopyError> {
        for (number, chunk) in content.chunks(CHUNK_BYTES).enumerate() {
            let data = Binary { subtype: BinarySubtype::Generic, bytes: chunk.to_vec() };
            let chunk =
                doc! { "_id": format!("{}/{generation}/{number:08x}", self.copy), "data": data };
            self.server.limited(tables.chunks.insert_one(chunk)).await?;
        }
        Ok(())
    }

    async fn write(&self, content: &[u8], position: &Position) -> Result<(), CopyError> {
        let tables = self.server.tables().await?;
        let present = self.head(&tables, ReadPreference::Primary).await?;
        if let Some(present) = &present {
            self.check(present, position)?;
        }
        let before = present.as_ref().and_then(|present| present.get("generation"));
        let generation = new_generation(now_ms(), before.and_then(Bson::as_str));
        let old =
            now_ms().saturating_sub(u64::try_from(LEFT_BEHIND.as_millis()).unwrap_or(u64::MAX));
        let left = of_left_behind(&self.copy, before.and_then(Bson::as_str), old);
        self.server.limited(tables.chunks.delete_many(left)).await?;
        let put =
            tokio::time::timeout(CHUNKS_WITHIN, self.put_chunks(&tables, &generation, content));
        put.await.map_err(|_| CopyError::Away {
            place: self.place.clone(),
            detail: format!("not written within {} s", CHUNKS_WITHIN.as_secs()),
        })??;
        let revision = i64::try_from(position.revision).unwrap_or(i64::MAX);
        let head = doc! {
            "format": i64::try_from(format::FORMAT).unwrap_or(i64::MAX), "generation": &generation,
            "store_id": &position.store_id, "revision": revision,
        };
        // `null` also matches a head that has none.
        let from = doc! { "_id": &self.copy, "generation": before.cloned().unwrap_or(Bson::Null) };
        let moved = tables.head.update_one(from, doc! { "$set": head }).upsert(true);
        match self.server.within(moved).await? {
            Ok(_) => {}
            Err(error) if is_duplicate(&error) => {
                let place = self.place.clone();
                return Err(CopyError::Raced { place });
            }
            Err(error) => return Err(self.server.failed(&error)),
        }
        let earlier = of_earlier(&self.copy, &generation);
        self.server.limited(tables.chunks.delete_many(earlier)).await.map(|_| ())
    }
}

#[async_trait]
impl LocalCopy for MongoCopy {
    async fn load(&self) -> Result<Option<Loaded>, CopyError> {
        let tables = self.server.tables().await?;
        let mut before = self.head(&tables, primary_preferred()).await?;
        for _ in 0..TRIES {
            let Some(head) = before else { return Ok(None) };
            let generation = head.get_str("generation").unwrap_or_default();
            let content = self.chunks(&tables, generation).await;
            // Chunks that the head names are deleted only after it has moved.
            let after = self.head(&tables, primary_preferred()).await?;
            if after.as_ref() == Some(&head) {
                return format::decode(&content?, &self.place, &self.layer, &self.vault).map(Some);
            }
            before = after;
        }
        Err(CopyError::Away {
            place: self.place.clone(),
            detail: "it is written all the time".to_owned(),
        })
    }

    async fn replace(&self, whole: &Loaded) -> Result<(), CopyError> {
        let (copied, vault) = (whole.clone(), Arc::clone(&self.vault));
        let encoded = tokio::task::spawn_blocking(move || format::encode(&copied, &vault)).await;
        let content = encoded.unwrap_or(Err(CopyError::Sealing))?;
        self.write(&content, &whole.position).await
    }

    fn describe(&self) -> String {
        self.place.clone()
    }
}

fn primary_preferred() -> ReadPreference {
    ReadPreference::PrimaryPreferred { options: None }
}

fn now_ms() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(now.as_millis()).unwrap_or(0)
}

/// A generation that sorts behind those that began earlier. `after` is the present one, for clocks
/// may go back.
fn new_generation(now_ms: u64, after: Option<&str>) -> String {
    let known = after.and_then(|text| u64::from_str_radix(text.split('-').next()?, 16).ok());
    let start = known.map_or(now_ms, |known| now_ms.max(known.saturating_add(1)));
    format!("{start:016x}-{:016x}", rand::random::<u64>())
}

/// Filter for all chunks of a generation. `0` is the character after `/`.
fn of_generation(copy: &str, generation: &str) -> Document {
    doc! { "_id": { "$gte": format!("{copy}/{generation}/"),
    "$lt": format!("{copy}/{generation}0") } }
}

/// Filter for all chunks of earlier generations.
fn of_earlier(copy: &str, generation: &str) -> Document {
    doc! { "_id": { "$gte": format!("{copy}/"), "$lt": format!("{copy}/{generation}/") } }
}

/// Filter for the chunks of generations that began before this time, but for those that the head
/// names.
fn of_left_behind(copy: &str, head: Option<&str>, before_ms: u64) -> Document {
    let mut old =
        doc! { "_id": { "$gte": format!("{copy}/"), "$lt": format!("{copy}/{before_ms:016x}") } };
    if let Some(head) = head {
        let held = of_generation(copy, head);
        old.insert("$nor", vec![held]);
    }
    old
}

/// In any width, as tools that copy databases do not keep it.
fn integer(found: &Document, name: &str) -> Option<i64> {
    match found.get(name) {
        Some(Bson::Int64(value)) => Some(*value),
        Some(Bson::Int32(value)) => Some(i64::from(*value)),
        _ => None,
    }
}

#[cfg(test)]
#[path = "mongo_tests.rs"]
mod tests;
