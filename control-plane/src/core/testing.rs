//! A core on a store in memory, for tests of what is built on it.

use std::sync::Arc;

use blaze_domain::node_file::ControlPlaneSection;
use blaze_runtime::{Readiness, Supervisor};

use super::service::{ConfigService, CoreOptions};
use crate::auth::Revocations;
use crate::secrets::Keyring;
use crate::store::{SqliteStore, StoreError};

/// A core in development mode on an empty store, with a key for secrets. It lives as long as the supervisor.
///
/// # Errors
/// If the store in memory cannot be made.
pub async fn service(supervisor: &Supervisor) -> Result<ConfigService, StoreError> {
    let store = SqliteStore::in_memory(supervisor).await?;
    let keyring = Keyring::with_keys(&[("e1", [7; 32])]).map_err(|error| StoreError::Refused(error.to_string()))?;
    let options = CoreOptions {
        store: Arc::new(store),
        authenticator: None,
        dev: true,
        revocations: Revocations::new(),
        keyring: Arc::new(keyring),
        history: ControlPlaneSection::default().history,
        on_commit: Arc::new(|_| {}),
        readiness: Readiness::new(),
    };
    ConfigService::start(supervisor, options).await
}
