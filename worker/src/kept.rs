//! Which copies a worker has.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use blaze_domain::node_file::{DatabaseSection, MongoSection};

use crate::copy::{FileCopy, LocalCopy, Vault};
use crate::settings::WorkerSettings;

/// A place that keeps a copy, if there is one.
type Copy = Option<Arc<dyn LocalCopy>>;

/// The file and the database, where the settings say.
///
/// # Errors
/// A folder or database that cannot be worked with.
pub(crate) async fn open(
    settings: &WorkerSettings,
    folder: Option<PathBuf>,
    vault: &Vault,
) -> anyhow::Result<(Copy, Copy)> {
    let layer = &settings.site.layer;
    let (folder, database) = match &settings.database {
        Some(DatabaseSection::Embedded { path }) => (Some(path.clone()), None),
        Some(DatabaseSection::MongoDb(section)) => {
            let copy = mongodb(section.clone(), settings, vault).context("database.mongodb")?;
            (folder, Some(copy))
        }
        None => (folder, None),
    };
    let Some(folder) = folder else {
        return Ok((None, database));
    };
    make_folder(&folder).await?;
    let file: Arc<dyn LocalCopy> = Arc::new(FileCopy::new(&folder, layer.clone(), vault.clone()));
    Ok((Some(file), database))
}

#[cfg(feature = "mongodb")]
fn mongodb(
    section: MongoSection,
    settings: &WorkerSettings,
    vault: &Vault,
) -> anyhow::Result<Arc<dyn LocalCopy>> {
    let (layer, node) = (settings.site.layer.clone(), settings.site.node.as_ref());
    let copy = crate::copy::MongoCopy::new(section, layer, node, vault.clone());
    Ok(Arc::new(copy))
}

#[cfg(not(feature = "mongodb"))]
fn mongodb(
    _section: MongoSection,
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
