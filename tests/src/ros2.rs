//! Nodes of ROS 2 for tests: rclpy of two releases with Fast DDS, Cyclone DDS in the manner of
//! rmw_cyclonedds, and Fast DDS without ROS, from what `scripts/services install` gets.
//!
//! A [`Peer`] is a process with any number of nodes; its commands are those of
//! `tests/peers/peer.py`.

use std::net::Ipv4Addr;
use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use anyhow::Context as _;
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD as BASE64;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::dialogue::Dialogue;
use crate::network::{self, Host};
use crate::servers::installed;
use crate::wait;

/// Python and its packages take half a second to load; the rest is for a machine that does much
/// else.
const START: Duration = Duration::from_secs(30);
/// An answer takes milliseconds, but for a node that starts or ends on a busy machine.
const ANSWER: Duration = Duration::from_secs(30);
/// Room for the packet filters of a flow.
const OPTIONS_ROOM: u32 = 131_072;

/// The programs of a peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Release {
    /// rclpy of Jazzy on Fast DDS 2.
    Jazzy,
    /// rclpy of Kilted on Fast DDS 3.
    Kilted,
    /// Cyclone DDS, which knows no graph and no actions.
    Cyclone,
    /// A C++ program on Fast DDS alone, which tells no node and knows no services.
    FastDds,
}

impl Release {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Jazzy, Self::Kilted, Self::Cyclone, Self::FastDds];

    fn packages(self) -> &'static str {
        match self {
            Self::Jazzy | Self::Cyclone | Self::FastDds => "jazzy",
            Self::Kilted => "kilted",
        }
    }

    /// Fast DDS 2 knows the old name alone.
    fn profile_variable(self) -> &'static str {
        match self {
            Self::Jazzy | Self::Cyclone | Self::FastDds => "FASTRTPS_DEFAULT_PROFILES_FILE",
            Self::Kilted => "FASTDDS_DEFAULT_PROFILES_FILE",
        }
    }

    fn program(self) -> &'static str {
        match self {
            Self::Jazzy | Self::Kilted => "ros2_peer.py",
            Self::Cyclone => "cyclone_peer.py",
            Self::FastDds => "fastdds_peer.py",
        }
    }
}

/// Quality of service; the default is that of ROS.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Quality {
    /// RELIABLE, else BEST_EFFORT.
    pub reliable: bool,
    /// TRANSIENT_LOCAL, else VOLATILE.
    pub durable: bool,
    /// KEEP_LAST.
    pub depth: u32,
    /// Deadline; 0 = none.
    pub deadline_ms: u64,
    /// Lease of liveliness; 0 = none.
    pub lease_ms: u64,
    /// Lifespan; 0 = none.
    pub lifespan_ms: u64,
}

impl Default for Quality {
    fn default() -> Self {
        Self {
            reliable: true,
            durable: false,
            depth: 10,
            deadline_ms: 0,
            lease_ms: 0,
            lifespan_ms: 0,
        }
    }
}

/// Messages with random values, about `size` bytes each.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Stream {
    /// How many.
    pub count: usize,
    /// Bytes of each.
    pub size: usize,
    /// Messages a second; 0 = without a pause.
    pub hz: f64,
    /// Equal ones give equal messages.
    pub seed: u64,
}

/// Length and SHA-256 of a message, padded to a multiple of 4 as DDS may do.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Deserialize)]
pub struct Message(pub usize, pub String);

/// Readies a host of a network for ROS 2 on its loopback alone.
///
/// # Errors
/// When the system refuses.
pub fn open_loopback(host: &Host) -> anyhow::Result<()> {
    let namespace = &host.namespace;
    network::run(&format!("ip -n {namespace} link set lo multicast on"))?;
    network::run(&format!("ip -n {namespace} route add 224.0.0.0/4 dev lo"))?;
    open_switch(host)
}

