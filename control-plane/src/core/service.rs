//! The use cases, as REST and gRPC call them. Every right is checked here, for every caller.

mod asked;
mod canaries;
mod fleet;
mod history;
mod live;
mod read;
mod sync;
mod tasks;
mod token;
mod topology;
mod write;

use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::config::selector::LabelSelector;
use blaze_domain::config::{Code, Key, Problem};
use blaze_domain::node_file::HistorySection;
use blaze_runtime::{Readiness, Supervisor};
use parking_lot::Mutex;
use tokio::sync::{Semaphore, mpsc};
use tokio_util::sync::CancellationToken;

use super::barrier::{Barrier, barrier};
use super::committer::{Committer, OnCommit, QUEUE, QUEUE_BYTES, Queued, RunningKeys, now};
use super::digests::Digests;
use super::evaluate::Evaluator;
use super::log::Log;
use super::page::Pages;
use super::schema::Schemas;
use super::secrets;
use super::view;
use super::watch::Watches;
use super::workers::Workers;
use crate::auth::{Authenticator, Claims, Revocations, Right, dev};
use crate::secrets::Keyring;
use crate::status::{Hub, StatusMetrics};
use crate::store::{Store, StoreError};
use blaze_domain::config::state::State;

pub use asked::{End, TopicsQuery, WhyQuery};
pub use fleet::ProblemsQuery;
pub use history::DiffReport;
pub use live::{LiveItem, LiveQuery, LiveStream, LiveView, live_view};
pub use sync::{OLDEST_SYNC_PROTOCOL, SYNC_PROTOCOL, SyncHello, SyncItem, SyncStream};

/// Refusals that wait to be written to the audit, at most.
const DENIED_QUEUE: usize = 1024;
/// Dry runs that are worked out at once: each takes a processor.
const DRY_RUNNING: usize = 2;
/// Dry runs that run or wait for others, at most.
const DRY_WAITING: usize = 64;
/// How long a read waits for a revision that is yet to come.
const WAIT_FOR_REVISION: Duration = Duration::from_secs(5);

/// What the core is made of.
pub struct CoreOptions {
    /// Where documents are kept.
    pub store: Arc<dyn Store>,
    /// Who accepts tokens.
    pub authenticator: Option<Arc<Authenticator>>,
    /// Who brings no token is the administrator `dev`.
    pub dev: bool,
    /// Tokens that were taken back.
    pub revocations: Revocations,
    /// Keys for secrets.
    pub keyring: Arc<Keyring>,
    /// How much of the past is kept.
    pub history: HistorySection,
    /// Told of every transaction.
    pub on_commit: OnCommit,
    /// Gets the check `store`.
    pub readiness: Readiness,
}

/// The core of the main service. Clones share it.
#[derive(Clone)]
pub struct ConfigService {
    inner: Arc<Inner>,
}

struct Inner {
    store: Arc<dyn Store>,
    store_id: String,
    log: Arc<Log>,
    evaluator: Arc<Evaluator>,
    barrier: Barrier,
    queue: mpsc::Sender<Queued>,
    watches: Arc<Watches>,
    pages: Pages,
    authenticator: Option<Arc<Authenticator>>,
    revocations: Revocations,
    /// Who everybody without a token is, in development.
    dev: Option<Arc<Claims>>,
    /// Versions of each document that trimming leaves.
    keep_versions: u32,
    running: RunningKeys,
    /// Bytes that may still be queued.
    room: Arc<Semaphore>,
    /// Dry runs that may still begin.
    dry_running: Arc<Semaphore>,
    /// Dry runs that may still wait.
    dry_waiting: Semaphore,
    denied: mpsc::Sender<token::Denial>,
    denials: Mutex<token::DenialLimit>,
    workers: Arc<Workers>,
    digests: Digests,
    status: Arc<Hub>,
    /// Snapshots that may still begin.
    snapshots: Arc<Semaphore>,
}

impl ConfigService {
    /// Loads the store and starts the tasks of the core.
    ///
    /// # Errors
    /// [`StoreError`] if the store cannot be loaded.
    pub async fn start(supervisor: &Supervisor, options: CoreOptions) -> Result<Self, StoreError> {
        let snapshot = options.store.load().await?;
        let state = State::new(snapshot.revision, snapshot.documents);
        tracing::info!(
            store_id = %snapshot.store_id, revision = snapshot.revision, documents = state.len(),
            floor = snapshot.floor,
            "the configuration is loaded"
        );
        tell_unreadable(&options.keyring, &state);
        let log = Arc::new(Log::new(state, snapshot.floor));
        let evaluator = Arc::new(Evaluator {
            keyring: Arc::clone(&options.keyring),
            schemas: Schemas::default(),
        });
        let (barrier, looks) = barrier();
        let (queue, requests) = mpsc::channel(QUEUE);
        let (denied, denials) = mpsc::channel(DENIED_QUEUE);
        let committer = Committer {
            store: Arc::clone(&options.store),
            log: Arc::clone(&log),
            evaluator: Arc::clone(&evaluator),
            queue: requests,
            on_commit: options.on_commit,
            doubtful: false,
        };
        // Only a bad name could fail, and a test makes them.
        let metrics =
            StatusMetrics::new().map_err(|error| StoreError::Refused(error.to_string()))?;
        let watches = Arc::new(Watches {
            store: Arc::clone(&options.store),
            log: Arc::clone(&log),
            revocations: options.revocations.clone(),
            ending: CancellationToken::new(),
        });
        let service = Self {
            inner: Arc::new(Inner {
                pages: Pages::new(&snapshot.store_id),
                store_id: snapshot.store_id,
                store: options.store,
                log,
                evaluator,
                barrier,
                queue,
                watches,
                authenticator: options.authenticator,
                revocations: options.revocations,
                dev: options.dev.then(|| Arc::new(dev::claims())),
                keep_versions: options.history.keep_versions,
                running: RunningKeys::default(),
                room: Arc::new(Semaphore::new(QUEUE_BYTES)),
                dry_running: Arc::new(Semaphore::new(DRY_RUNNING)),
                dry_waiting: Semaphore::new(DRY_WAITING),
                denied,
                denials: Mutex::default(),
                workers: Arc::default(),
                digests: Digests::default(),
                status: Arc::new(Hub::new(metrics)),
                snapshots: Arc::new(Semaphore::new(sync::SNAPSHOTS)),
            }),
        };
        service.refresh_tokens().await?;
        let parts = tasks::Parts {
            committer,
            looks,
            denials,
            history: options.history,
            readiness: options.readiness,
        };
        service.spawn_tasks(supervisor, parts);
        Ok(service)
    }

