//! Which addresses of another participant mean here what they mean there.
//!
//! A DDS program that is not told otherwise announces the addresses of all its interfaces. Its
//! loopback, the bridge of its containers or the network inside its robot are somebody else's
//! addresses here, or our own.

use std::collections::BTreeSet;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use nix::ifaddrs::{InterfaceAddress, getifaddrs};
use nix::sys::socket::SockaddrStorage;

/// The network of the own interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Near {
    address: Ipv4Addr,
    mask: Ipv4Addr,
}

impl Near {
    pub(super) fn new(address: Ipv4Addr, mask: Ipv4Addr) -> Self {
        Self { address, mask }
    }

    /// The network of the interface that has an address. Where the system does not tell it is that
    /// address alone.
    pub(super) fn of_interface(address: Ipv4Addr) -> Self {
        let has_it = |interface: &InterfaceAddress| ipv4(interface.address) == Some(address);
        let interface = getifaddrs().ok().and_then(|mut interfaces| interfaces.find(has_it));
        let mask = interface.and_then(|interface| ipv4(interface.netmask));
        Self::new(address, mask.unwrap_or(Ipv4Addr::BROADCAST))
    }

    /// Of a participant's addresses those in the own network. Where there is none, because a router
    /// is between, all but those that certainly mean something else here.
    pub(super) fn select(self, sockets: &BTreeSet<SocketAddr>) -> BTreeSet<SocketAddr> {
        let possible = |socket: &&SocketAddr| {
            let ip = socket.ip();
            ip.is_ipv4() && !ip.is_unspecified() && ip.is_loopback() == self.address.is_loopback()
        };
        let possible: BTreeSet<SocketAddr> = sockets.iter().filter(possible).copied().collect();
        let own: BTreeSet<SocketAddr> =
            possible.iter().filter(|socket| self.has(**socket)).copied().collect();
        if own.is_empty() { possible } else { own }
    }

    /// Where a participant certainly takes its data, of what [`select`](Self::select) gave: an
    /// address in the own network, or the only one that it has.
    pub(super) fn certain(self, selected: &BTreeSet<SocketAddr>) -> Option<SocketAddr> {
        let first = *selected.first()?;
        (selected.len() == 1 || self.has(first)).then_some(first)
    }

    fn has(self, socket: SocketAddr) -> bool {
        let network = |ip: Ipv4Addr| ip.to_bits() & self.mask.to_bits();
        matches!(socket.ip(), IpAddr::V4(ip) if network(ip) == network(self.address))
    }
}

fn ipv4(address: Option<SockaddrStorage>) -> Option<Ipv4Addr> {
    Some(address?.as_sockaddr_in()?.ip())
}

#[cfg(test)]
mod tests {
    use super::*;

    const HERE: Near =
        Near { address: Ipv4Addr::new(192, 168, 1, 4), mask: Ipv4Addr::new(255, 255, 255, 0) };

    fn sockets(addresses: &[&str]) -> BTreeSet<SocketAddr> {
        addresses.iter().map(|address| address.parse().unwrap()).collect()
    }

    fn certain(near: Near, addresses: &[&str]) -> Option<String> {
        near.certain(&near.select(&sockets(addresses))).map(|socket| socket.to_string())
    }

    #[test]
    fn addresses_of_the_own_network_come_before_all_others() {
        let announced = sockets(&[
            "127.0.0.1:7413",
            "172.17.0.1:7413",
            "192.168.1.5:7413",
            "10.42.0.1:7413",
            "[fe80::1]:7413",
        ]);
        assert_eq!(HERE.select(&announced), sockets(&["192.168.1.5:7413"]));
        let routed = sockets(&["127.0.0.1:7413", "172.17.0.1:7413", "192.168.2.5:7413"]);
        assert_eq!(HERE.select(&routed), sockets(&["172.17.0.1:7413", "192.168.2.5:7413"]));
        assert_eq!(HERE.select(&sockets(&["127.0.0.1:7413", "0.0.0.0:7413"])), sockets(&[]));
    }

    #[test]
    fn only_an_address_that_means_the_same_here_is_asked() {
        let own_bridge = ["172.17.0.1:7413", "192.168.1.5:7413"];
        assert_eq!(certain(HERE, &own_bridge).as_deref(), Some("192.168.1.5:7413"));
        // Behind a router it could be either; a participant with one interface has no other.
        assert_eq!(certain(HERE, &["172.17.0.1:7413", "192.168.2.5:7413"]), None);
        let only = ["127.0.0.1:7413", "192.168.2.5:7413"];
        assert_eq!(certain(HERE, &only).as_deref(), Some("192.168.2.5:7413"));
        assert_eq!(certain(HERE, &["127.0.0.1:7413"]), None);
    }

    #[test]
    fn on_loopback_only_loopback_counts() {
        let near = Near::of_interface(Ipv4Addr::LOCALHOST);
        assert_eq!(near.mask, Ipv4Addr::new(255, 0, 0, 0), "the system tells the mask");
        let both = ["127.0.0.1:7413", "192.168.1.5:7413"];
        assert_eq!(certain(near, &both).as_deref(), Some("127.0.0.1:7413"));
        assert_eq!(certain(near, &["192.168.1.5:7413"]), None);
    }

    #[test]
    fn without_a_mask_the_own_address_is_alone() {
        // Reserved for documentation: no interface has it.
        let near = Near::of_interface(Ipv4Addr::new(192, 0, 2, 1));
        assert_eq!(near, Near::new(Ipv4Addr::new(192, 0, 2, 1), Ipv4Addr::BROADCAST));
        let several = ["192.0.2.1:7413", "192.0.2.5:7413"];
        assert_eq!(certain(near, &several).as_deref(), Some("192.0.2.1:7413"));
    }
}
