//! Signs of life of the services of this node: their states, and where their metrics are.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::redis::RedisKeys;
use blaze_brokers::{Broker, Content, SubscribeOptions};
use blaze_domain::NodeName;
use blaze_domain::config::ServiceState;
use blaze_domain::names::ChannelName;
use parking_lot::Mutex;
use serde_json::Value;

/// How the keys begin under which services say that they live.
const RECORDS: &str = "blaze:watchdog:";
/// Where services without a Redis say it.
const CHANNEL: &str = "blaze/watchdog";
/// Between two looks at the records.
const LOOK: Duration = Duration::from_secs(2);
/// Between two tries to subscribe on a broker that is away.
const AGAIN: Duration = Duration::from_secs(1);
/// A record is renewed every 5 s and counts three times as long.
const DEFAULT_TTL: Duration = Duration::from_secs(15);
/// Longest that a message may count.
const MAX_TTL: Duration = Duration::from_secs(3600);
/// Instances that are followed, at most.
const MAX_SERVICES: usize = 1_000;
/// Longest message that is read, in bytes.
const MAX_MESSAGE_BYTES: usize = 64 * 1024;

/// The newest sign of life of an instance.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sign {
    /// The service.
    pub service: String,
    /// The instance.
    pub instance: String,
    /// Its state by its own account.
    pub state: ServiceState,
    /// When the sign ends.
    pub expires: Instant,
    /// `HOST:PORT` of its metrics; empty where it has none.
    pub metrics: String,
    /// Revision of the configuration that it has; 0: none.
    pub config_revision: u64,
}

/// All signs of life. Shared by the task that reads them and those who look.
#[derive(Debug, Default)]
pub struct Signs {
    inner: Mutex<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    /// By service and instance.
    signs: BTreeMap<(String, String), Sign>,
    /// Whether they could be read of late.
    is_readable: bool,
}

impl Signs {
    /// Those that have not ended, by service and instance; `None` where they cannot be read now.
    #[must_use]
    pub fn now(&self, now: Instant) -> Option<Vec<Sign>> {
        let mut inner = self.inner.lock();
        inner.signs.retain(|_, sign| sign.expires > now);
        inner.is_readable.then(|| inner.signs.values().cloned().collect())
    }

    fn replace(&self, signs: impl Iterator<Item = Sign>) {
        let mut inner = self.inner.lock();
        inner.signs = signs.take(MAX_SERVICES).map(|sign| (key(&sign), sign)).collect();
        inner.is_readable = true;
    }

    fn add(&self, sign: Sign) {
        let mut inner = self.inner.lock();
        let key = key(&sign);
        if inner.signs.len() < MAX_SERVICES || inner.signs.contains_key(&key) {
            inner.signs.insert(key, sign);
        }
    }

    fn set_readable(&self, is_readable: bool) {
        self.inner.lock().is_readable = is_readable;
    }
}

fn key(sign: &Sign) -> (String, String) {
    (sign.service.clone(), sign.instance.clone())
}

/// Reads the records of a Redis, for ever.
pub async fn read_records(keys: RedisKeys, node: NodeName, signs: Arc<Signs>) {
    loop {
        match keys.records(RECORDS, MAX_SERVICES).await {
            Ok(records) => {
                let expires = Instant::now() + DEFAULT_TTL;
                let of_node = records.iter().filter_map(|(_, members)| {
                    sign(|name| members.get(name).cloned(), &node, expires)
                });
                signs.replace(of_node);
            }
            Err(error) => {
                tracing::debug!(%error, "the signs of life of services cannot be read");
                signs.set_readable(false);
            }
        }
        tokio::time::sleep(LOOK).await;
    }
}

/// Takes the messages of a broker without a Redis beside it, for ever.
pub async fn read_messages(broker: Arc<dyn Broker>, node: NodeName, signs: Arc<Signs>) {
    // It is a good name.
    let Ok(channel) = CHANNEL.parse::<ChannelName>() else { return };
    loop {
        if let Ok(mut subscription) = broker.subscribe(&channel, SubscribeOptions::default()).await
        {
            signs.set_readable(true);
            let mut batch = Vec::new();
            while subscription.receive(&mut batch, 64).await > 0 {
                for received in batch.drain(..) {
                    if let Content::Bare { payload, .. } = received.content
                        && let Some(sign) = of_message(&payload, &node)
                    {
                        signs.add(sign);
                    }
                }
            }
            signs.set_readable(false);
        }
        tokio::time::sleep(AGAIN).await;
    }
}

fn of_message(payload: &[u8], node: &NodeName) -> Option<Sign> {
    if payload.len() > MAX_MESSAGE_BYTES {
        return None;
    }
    let value: Value = serde_json::from_slice(payload).ok()?;
    let ttl = value["ttl_ms"].as_u64().map_or(DEFAULT_TTL, Duration::from_millis).min(MAX_TTL);
    let text = |name: &str| match &value[name] {
        Value::String(text) => Some(text.clone()),
        Value::Number(number) => Some(number.to_string()),
        _ => None,
    };
    sign(text, node, Instant::now() + ttl)
}

/// The sign of a record or message; `None` where it is of another node, or is none.
fn sign(
    text: impl Fn(&str) -> Option<String>,
    node: &NodeName,
    expires: Instant,
) -> Option<Sign> {
    if text("node")? != node.as_str() {
        return None;
    }
    let is_name = |name: &String| !name.is_empty() && name.len() <= 256;
    Some(Sign {
        service: text("service").filter(is_name)?,
        instance: text("instance").filter(is_name)?,
        state: text("state")?.parse().ok()?,
        expires,
        metrics: text("metrics").unwrap_or_default(),
        config_revision: text("config_revision").and_then(|text| text.parse().ok()).unwrap_or(0),
    })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn message(node: &str, state: &str) -> Vec<u8> {
        json!({"layer": "edge", "node": node, "service": "slam", "instance": "0", "state": state,
               "metrics": "127.0.0.1:9200", "config_revision": 7, "ttl_ms": 1000})
        .to_string()
        .into_bytes()
    }

    #[test]
    fn only_signs_of_this_node_count_and_they_end() {
        let node: NodeName = "robot-1".parse().unwrap();
        let sign = of_message(&message("robot-1", "ready"), &node).unwrap();
        assert_eq!((sign.metrics.as_str(), sign.config_revision), ("127.0.0.1:9200", 7));
        assert_eq!(of_message(&message("robot-2", "ready"), &node), None);
        assert_eq!(of_message(&message("robot-1", "dancing"), &node), None);
        assert_eq!(of_message(b"{}", &node), None);
        assert_eq!(of_message(&[b' '; MAX_MESSAGE_BYTES + 1], &node), None);
        let signs = Signs::default();
        let expires = sign.expires;
        signs.add(sign);
        assert_eq!(signs.now(Instant::now()), None);
        signs.set_readable(true);
        assert_eq!(signs.now(Instant::now()).unwrap().len(), 1);
        assert_eq!(signs.now(expires).unwrap().len(), 0);
    }

    #[test]
    fn the_number_of_instances_is_bounded() {
        let signs = Signs::default();
        let sign = of_message(&message("robot-1", "ready"), &"robot-1".parse().unwrap()).unwrap();
        signs.set_readable(true);
        for number in 0..=MAX_SERVICES {
            signs.add(Sign { instance: number.to_string(), ..sign.clone() });
        }
        assert_eq!(signs.now(Instant::now()).unwrap().len(), MAX_SERVICES);
    }
}
