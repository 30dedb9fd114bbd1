//! `dds_interface`, `multicast` and `udp_buffers`.

use std::io;
use std::net::{Ipv4Addr, UdpSocket};
use std::path::{Path, PathBuf};
use std::time::Instant;

use blaze_domain::node_file::{LayerBroker, NodeFile};
use nix::net::if_::InterfaceFlags;
use socket2::SockRef;

use super::check::{Finding, named};
use super::limits::{APART, LARGE_BUFFER, MULTICAST_ANSWER, SMALL_BUFFER};
use super::{Node, on_thread};

/// The group that DDS announces itself to.
const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);

/// An interface of this machine with one of its IPv4 addresses.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Interface {
    name: String,
    address: Ipv4Addr,
    flags: InterfaceFlags,
}

/// An address that the node file names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Wanted {
    key: &'static str,
    address: Ipv4Addr,
    /// Others are found by multicast there.
    multicast: bool,
}

fn wanted(file: &NodeFile) -> Vec<Wanted> {
    let brokers = &file.brokers;
    let mut all = Vec::new();
    if let Some(LayerBroker::Dds(dds)) = &brokers.layer {
        let (key, address) = ("brokers.layer.dds.interface", dds.interface);
        all.push(Wanted { key, address, multicast: true });
    }
    if let Some(inter) = &brokers.inter {
        let (key, address) = ("brokers.inter.dds.listen", inter.listen);
        all.push(Wanted { key, address, multicast: false });
    }
    if let Some(ros2) = &brokers.ros2 {
        let (key, address) = ("brokers.plugins[0].ros2.interface", ros2.interface);
        all.push(Wanted { key, address, multicast: ros2.peers.is_empty() });
    }
    all
}

fn interfaces() -> io::Result<Vec<Interface>> {
    let all = nix::ifaddrs::getifaddrs().map_err(io::Error::from)?;
    let read = |found: nix::ifaddrs::InterfaceAddress| {
        let address = found.address?.as_sockaddr_in()?.ip();
        Some(Interface { name: found.interface_name, address, flags: found.flags })
    };
    Ok(all.filter_map(read).collect())
}

/// `dds_interface`: each address of the file is on an interface that is up.
pub(super) async fn dds_interface(node: &Node) -> Vec<Finding> {
    let wanted = wanted(&node.file);
    if wanted.is_empty() {
        return vec![no_dds(&node.name)];
    }
    match on_thread(interfaces).await {
        Some(Ok(found)) => {
            wanted.iter().map(|wanted| interface_of(*wanted, &found, &node.name)).collect()
        }
        Some(Err(error)) => vec![unreadable(&error)],
        None => vec![unreadable(&io::Error::other("no thread"))],
    }
}

fn no_dds(file: &str) -> Finding {
    Finding::skipped(
        "the node file uses no DDS",
        format!("nothing to do; to reach other layers set brokers.inter.dds in {file}"),
    )
}

fn unreadable(error: &io::Error) -> Finding {
    Finding::skipped(format!("the interfaces cannot be read: {error}"), "ip -4 address")
}

fn interface_of(wanted: Wanted, all: &[Interface], file: &str) -> Finding {
    let Wanted { key, address, .. } = wanted;
    let Some(found) = all.iter().find(|found| found.address == address) else {
        let others = all.iter().filter(|found| !found.flags.contains(InterfaceFlags::IFF_LOOPBACK));
        let others: Vec<&Interface> = others.collect();
        let listed: Vec<String> =
            others.iter().map(|found| format!("{} {}", found.name, found.address)).collect();
        let remedy = match others.first() {
            Some(first) => format!("set {key}: {} in {file}", first.address),
            None => format!("ip address add {address}/24 dev INTERFACE"),
        };
        let here = if listed.is_empty() { "none".to_owned() } else { named(&listed) };
        return Finding::fail(format!("no interface has {address} ({key}); here: {here}"), remedy);
    };
    let Interface { name, flags, .. } = found;
    if !flags.contains(InterfaceFlags::IFF_UP) {
        let detail = format!("{name} with {address} ({key}) is down");
        return Finding::fail(detail, format!("ip link set {name} up"));
    }
    if !flags.contains(InterfaceFlags::IFF_RUNNING) {
        return Finding::warn(
            format!("{name} with {address} ({key}) has no carrier"),
            format!("plug in its cable or join its wireless network: ip link show {name}"),
        );
    }
    Finding::ok(format!("{key}: {name} {address}"))
}

