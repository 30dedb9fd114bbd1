//! What every copy must do, run on each of them. MongoDB is that of `BLAZE_TEST_MONGODB_URI`,
//! standalone or replica set.

use std::sync::Arc;

use blaze_domain::LayerName;
#[cfg(feature = "mongodb")]
use blaze_domain::node_file::MongoSection;
use serde_json::json;
use tempfile::TempDir;
use tokio::runtime::Runtime;

use super::samples::{loaded, notes, service, with_secret};
use super::{FileCopy, Loaded, LocalCopy, Vault};

/// Which copy.
enum Kind {
    File,
    #[cfg(feature = "mongodb")]
    Mongo {
        uri: String,
        database: String,
    },
}

/// One copy that can be opened again and again.
struct Subject {
    kind: Kind,
    folder: TempDir,
    runtime: Runtime,
}

impl Subject {
    fn new(kind: Kind) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        Self { kind, folder: tempfile::tempdir().unwrap(), runtime }
    }

    fn open(&self) -> Box<dyn LocalCopy> {
        let vault = Vault::with_key([7; 32]);
        let layer: LayerName = "edge".parse().unwrap();
        match &self.kind {
            Kind::File => Box::new(FileCopy::new(self.folder.path(), layer, vault)),
            #[cfg(feature = "mongodb")]
            Kind::Mongo { uri, database } => {
                Box::new(super::MongoCopy::new(MongoSection::of(uri, database), layer, None, vault))
            }
        }
    }

    /// What a process that starts now finds.
    async fn found(&self) -> Option<Loaded> {
        self.open().load().await.unwrap()
    }
}

/// A server, and a database that no other test has.
#[cfg(feature = "mongodb")]
fn mongo_server() -> Kind {
    let uri = blaze_runtime::environment::variable("BLAZE_TEST_MONGODB_URI");
    let uri = uri
        .expect("BLAZE_TEST_MONGODB_URI, which is in .services/env after `scripts/services start`");
    let database = format!("blaze_copy_{:016x}", rand::random::<u64>());
    Kind::Mongo { uri, database }
}

#[cfg(feature = "mongodb")]
impl Drop for Subject {
    fn drop(&mut self) {
        if let Kind::Mongo { uri, database } = &self.kind {
            // What is left behind on a test server does no harm.
            let _ = self.runtime.block_on(async {
                let client = mongodb::Client::with_uri_str(uri).await?;
                client.database(database).drop().await
            });
        }
    }
}

fn sample(revision: u64) -> Loaded {
    let text = |name: &str| json!({ "config": { "a": format!("{name} at {revision}") } });
    Loaded {
        notes: Arc::new(notes(&format!("uid-{revision}"), revision)),
        ..loaded(
            revision,
            [
                service("a", revision, text("a")),
                service("b", 1, text("b")),
                with_secret("c", revision, "canary-5f1c"),
            ],
        )
    }
}

fn a_large_copy_is_kept(subject: &Subject) {
    subject.runtime.block_on(async {
        let text = "\u{e4}".repeat(120 * 1024);
        let whole = loaded(
            7,
            (0..80).map(|number| {
                service(&format!("s{number}"), 7, json!({ "config": { "a": text } }))
            }),
        );
        subject.open().replace(&whole).await.unwrap();
        assert!(subject.found().await == Some(whole));
    });
}

/// Whoever began from an older state, because this copy could not be read then, does not write it
/// over the newer one.
fn nothing_older_of_the_same_store_replaces_it(subject: &Subject) {
    subject.runtime.block_on(async {
        assert_eq!(subject.found().await, None);
        let held = sample(5);
        subject.open().replace(&held).await.unwrap();
        for copy in [subject.open(), subject.open()] {
            let refused = copy.replace(&sample(4)).await.unwrap_err();
            assert!(!refused.is_unreadable(), "{refused}");
            assert_eq!(subject.found().await.as_ref(), Some(&held));
        }
        let again = Loaded { documents: Vec::new(), ..held };
        for _ in 0..3 {
            subject.open().replace(&again).await.unwrap();
            assert_eq!(
                subject.found().await.as_ref(),
                Some(&again),
                "of the same revision the later counts"
            );
        }
        // A restored store has another identity.
        let mut other = sample(3);
        other.position.store_id = "store-b".to_owned();
        subject.open().replace(&other).await.unwrap();
        assert_eq!(subject.found().await, Some(other));
    });
}

fn suite(kind: Kind) {
    let subject = Subject::new(kind);
    nothing_older_of_the_same_store_replaces_it(&subject);
    a_large_copy_is_kept(&subject);
}

#[test]
fn the_file_passes() {
    suite(Kind::File);
}