/// Readies a host of a network for ROS 2 on its switch.
///
/// # Errors
/// When the system refuses.
pub fn open_switch(host: &Host) -> anyhow::Result<()> {
    network::inside(&host.namespace, || {
        // Older kernels give a sixth of it.
        const SETTING: &str = "/proc/sys/net/core/optmem_max";
        let room: u32 = std::fs::read_to_string(SETTING)?.trim().parse()?;
        if room < OPTIONS_ROOM {
            std::fs::write(SETTING, OPTIONS_ROOM.to_string())?;
        }
        Ok(())
    })
}

/// A running peer; it is killed when dropped.
pub struct Peer {
    /// Its programs.
    pub release: Release,
    dialogue: Dialogue,
    next: AtomicU32,
    _profile: TempDir,
}

impl Peer {
    /// Starts one without a node on the loopback of a host.
    ///
    /// # Errors
    /// When its packages are not installed, or it does not start.
    pub fn start(release: Release, host: &Host, domain: u16) -> anyhow::Result<Self> {
        Self::launch(release, host, Ipv4Addr::LOCALHOST, domain, true)
    }

    /// The same on the switch of a host.
    ///
    /// # Errors
    /// As [`Peer::start`].
    pub fn start_on_switch(release: Release, host: &Host, domain: u16) -> anyhow::Result<Self> {
        Self::launch(release, host, host.address, domain, true)
    }

    /// The same, as one that sends no type objects: Cyclone DDS refuses those of Fast DDS 3 where
    /// it has one of its own, which rmw_cyclonedds has not.
    ///
    /// # Errors
    /// As [`Peer::start`].
    pub fn start_untyped(release: Release, host: &Host, domain: u16) -> anyhow::Result<Self> {
        Self::launch(release, host, Ipv4Addr::LOCALHOST, domain, false)
    }

    fn launch(
        release: Release,
        host: &Host,
        interface: Ipv4Addr,
        domain: u16,
        types: bool,
    ) -> anyhow::Result<Self> {
        let programs = Path::new(env!("CARGO_MANIFEST_DIR")).join("peers");
        let python = installed::path(&format!("ros/{}/bin/python", release.packages()))?;
        let folder = tempfile::tempdir()?;
        let profile = folder.path().join("fastdds.xml");
        let text = std::fs::read_to_string(programs.join("fastdds.xml"))?
            .replace("INTERFACE", &interface.to_string())
            .replace("TYPES", if types { "enabled" } else { "disabled" });
        std::fs::write(&profile, text)?;
        let mut command = network::program(Some(&host.namespace), python);
        command
            .arg("-B")
            .arg(programs.join(release.program()))
            .env("ROS_DOMAIN_ID", domain.to_string())
            .env("ROS_LOG_DIR", folder.path())
            .env(release.profile_variable(), &profile)
            .env(
                "CYCLONEDDS_URI",
                format!(
                    "<General><Interfaces><NetworkInterface address='{interface}' \
                     multicast='true'/></Interfaces></General><Internal><SocketReceiveBufferSize \
                     min='4MB'/></Internal>"
                ),
            );
        if release == Release::FastDds {
            command.arg(installed::path("bin/fastdds-peer")?);
        }
        let (dialogue, ready) = Dialogue::start(&format!("{release:?}"), command, START)?;
        anyhow::ensure!(ready["ready"].is_string(), "{release:?} says {ready}");
        Ok(Self { release, dialogue, next: AtomicU32::new(0), _profile: folder })
    }

    /// The answer to any command.
    ///
    /// # Errors
    /// With what the peer says.
    pub fn ask(&self, command: &Value) -> anyhow::Result<Value> {
        self.ask_within(command, ANSWER)
    }

    fn ask_within(&self, command: &Value, deadline: Duration) -> anyhow::Result<Value> {
        let answer = self.dialogue.ask(command, deadline)?;
        anyhow::ensure!(answer["error"].is_null(), "{:?}: {command}: {answer}", self.release);
        Ok(answer)
    }

    /// Starts a node in the root namespace.
    ///
    /// # Errors
    /// As [`Peer::ask`]; so with all other calls.
    pub fn node(&self, name: &str) -> anyhow::Result<()> {
        self.ask(&json!({ "op": "node", "node": name })).map(drop)
    }

