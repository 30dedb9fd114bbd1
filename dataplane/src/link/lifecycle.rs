//! Peers come and go: found, up, suspect, down, forgotten, replaced by a newer life.

use std::time::{Duration, Instant};

use blaze_domain::FlowId;

use super::engine::Engine;
use super::event::{DownReason, LinkEvent};
use super::peer::{FORGET_AFTER, HELLO_EVERY, Peer, Phase};
use super::receiver::Inbox;
use super::sender::{SendContext, SendLimits};
use super::transport::Endpoint;
use super::wire::SenderId;

/// Missed flows that are kept; beyond that the one that is due next is forgotten.
const MAX_MISSED: usize = 1_024;
/// Endpoints that are kept until there is a place for them, or until the newer life of the same flow
/// has ended that speaks in their stead; beyond that the oldest gives way.
const MAX_WAITING: usize = 256;
/// How often it is told that a flow found no place.
const REFUSAL_TOLD_EVERY: Duration = Duration::from_secs(60);

/// A flow that was heard, until a new life began, here or there. Without this nobody would tell
/// that it did not come back.
#[derive(Debug, Clone, Copy)]
pub(super) struct Missed {
    /// The life in which it was heard.
    epoch: u64,
    /// When it is forgotten, unless it says Hello before.
    pub(super) until: Instant,
}

impl Engine {
    /// The transport can write to an endpoint.
    ///
    /// Returns whether it is wanted: not an older life, not this flow itself, and there is room.
    pub fn peer_discovered(&mut self, now: Instant, endpoint: Endpoint) -> bool {
        let Some(at) = self.place_of(now, endpoint, false) else {
            return false;
        };
        if let Some(peer) = &mut self.peers[at]
            && peer.phase != Phase::Gone
        {
            peer.hello_due = true;
            peer.hello_at = now + HELLO_EVERY;
        }
        true
    }

    /// The transport no longer sees an endpoint. One that says Hello stays; one that never did is
    /// forgotten.
    pub fn peer_lost(&mut self, now: Instant, endpoint: &Endpoint) {
        self.waiting.retain(|waiting| waiting != endpoint);
        if let Some(&at) = self.by_flow.get(&endpoint.flow)
            && let Some(peer) = &self.peers[at]
            && peer.endpoint == *endpoint
            && peer.phase == Phase::Connecting
        {
            self.remove(at);
            self.admit_waiting(now);
        }
    }

    /// The place of an endpoint, made if it is new; a newer life replaces an older one, and an older
    /// one that speaks now replaces a newer one that does not any more. `None`: an older life, this
    /// flow itself, or no room.
    pub(super) fn place_of(
        &mut self,
        now: Instant,
        endpoint: Endpoint,
        speaks: bool,
    ) -> Option<usize> {
        if endpoint.flow == self.config.me {
            return None;
        }
        let mut ended = None;
        if let Some(&at) = self.by_flow.get(&endpoint.flow)
            && let Some(peer) = &self.peers[at]
        {
            let known = peer.endpoint.clone();
            if endpoint == known {
                return Some(at);
            }
            if !self.may_enter(&endpoint, speaks) {
                self.counters.stale += 1;
                if endpoint.epoch < known.epoch {
                    self.wait(endpoint);
                }
                return None;
            }
            if endpoint.epoch > known.epoch {
                let was_connected = peer.is_connected();
                self.replace(now, at, DownReason::NewEpoch);
                if was_connected {
                    // It may go on, and the newer one may be a mistake that ends.
                    self.wait(known);
                }
            } else {
                ended = (peer.phase == Phase::Gone).then_some(known.epoch);
                self.forget(at);
            }
        }
        let Some(at) = self.free_place() else {
            self.refuse(now, endpoint);
            return None;
        };
        self.waiting.retain(|waiting| *waiting != endpoint);
        let limits = [0, 1, 2].map(|class| SendLimits {
            queue_bytes: self.config.limits.queue_bytes[class],
            streams: self.config.limits.streams,
            max_datagram: self.config.max_datagram,
        });
        let mut peer =
            Peer::new(now, endpoint, self.next_link_epoch, limits, self.config.limits.streams);
        peer.ended = ended;
        peer.was_heard = self.heard.pop(&peer.endpoint.flow).is_some();
        let layer = &peer.endpoint.flow.layer;
        self.budgets.fit(now, layer, self.config.max_datagram, &mut peer.path);
        self.next_link_epoch = self.next_link_epoch.saturating_add(3);
        self.by_flow.insert(peer.endpoint.flow.clone(), at);
        self.by_sender.insert(peer.sender, at);
        self.peers[at] = Some(peer);
        Some(at)
    }