/// What came of a join and a packet to ourselves.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Multicast {
    Works,
    NoJoin(String),
    NoReturn(String),
}

/// `multicast`: a join, and a packet that comes back, on each interface where others are found so.
pub(super) async fn multicast(node: &Node) -> Vec<Finding> {
    let all = wanted(&node.file);
    if all.is_empty() {
        return vec![no_dds(&node.name)];
    }
    let mut findings = Vec::new();
    let found = on_thread(interfaces).await.and_then(Result::ok).unwrap_or_default();
    for wanted in all {
        let Some(interface) = found.iter().find(|found| found.address == wanted.address) else {
            let detail = format!("no interface has {} ({})", wanted.address, wanted.key);
            findings.push(Finding::skipped(detail, "see the check dds_interface"));
            continue;
        };
        let address = wanted.address;
        let tried = on_thread(move || try_multicast(address)).await;
        let tried = tried.unwrap_or(Multicast::NoJoin("no thread".to_owned()));
        findings.push(judge_multicast(wanted, interface, &tried));
    }
    findings
}

/// The packet has a time to live of 0: it leaves this machine on no interface.
fn try_multicast(address: Ipv4Addr) -> Multicast {
    let join = || -> io::Result<UdpSocket> {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
        socket.join_multicast_v4(&GROUP, &address)?;
        SockRef::from(&socket).set_multicast_if_v4(&address)?;
        socket.set_multicast_loop_v4(true)?;
        socket.set_multicast_ttl_v4(0)?;
        socket.set_read_timeout(Some(MULTICAST_ANSWER))?;
        Ok(socket)
    };
    let socket = match join() {
        Ok(socket) => socket,
        Err(error) => return Multicast::NoJoin(error.to_string()),
    };
    match returns(&socket) {
        Ok(true) => Multicast::Works,
        Ok(false) => Multicast::NoReturn("it does not come back".to_owned()),
        Err(error) => Multicast::NoReturn(error.to_string()),
    }
}

fn returns(socket: &UdpSocket) -> io::Result<bool> {
    let port = socket.local_addr()?.port();
    // Nobody else has that port, so that what comes is ours but for strangers.
    let token = format!("blaze doctor {} {port}", std::process::id());
    socket.send_to(token.as_bytes(), (GROUP, port))?;
    let until = Instant::now() + MULTICAST_ANSWER;
    let mut buffer = [0; 64];
    while Instant::now() < until {
        match socket.recv(&mut buffer) {
            Ok(length) if &buffer[..length] == token.as_bytes() => return Ok(true),
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(false),
            Err(error) => return Err(error),
        }
    }
    Ok(false)
}

fn judge_multicast(wanted: Wanted, interface: &Interface, tried: &Multicast) -> Finding {
    let Wanted { key, address, multicast } = wanted;
    let Interface { name, flags, .. } = interface;
    let worse = |detail: String, remedy: String| match multicast {
        true => Finding::fail(detail, remedy),
        false => Finding::warn(
            format!("{detail}; {key} needs unicast alone"),
            format!("nothing has to be done for unicast; for multicast: {remedy}"),
        ),
    };
    // Loopback lacks the flag and carries multicast all the same.
    let carries = InterfaceFlags::IFF_MULTICAST | InterfaceFlags::IFF_LOOPBACK;
    if !flags.intersects(carries) {
        let detail = format!("{name} ({address}, {key}) carries no multicast");
        return worse(detail, format!("ip link set {name} multicast on"));
    }
    match tried {
        Multicast::Works => Finding::ok(format!("{name} {address}: joined {GROUP}")),
        Multicast::NoJoin(reason) => worse(
            format!("no join of {GROUP} on {name} ({address}, {key}): {reason}"),
            "sysctl -w net.ipv4.igmp_max_memberships=200".to_owned(),
        ),
        Multicast::NoReturn(reason) => worse(
            format!("a packet to {GROUP} on {name} ({address}, {key}) fails: {reason}"),
            format!(
                "let the firewall pass it: nft insert rule inet filter input iifname {name} ip \
                 daddr 224.0.0.0/4 accept"
            ),
        ),
    }
}