#[cfg(feature = "mongodb")]
#[test]
fn mongodb_passes() {
    suite(mongo_server());
}

/// A write to MongoDB that ends after each of its steps, and what reaches the server late.
#[cfg(feature = "mongodb")]
mod in_mongodb {
    use futures::TryStreamExt as _;
    use mongodb::bson::{Binary, Document, doc, spec::BinarySubtype};

    use super::*;
    use crate::copy::CopyError;

    #[test]
    fn a_write_that_ended_in_the_middle_leaves_the_old_and_goes_with_the_next() {
        let subject = Subject::new(mongo_server());
        let Kind::Mongo { uri, database } = &subject.kind else {
            return;
        };
        subject.runtime.block_on(async {
            let client = mongodb::Client::with_uri_str(uri).await.unwrap();
            let database = client.database(database);
            let (head, chunks) =
                (database.collection::<Document>("head"), database.collection("chunks"));
            let held = sample(5);
            subject.open().replace(&held).await.unwrap();
            let before = head.find_one(doc! {}).await.unwrap().unwrap();
            let generation = before.get_str("generation").unwrap();
            let later = u64::from_str_radix(&generation[..16], 16).unwrap() + 1;
            let bytes = b"cut off".to_vec();
            let chunk = Binary { subtype: BinarySubtype::Generic, bytes };
            let stray = doc! { "_id": format!("edge/{later:016x}-0/00000000"), "data": chunk };
            chunks.insert_one(stray).await.unwrap();
            assert_eq!(subject.found().await.as_ref(), Some(&held));
            subject.open().replace(&sample(6)).await.unwrap();
            assert_eq!(subject.found().await, Some(sample(6)));
            tokio::time::sleep(std::time::Duration::from_millis(5)).await;
            subject.open().replace(&sample(7)).await.unwrap();
            let left: Vec<Document> =
                chunks.find(doc! {}).await.unwrap().try_collect().await.unwrap();
            assert_eq!(left.len(), 1, "{left:?}");
        });
    }

    #[test]
    fn no_text_of_a_secret_is_in_the_database_with_and_without_a_key() {
        let subject = Subject::new(mongo_server());
        let Kind::Mongo { uri, database } = &subject.kind else {
            return;
        };
        subject.runtime.block_on(async {
            let client = mongodb::Client::with_uri_str(uri).await.unwrap();
            let tables = client.database(database);
            // With a key all but the first line is encrypted.
            for (revision, vault, is_plain) in
                [(5, Vault::default(), true), (6, Vault::with_key([7; 32]), false)]
            {
                let layer = "edge".parse().unwrap();
                let copy = crate::copy::MongoCopy::new(
                    MongoSection::of(uri, database),
                    layer,
                    None,
                    vault,
                );
                copy.replace(&sample(revision)).await.unwrap();
                let head = tables.collection::<Document>("head").find_one(doc! {}).await.unwrap();
                let chunks = tables.collection::<Document>("chunks").find(doc! {}).await.unwrap();
                let chunks: Vec<Document> = chunks.try_collect().await.unwrap();
                // Debug shows the bytes of a chunk as numbers: they are to be read as text.
                let mut kept = format!("{head:?}");
                for chunk in &chunks {
                    kept += &String::from_utf8_lossy(chunk.get_binary_generic("data").unwrap());
                }
                assert!(kept.contains("blaze-copy 2 "), "{kept}");
                let text = format!("a at {revision}");
                assert_eq!(kept.contains(&text), is_plain, "what is no secret: {kept}");
                assert!(!kept.contains("canary"), "{revision}: {kept}");
            }
        });
    }

    #[test]
    fn a_newer_format_stays_and_a_broken_copy_gives_way() {
        let subject = Subject::new(mongo_server());
        let Kind::Mongo { uri, database } = &subject.kind else {
            return;
        };
        subject.runtime.block_on(async {
            let client = mongodb::Client::with_uri_str(uri).await.unwrap();
            let head = client.database(database).collection::<Document>("head");
            for (change, is_newer) in [
                (doc! { "$set": { "format": 99 } }, true),
                (doc! { "$set": { "generation": "elsewhere" } }, false),
                (doc! { "$unset": { "generation": "", "format": "" } }, false),
            ] {
                head.delete_many(doc! {}).await.unwrap();
                subject.open().replace(&sample(5)).await.unwrap();
                head.update_one(doc! {}, change).await.unwrap();
                let next = subject.open().replace(&sample(6)).await;
                assert_eq!(
                    matches!(next, Err(CopyError::NewerFormat { .. })),
                    is_newer,
                    "{next:?}"
                );
                if !is_newer {
                    assert_eq!(subject.found().await, Some(sample(6)));
                }
            }
        });
    }
}
