//! Nodes of the demo as processes, and what they print.

use std::path::Path;
use std::time::Duration;

use anyhow::Context as _;
use blaze_tests::admin::Admin;
pub(crate) use blaze_tests::flow::free_domain;
use blaze_tests::process::Process;
use blaze_tests::wait;
use serde_json::Value;

/// Where one flow must say `ready`, on a busy machine.
pub(crate) const START: Duration = Duration::from_secs(20);

/// The recording without the camera: IMU and odometry, 50 Hz each.
pub(crate) fn robot_recording() -> String {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    let file = tests.with_file_name("demo").join("data/jackal.mcap");
    file.to_string_lossy().into_owned()
}

/// How a node is started.
#[derive(Debug, Clone)]
pub(crate) struct Launch {
    pub(crate) node: &'static str,
    pub(crate) domain: u16,
    pub(crate) listen: String,
    pub(crate) peer: Option<String>,
    pub(crate) namespace: Option<String>,
    /// Without the camera.
    pub(crate) light: bool,
    pub(crate) settings: Vec<String>,
    pub(crate) duration_s: u32,
}

impl Launch {
    /// A node on loopback, without the camera, until it is ended.
    pub(crate) fn local(node: &'static str, domain: u16) -> Self {
        Self {
            node,
            domain,
            listen: "127.0.0.1".to_owned(),
            peer: Some("127.0.0.1".to_owned()),
            namespace: None,
            light: true,
            settings: Vec::new(),
            duration_s: 3600,
        }
    }

    /// Starts the process.
    pub(crate) fn start(&self) -> anyhow::Result<Node> {
        let domain = format!("brokers.inter.dds.domain={}", self.domain);
        let duration = format!("{}s", self.duration_s);
        let recording = robot_recording();
        let mut arguments = vec!["demo", "-o", "json", "--only", self.node, "--listen", &self.listen];
        arguments.extend(["--duration", &duration, "--set", &domain]);
        if let Some(peer) = &self.peer {
            arguments.extend(["--peer", peer]);
        }
        for setting in &self.settings {
            arguments.extend(["--set", setting]);
        }
        if self.light {
            arguments.extend(["--record", &recording]);
        }
        Ok(Node {
            name: self.node,
            process: Process::start("blaze", &arguments, self.namespace.as_deref())?,
            admin: None,
        })
    }
}

/// A process of `blaze demo --only NODE`.
pub(crate) struct Node {
    pub(crate) name: &'static str,
    pub(crate) process: Process,
    admin: Option<Admin>,
}

impl Node {
    /// Waits until it is ready.
    pub(crate) fn ready(&mut self) -> anyhow::Result<()> {
        let admin = self.process.node_ready(self.name, START)?;
        let asked = admin.clone();
        wait::until("/readyz says 200", START, || asked.ready(), || self.process.tail())?;
        self.admin = Some(admin);
        Ok(())
    }

    /// Its admin port, once it is ready.
    pub(crate) fn admin(&self) -> &Admin {
        self.admin.as_ref().expect("asked after ready()")
    }

    /// Whether its process has said `ready`; keeps the admin port when it has.
    pub(crate) fn poll_ready(&mut self) -> bool {
        if self.admin.is_none() {
            let start = format!("ready node={} ", self.name);
            let said = self.process.stderr().iter().any(|line| line.starts_with(&start));
            if !said || self.ready().is_err() {
                return false;
            }
        }
        true
    }

    /// Flows that it holds to be up.
    pub(crate) fn peers_up(&self) -> Vec<String> {
        let Ok(answer) = self.admin().json("/v1/peers") else {
            return Vec::new();
        };
        let peers = answer["peers"].as_array().cloned().unwrap_or_default();
        let up = peers.iter().filter(|peer| peer["state"] == "up");
        let mut names: Vec<String> = up.map(|peer| text(&peer["flow"])).collect();
        names.sort();
        names
    }

    /// Ids of its bridges, sorted.
    pub(crate) fn bridges(&self) -> Vec<String> {
        let mut ids: Vec<String> = self.bridge_list().iter().map(|bridge| text(&bridge["id"])).collect();
        ids.sort();
        ids
    }

    fn bridge_list(&self) -> Vec<Value> {
        let answer = self.admin().json("/v1/bridges").unwrap_or_default();
        answer["bridges"].as_array().cloned().unwrap_or_default()
    }

    /// Messages that came out of a bridge; 0 when there is none.
    pub(crate) fn bridged(&self, id: &str) -> u64 {
        let bridges = self.bridge_list();
        let bridge = bridges.iter().find(|bridge| bridge["id"] == id);
        bridge.and_then(|b| b["out"]["messages"].as_u64()).unwrap_or(0)
    }

    /// Wire bytes that it has computed since its start.
    pub(crate) fn wire_bytes(&self) -> u64 {
        let answer = self.admin().json("/v1/allocation").unwrap_or_default();
        answer["wire_bytes"].as_u64().unwrap_or(0)
    }

    /// The rows of each second of one topic and service.
    pub(crate) fn rows(&self, topic: &str, service: &str) -> Vec<Value> {
        let rows = self.lines().into_iter().filter(|line| line["kind"] == "row");
        rows.filter(|row| row["topic"] == topic && row["service"] == service)
            .collect()
    }

    fn lines(&self) -> Vec<Value> {
        let lines = self.process.stdout();
        lines
            .iter()
            .filter_map(|line| serde_json::from_str(line).ok())
            .collect()
    }

    /// Ends it and gives what its summary says of one topic and service.
    pub(crate) fn end(&mut self) -> anyhow::Result<Summary> {
        let code = self.process.terminate(Duration::from_secs(15))?;
        let summary = self.lines().into_iter().find(|line| line["kind"] == "summary");
        let summary = summary.with_context(|| format!("no summary. {}", self.process.tail()))?;
        anyhow::ensure!(code.is_some(), "{} was ended by a signal", self.name);
        Ok(Summary { value: summary })
    }
}

/// The last line of a node.
#[derive(Debug)]
pub(crate) struct Summary {
    pub(crate) value: Value,
}

impl Summary {
    /// What it says of a topic at a service.
    pub(crate) fn topic(&self, topic: &str, service: &str) -> anyhow::Result<&Value> {
        let topics = self.value["topics"].as_array().map(Vec::as_slice).unwrap_or_default();
        topics
            .iter()
            .find(|row| row["topic"] == topic && row["service"] == service)
            .ok_or_else(|| anyhow::anyhow!("no {topic} at {service} in {}", self.value))
    }

    /// Messages that were published, as the publishing process says.
    pub(crate) fn sent(&self, topic: &str) -> u64 {
        let topics = self.value["topics"].as_array().map(Vec::as_slice).unwrap_or_default();
        let row = topics.iter().find(|row| row["topic"] == topic);
        row.and_then(|row| row["sent"].as_u64()).unwrap_or(0)
    }
}

/// A number of a row; 0 where it is absent.
pub(crate) fn count(row: &Value, field: &str) -> u64 {
    row[field].as_u64().unwrap_or(0)
}

/// Text of a JSON string.
pub(crate) fn text(value: &Value) -> String {
    value.as_str().unwrap_or_default().to_owned()
}

/// The value that a share (0 to 1) of all does not exceed; 0 without any.
pub(crate) fn percentile(values: &mut [f64], share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let rank = ((share * values.len() as f64).ceil() as usize).max(1);
    values.get(rank - 1).copied().unwrap_or(0.0)
}
