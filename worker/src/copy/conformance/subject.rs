//! Copies that can be opened again and again.

use blaze_domain::LayerName;
use blaze_runtime::Supervisor;
use tempfile::TempDir;
use tokio::runtime::Runtime;

use crate::copy::steps::Steps;
use crate::copy::{DATABASE_NAME, FileCopy, Loaded, LocalCopy, SqliteCopy, Vault};

/// A key that copies are encrypted with.
pub(super) const KEY: [u8; 32] = [7; 32];

/// Which copy.
pub(super) enum Kind {
    File,
    Sqlite,
    #[cfg(feature = "mongodb")]
    Mongo {
        uri: String,
        database: String,
    },
}

/// One copy that can be opened again and again.
pub(super) struct Subject {
    pub(super) kind: Kind,
    folder: TempDir,
    supervisor: Supervisor,
    pub(super) runtime: Runtime,
}

impl Subject {
    pub(super) fn new(kind: Kind) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        Self {
            kind,
            folder: tempfile::tempdir().unwrap(),
            supervisor: Supervisor::on(runtime.handle().clone(), "test"),
            runtime,
        }
    }

    pub(super) fn open(&self) -> Box<dyn LocalCopy> {
        self.open_as(Vault::with_key(KEY), None)
    }

    /// `crash_after`: how many steps of writes are done; a copy that is written in one step ignores it.
    pub(super) fn open_as(&self, vault: Vault, crash_after: Option<usize>) -> Box<dyn LocalCopy> {
        let layer: LayerName = "edge".parse().unwrap();
        let steps = crash_after.map_or_else(Steps::default, Steps::crash_after);
        match &self.kind {
            Kind::File => Box::new(FileCopy::with_steps(self.folder.path(), layer, vault, steps)),
            Kind::Sqlite => {
                let path = self.folder.path().join(DATABASE_NAME);
                Box::new(SqliteCopy::new(path, layer, vault, &self.supervisor).unwrap())
            }
            #[cfg(feature = "mongodb")]
            Kind::Mongo { uri, database } => {
                let copy = crate::copy::MongoCopy::new(uri.clone().into(), database, layer, None, vault).unwrap();
                Box::new(match crash_after {
                    Some(steps) => copy.crashing_after(steps),
                    None => copy,
                })
            }
        }
    }

    /// What a process that starts now finds.
    pub(super) async fn found(&self) -> Option<Loaded> {
        self.open().load().await.unwrap()
    }
}

/// A server, and a database that no other test has.
#[cfg(feature = "mongodb")]
pub(super) fn mongo_server() -> Option<Kind> {
    use blaze_runtime::environment::variable;
    let uri = variable("BLAZE_TEST_MONGODB_URI").or_else(|| variable("BLAZE_TEST_MONGODB"))?;
    let database = format!("blaze_copy_{:016x}", rand::random::<u64>());
    Some(Kind::Mongo { uri, database })
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
