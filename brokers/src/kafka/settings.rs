//! What the clients of librdkafka are told.

use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::node_file::KafkaBroker as Section;
use blaze_runtime::read_password;
use parking_lot::Mutex;
use rdkafka::ClientConfig;
use rdkafka::config::RDKafkaLogLevel;
use rdkafka::error::KafkaError;
use rdkafka::producer::BaseProducer;

use crate::open::OpenError;

/// Largest record, in bytes: the largest payload, and a mebibyte for everything around it.
const MESSAGE_MAX_BYTES: &str = "17825792";
/// Most that one fetch brings together, beside that one record.
const FETCH_MAX_BYTES: &str = "18874368";
/// How long the server may keep a fetch that has nothing to give, in milliseconds. A partition that
/// joins waits for that; each answer costs both sides a tenth of a millisecond of processor time.
const FETCH_WAIT_MS: &str = "200";
/// Identities of topics come with this part of the debug log.
const DEBUG: &str = "topic";
/// A consumer needs a group, though it never joins one.
const GROUP: &str = "blaze";

/// The property that the password of an account goes to.
const PASSWORD: &str = "sasl.password";
/// What properties of accounts and of TLS begin with.
const ACCOUNT_KEYS: [&str; 3] = ["sasl.", "security.", "ssl."];

/// What correctness rests on, so that nobody may set it otherwise.
const FIXED: &[&str] = &[
    "acks",
    "allow.auto.create.topics",
    "auto.commit.enable",
    "auto.offset.reset",
    "bootstrap.servers",
    "compression.codec",
    "compression.type",
    "debug",
    "delivery.timeout.ms",
    "enable.auto.commit",
    "enable.auto.offset.store",
    "enable.idempotence",
    "enable.partition.eof",
    "fetch.max.bytes",
    "fetch.message.max.bytes",
    "group.id",
    "group.instance.id",
    "group.protocol",
    "log.queue",
    "log_level",
    "max.in.flight",
    "max.in.flight.requests.per.connection",
    "message.max.bytes",
    "message.send.max.retries",
    "message.timeout.ms",
    "metadata.broker.list",
    "produce.offset.report",
    "request.required.acks",
    "retries",
    "statistics.interval.ms",
    "topic.metadata.propagation.max.ms",
    "topic.metadata.refresh.interval.ms",
    "transactional.id",
];

/// What a producer is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub(super) struct Lot {
    /// What is lost is sent again for long.
    pub(super) reliable: bool,
    /// Messages may be large.
    pub(super) large: bool,
}

impl Lot {
    /// How many there are.
    pub(super) const COUNT: usize = 4;

    /// Its place among them.
    pub(super) fn index(self) -> usize {
        usize::from(self.reliable) + 2 * usize::from(self.large)
    }

    /// How long a message may wait for the server.
    pub(super) fn longest_wait(self) -> Duration {
        if self.reliable { Duration::from_secs(120) } else { Duration::from_secs(5) }
    }

    /// For names of tasks and threads.
    pub(super) fn as_str(self) -> &'static str {
        match (self.reliable, self.large) {
            (false, false) => "kafka-send",
            (true, false) => "kafka-send-r",
            (false, true) => "kafka-send-l",
            (true, true) => "kafka-send-rl",
        }
    }
}

/// The settings of all clients of one broker section.
#[derive(Clone)]
pub(super) struct Settings {
    base: ClientConfig,
    given: Vec<(String, String)>,
    password: Option<PasswordFile>,
}

/// A password in a file, which may be replaced while clients run.
#[derive(Clone)]
struct PasswordFile {
    path: PathBuf,
    /// As it was read last.
    read: Arc<Mutex<String>>,
}

impl PasswordFile {
    fn open(path: &Path) -> Result<Self, OpenError> {
        let file = Self { path: path.to_owned(), read: Arc::default() };
        let unreadable =
            |reason| OpenError::Setting { key: "kafka.password_file".to_owned(), reason };
        *file.read.lock() = read_password(path).map_err(unreadable)?;
        Ok(file)
    }

