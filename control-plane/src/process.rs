//! The process around the core: what it is built of, and in which order it begins and ends.
//!
//! ```text
//! keys ─▶ store (migrated) ─▶ core ─▶ REST, gRPC, admin ─▶ ready line
//! SIGTERM: not ready ─▶ no new connections ─▶ watches end ─▶ open requests finish ─▶ store closed
//! ```

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_domain::node_file::{ControlPlaneSection, StoreSection};
use blaze_runtime::supervisor::{ShutdownPhase, ShutdownSteps, Supervisor, TaskPolicy, exit_code};
use blaze_runtime::{AdminServer, CheckStatus, Gate, Readiness, ready_line, say};
use rand::RngExt as _;

use crate::api::grpc::{self, GrpcOptions};
use crate::api::limits::ApiLimits;
use crate::api::rest::{self, RestOptions};
use crate::auth::startup::check_startup;
use crate::auth::{Authenticator, Revocations};
use crate::core::{ConfigService, CoreOptions};
use crate::listen::{
    ListenCounters, ListenLimits, Listener, Protocols, Serving, Tls, install_crypto_provider, metrics_text,
};
use crate::metrics::ApiMetrics;
use crate::secrets::Keyring;
use crate::store::migrate::Plan;
use crate::store::{self, FullStore, Store, StoreError, backup};

/// A shutdown takes at most this long.
const SHUTDOWN: Duration = Duration::from_secs(10);

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
        if cfg!(not(feature = "mongodb")) && matches!(self.section.store, StoreSection::MongoDb { .. }) {
            faults.push(
                "control_plane.store.mongodb: this program was built without MongoDB (cargo feature `mongodb`)"
                    .to_owned(),
            );
        }
        if faults.is_empty() { Ok(()) } else { Err(faults) }
    }

    /// The same, and whether every file with a key or a certificate can be used. The store is not looked at.
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

    async fn open(&self, supervisor: &Supervisor) -> Result<Arc<dyn FullStore>, StoreError> {
        match self.in_memory {
            true => store::in_memory(supervisor).await,
            false => store::open(&self.section.store, supervisor).await,
        }
    }
}

/// Everything that is read of files before the store is opened.
struct Keys {
    keyring: Keyring,
    authenticator: Option<Authenticator>,
    tls: Option<Tls>,
}

impl Keys {
    /// # Errors
    /// Every fault, with its place in the node file.
    fn read(section: &ControlPlaneSection) -> Result<Self, Vec<String>> {
        let authenticator = section.auth.as_ref().map(Authenticator::load).transpose();
        let keyring = Keyring::load(&section.encryption);
        match (authenticator, keyring, Tls::load(&section.tls)) {
            (Ok(authenticator), Ok(keyring), Ok(tls)) => Ok(Self {
                keyring,
                authenticator,
                tls,
            }),
            (authenticator, keyring, tls) => {
                let faults = [authenticator.err(), keyring.err(), tls.err()];
                Err(faults.into_iter().flatten().flatten().collect())
            }
        }
    }

    /// Reads the files again when they change.
    fn watch(&self, supervisor: &Supervisor) {
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
    let supervisor = Supervisor::new("blaze-config");
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
        Err(error) => {
            say(format_args!("blaze-config failed: {error:#}"));
            ExitCode::from(exit_code::FAILED)
        }
    }
}

async fn migrate(supervisor: &Supervisor, setup: &Setup, dry_run: bool) -> anyhow::Result<()> {
    let Plan {
        version,
        target,
        pending,
    } = store::plan(&setup.section.store).await?;
    say(format_args!(
        "the store has schema {version}, this program knows {target}"
    ));
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
        out.into_inner()
            .map_err(std::io::IntoInnerError::into_error)?
            .sync_all()?;
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
    std::fs::OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(path)
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
    say(format_args!(
        "{replaced} versions of documents are encrypted with the first key now"
    ));
    let failed = failed.into_inner();
    failed.iter().for_each(|line| say(format_args!("{line}")));
    anyhow::ensure!(failed.is_empty(), "{} versions were left as they are", failed.len());
    Ok(())
}

