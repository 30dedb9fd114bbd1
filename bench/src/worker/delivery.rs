//! From a change to the callbacks of the services that it concerns.

use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_brokers::{
    Broker, Content, Health, Publisher, PublisherOptions, SubscribeOptions, Subscription,
};
use blaze_domain::names::ChannelName;
use blaze_tests::fleet::Written;
use bytes::Bytes;
use serde::Serialize;
use serde_json::{Value, json};

use super::figures::{Clock, Spread};
use super::fleet::{BrokerKind, Fleet, LAYER, SERVICE, Taken, config, node};

/// For a change to be heard by all.
const PATIENCE: Duration = Duration::from_secs(30);
/// Changes before anything counts.
const WARM_UP: usize = 10;
/// As large as a notice, about.
const PLAIN_BYTES: usize = 800;

/// What is measured.
pub(crate) struct Plan {
    pub(crate) broker: BrokerKind,
    pub(crate) workers: usize,
    pub(crate) changes: usize,
    pub(crate) pause: RangeInclusive<Duration>,
    pub(crate) services: usize,
}

/// Whom a change concerns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Whom {
    /// The service on one node: its override in the document of that node.
    One,
    /// The service on every node: its defaults.
    All,
}

impl Whom {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::One => "one node",
            Self::All => "all nodes",
        }
    }

    /// The member of the configuration that says which change it is.
    fn member(self) -> &'static str {
        match self {
            Self::One => "own",
            Self::All => "common",
        }
    }
}

/// One line of the report.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Row {
    pub(crate) broker: &'static str,
    pub(crate) workers: usize,
    pub(crate) whom: Whom,
    pub(crate) changes: usize,
    /// From the status of the answer (2xx) to the callback; 0 where the callback was first.
    pub(crate) after_answer: Spread,
    /// From sending the request to the callback.
    pub(crate) after_request: Spread,
    /// From the status of the answer to the last callback of the change.
    pub(crate) last: Spread,
    /// The request alone.
    pub(crate) put: Spread,
    /// The broker alone: a message of that size from one client to another, between the changes.
    pub(crate) plain: Spread,
    /// CPU time of a change, in ms: of the main service; of all workers, all services and this
    /// program.
    pub(crate) main_cpu_ms: f64,
    pub(crate) own_cpu_ms: f64,
    /// Of one worker, without its service.
    pub(crate) worker: Taken,
    /// The same with its service.
    pub(crate) with_service: Taken,
}

/// Measures changes of both kinds.
///
/// # Errors
/// When a service does not hear what it must, or hears what it must not.
pub(crate) async fn run(parent: &Path, plan: &Plan) -> anyhow::Result<Vec<Row>> {
    let mut fleet = Fleet::new(parent, Some(plan.broker), plan.workers, plan.services).await?;
    fleet.start_workers(plan.workers).await?;
    let worker = fleet.taken_per_worker()?;
    fleet.start_listeners().await?;
    let with_service = fleet.taken_per_worker()?;
    let mut plain = Plain::new(fleet.workers[0].open_broker()?, plan.broker).await?;
    let mut rows = Vec::new();
    for whom in [Whom::One, Whom::All] {
        let mut times = Times::default();
        for number in 0..WARM_UP {
            change(&mut fleet, plan, whom, number, &mut times).await?;
        }
        times = Times::default();
        let (main, own) = (Clock::start(fleet.main_process()?)?, Clock::start(std::process::id())?);
        let mut alone = Vec::with_capacity(plan.changes);
        for number in WARM_UP..WARM_UP + plan.changes {
            change(&mut fleet, plan, whom, number, &mut times).await?;
            alone.push(plain.once().await?);
        }
        let (main_cpu_ms, own_cpu_ms) = (main.used_ms(plan.changes)?, own.used_ms(plan.changes)?);
        let unwanted = fleet.listeners.iter_mut().map(|listener| listener.rest().len());
        anyhow::ensure!(
            unwanted.sum::<usize>() == 0,
            "services heard of changes that are none to them"
        );
        rows.push(Row {
            broker: plan.broker.name(),
            workers: plan.workers,
            whom,
            changes: plan.changes,
            after_answer: Spread::of(times.after_answer),
            after_request: Spread::of(times.after_request),
            last: Spread::of(times.last),
            put: Spread::of(times.put),
            plain: Spread::of(alone),
            main_cpu_ms,
            own_cpu_ms,
            worker,
            with_service,
        });
    }
    Ok(rows)
}

