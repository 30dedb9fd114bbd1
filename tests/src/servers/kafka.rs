//! A Kafka broker of one test.

use std::path::Path;
use std::time::Duration;

use anyhow::Context as _;
use rdkafka::ClientConfig;
use rdkafka::consumer::{BaseConsumer, Consumer as _};
use rdkafka::metadata::{MetadataPartition, MetadataTopic};

use super::endpoint::Endpoint;
use super::process::ServerProcess;
use super::{installed, ports};
use crate::network::Host;

/// Measured: 3 s, some seconds more after a kill. The rest is for a machine that does much else.
const START: Duration = Duration::from_secs(60);
/// One look whether it can be used.
const LOOK: Duration = Duration::from_secs(1);
/// Another process may take a port between our choice and the broker's start.
const PORT_ATTEMPTS: usize = 3;

const PROPERTIES: &str =
    include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/../scripts/services.d/kafka.properties"));
const JAVA_OPTIONS: &str =
    concat!(env!("CARGO_MANIFEST_DIR"), "/../scripts/services.d/kafka.java-options");
const LOGGING: &str = include_str!(concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../scripts/services.d/kafka.log4j2.properties"
));

/// How a broker of one test is set up.
#[derive(Debug, Clone)]
pub struct KafkaOptions {
    /// Largest heap of the Java machine, MiB.
    pub heap_mib: u32,
    /// The host of a network that it runs and listens on; absent = this machine's loopback.
    pub host: Option<Host>,
    /// Lines of `server.properties`; they win over those of `scripts/services.d/kafka.properties`,
    /// and have the same words of the form `@WORD@`.
    pub extra: Vec<String>,
}

impl Default for KafkaOptions {
    fn default() -> Self {
        Self { heap_mib: 512, host: None, extra: Vec::new() }
    }
}

/// A running broker, which is its own controller; killed when dropped. The first consumer group
/// takes some seconds more, because its offsets' topic is made then.
pub struct KafkaServer {
    process: ServerProcess,
    options: KafkaOptions,
    endpoint: Endpoint,
    cluster: String,
}

impl KafkaServer {
    /// Starts a broker with a cluster identity of its own and waits until it can be used.
    ///
    /// # Errors
    /// When it is not installed, refuses its configuration, or does not answer in time.
    #[expect(
        clippy::needless_pass_by_value,
        reason = "options are written in place: `start(KafkaOptions::default())`"
    )]
    pub fn start(options: KafkaOptions) -> anyhow::Result<Self> {
        let mut attempt = 1;
        loop {
            let server = Self::prepare(options.clone())?;
            match server.spawn() {
                Ok(()) => return Ok(server),
                Err(error) => {
                    let taken = server.process.log_tail().contains("already in use");
                    if !taken || attempt == PORT_ATTEMPTS {
                        return Err(error);
                    }
                    attempt += 1;
                }
            }
        }
    }

    fn prepare(options: KafkaOptions) -> anyhow::Result<Self> {
        let process = ServerProcess::new("kafka")?;
        let folder = process.folder();
        let endpoint = Endpoint::new(options.host.as_ref(), ports::free()?);
        let data = folder.join("data");
        let cluster = new_cluster_id();
        copy_formatted(&installed::path("kafka/formatted")?, &data, &cluster)?;
        let text = format!("{PROPERTIES}\n{}\n", options.extra.join("\n"))
            .replace("PLAINTEXT://127.0.0.1:", &format!("PLAINTEXT://{}:", endpoint.ip()))
            .replace("@PORT@", &endpoint.port.to_string())
            .replace("@CONTROLLER_PORT@", &ports::free()?.to_string())
            .replace("@DATA@", &data.display().to_string());
        std::fs::write(folder.join("server.properties"), text)?;
        std::fs::write(folder.join("log4j2.properties"), LOGGING)?;
        Ok(Self { process, options, endpoint, cluster })
    }

    fn spawn(&self) -> anyhow::Result<()> {
        let mut command = self.endpoint.program(installed::path("jre/bin/java")?);
        // Java itself expands the asterisk.
        let libraries = installed::path("kafka/libs")?.join("*");
        command.arg(format!("@{JAVA_OPTIONS}")).arg(format!("-Xmx{}m", self.options.heap_mib));
        // Half the time to start. Java does without if the archive does not fit.
        let archive = installed::folder().join("kafka/classes.jsa");
        if archive.exists() {
            command.arg(format!("-XX:SharedArchiveFile={}", archive.display()));
        }
        command
            .arg("-Dlog4j2.configurationFile=log4j2.properties")
            .arg("-cp")
            .arg(libraries)
            .args(["kafka.Kafka", "server.properties"]);
        self.process.spawn(command)?;
        self.wait_ready()
    }

    /// `ADDRESS:PORT`; the address is 127.0.0.1 or that of its host.
    #[must_use]
    pub fn bootstrap(&self) -> String {
        format!("{}:{}", self.endpoint.ip(), self.endpoint.port)
    }

    /// Waits until the broker lists itself and every partition has a leader.
    fn wait_ready(&self) -> anyhow::Result<()> {
        // The cluster tells that it has the port: another broker there would answer as well.
        let ready = || {
            let leaders = leaders(&self.endpoint, LOOK);
            leaders.is_ok_and(|(cluster, leaders)| {
                cluster == self.cluster && leaders.iter().all(|leader| *leader >= 0)
            })
        };
        self.process.wait_ready(START, ready)?;
        Ok(())
    }

    /// SIGKILL; its end has been waited for.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn kill(&self) -> anyhow::Result<()> {
        self.process.kill()
    }

    /// Kills it if it runs, starts it with the same ports and data, and waits until it can be used.
    ///
    /// # Errors
    /// As [`KafkaServer::start`].
    pub fn restart(&self) -> anyhow::Result<()> {
        self.kill()?;
        self.spawn()
    }

    /// SIGSTOP: connections stay, answers do not come.
    ///
    /// # Errors
    /// When it does not run.
    pub fn freeze(&self) -> anyhow::Result<()> {
        self.process.freeze()
    }

    /// SIGCONT after [`KafkaServer::freeze`]. The broker may need seconds to take itself for alive
    /// again.
    ///
    /// # Errors
    /// When it does not run.
    pub fn thaw(&self) -> anyhow::Result<()> {
        self.process.thaw()
    }
}