/// Largest buffers that the system gives, and what was lost because one was full.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Buffers {
    read_max: Option<u64>,
    write_max: Option<u64>,
    errors: Option<u64>,
}

/// `udp_buffers`.
pub(super) async fn udp_buffers(node: &Node) -> Vec<Finding> {
    if wanted(&node.file).is_empty() {
        return vec![no_dds(&node.name)];
    }
    let brokers = &node.file.brokers;
    let is_large = brokers.layer_domain().is_some() || brokers.ros2.is_some();
    let read = |root: PathBuf| on_thread(move || buffers(&root));
    let first = read(node.proc.clone()).await.unwrap_or_default();
    tokio::time::sleep(APART).await;
    let second = read(node.proc.clone()).await.unwrap_or_default();
    let lost = second.errors.zip(first.errors).map_or(0, |(now, then)| now.saturating_sub(then));
    judge_buffers(second, lost, is_large)
}

fn buffers(proc: &Path) -> Buffers {
    let number = |name: &str| {
        std::fs::read_to_string(proc.join("sys/net/core").join(name)).ok()?.trim().parse().ok()
    };
    let snmp = std::fs::read_to_string(proc.join("net/snmp")).unwrap_or_default();
    Buffers {
        read_max: number("rmem_max"),
        write_max: number("wmem_max"),
        errors: udp_counter(&snmp, "RcvbufErrors"),
    }
}

/// A counter of `/proc/net/snmp`: a line of names, then one of numbers.
fn udp_counter(snmp: &str, name: &str) -> Option<u64> {
    let mut lines = snmp.lines().filter(|line| line.starts_with("Udp:"));
    let (names, numbers) = (lines.next()?, lines.next()?);
    let column = names.split_whitespace().position(|found| found == name)?;
    numbers.split_whitespace().nth(column)?.parse().ok()
}

fn judge_buffers(buffers: Buffers, lost: u64, is_large: bool) -> Vec<Finding> {
    let least = if is_large { LARGE_BUFFER } else { SMALL_BUFFER };
    let mut findings = Vec::new();
    for (name, of) in [("rmem_max", buffers.read_max), ("wmem_max", buffers.write_max)] {
        let name = format!("net.core.{name}");
        match of {
            Some(bytes) if bytes < least => findings.push(Finding::warn(
                format!("{name} is {bytes} B, sockets ask for {least} B"),
                format!("sysctl -w {name}={least}"),
            )),
            Some(bytes) => findings.push(Finding::ok(format!("{name} {bytes} B"))),
            // A network namespace of its own may not have it.
            None => findings.push(Finding::skipped(
                format!("{name} cannot be read here"),
                format!("sysctl {name} on the host"),
            )),
        }
    }
    if lost > 0 {
        findings.push(Finding::warn(
            format!("{lost} UDP packets were lost in a second because a buffer was full"),
            format!(
                "sysctl -w net.core.rmem_max={max} net.core.rmem_default={max}, then restart \
                 blaze-flow",
                max = 4 * LARGE_BUFFER
            ),
        ));
    }
    findings
}

#[cfg(test)]
mod tests {
    use super::super::check::Outcome;
    use super::*;

    const KEY: &str = "brokers.layer.dds.interface";

    fn interface(flags: InterfaceFlags) -> Interface {
        Interface { name: "eth0".to_owned(), address: Ipv4Addr::new(10, 0, 0, 1), flags }
    }

