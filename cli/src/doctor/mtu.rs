//! `mtu`: whether packets of the configured size pass to each peer whole.
//!
//! A datagram that must not be fragmented goes to a UDP port where nobody listens. The host answers
//! that the port is closed when it arrived, a router answers that it was too large, and the system
//! refuses one that is larger than the interface carries. Silence says something only where a small
//! one is answered.

use std::io::{self, ErrorKind};
use std::net::{IpAddr, Ipv4Addr, UdpSocket};

use rustix::net::sockopt::{Ipv4PathMtuDiscovery, ip_mtu, set_ip_mtu_discover};

use super::check::{Finding, named};
use super::limits::{MTU_ANSWER, MTU_PEERS, MTU_TRIES};
use super::programs::rows;
use super::{Node, on_thread};

/// First port of traceroute: hosts have nothing there, and answer that.
const CLOSED_PORT: u16 = 33_434;
/// Headers of IPv4 and UDP.
const HEADERS: usize = 28;
/// A packet that every path carries.
const SMALL: usize = 64;
/// Sizes of packets that links of the field have, largest first: Ethernet with jumbo frames, plain,
/// PPPoE, tunnels (IP in IP, GRE, WireGuard, IPsec, VXLAN), mobile networks.
const COMMON: [usize; 13] =
    [9000, 8900, 1500, 1492, 1480, 1476, 1450, 1440, 1420, 1400, 1380, 1350, 1280];

/// What a path carries.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Path {
    /// Packets of the size that was asked for.
    Whole,
    /// Packets of at most these bytes.
    Narrow(usize),
    /// The peer answers nothing, so that nothing is known.
    Silent,
    /// There is no way to it.
    Unreachable(String),
}

/// What became of one packet.
#[derive(Debug, PartialEq, Eq)]
enum Sent {
    Arrived,
    TooLarge,
    Lost,
    Unreachable(String),
}

/// `mtu`: the path to each peer.
pub(super) async fn mtu(node: &Node) -> Vec<Finding> {
    let Some(inter) = &node.file.brokers.inter else {
        return vec![Finding::skipped(
            "the node file has no brokers.inter: nothing leaves the layer",
            format!("nothing to do; to reach other layers set brokers.inter.dds in {}", node.name),
        )];
    };
    let (listen, mtu) = (inter.listen, usize::from(inter.mtu));
    let mut peers: Vec<Ipv4Addr> = inter.peers.clone();
    peers.extend(seen_peers(node).await);
    peers.retain(|peer| *peer != listen && !peer.is_loopback());
    peers.sort_unstable();
    peers.dedup();
    let left_out = peers.len().saturating_sub(MTU_PEERS);
    peers.truncate(MTU_PEERS);
    let paths = peers.iter().map(|peer| {
        let peer = *peer;
        async move {
            let path = on_thread(move || path(listen, peer, mtu)).await;
            (peer, path.unwrap_or(Path::Silent))
        }
    });
    let paths = futures::future::join_all(paths).await;
    let mut findings = judge(mtu, &paths, &node.name);
    if left_out > 0 {
        findings.push(Finding::ok(format!("{left_out} more peers were not measured")));
    }
    findings
}

/// Addresses of the flows that the running flow sees.
async fn seen_peers(node: &Node) -> Vec<Ipv4Addr> {
    if node.flow.object().is_none() {
        return Vec::new();
    }
    let answer = node.flow.get("/v1/peers").await.unwrap_or_default();
    rows(&answer, "peers")
        .iter()
        .filter_map(|row| super::peers::address(row["address"].as_str()?))
        .collect()
}

