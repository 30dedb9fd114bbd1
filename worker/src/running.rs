//! A worker put together: what it starts, in which order, and how it ends.
//!
//! ```text
//! key ─▶ copies (file, database) ─▶ what to serve first ─▶ engine ─▶ stream, broker, lease, mounted file
//! end: copies hold what was stored ─▶ lease given up
//! ```

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::Context as _;
use blaze_brokers::redis::RedisKeys;
use blaze_brokers::{Broker, BrokerKind, Health};
use blaze_domain::InstanceName;
use blaze_domain::names::ChannelName;
use blaze_runtime::main_service::MainService;
use blaze_runtime::{Supervisor, TaskPolicy};
use bytes::Bytes;
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;

use crate::copy::{Copies, Counts as CopyCounts, Vault, choose, defaults};
use crate::core::Site;
use crate::engine::{Engine, Identity, Inputs, Outputs, QUEUE, Replies, Sign, Status};
use crate::hearing::{ACK, GET, WATCHDOG, listen, notice_deafness, scan};
use crate::kept;
use crate::lease::{self, Holder, Leadership, Lease};
use crate::own::{OwnConfig, say_again};
use crate::serve::{BrokerOutlet, Channels, Speaker, SpeakerCounts};
use crate::settings::WorkerSettings;
use crate::sync::follow;

/// Copies that may be read late: file and database.
const COPIES: usize = 2;
/// Between two looks at the mounted file.
const LOOK_AT_FILE: Duration = Duration::from_millis(500);
/// How long the end waits for the copies.
const KEEP_WITHIN: Duration = Duration::from_secs(2);
/// How long it waits until the lease is given up.
const GIVE_UP_WITHIN: Duration = Duration::from_secs(2);

/// What a worker is made of.
pub struct WorkerOptions {
    /// What it does.
    pub settings: WorkerSettings,
    /// The broker that services are on.
    pub broker: Arc<dyn Broker>,
    /// Where keys go.
    pub keys: Option<Arc<RedisKeys>>,
    /// Folder of the copies; it is made if it is not there. `None`: nothing is kept.
    pub folder: Option<PathBuf>,
    /// The lease of its layer, which, if it is on a Redis, is on that of the keys; `None`: it is
    /// alone.
    pub lease: Option<Arc<dyn Lease>>,
    /// Its name among the workers of the layer.
    pub worker_id: String,
    /// Which instance it is, as a service with a configuration of its own.
    pub instance: InstanceName,
}

/// A worker that runs until its supervisor ends.
pub struct RunningWorker {
    queries: mpsc::Sender<oneshot::Sender<Status>>,
    speaker: Speaker,
    copies: Option<Copies>,
    lease: Option<LeaseEnd>,
    main: watch::Sender<MainService>,
    own: OwnConfig,
    broker: Arc<dyn Broker>,
    hears_requests: Arc<AtomicBool>,
    has_main: bool,
    worker_id: String,
    rival: watch::Receiver<Option<String>>,
    /// Of a worker that may be the only one of its node: whether it leads.
    leads: Option<watch::Receiver<Option<u64>>>,
}

/// How the task that keeps the lease is ended, and says that it has.
struct LeaseEnd {
    give_up: CancellationToken,
    is_given_up: CancellationToken,
}

