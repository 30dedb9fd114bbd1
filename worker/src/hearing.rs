//! What services say, from the broker and from Redis to the engine.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use blaze_brokers::redis::RedisKeys;
use blaze_brokers::{Broker, BrokerStatus, Content, Health, SubscribeOptions};
use blaze_domain::names::ChannelName;
use blaze_runtime::pause;
use bytes::Bytes;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, sleep};

use crate::core::MAX_SIGNS;
use crate::engine::Sign;

/// Where services ask.
pub(crate) const GET: &str = "blaze/config/get";
/// Where services say how they get on with their configurations.
pub(crate) const ACK: &str = "blaze/config/ack";
/// Where services without a Redis say that they are alive.
pub(crate) const WATCHDOG: &str = "blaze/watchdog";
/// How the keys begin under which the others say it.
const RECORDS: &str = "blaze:watchdog:";
/// Messages that wait for the engine.
const MESSAGES: SubscribeOptions = SubscribeOptions {
    max_messages: 4096,
    max_bytes: 16 * 1024 * 1024,
    large: false,
    with_kept: false,
};
/// Between two tries to listen on a broker that is away.
const LISTEN_AGAIN: Duration = Duration::from_millis(200);
/// Between two looks at the records of services.
const SCAN: Duration = Duration::from_secs(1);
/// While a broker is away this is said again and again.
const STILL_DEAF: Duration = Duration::from_secs(1);
/// After Redis was away, services have so long to write their records again.
const PATIENCE: Duration = Duration::from_secs(15);

/// Hands on what comes on a channel, for ever; `hears`: whether what is said there now is heard.
pub(crate) async fn listen<T: Send>(
    broker: Arc<dyn Broker>,
    channel: &'static str,
    sender: mpsc::Sender<T>,
    into: fn(Bytes) -> T,
    hears: Arc<AtomicBool>,
) {
    // It is a good name.
    let Ok(channel) = channel.parse::<ChannelName>() else {
        return;
    };
    loop {
        let mut subscription = match broker.subscribe(&channel, MESSAGES).await {
            Ok(subscription) => subscription,
            Err(error) => {
                tracing::debug!(%error, %channel, "services cannot be heard yet");
                sleep(LISTEN_AGAIN).await;
                continue;
            }
        };
        hears.store(true, Ordering::Relaxed);
        let mut batch = Vec::new();
        while subscription.receive(&mut batch, 64).await > 0 {
            for received in batch.drain(..) {
                let payload = match received.content {
                    Content::Bare { payload, .. } => payload,
                    // These are never framed.
                    Content::Frame(_) | Content::Malformed { .. } => continue,
                };
                if sender.send(into(payload)).await.is_err() {
                    return;
                }
            }
            let dropped = subscription.take_dropped();
            if dropped > 0 {
                tracing::warn!(dropped, %channel, "more than can be taken; services say it again");
            }
        }
        hears.store(false, Ordering::Relaxed);
    }
}

/// Says when the broker is away: what cannot be heard is not lost.
pub(crate) async fn notice_deafness(
    mut status: watch::Receiver<BrokerStatus>,
    signs: mpsc::Sender<Sign>,
) {
    loop {
        let is_up = status.borrow_and_update().health == Health::Up;
        if is_up {
            if status.changed().await.is_err() {
                // The broker has gone; so does this worker.
                return std::future::pending().await;
            }
        } else {
            sleep(STILL_DEAF).await;
        }
        // Also when it is back: services need their time to be heard again.
        if (!is_up || status.borrow().health != Health::Up) && signs.send(Sign::Deaf).await.is_err()
        {
            return;
        }
    }
}

/// Looks at the records of services again and again, for ever.
pub(crate) async fn scan(keys: Arc<RedisKeys>, signs: mpsc::Sender<Sign>) {
    let mut doubtful_until = Instant::now();
    let mut last_run = None;
    loop {
        pause(SCAN).await;
        // Which run of the server it is is asked last: records that a restart has taken are then
        // known to be its doing.
        let found = match keys.records(RECORDS, MAX_SIGNS).await {
            Ok(records) => keys.run_id().await.map(|run| (records, run)),
            Err(error) => Err(error),
        };
        match found {
            Ok((records, run)) => {
                if last_run.is_some() && last_run != run {
                    doubtful_until = Instant::now() + PATIENCE;
                }
                last_run = run;
                let is_whole = records.len() < MAX_SIGNS && Instant::now() >= doubtful_until;
                if signs.send(Sign::Scan { records, is_whole }).await.is_err() {
                    return;
                }
            }
            Err(error) => {
                tracing::debug!(%error, "the records of services cannot be read");
                doubtful_until = Instant::now() + PATIENCE;
            }
        }
    }
}

#[cfg(test)]
#[path = "hearing_tests.rs"]
mod tests;
