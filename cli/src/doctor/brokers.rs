//! `brokers` and `broker_limits`.

use std::sync::Arc;

use blaze_brokers::redis::{RedisReport, examine as examine_redis};
use blaze_brokers::{Broker, Health, OpenError, Role, open_layer, open_node};
use blaze_domain::node_file::{LayerBroker, NodeBroker, RedisBroker};
use tokio::time::timeout;

use super::Node;
use super::check::Finding;
#[cfg(feature = "kafka")]
use super::check::named;
use super::limits::{BROKER, CLOSE};
#[cfg(feature = "kafka")]
use super::on_thread;

/// A broker of the node file: its key, and its place without credentials.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Place {
    key: &'static str,
    shown: String,
}

/// What came of a connection.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Reached {
    Up(String),
    Away(String),
    Refused(String),
    NotBuilt(&'static str),
    InProcess,
}

/// `brokers`: a connection to each.
pub(super) async fn brokers(node: &Node) -> Vec<Finding> {
    let brokers = &node.file.brokers;
    let role = Role::Service;
    let mut waits = Vec::new();
    if let Some(section) = &brokers.node {
        let place = match section {
            NodeBroker::Redis(redis) => redis_place("brokers.node.redis", redis),
            NodeBroker::Memory => Place { key: "brokers.node.memory", shown: String::new() },
        };
        waits.push((place, open_node(section, &role)));
    }
    if let Some(section) = &brokers.layer {
        waits.push((layer_place(section), open_layer(section, &role)));
    }
    if let Some(cache) = cache(node) {
        let place = redis_place("cache.redis", cache);
        waits.push((place, open_node(&NodeBroker::Redis(cache.clone()), &role)));
    }
    if waits.is_empty() {
        return vec![Finding::skipped(
            "the node file names no broker",
            format!("set brokers.node.redis.url: redis://127.0.0.1:6379 in {}", node.name),
        )];
    }
    let all = waits.into_iter().map(|(place, opened)| async move {
        let reached = reach(opened).await;
        judge(&place, &reached, &node.name)
    });
    futures::future::join_all(all).await
}

/// The Redis for values, where it is one of its own.
fn cache(node: &Node) -> Option<&RedisBroker> {
    let cache = node.file.cache_redis()?;
    let is_broker =
        matches!(&node.file.brokers.node, Some(NodeBroker::Redis(redis)) if redis == cache);
    (!is_broker).then_some(cache)
}

fn redis_place(key: &'static str, redis: &RedisBroker) -> Place {
    Place { key, shown: without_credentials(redis.url.reveal()) }
}

fn layer_place(section: &LayerBroker) -> Place {
    match section {
        LayerBroker::Kafka(kafka) => {
            Place { key: "brokers.layer.kafka", shown: kafka.bootstrap.join(",") }
        }
        LayerBroker::Dds(dds) => Place {
            key: "brokers.layer.dds",
            shown: format!("domain {} on {}", dds.domain, dds.interface),
        },
        LayerBroker::Memory => Place { key: "brokers.layer.memory", shown: String::new() },
    }
}

/// A URL without user, password and query.
fn without_credentials(url: &str) -> String {
    let Some((scheme, rest)) = url.split_once("://") else { return String::new() };
    let rest = rest.split(['?', '#']).next().unwrap_or_default();
    let (host, path) = rest.split_once('/').map_or((rest, ""), |(host, path)| (host, path));
    // A password may have a slash in it: then what looks like the host is a part of it.
    let bare = match path.rsplit_once('@') {
        Some((_, after)) => after.to_owned(),
        None => {
            let host = host.rsplit_once('@').map_or(host, |(_, host)| host);
            if path.is_empty() { host.to_owned() } else { format!("{host}/{path}") }
        }
    };
    format!("{scheme}://{bare}")
}

async fn reach(opened: Result<Arc<dyn Broker>, OpenError>) -> Reached {
    let broker = match opened {
        Ok(broker) => broker,
        Err(OpenError::InProcess) => return Reached::InProcess,
        Err(OpenError::NotBuilt { feature }) => return Reached::NotBuilt(feature),
        Err(error @ OpenError::Setting { .. }) => return Reached::Refused(error.to_string()),
    };
    let mut status = broker.status();
    let waited = timeout(BROKER, status.wait_for(|status| status.health == Health::Up)).await;
    let is_up = matches!(waited, Ok(Ok(_)));
    drop(waited);
    let detail = broker.status().borrow().detail.clone();
    // What is left of it ends with the process.
    let _ = timeout(CLOSE, broker.close()).await;
    if is_up { Reached::Up(detail) } else { Reached::Away(detail) }
}

