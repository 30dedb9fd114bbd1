//! Flows of the own layer on the channel that they share on their layer broker, with or without an
//! inter scope between them.
//!
//! A flow that was ever heard there lives as long as it is heard there: one that has lost the
//! broker cannot carry its topics, whatever the inter scope says, and what it says there is what
//! counts, with or without a link. Deltas are broadcast, requests and snapshots name whom they are
//! for.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use blaze_domain::{FlowId, TopicName};
use blaze_proto::link::link_control::{Body, Hello};

use super::loads::Load;
use super::remote::Remote;
use super::{Registry, Way};
use crate::world::{FlowState, Reach, SETTLED_AFTER};

/// A flow that was not heard on the layer broker for this long is gone.
pub const SILENT: Duration = Duration::from_millis(2500);
/// A flow that does not hear its own Hellos for this long, two of them, hears nobody.
const DEAF: Duration = Duration::from_millis(1200);
/// Who stood still for longer before it went silent is taken up from so much before its last sign
/// of life at most, in milliseconds.
const LONGEST_DEAF_MS: i64 = 30_000;
/// One that is heard nowhere is forgotten after this long.
const FORGET: Duration = Duration::from_secs(60);

/// The last sign of life of a flow on the layer broker.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sign {
    pub(super) at: Instant,
    /// Until when it had read what is published on the server, by that one's clock; its own Hello,
    /// where it does not say so.
    pub(super) read_ms: Option<i64>,
    /// It is too old, or was the last on purpose.
    pub(super) over: bool,
    /// What the flow carries, as it says.
    pub(super) load: Option<Load>,
}

/// How another flow can be reached.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Ways {
    /// Over the inter scope, if it was ever heard there.
    pub(super) link: Option<Reach>,
    /// Over the layer broker, if it was ever heard there.
    pub(super) layer: Option<Sign>,
}

impl Ways {
    /// Whether it lives.
    pub(super) fn reach(&self) -> Reach {
        match (&self.layer, self.link) {
            (Some(sign), _) if sign.over => Reach::Down,
            (Some(_), _) | (None, None) => Reach::Up,
            (None, Some(link)) => link,
        }
    }

    pub(super) fn over_link(&self) -> bool {
        self.link.is_some_and(|reach| reach != Reach::Down)
    }

    pub(super) fn over_layer(&self) -> bool {
        self.layer.is_some_and(|sign| !sign.over)
    }
}

/// Until when the sender of a Hello has read what is published, given when the server took it and
/// what it says itself. It may stand still although what it writes gets through.
fn read_until(appended_ms: i64, heard_ms: i64) -> i64 {
    if heard_ms > 0 {
        heard_ms.clamp(appended_ms.saturating_sub(LONGEST_DEAF_MS), appended_ms)
    } else {
        appended_ms
    }
}

/// Whether this flow hears what is said on the layer broker: it hears itself there.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hearing {
    /// Without a pause since then.
    since: Instant,
    last: Instant,
    appended_ms: Option<i64>,
}

impl Hearing {
    /// For how long nothing has been heard of a flow that should have been.
    fn silence(hearing: Option<&Self>, now: Instant, sign: &Sign) -> Duration {
        let heard_since = match hearing {
            Some(hearing) if now.saturating_duration_since(hearing.last) >= DEAF => now,
            Some(hearing) => hearing.since.max(sign.at),
            // Not every broker gives back what one says.
            None => sign.at,
        };
        now.saturating_duration_since(heard_since)
    }
}

impl Registry {
    /// The own Hello came back; the server took it at `appended_ms` of its clock.
    pub fn on_own_hello(&mut self, now: Instant, appended_ms: Option<i64>) {
        let before =
            self.hearing.filter(|hearing| now.saturating_duration_since(hearing.last) < DEAF);
        self.hearing = Some(Hearing {
            since: before.map_or(now, |hearing| hearing.since),
            last: now,
            appended_ms,
        });
    }

    /// Until when this flow has read what is published on the layer broker, by the server's clock
    /// in milliseconds; 0 = not known.
    #[must_use]
    pub fn heard_ms(&self) -> i64 {
        self.hearing.and_then(|hearing| hearing.appended_ms).unwrap_or(0)
    }

    /// A flow that shares the layer broker said Hello there, and the life that its process `began`
    /// with; the server took that at `appended_ms` of its clock. Returns the topics to plan anew.
    pub fn on_layer_hello(
        &mut self,
        now: Instant,
        from: &FlowId,
        hello: &Hello,
        began: u64,
        appended_ms: Option<i64>,
    ) -> BTreeSet<TopicName> {
        let own = self.world.own().and_then(|own| own.layer_scope);
        if from.layer != self.config.me.layer || own.is_none_or(|own| own.0 != hello.layer_scope_id)
        {
            return BTreeSet::new();
        }
        self.follow_life(from, hello.epoch, began);
        let mut changed = self.hear(now, from, hello, Way::Layer);
        let epoch = self.world.flows.get(from).map(|view| view.epoch);
        if epoch != Some(hello.epoch) {
            return changed;
        }
        if let Some(remote) = self.remotes.get_mut(from) {
            remote.began = Some(began);
            remote.ways.layer = Some(Sign {
                at: now,
                read_ms: appended_ms.map(|appended| read_until(appended, hello.heard_ms)),
                over: false,
                load: Load::said(hello),
            });
        }
        changed.extend(self.update_reach(now, from));
        changed
    }

