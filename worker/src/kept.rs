//! Which copies a worker has, and what it begins from.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use blaze_domain::node_file::DatabaseSection;
use blaze_runtime::Supervisor;
use tokio::sync::mpsc;

use crate::copy::{Copies, DATABASE_LIMIT, FileCopy, Found, LocalCopy, Start, Target, Vault, choose};
use crate::settings::WorkerSettings;

/// Where copies are kept.
pub(crate) struct Kept {
    file: Option<Arc<dyn LocalCopy>>,
    database: Option<Arc<dyn LocalCopy>>,
}

impl Kept {
    /// Where the settings say.
    ///
    /// # Errors
    /// A folder or database that cannot be worked with.
    pub(crate) async fn open(
        settings: &WorkerSettings,
        folder: Option<PathBuf>,
        vault: &Vault,
    ) -> anyhow::Result<Self> {
        let layer = &settings.site.layer;
        let folder = match &settings.database {
            Some(DatabaseSection::Embedded { path }) => Some(path.clone()),
            Some(DatabaseSection::MongoDb { .. }) | None => folder,
        };
        let file = match folder {
            None => None,
            Some(folder) => {
                make_folder(&folder).await?;
                Some(Arc::new(FileCopy::new(&folder, layer.clone(), vault.clone())) as Arc<dyn LocalCopy>)
            }
        };
        let database = match &settings.database {
            Some(DatabaseSection::MongoDb { uri, database }) => {
                Some(mongodb(uri.clone(), database, settings, vault).context("database.mongodb")?)
            }
            Some(DatabaseSection::Embedded { .. }) | None => None,
        };
        Ok(Self { file, database })
    }

    /// Reads what is there and keeps it up to date from now on; `find` takes what can be read only later.
    pub(crate) async fn begin(self, supervisor: &Supervisor, find: &mpsc::Sender<Found>) -> (Option<Copies>, Start) {
        let start = choose(self.file.as_ref(), self.database.as_ref(), DATABASE_LIMIT).await;
        let targets = [self.file, self.database].into_iter().flatten();
        let targets: Vec<Target> = targets
            .map(|copy| Target {
                is_read: !start.unread.contains(&copy.describe()),
                copy,
            })
            .collect();
        if targets.is_empty() {
            return (None, start);
        }
        (Some(Copies::start(supervisor, targets, find)), start)
    }
}

#[cfg(feature = "mongodb")]
fn mongodb(
    uri: blaze_domain::node_file::SecretText,
    database: &str,
    settings: &WorkerSettings,
    vault: &Vault,
) -> anyhow::Result<Arc<dyn LocalCopy>> {
    let (layer, node) = (settings.site.layer.clone(), settings.site.node.as_ref());
    let copy = crate::copy::MongoCopy::new(uri, database, layer, node, vault.clone())?;
    Ok(Arc::new(copy))
}

#[cfg(not(feature = "mongodb"))]
fn mongodb(
    _uri: blaze_domain::node_file::SecretText,
    _database: &str,
    _settings: &WorkerSettings,
    _vault: &Vault,
) -> anyhow::Result<Arc<dyn LocalCopy>> {
    anyhow::bail!("this program was built without MongoDB (cargo feature `mongodb`)")
}

/// For its owner alone: what is in it says how the whole layer is configured.
async fn make_folder(path: &Path) -> anyhow::Result<()> {
    tokio::fs::DirBuilder::new()
        .recursive(true)
        .mode(0o700)
        .create(path)
        .await
        .with_context(|| format!("{}", path.display()))
}
