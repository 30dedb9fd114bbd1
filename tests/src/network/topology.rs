//! A network of namespaces.

use std::net::Ipv4Addr;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use anyhow::Context as _;

use super::link::{Link, LinkProcess};
use super::namespace::{Namespace, batch, check_rights, run};
use super::plan::Plan;
use super::routes::{Network, networks, routes};
use crate::wait;

/// Packets that a device holds for `blaze-wan` while it waits for the processor: 10,000 are 90 ms
/// at 160 Mbit/s.
const DEVICE_QUEUE: u32 = 10_000;

/// Measured: at most 1 s. The rest is for a machine that does much else.
const PORTS: Duration = Duration::from_secs(10);

/// A host: its namespace, and the address under which everybody reaches it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Host {
    /// As in the plan.
    pub name: String,
    /// As `ip netns list` names it.
    pub namespace: String,
    /// That of its first interface; what it sends itself comes from there.
    pub address: Ipv4Addr,
}

/// A running network. It goes when dropped, also after a panic, and when this process dies.
pub struct Topology {
    // Fields are dropped in this order: links before the namespaces that they join.
    links: Vec<LinkProcess>,
    hosts: Vec<Host>,
    _namespaces: Vec<Namespace>,
}

impl Topology {
    /// Builds what a plan says. Nothing of it is seen outside, so networks of several tests, and of
    /// several runs, live side by side with the same addresses.
    ///
    /// # Errors
    /// When the plan has faults, or the machine does not allow it: namespaces need root and
    /// iproute2, links `/dev/net/tun`.
    pub fn build(plan: &Plan) -> anyhow::Result<Self> {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        check_rights()?;
        let networks = networks(plan)?;
        let prefix =
            format!("blaze-{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        let mut namespaces = Vec::new();
        let mut hosts = Vec::new();
        for (index, name) in plan.hosts.iter().enumerate() {
            let namespace = Namespace::new(format!("{prefix}t{index}"))?;
            let first = |network: &Network| {
                network.members.iter().find(|member| member.host == index).cloned()
            };
            let first = networks.iter().find_map(first).context("a host without an interface")?;
            hosts.push(Host {
                name: name.clone(),
                namespace: namespace.name().to_owned(),
                address: first.address,
            });
            namespaces.push(namespace);
        }
        if !plan.segments.is_empty() {
            let switch = Namespace::new(format!("{prefix}ts"))?;
            build_segments(plan, &networks, &hosts, &switch)?;
            namespaces.push(switch);
        }
        let mut links = Vec::new();
        for (link, network) in plan.links.iter().zip(&networks[plan.segments.len()..]) {
            links.push(build_link(link, network, &hosts)?);
        }
        for (index, host) in hosts.iter().enumerate() {
            let lines = routes(index, &networks)?.into_iter().map(|route| {
                format!(
                    "route add {}/{} via {} dev {} src {}",
                    route.to, route.bits, route.via, route.interface, host.address
                )
            });
            batch(&host.namespace, &lines.collect::<Vec<_>>())?;
        }
        Ok(Self { links, hosts, _namespaces: namespaces })
    }

    /// A host by its name.
    ///
    /// # Errors
    /// When the plan has none of that name.
    pub fn host(&self, name: &str) -> anyhow::Result<&Host> {
        let host = self.hosts.iter().find(|host| host.name == name);
        host.with_context(|| format!("{name} is no host"))
    }

    /// The link between two hosts, seen from the first: forward is from `a` to `b`, however the
    /// plan names them.
    ///
    /// # Errors
    /// When the plan has none.
    pub fn link(&self, a: &str, b: &str) -> anyhow::Result<Link<'_>> {
        let link = self.links.iter().find_map(|link| link.seen_from(a, b));
        link.with_context(|| format!("{a} and {b} are joined by no link"))
    }
}

/// One bridge for each segment, all in one namespace.
fn build_segments(
    plan: &Plan,
    networks: &[Network],
    hosts: &[Host],
    switch: &Namespace,
) -> anyhow::Result<()> {
    let mut ports = Vec::new();
    for (number, (segment, network)) in plan.segments.iter().zip(networks).enumerate() {
        ports.push(format!("link add b{number} type bridge mcast_snooping 0"));
        ports.push(format!("link set b{number} up"));
        let flood = if segment.multicast { "on" } else { "off" };
        for (position, member) in network.members.iter().enumerate() {
            let (port, name) = (format!("p{number}-{position}"), &member.name);
            let mut lines = vec![
                format!("link add {name} type veth peer name {port} netns {}", switch.name()),
                format!("addr add {}/{} dev {name}", member.address, network.bits),
                format!("link set {name} up"),
            ];
            // Programs that name no interface send multicast where there is a route for it.
            if segment.multicast && hosts[member.host].address == member.address {
                lines.push(format!("route add 224.0.0.0/4 dev {name}"));
            }
            batch(&hosts[member.host].namespace, &lines)?;
            ports.push(format!("link set {port} master b{number}"));
            ports.push(format!("link set dev {port} type bridge_slave mcast_flood {flood}"));
            ports.push(format!("link set {port} up"));
        }
    }
    batch(switch.name(), &ports)?;
    let members: usize = plan.segments.iter().map(|segment| segment.members.len()).sum();
    forwarding(switch, members)
}

/// Waits until every port of the switches forwards: the kernel opens them up to a second after they
/// were set up, and until then multicast is lost without a word.
fn forwarding(switch: &Namespace, ports: usize) -> anyhow::Result<()> {
    let list = || {
        run(&format!("ip -n {} -d link show type bridge_slave", switch.name())).unwrap_or_default()
    };
    wait::until(
        "every port of the switches forwards",
        PORTS,
        || list().matches("bridge_slave state forwarding").count() == ports,
        list,
    )?;
    Ok(())
}

fn build_link(
    link: &super::WanLink,
    network: &Network,
    hosts: &[Host],
) -> anyhow::Result<LinkProcess> {
    let [a, b] = &network.members[..] else { anyhow::bail!("a link has two ends") };
    let process = LinkProcess::start(
        link,
        (&hosts[a.host].namespace, &a.name),
        (&hosts[b.host].namespace, &b.name),
    )?;
    for end in [a, b] {
        let lines = [
            format!("addr add {}/{} dev {}", end.address, network.bits, end.name),
            format!("link set {} txqueuelen {DEVICE_QUEUE}", end.name),
        ];
        batch(&hosts[end.host].namespace, &lines)?;
    }
    Ok(process)
}
