//! The copy in a file, `last-known-good`.
//!
//! ```text
//! replace ─▶ last-known-good.new (mode 0600) ─[fsync]─▶ [rename] last-known-good ─▶ [fsync of the folder]
//!                                                              │ content that cannot be read
//!                                                              └─▶ last-known-good.broken, the newest one
//! ```
//!
//! Reading changes nothing: a worker that was started with the wrong key finds its file when it is
//! started with the right one. Only the first write moves an unreadable file away. A later revision
//! of the same store stays.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read as _, Write as _};
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use async_trait::async_trait;
use blaze_domain::LayerName;
use parking_lot::Mutex;

use super::{CopyError, Loaded, LocalCopy, Position, Vault, format};

/// Its name, in the worker's folder for state.
pub const FILE_NAME: &str = "last-known-good";
/// Largest file that is written and read (1 GiB).
const MAX_BYTES: u64 = 1024 * 1024 * 1024;

/// The file. Two processes must not have the same folder.
pub struct FileCopy {
    inner: Arc<Inner>,
}

struct Inner {
    path: PathBuf,
    layer: LayerName,
    vault: Vault,
    /// Position of the content, held during a write; `None`: it was not read yet.
    known: Mutex<Option<Position>>,
}

impl FileCopy {
    /// In this folder, which must exist.
    #[must_use]
    pub fn new(folder: &Path, layer: LayerName, vault: Vault) -> Self {
        let inner = Inner { path: folder.join(FILE_NAME), layer, vault, known: Mutex::default() };
        Self { inner: Arc::new(inner) }
    }

    /// Does something with the file on a thread that may block.
    async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Inner) -> Result<T, CopyError> + Send + 'static,
    ) -> Result<T, CopyError> {
        let inner = Arc::clone(&self.inner);
        let place = inner.place();
        let done = tokio::task::spawn_blocking(move || work(&inner)).await;
        done.unwrap_or_else(|_| {
            Err(CopyError::Away { place, detail: "the process is about to end".to_owned() })
        })
    }
}

#[async_trait]
impl LocalCopy for FileCopy {
    async fn load(&self) -> Result<Option<Loaded>, CopyError> {
        self.run(|inner| inner.load(&mut inner.known.lock())).await
    }

    async fn replace(&self, whole: &Loaded) -> Result<(), CopyError> {
        let whole = whole.clone();
        self.run(move |inner| inner.write(&whole)).await
    }

    fn describe(&self) -> String {
        self.inner.place()
    }
}

impl Inner {
    fn place(&self) -> String {
        format!("file {}", self.path.display())
    }

    fn failed(&self, error: &io::Error) -> CopyError {
        let (place, detail) = (self.place(), error.to_string());
        match error.kind() {
            io::ErrorKind::PermissionDenied
            | io::ErrorKind::NotFound
            | io::ErrorKind::ReadOnlyFilesystem => CopyError::Refused { place, detail },
            _ => CopyError::Away { place, detail },
        }
    }

    fn load(&self, known: &mut Option<Position>) -> Result<Option<Loaded>, CopyError> {
        let file = match File::open(&self.path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(self.failed(&error)),
        };
        let mut content = Vec::new();
        let read = file.take(MAX_BYTES + 1).read_to_end(&mut content);
        read.map_err(|error| self.failed(&error))?;
        if content.len() as u64 > MAX_BYTES {
            return Err(CopyError::Broken {
                place: self.place(),
                detail: format!("it has more than {MAX_BYTES} bytes"),
            });
        }
        let whole = format::decode(&content, &self.place(), &self.layer, &self.vault)?;
        *known = Some(whole.position.clone());
        Ok(Some(whole))
    }

    fn write(&self, whole: &Loaded) -> Result<(), CopyError> {
        let content = format::encode(whole, &self.vault)?;
        if content.len() as u64 > MAX_BYTES {
            return Err(CopyError::Refused {
                place: self.place(),
                detail: format!("it would have more than {MAX_BYTES} bytes"),
            });
        }
        let mut known = self.known.lock();
        let mut is_unreadable = false;
        if known.is_none() {
            match self.load(&mut known) {
                Err(error) if error.is_unreadable() => is_unreadable = true,
                // It may hold anything.
                loaded => drop(loaded?),
            }
        }
        if let Some(held) = &*known {
            held.check_replaced_by(&whole.position, &self.place())?;
        }
        self.replace_content(&content, is_unreadable).map_err(|error| self.failed(&error))?;
        *known = Some(whole.position.clone());
        Ok(())
    }

    fn replace_content(&self, content: &[u8], is_unreadable: bool) -> io::Result<()> {
        let temporary = beside(&self.path, "new");
        let mut options = OpenOptions::new();
        options.write(true).create(true).truncate(true).mode(0o600);
        let mut file = options.open(&temporary)?;
        // One that a crash has left may have other rights.
        file.set_permissions(fs::Permissions::from_mode(0o600))?;
        file.write_all(content)?;
        file.sync_all()?;
        if is_unreadable {
            let aside = beside(&self.path, "broken");
            fs::rename(&self.path, &aside)?;
            tracing::warn!(
                file = %self.path.display(), aside = %aside.display(),
                "the copy cannot be read; it was moved aside and a new one is written"
            );
        }
        fs::rename(&temporary, &self.path)?;
        // The rename itself is in the folder.
        File::open(self.path.parent().unwrap_or(Path::new(".")))?.sync_all()
    }
}

/// A file beside another one: its name and `.ending`.
fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(format!(".{ending}"));
    PathBuf::from(name)
}

#[cfg(test)]
#[path = "file_tests.rs"]
mod tests;