    /// What the file holds now. While it cannot be read, what it held last.
    fn now(&self) -> String {
        let mut read = self.read.lock();
        match read_password(&self.path) {
            Ok(text) => *read = text,
            Err(error) => tracing::warn!(error, "the password of Kafka cannot be read again"),
        }
        read.clone()
    }
}

impl Settings {
    /// Checks the properties of a section.
    pub(super) fn new(section: &Section) -> Result<Self, OpenError> {
        let mut base = ClientConfig::new();
        base.set("bootstrap.servers", section.bootstrap.join(","))
            .set("client.id", "blaze")
            .set("socket.nagle.disable", "true")
            .set("socket.keepalive.enable", "true")
            .set("reconnect.backoff.ms", "50")
            .set("reconnect.backoff.max.ms", "500")
            .set("log.connection.close", "false")
            .set("message.max.bytes", MESSAGE_MAX_BYTES)
            .set("topic.metadata.refresh.interval.ms", "1000")
            .set("topic.metadata.refresh.fast.interval.ms", "50")
            .set("topic.metadata.propagation.max.ms", "3000")
            .set_log_level(RDKafkaLogLevel::Warning);
        let mut given = Vec::new();
        for (key, value) in &section.properties {
            check_property(key, value.reveal())?;
            given.push((key.clone(), value.reveal().to_owned()));
        }
        let password = section.password_file.as_deref().map(PasswordFile::open).transpose()?;
        let settings = Self { base, given, password };
        // One of each kind, as each has its own rules for what goes together.
        settings.check(&settings.consumer(false), "consumers")?;
        settings
            .check(&settings.producer(Lot { reliable: true, large: false }, None), "producers")?;
        let of_account =
            |(key, _): &(String, String)| ACCOUNT_KEYS.iter().any(|of| key.starts_with(of));
        if settings.password.is_some() || settings.given.iter().any(of_account) {
            settings.check_account()?;
        }
        Ok(settings)
    }

    fn check(&self, config: &ClientConfig, kind: &str) -> Result<(), OpenError> {
        let refused = |error: KafkaError| {
            self.refused(&error, &format!("the client library refuses them for {kind}"))
        };
        config.create_native_config().map(|_| ()).map_err(refused)
    }

    /// Files of certificates, and what an account needs, are looked at when a client is made. This
    /// one connects nowhere.
    fn check_account(&self) -> Result<(), OpenError> {
        let mut config = self.admin();
        config.remove("bootstrap.servers").set_log_level(RDKafkaLogLevel::Emerg);
        let made: Result<BaseProducer, _> = config.create();
        made.map(|_| ()).map_err(|error| self.refused(&error, "the client library refuses them"))
    }

    /// The library's text may hold a value, and that may be a secret.
    fn refused(&self, error: &KafkaError, otherwise: &str) -> OpenError {
        let text = error.to_string();
        let secret = |(key, value): &(String, String)| {
            !key.ends_with(".location") && text.contains(value.as_str())
        };
        let password = self.password.as_ref().map(|file| file.read.lock().clone());
        let is_secret = self.given.iter().any(secret)
            || password.is_some_and(|password| text.contains(&password));
        let reason = if is_secret { otherwise.to_owned() } else { text.clone() };
        OpenError::Setting { key: "kafka.properties".to_owned(), reason }
    }

    /// Stands for what the files of passwords and certificates hold now: another number, other
    /// content.
    pub(super) fn secrets(&self) -> u64 {
        let of_file = |(key, path): &(String, String)| {
            key.ends_with(".location").then(|| std::fs::read(path).ok())
        };
        let files: Vec<_> = self.given.iter().filter_map(of_file).collect();
        let password = self.password.as_ref().map(PasswordFile::now);
        let mut hasher = DefaultHasher::new();
        (files, password).hash(&mut hasher);
        hasher.finish()
    }

    /// Where the server is, for people.
    pub(super) fn place(&self) -> &str {
        self.base.get("bootstrap.servers").unwrap_or_default()
    }

    /// With what the section gives on top of our own choice, and what is fixed on top of that.
    fn with(&self, chosen: &[(&str, &str)], fixed: &[(&str, &str)]) -> ClientConfig {
        let mut config = self.base.clone();
        for (key, value) in chosen {
            config.set(*key, *value);
        }
        for (key, value) in &self.given {
            config.set(key, value);
        }
        if let Some(password) = &self.password {
            config.set(PASSWORD, password.now());
        }
        for (key, value) in fixed {
            config.set(*key, *value);
        }
        config
    }