fn judge(place: &Place, reached: &Reached, file: &str) -> Finding {
    let Place { key, shown } = place;
    match reached {
        Reached::Up(detail) => Finding::ok(format!("{key} {shown}: {detail}")),
        Reached::InProcess => Finding::ok(format!("{key}: inside the process of the flow")),
        Reached::NotBuilt(feature) => Finding::skipped(
            format!("{key}: this blaze was built without {feature}"),
            format!("cargo build -p blaze --features {feature}"),
        ),
        Reached::Refused(reason) => Finding::fail(
            format!("{key} {shown}: {reason}"),
            format!("correct {key} in {file}, then blaze doctor --config {file}"),
        ),
        Reached::Away(reason) => {
            let waited = BROKER.as_secs();
            Finding::fail(
                format!("{key} {shown} does not answer within {waited} s: {reason}"),
                remedy(place, reason, file),
            )
        }
    }
}

fn remedy(Place { key, shown }: &Place, reason: &str, file: &str) -> String {
    let reason = reason.to_ascii_lowercase();
    let is_login = ["noauth", "wrongpass", "authentication", "sasl", "noperm"];
    if is_login.iter().any(|word| reason.contains(word)) {
        return format!("put the right password into the file of {key}.password_file in {file}");
    }
    match *key {
        "brokers.layer.kafka" => {
            let server = shown.split(',').next().unwrap_or_default();
            format!(
                "systemctl start kafka on {server} (kafka-broker-api-versions.sh \
                 --bootstrap-server {server} answers when it runs), or set \
                 {key}.bootstrap in {file}"
            )
        }
        "brokers.layer.dds" => format!("see the check dds_interface, or set {key} in {file}"),
        _ => format!(
            "systemctl start redis-server on that host (redis-cli -u {shown} ping answers PONG \
             when it runs), or set {key}.url in {file}"
        ),
    }
}

/// `broker_limits`: what the servers are set to.
pub(super) async fn broker_limits(node: &Node) -> Vec<Finding> {
    let mut findings = Vec::new();
    if let Some(NodeBroker::Redis(redis)) = &node.file.brokers.node {
        findings.extend(redis_limits("brokers.node.redis", redis).await);
    }
    if let Some(cache) = cache(node) {
        findings.extend(redis_limits("cache.redis", cache).await);
    }
    if let Some(LayerBroker::Kafka(kafka)) = &node.file.brokers.layer {
        findings.extend(kafka_limits(kafka).await);
    }
    if findings.is_empty() {
        findings.push(Finding::skipped(
            "the node file names neither Redis nor Kafka: no server limits messages",
            "nothing to do",
        ));
    }
    findings
}

async fn redis_limits(key: &'static str, redis: &RedisBroker) -> Vec<Finding> {
    let place = redis_place(key, redis);
    match timeout(BROKER, examine_redis(redis)).await {
        Ok(Ok(report)) => judge_redis(&place, &report),
        Ok(Err(reason)) => vec![unknown(&place, &reason)],
        Err(_) => vec![unknown(&place, "no answer")],
    }
}

fn unknown(Place { key, shown }: &Place, reason: &str) -> Finding {
    Finding::skipped(format!("{key} {shown}: {reason}"), "see the check brokers")
}

fn judge_redis(Place { key, shown }: &Place, report: &RedisReport) -> Vec<Finding> {
    let mut findings: Vec<Finding> = report
        .complaints
        .iter()
        .map(|complaint| {
            let (setting, value) = (complaint.setting, complaint.value);
            Finding::warn(
                format!("{key} {shown}: {}", complaint.detail),
                format!(
                    "redis-cli -u {shown} config set {setting} '{value}', and `{setting} {value}` \
                     in its redis.conf"
                ),
            )
        })
        .collect();
    if !report.tells_buffers {
        findings.push(Finding::skipped(
            format!("{key} {shown}: the access list hides client-output-buffer-limit"),
            format!("redis-cli -u {shown} acl setuser USER +config|get"),
        ));
    }
    if findings.is_empty() {
        findings.push(Finding::ok(format!("{key}: {}", report.version)));
    }
    findings
}

#[cfg(not(feature = "kafka"))]
async fn kafka_limits(kafka: &blaze_domain::node_file::KafkaBroker) -> Vec<Finding> {
    let place = layer_place(&LayerBroker::Kafka(kafka.clone()));
    std::future::ready(vec![unknown(&place, "this blaze was built without kafka")]).await
}