    fn free_place(&mut self) -> Option<usize> {
        if let Some(at) = self.peers.iter().position(Option::is_none) {
            return Some(at);
        }
        if self.peers.len() < self.config.limits.peers {
            self.peers.push(None);
            return Some(self.peers.len() - 1);
        }
        let idle = self.peers.iter().enumerate().filter_map(|(at, peer)| {
            let peer = peer.as_ref().filter(|peer| !peer.is_connected())?;
            Some((peer.last_hello.unwrap_or(peer.since), at))
        });
        let Some((_, at)) = idle.min() else {
            self.counters.peers_refused += 1;
            return None;
        };
        self.forget(at);
        Some(at)
    }

    /// Notes a flow that found no place. It will not be found a second time, and stops saying Hello
    /// if it gets no answer.
    fn refuse(&mut self, now: Instant, endpoint: Endpoint) {
        let told = self.refusal_told;
        if told.is_none_or(|told| now.saturating_duration_since(told) >= REFUSAL_TOLD_EVERY) {
            self.refusal_told = Some(now);
            self.ledger.events.push_back(LinkEvent::PeerRefused {
                flow: endpoint.flow.clone(),
                peers: self.config.limits.peers,
            });
        }
        self.wait(endpoint);
    }

    fn wait(&mut self, endpoint: Endpoint) {
        if self.waiting.contains(&endpoint) {
            return;
        }
        if self.waiting.len() >= MAX_WAITING {
            self.waiting.pop_front();
        }
        self.waiting.push_back(endpoint);
    }

    /// Takes those that wait and may be peers now.
    pub(super) fn admit_waiting(&mut self, now: Instant) {
        while let Some(at) =
            self.waiting.iter().position(|endpoint| self.may_enter(endpoint, false))
            && let Some(endpoint) = self.waiting.remove(at)
        {
            if self.peer_discovered(now, endpoint.clone()) {
                self.ledger.events.push_back(LinkEvent::PeerAdmitted(endpoint));
            }
        }
    }

    /// Whether there is a place for an endpoint that has none: a free one, or that of another life
    /// of the same flow, which is older or has ended. One that is silent, but may be back, gives way
    /// to one that speaks alone.
    fn may_enter(&self, endpoint: &Endpoint, speaks: bool) -> bool {
        match self.by_flow.get(&endpoint.flow).and_then(|at| self.peers[*at].as_ref()) {
            Some(peer) if peer.ended == Some(endpoint.epoch) => false,
            Some(peer) => {
                endpoint.epoch > peer.endpoint.epoch
                    || peer.phase == Phase::Gone
                    || (speaks && peer.phase == Phase::Down)
            }
            None => {
                self.peers.len() < self.config.limits.peers
                    || self.peers.iter().any(Option::is_none)
            }
        }
    }

    /// This flow begins a new life: peers are dropped and have to be found again. Those that are
    /// not heard again are forgotten as if it had gone on.
    pub fn restart(&mut self, now: Instant, epoch: u64) {
        // The transport finds all of them anew.
        self.waiting.clear();
        for at in 0..self.peers.len() {
            self.replace(now, at, DownReason::Restarted);
        }
        self.config.epoch = epoch;
        self.sender = SenderId::of(&self.config.me, epoch);
    }

    /// This flow leaves the inter scope on purpose: it waits for nobody there.
    pub fn leave(&mut self, now: Instant) {
        for at in 0..self.peers.len() {
            self.take_down(now, at, DownReason::Restarted);
            self.remove(at);
        }
        self.missed.clear();
        self.waiting.clear();
    }

    /// Removes a peer because a new life begins, here or there. If it was heard, it is missed.
    fn replace(&mut self, now: Instant, at: usize, reason: DownReason) {
        let peer = self.peers.get(at).and_then(Option::as_ref);
        if let Some(peer) = peer.filter(|peer| peer.is_connected() || peer.phase == Phase::Down) {
            let missed = Missed {
                epoch: peer.endpoint.epoch,
                until: peer.last_hello.unwrap_or(peer.since) + FORGET_AFTER,
            };
            let flow = peer.endpoint.flow.clone();
            self.miss(flow, missed);
        }
        self.take_down(now, at, reason);
        self.remove(at);
    }

    fn miss(&mut self, flow: FlowId, missed: Missed) {
        if self.missed.len() >= MAX_MISSED && !self.missed.contains_key(&flow) {
            let next = self.missed.iter().min_by_key(|(_, missed)| missed.until);
            if let Some(next) = next.map(|(flow, _)| flow.clone()) {
                self.forget_missed(next);
            }
        }
        self.missed.insert(flow, missed);
    }

