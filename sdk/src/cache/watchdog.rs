//! The task that says that the service lives.

use std::sync::atomic::Ordering;
use std::time::Duration;

use blaze_brokers::{BrokerError, Received};
use blaze_domain::ServiceName;
use bytes::Bytes;
use parking_lot::Mutex;
use tokio::time::Instant;

use super::record::{self, Heard, Sign};
use super::store::Store;
use super::{Liveness, Said, Shared};
use crate::reserved::{bare, channel, now, speaking, subscribe};

const WATCHDOG: &str = "blaze/watchdog";
/// Longest pause before a record that could not be written is tried again.
const RETRY: Duration = Duration::from_millis(500);
const BATCH: usize = 256;
/// What a last message counts: nothing is left to wait for.
const OVER: Duration = Duration::from_millis(1);

/// Runs until the service has ended. One that was superseded goes on when the newer process has
/// ended.
pub(super) async fn run(shared: &Shared) {
    while !shared.said.lock().is_on {
        shared.wake.notified().await;
    }
    let end = match (&shared.store, &shared.key) {
        (_, None) => {
            tracing::warn!(
                service = %shared.identity.service,
                "a service without a node cannot say that it lives",
            );
            Liveness::Off
        }
        (Some(store), Some(key)) => in_store(shared, store.as_ref(), key).await,
        (None, Some(_)) => by_messages(shared).await.unwrap_or_else(|error| {
            tracing::warn!(%error, "the service cannot say that it lives any more");
            Liveness::Ended
        }),
    };
    shared.liveness.send_replace(end);
}

/// Writes a record again and again. A look before each write finds out whether a newer process has
/// the key.
async fn in_store(shared: &Shared, store: &dyn Store, key: &str) -> Liveness {
    // Until it has said something itself, what began in the future began before a clock went back.
    let mut is_first = shared.watchdog.by_clock;
    loop {
        let said = shared.said.lock().clone();
        let beaten = beat(shared, store, key, &said, is_first).await;
        is_first &= beaten.is_err();
        let next = match beaten {
            // What is left of it vanishes by itself.
            _ if said.ending => return Liveness::Ended,
            Ok(true) => {
                shared.show(Liveness::Alive);
                shared.pace()
            }
            Ok(false) => {
                shared.show(Liveness::Superseded);
                shared.pace()
            }
            Err(error) => {
                tracing::debug!(%error, "the sign of life could not be written");
                shared.show(Liveness::Silent);
                shared.pace().min(RETRY)
            }
        };
        tokio::select! {
            () = tokio::time::sleep(next) => {}
            () = shared.wake.notified() => {}
        }
    }
}

/// Returns whether the key is this process's.
async fn beat(
    shared: &Shared,
    store: &dyn Store,
    key: &str,
    said: &Said,
    is_first: bool,
) -> Result<bool, blaze_brokers::redis::KeyError> {
    let present = store.record(key).await?.map_or(0, |record| record::epoch_of(&record));
    let own = shared.epoch.load(Ordering::Relaxed);
    if present > own {
        if !is_first || present <= super::now_ms() {
            return Ok(false);
        }
        shared.epoch.store(present.saturating_add(1), Ordering::Relaxed);
    }
    if said.ending {
        // Another process may have begun since.
        let own = shared.epoch.load(Ordering::Relaxed);
        store.delete_record(key, &own.to_string()).await?;
    } else {
        store.put_record(key, shared.sign(said).record(), shared.watchdog.ttl).await?;
    }
    Ok(true)
}

/// Sends a message again and again, and listens for a newer process.
async fn by_messages(shared: &Shared) -> Result<Liveness, BrokerError> {
    let channel = channel(WATCHDOG)?;
    let mut others = subscribe(shared.broker.as_ref(), &channel).await?;
    let publisher = shared.broker.publisher(&channel, speaking(shared.broker.kind()))?;
    let mut heard = Vec::new();
    let mut newer_until: Option<Instant> = None;
    loop {
        let said = shared.said.lock().clone();
        newer_until = newer_until.filter(|until| *until > Instant::now());
        if newer_until.is_some() && said.ending {
            return Ok(Liveness::Ended);
        }
        if let Some(until) = newer_until {
            shared.show(Liveness::Superseded);
            tokio::select! {
                () = tokio::time::sleep_until(until) => {}
                () = shared.wake.notified() => {}
                count = others.receive(&mut heard, BATCH) => {
                    if count == 0 {
                        return Err(BrokerError::Closed);
                    }
                    newer_until = newer(shared, &mut heard).or(newer_until);
                }
            }
            continue;
        }
        let ttl = if said.ending { OVER } else { shared.watchdog.ttl };
        let text = shared.sign(&said).message(ttl);
        let outcome = publisher.publish_bare(&Bytes::from(text), None);
        if said.ending {
            return Ok(Liveness::Ended);
        }
        let was_taken = outcome == blaze_brokers::PublishOutcome::Taken;
        shared.show(if was_taken { Liveness::Alive } else { Liveness::Silent });
        let next =
            Instant::now() + if was_taken { shared.pace() } else { shared.pace().min(RETRY) };
        loop {
            tokio::select! {
                () = tokio::time::sleep_until(next) => break,
                () = shared.wake.notified() => break,
                count = others.receive(&mut heard, BATCH) => {
                    if count == 0 {
                        return Err(BrokerError::Closed);
                    }
                    newer_until = newer(shared, &mut heard);
                    if newer_until.is_some() {
                        break;
                    }
                }
            }
        }
    }
}