    /// Reads channels, each partition as it is told.
    pub(super) fn consumer(&self, large: bool) -> ClientConfig {
        let queued = if large { "65536" } else { "32768" };
        let mut config = self.with(
            &[
                ("fetch.wait.max.ms", FETCH_WAIT_MS),
                ("fetch.min.bytes", "1"),
                ("fetch.error.backoff.ms", "20"),
                ("fetch.queue.backoff.ms", "20"),
                ("queued.min.messages", "10000"),
                ("queued.max.messages.kbytes", queued),
            ],
            &[
                ("group.id", GROUP),
                ("enable.auto.commit", "false"),
                ("enable.auto.offset.store", "false"),
                ("allow.auto.create.topics", "false"),
                ("fetch.message.max.bytes", MESSAGE_MAX_BYTES),
                ("fetch.max.bytes", FETCH_MAX_BYTES),
                // A position that the server has not is looked into: it must never mean "all
                // again".
                ("auto.offset.reset", "error"),
                ("debug", DEBUG),
            ],
        );
        config.set_log_level(RDKafkaLogLevel::Debug);
        config
    }

    /// Reads one topic to its end.
    pub(super) fn reader_to_end(&self) -> ClientConfig {
        let mut config = self.consumer(true);
        config.set("enable.partition.eof", "true");
        config.remove("debug");
        config.set_log_level(RDKafkaLogLevel::Warning);
        config
    }

    /// A member of the group whose partition is a lease.
    pub(super) fn lease_member(&self, group: &str, session: Duration) -> ClientConfig {
        let session_ms = session.as_millis().to_string();
        self.with(
            &[],
            &[
                ("group.id", group),
                ("enable.auto.commit", "false"),
                ("enable.auto.offset.store", "false"),
                ("allow.auto.create.topics", "false"),
                ("auto.offset.reset", "latest"),
                ("session.timeout.ms", &session_ms),
                // An answer that does not come holds up the thread of the lease.
                ("socket.timeout.ms", "5000"),
                ("max.poll.interval.ms", &(session * 30).as_millis().to_string()),
                // Members hear of each other's end with their heartbeats.
                ("heartbeat.interval.ms", "500"),
                // A member that joins or leaves takes the partition from nobody.
                ("partition.assignment.strategy", "cooperative-sticky"),
                ("topic.metadata.refresh.interval.ms", "5000"),
            ],
        )
    }

    /// Asks for metadata and offsets.
    pub(super) fn questions(&self) -> ClientConfig {
        let mut config = self.with(&[], &[("allow.auto.create.topics", "false"), ("debug", DEBUG)]);
        config.set_log_level(RDKafkaLogLevel::Debug);
        config
    }

    /// Makes topics.
    pub(super) fn admin(&self) -> ClientConfig {
        self.with(&[], &[])
    }

    /// Writes channels: sends at once what it gets, or gathers it for a time.
    pub(super) fn producer(&self, lot: Lot, gathers: Option<Duration>) -> ClientConfig {
        let linger = gathers.map_or(0.0, |time| time.as_secs_f64() * 1_000.0).to_string();
        let timeout = lot.longest_wait().as_millis().to_string();
        self.with(
            &[
                ("linger.ms", &linger),
                // The server's limit counts the whole batch, and a topic allows 1 MiB by default:
                // messages that each fit must not be refused for their company.
                ("batch.size", "500000"),
                ("queue.buffering.max.kbytes", "65536"),
            ],
            &[
                ("enable.idempotence", "true"),
                ("acks", "all"),
                ("compression.type", "none"),
                ("message.timeout.ms", &timeout),
            ],
        )
    }
}

