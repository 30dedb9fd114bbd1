//! Hosts that are joined by one wire or one switch, without routers.

use std::sync::atomic::{AtomicU32, Ordering};

use super::namespace::run;

static NEXT: AtomicU32 = AtomicU32::new(0);

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