/// Until when the last sign of life of a newer process counts, if there is one among the messages.
fn newer(shared: &Shared, heard: &mut Vec<Received>) -> Option<Instant> {
    let own = &shared.identity;
    let signs = signs_of(heard).filter(|sign| sign.is_of(own) && sign.epoch > own.epoch);
    signs.last().map(|sign| Instant::now() + sign.ttl)
}

impl Shared {
    fn pace(&self) -> Duration {
        self.watchdog.ttl / 3
    }

    fn show(&self, liveness: Liveness) {
        let is_new =
            self.liveness.send_if_modified(|shown| std::mem::replace(shown, liveness) != liveness);
        if is_new && liveness == Liveness::Superseded {
            tracing::warn!(
                service = %self.identity.service,
                "a newer process of the same service, node and instance lives",
            );
        }
    }

    fn sign(&self, said: &Said) -> Sign<'_> {
        Sign {
            identity: &self.identity,
            state: said.state,
            since_ms: said.since_ms,
            epoch: self.epoch.load(Ordering::Relaxed),
            version: &self.watchdog.version,
            metrics: &self.watchdog.metrics,
            config: record::of_config(self.config.borrow().held()),
        }
    }
}

/// Waits until each service has an instance that is ready. Never returns otherwise; `missing` has
/// those that are not.
pub(super) async fn wait(
    shared: &Shared,
    services: &[ServiceName],
    missing: &Mutex<Vec<ServiceName>>,
) -> Result<(), BrokerError> {
    match &shared.store {
        Some(store) => wait_for_records(store.as_ref(), services, missing).await,
        None => wait_for_messages(shared, services, missing).await?,
    }
    Ok(())
}

/// Notes who is missing. Returns whether nobody is.
fn nobody(missing: &Mutex<Vec<ServiceName>>, absent: Vec<ServiceName>) -> bool {
    let is_done = absent.is_empty();
    *missing.lock() = absent;
    is_done
}

/// The signs of life among messages.
fn signs_of(heard: &mut Vec<Received>) -> impl Iterator<Item = Heard> {
    let payloads = heard.drain(..).filter_map(bare);
    payloads.filter_map(|payload| Heard::parse(&payload))
}

async fn wait_for_records(
    store: &dyn Store,
    services: &[ServiceName],
    missing: &Mutex<Vec<ServiceName>>,
) {
    loop {
        let mut absent = Vec::new();
        for service in services {
            let records =
                store.records(&record::beginning(service.as_str()), super::MAX_INSTANCES).await;
            let is_there = match records {
                Ok(records) => records.iter().any(|(_, record)| super::wait::is_ready(record)),
                Err(error) => {
                    tracing::debug!(%error, "who is ready cannot be read");
                    false
                }
            };
            if !is_there {
                absent.push(service.clone());
            }
        }
        if nobody(missing, absent) {
            return;
        }
        tokio::time::sleep(super::LOOK).await;
    }
}

async fn wait_for_messages(
    shared: &Shared,
    services: &[ServiceName],
    missing: &Mutex<Vec<ServiceName>>,
) -> Result<(), BrokerError> {
    let mut signs = subscribe(shared.broker.as_ref(), &channel(WATCHDOG)?).await?;
    let mut roll = super::wait::Roll::new(services);
    let mut heard = Vec::new();
    loop {
        if nobody(missing, roll.missing(now())) {
            return Ok(());
        }
        if signs.receive(&mut heard, BATCH).await == 0 {
            return Err(BrokerError::Closed);
        }
        for sign in signs_of(&mut heard) {
            roll.hear(sign, now());
        }
    }
}
