//! `blaze-flow` as a process of its own, on real brokers.

use std::fmt::Write as _;
use std::fs::File;
use std::net::{Ipv4Addr, UdpSocket};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use serde_json::Value;

use crate::admin::Admin;
use crate::network::Host;
use crate::process::{self, Process, Signal, Usage};
use crate::wait;

/// Where a flow must say `ready`, on a busy machine.
const START: Duration = Duration::from_secs(30);

/// The node file of a flow.
#[derive(Debug, Clone)]
pub struct FlowSpec {
    /// Layer; its kind has the same word unless `kind` says otherwise.
    pub layer: String,
    /// edge, fog or cloud; empty = as the layer is named.
    pub kind: String,
    /// Node.
    pub node: String,
    /// URL and prefix of the node scope's Redis.
    pub redis: Option<(String, String)>,
    /// Address and prefix of the layer scope's Kafka.
    pub kafka: Option<(String, String)>,
    /// DDS domain of the layer scope, on loopback or its host's address.
    pub layer_domain: Option<u16>,
    /// `ROS_DOMAIN_ID` of the ROS 2 network, and its interface.
    pub ros2: Option<(u16, Ipv4Addr)>,
    /// DDS domain of the inter scope, on loopback or its host's address.
    pub domain: Option<u16>,
    /// The host of a network that it runs on; absent = this machine.
    pub host: Option<Host>,
    /// Addresses of flows to begin with; empty = loopback, which a host of a network does not
    /// share.
    pub peers: Vec<Ipv4Addr>,
    /// `flow.bandwidth.limit_mbps`.
    pub limit_mbps: f64,
    /// More keys of `flow.bandwidth`, such as `share: fair`.
    pub bandwidth: String,
    /// Further lines of the node file.
    pub extra: String,
    /// More keys of `flow`, such as `access: […]`.
    pub flow: String,
}

impl FlowSpec {
    /// A flow without brokers.
    #[must_use]
    pub fn new(layer: &str, node: &str) -> Self {
        Self {
            layer: layer.to_owned(),
            kind: String::new(),
            node: node.to_owned(),
            redis: None,
            kafka: None,
            layer_domain: None,
            ros2: None,
            domain: None,
            host: None,
            peers: Vec::new(),
            limit_mbps: 160.0,
            bandwidth: String::new(),
            extra: String::new(),
            flow: String::new(),
        }
    }

    /// With Redis as node scope.
    #[must_use]
    pub fn on_redis(mut self, url: &str, prefix: &str) -> Self {
        self.redis = Some((url.to_owned(), prefix.to_owned()));
        self
    }

    /// With Kafka as layer scope.
    #[must_use]
    pub fn on_kafka(mut self, bootstrap: &str, prefix: &str) -> Self {
        self.kafka = Some((bootstrap.to_owned(), prefix.to_owned()));
        self
    }

    /// With a DDS domain as layer scope.
    #[must_use]
    pub fn on_dds(mut self, domain: u16) -> Self {
        self.layer_domain = Some(domain);
        self
    }

    /// With the ROS 2 network of its host.
    #[must_use]
    pub fn on_ros2(mut self, domain: u16) -> Self {
        self.ros2 = Some((domain, Ipv4Addr::LOCALHOST));
        self
    }

    /// With the ROS 2 network that a host of a network is on, with others.
    #[must_use]
    pub fn on_ros2_of(mut self, host: &Host, domain: u16) -> Self {
        self.ros2 = Some((domain, host.address));
        self
    }

    /// With an inter scope on loopback.
    #[must_use]
    pub fn joined(mut self, domain: u16) -> Self {
        self.domain = Some(domain);
        self
    }

    /// On a host of a network, with the addresses of other flows' hosts to begin with.
    #[must_use]
    pub fn inside(mut self, host: &Host, peers: &[Ipv4Addr]) -> Self {
        self.host = Some(host.clone());
        self.peers = peers.to_vec();
        self
    }

