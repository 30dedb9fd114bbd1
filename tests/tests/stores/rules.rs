//! The rules for all stores, on the MongoDB that all tests share.

use std::sync::Arc;

use async_trait::async_trait;
use blaze_config::store::conformance::Fixture;
use blaze_config::store::{FullStore, MongoStore};
use blaze_tests::servers::{drop_mongo_database, shared_mongo};
use parking_lot::Mutex;

/// Databases of one test, dropped with it.
struct Databases {
    uri: String,
    made: Mutex<Vec<String>>,
}

impl Databases {
    fn new() -> Self {
        Self {
            uri: shared_mongo().unwrap(),
            made: Mutex::new(Vec::new()),
        }
    }
}

#[async_trait]
impl Fixture for Databases {
    async fn open(&self, name: &str) -> Result<Arc<dyn FullStore>, String> {
        let database = format!("rules_{name}");
        self.made.lock().push(database.clone());
        let store = MongoStore::open(&self.uri, &database).await;
        Ok(Arc::new(store.map_err(|error| error.to_string())?))
    }

    fn is_shared(&self) -> bool {
        true
    }
}

impl Drop for Databases {
    fn drop(&mut self) {
        for database in self.made.get_mut() {
            // What stays goes with the server.
            let _ = drop_mongo_database(&self.uri, database);
        }
    }
}

blaze_config::store_conformance_tests!(async { Databases::new() });