impl RunningWorker {
    /// Starts it. It waits for nobody but, shortly, for its own copies.
    ///
    /// # Errors
    /// A file or folder that it cannot work with.
    pub async fn start(options: WorkerOptions, supervisor: &Supervisor) -> anyhow::Result<Self> {
        let WorkerOptions { settings, broker, keys, folder, lease, worker_id, instance } = options;
        let vault = Vault::load(settings.key_file.as_deref()).context("worker.key_file")?;
        let (file, database) = kept::open(&settings, folder, &vault).await?;
        let (find, found) = mpsc::channel(COPIES);
        let start = choose(file, database).await;
        let has_copies = !start.targets.is_empty();
        let copies = has_copies.then(|| Copies::start(supervisor, start.targets, &find));
        if let Some(from) = &start.from {
            tracing::info!(from, "services get their last configuration");
        }
        let (holder, leadership) = match &lease {
            Some(lease) => {
                let (holder, leadership) = lease::leadership();
                (Some((holder, Arc::clone(lease))), leadership)
            }
            None => (None, Leadership::alone()),
        };
        let is_of_node = lease.is_some() && settings.site.node.is_some();
        let leads = is_of_node.then(|| leadership.leader.clone());
        let speaker = Speaker::new(leadership.term.clone());
        let mut outlet = BrokerOutlet::new(Arc::clone(&broker));
        let records = keys.clone();
        if let Some(keys) = keys {
            let site = settings.site.clone();
            let is_own = move |value: &[u8]| is_own(&site, value);
            let lock = lease.as_ref().and_then(|lease| lease.lock().cloned());
            outlet = outlet.with_keys(keys, settings.keys_on_broker(), lock, is_own);
        }
        let outlet = Arc::new(outlet);
        let (acks, acked) = watch::channel(None);
        let (queries, asked) = mpsc::channel(QUEUE);
        let (events, sync) = mpsc::channel(QUEUE);
        let (requests, gets) = mpsc::channel(QUEUE);
        let (said, signs) = mpsc::channel(QUEUE);
        let defaults = match &settings.defaults_file {
            Some(path) => defaults::watch_file(
                supervisor,
                path.clone(),
                settings.site.layer.clone(),
                LOOK_AT_FILE,
            ),
            None => watch::channel(defaults::Status::default()).1,
        };
        let (own, said_of_own, own_acks) = OwnConfig::new(&settings.node, instance)?;
        let identity = Identity {
            site: settings.site.clone(),
            node: settings.node.clone(),
            worker_id: worker_id.clone(),
            delivery: settings.delivery,
        };
        let outputs = Outputs {
            replies: Arc::clone(&outlet) as Arc<dyn Replies>,
            speaker: speaker.clone(),
            channels: outlet.makes_channels().then(|| Arc::clone(&outlet) as Arc<dyn Channels>),
            copies: copies.clone(),
            acks,
            own: Some(said_of_own),
            term: leadership.term,
            told: leadership.told,
        };
        let inputs = Inputs {
            sync,
            gets,
            signs,
            defaults,
            leader: leadership.leader,
            noted: leadership.noted,
            queries: asked,
            found,
        };
        let stop = supervisor.shutdown_token();
        let spawn = |name: &str, task: futures::future::BoxFuture<'static, ()>| {
            let stop = stop.clone();
            supervisor.spawn(name, TaskPolicy::Essential, async move {
                tokio::select! {
                    () = task => {}
                    () = stop.cancelled() => {}
                }
            });
        };
        let hears_requests = Arc::new(AtomicBool::new(false));
        spawn("own state", Box::pin(say_again(own_acks, said.clone())));
        let engine = Engine::new(identity, outputs, start.loaded);
        spawn("engine", Box::pin(engine.run(inputs, stop.clone())));
        spawn("notices", Box::pin(speaker.clone().run(outlet)));
        let hears = Arc::clone(&hears_requests);
        let listening = listen(Arc::clone(&broker), GET, requests, |payload| payload, hears);
        spawn("requests", Box::pin(listening));
        type Into = fn(Bytes) -> Sign;
        let heard: [(&str, &str, Into); 2] =
            [("acknowledgements", ACK, Sign::Ack), ("watchdogs", WATCHDOG, Sign::Beat)];
        for (name, channel, into) in heard {
            let listening =
                listen(Arc::clone(&broker), channel, said.clone(), into, Arc::default());
            spawn(name, Box::pin(listening));
        }
        spawn("outages", Box::pin(notice_deafness(broker.status(), said.clone())));
        if let Some(records) = records {
            spawn("records of watchdogs", Box::pin(scan(records, said)));
        }
        let lease = holder.map(|(holder, lease)| {
            let end = LeaseEnd {
                give_up: CancellationToken::new(),
                is_given_up: CancellationToken::new(),
            };
            let (give_up, is_given_up) = (end.give_up.clone(), end.is_given_up.clone());
            let time = settings.lease;
            spawn(
                "lease",
                Box::pin(async move {
                    keep_until(lease, time, holder, &give_up).await;
                    is_given_up.cancel();
                    std::future::pending::<()>().await;
                }),
            );
            end
        });
        let main = settings.main.clone();
        let (main_sender, main_receiver) = watch::channel(main.clone().unwrap_or_default());
        if main.is_some() {
            spawn("stream", Box::pin(follow(main_receiver, events, acked, stop.clone())));
        }
        Ok(Self {
            queries,
            speaker,
            copies,
            lease,
            has_main: main.is_some(),
            main: main_sender,
            own,
            broker,
            hears_requests,
            worker_id,
            rival: leadership.rival,
            leads,
        })
    }

    /// How it is; `None` if it has ended.
    pub async fn status(&self) -> Option<Status> {
        let (send, answer) = oneshot::channel();
        self.queries.send(send).await.ok()?;
        answer.await.ok()
    }

    /// Whether services reach it on its broker: that answers, what they say there is heard, and no
    /// other worker of the node serves instead.
    /// With words for people.
    #[must_use]
    pub fn reach(&self) -> (bool, String) {
        if let Some(rival) = &*self.rival.borrow() {
            let words = format!(
                "another worker of this node was started later and serves: {rival}; this one is {}",
                self.worker_id
            );
            return (false, words);
        }
        if self.leads.as_ref().is_some_and(|leads| leads.borrow().is_none()) {
            return (false, "the lease of the node is not held yet".to_owned());
        }
        let status = self.broker.status().borrow().clone();
        match (status.health, self.hears_requests.load(Ordering::Relaxed)) {
            (Health::Up, true) => (true, status.detail),
            (Health::Up, false) => {
                (false, format!("{}: requests are not heard yet", status.detail))
            }
            (Health::Connecting | Health::Down | Health::InUse | Health::Closed, _) => {
                (false, status.detail)
            }
        }
    }

    /// Whether it has a main service to ask at all.
    #[must_use]
    pub fn has_main(&self) -> bool {
        self.has_main
    }

    /// What became of notices and keys.
    #[must_use]
    pub fn speaker(&self) -> SpeakerCounts {
        self.speaker.counts()
    }

    /// What became of the copies.
    #[must_use]
    pub fn copies(&self) -> Vec<CopyCounts> {
        self.copies.as_ref().map(Copies::counts).unwrap_or_default()
    }

    /// The main service is elsewhere from now on.
    pub fn set_main(&self, main: MainService) {
        let is_another = *self.main.borrow() != main;
        if is_another {
            self.main.send_replace(main);
        }
    }

    /// Its own configuration.
    #[must_use]
    pub fn own(&self) -> &OwnConfig {
        &self.own
    }

    /// Leaves everything as the next life wants to find it: copies that are up to date, no lease.
    pub async fn drain(&self) {
        if let Some(copies) = &self.copies
            && !copies.flush(KEEP_WITHIN).await
        {
            tracing::warn!(
                "a copy is behind; the next start gets the rest from the other one or the main \
                 service"
            );
        }
        // From now on nothing is told, and the lease is not taken again.
        if let Some(lease) = &self.lease {
            lease.give_up.cancel();
            if tokio::time::timeout(GIVE_UP_WITHIN, lease.is_given_up.cancelled()).await.is_err() {
                tracing::warn!("the lease was not given up in time; it runs out");
            }
        }
    }
}