fn check_property(key: &str, value: &str) -> Result<(), OpenError> {
    let refuse = |reason: &str| {
        Err(OpenError::Setting {
            key: format!("kafka.properties.{key}"),
            reason: reason.to_owned(),
        })
    };
    if FIXED.contains(&key) {
        return refuse("is set by BlazeAIoT itself");
    }
    let mut alone = ClientConfig::new();
    alone.set(key, value);
    match alone.create_native_config() {
        Ok(_) => Ok(()),
        Err(_) => refuse("the client library does not know this property, or not this value of it"),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::Arc;

    use blaze_domain::node_file::{LayerBroker, NodeFile};

    use super::*;
    use crate::kafka::inner::Shared;

    fn section(properties: &str) -> Section {
        section_at("127.0.0.1:9092", properties)
    }

    /// The section of a server at this address.
    pub(in crate::kafka) fn section_at(bootstrap: &str, properties: &str) -> Section {
        let tree = serde_json::json!({
            "layer": {"name": "fog", "kind": "fog"},
            "node": {"name": "server-1"},
            "brokers": {"layer": {"kafka": {
                "bootstrap": [bootstrap],
                "properties": serde_json::from_str::<serde_json::Value>(properties).unwrap(),
            }}},
        });
        let (file, _) = NodeFile::read(&tree).unwrap();
        match file.brokers.layer {
            Some(LayerBroker::Kafka(kafka)) => kafka,
            other => panic!("{other:?}"),
        }
    }

    /// What the clients of a server at this address share; without a runtime that runs tasks.
    pub(in crate::kafka) fn shared_at(bootstrap: &str) -> Arc<Shared> {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let _entered = runtime.enter();
        Shared::new(Settings::new(&section_at(bootstrap, "{}")).unwrap())
    }

    fn refused(properties: &str) -> OpenError {
        match Settings::new(&section(properties)) {
            Ok(_) => panic!("{properties} was accepted"),
            Err(error) => error,
        }
    }

    #[test]
    fn our_own_settings_are_ones_that_the_library_knows() {
        let settings = Settings::new(&section("{}")).unwrap();
        for config in [
            settings.consumer(false),
            settings.consumer(true),
            settings.reader_to_end(),
            settings.questions(),
            settings.admin(),
            settings.lease_member("g", Duration::from_secs(10)),
            settings.lease_member("g", Duration::from_secs(600)),
        ] {
            config.create_native_config().unwrap();
        }
        for (reliable, large) in [(false, false), (true, false), (false, true), (true, true)] {
            settings.producer(Lot { reliable, large }, None).create_native_config().unwrap();
        }
    }

    #[test]
    fn properties_of_the_section_count_but_not_against_correctness() {
        let settings = Settings::new(&section(r#"{"linger.ms": 3, "client.id": "me"}"#)).unwrap();
        let config = settings.producer(Lot { reliable: false, large: false }, None);
        assert_eq!(config.get("linger.ms"), Some("3"));
        assert_eq!(config.get("client.id"), Some("me"));
        assert_eq!(config.get("message.timeout.ms"), Some("5000"));
        for key in
            ["enable.idempotence", "acks", "group.id", "enable.auto.commit", "auto.offset.reset"]
        {
            match refused(&format!(r#"{{"{key}": "x"}}"#)) {
                OpenError::Setting { key: found, .. } => {
                    assert_eq!(found, format!("kafka.properties.{key}"));
                }
                other => panic!("{other}"),
            }
        }
    }

    #[test]
    fn a_bad_property_is_named_and_its_value_is_not() {
        for properties in [
            r#"{"no.such.thing": "s3cret"}"#,
            r#"{"linger.ms": "s3cret"}"#,
            r#"{"client.dns.lookup": "s3cret"}"#,
        ] {
            let error = refused(properties).to_string();
            assert!(error.contains("kafka.properties."), "{error}");
            assert!(!error.contains("s3cret"), "{error}");
        }
    }

    #[test]
    fn accounts_and_tls_are_built_in() {
        for protocol in ["plaintext", "ssl", "SASL_SSL", "sasl_plaintext"] {
            for mechanism in ["PLAIN", "SCRAM-SHA-256", "SCRAM-SHA-512"] {
                let properties = serde_json::json!({
                    "security.protocol": protocol,
                    "sasl.mechanisms": mechanism,
                    "sasl.username": "robot",
                    "sasl.password": "s3cret",
                });
                let checked = Settings::new(&section(&properties.to_string()));
                assert_eq!(checked.err(), None, "{protocol} {mechanism}");
            }
        }
    }
}