    fn asked(multicast: bool) -> Wanted {
        Wanted { key: KEY, address: Ipv4Addr::new(10, 0, 0, 1), multicast }
    }

    #[test]
    fn an_interface_is_missing_down_or_there() {
        let up = InterfaceFlags::IFF_UP | InterfaceFlags::IFF_RUNNING;
        let judge = |flags| interface_of(asked(true), &[interface(flags)], "blaze.yaml");
        assert_eq!(judge(up).result, Outcome::Ok);
        let down = judge(InterfaceFlags::empty());
        assert_eq!((down.result, down.remedy.as_str()), (Outcome::Fail, "ip link set eth0 up"));
        assert_eq!(judge(InterfaceFlags::IFF_UP).result, Outcome::Warn);
        let elsewhere = Wanted { address: Ipv4Addr::new(10, 9, 9, 9), ..asked(true) };
        let missing = interface_of(elsewhere, &[interface(up)], "blaze.yaml");
        assert_eq!(missing.result, Outcome::Fail);
        assert!(missing.detail.contains("10.9.9.9") && missing.detail.contains("eth0 10.0.0.1"));
        assert_eq!(missing.remedy, format!("set {KEY}: 10.0.0.1 in blaze.yaml"));
    }

    #[test]
    fn multicast_fails_only_where_it_is_needed() {
        let flags = InterfaceFlags::IFF_UP | InterfaceFlags::IFF_MULTICAST;
        let judge =
            |wanted, flags, tried: &Multicast| judge_multicast(wanted, &interface(flags), tried);
        assert_eq!(judge(asked(true), flags, &Multicast::Works).result, Outcome::Ok);
        let none = judge(asked(true), InterfaceFlags::IFF_UP, &Multicast::Works);
        assert_eq!(none.result, Outcome::Fail);
        assert_eq!(none.remedy, "ip link set eth0 multicast on");
        let unicast = judge(asked(false), InterfaceFlags::IFF_UP, &Multicast::Works);
        assert_eq!(unicast.result, Outcome::Warn);
        let lost = Multicast::NoReturn("it does not come back".to_owned());
        assert!(judge(asked(true), flags, &lost).remedy.contains("iifname eth0"));
    }

    #[test]
    fn multicast_on_loopback_comes_back() {
        assert_eq!(try_multicast(Ipv4Addr::LOCALHOST), Multicast::Works);
        let nowhere = try_multicast(Ipv4Addr::new(192, 0, 2, 1));
        assert!(matches!(nowhere, Multicast::NoJoin(_)), "{nowhere:?}");
    }

    #[test]
    fn small_buffers_and_losses_are_named() {
        let (read_max, write_max) = (Some(212_992), Some(LARGE_BUFFER));
        let buffers = Buffers { read_max, write_max, errors: Some(3) };
        let found = judge_buffers(buffers, 0, true);
        assert_eq!(found[0].result, Outcome::Warn);
        assert_eq!(found[0].remedy, "sysctl -w net.core.rmem_max=8388608");
        assert_eq!(found[1].result, Outcome::Ok);
        assert_eq!(judge_buffers(buffers, 7, true).len(), 3);
        let unknown = judge_buffers(Buffers::default(), 0, false);
        assert!(unknown.iter().all(|found| found.result == Outcome::Skipped));
    }

    #[test]
    fn counters_are_read_from_the_root_that_is_given() {
        let root = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(root.path().join("net")).unwrap();
        std::fs::create_dir_all(root.path().join("sys/net/core")).unwrap();
        let snmp = "Ip: Forwarding\nIp: 1\nUdp: InDatagrams NoPorts RcvbufErrors\nUdp: 9 8 7\n";
        std::fs::write(root.path().join("net/snmp"), snmp).unwrap();
        std::fs::write(root.path().join("sys/net/core/rmem_max"), "212992\n").unwrap();
        let found = buffers(root.path());
        let expected = Buffers { read_max: Some(212_992), write_max: None, errors: Some(7) };
        assert_eq!(found, expected);
    }
}
