//! Addresses and routes of a plan. A pure function.

use std::collections::{BTreeMap, VecDeque};
use std::net::Ipv4Addr;

use anyhow::Context as _;

use super::plan::Plan;

/// Hosts on one segment at most: a segment has a network of 256 addresses.
const MAX_MEMBERS: usize = 250;
/// Segments, and links, at most.
const MAX_NETWORKS: usize = 250;

/// An interface of a host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Interface {
    /// Index in [`Plan::hosts`].
    pub(super) host: usize,
    /// `v0`, `v1` … on segments, `w0` … on links, counted together.
    pub(super) name: String,
    pub(super) address: Ipv4Addr,
}

/// A segment or a link.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Network {
    pub(super) base: Ipv4Addr,
    pub(super) bits: u8,
    pub(super) members: Vec<Interface>,
}

/// One line of a host's routing table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Route {
    pub(super) to: Ipv4Addr,
    pub(super) bits: u8,
    pub(super) via: Ipv4Addr,
    pub(super) interface: String,
}

/// The segments of a plan, then its links.
///
/// # Errors
/// When a name is used twice or not known, a host is joined to nothing, or there are too many.
pub(super) fn networks(plan: &Plan) -> anyhow::Result<Vec<Network>> {
    anyhow::ensure!(
        plan.segments.len() <= MAX_NETWORKS && plan.links.len() <= MAX_NETWORKS,
        "more than {MAX_NETWORKS} segments or links"
    );
    let mut hosts = BTreeMap::new();
    for (index, name) in plan.hosts.iter().enumerate() {
        anyhow::ensure!(hosts.insert(name.as_str(), index).is_none(), "{name} is there twice");
    }
    let mut interfaces = vec![0_u32; plan.hosts.len()];
    let mut join = |name: &str, letter: char, address: Ipv4Addr| -> anyhow::Result<Interface> {
        let host = *hosts.get(name).with_context(|| format!("{name} is no host"))?;
        let number = interfaces[host];
        interfaces[host] += 1;
        Ok(Interface { host, name: format!("{letter}{number}"), address })
    };
    let mut networks = Vec::new();
    for (number, segment) in plan.segments.iter().enumerate() {
        anyhow::ensure!(
            segment.members.len() <= MAX_MEMBERS,
            "more than {MAX_MEMBERS} hosts on a switch"
        );
        let address = |member: usize| Ipv4Addr::new(10, 1, number as u8, member as u8);
        let members = segment.members.iter().enumerate();
        networks.push(Network {
            base: address(0),
            bits: 24,
            members: members
                .map(|(member, name)| join(name, 'v', address(member + 1)))
                .collect::<anyhow::Result<_>>()?,
        });
    }
    for (number, link) in plan.links.iter().enumerate() {
        let address = |end: u8| Ipv4Addr::new(10, 2, number as u8, end);
        networks.push(Network {
            base: address(0),
            bits: 30,
            members: vec![join(&link.a, 'w', address(1))?, join(&link.b, 'w', address(2))?],
        });
    }
    let alone = interfaces.iter().position(|count| *count == 0);
    anyhow::ensure!(
        alone.is_none(),
        "{} is joined to nothing",
        alone.map_or("", |host| &plan.hosts[host])
    );
    Ok(networks)
}

/// A host's routes to the networks that it is not on itself, over as few hosts as possible.
///
/// # Errors
/// When one cannot be reached.
pub(super) fn routes(host: usize, networks: &[Network]) -> anyhow::Result<Vec<Route>> {
    // From network to network; `first` is the host on the first one through which the others are
    // reached.
    let mut first: Vec<Option<(Ipv4Addr, String)>> = vec![None; networks.len()];
    let mut known = vec![false; networks.len()];
    let mut next = VecDeque::new();
    for (index, network) in networks.iter().enumerate() {
        if network.members.iter().any(|member| member.host == host) {
            known[index] = true;
            next.push_back(index);
        }
    }
    let mut routes = Vec::new();
    while let Some(here) = next.pop_front() {
        let own = networks[here].members.iter().find(|member| member.host == host);
        for router in networks[here].members.iter().filter(|member| member.host != host) {
            let way = match (own, &first[here]) {
                (Some(own), _) => (router.address, own.name.clone()),
                (None, Some(way)) => way.clone(),
                (None, None) => continue,
            };
            for (index, network) in networks.iter().enumerate() {
                if known[index] || !network.members.iter().any(|member| member.host == router.host)
                {
                    continue;
                }
                known[index] = true;
                first[index] = Some(way.clone());
                next.push_back(index);
                routes.push(Route {
                    to: network.base,
                    bits: network.bits,
                    via: way.0,
                    interface: way.1.clone(),
                });
            }
        }
    }
    let missing = known.iter().position(|known| !known);
    anyhow::ensure!(
        missing.is_none(),
        "host {host} cannot reach {}",
        missing.map_or(Ipv4Addr::UNSPECIFIED, |index| networks[index].base)
    );
    Ok(routes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wan::Shape;

    fn route(to: [u8; 4], bits: u8, via: [u8; 4], interface: &str) -> Route {
        Route { to: to.into(), bits, via: via.into(), interface: interface.to_owned() }
    }

    #[test]
    fn a_robot_reaches_the_cloud_over_its_router() {
        let plan = Plan::new()
            .with_hosts(&["robot", "router", "cloud"])
            .with_lan(&["robot", "router"])
            .with_link("router", "cloud", Shape::default());
        let networks = networks(&plan).unwrap();
        let names: Vec<Vec<&str>> = networks
            .iter()
            .map(|network| network.members.iter().map(|member| member.name.as_str()).collect())
            .collect();
        assert_eq!(names, [["v0", "v0"], ["w1", "w0"]]);
        assert_eq!(routes(0, &networks).unwrap(), [route([10, 2, 0, 0], 30, [10, 1, 0, 2], "v0")]);
        assert_eq!(routes(1, &networks).unwrap(), []);
        assert_eq!(routes(2, &networks).unwrap(), [route([10, 1, 0, 0], 24, [10, 2, 0, 1], "w0")]);
    }
}
