//! What a host sees of its network.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::time::Duration;

use blaze_tests::network::udp::socket;
use blaze_tests::network::{Host, inside};

/// Bytes that an interface has received, as the kernel of that host counts.
pub(crate) fn received_bytes(host: &Host, interface: &str) -> anyhow::Result<u64> {
    inside(&host.namespace, || {
        let text = std::fs::read_to_string("/proc/thread-self/net/dev")?;
        let line = text
            .lines()
            .find_map(|line| line.trim().strip_prefix(&format!("{interface}:")).map(str::to_owned));
        let number = line.and_then(|line| line.split_whitespace().next().map(str::to_owned));
        Ok(number.ok_or_else(|| anyhow::anyhow!("no {interface}"))?.parse()?)
    })
}

/// Whether a packet from one host reaches another, and which address it comes from.
pub(crate) fn reaches(from: &Host, to: &Host) -> anyhow::Result<Option<Ipv4Addr>> {
    let (sender, receiver) =
        (inside(&from.namespace, || Ok(UdpSocket::bind("0.0.0.0:0")?))?, socket(to)?);
    receiver.set_read_timeout(Some(Duration::from_secs(1)))?;
    sender.send_to(b"here", receiver.local_addr()?)?;
    let mut buffer = [0; 10];
    match receiver.recv_from(&mut buffer) {
        Ok((_, SocketAddr::V4(from))) => Ok(Some(*from.ip())),
        _ => Ok(None),
    }
}
