//! The process: serve, or one piece of work on the store.
//!
//! ```text
//! setup ─▶ serve: RunningMain ─▶ ready line ─▶ signal ─▶ shutdown
//!      └─▶ migrate, backup, restore, reencrypt: store ─▶ work ─▶ store closed
//! ```

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use blaze_domain::node_file::{ControlPlaneSection, MongoSection, StoreSection};
use blaze_runtime::admin::say_listening;
use blaze_runtime::supervisor::{ShutdownSteps, Supervisor, TaskPolicy, failed};
use blaze_runtime::{read_password, ready_line, say};

use crate::auth::Authenticator;
use crate::auth::startup::check_startup;
use crate::listen::{Tls, install_crypto_provider};
use crate::running::{Addresses, RunningMain};
use crate::secrets::Keyring;
use crate::store::migrate::Plan;
use crate::store::{self, FullStore, StoreError, backup};

/// Name of the program.
pub const NAME: &str = "blaze-config";
/// A shutdown takes at most this long.
pub(crate) const SHUTDOWN: Duration = Duration::from_secs(10);

/// What the process does.
#[derive(Debug, Clone)]
pub enum Command {
    /// Serve REST and gRPC.
    Serve,
    /// Bring the store to this program's schema.
    Migrate {
        /// Only say what would be done.
        dry_run: bool,
    },
    /// Write a backup.
    Backup(PathBuf),
    /// Fill an empty store from a backup.
    Restore(PathBuf),
    /// Encrypt all secrets with the first key.
    Reencrypt,
}

/// What the process is made of.
#[derive(Debug, Clone)]
pub struct Setup {
    /// `control_plane` of the node file.
    pub section: ControlPlaneSection,
    /// `--dev`.
    pub dev: bool,
    /// The store is gone with the process.
    pub in_memory: bool,
}

impl Setup {
    /// What speaks against starting so.
    ///
    /// # Errors
    /// Every reason, one a line.
    pub fn check(&self) -> Result<(), Vec<String>> {
        let mut faults = check_startup(&self.section, self.dev).err().unwrap_or_default();
        if cfg!(not(feature = "mongodb")) && matches!(self.section.store, StoreSection::MongoDb(_))
        {
            faults.push(
                "control_plane.store.mongodb: this program was built without MongoDB (cargo \
                 feature `mongodb`)"
                    .to_owned(),
            );
        }
        #[cfg(feature = "mongodb")]
        if let StoreSection::MongoDb(section) = &self.section.store
            && let Err(fault) = store::mongo::check_uri(section)
        {
            faults.push(format!("control_plane.store.mongodb.uri: {fault}"));
        }
        if let StoreSection::MongoDb(MongoSection { password_file: Some(file), .. }) =
            &self.section.store
            && let Err(fault) = read_password(file)
        {
            faults.push(format!("control_plane.store.mongodb.password_file: {fault}"));
        }
        if faults.is_empty() { Ok(()) } else { Err(faults) }
    }

    /// The same, and whether every file with a key or a certificate can be used. The store is not
    /// looked at.
    ///
    /// # Errors
    /// Every reason, one a line, with its place in the node file.
    pub fn check_all(&self) -> Result<(), Vec<String>> {
        install_crypto_provider();
        let mut faults = self.check().err().unwrap_or_default();
        for fault in Keys::read(&self.section).err().unwrap_or_default() {
            // Some are seen both ways, in more words before.
            if !faults.iter().any(|known| known.starts_with(&fault)) {
                faults.push(fault);
            }
        }
        if faults.is_empty() { Ok(()) } else { Err(faults) }
    }

    pub(crate) async fn open(
        &self,
        supervisor: &Supervisor,
    ) -> Result<Arc<dyn FullStore>, StoreError> {
        match self.in_memory {
            true => store::in_memory(supervisor).await,
            false => store::open(&self.section.store, supervisor).await,
        }
    }
}

/// Everything that is read of files before the store is opened.
pub(crate) struct Keys {
    pub(crate) keyring: Keyring,
    pub(crate) authenticator: Option<Authenticator>,
    pub(crate) tls: Option<Tls>,
}

impl Keys {
    /// # Errors
    /// Every fault, with its place in the node file.
    pub(crate) fn read(section: &ControlPlaneSection) -> Result<Self, Vec<String>> {
        let authenticator = section.auth.as_ref().map(Authenticator::load).transpose();
        let keyring = Keyring::load(&section.encryption);
        match (authenticator, keyring, Tls::load(&section.tls)) {
            (Ok(authenticator), Ok(keyring), Ok(tls)) => Ok(Self { keyring, authenticator, tls }),
            (authenticator, keyring, tls) => {
                let faults = [authenticator.err(), keyring.err(), tls.err()];
                Err(faults.into_iter().flatten().flatten().collect())
            }
        }
    }