    /// Who a token belongs to. Without `bearer` it is an administrator in development, and nobody
    /// otherwise.
    ///
    /// # Errors
    /// [`Code::Unauthenticated`], the same for all causes; the cause is in `internal`.
    pub fn authenticate(
        &self,
        bearer: Option<&str>,
        address: IpAddr,
    ) -> Result<Arc<Claims>, Problem> {
        let refuse = |reason: &str| {
            let detail = "a valid token is needed: Authorization: Bearer <token>";
            Err(Problem::new(Code::Unauthenticated, detail)
                .because(format!("{reason} (from {address})")))
        };
        let (authenticator, bearer) = match (&self.inner.authenticator, bearer, &self.inner.dev) {
            (None, _, Some(dev)) | (Some(_), None, Some(dev)) => return Ok(Arc::clone(dev)),
            (_, None, None) => return refuse("no token"),
            (None, Some(_), None) => return refuse("no key to check it with"),
            (Some(authenticator), Some(bearer), _) => (authenticator, bearer),
        };
        let claims = match authenticator.verify(bearer, now().as_millis() / 1000) {
            Ok(claims) => claims,
            Err(reason) => return refuse(&reason),
        };
        match &claims.token_id {
            Some(id) if self.inner.revocations.is_revoked(id) => refuse("the token was revoked"),
            _ => Ok(claims),
        }
    }

    /// Whether a role allows something at all, before the request is read.
    ///
    /// # Errors
    /// [`Code::PermissionDenied`].
    pub fn authorize(&self, claims: &Claims, right: Right) -> Result<(), Problem> {
        view::authorize(claims, right)
    }

    /// The newest revision in memory.
    #[must_use]
    pub fn revision(&self) -> u64 {
        self.inner.log.revision()
    }

    /// The smallest revision that a watch may start after.
    #[must_use]
    pub fn oldest_revision(&self) -> u64 {
        self.inner.log.floor()
    }

    /// How many documents there are.
    #[must_use]
    pub fn documents(&self) -> usize {
        self.inner.log.state().len()
    }

    /// Which store this is.
    #[must_use]
    pub fn store_id(&self) -> &str {
        &self.inner.store_id
    }

    /// Ends all watches; those that are opened later end at once.
    pub fn end_watches(&self) {
        self.inner.watches.ending.cancel();
    }

    fn state(&self) -> State {
        self.inner.log.state()
    }
}

/// Secrets that do not open stay redacted even where they are to be revealed, and services do not
/// get them: say so.
fn tell_unreadable(keyring: &Keyring, state: &State) {
    let mut unreadable = state.all().filter_map(|(key, held)| {
        secrets::unreadable(keyring, &held.document).map(|error| (key, error))
    });
    if let Some((first, error)) = unreadable.next() {
        tracing::error!(
            documents = unreadable.count() + 1, %first, %error,
            "there are secrets that cannot be read: put their key back among \
             control_plane.encryption.keys, or write them anew"
        );
    }
}

/// A label selector as it was given.
pub(crate) fn selector(text: &str) -> Result<LabelSelector, Problem> {
    let refuse = |error: String| {
        Problem::new(Code::InvalidLabelSelector, format!("label_selector {text:?}: {error}"))
    };
    text.parse::<LabelSelector>().map_err(|error| refuse(error.to_string()))
}

fn not_found(key: &Key, state: &State) -> Problem {
    let name = key.name().as_str();
    let near = state
        .of_kind(key.kind(), None)
        .take(1000)
        .filter(|(other, _)| other.service_name() == key.service_name() && *other != key)
        .map(|(other, _)| (strsim::damerau_levenshtein(other.name().as_str(), name), other))
        .min_by_key(|(distance, _)| *distance);
    let hint = match near {
        Some((distance, other)) if distance <= 2 => format!("; did you mean {}?", other.name()),
        _ => String::new(),
    };
    Problem::new(Code::NotFound, format!("there is no {key}{hint}"))
}
