//! A core on a store in memory, for tests of what is built on it.

use std::sync::Arc;

use blaze_domain::node_file::ControlPlaneSection;
use blaze_runtime::{Readiness, Supervisor};

use super::service::{ConfigService, CoreOptions};
use crate::auth::Revocations;
use crate::secrets::Keyring;
use crate::store::{SqliteStore, Store, StoreError};

/// A core in development mode on an empty store, with a key for secrets. It lives as long as the
/// supervisor.
///
/// # Errors
/// If the store in memory cannot be made.
pub async fn service(supervisor: &Supervisor) -> Result<ConfigService, StoreError> {
    let store = SqliteStore::in_memory(supervisor).await?;
    service_on(supervisor, Arc::new(store), &[("e1", [7; 32])]).await
}

/// The same on a store that may hold something, with these keys for secrets, the first one first.
///
/// # Errors
/// If the store cannot be read, or a key is none.
pub async fn service_on(
    supervisor: &Supervisor,
    store: Arc<dyn Store>,
    keys: &[(&str, [u8; 32])],
) -> Result<ConfigService, StoreError> {
    let keyring =
        Keyring::with_keys(keys).map_err(|error| StoreError::Refused(error.to_string()))?;
    let options = CoreOptions {
        store,
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
