//! The last-known-good file.
//!
//! ```text
//! replace ─▶ last-known-good.new (mode 0600) ─[fsync]─▶ [rename] last-known-good ─▶ [fsync of the folder]
//!                                                              │ what was there and cannot be read
//!                                                              └─▶ last-known-good.broken-<milliseconds>, the newest three
//! ```
//!
//! Reading changes nothing: a worker that was started with the wrong key finds its file when it is started with the right
//! one. Only the first write moves away what cannot be read. What is of a later revision of the same store stays.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read as _, Write as _};
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use async_trait::async_trait;
use blaze_domain::LayerName;
use blaze_domain::config::{Document, Key};
use parking_lot::Mutex;

use super::aside::{beside, set_aside};
use super::steps::Steps;
use super::{CopyError, Loaded, LocalCopy, Notes, Position, Vault, file_format, progress};

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
    steps: Steps,
    /// Held during a write.
    writing: Mutex<()>,
    /// How far what is there is, so that it is known what may be written over it; `None`: nobody has looked yet.
    known: Mutex<Option<Position>>,
}

impl FileCopy {
    /// In this folder, which must exist.
    #[must_use]
    pub fn new(state_dir: &Path, layer: LayerName, vault: Vault) -> Self {
        Self::with_steps(state_dir, layer, vault, Steps::default())
    }

    pub(super) fn with_steps(state_dir: &Path, layer: LayerName, vault: Vault, steps: Steps) -> Self {
        let inner = Inner {
            path: state_dir.join(FILE_NAME),
            layer,
            vault,
            steps,
            writing: Mutex::new(()),
            known: Mutex::default(),
        };
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
            Err(CopyError::Away {
                place,
                detail: "the process is about to end".to_owned(),
            })
        })
    }
}

#[async_trait]
impl LocalCopy for FileCopy {
    async fn load(&self) -> Result<Option<Loaded>, CopyError> {
        self.run(Inner::load).await
    }

    async fn replace(&self, whole: &Loaded) -> Result<(), CopyError> {
        let whole = whole.clone();
        self.run(move |inner| inner.write(&whole)).await
    }

    async fn advance(
        &self,
        position: &Position,
        puts: &[Arc<Document>],
        removes: &[Key],
        notes: Option<&Notes>,
    ) -> Result<(), CopyError> {
        let (position, puts, removes) = (position.clone(), puts.to_vec(), removes.to_vec());
        let notes = notes.cloned();
        self.run(move |inner| {
            let held = inner.load()?;
            let whole = progress::advanced(held, position, &puts, &removes, notes, &inner.place())?;
            inner.write(&whole)
        })
        .await
    }

    fn describe(&self) -> String {
        self.inner.place()
    }

    fn writes_whole(&self) -> bool {
        true
    }
}

impl Inner {
    fn place(&self) -> String {
        format!("file {}", self.path.display())
    }

    fn failed(&self, error: &io::Error) -> CopyError {
        let (place, detail) = (self.place(), error.to_string());
        match error.kind() {
            io::ErrorKind::PermissionDenied | io::ErrorKind::NotFound | io::ErrorKind::ReadOnlyFilesystem => {
                CopyError::Refused { place, detail }
            }
            _ => CopyError::Away { place, detail },
        }
    }

    fn load(&self) -> Result<Option<Loaded>, CopyError> {
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
        let (whole, lost) = file_format::decode(&content, &self.place(), &self.layer, &self.vault)?;
        if lost > 0 {
            tracing::warn!(file = %self.path.display(), lost, "secrets of the last-known-good file do not open");
        }
        *self.known.lock() = Some(whole.position.clone());
        Ok(Some(whole))
    }

    fn write(&self, whole: &Loaded) -> Result<(), CopyError> {
        let content = file_format::encode(whole, &self.vault)?;
        if content.len() as u64 > MAX_BYTES {
            return Err(CopyError::Refused {
                place: self.place(),
                detail: format!("it would have more than {MAX_BYTES} bytes"),
            });
        }
        let _writing = self.writing.lock();
        let known = self.known.lock().clone();
        let is_unreadable = match known {
            Some(_) => false,
            None => match self.load() {
                Ok(_) => false,
                Err(error) if error.is_unreadable() => true,
                // It may hold anything.
                Err(error) => return Err(error),
            },
        };
        progress::check_whole(self.known.lock().as_ref(), &whole.position, &self.place())?;
        let temporary = beside(&self.path, "new");
        self.write_temporary(&temporary, &content)?;
        self.steps.pass()?;
        if is_unreadable {
            self.move_aside().map_err(|error| self.failed(&error))?;
        }
        self.steps.pass()?;
        fs::rename(&temporary, &self.path).map_err(|error| self.failed(&error))?;
        *self.known.lock() = Some(whole.position.clone());
        self.steps.pass()?;
        // The rename itself is in the folder.
        let folder = self.path.parent().unwrap_or(Path::new("."));
        let synced = File::open(folder).and_then(|folder| folder.sync_all());
        synced.map_err(|error| self.failed(&error))
    }

    /// In steps, so that a test can end it in the middle.
    fn write_temporary(&self, path: &Path, content: &[u8]) -> Result<(), CopyError> {
        let failed = |error: io::Error| self.failed(&error);
        self.steps.pass()?;
        let mut options = OpenOptions::new();
        options.write(true).create(true).truncate(true).mode(0o600);
        let mut file = options.open(path).map_err(failed)?;
        // One that a crash has left may have other rights.
        file.set_permissions(fs::Permissions::from_mode(0o600))
            .map_err(failed)?;
        let (first, second) = content.split_at(content.len() / 2);
        for part in [first, second] {
            self.steps.pass()?;
            file.write_all(part).map_err(failed)?;
        }
        self.steps.pass()?;
        file.sync_all().map_err(failed)
    }

    /// What is there and cannot be read is kept for people, as far as there is room.
    fn move_aside(&self) -> io::Result<()> {
        let aside = set_aside(&self.path, &[])?;
        tracing::warn!(
            file = %self.path.display(), aside = %aside.display(),
            "the last-known-good file cannot be read; it was moved aside and a new one is written"
        );
        Ok(())
    }
}

#[cfg(test)]
#[path = "file_tests.rs"]
mod tests;