    /// A flow that shares the layer broker sent something else there. Returns the topics to plan
    /// anew.
    pub fn on_layer_control(
        &mut self,
        now: Instant,
        from: &FlowId,
        epoch: u64,
        body: Body,
    ) -> BTreeSet<TopicName> {
        if self.world.flows.get(from).is_none_or(|view| view.epoch != epoch) {
            self.faults.unknown_flows += 1;
            return BTreeSet::new();
        }
        if let Body::Goodbye(_) = body {
            if let Some(sign) =
                self.remotes.get_mut(from).and_then(|remote| remote.ways.layer.as_mut())
            {
                sign.over = true;
            }
            return self.update_reach(now, from);
        }
        self.take(now, from, body, Way::Layer)
    }

    /// Nothing can be heard while the layer broker is away, which says nothing of who lives.
    pub fn excuse_silence(&mut self, now: Instant) {
        let signs = self.remotes.values_mut().filter_map(|remote| remote.ways.layer.as_mut());
        for sign in signs.filter(|sign| !sign.over) {
            sign.at = now;
        }
    }

    /// Flows that have been silent for too long are gone; flows that have been ready for long
    /// enough are settled. To be called every few ten milliseconds. Returns the topics to plan
    /// anew.
    pub fn watch_flows(&mut self, now: Instant) -> BTreeSet<TopicName> {
        let mut changed = BTreeSet::new();
        let (mut silent, mut forgotten) = (Vec::new(), Vec::new());
        for (flow, remote) in &mut self.remotes {
            let Some(sign) = &mut remote.ways.layer else { continue };
            let since = now.saturating_duration_since(sign.at);
            // Who hears nothing believes no silence.
            if !sign.over && Hearing::silence(self.hearing.as_ref(), now, sign) >= SILENT {
                sign.over = true;
                silent.push(flow.clone());
            } else if sign.over && since >= FORGET && !remote.ways.over_link() {
                forgotten.push(flow.clone());
            }
        }
        for flow in &silent {
            changed.extend(self.update_reach(now, flow));
        }
        for flow in &forgotten {
            changed.extend(self.forget(now, flow));
        }
        changed.extend(self.settle(now));
        changed
    }

    fn settle(&mut self, now: Instant) -> BTreeSet<TopicName> {
        let mut settled = false;
        for (flow, remote) in &mut self.remotes {
            let Some(view) = self.world.flows.get_mut(flow) else {
                continue;
            };
            if view.state != FlowState::Ready || view.reach == Reach::Down || view.layer_away {
                remote.ready_since = None;
                view.settled = false;
                continue;
            }
            let since = *remote.ready_since.get_or_insert(now);
            if !view.settled && now.saturating_duration_since(since) >= SETTLED_AFTER {
                view.settled = true;
                settled = true;
            }
        }
        settled |= self.end_of_grace(now);
        if settled { self.all_topics() } else { BTreeSet::new() }
    }

    /// What its ways say of a flow goes into the world. Returns the topics to plan anew.
    pub(super) fn update_reach(&mut self, now: Instant, flow: &FlowId) -> BTreeSet<TopicName> {
        let Some(reach) = self.remotes.get(flow).map(|remote| remote.ways.reach()) else {
            return BTreeSet::new();
        };
        match self.world.flows.get_mut(flow) {
            Some(view) if view.reach != reach => view.reach = reach,
            _ => return BTreeSet::new(),
        }
        self.tell_of(now, flow);
        if let Some(remote) = self.remotes.get_mut(flow) {
            remote.down_since = (reach == Reach::Down).then_some(now);
        }
        if reach == Reach::Down {
            self.inherit(now, flow);
            if let Some(remote) = self.remotes.get_mut(flow) {
                remote.stop();
            }
        }
        self.all_topics()
    }

    /// What is to be sent on the channel of the layer broker now, and to whom; `None` = to
    /// everybody. Call it after [`Registry::poll`].
    pub fn poll_layer(&mut self) -> Vec<(Option<FlowId>, Body)> {
        std::mem::take(&mut self.layer_outgoing)
    }

    /// Whether a change of what is told to others has not been handed out yet.
    #[must_use]
    pub fn has_unannounced(&self) -> bool {
        self.announcer.due().is_some() || self.layer_announcer.due().is_some()
    }

    /// Flows that were ever heard on the layer broker, and the time since the last sign of life.
    pub fn replicas(&self, now: Instant) -> impl Iterator<Item = (&FlowId, Duration)> {
        self.remotes.iter().filter_map(move |(flow, remote)| {
            let sign = remote.ways.layer?;
            Some((flow, now.saturating_duration_since(sign.at)))
        })
    }

    /// Whether all that living flows of the layer broker have announced is known.
    #[must_use]
    pub fn knows_replicas(&self) -> bool {
        let mut living = self.remotes.values().filter(|remote| remote.ways.over_layer());
        living.all(Remote::is_in_step)
    }
}