fn path(listen: Ipv4Addr, peer: Ipv4Addr, mtu: usize) -> Path {
    let connect = || -> io::Result<UdpSocket> {
        let socket = UdpSocket::bind((listen, 0))?;
        // What is remembered of the path is not believed: it may have been repaired since.
        set_ip_mtu_discover(&socket, Ipv4PathMtuDiscovery::PROBE)?;
        socket.set_read_timeout(Some(MTU_ANSWER))?;
        socket.connect((IpAddr::V4(peer), CLOSED_PORT))?;
        Ok(socket)
    };
    match connect() {
        Ok(socket) => measure(mtu, |bytes| send(&socket, bytes), || known(&socket)),
        Err(error) => Path::Unreachable(error.to_string()),
    }
}

/// The MTU that the system knows of the path.
fn known(socket: &UdpSocket) -> Option<usize> {
    ip_mtu(socket).ok().and_then(|mtu| usize::try_from(mtu).ok())
}

fn send(socket: &UdpSocket, bytes: usize) -> Sent {
    let payload = vec![0; bytes.saturating_sub(HEADERS)];
    match socket.send(&payload).and_then(|_| socket.recv(&mut [0; 1])) {
        Ok(_) => Sent::Arrived,
        Err(error) if error.kind() == ErrorKind::ConnectionRefused => Sent::Arrived,
        Err(error) if error.raw_os_error() == Some(rustix::io::Errno::MSGSIZE.raw_os_error()) => {
            Sent::TooLarge
        }
        Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
            Sent::Lost
        }
        Err(error) => Sent::Unreachable(error.to_string()),
    }
}

/// What a path carries, from what becomes of packets on it.
fn measure(
    mtu: usize,
    mut send: impl FnMut(usize) -> Sent,
    known: impl Fn() -> Option<usize>,
) -> Path {
    for _ in 0..MTU_TRIES {
        match send(mtu) {
            Sent::Arrived => return Path::Whole,
            Sent::Unreachable(reason) => return Path::Unreachable(reason),
            Sent::TooLarge => {
                let told = known().filter(|told| *told < mtu);
                return Path::Narrow(told.unwrap_or_else(|| widest(mtu, &mut send)));
            }
            Sent::Lost => {}
        }
    }
    match (send(SMALL), send(SMALL)) {
        (Sent::Arrived, _) | (_, Sent::Arrived) => Path::Narrow(widest(mtu, &mut send)),
        (Sent::Unreachable(reason), _) => Path::Unreachable(reason),
        _ => Path::Silent,
    }
}

/// The largest of the common sizes below `mtu` that arrives, in as few steps as can be: hosts
/// answer only some packets a second.
fn widest(mtu: usize, send: &mut impl FnMut(usize) -> Sent) -> usize {
    let smaller: Vec<usize> = COMMON.into_iter().filter(|size| *size < mtu).collect();
    let place = smaller.partition_point(|size| send(*size) != Sent::Arrived);
    smaller.get(place).copied().unwrap_or(SMALL)
}

fn judge(mtu: usize, paths: &[(Ipv4Addr, Path)], file: &str) -> Vec<Finding> {
    const KEY: &str = "brokers.inter.dds.mtu";
    if paths.is_empty() {
        return vec![Finding::skipped(
            "no peers of other layers are known",
            format!("set brokers.inter.dds.peers: [ADDRESS] in {file}, or start the other flows"),
        )];
    }
    let narrowest = paths.iter().filter_map(|(_, path)| match path {
        Path::Narrow(bytes) => Some(*bytes),
        _ => None,
    });
    let least = narrowest.min().unwrap_or(mtu);
    let remedy = match least {
        least if least < usize::from(blaze_domain::node_file::MIN_MTU) => format!(
            "raise the MTU of the links on the path to {} at least (ip link set INTERFACE mtu \
             1500); tracepath PEER shows the narrow one",
            blaze_domain::node_file::MIN_MTU
        ),
        least => format!("set {KEY}: {least} in {file}, then restart blaze-flow"),
    };
    let mut findings = Vec::new();
    let (mut whole, mut silent) = (Vec::new(), Vec::new());
    for (peer, path) in paths {
        match path {
            Path::Whole => whole.push(peer.to_string()),
            Path::Silent => silent.push(peer.to_string()),
            Path::Narrow(bytes) => findings.push(Finding::fail(
                format!("{KEY} is {mtu}, packets to {peer} pass up to {bytes} bytes"),
                remedy.clone(),
            )),
            Path::Unreachable(reason) => findings.push(Finding::warn(
                format!("no way to {peer}: {reason}"),
                format!("ip route get {peer}, and see the check dds_interface"),
            )),
        }
    }
    if !whole.is_empty() {
        findings.push(Finding::ok(format!("{mtu} bytes pass whole to {}", named(&whole))));
    }
    if let Some(first) = silent.first() {
        findings.push(Finding::skipped(
            format!("not measured, as no probe is answered: {}", named(&silent)),
            format!("tracepath -n {first}, or let UDP port {CLOSED_PORT} through the firewall"),
        ));
    }
    findings
}

