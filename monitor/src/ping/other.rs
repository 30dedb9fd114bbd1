//! Offsets that others measured: the flow here on its links, and its peers on theirs.

use std::collections::BTreeMap;
use std::time::Duration;

use blaze_domain::FlowId;

use super::estimate::{Now, Offset, Source, drift_ppm, drift_s};
use super::limits::OTHER_OFFSETS;

/// Offset that a flow knows from its exchange of Hellos with another flow.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinkOffset {
    /// The other clock minus that of the flow, in seconds.
    pub offset_s: f64,
    /// The true offset is not farther away than this at the time of the call, in seconds.
    pub error_s: f64,
}

/// Those of one flow, with the time since when they hold.
#[derive(Debug, Default)]
struct Links {
    at: Duration,
    offsets: BTreeMap<FlowId, LinkOffset>,
}

/// All of them.
#[derive(Debug, Default)]
pub(super) struct Other {
    own: Links,
    relayed: BTreeMap<FlowId, Links>,
}

impl Links {
    /// Returns also how many were too many.
    fn new(
        now: Now,
        offsets: impl IntoIterator<Item = (FlowId, LinkOffset)>,
        room: usize,
    ) -> (Self, u64) {
        let sound = |link: &LinkOffset| {
            link.offset_s.is_finite() && link.error_s.is_finite() && link.error_s >= 0.0
        };
        let mut offsets = offsets.into_iter().filter(|(_, link)| sound(link));
        let kept = offsets.by_ref().take(room).collect();
        (Self { at: now.monotonic, offsets: kept }, offsets.count() as u64)
    }

    fn offset(&self, node: &FlowId, now: Now, source: Source) -> Option<Offset> {
        let link = self.offsets.get(node)?;
        // The flow does not say whether the clocks are synchronised, so the larger drift counts.
        let drift = drift_s(drift_ppm(false), now.monotonic.saturating_sub(self.at));
        Some(Offset { offset_s: link.offset_s, error_s: link.error_s + drift, source })
    }
}

impl Other {
    /// Replaces the offsets of the links. Returns how many were too many.
    pub(super) fn set_links(
        &mut self,
        now: Now,
        links: impl IntoIterator<Item = (FlowId, LinkOffset)>,
    ) -> u64 {
        let (links, too_many) = Links::new(now, links, OTHER_OFFSETS);
        self.own = links;
        too_many
    }

    /// Replaces the offsets that peers know. Returns how many were too many.
    pub(super) fn set_relayed<I: IntoIterator<Item = (FlowId, LinkOffset)>>(
        &mut self,
        now: Now,
        relayed: impl IntoIterator<Item = (FlowId, I)>,
    ) -> u64 {
        self.relayed.clear();
        let (mut room, mut too_many) = (OTHER_OFFSETS, 0);
        for (peer, offsets) in relayed {
            let (links, more) = Links::new(now, offsets, room);
            room -= links.offsets.len();
            too_many += more;
            if !links.offsets.is_empty() {
                self.relayed.insert(peer, links);
            }
        }
        too_many
    }

    /// Forgets all, after a step of the clock here.
    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }

    /// Forgets what contains a node, after a step of its clock.
    pub(super) fn forget(&mut self, node: &FlowId) {
        self.own.offsets.remove(node);
        self.relayed.remove(node);
        for links in self.relayed.values_mut() {
            links.offsets.remove(node);
        }
    }

    /// The best offset to a node: of a ping, of a link, of two in a row.
    pub(super) fn best(
        &self,
        node: &FlowId,
        now: Now,
        ping: impl Fn(&FlowId) -> Option<Offset>,
    ) -> Option<Offset> {
        let direct = |node: &FlowId| better(ping(node), self.own.offset(node, now, Source::Link));
        let via = self.relayed.iter().filter(|(peer, _)| *peer != node);
        via.filter_map(|(peer, links)| {
            let second = links.offset(node, now, Source::Via)?;
            let first = direct(peer)?;
            Some(Offset {
                offset_s: first.offset_s + second.offset_s,
                error_s: first.error_s + second.error_s,
                source: Source::Via,
            })
        })
        .fold(direct(node), |best, offset| better(best, Some(offset)))
    }
}

/// The one with the smaller error; the first of equal ones.
fn better(a: Option<Offset>, b: Option<Offset>) -> Option<Offset> {
    match (a, b) {
        (Some(a), Some(b)) => Some(if b.error_s < a.error_s { b } else { a }),
        (a, b) => a.or(b),
    }
}