    /// The node file.
    #[must_use]
    pub fn to_yaml(&self, state: &Path) -> String {
        let kind = if self.kind.is_empty() { &self.layer } else { &self.kind };
        let mut text = format!(
            "layer: {{ name: {}, kind: {kind} }}\nnode: {{ name: {} }}\nbrokers:\n",
            self.layer, self.node
        );
        if let Some((url, prefix)) = &self.redis {
            let _ =
                writeln!(text, "  node: {{ redis: {{ url: \"{url}\", prefix: \"{prefix}\" }} }}");
        }
        if let Some((bootstrap, prefix)) = &self.kafka {
            let _ = writeln!(
                text,
                "  layer: {{ kafka: {{ bootstrap: [\"{bootstrap}\"], prefix: \"{prefix}\" }} }}"
            );
        }
        let listen = self.host.as_ref().map_or(Ipv4Addr::LOCALHOST, |host| host.address);
        if let Some(domain) = self.layer_domain {
            let _ = writeln!(
                text,
                "  layer: {{ dds: {{ domain: {domain}, interface: \"{listen}\" }} }}"
            );
        }
        if let Some((domain, interface)) = self.ros2 {
            let _ = writeln!(
                text,
                "  plugins: [{{ ros2: {{ domain: {domain}, interface: \"{interface}\" }} }}]"
            );
        }
        if let Some(domain) = self.domain {
            let peers = match (&self.host, &self.peers[..]) {
                (None, []) => &[Ipv4Addr::LOCALHOST],
                (_, peers) => peers,
            };
            let peers: Vec<String> = peers.iter().map(|peer| format!("\"{peer}\"")).collect();
            let _ = writeln!(
                text,
                "  inter: {{ dds: {{ domain: {domain}, listen: \"{listen}\", peers: [{}] }} }}",
                peers.join(", ")
            );
        }
        let _ = write!(
            text,
            "admin: {{ flow: \"127.0.0.1:0\" }}\nflow: {{ bandwidth: {{ limit_mbps: {}, {} }}, {} }}\nstate_dir: {}\n{}",
            self.limit_mbps,
            self.bandwidth,
            self.flow,
            state.display(),
            self.extra
        );
        text
    }
}

/// A running `blaze-flow`; it is killed when dropped.
pub struct FlowProcess {
    /// What it was started with.
    pub spec: FlowSpec,
    file: PathBuf,
    process: Process,
    admin: Option<Admin>,
    folder: tempfile::TempDir,
}

impl FlowProcess {
    /// Starts it and does not wait.
    ///
    /// # Errors
    /// When it is not built or the node file cannot be written.
    pub fn launch(spec: FlowSpec) -> anyhow::Result<Self> {
        let folder = tempfile::tempdir()?;
        let file = folder.path().join("blaze.yaml");
        std::fs::write(&file, spec.to_yaml(folder.path()))?;
        let process = run(&file, spec.host.as_ref())?;
        Ok(Self { spec, file, process, admin: None, folder })
    }

    /// Starts it and waits until it is ready.
    ///
    /// # Errors
    /// As [`FlowProcess::launch`], and when it is not ready in time.
    pub fn start(spec: FlowSpec) -> anyhow::Result<Self> {
        let mut flow = Self::launch(spec)?;
        flow.wait_ready()?;
        Ok(flow)
    }

