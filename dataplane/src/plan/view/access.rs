//! What the rules `flow.access` of the own node file mean for services of other flows.
//!
//! Services of the own brokers had their leases looked at. Of others a flow hears which scopes ask
//! and who publishes there, so the rules are held against layer and node; what nobody tells is
//! empty, and fits `*` alone.

use blaze_domain::control::LeaseKind;
use blaze_domain::{FlowId, Scope};

use super::{Group, Publisher, Requester, TopicView, meets_directly};
use crate::plan::Destination;

impl<'w> TopicView<'w> {
    /// Whether the rules let a requester have the topic.
    pub(super) fn may_request(&self, requester: &Requester<'_>) -> bool {
        let flow = requester.flow;
        if !self.access.limits(LeaseKind::Request) || flow == self.me {
            return true;
        }
        let (layer, node) = match requester.scope {
            Scope::Node | Scope::Ros2 => (flow.layer.as_str(), flow.node.as_str()),
            // All flows of the group hear these services, so whom of them the rules allow has a
            // lease here.
            Scope::Layer if requester.group == self.group => return self.leases_on_layer(),
            Scope::Layer => (flow.layer.as_str(), ""),
            Scope::Inter => ("", ""),
        };
        self.access.allows(LeaseKind::Request, layer, node, "")
    }

    fn leases_on_layer(&self) -> bool {
        let own = self.world.own().and_then(|own| own.topics.get(self.topic));
        own.is_some_and(|entry| entry.layer.request.is_some())
    }

    /// Requesters that the own rules refuse, and that other flows count among those that could take
    /// in what the publisher sends to a group: of the own group any, of others those whom another
    /// flow sends it.
    pub(super) fn refused_elsewhere(
        &self,
        publisher: &Publisher<'_>,
        group: Group<'_>,
    ) -> &[Requester<'w>] {
        if self.refused.is_empty() || (group != self.group && self.sends(publisher)) {
            &[]
        } else {
            &self.refused
        }
    }

    /// Why the rules keep from the requester what the publisher sends, if they do.
    pub(crate) fn denial(
        &self,
        publisher: &Publisher<'w>,
        requester: &Requester<'w>,
    ) -> Option<String> {
        let is_refused = self.is_refused(requester) && !self.is_served_along(publisher, requester);
        let (who, what) = if is_refused {
            (place(requester.flow, requester.scope), LeaseKind::Request)
        } else if self.is_denied(publisher) && requester.group == self.group {
            (place(publisher.flow, publisher.scope), LeaseKind::Advertise)
        } else {
            return None;
        };
        let (me, topic) = (self.me, self.topic);
        self.passes(publisher, requester).then(|| {
            format!("{who} may not {what} {topic}: the rules flow.access of {me} do not allow it")
        })
    }

    /// Requests that the rules leave without an answer, and why: whoever is refused, and whoever is
    /// reached by none but those who may not publish.
    pub(super) fn denied(&self) -> Vec<(Destination, String)> {
        let denies = self.access.limits(LeaseKind::Advertise);
        if self.refused.is_empty() && !denies {
            return Vec::new();
        }
        let of = |requester: &Requester<'w>| {
            let requester = *requester;
            let publishers =
                self.publishers.iter().filter(move |publisher| publisher.matches(&requester));
            publishers.map(move |publisher| self.denial(publisher, &requester))
        };
        let refused = self.refused.iter().filter_map(|requester| {
            let denial = of(requester).flatten().next()?;
            Some((requester.destination(), denial))
        });
        let here = |requester: &&Requester<'w>| {
            requester.group == self.group && requester.scope != Scope::Inter
        };
        let unheard = self.requesters.iter().filter(|_| denies).filter(here);
        let unheard = unheard.filter_map(|requester| {
            let denials: Option<Vec<String>> = of(requester).collect();
            Some((requester.destination(), denials?.into_iter().next()?))
        });
        refused.chain(unheard).collect()
    }

    fn is_refused(&self, requester: &Requester<'_>) -> bool {
        let same = |refused: &Requester<'_>| {
            (refused.flow, refused.scope) == (requester.flow, requester.scope)
        };
        self.refused.iter().any(same)
    }

    /// Whether what the publisher sends goes the requester's way for another one all the same: what
    /// is on the broker of a layer everybody there may read.
    fn is_served_along(&self, publisher: &Publisher<'w>, requester: &Requester<'w>) -> bool {
        let over_layer =
            |other: &Requester<'_>| other.flow != self.me || other.scope == Scope::Layer;
        let same_way = |other: &&Requester<'w>| {
            other.group == requester.group && (requester.group != self.group || over_layer(other))
        };
        let mut others = self.requesters.iter().filter(same_way);
        others.any(|other| publisher.matches(other))
    }

    /// Whether the rules let none of those advertise the topic who are known to publish there, in
    /// another group.
    fn is_denied(&self, publisher: &Publisher<'_>) -> bool {
        let (flow, advertise) = (publisher.flow, publisher.advertise);
        let outside = publisher.group != self.group && publisher.scope != Scope::Inter;
        if !self.access.limits(LeaseKind::Advertise) || !outside || advertise.more_sources {
            return false;
        }
        let may = |node: &str, service: &str| {
            let node = if publisher.is_of_flow() { flow.node.as_str() } else { node };
            self.access.allows(LeaseKind::Advertise, flow.layer.as_str(), node, service)
        };
        let sources = &advertise.sources;
        // A message without header is of no known service where several advertise.
        let may_unnamed = sources.len() > 1 && may("", "");
        !sources.is_empty()
            && !may_unnamed
            && !sources.iter().any(|source| may(&source.node, &source.service))
    }

    /// Whether this flow sends other groups what is published there.
    fn sends(&self, publisher: &Publisher<'_>) -> bool {
        if publisher.group != self.group || publisher.scope == Scope::Inter {
            return false;
        }
        if publisher.is_of_flow() && publisher.flow == self.me {
            return true;
        }
        let is_relayed = || self.relayed_publishers().any(|relayed| relayed.flow == publisher.flow);
        (publisher.scope == Scope::Layer || is_relayed()) && self.owner() == Some(self.me)
    }

    /// Whether what the publisher sends comes through this flow on its way to the requester, as far
    /// as others are concerned: what the own node gets from the layer scope does not.
    fn passes(&self, publisher: &Publisher<'w>, requester: &Requester<'w>) -> bool {
        if requester.group != self.group {
            return self.sends(publisher);
        }
        if publisher.group == self.group {
            let own = publisher.flow == self.me && publisher.is_of_flow();
            return own && !meets_directly(publisher, requester);
        }
        // What is published on a layer scope is told by all flows of the layer, and one of them
        // sends it.
        let same = |other: &&Publisher<'w>| {
            let of_layer = publisher.scope == Scope::Layer && other.scope == Scope::Layer;
            let of_node = (other.flow, other.scope) == (publisher.flow, publisher.scope);
            other.group == publisher.group && (of_layer || of_node)
        };
        let mut others = self.publishers.iter().filter(same);
        others.any(|other| self.may_receive(other))
    }
}

/// Where somebody is, for people.
fn place(flow: &FlowId, scope: Scope) -> String {
    match scope {
        Scope::Node => flow.to_string(),
        Scope::Ros2 => format!("the ROS 2 network of {flow}"),
        Scope::Layer => format!("layer {}", flow.layer),
        Scope::Inter => "other layers".to_owned(),
    }
}
