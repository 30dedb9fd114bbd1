//! Network namespaces joined by veth pairs: several hosts on one machine.

use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};

use anyhow::Context;

static NEXT: AtomicU32 = AtomicU32::new(0);

/// Runs a command.
///
/// # Errors
/// When it fails; the message holds what it printed.
pub fn run(command: &str) -> anyhow::Result<String> {
    let output = Command::new("bash")
        .args(["-c", command])
        .output()
        .with_context(|| command.to_owned())?;
    let text = format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    anyhow::ensure!(output.status.success(), "{command}: {text}");
    Ok(text)
}

/// Two hosts and the wire between them.
pub struct Pair {
    /// Names of the two namespaces.
    pub names: [String; 2],
    /// Their addresses.
    pub addresses: [String; 2],
}

impl Pair {
    /// Makes two namespaces with one veth pair; the interface is `v0` in both.
    ///
    /// # Errors
    /// When the machine does not allow it: namespaces need root and iproute2.
    pub fn new() -> anyhow::Result<Self> {
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let id = std::process::id();
        let names = [format!("blaze-{id}-{number}a"), format!("blaze-{id}-{number}b")];
        let net = 16 + (id + number) % 200;
        let addresses = [format!("10.199.{net}.1"), format!("10.199.{net}.2")];
        let pair = Self { names, addresses };
        let [a, b] = &pair.names;
        run(&format!(
            "ip netns add {a} && ip netns add {b} && ip -n {a} link add v0 type veth peer name v0 netns {b}"
        ))?;
        for (name, address) in pair.names.iter().zip(&pair.addresses) {
            run(&format!(
                "ip -n {name} addr add {address}/24 dev v0 && ip -n {name} link set v0 up && ip -n {name} link set lo up"
            ))?;
        }
        Ok(pair)
    }

    /// Ethernet payload bytes and packets that a host's interface has sent.
    ///
    /// # Errors
    /// When the namespace has gone.
    pub fn sent(&self, host: usize) -> anyhow::Result<(u64, u64)> {
        let name = &self.names[host];
        let text = run(&format!(
            "ip netns exec {name} cat /sys/class/net/v0/statistics/tx_bytes /sys/class/net/v0/statistics/tx_packets"
        ))?;
        let numbers: Vec<u64> = text.split_whitespace().map(str::parse).collect::<Result<_, _>>()?;
        let [bytes, packets] = numbers[..] else {
            anyhow::bail!("two numbers expected: {text}")
        };
        const ETHERNET_HEADER: u64 = 14;
        Ok((bytes.saturating_sub(packets * ETHERNET_HEADER), packets))
    }

    /// Drops a part of the UDP packets that arrive at a host, silently; 0 ends it.
    ///
    /// # Errors
    /// When nftables is missing or refuses.
    pub fn lose(&self, host: usize, per_mille: u32) -> anyhow::Result<()> {
        let name = &self.names[host];
        run(&format!("ip netns exec {name} nft flush ruleset"))?;
        if per_mille == 0 {
            return Ok(());
        }
        run(&format!(
            "ip netns exec {name} nft 'add table ip loss; add chain ip loss input {{ type filter hook input priority 0 ; }}; \
             add rule ip loss input meta l4proto udp iifname v0 numgen random mod 1000 < {per_mille} counter drop'"
        ))?;
        Ok(())
    }
}

impl Drop for Pair {
    fn drop(&mut self) {
        for name in &self.names {
            let _ = run(&format!("ip netns del {name}"));
        }
    }
}

/// Several hosts on one switch, without multicast, as where they are joined by routers.
pub struct Lan {
    switch: String,
    /// Names of the namespaces.
    pub names: Vec<String>,
    /// Their addresses.
    pub addresses: Vec<String>,
}

impl Lan {
    /// Makes namespaces with one interface `v0` each.
    ///
    /// # Errors
    /// As [`Pair::new`]; nftables is needed, too.
    pub fn new(hosts: usize) -> anyhow::Result<Self> {
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let id = std::process::id();
        let net = 16 + (id + number) % 200;
        let lan = Self {
            switch: format!("blaze-{id}-{number}s"),
            names: (0..hosts).map(|host| format!("blaze-{id}-{number}h{host}")).collect(),
            addresses: (1..=hosts).map(|host| format!("10.199.{net}.{host}")).collect(),
        };
        let switch = &lan.switch;
        run(&format!(
            "ip netns add {switch} && ip -n {switch} link add b0 type bridge && ip -n {switch} link set b0 up"
        ))?;
        for (host, (name, address)) in lan.names.iter().zip(&lan.addresses).enumerate() {
            run(&format!(
                "ip netns add {name} && ip -n {name} link add v0 type veth peer name p{host} netns {switch} && \
                 ip -n {switch} link set p{host} master b0 && ip -n {switch} link set p{host} up && \
                 ip -n {name} addr add {address}/24 dev v0 && ip -n {name} link set v0 up && \
                 ip -n {name} link set lo up && \
                 ip netns exec {name} nft 'add table ip routed; \
                 add chain ip routed output {{ type filter hook output priority 0 ; }}; \
                 add rule ip routed output ip daddr 224.0.0.0/4 oifname v0 drop'"
            ))?;
        }
        Ok(lan)
    }
}

