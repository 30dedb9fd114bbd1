//! What is left in a MongoDB.

use futures::TryStreamExt as _;
use mongodb::bson::{Document, doc};

use super::*;

/// Old rows go, and no text of a secret is in any.
#[test]
fn mongodb_keeps_no_old_rows_and_no_texts() {
    let Some(kind) = mongo_server() else { return };
    let subject = Subject::new(kind);
    let Kind::Mongo { uri, database } = &subject.kind else {
        return;
    };
    subject.runtime.block_on(async {
        let client = mongodb::Client::with_uri_str(uri).await.unwrap();
        let rows = client.database(database).collection::<Document>("documents");
        for vault in [Vault::default(), Vault::with_key(KEY)] {
            let store_id = new_store();
            for steps in 0..12 {
                let crashing = subject.open_as(vault.clone(), Some(steps));
                let _ = crashing.replace(&of_store(&store_id, sample(1))).await;
            }
            let copy = subject.open_as(vault.clone(), None);
            let mut held = of_store(&store_id, sample(2));
            copy.replace(&held).await.unwrap();
            let gone: Key = "Service/b".parse().unwrap();
            let put = Arc::new(with_secret("a", 3, "canary-5f1c"));
            let to = Position {
                store_id,
                ..position(3)
            };
            let next = (to, std::slice::from_ref(&put), std::slice::from_ref(&gone), None);
            held = advance(&*copy, &held, next).await.unwrap();
            let all: Vec<Document> = rows.find(doc! {}).await.unwrap().try_collect().await.unwrap();
            // The documents and the notes.
            assert_eq!(all.len(), held.documents.len() + 1, "{all:?}");
            assert!(!format!("{all:?}").contains("canary"), "{all:?}");
        }
    });
}
