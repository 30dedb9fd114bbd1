//! What a network looks like, as data.

use crate::wan::Shape;

/// Hosts and what joins them. A host with several interfaces is a router; every host reaches every
/// other one.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Plan {
    /// Names, unique; the first segment or link of a host gives it its address.
    pub hosts: Vec<String>,
    /// Switches.
    pub segments: Vec<Segment>,
    /// Emulated links.
    pub links: Vec<WanLink>,
}

/// Hosts on one switch.
#[derive(Debug, Clone, PartialEq)]
pub struct Segment {
    /// Hosts.
    pub members: Vec<String>,
    /// Whether it carries multicast.
    pub multicast: bool,
}

/// A link between two hosts through `blaze-wan`.
#[derive(Debug, Clone, PartialEq)]
pub struct WanLink {
    /// One end.
    pub a: String,
    /// The other end.
    pub b: String,
    /// From A to B. Its MTU is that of the interface at A, too.
    pub forward: Shape,
    /// From B to A.
    pub back: Shape,
    /// For loss and jitter.
    pub seed: u64,
}

impl Plan {
    /// Without any host.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Two hosts and one link with the same quality both ways.
    #[must_use]
    pub fn two_hosts(a: &str, b: &str, shape: Shape) -> Self {
        Self::new().with_hosts(&[a, b]).with_link(a, b, shape)
    }

    /// With further hosts.
    #[must_use]
    pub fn with_hosts(mut self, names: &[&str]) -> Self {
        self.hosts.extend(names.iter().map(|name| (*name).to_owned()));
        self
    }

    /// With a switch that carries multicast.
    #[must_use]
    pub fn with_lan(mut self, members: &[&str]) -> Self {
        self.segments.push(Segment {
            members: members.iter().map(|name| (*name).to_owned()).collect(),
            multicast: true,
        });
        self
    }

    /// With a switch that drops multicast.
    #[must_use]
    pub fn with_unicast_lan(self, members: &[&str]) -> Self {
        let mut plan = self.with_lan(members);
        if let Some(segment) = plan.segments.last_mut() {
            segment.multicast = false;
        }
        plan
    }

    /// With a link of the same quality both ways.
    #[must_use]
    pub fn with_link(self, a: &str, b: &str, shape: Shape) -> Self {
        self.with_asymmetric_link(a, b, shape, shape)
    }

    /// With a link of a quality for each way.
    #[must_use]
    pub fn with_asymmetric_link(mut self, a: &str, b: &str, forward: Shape, back: Shape) -> Self {
        self.links.push(WanLink {
            a: a.to_owned(),
            b: b.to_owned(),
            forward,
            back,
            seed: self.links.len() as u64 + 1,
        });
        self
    }
}
