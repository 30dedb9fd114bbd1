//! The rules for all stores, on files.

use std::sync::Arc;

use async_trait::async_trait;
use blaze_config::store::{FullStore, SqliteStore};
use blaze_conformance::store::Fixture;
use blaze_runtime::supervisor::Supervisor;
use tempfile::TempDir;

struct Files {
    folder: TempDir,
    supervisor: Supervisor,
}

impl Files {
    fn new() -> Self {
        Self {
            folder: tempfile::tempdir().unwrap(),
            supervisor: Supervisor::new("test"),
        }
    }
}

#[async_trait]
impl Fixture for Files {
    async fn open(&self, name: &str) -> Result<Arc<dyn FullStore>, String> {
        let path = self.folder.path().join(format!("{name}.db"));
        let store = SqliteStore::open(&path, &self.supervisor).await;
        Ok(Arc::new(store.map_err(|error| error.to_string())?))
    }

    fn is_shared(&self) -> bool {
        false
    }
}

blaze_conformance::store_conformance_tests!(async { Files::new() });
