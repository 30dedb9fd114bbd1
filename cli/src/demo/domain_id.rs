//! A DDS domain that no other demo on this host uses.

use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};

use blaze_domain::node_file::MAX_DDS_DOMAIN;

/// The demo's domain where several processes must agree on one.
pub const DEFAULT_DOMAIN: u16 = 20;

/// A domain that is ours until this is dropped.
#[derive(Debug)]
pub struct ReservedDomain {
    /// The domain, 20 to 100.
    pub domain: u16,
    /// Bound as long as the domain is ours; nothing is sent or received here.
    _claim: UdpSocket,
}

/// First port of a domain (RTPS: port base 7400, domain gain 250).
fn base_port(domain: u16) -> u16 {
    7_400 + 250 * domain
}

/// The last port of a domain's range; participants use it only where there are 120 of them on a
/// host.
fn claim_port(domain: u16) -> u16 {
    base_port(domain) + 249
}

/// Finds a domain that nobody on this host uses at `address`, beginning with [`DEFAULT_DOMAIN`],
/// but for one that has another use. `None`: all are taken.
#[must_use]
pub fn reserve(address: Ipv4Addr, but: Option<u16>) -> Option<ReservedDomain> {
    (DEFAULT_DOMAIN..=MAX_DDS_DOMAIN).filter(|domain| Some(*domain) != but).find_map(|domain| {
        let claim = bind(Ipv4Addr::LOCALHOST, claim_port(domain))?;
        // SPDP and user traffic of the first participant, whoever started it.
        let free =
            [10, 11].into_iter().all(|offset| bind(address, base_port(domain) + offset).is_some());
        free.then_some(ReservedDomain { domain, _claim: claim })
    })
}

/// Whether an interface of this host has the address.
#[must_use]
pub fn is_local(address: Ipv4Addr) -> bool {
    bind(address, 0).is_some()
}

fn bind(address: Ipv4Addr, port: u16) -> Option<UdpSocket> {
    UdpSocket::bind(SocketAddr::new(IpAddr::V4(address), port)).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_demos_have_two_domains() {
        let first = reserve(Ipv4Addr::LOCALHOST, None).unwrap();
        let second = reserve(Ipv4Addr::LOCALHOST, None).unwrap();
        assert_ne!(first.domain, second.domain);
        assert!((DEFAULT_DOMAIN..=MAX_DDS_DOMAIN).contains(&second.domain));
        let free = second.domain;
        drop(second);
        assert_ne!(reserve(Ipv4Addr::LOCALHOST, Some(free)).unwrap().domain, free);
    }

    #[test]
    fn a_domain_with_a_participant_is_left_alone() {
        let probe = reserve(Ipv4Addr::LOCALHOST, None).unwrap();
        let domain = probe.domain;
        let _participant = bind(Ipv4Addr::LOCALHOST, base_port(domain) + 10).unwrap();
        drop(probe);
        assert!(reserve(Ipv4Addr::LOCALHOST, None).unwrap().domain > domain);
    }

    #[test]
    fn ports_stay_within_the_range() {
        assert_eq!(claim_port(MAX_DDS_DOMAIN), 32_649);
        assert_eq!(claim_port(DEFAULT_DOMAIN) + 1, base_port(DEFAULT_DOMAIN + 1));
    }
}