#[cfg(test)]
mod tests {
    use super::super::check::{Check, Outcome};
    use super::*;

    /// A path that carries packets of at most `widest` bytes, and whose routers tell so or not.
    fn over(widest: usize, tells: bool, mtu: usize) -> Path {
        let send = |bytes| match bytes {
            bytes if bytes <= widest => Sent::Arrived,
            _ if tells => Sent::TooLarge,
            _ => Sent::Lost,
        };
        measure(mtu, send, || tells.then_some(widest))
    }

    #[test]
    fn the_width_of_a_path_is_found_also_where_routers_are_silent() {
        assert_eq!(over(1500, true, 1500), Path::Whole);
        assert_eq!(over(1431, true, 1500), Path::Narrow(1431));
        for (widest, found) in [(1431, 1420), (1280, 1280), (1499, 1492), (1000, SMALL)] {
            assert_eq!(over(widest, false, 1500), Path::Narrow(found), "{widest}");
        }
        assert_eq!(over(0, false, 1500), Path::Silent);
        let gone = measure(1500, |_| Sent::Unreachable("no route".to_owned()), || None);
        assert_eq!(gone, Path::Unreachable("no route".to_owned()));
    }

    #[test]
    fn one_lost_probe_does_not_make_a_path_narrow() {
        let mut sent = 0;
        let lossy = |_| {
            sent += 1;
            if sent == 1 { Sent::Lost } else { Sent::Arrived }
        };
        assert_eq!(measure(1500, lossy, || None), Path::Whole);
    }

    #[test]
    fn the_narrowest_path_gives_the_value_to_set() {
        let peer = |last| Ipv4Addr::new(10, 0, 0, last);
        let paths =
            [(peer(1), Path::Whole), (peer(2), Path::Narrow(1450)), (peer(3), Path::Narrow(1400))];
        let check = Check::of("mtu", &judge(1500, &paths, "blaze.yaml"));
        assert_eq!(check.result, Outcome::Fail);
        assert!(check.detail.contains("10.0.0.3 pass up to 1400"), "{check:?}");
        let set = "set brokers.inter.dds.mtu: 1400 in blaze.yaml, then restart blaze-flow";
        assert_eq!(check.remedy, set);
        let below = judge(1500, &[(peer(1), Path::Narrow(1000))], "f");
        assert!(below[0].remedy.contains("ip link set"), "{below:?}");
        let silent = Check::of("mtu", &judge(1500, &[(peer(1), Path::Silent)], "f"));
        assert_eq!(silent.result, Outcome::Skipped);
        let some = [(peer(1), Path::Silent), (peer(2), Path::Whole)];
        assert_eq!(Check::of("mtu", &judge(1500, &some, "f")).result, Outcome::Ok);
        assert_eq!(judge(1500, &[], "f")[0].result, Outcome::Skipped);
    }

    #[test]
    fn a_closed_port_of_this_machine_answers() {
        assert_eq!(path(Ipv4Addr::LOCALHOST, Ipv4Addr::LOCALHOST, 1500), Path::Whole);
    }
}