impl Drop for Lan {
    fn drop(&mut self) {
        for name in self.names.iter().chain([&self.switch]) {
            let _ = run(&format!("ip netns del {name}"));
        }
    }
}

/// Refuses with a sentence for people where namespaces cannot be made.
///
/// # Errors
/// When this is not root, or iproute2 or nftables is missing.
pub fn check_rights() -> anyhow::Result<()> {
    let user = run("id -u")?;
    anyhow::ensure!(
        user.trim() == "0",
        "this test makes network namespaces and must be run by root: `sudo -E env PATH=\"$PATH\" cargo test -p blaze-tests --test e2e`"
    );
    for tool in ["ip", "nft"] {
        anyhow::ensure!(
            run(&format!("command -v {tool}")).is_ok(),
            "`{tool}` is missing: run `apt-get install -y iproute2 nftables`"
        );
    }
    Ok(())
}

/// What an interface had sent at some time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// When the counter was read: seconds since 1970, right within [`Sample::MAX_ERROR_S`].
    pub at_s: f64,
    /// Ethernet payload bytes.
    pub bytes: u64,
    /// Packets.
    pub packets: u64,
}

impl Sample {
    /// Samples whose time is less certain, because their reader had to wait for the processor, are left out.
    pub const MAX_ERROR_S: f64 = 0.000_5;
}

/// Reads a host's counter again and again, from a process in its namespace so that no start of a process stands between
/// the clock and the counter. It ends when dropped.
pub struct Meter {
    child: std::process::Child,
    samples: std::sync::Arc<std::sync::Mutex<Vec<Sample>>>,
}

impl Meter {
    /// Starts to read the counter of `v0` every `period_ms`.
    ///
    /// # Errors
    /// When the namespace has gone.
    pub fn start(namespace: &str, period_ms: u32) -> anyhow::Result<Self> {
        let script = format!(
            "cd /sys/class/net/v0/statistics; exec 3<> <(:); \
             while :; do read -r p < tx_packets; s=$EPOCHREALTIME; read -r b < tx_bytes; echo $s $EPOCHREALTIME $b $p; \
             read -r -t {}.{:03} -u 3; done",
            period_ms / 1000,
            period_ms % 1000
        );
        let mut child = Command::new("ip")
            .args(["netns", "exec", namespace, "bash", "-c", &script])
            .stdin(std::process::Stdio::null())
            .stdout(std::process::Stdio::piped())
            .spawn()?;
        let samples = std::sync::Arc::<std::sync::Mutex<Vec<Sample>>>::default();
        let kept = std::sync::Arc::clone(&samples);
        let out = child.stdout.take().context("no output")?;
        std::thread::spawn(move || {
            use std::io::BufRead as _;
            for line in std::io::BufReader::new(out).lines().map_while(Result::ok) {
                let mut kept = kept.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                kept.extend(parse_sample(&line));
            }
        });
        Ok(Self { child, samples })
    }

    /// What was read so far.
    #[must_use]
    pub fn samples(&self) -> Vec<Sample> {
        self.samples
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
            .clone()
    }
}

impl Drop for Meter {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn parse_sample(line: &str) -> Option<Sample> {
    const ETHERNET_HEADER: u64 = 14;
    let mut words = line.split_whitespace();
    let before: f64 = words.next()?.parse().ok()?;
    let after: f64 = words.next()?.parse().ok()?;
    let bytes: u64 = words.next()?.parse().ok()?;
    let packets: u64 = words.next()?.parse().ok()?;
    if after - before > 2.0 * Sample::MAX_ERROR_S {
        return None;
    }
    Some(Sample {
        at_s: (before + after) / 2.0,
        bytes: bytes.saturating_sub(packets * ETHERNET_HEADER),
        packets,
    })
}
