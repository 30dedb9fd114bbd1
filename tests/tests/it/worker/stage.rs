//! A main service without tokens, a broker, and workers of layer `edge`.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::redis::RedisKeys;
use blaze_brokers::{
    Broker, BrokerKind, Content, Health, PublisherOptions, Role, SubscribeOptions, Subscription,
    open_layer, open_node,
};
use blaze_domain::config::merge::merge_patch;
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::{NodeBroker, NodeFile};
use blaze_tests::process::{Process, Signal};
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer, free_port};
use blaze_tests::wait;
use bytes::Bytes;
use serde_json::{Value, json};
use tempfile::TempDir;

use super::kit::Starting;

/// A start on a machine that does much else.
const START: Duration = Duration::from_secs(60);
/// What is waited for, at most.
pub(crate) const PATIENCE: Duration = Duration::from_secs(20);

/// What the processes of one test have in common.
pub(crate) struct Stage {
    pub(super) folder: TempDir,
    pub(crate) redis: OwnRedis,
    /// The section of the node file.
    brokers: Value,
    pub(super) rest: SocketAddr,
    pub(super) grpc: SocketAddr,
    pub(super) http: reqwest::Client,
}

/// A Redis, where the stage has one.
pub(crate) struct OwnRedis(Option<RedisServer>);

impl std::ops::Deref for OwnRedis {
    type Target = RedisServer;
    fn deref(&self) -> &RedisServer {
        self.0.as_ref().expect("the stage has a Redis")
    }
}

/// A running worker and where it is asked.
pub(crate) struct Worker {
    pub(super) process: Process,
    pub(crate) admin: SocketAddr,
}

fn free() -> SocketAddr {
    SocketAddr::from((Ipv4Addr::LOCALHOST, free_port().unwrap()))
}

/// Waits for the ready line, and gives what is in it.
pub(super) fn addresses(process: &Process) -> anyhow::Result<BTreeMap<String, SocketAddr>> {
    let line = wait::until_some(
        "the ready line",
        START,
        || process.stdout().into_iter().find(|line| line.starts_with("ready ")),
        || process.tail(),
    )?;
    let words = line.split(' ').filter_map(|word| word.split_once('='));
    let addresses =
        words.filter_map(|(name, address)| Some((name.to_owned(), address.parse().ok()?)));
    Ok(addresses.collect())
}

