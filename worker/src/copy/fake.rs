//! A copy in memory for tests: it fails, hangs and counts as it is told.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use async_trait::async_trait;
use parking_lot::Mutex;
use tokio::sync::{Notify, Semaphore};

use super::{CopyError, Loaded, LocalCopy};

pub(crate) struct Fake {
    pub(super) name: &'static str,
    pub(super) held: Mutex<Option<Loaded>>,
    /// Every call fails.
    pub(super) is_away: AtomicBool,
    /// Each call needs one.
    pub(super) permits: Semaphore,
    pub(super) replaced: AtomicUsize,
    /// Told before each call waits for its permit.
    pub(super) called: Notify,
}

impl Fake {
    pub(crate) fn new(name: &'static str) -> Self {
        Self {
            name,
            held: Mutex::new(None),
            is_away: AtomicBool::new(false),
            permits: Semaphore::new(Semaphore::MAX_PERMITS),
            replaced: AtomicUsize::new(0),
            called: Notify::new(),
        }
    }

    pub(super) fn with(name: &'static str, held: Loaded) -> Arc<dyn LocalCopy> {
        let fake = Self::new(name);
        *fake.held.lock() = Some(held);
        Arc::new(fake)
    }

    async fn call(&self) -> Result<(), CopyError> {
        self.called.notify_one();
        self.permits.acquire().await.unwrap().forget();
        if self.is_away.load(Ordering::Relaxed) {
            return Err(CopyError::Away {
                place: self.name.to_owned(),
                detail: "told so".to_owned(),
            });
        }
        Ok(())
    }
}

#[async_trait]
impl LocalCopy for Fake {
    async fn load(&self) -> Result<Option<Loaded>, CopyError> {
        self.call().await?;
        Ok(self.held.lock().clone())
    }

    async fn replace(&self, whole: &Loaded) -> Result<(), CopyError> {
        self.call().await?;
        let mut held = self.held.lock();
        if let Some(held) = &*held {
            held.position.check_replaced_by(&whole.position, self.name)?;
        }
        self.replaced.fetch_add(1, Ordering::Relaxed);
        *held = Some(whole.clone());
        Ok(())
    }

    fn describe(&self) -> String {
        self.name.to_owned()
    }
}