async fn keep_until(
    lease: Arc<dyn Lease>,
    time: Duration,
    mut holder: Holder,
    give_up: &CancellationToken,
) {
    tokio::select! {
        () = lease::keep(Arc::clone(&lease), time, &mut holder) => {}
        () = give_up.cancelled() => {}
    }
    lease::give_up(&*lease, &mut holder).await;
}

/// Whether a value is one that a worker of this site writes: several may share a server.
fn is_own(site: &Site, value: &[u8]) -> bool {
    let Ok(value) = serde_json::from_slice::<serde_json::Value>(value) else {
        return false;
    };
    let is_node = match &site.node {
        Some(node) => value["node"] == node.as_str(),
        None => true,
    };
    is_node && value["layer"] == site.layer.as_str() && value["hash"].is_string()
}

impl Replies for BrokerOutlet {
    fn reply(&self, to: &ChannelName, payload: Bytes) -> Result<(), String> {
        self.publish(to, &payload).map_err(|error| error.to_string())
    }

    fn shared(&self) -> Option<ChannelName> {
        match self.kind() {
            BrokerKind::Kafka | BrokerKind::Dds | BrokerKind::Ros2 => {
                Some(ChannelName::shared_reply())
            }
            BrokerKind::Memory | BrokerKind::Redis => None,
        }
    }
}