impl Stage {
    /// Nodes with a Redis each.
    pub(crate) fn new() -> Self {
        let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default()).unwrap();
        let brokers = json!({ "node": { "redis": { "url": redis.url() } } });
        Self::with(Some(redis), brokers)
    }

    /// A layer on this broker, as in the node file.
    pub(crate) fn of_layer(broker: &Value) -> Self {
        Self::with(None, json!({ "layer": broker }))
    }

    fn with(redis: Option<RedisServer>, brokers: Value) -> Self {
        let folder = TempDir::new().unwrap();
        let key = blaze_auth::generate_encryption_key().unwrap();
        std::fs::write(folder.path().join("enc.key"), key.as_bytes()).unwrap();
        Self {
            folder,
            redis: OwnRedis(redis),
            brokers,
            rest: free(),
            grpc: free(),
            http: reqwest::Client::new(),
        }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(super) fn write(&self, name: &str, file: &Value) -> String {
        let path = self.path(name);
        // JSON is YAML.
        std::fs::write(&path, file.to_string()).unwrap();
        path.to_str().unwrap().to_owned()
    }

    /// The main service, ready; after a start on the same store as before.
    pub(crate) fn main(&self) -> Process {
        self.main_at("warn", None)
    }

    /// The same with a level of logs, which may all be written to a file.
    pub(crate) fn main_at(&self, level: &str, log: Option<&Path>) -> Process {
        let file = self.write(
            "main.yaml",
            &json!({
                "log": { "level": level },
                "control_plane": {
                    "rest": { "listen": self.rest }, "grpc": { "listen": self.grpc },
                    "admin": { "listen": "127.0.0.1:0" },
                    "store": { "sqlite": { "path": self.path("main.db") } },
                    "encryption": { "keys": [{ "id": "e1", "file": self.path("enc.key") }] },
                },
            }),
        );
        let arguments = ["--dev", "--config", &file];
        let process = match log {
            Some(log) => Process::start_logged("blaze-config", &arguments, log),
            None => Process::start("blaze-config", &arguments, None),
        }
        .unwrap();
        addresses(&process).unwrap();
        process
    }

    /// The worker of a node, ready; after a start on the same copies as before.
    pub(crate) fn worker(&self, node: &str) -> Worker {
        self.worker_with(node, &json!({}))
    }

    /// The same with further members of the section `worker`.
    pub(crate) fn worker_with(&self, node: &str, section: &Value) -> Worker {
        self.started(node, &self.node_file(node, &self.brokers, &json!({ "worker": section })))
    }

    /// A worker of the whole layer, ready, beside others; `more` are further sections. Its broker
    /// is in its own memory, unless they name another: keys are enough to see who serves.
    pub(crate) fn layer_worker(&self, node: &str, more: &Value) -> Worker {
        let memory = json!({ "layer": { "memory": {} } });
        let brokers = more.get("brokers").unwrap_or(&memory);
        self.started(node, &self.node_file(node, brokers, more))
    }

    /// The node file of a worker, with further members.
    pub(super) fn node_file(&self, node: &str, brokers: &Value, more: &Value) -> Value {
        let mut file = json!({
            "log": { "level": "info" },
            "layer": { "name": "edge", "kind": "edge" },
            "node": { "name": node },
            "brokers": brokers,
            "admin": { "worker": "127.0.0.1:0" },
            "config": { "server": format!("http://{}", self.grpc) },
            "worker": { "state_dir": self.path(node) },
        });
        merge_patch(&mut file, more);
        file
    }

    fn started(&self, node: &str, file: &Value) -> Worker {
        let file = self.write(&format!("{node}.yaml"), file);
        Starting::of(Process::start("blaze-worker", &["--config", &file], None).unwrap()).ready()
    }

    /// A request to the main service that must succeed.
    pub(crate) async fn send(
        &self,
        method: reqwest::Method,
        path: &str,
        body: Option<&Value>,
    ) -> Value {
        let mut request = self.http.request(method, format!("http://{}/api/v1{path}", self.rest));
        request = request.header("if-match", "*");
        if let Some(body) = body {
            request = request.json(body);
        }
        let response = request.send().await.unwrap();
        let (status, text) = (response.status(), response.text().await.unwrap());
        assert!(status.is_success(), "{path}: {status} {text}");
        serde_json::from_str(&text).unwrap_or_default()
    }

    /// Applies documents: kind, name (of an instance `service/name`), spec.
    pub(crate) async fn apply(&self, documents: &[(&str, &str, Value)]) -> u64 {
        let documents = documents.iter().map(|(kind, name, spec)| match name.split_once('/') {
            Some((service, name)) => {
                json!({ "kind": kind, "service": service, "name": name, "spec": spec })
            }
            None => json!({ "kind": kind, "name": name, "spec": spec }),
        });
        let body = Value::Array(documents.collect());
        let answer = self.send(reqwest::Method::POST, "/apply", Some(&body)).await;
        answer["revision"].as_u64().unwrap()
    }

    pub(crate) async fn put(&self, path: &str, spec: Value) -> u64 {
        let answer = self.send(reqwest::Method::PUT, path, Some(&json!({ "spec": spec }))).await;
        answer["revision"].as_u64().unwrap()
    }

    pub(crate) async fn get(&self, path: &str) -> Value {
        self.send(reqwest::Method::GET, path, None).await
    }

    /// A robot with two services, of which one has an instance.
    pub(crate) async fn robot(&self) -> u64 {
        self.apply(&[
            ("Layer", "edge", json!({ "kind": "edge", "config": { "verbosity": "info" } })),
            ("Node", "robot-1", json!({ "layer": "edge" })),
            ("Service", "slam", json!({ "config": { "camera": { "rate_hz": 30 } } })),
            ("Service", "nav", json!({ "config": { "speed": 1 } })),
            ("Instance", "slam/0", json!({ "node": "robot-1" })),
        ])
        .await
    }

    pub(crate) fn keys(&self) -> RedisKeys {
        RedisKeys::open(&section(&self.redis)).unwrap()
    }

    /// A client of the broker, as services have it, that is connected.
    pub(crate) async fn broker(&self) -> Arc<dyn Broker> {
        connected(&self.brokers).await
    }

    /// A service that knows only the broker.
    pub(crate) async fn service(&self) -> Service {
        Service::over(self.broker().await).await
    }

    /// Waits until the worker has what the main service has; gives the digest.
    pub(crate) async fn equal(&self, worker: &Worker, limit: Duration) -> String {
        let start = tokio::time::Instant::now();
        loop {
            let (main, here) = (self.get("/digest?layer=edge").await, worker.status().await);
            let is_equal = main["digest"] == here["digest"]
                && here["connected"] == true
                && here["source"] == "main";
            if is_equal {
                return main["digest"].as_str().unwrap().to_owned();
            }
            assert!(
                start.elapsed() < limit,
                "not equal within {limit:?}: {main} and {here}; {}",
                worker.tail()
            );
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
}

impl Worker {
    pub(crate) async fn status(&self) -> Value {
        let url = format!("http://{}/v1/status", self.admin);
        let text = reqwest::get(url).await.unwrap().text().await.unwrap();
        serde_json::from_str(&text).unwrap()
    }

    /// Waits until the status satisfies.
    pub(crate) async fn until(&self, what: &str, is_good: impl Fn(&Value) -> bool) -> Value {
        let start = tokio::time::Instant::now();
        loop {
            let status = self.status().await;
            if is_good(&status) {
                return status;
            }
            assert!(start.elapsed() < PATIENCE, "{what}: {status}; {}", self.tail());
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    pub(crate) async fn text(&self, path: &str) -> String {
        let url = format!("http://{}{path}", self.admin);
        reqwest::get(url).await.unwrap().text().await.unwrap()
    }

    pub(crate) fn signal(&self, signal: Signal) {
        self.process.signal(signal).unwrap();
    }

    /// Whether it leads; `None`: it does not answer within a tenth of a second.
    pub(crate) async fn leads(&self) -> Option<bool> {
        let url = format!("http://{}/v1/status", self.admin);
        let answer = async { reqwest::get(url).await.ok()?.text().await.ok() };
        let text = tokio::time::timeout(Duration::from_millis(100), answer).await.ok()??;
        let status: Value = serde_json::from_str(&text).ok()?;
        status["leader"].as_bool()
    }

    /// Whether it leads, as it says when it is asked until it answers.
    pub(crate) async fn is_leader(&self) -> bool {
        let start = tokio::time::Instant::now();
        loop {
            if let Some(leads) = self.leads().await {
                return leads;
            }
            assert!(start.elapsed() < PATIENCE, "it does not answer: {}", self.tail());
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }

    pub(crate) fn kill(mut self) {
        self.process.kill().unwrap();
    }

    pub(crate) fn stop(mut self) {
        assert_eq!(self.process.terminate(PATIENCE).unwrap(), Some(0), "{}", self.tail());
    }

    pub(crate) fn tail(&self) -> String {
        self.process.tail()
    }
}

/// A service that knows only the broker.
pub(crate) struct Service {
    broker: Arc<dyn Broker>,
    replies: Subscription,
    /// Others may be answered on the same channel.
    life: u32,
    asked: u64,
}

/// A Redis as a node file names it.
pub(super) fn section(redis: &RedisServer) -> blaze_domain::node_file::RedisBroker {
    let file = json!({ "brokers": { "node": { "redis": { "url": redis.url() } } } });
    match NodeFile::read(&file).unwrap().0.brokers.node {
        Some(NodeBroker::Redis(section)) => section,
        other => panic!("{other:?}"),
    }
}

/// A client of a broker, as services have it, that is connected.
async fn connected(brokers: &Value) -> Arc<dyn Broker> {
    let file = NodeFile::read(&json!({ "brokers": brokers })).unwrap().0.brokers;
    let broker = match (&file.node, &file.layer) {
        (Some(section), _) => open_node(section, &Role::Service).unwrap(),
        (None, Some(section)) => open_layer(section, &Role::Service).unwrap(),
        (None, None) => panic!("no broker"),
    };
    let mut status = broker.status();
    let up = status.wait_for(|status| status.health == Health::Up);
    tokio::time::timeout(PATIENCE, up).await.expect("the broker answers").unwrap();
    broker
}

impl Service {
    pub(crate) async fn on(redis: &RedisServer) -> Self {
        let brokers = json!({ "node": { "redis": { "url": redis.url() } } });
        Self::over(connected(&brokers).await).await
    }

    async fn over(broker: Arc<dyn Broker>) -> Self {
        let reply: ChannelName = match broker.kind() {
            BrokerKind::Redis | BrokerKind::Memory => "blaze/reply/test".parse().unwrap(),
            BrokerKind::Kafka | BrokerKind::Dds | BrokerKind::Ros2 => ChannelName::shared_reply(),
        };
        let replies = broker.subscribe(&reply, SubscribeOptions::default()).await.unwrap();
        Self { broker, replies, life: rand::random(), asked: 0 }
    }

    /// Hears of changes of a service from now on.
    pub(crate) async fn listen(&self, service: &str) -> Subscription {
        self.listen_with(service, SubscribeOptions::default()).await
    }

    /// The same, beginning with what the broker keeps.
    pub(crate) async fn listen_late(&self, service: &str) -> Subscription {
        let options = SubscribeOptions { with_kept: true, ..SubscribeOptions::default() };
        self.listen_with(service, options).await
    }

    async fn listen_with(&self, service: &str, options: SubscribeOptions) -> Subscription {
        let channel = format!("blaze/config/changed/{service}").parse().unwrap();
        self.broker.subscribe(&channel, options).await.unwrap()
    }

    /// Says something on a channel.
    pub(crate) fn publish(&self, channel: &str, message: &Value) {
        let publisher =
            self.broker.publisher(&channel.parse().unwrap(), PublisherOptions::default()).unwrap();
        publisher.publish_bare(&Bytes::from(message.to_string()), None);
    }

    /// Asks until it is answered, as often as a service may: each second.
    pub(crate) async fn ask(&mut self, mut request: Value, limit: Duration) -> Value {
        let options = PublisherOptions { reliable: true, ..PublisherOptions::default() };
        let publisher =
            self.broker.publisher(&"blaze/config/get".parse().unwrap(), options).unwrap();
        let start = tokio::time::Instant::now();
        loop {
            self.asked += 1;
            let id = format!("{:08x}-{}", self.life, self.asked);
            request["id"] = json!(id);
            request["reply_to"] = json!("blaze/reply/test");
            publisher.publish_bare(&Bytes::from(request.to_string()), None);
            let mut batch = Vec::new();
            let answer = async {
                loop {
                    batch.clear();
                    if self.replies.receive(&mut batch, 1).await == 0 {
                        std::future::pending::<()>().await;
                    }
                    let answer = text(&batch[0].content);
                    if answer["id"] == id.as_str() {
                        return answer;
                    }
                }
            };
            if let Ok(answer) = tokio::time::timeout(Duration::from_millis(200), answer).await {
                return answer;
            }
            assert!(start.elapsed() < limit, "no answer within {limit:?}");
        }
    }
}

fn text(content: &Content) -> Value {
    match content {
        Content::Bare { payload, .. } => serde_json::from_slice(payload).unwrap(),
        other => panic!("{other:?}"),
    }
}

/// The next notice.
pub(crate) async fn next(notices: &mut Subscription) -> Value {
    let mut batch = Vec::new();
    let received = notices.receive(&mut batch, 1);
    let count = tokio::time::timeout(PATIENCE, received).await.expect("a notice in time");
    assert_eq!(count, 1);
    text(&batch[0].content)
}

/// Whatever has come by now.
pub(crate) async fn rest(notices: &mut Subscription) -> Vec<Value> {
    let mut batch = Vec::new();
    // What is there is taken at once.
    let _ =
        tokio::time::timeout(Duration::from_millis(1), notices.receive(&mut batch, 10_000)).await;
    batch.iter().map(|received| text(&received.content)).collect()
}