#[expect(clippy::needless_pass_by_value, reason = "it stands in `map_err`")]
fn all_of(faults: Vec<String>) -> anyhow::Error {
    anyhow::anyhow!(faults.join("; "))
}

/// What runs once everything is built.
struct Running {
    service: ConfigService,
    store: Arc<dyn FullStore>,
    rest: Serving,
    grpc: Serving,
    counters: [Arc<ListenCounters>; 2],
}

async fn serve(supervisor: &Supervisor, setup: Setup) -> ExitCode {
    let readiness = Readiness::new();
    readiness.add("store", Gate::Decides, CheckStatus::Failed, "not opened yet");
    let metrics = match ApiMetrics::new() {
        Ok(metrics) => Arc::new(metrics),
        Err(error) => {
            say(format_args!("blaze-config failed: metrics: {error}"));
            return ExitCode::from(exit_code::FAILED);
        }
    };
    let running: Arc<OnceLock<Running>> = Arc::new(OnceLock::new());
    let admin = match admin(supervisor, &setup, &readiness, &metrics, &running).await {
        Ok(address) => address,
        Err(error) => {
            say(format_args!("blaze-config failed: {error}"));
            return ExitCode::from(exit_code::FAILED);
        }
    };
    // The store may come later than this process, and SIGTERM earlier than the store.
    let starting = {
        let (supervisor, readiness, running) = (supervisor.clone(), readiness.clone(), Arc::clone(&running));
        async move {
            let stopping = supervisor.stopping_token();
            let built = tokio::select! {
                built = start(&supervisor, &setup, &readiness, &metrics) => built,
                () = stopping.cancelled() => return Ok(()),
            };
            let built = built.map_err(|error| format!("{error:#}"))?;
            let (rest, grpc) = (built.rest.local_addr(), built.grpc.local_addr());
            // Set once, here.
            let _ = running.set(built);
            readiness.ready().await;
            ready_line(&[("rest", rest), ("grpc", grpc), ("admin", admin)]).map_err(|error| error.to_string())
        }
    };
    let failing = supervisor.clone();
    supervisor.spawn("start", TaskPolicy::MayEnd, async move {
        if let Err(reason) = starting.await {
            failing.fail(reason);
        }
    });
    let (watches, drained, closed) = (Arc::clone(&running), Arc::clone(&running), running);
    let steps = ShutdownSteps::new(SHUTDOWN)
        .on(ShutdownPhase::NotReady, "readiness", async move { readiness.stop() })
        .on(ShutdownPhase::EndStreams, "watches", async move {
            if let Some(running) = watches.get() {
                running.service.end_watches();
            }
        })
        .on(ShutdownPhase::Drain, "requests", async move {
            if let Some(running) = drained.get() {
                running.rest.stop();
                running.grpc.stop();
                tokio::join!(running.rest.drained(), running.grpc.drained());
            }
        })
        .on(ShutdownPhase::Drain, "store", async move {
            if let Some(running) = closed.get() {
                running.store.close().await;
            }
        });
    supervisor.clone().run(steps).await
}

async fn admin(
    supervisor: &Supervisor,
    setup: &Setup,
    readiness: &Readiness,
    metrics: &Arc<ApiMetrics>,
    running: &Arc<OnceLock<Running>>,
) -> std::io::Result<SocketAddr> {
    let (metrics, running) = (Arc::clone(metrics), Arc::clone(running));
    let text = move || {
        let mut text = String::new();
        if let Some(running) = running.get() {
            let core = &running.service;
            metrics.state(
                core.revision(),
                core.oldest_revision(),
                core.documents(),
                core.denials_skipped(),
            );
            let lags = core.worker_lags();
            metrics.worker_lags(lags.iter().map(|((layer, node), lag)| {
                let node = node.as_ref().map_or("", |node| node.as_str());
                (layer.as_str(), node, *lag)
            }));
            text.push_str(&metrics_text(&running.counters));
        }
        metrics.text() + &text
    };
    let address = setup.section.admin.listen;
    let server = AdminServer::bind(address, axum::Router::new(), readiness.clone(), Arc::new(text)).await?;
    let address = server.address();
    server.serve(supervisor);
    Ok(address)
}