    fn forget_missed(&mut self, flow: FlowId) {
        if let Some(Missed { epoch, .. }) = self.missed.remove(&flow) {
            let endpoint = Endpoint { flow, epoch };
            self.ledger.events.push_back(LinkEvent::PeerForgotten(endpoint));
        }
    }

    /// Forgets the missed flows that did not come back in time.
    fn forget_silent(&mut self, now: Instant) {
        let missed = self.missed.iter();
        let due = missed
            .filter(|(flow, missed)| missed.until <= now && !self.by_flow.contains_key(*flow));
        let due: Vec<FlowId> = due.map(|(flow, _)| flow.clone()).collect();
        for flow in due {
            self.forget_missed(flow);
        }
    }

    /// Drops what waits for a peer, hands out what waits from it, and says so if it was up.
    pub(super) fn take_down(&mut self, now: Instant, at: usize, reason: DownReason) {
        let Some(peer) = self.peers.get_mut(at).and_then(Option::as_mut) else {
            return;
        };
        let was_connected = peer.is_connected();
        self.next_link_epoch = peer.drop_outgoing(self.next_link_epoch, &mut self.ledger);
        let half_round_trip = peer.round_trip.measured().unwrap_or_default() / 2;
        let mut inbox = Inbox {
            now,
            from: &peer.endpoint.flow,
            half_round_trip,
            events: &mut self.ledger.events,
            counters: &mut self.counters,
            hasher: &self.hasher,
        };
        for class in &mut peer.receive {
            class.release_all(&mut inbox);
        }
        if peer.phase != Phase::Gone {
            peer.phase = Phase::Down;
        }
        peer.since = now;
        if was_connected {
            let endpoint = peer.endpoint.clone();
            self.ledger.events.push_back(LinkEvent::PeerDown { endpoint, reason });
        }
    }

    fn remove(&mut self, at: usize) {
        if let Some(peer) = self.peers.get_mut(at).and_then(Option::take) {
            self.by_flow.remove(&peer.endpoint.flow);
            self.by_sender.remove(&peer.sender);
            if peer.was_heard {
                self.heard.put(peer.endpoint.flow.clone(), ());
            }
            self.ledger.events.push_back(LinkEvent::PeerRemoved(peer.endpoint));
        }
    }

    /// Removes a peer that is not connected, and says so if it was known by name.
    fn forget(&mut self, at: usize) {
        let Some(peer) = self.peers.get(at).and_then(Option::as_ref) else {
            return;
        };
        if peer.phase == Phase::Down {
            let endpoint = peer.endpoint.clone();
            self.ledger.events.push_back(LinkEvent::PeerForgotten(endpoint));
        }
        self.remove(at);
    }

    /// Does what time has made due.
    pub fn handle_timeout(&mut self, now: Instant) {
        for at in 0..self.peers.len() {
            self.advance_phase(now, at);
            self.advance_classes(now, at);
        }
        self.forget_silent(now);
        if !self.waiting.is_empty() {
            self.admit_waiting(now);
        }
    }

    fn advance_phase(&mut self, now: Instant, at: usize) {
        let Some(peer) = &mut self.peers[at] else { return };
        if peer.hello_at <= now && peer.phase != Phase::Gone {
            peer.hello_due = true;
            peer.hello_at = now + HELLO_EVERY;
        }
        if peer.silent_at().is_some_and(|silent| silent <= now) {
            if peer.is_connected() {
                self.take_down(now, at, DownReason::Silent);
            } else {
                self.forget(at);
            }
        } else if peer.suspect_at().is_some_and(|suspect| suspect <= now) {
            peer.phase = Phase::Suspect;
            self.ledger
                .events
                .push_back(LinkEvent::PeerSuspect { flow: peer.endpoint.flow.clone() });
        }
    }

    fn advance_classes(&mut self, now: Instant, at: usize) {
        let Some(peer) = &mut self.peers[at] else { return };
        let connected = peer.is_connected();
        let mut ctx = SendContext {
            now,
            send_ns: self.clocks.monotonic_ns(now),
            sender: self.sender,
            round_trip: peer.round_trip.get(),
            packets: self.budgets.packets(),
            ledger: &mut self.ledger,
            counters: &mut self.counters,
        };
        for class in &mut peer.send {
            if class.next_timeout().is_some_and(|due| due <= now) {
                class.handle_timeout(&mut ctx);
            }
        }
        let mut inbox = Inbox {
            now,
            from: &peer.endpoint.flow,
            half_round_trip: peer.round_trip.measured().unwrap_or_default() / 2,
            events: &mut self.ledger.events,
            counters: &mut self.counters,
            hasher: &self.hasher,
        };
        for class in &mut peer.receive {
            if class.next_timeout(connected).is_some_and(|due| due <= now) {
                class.handle_timeout(&mut inbox);
            }
        }
    }
}