#[derive(Default)]
struct Times {
    after_answer: Vec<Duration>,
    after_request: Vec<Duration>,
    last: Vec<Duration>,
    put: Vec<Duration>,
}

/// One change, heard by all that it concerns, and the pause after it.
async fn change(
    fleet: &mut Fleet,
    plan: &Plan,
    whom: Whom,
    number: usize,
    times: &mut Times,
) -> anyhow::Result<()> {
    let at = number % plan.workers;
    let (path, spec) = match whom {
        Whom::One => (
            format!("/nodes/{}", node(at)),
            json!({ "layer": LAYER, "overrides": { SERVICE: { whom.member(): number } } }),
        ),
        Whom::All => {
            let mut config = config(0);
            config[whom.member()] = json!(number);
            (format!("/services/{SERVICE}"), json!({ "config": config }))
        }
    };
    let written = fleet.api.replace_timed(&path, spec).await?;
    let hearing = match whom {
        Whom::One => at..at + 1,
        Whom::All => 0..plan.workers,
    };
    let mut last = Duration::ZERO;
    for listener in &mut fleet.listeners[hearing] {
        let heard = listener.next(PATIENCE).await?;
        let found = heard.config.as_ref().map(|config| &config[whom.member()]);
        anyhow::ensure!(
            found == Some(&Value::from(number)),
            "change {number} of {} was heard as {found:?} at revision {}",
            whom.name(),
            heard.revision
        );
        let after = since(&written, heard.at);
        last = last.max(after);
        times.after_answer.push(after);
        times.after_request.push(heard.at.saturating_duration_since(written.sent));
    }
    times.last.push(last);
    times.put.push(written.answered - written.sent);
    tokio::time::sleep(rand::random_range(plan.pause.clone())).await;
    Ok(())
}

/// A callback may run before the answer has come.
fn since(written: &Written, heard: Instant) -> Duration {
    heard.saturating_duration_since(written.answered)
}

/// A message that nobody but this program knows of.
struct Plain {
    publisher: Arc<dyn Publisher>,
    subscription: Subscription,
    count: u64,
    _broker: Arc<dyn Broker>,
}

impl Plain {
    async fn new(broker: Arc<dyn Broker>, kind: BrokerKind) -> anyhow::Result<Self> {
        let channel: ChannelName = match kind {
            BrokerKind::Redis => "bench/plain".parse()?,
            // Channels must be made there; services leave alone what is no answer to them.
            BrokerKind::Kafka => ChannelName::shared_reply(),
        };
        let mut status = broker.status();
        let is_up = status.wait_for(|status| status.health == Health::Up);
        tokio::time::timeout(PATIENCE, is_up).await.context("the broker does not answer")??;
        let subscription = broker.subscribe(&channel, SubscribeOptions::default()).await?;
        Ok(Self {
            publisher: broker.publisher(&channel, PublisherOptions::default())?,
            subscription,
            count: 0,
            _broker: broker,
        })
    }

    async fn once(&mut self) -> anyhow::Result<Duration> {
        self.count += 1;
        let mut payload = self.count.to_string().into_bytes();
        payload.resize(PLAIN_BYTES, b' ');
        let payload = Bytes::from(payload);
        let begun = Instant::now();
        self.publisher.publish_bare(&payload, None);
        loop {
            let mut batch = Vec::new();
            let received =
                tokio::time::timeout(PATIENCE, self.subscription.receive(&mut batch, 1)).await;
            anyhow::ensure!(
                received.context("the broker delivers nothing")? > 0,
                "the broker was closed"
            );
            let is_it = batch.iter().any(|one| match &one.content {
                Content::Bare { payload: found, .. } => *found == payload,
                _ => false,
            });
            if is_it {
                return Ok(begun.elapsed());
            }
        }
    }
}