/// Between two lines that say that nothing has changed.
const STILL_WAITING: Duration = Duration::from_secs(60);

/// What the log is told of a store that cannot be reached: each reason once.
#[derive(Default)]
struct Waiting {
    /// The last reason without its numbers, and when something was told.
    told: Option<(String, Instant)>,
}

#[derive(Debug, PartialEq, Eq)]
enum News {
    /// Another reason than before, with what to do about it if that is known.
    Other(Option<&'static str>),
    /// The same reason for long.
    Still,
    None,
}

impl Waiting {
    fn news(&mut self, reason: &str, now: Instant) -> News {
        let shape = without_numbers(reason);
        match &mut self.told {
            Some((told, at)) if *told == shape => {
                if now.saturating_duration_since(*at) < STILL_WAITING {
                    return News::None;
                }
                *at = now;
                News::Still
            }
            told => {
                *told = Some((shape, now));
                News::Other(hint(reason))
            }
        }
    }
}

/// Times and counters differ from one try to the next: `1.5 ms` and `820 µs` are the same.
fn without_numbers(text: &str) -> String {
    let part = |c: char| c.is_alphanumeric() || matches!(c, '.' | 'µ');
    let mut out = String::new();
    for word in text.split_inclusive(|c: char| !part(c)) {
        if word.contains(|c: char| c.is_ascii_digit()) {
            out.push('#');
        } else if !matches!(word.trim_end_matches(|c: char| !part(c)), "ns" | "µs" | "ms" | "s") {
            out.push_str(word);
        }
    }
    out
}

/// MongoDB's driver tells the state of each member in words alone.
fn hint(reason: &str) -> Option<&'static str> {
    reason
        .contains("RsGhost")
        .then_some("a member says that its replica set was never initiated: run rs.initiate() once, on one member")
}

/// Opens the store, again and again while it cannot be reached.
async fn open_store(
    supervisor: &Supervisor,
    setup: &Setup,
    readiness: &Readiness,
) -> anyhow::Result<Arc<dyn FullStore>> {
    let mut waiting = Waiting::default();
    loop {
        let error = match setup.open(supervisor).await {
            Ok(store) => return Ok(store),
            Err(error) if error.is_transient() => error,
            Err(error) => return Err(error.into()),
        };
        match waiting.news(&error.to_string(), Instant::now()) {
            News::Other(hint) => tracing::warn!(%error, hint, "waiting for the store"),
            News::Still => tracing::warn!("still waiting for the store, for the reason that was told before"),
            News::None => tracing::debug!(%error, "waiting for the store"),
        }
        readiness.set("store", CheckStatus::Failed, error.told());
        let pause = rand::rng().random_range(Duration::from_millis(100)..Duration::from_secs(2));
        tokio::time::sleep(pause).await;
    }
}