    /// Reads the files again when they change.
    pub(crate) fn watch(&self, supervisor: &Supervisor) {
        self.keyring.watch(supervisor);
        if let Some(authenticator) = &self.authenticator {
            authenticator.watch(supervisor);
        }
        if let Some(tls) = &self.tls {
            tls.watch(supervisor);
        }
    }
}

/// Does it, and gives what the process exits with.
pub async fn run(setup: Setup, command: Command) -> ExitCode {
    install_crypto_provider();
    let supervisor = Supervisor::new(NAME);
    let result = match command {
        Command::Serve => return serve(&supervisor, setup).await,
        Command::Migrate { dry_run } => migrate(&supervisor, &setup, dry_run).await,
        Command::Backup(file) => back_up(&supervisor, &setup, file).await,
        Command::Restore(file) => restore(&supervisor, &setup, file).await,
        Command::Reencrypt => reencrypt(&supervisor, &setup).await,
    };
    supervisor.shutdown(SHUTDOWN).await;
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(NAME, format_args!("{error:#}")),
    }
}

async fn migrate(supervisor: &Supervisor, setup: &Setup, dry_run: bool) -> anyhow::Result<()> {
    let Plan { version, target, pending } = store::plan(&setup.section.store).await?;
    say(format_args!("the store has schema {version}, this program knows {target}"));
    for step in &pending {
        say(format_args!("to do: {step}"));
    }
    if dry_run || pending.is_empty() {
        return Ok(());
    }
    setup.open(supervisor).await?.close().await;
    say(format_args!("done: the store has schema {target}"));
    Ok(())
}

async fn back_up(supervisor: &Supervisor, setup: &Setup, path: PathBuf) -> anyhow::Result<()> {
    let context = || format!("{}", path.display());
    // It holds encrypted secrets and the audit: for its owner alone.
    let file = private_file(&path).with_context(context)?;
    let mut out = std::io::BufWriter::new(file);
    let export = |pieces| store::export(&setup.section.store, supervisor, pieces);
    let written = backup::write(export, &mut out).await;
    let written = written.map_err(anyhow::Error::from).and_then(|summary| {
        out.into_inner().map_err(std::io::IntoInnerError::into_error)?.sync_all()?;
        Ok(summary)
    });
    let summary = match written {
        Ok(summary) => summary,
        Err(error) => {
            // Half a backup must not be taken for one.
            let _ = std::fs::remove_file(&path);
            return Err(error.context(context()));
        }
    };
    say(format_args!(
        "revision {} of store {} is in {}: {:?}",
        summary.head.revision,
        summary.head.store_id,
        path.display(),
        summary.counts
    ));
    Ok(())
}

fn private_file(path: &std::path::Path) -> std::io::Result<std::fs::File> {
    use std::os::unix::fs::OpenOptionsExt as _;
    std::fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)
}

async fn restore(supervisor: &Supervisor, setup: &Setup, path: PathBuf) -> anyhow::Result<()> {
    let context = || format!("{}", path.display());
    let file = std::fs::File::open(&path).with_context(context)?;
    let mut file = std::io::BufReader::new(file);
    // Before the store: opening makes one that is not there.
    backup::check(&mut file).with_context(context)?;
    let store = setup.open(supervisor).await?;
    let restored = backup::restore_checked(&*store, &mut file).await.with_context(context);
    store.close().await;
    let restored = restored?;
    say(format_args!(
        "restored as store {} at revision {}: every client lists again",
        restored.store_id, restored.revision
    ));
    Ok(())
}

async fn reencrypt(supervisor: &Supervisor, setup: &Setup) -> anyhow::Result<()> {
    let keyring = Keyring::load(&setup.section.encryption).map_err(all_of)?;
    anyhow::ensure!(keyring.can_seal(), "control_plane.encryption.keys names no key");
    let store = setup.open(supervisor).await?;
    let failed = parking_lot::Mutex::new(Vec::new());
    let reseal = |document: &blaze_domain::config::Document| match keyring.reseal(document) {
        Ok(new) => new,
        Err(error) => {
            failed
                .lock()
                .push(format!("{} at revision {}: {error}", document.key, document.revision));
            None
        }
    };
    let replaced = store.rewrite(&reseal).await;
    store.close().await;
    let replaced = replaced?;
    say(format_args!("{replaced} versions of documents are encrypted with the first key now"));
    let failed = failed.into_inner();
    failed.iter().for_each(|line| say(format_args!("{line}")));
    anyhow::ensure!(failed.is_empty(), "{} versions were left as they are", failed.len());
    Ok(())
}

#[expect(clippy::needless_pass_by_value, reason = "it stands in `map_err`")]
pub(crate) fn all_of(faults: Vec<String>) -> anyhow::Error {
    anyhow::anyhow!(faults.join("; "))
}

