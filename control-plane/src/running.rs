//! A main service that runs, in a process of its own or within another program: what it is built
//! of, and in which order it begins and ends.
//!
//! ```text
//! admin ─▶ keys ─▶ store (migrated; waited for) ─▶ core ─▶ REST, gRPC ─▶ ready
//! end: not ready ─▶ watches end ─▶ open requests finish ─▶ store closed
//! ```

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_runtime::supervisor::{ShutdownPhase, ShutdownSteps, Supervisor, TaskPolicy};
use blaze_runtime::{AdminServer, CheckStatus, Gate, Readiness};
use rand::RngExt as _;
use tokio::sync::watch;

use crate::api::grpc::{self, GrpcOptions};
use crate::api::limits::ApiLimits;
use crate::api::rest::{self, RestOptions};
use crate::auth::Revocations;
use crate::core::{ConfigService, CoreOptions};
use crate::listen::{ListenLimits, Listener, Protocols, Serving, install_crypto_provider};
use crate::metrics::ApiMetrics;
use crate::process::{Keys, SHUTDOWN, Setup, all_of};
use crate::store::{FullStore, Store};
use crate::waiting::{News, Waiting};

/// Where a main service is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Addresses {
    /// REST.
    pub rest: SocketAddr,
    /// gRPC, for clients and workers.
    pub grpc: SocketAddr,
    /// `/livez`, `/readyz`, `/metrics`.
    pub admin: SocketAddr,
}

/// A main service that runs until its supervisor ends.
pub struct RunningMain {
    readiness: Readiness,
    admin: SocketAddr,
    /// `None` while the store is waited for.
    built: watch::Sender<Option<Arc<Built>>>,
}

/// What there is once the store is open.
struct Built {
    service: ConfigService,
    store: Arc<dyn FullStore>,
    rest: Serving,
    grpc: Serving,
}

impl RunningMain {
    /// Starts it; returns as soon as the admin port listens. The store may come later. What cannot
    /// work then is a failure of the supervisor.
    ///
    /// # Errors
    /// When the admin port cannot be bound.
    pub async fn start(supervisor: &Supervisor, setup: Setup) -> anyhow::Result<Self> {
        install_crypto_provider();
        let readiness = Readiness::new();
        readiness.add("store", Gate::Decides, CheckStatus::Failed, "not opened yet");
        let metrics = Arc::new(ApiMetrics::new().context("metrics")?);
        let built = watch::Sender::new(None);
        let admin = admin(supervisor, &setup, &readiness, &metrics, built.subscribe()).await?;
        let (inside, ready, slot) = (supervisor.clone(), readiness.clone(), built.clone());
        supervisor.spawn("start", TaskPolicy::MayEnd, async move {
            let stopping = inside.stopping_token();
            // The store may come later than this process, and the end earlier than the store.
            let result = tokio::select! {
                result = build(&inside, &setup, &ready, &metrics) => result,
                () = stopping.cancelled() => return,
            };
            match result {
                Ok(built) => {
                    slot.send_replace(Some(Arc::new(built)));
                }
                Err(error) => inside.fail(format!("{error:#}")),
            }
        });
        Ok(Self { readiness, admin, built })
    }

    /// Where it is asked for its state, from the beginning.
    #[must_use]
    pub fn admin(&self) -> SocketAddr {
        self.admin
    }

    /// Waits until it serves, and says where. It waits for ever where the supervisor has failed
    /// before.
    pub async fn ready(&self) -> Addresses {
        let mut built = self.built.subscribe();
        let is_built = built.wait_for(Option::is_some).await;
        let ports = is_built.ok().and_then(|built| {
            let built = built.as_ref()?;
            Some((built.rest.local_addr(), built.grpc.local_addr()))
        });
        let Some((rest, grpc)) = ports else {
            // The sender is in `self`: it cannot be gone.
            return std::future::pending().await;
        };
        self.readiness.ready().await;
        Addresses { rest, grpc, admin: self.admin }
    }

    /// The steps of its orderly end, behind those that there are. The supervisor has to run on
    /// while they are taken.
    #[must_use]
    pub fn shutdown_steps(&self, steps: ShutdownSteps) -> ShutdownSteps {
        let readiness = self.readiness.clone();
        let [watches, drained, closed] = [(); 3].map(|()| self.built.subscribe());
        let now = |built: &watch::Receiver<Option<Arc<Built>>>| built.borrow().clone();
        steps
            .on(ShutdownPhase::NotReady, "readiness", async move { readiness.stop() })
            .on(ShutdownPhase::EndStreams, "watches", async move {
                if let Some(built) = now(&watches) {
                    built.service.end_watches();
                }
            })
            .on(ShutdownPhase::Drain, "requests", async move {
                if let Some(built) = now(&drained) {
                    built.rest.stop();
                    built.grpc.stop();
                    tokio::join!(built.rest.drained(), built.grpc.drained());
                }
            })
            .on(ShutdownPhase::Drain, "store", async move {
                if let Some(built) = now(&closed) {
                    built.store.close().await;
                }
            })
    }
}

async fn admin(
    supervisor: &Supervisor,
    setup: &Setup,
    readiness: &Readiness,
    metrics: &Arc<ApiMetrics>,
    built: watch::Receiver<Option<Arc<Built>>>,
) -> std::io::Result<SocketAddr> {
    let metrics = Arc::clone(metrics);
    let text = move || {
        if let Some(built) = built.borrow().as_ref() {
            let core = &built.service;
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
        }
        metrics.text()
    };
    let address = setup.section.admin.listen;
    let server =
        AdminServer::bind(address, axum::Router::new(), readiness.clone(), Arc::new(text)).await?;
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
    let mut waiting = Waiting::default();
    loop {
        let error = match setup.open(supervisor).await {
            Ok(store) => return Ok(store),
            Err(error) if error.is_transient() => error,
            Err(error) => return Err(error.into()),
        };
        match waiting.news(&error.to_string(), Instant::now()) {
            News::Other(hint) => tracing::warn!(%error, hint, "waiting for the store"),
            News::Still => {
                tracing::warn!("still waiting for the store, for the reason that was told before");
            }
            News::None => tracing::debug!(%error, "waiting for the store"),
        }
        readiness.set("store", CheckStatus::Failed, error.told());
        let pause = rand::rng().random_range(Duration::from_millis(100)..Duration::from_secs(2));
        tokio::time::sleep(pause).await;
    }
}

async fn build(
    supervisor: &Supervisor,
    setup: &Setup,
    readiness: &Readiness,
    metrics: &Arc<ApiMetrics>,
) -> anyhow::Result<Built> {
    let section = &setup.section;
    let keys = Keys::read(section).map_err(all_of)?;
    keys.watch(supervisor);
    let Keys { keyring, authenticator, tls } = keys;
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
    metrics.add(service.status_metrics().collectors()).context("metrics")?;
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
    let rest_port =
        Listener::bind("rest", rest_port, tls.clone(), Protocols::Both, listen.clone()).await?;
    let grpc_port =
        Listener::bind("grpc", section.grpc.listen, tls, Protocols::Http2, listen).await?;
    Ok(Built {
        rest: rest_port.serve(supervisor, rest, metrics),
        grpc: grpc_port.serve(supervisor, grpc, metrics),
        service,
        store,
    })
}