    /// Ends a node with all that it has.
    ///
    /// # Errors
    /// As [`Peer::ask`].
    pub fn end_node(&self, name: &str) -> anyhow::Result<()> {
        self.ask(&json!({ "op": "destroy", "name": name })).map(drop)
    }

    /// Makes a publisher. ROS names begin with a slash.
    ///
    /// # Errors
    /// As [`Peer::ask`].
    pub fn publisher(
        &self,
        node: &str,
        topic: &str,
        kind: &str,
        quality: Quality,
    ) -> anyhow::Result<End<'_>> {
        self.end(json!({
            "op": "publisher", "node": node, "topic": topic, "type": kind, "qos": quality,
        }))
    }

    /// Makes a subscription.
    ///
    /// # Errors
    /// As [`Peer::ask`].
    pub fn subscription(
        &self,
        node: &str,
        topic: &str,
        kind: &str,
        quality: Quality,
    ) -> anyhow::Result<End<'_>> {
        self.end(json!({
            "op": "subscription", "node": node, "topic": topic, "type": kind, "qos": quality,
        }))
    }

    /// Makes any endpoint; gives it a name.
    ///
    /// # Errors
    /// As [`Peer::ask`].
    pub fn end(&self, mut command: Value) -> anyhow::Result<End<'_>> {
        let name = format!("end {}", self.next.fetch_add(1, Ordering::Relaxed));
        command["name"] = json!(name);
        self.ask(&command)?;
        Ok(End { peer: self, name })
    }

    /// Lets clients call their services, all at once, and each so many times. An integer `field`
    /// tells each request from all others. Gives how many got their own reply, and faults of some
    /// that did not.
    ///
    /// # Errors
    /// As [`Peer::ask`], and when that takes longer than `deadline`.
    pub fn call_all(
        &self,
        clients: &[End<'_>],
        field: &str,
        count: usize,
        deadline: Duration,
    ) -> anyhow::Result<(usize, Vec<String>)> {
        let names: Vec<&str> = clients.iter().map(|client| &*client.name).collect();
        let timeout = u64::try_from(ANSWER.as_millis())?;
        self.ask(&json!({
            "op": "calls", "names": names, "field": field, "count": count, "timeout_ms": timeout,
        }))?;
        let called = || self.ask(&json!({ "op": "called" })).ok();
        let ended = || called().filter(|answer| answer["busy"] == false);
        let what = format!("the calls of {:?}", self.release);
        let answer = wait::until_some(&what, deadline, ended, || format!("{:?}", called()))?;
        let answered = answer["answered"].as_u64().context("no count")?;
        Ok((usize::try_from(answered)?, Vec::deserialize(&answer["faults"])?))
    }

    /// Its process id. `ip netns exec` replaces itself.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.dialogue.id()
    }

    /// Ends it as a node ends that is asked to: it leaves the network in order.
    ///
    /// # Errors
    /// When it does not end in time.
    pub fn finish(mut self) -> anyhow::Result<()> {
        self.dialogue.finish(ANSWER)
    }
}

/// An endpoint of a peer; it stays until [`End::destroy`], or as long as its node.
pub struct End<'a> {
    peer: &'a Peer,
    name: String,
}