async fn serve(supervisor: &Supervisor, setup: Setup) -> ExitCode {
    let main = match RunningMain::start(supervisor, setup).await {
        Ok(main) => Arc::new(main),
        Err(error) => return failed(NAME, format_args!("{error:#}")),
    };
    say_listening(main.admin());
    let (announced, stopping, failing) =
        (Arc::clone(&main), supervisor.stopping_token(), supervisor.clone());
    supervisor.spawn("ready line", TaskPolicy::MayEnd, async move {
        let Addresses { rest, grpc, admin } = tokio::select! {
            addresses = announced.ready() => addresses,
            () = stopping.cancelled() => return,
        };
        if let Err(error) = ready_line(&[("rest", rest), ("grpc", grpc), ("admin", admin)]) {
            failing.fail(error.to_string());
        }
    });
    let steps = main.shutdown_steps(ShutdownSteps::new(SHUTDOWN));
    supervisor.clone().run(steps).await
}

#[cfg(test)]
mod tests {
    use blaze_domain::node_file::{AuthSection, EncryptionKey, JwksSource, JwtAlgorithm, JwtKey};

    use super::*;

    fn setup(section: ControlPlaneSection) -> Setup {
        Setup { section, dev: false, in_memory: false }
    }

    #[test]
    fn a_check_reads_all_files_and_names_their_places() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        std::fs::write(path("short.key"), "short").unwrap();
        let key = |id: &str, algorithm, name: &str| JwtKey {
            id: id.to_owned(),
            algorithm,
            file: path(name),
            sign: false,
        };
        let mut section = ControlPlaneSection {
            auth: Some(AuthSection {
                issuer: String::new(),
                audience: "blaze-config".to_owned(),
                keys: vec![
                    key("k0", JwtAlgorithm::Es256, "nope.key"),
                    key("k1", JwtAlgorithm::Hs256, "short.key"),
                    key("k2", JwtAlgorithm::Hs256, "nope.key"),
                ],
                jwks: Some(JwksSource::File(path("nope.json"))),
            }),
            ..ControlPlaneSection::default()
        };
        section.encryption.keys =
            vec![EncryptionKey { id: "e1".to_owned(), file: path("nope.enc") }];
        section.tls.cert_file = Some(path("nope.pem"));
        section.tls.key_file = Some(path("nope.pem"));
        section.tls.client_ca_file = Some(path("nope.ca"));
        section.store = StoreSection::MongoDb(MongoSection {
            password_file: Some(path("nope.pw")),
            ..MongoSection::of("mongodb://me@h/?nonsense=x", "x")
        });
        let found = setup(section).check_all().unwrap_err();
        for (place, part) in [
            ("control_plane.auth.issuer: ", "empty"),
            ("control_plane.auth.keys[0].alg: ", "ES256"),
            ("control_plane.auth.keys[1].file: ", "short.key (key k1) holds 5 bytes"),
            ("control_plane.auth.keys[2].file: ", "nope.key cannot be read"),
            ("control_plane.auth.jwks.file: ", "nope.json cannot be read"),
            ("control_plane.encryption.keys[0].file: ", "nope.enc cannot be read"),
            ("control_plane.tls.cert_file: ", "nope.pem cannot be read"),
            ("control_plane.tls.key_file: ", "nope.pem cannot be read"),
            ("control_plane.tls.client_ca_file: ", "nope.ca cannot be read"),
            ("control_plane.store.mongodb.password_file: ", "nope.pw: No such file"),
            #[cfg(feature = "mongodb")]
            ("control_plane.store.mongodb.uri: ", "nonsense is an invalid option"),
        ] {
            let matching =
                found.iter().filter(|fault| fault.starts_with(place) && fault.contains(part));
            assert_eq!(matching.count(), 1, "{place}{part} in {found:#?}");
        }
        assert_eq!(found.len(), 11, "{found:#?}");
    }

    #[test]
    fn what_is_seen_twice_is_told_once() {
        let section = ControlPlaneSection {
            auth: Some(AuthSection {
                issuer: "blaze".to_owned(),
                audience: "blaze-config".to_owned(),
                keys: Vec::new(),
                jwks: Some(JwksSource::Url {
                    url: "http://example.org/jwks".to_owned().into(),
                    refresh_s: 300,
                }),
            }),
            ..ControlPlaneSection::default()
        };
        assert_eq!(setup(section).check_all().unwrap_err().len(), 1);
    }

    #[tokio::test]
    async fn a_broken_backup_leaves_no_store_behind() {
        let folder = tempfile::tempdir().unwrap();
        let (backup, store) = (folder.path().join("backup"), folder.path().join("store.db"));
        std::fs::write(&backup, "{}\n").unwrap();
        let section = ControlPlaneSection {
            store: StoreSection::Sqlite { path: store.clone() },
            ..ControlPlaneSection::default()
        };
        let error = restore(&Supervisor::new("test"), &setup(section), backup).await;
        assert!(format!("{:#}", error.unwrap_err()).contains("line 1"));
        assert!(!store.exists());
    }
}