async fn start(
    supervisor: &Supervisor,
    setup: &Setup,
    readiness: &Readiness,
    metrics: &Arc<ApiMetrics>,
) -> anyhow::Result<Running> {
    let section = &setup.section;
    let keys = Keys::read(section).map_err(all_of)?;
    keys.watch(supervisor);
    let Keys {
        keyring,
        authenticator,
        tls,
    } = keys;
    let store = open_store(supervisor, setup, readiness).await?;
    let told = Arc::clone(metrics);
    let options = CoreOptions {
        store: Arc::clone(&store) as Arc<dyn Store>,
        authenticator: authenticator.map(Arc::new),
        dev: setup.dev,
        revocations: Revocations::new(),
        keyring: Arc::new(keyring),
        history: section.history.clone(),
        on_commit: Arc::new(move |report| told.commit(&report)),
        readiness: readiness.clone(),
    };
    let service = ConfigService::start(supervisor, options).await?;
    let limits = Arc::new(ApiLimits::new(&section.limits));
    let rest = rest::router(
        service.clone(),
        RestOptions {
            dev: setup.dev,
            limits: Arc::clone(&limits),
            readiness: readiness.clone(),
            metrics: Arc::clone(metrics),
        },
    );
    let grpc = grpc::router(
        service.clone(),
        GrpcOptions {
            dev: setup.dev,
            limits,
            metrics: Arc::clone(metrics),
            readiness: readiness.clone(),
            reflection: section.grpc.reflection || setup.dev,
            stopping: supervisor.stopping_token(),
        },
    );
    let listen = ListenLimits {
        // A watcher that stands still for a minute is told why it ends; see `watch_too_slow`.
        write_stall: Duration::from_secs(120),
        drain_timeout: SHUTDOWN - Duration::from_secs(2),
        ..ListenLimits::default()
    };
    let rest_port = section.rest.listen;
    let rest_port = Listener::bind("rest", rest_port, tls.clone(), Protocols::Both, listen.clone()).await?;
    let grpc_port = Listener::bind("grpc", section.grpc.listen, tls, Protocols::Http2, listen).await?;
    Ok(Running {
        counters: [rest_port.counters(), grpc_port.counters()],
        rest: rest_port.serve(supervisor, rest),
        grpc: grpc_port.serve(supervisor, grpc),
        service,
        store,
    })
}

#[cfg(test)]
mod tests {
    use blaze_domain::node_file::{AuthSection, EncryptionKey, JwksSource, JwtAlgorithm, JwtKey};

    use super::*;

    fn setup(section: ControlPlaneSection) -> Setup {
        Setup {
            section,
            dev: false,
            in_memory: false,
        }
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
        section.encryption.keys = vec![EncryptionKey {
            id: "e1".to_owned(),
            file: path("nope.enc"),
        }];
        section.tls.cert_file = Some(path("nope.pem"));
        section.tls.key_file = Some(path("nope.pem"));
        section.tls.client_ca_file = Some(path("nope.ca"));
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
        ] {
            let matching = found
                .iter()
                .filter(|fault| fault.starts_with(place) && fault.contains(part));
            assert_eq!(matching.count(), 1, "{place}{part} in {found:#?}");
        }
        assert_eq!(found.len(), 9, "{found:#?}");
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

    #[test]
    fn a_reason_to_wait_is_told_once() {
        let ghost = |rtt: &str| {
            format!(
                "MongoDB: Server selection timeout: No available servers. Topology: {{ Type: ReplicaSetNoPrimary, Servers: \
                 [ {{ Address: 127.0.0.1:27017, Type: RsGhost, Average RTT: {rtt}, Last Update Time: 2026-11-23 9:12:33.5 }} ] }}"
            )
        };
        let (mut waiting, start) = (Waiting::default(), Instant::now());
        let News::Other(Some(hint)) = waiting.news(&ghost("1.2ms"), start) else {
            panic!("the first reason is news");
        };
        assert!(hint.contains("rs.initiate()"));
        assert_eq!(
            waiting.news(&ghost("820µs"), start + Duration::from_secs(2)),
            News::None
        );
        assert_eq!(
            waiting.news(&ghost("2.5 ms"), start + Duration::from_secs(59)),
            News::None
        );
        assert_eq!(
            waiting.news(&ghost("2 ms"), start + Duration::from_secs(61)),
            News::Still
        );
        assert_eq!(
            waiting.news(&ghost("2 ms"), start + Duration::from_secs(63)),
            News::None
        );
        let other = "MongoDB: connection refused";
        assert_eq!(waiting.news(other, start + Duration::from_secs(64)), News::Other(None));
        assert!(matches!(waiting.news(&ghost("1 s"), start), News::Other(Some(_))));
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
