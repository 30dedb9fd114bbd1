//! Which copies a worker has, and what it begins from.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context as _;
use blaze_domain::node_file::DatabaseSection;
use blaze_runtime::Supervisor;
use tokio::sync::mpsc;

use crate::copy::{
    Copies, DATABASE_LIMIT, DATABASE_NAME, FileCopy, Found, LocalCopy, Notes, SqliteCopy, Start, Target, Vault, choose,
};
use crate::settings::WorkerSettings;

/// Where copies are kept.
pub(crate) struct Kept {
    database: Option<Arc<dyn LocalCopy>>,
    file: Option<Arc<dyn LocalCopy>>,
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
        supervisor: &Supervisor,
    ) -> anyhow::Result<Self> {
        let layer = &settings.site.layer;
        if let Some(folder) = &folder {
            make_folder(folder).await?;
        }
        let sqlite = |path: PathBuf| -> anyhow::Result<Arc<dyn LocalCopy>> {
            let copy = SqliteCopy::new(path, layer.clone(), vault.clone(), supervisor)?;
            Ok(Arc::new(copy))
        };
        let database = match (&settings.database, &folder) {
            (Some(DatabaseSection::Embedded { path }), _) => {
                make_folder(path).await?;
                Some(sqlite(path.join(DATABASE_NAME)).context("database.embedded")?)
            }
            (Some(DatabaseSection::MongoDb { uri, database }), _) => {
                Some(mongodb(uri.clone(), database, settings, vault).context("database.mongodb")?)
            }
            (None, Some(folder)) => Some(sqlite(folder.join(DATABASE_NAME)).context("the copy")?),
            (None, None) => None,
        };
        let file = folder
            .map(|folder| -> Arc<dyn LocalCopy> { Arc::new(FileCopy::new(&folder, layer.clone(), vault.clone())) });
        Ok(Self { database, file })
    }

    /// Reads what is there and keeps it up to date from now on; `find` takes what can be read only later.
    pub(crate) async fn begin(self, supervisor: &Supervisor, find: &mpsc::Sender<Found>) -> (Option<Copies>, Start) {
        let start = choose(self.database.as_ref(), self.file.as_ref(), DATABASE_LIMIT).await;
        let notes = start.loaded.as_ref().map(|loaded| Arc::clone(&loaded.notes));
        let current = [start.is_database_current, start.is_file_current];
        let targets = [self.database, self.file].into_iter().zip(current);
        let targets: Vec<Target> = targets
            .filter_map(|(copy, is_current)| {
                let copy = copy?;
                Some(Target {
                    is_read: !start.is_unread(&*copy),
                    copy,
                    is_current,
                })
            })
            .collect();
        if targets.is_empty() {
            return (None, start);
        }
        let notes = notes.unwrap_or_else(|| Arc::new(Notes::default()));
        (Some(Copies::start(supervisor, targets, &notes, find)), start)
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
async fn make_folder(path: &std::path::Path) -> anyhow::Result<()> {
    tokio::fs::DirBuilder::new()
        .recursive(true)
        .mode(0o700)
        .create(path)
        .await
        .with_context(|| format!("{}", path.display()))
}