/// Copies the empty data folder that `scripts/services install` formatted, which saves a start of
/// Java, and gives it a cluster identity of its own.
fn copy_formatted(from: &Path, to: &Path, cluster: &str) -> anyhow::Result<()> {
    std::fs::create_dir(to)?;
    for entry in std::fs::read_dir(from)? {
        let entry = entry?;
        std::fs::copy(entry.path(), to.join(entry.file_name()))?;
    }
    let path = to.join("meta.properties");
    let text =
        std::fs::read_to_string(&path).context("kafka/formatted is not a formatted data folder")?;
    std::fs::write(path, with_cluster_id(&text, cluster))?;
    Ok(())
}

fn with_cluster_id(properties: &str, id: &str) -> String {
    let lines = properties.lines().map(|line| match line.starts_with("cluster.id=") {
        true => format!("cluster.id={id}\n"),
        false => format!("{line}\n"),
    });
    lines.collect()
}

/// 22 characters, the form of Kafka's own identities.
fn new_cluster_id() -> String {
    let name: String = super::unique_name("test").replace('-', "_");
    let start = name.len().saturating_sub(22);
    format!("{:0>22}", &name[start..])
}

/// The cluster that a broker belongs to, and the leaders of all partitions; −1 where there is none,
/// and writing fails for now.
///
/// # Errors
/// When no broker answers in time.
pub(super) fn leaders(broker: &Endpoint, within: Duration) -> anyhow::Result<(String, Vec<i32>)> {
    broker.inside(|| {
        let mut settings = ClientConfig::new();
        let settings =
            settings.set("bootstrap.servers", format!("{}:{}", broker.ip(), broker.port));
        let client: BaseConsumer = settings.set("log_level", "2").create()?;
        let metadata = client.fetch_metadata(None, within)?;
        anyhow::ensure!(!metadata.brokers().is_empty(), "no broker takes part");
        let partitions = metadata.topics().iter().flat_map(MetadataTopic::partitions);
        let cluster = client.client().fetch_cluster_id(within).context("no cluster")?;
        Ok((cluster, partitions.map(MetadataPartition::leader).collect()))
    })
}
