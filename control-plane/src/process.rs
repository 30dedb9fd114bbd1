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
use std::time::Duration;

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

    async fn open(&self, supervisor: &Supervisor) -> Result<Arc<dyn FullStore>, StoreError> {
        match self.in_memory {
            true => store::in_memory(supervisor).await,
            false => store::open(&self.section.store, supervisor).await,
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
    let store = setup.open(supervisor).await?;
    let restored = backup::restore(&*store, &mut file).await.with_context(context);
    store.close().await;
    let restored = restored?;
    say(format_args!(
        "restored as store {} at revision {}: every client lists again",
        restored.store_id, restored.revision
    ));
    Ok(())
}

async fn reencrypt(supervisor: &Supervisor, setup: &Setup) -> anyhow::Result<()> {
    let keyring = keyring(setup)?;
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

fn keyring(setup: &Setup) -> anyhow::Result<Keyring> {
    Keyring::load(&setup.section.encryption).map_err(|faults| anyhow::anyhow!(faults.join("; ")))
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

/// Opens the store, again and again while it cannot be reached.
async fn open_store(
    supervisor: &Supervisor,
    setup: &Setup,
    readiness: &Readiness,
) -> anyhow::Result<Arc<dyn FullStore>> {
    loop {
        let error = match setup.open(supervisor).await {
            Ok(store) => return Ok(store),
            Err(error) if error.is_transient() => error,
            Err(error) => return Err(error.into()),
        };
        tracing::warn!(%error, "waiting for the store");
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
    let keyring = keyring(setup)?;
    keyring.watch(supervisor);
    let authenticator = match &section.auth {
        Some(auth) => {
            let authenticator = Authenticator::load(auth).map_err(|faults| anyhow::anyhow!(faults.join("; ")))?;
            authenticator.watch(supervisor);
            Some(Arc::new(authenticator))
        }
        None => None,
    };
    let store = open_store(supervisor, setup, readiness).await?;
    let told = Arc::clone(metrics);
    let options = CoreOptions {
        store: Arc::clone(&store) as Arc<dyn Store>,
        authenticator,
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
    let tls = Tls::load(&section.tls).map_err(|fault| anyhow::anyhow!("control_plane.tls: {fault}"))?;
    if let Some(tls) = &tls {
        tls.watch(supervisor);
    }
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