impl End<'_> {
    fn ask(&self, command: Value) -> anyhow::Result<Value> {
        self.ask_within(command, ANSWER)
    }

    /// The answer to any command that may take a while.
    ///
    /// # Errors
    /// As [`Peer::ask`].
    pub fn ask_within(&self, mut command: Value, deadline: Duration) -> anyhow::Result<Value> {
        command["name"] = json!(self.name);
        self.peer.ask_within(&command, deadline)
    }

    /// Publishes messages, and does not wait until all are.
    ///
    /// # Errors
    /// As [`Peer::ask`]; so with all other calls.
    pub fn publish(&self, stream: Stream) -> anyhow::Result<()> {
        let mut command = json!(stream);
        command["op"] = json!("publish");
        self.ask(command).map(drop)
    }

    /// Publishes one message: CDR with its encapsulation.
    ///
    /// # Errors
    /// As [`Peer::ask`].
    pub fn send(&self, cdr: &[u8]) -> anyhow::Result<()> {
        self.ask(json!({ "op": "publish", "data": BASE64.encode(cdr) })).map(drop)
    }

    /// Publishes messages and waits until all are; gives those.
    ///
    /// # Errors
    /// As [`End::publish`].
    pub fn publish_all(&self, stream: Stream) -> anyhow::Result<Vec<Message>> {
        let before = self.log()?.len();
        self.publish(stream)?;
        let sent = || {
            let answer = self.ask(json!({ "op": "log", "from": before })).ok()?;
            let messages = Vec::<Message>::deserialize(&answer["messages"]).ok()?;
            (answer["busy"] == false).then_some(messages)
        };
        let pause = if stream.hz > 0.0 { stream.count as f64 / stream.hz } else { 0.0 };
        let deadline = ANSWER + Duration::from_secs_f64(pause);
        wait::until_some("all is published", deadline, sent, String::new)
    }

    /// What it has published or received so far, in order.
    ///
    /// # Errors
    /// As [`End::publish`].
    pub fn log(&self) -> anyhow::Result<Vec<Message>> {
        let answer = self.ask(json!({ "op": "log" }))?;
        Ok(Vec::deserialize(&answer["messages"])?)
    }

    /// Waits until a subscription has received so many; gives all that it has.
    ///
    /// # Errors
    /// As [`End::publish`], and with the number that it has received.
    pub fn received(&self, count: usize, deadline: Duration) -> anyhow::Result<Vec<Message>> {
        let mut last = 0;
        wait::until_some(
            &format!("{count} messages at {:?}", self.peer.release),
            deadline,
            || {
                let log = self.log().ok()?;
                last = log.len();
                (log.len() >= count).then_some(log)
            },
            String::new,
        )
        .with_context(|| format!("{last} were received"))
    }

    /// Endpoints on the other side that it has met.
    ///
    /// # Errors
    /// As [`End::publish`].
    pub fn matched(&self) -> anyhow::Result<u64> {
        self.ask(json!({ "op": "matched" }))?["count"].as_u64().context("no count")
    }

    /// Waits until it has met so many, exactly.
    ///
    /// # Errors
    /// As [`End::publish`].
    pub fn wait_matched(&self, count: u64, deadline: Duration) -> anyhow::Result<Duration> {
        wait::until(
            &format!("an endpoint of {:?} has met {count} others", self.peer.release),
            deadline,
            || self.matched().is_ok_and(|met| met == count),
            || format!("It has met {:?}.", self.matched()),
        )
    }

    /// Whether a service or an action has a server, seen from its client.
    ///
    /// # Errors
    /// As [`End::publish`].
    pub fn available(&self) -> anyhow::Result<bool> {
        Ok(self.ask(json!({ "op": "available" }))?["ready"] == true)
    }

    /// Waits until a service or an action has a server, or none, seen from its client.
    ///
    /// # Errors
    /// When that takes longer than `deadline`.
    pub fn wait_available(&self, has: bool, deadline: Duration) -> anyhow::Result<Duration> {
        let is_so = || self.available().is_ok_and(|available| available == has);
        let word = if has { "a" } else { "no" };
        let what = format!("a client of {:?} sees {word} server", self.peer.release);
        wait::until(&what, deadline, is_so, String::new)
    }

    /// Calls a service and gives its reply.
    ///
    /// # Errors
    /// As [`End::publish`], and when no reply comes in time.
    pub fn call(&self, request: &Value, timeout: Duration) -> anyhow::Result<Value> {
        let timeout = u64::try_from(timeout.as_millis())?;
        let mut answer =
            self.ask(json!({ "op": "call", "request": request, "timeout_ms": timeout }))?;
        Ok(answer["reply"].take())
    }

    /// Requests that a server has executed.
    ///
    /// # Errors
    /// As [`End::publish`].
    pub fn served(&self) -> anyhow::Result<u64> {
        self.ask(json!({ "op": "served" }))?["count"].as_u64().context("no count")
    }

    /// Removes it from its node.
    ///
    /// # Errors
    /// As [`End::publish`].
    pub fn destroy(self) -> anyhow::Result<()> {
        self.ask(json!({ "op": "destroy" })).map(drop)
    }
}