    /// Writes another node file, which it is to notice by itself.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn edit(&mut self, change: impl FnOnce(&mut FlowSpec)) -> anyhow::Result<()> {
        change(&mut self.spec);
        std::fs::write(&self.file, self.spec.to_yaml(self.folder.path()))?;
        Ok(())
    }

    /// Waits until it is ready.
    ///
    /// # Errors
    /// When it is not in time, with its last words.
    pub fn wait_ready(&mut self) -> anyhow::Result<()> {
        let admin = self.listening()?;
        let asked = admin.clone();
        wait::until("/readyz says 200", START, || asked.ready(), || self.process.tail())?;
        Ok(())
    }

    /// Waits until its admin port listens, which it does before it is ready.
    ///
    /// # Errors
    /// When it does not in time, with its last words.
    pub fn listening(&mut self) -> anyhow::Result<Admin> {
        const SAID: &str = "admin listening on ";
        if let Some(admin) = &self.admin {
            return Ok(admin.clone());
        }
        let line = wait::until_some(
            "the admin port listens",
            START,
            || self.process.stderr().into_iter().find(|line| line.contains(SAID)),
            || self.process.tail(),
        )?;
        let address = line.split(SAID).nth(1).and_then(|rest| rest.split_whitespace().next());
        let admin = Admin {
            address: address.context("no address")?.parse()?,
            namespace: self.spec.host.as_ref().map(|host| host.namespace.clone()),
        };
        self.admin = Some(admin.clone());
        Ok(admin)
    }

    /// Its admin port.
    ///
    /// # Panics
    /// Before it was listening.
    #[must_use]
    #[allow(clippy::expect_used, reason = "a helper of tests")]
    pub fn admin(&self) -> &Admin {
        self.admin.as_ref().expect("asked before it listens")
    }

    /// Its process id.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.process.id()
    }

    /// The last lines that it printed.
    #[must_use]
    pub fn tail(&self) -> String {
        self.process.tail()
    }

    /// Sends it a signal.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn signal(&self, signal: Signal) -> anyhow::Result<()> {
        self.process.signal(signal)
    }

    /// Kills it with -9 and waits for its end.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn kill(&mut self) -> anyhow::Result<()> {
        self.process.kill()
    }

    /// Asks it to end (SIGTERM) and does not wait: it goes on until what it holds has left.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn terminate(&self) -> anyhow::Result<()> {
        self.process.ask_to_end()
    }

    /// Waits for its end and gives its exit code.
    ///
    /// # Errors
    /// When it does not end in time.
    pub fn exit(&mut self, deadline: Duration) -> anyhow::Result<Option<i32>> {
        self.process.exit(deadline)
    }

    /// Starts it again with the same node file and does not wait.
    ///
    /// # Errors
    /// As [`FlowProcess::launch`].
    pub fn relaunch(&mut self) -> anyhow::Result<()> {
        self.process = run(&self.file, self.spec.host.as_ref())?;
        self.admin = None;
        Ok(())
    }

    /// Kills it, starts it again, and waits until it is ready.
    ///
    /// # Errors
    /// As [`FlowProcess::start`].
    pub fn restart(&mut self) -> anyhow::Result<()> {
        self.kill()?;
        self.relaunch()?;
        self.wait_ready()
    }

    /// Messages that came out of all its bridges.
    #[must_use]
    pub fn delivered(&self) -> u64 {
        let bridges = self.bridges();
        let out = bridges.iter().filter_map(|bridge| bridge["out"]["messages"].as_u64());
        out.sum()
    }

    /// Bridges as `GET /v1/bridges` shows them.
    #[must_use]
    pub fn bridges(&self) -> Vec<Value> {
        let answer = self.admin().json("/v1/bridges").unwrap_or_default();
        answer["bridges"].as_array().cloned().unwrap_or_default()
    }

    /// Ids of the bridges that are up, sorted.
    #[must_use]
    pub fn bridges_up(&self) -> Vec<String> {
        let up = |bridge: &Value| {
            (bridge["state"] == "up").then(|| bridge["id"].as_str().unwrap_or_default().to_owned())
        };
        let mut ids: Vec<String> = self.bridges().iter().filter_map(up).collect();
        ids.sort();
        ids
    }

    /// Waits until a bridge of a topic is up.
    ///
    /// # Errors
    /// When none is in time.
    pub fn wait_bridge(&self, topic: &str, deadline: Duration) -> anyhow::Result<()> {
        let start = format!("{topic}|");
        wait::until(
            &format!("a bridge of {topic} on {} is up", self.spec.node),
            deadline,
            || self.bridges_up().iter().any(|id| id.starts_with(&start)),
            || format!("{:?} {}", self.bridges(), self.tail()),
        )?;
        Ok(())
    }

    /// What `GET /v1/why` says.
    ///
    /// # Errors
    /// When nothing answers.
    pub fn why(&self, topic: &str, to: Option<&str>) -> anyhow::Result<Value> {
        let to = to.map(|to| format!("&to={to}")).unwrap_or_default();
        self.admin().json(&format!("/v1/why?topic={topic}{to}"))
    }

    /// Resident memory in KiB.
    ///
    /// # Errors
    /// When the process has gone.
    pub fn rss_kib(&self) -> anyhow::Result<u64> {
        let bytes = self.process.resident_bytes().context("the process has gone")?;
        Ok(bytes / 1024)
    }

    /// What it holds of the machine now.
    ///
    /// # Errors
    /// When the process has gone.
    pub fn usage(&self) -> anyhow::Result<Usage> {
        self.process.usage().context("the process has gone")
    }

    /// CPU time that it has used.
    ///
    /// # Errors
    /// When the process has gone.
    pub fn cpu(&self) -> anyhow::Result<Duration> {
        process::cpu_time(self.id())
    }
}

fn run(file: &Path, host: Option<&Host>) -> anyhow::Result<Process> {
    let namespace = host.map(|host| host.namespace.as_str());
    Process::start("blaze-flow", &["--config", &file.to_string_lossy()], namespace)
}

/// A DDS domain that nobody uses on loopback now, so that another run of these tests is no
/// neighbour.
///
/// # Errors
/// When there is none between 40 and 99.
pub fn free_domain() -> anyhow::Result<u16> {
    /// Locked files, one for each domain of this process: tests in other processes look for domains
    /// at the same time.
    static HELD: parking_lot::Mutex<Vec<File>> = parking_lot::Mutex::new(Vec::new());
    let folder = std::env::temp_dir().join("blaze-test-domains");
    std::fs::create_dir_all(&folder)?;
    let hold = |domain: u16| -> anyhow::Result<bool> {
        let file = File::create(folder.join(domain.to_string()))?;
        let is_ours = file.try_lock().is_ok();
        if is_ours {
            HELD.lock().push(file);
        }
        Ok(is_ours)
    };
    // SPDP and user traffic of the first three participants.
    let is_quiet = |domain: u16| {
        (10..16).all(|offset| {
            UdpSocket::bind((Ipv4Addr::LOCALHOST, 7_400 + 250 * domain + offset)).is_ok()
        })
    };
    let first = (std::process::id() % 60) as u16;
    for domain in (0..60).map(|step| 40 + (first + step) % 60) {
        if hold(domain)? && is_quiet(domain) {
            return Ok(domain);
        }
    }
    anyhow::bail!("no free DDS domain between 40 and 99")
}