#[cfg(feature = "kafka")]
async fn kafka_limits(kafka: &blaze_domain::node_file::KafkaBroker) -> Vec<Finding> {
    let place = layer_place(&LayerBroker::Kafka(kafka.clone()));
    let section = kafka.clone();
    let asked = on_thread(move || blaze_brokers::kafka::narrow_topics(&section));
    match timeout(BROKER, asked).await {
        Ok(Some(Ok(narrow))) => vec![judge_kafka(&place, &narrow)],
        Ok(Some(Err(reason))) => vec![unknown(&place, &reason)],
        Ok(None) | Err(_) => vec![unknown(&place, "no answer")],
    }
}

/// Topics that take less than the largest message.
#[cfg(feature = "kafka")]
fn judge_kafka(Place { key, shown }: &Place, narrow: &[(String, usize)]) -> Finding {
    use blaze_brokers::kafka::LARGEST_RECORD;

    let Some((first, _)) = narrow.first() else {
        return Finding::ok(format!("{key}: its topics take messages of every size"));
    };
    let names = narrow.iter().map(|(name, bytes)| format!("{name} ({bytes} B)"));
    let server = shown.split(',').next().unwrap_or_default();
    Finding::warn(
        format!(
            "{key}: topics that blaze did not make take smaller messages: {}",
            named(&names.collect::<Vec<_>>())
        ),
        format!(
            "kafka-configs.sh --bootstrap-server {server} --alter --entity-type topics \
             --entity-name {first} --add-config max.message.bytes={LARGEST_RECORD}"
        ),
    )
}

#[cfg(test)]
mod tests {
    use blaze_brokers::redis::Complaint;

    use super::super::check::Outcome;
    use super::*;

    #[test]
    fn credentials_are_never_shown() {
        for (url, shown) in [
            ("redis://127.0.0.1:6379", "redis://127.0.0.1:6379"),
            ("redis://user:secret@h:1/0", "redis://h:1/0"),
            ("rediss://:se/cr@et@h:1", "rediss://h:1"),
            ("redis+unix:///run/redis.sock?pass=secret", "redis+unix:///run/redis.sock"),
            ("secret", ""),
        ] {
            assert_eq!(without_credentials(url), shown, "{url}");
        }
    }

    #[test]
    fn a_broker_that_is_away_is_named_with_its_place_and_its_key() {
        let place = Place { key: "brokers.node.redis", shown: "redis://h:1".to_owned() };
        let away = judge(&place, &Reached::Away("connection refused".to_owned()), "blaze.yaml");
        assert_eq!(away.result, Outcome::Fail);
        assert!(away.detail.contains("brokers.node.redis redis://h:1"), "{away:?}");
        assert!(away.remedy.contains("redis-cli -u redis://h:1 ping"), "{away:?}");
        let login = judge(&place, &Reached::Away("WRONGPASS invalid".to_owned()), "blaze.yaml");
        assert!(login.remedy.contains("brokers.node.redis.password_file"), "{login:?}");
        let up = judge(&place, &Reached::Up("redis 7.0.15".to_owned()), "blaze.yaml");
        assert_eq!(up.result, Outcome::Ok);
        assert_eq!(judge(&place, &Reached::NotBuilt("kafka"), "f").result, Outcome::Skipped);
    }

    #[test]
    fn each_low_setting_has_the_command_that_raises_it() {
        let place = Place { key: "brokers.node.redis", shown: "redis://h:1".to_owned() };
        let mut report = RedisReport {
            version: "redis 7.0.15".to_owned(),
            complaints: vec![Complaint {
                detail: "maxmemory-policy is allkeys-lru".to_owned(),
                setting: "maxmemory-policy",
                value: "noeviction",
            }],
            tells_buffers: true,
        };
        let low = judge_redis(&place, &report);
        assert_eq!((low.len(), low[0].result), (1, Outcome::Warn));
        let command = "redis-cli -u redis://h:1 config set maxmemory-policy 'noeviction'";
        assert!(low[0].remedy.starts_with(command), "{low:?}");
        report.complaints.clear();
        assert_eq!(judge_redis(&place, &report)[0].result, Outcome::Ok);
        report.tells_buffers = false;
        assert_eq!(judge_redis(&place, &report)[0].result, Outcome::Skipped);
    }

    #[cfg(feature = "kafka")]
    #[test]
    fn narrow_topics_are_named_with_the_command_that_widens_them() {
        let place = Place { key: "brokers.layer.kafka", shown: "h:9092,i:9092".to_owned() };
        assert_eq!(judge_kafka(&place, &[]).result, Outcome::Ok);
        let found = judge_kafka(&place, &[("camera_image".to_owned(), 1_048_588)]);
        assert_eq!(found.result, Outcome::Warn);
        assert!(found.remedy.contains("--bootstrap-server h:9092 "), "{found:?}");
        assert!(found.remedy.contains("--entity-name camera_image"), "{found:?}");
    }
}
