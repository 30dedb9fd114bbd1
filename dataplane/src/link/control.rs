//! What the engine sends and takes: LinkControl, and datagrams of messages.

use std::time::Instant;

use blaze_domain::{FlowId, Priority};
use blaze_proto::link::LinkControl;
use blaze_proto::link::link_control::{Body, Clock, Feedback, Goodbye, Hello};
use bytes::Bytes;
use prost::Message as _;

use super::engine::Engine;
use super::event::{DownReason, LinkEvent, Transmit};
use super::peer::{Echo, HELLO_EVERY, Phase, kind_to_wire};
use super::receiver::{Admission, Inbox};
use super::sender::{FIRST_WINDOW, FeedbackView, SendContext};
use super::transport::Endpoint;
use super::wire::{Datagram, DatagramBuilder, LinkHeader, VERSION, class_code, class_index};

/// Missing ranges in one Feedback.
const MAX_MISSING: usize = 32;
/// Bytes of a Feedback with all its ranges.
const LARGEST_FEEDBACK: usize = 760;

fn class_of(code: u32) -> Option<Priority> {
    Priority::ALL
        .iter()
        .copied()
        .find(|class| u32::from(class_code(*class)) == code)
}

/// Sending.
impl Engine {
    /// LinkControl or a probe, for the next peer that has any.
    pub(super) fn transmit_control(&mut self, now: Instant) -> Option<Transmit> {
        let count = self.peers.len();
        for step in 1..=count {
            let at = (self.cursors[3] + step) % count;
            if let Some(transmit) = self.control_datagram(now, at).or_else(|| self.probe_datagram(now, at)) {
                self.cursors[3] = at;
                return Some(transmit);
            }
        }
        None
    }

    fn control_datagram(&mut self, now: Instant, at: usize) -> Option<Transmit> {
        let peer = self.peers[at].as_ref()?;
        let feedback = peer.is_connected() && peer.receive.iter().any(|class| class.feedback_due());
        if !(peer.hello_due || feedback || peer.goodbye_due || !peer.controls.is_empty()) || peer.phase == Phase::Gone {
            return None;
        }
        let mut out = DatagramBuilder::new(self.config.max_datagram);
        if peer.hello_due {
            let hello = self.hello_for(now, at);
            put(&mut out, Body::Hello(hello));
        }
        if feedback {
            self.put_feedbacks(now, at, &mut out);
        }
        let peer = self.peers[at].as_mut()?;
        while let Some(control) = peer.controls.front()
            && out.fits(control.len())
        {
            out.put_control(control);
            peer.controls.pop_front();
        }
        if peer.goodbye_due && peer.controls.is_empty() && out.fits(32) {
            peer.goodbye_due = false;
            let epoch = self.config.epoch;
            put(&mut out, Body::Goodbye(Goodbye { epoch }));
        }
        let to = peer.endpoint.clone();
        let datagram = out.finish(&LinkHeader {
            class: Priority::Control,
            records: 0,
            link_epoch: 0,
            sender: self.sender,
            link_sequence: 0,
            send_ns: self.clocks.monotonic_ns(now),
            unsettled: 0,
            message_floor: 0,
        });
        Some(Transmit {
            to,
            class: Priority::Control,
            datagram,
            user_bytes: 0,
            control: true,
        })
    }

    fn hello_for(&mut self, now: Instant, at: usize) -> Hello {
        let addresses = self.addresses.for_hello();
        let mut clock = Clock {
            sent_monotonic_ns: self.clocks.monotonic_ns(now),
            sent_wall_ns: self.clocks.wall_ns(now),
            ..Clock::default()
        };
        if let Some(peer) = &mut self.peers[at] {
            peer.hello_due = false;
            if let Some(echo) = peer.echo {
                clock.echo_monotonic_ns = echo.sent_monotonic_ns;
                clock.echo_held_ns = super::clock::nanoseconds(now.saturating_duration_since(echo.at));
                clock.echo_wall_ns = echo.wall_ns;
                clock.echo_received_wall_ns = echo.sent_wall_ns;
            }
        }
        let (version, digest) = self.registry;
        let (scope, scope_id) = self.config.layer_scope;
        Hello {
            layer: self.config.me.layer.as_str().to_owned(),
            node: self.config.me.node.as_str().to_owned(),
            kind: kind_to_wire(self.config.kind).into(),
            epoch: self.config.epoch,
            registry_version: version,
            registry_digest: digest,
            state: self.state.into(),
            layer_scope: scope.into(),
            layer_scope_id: scope_id,
            protocol_min: u32::from(VERSION),
            protocol_max: u32::from(VERSION),
            addresses,
            dds_guid_prefixes: self.guid_prefixes.clone(),
            clock: Some(clock),
            egress: self.egress,
            public_key: Bytes::new(),
        }
    }

    fn put_feedbacks(&mut self, now: Instant, at: usize, out: &mut DatagramBuilder) {
        let share = self.receive_share(at);
        let Some(peer) = &mut self.peers[at] else { return };
        for (index, class) in peer.receive.iter_mut().enumerate() {
            // One with all its ranges fits an empty datagram; those for which there is no room go with the next.
            if class.feedback_due() && out.fits(LARGEST_FEEDBACK) {
                put(
                    out,
                    Body::Feedback(class.feedback(now, class_code(Priority::ALL[index]), share)),
                );
            }
        }
    }

    /// Memory for unfinished messages that a peer may still take: its share of the whole.
    fn receive_share(&self, at: usize) -> u64 {
        let connected = self.peers.iter().flatten().filter(|peer| peer.is_connected()).count();
        let share = self.config.limits.reassembly_bytes / connected.max(1);
        let used = self.peers[at].as_ref().map_or(0, super::peer::Peer::reserved);
        (share.saturating_sub(used) as u64).max(FIRST_WINDOW)
    }

    fn probe_datagram(&mut self, now: Instant, at: usize) -> Option<Transmit> {
        let peer = self.peers[at].as_mut().filter(|peer| peer.is_connected())?;
        let mut ctx = SendContext {
            now,
            send_ns: self.clocks.monotonic_ns(now),
            sender: self.sender,
            round_trip: peer.round_trip.get(),
            ledger: &mut self.ledger,
            counters: &mut self.counters,
        };
        for (index, class) in peer.send.iter_mut().enumerate() {
            if let Some(datagram) = class.probe(&mut ctx) {
                return Some(Transmit {
                    to: peer.endpoint.clone(),
                    class: Priority::ALL[index],
                    datagram,
                    user_bytes: 0,
                    control: true,
                });
            }
        }
        None
    }

    /// Messages of the most urgent class that has any, for the next peer in turn.
    pub(super) fn transmit_messages(&mut self, now: Instant) -> Option<Transmit> {
        let count = self.peers.len();
        let send_ns = self.clocks.monotonic_ns(now);
        for (index, class) in Priority::ALL.iter().copied().enumerate() {
            for step in 1..=count {
                let at = (self.cursors[index] + step) % count;
                let Some(peer) = self.peers[at].as_mut().filter(|peer| peer.phase == Phase::Up) else {
                    continue;
                };
                let mut ctx = SendContext {
                    now,
                    send_ns,
                    sender: self.sender,
                    round_trip: peer.round_trip.get(),
                    ledger: &mut self.ledger,
                    counters: &mut self.counters,
                };
                if let Some((datagram, user_bytes)) = peer.send[index].transmit(&mut ctx) {
                    self.cursors[index] = at;
                    return Some(Transmit {
                        to: peer.endpoint.clone(),
                        class,
                        datagram,
                        user_bytes,
                        control: false,
                    });
                }
            }
        }
        None
    }
}

fn put(out: &mut DatagramBuilder, body: Body) {
    out.put_control(&LinkControl { body: Some(body) }.encode_to_vec());
}

/// Receiving.
impl Engine {
    /// Takes a datagram that came on the topic of a class.
    pub fn receive(&mut self, now: Instant, datagram: Bytes, class: Priority) {
        let Ok(datagram) = Datagram::parse(datagram, class) else {
            self.counters.decode_errors += 1;
            return;
        };
        if datagram.header.link_sequence == 0 {
            datagram.for_each(|_, bytes| match LinkControl::decode(bytes) {
                Ok(LinkControl { body: Some(body) }) => self.control_received(now, &datagram.header, body),
                // A newer flow may say more than this one knows.
                Ok(LinkControl { body: None }) => {}
                Err(_) => self.counters.decode_errors += 1,
            });
        } else {
            self.messages_received(now, &datagram);
        }
    }

    fn messages_received(&mut self, now: Instant, datagram: &Datagram) {
        let header = &datagram.header;
        let Some(at) = self.known_sender(header) else { return };
        let class = class_index(header.class);
        let admission = self.with_inbox(now, at, |peer, inbox| peer[class].admit(inbox, header, datagram.len()));
        match admission {
            Some(Admission::New) => {}
            Some(Admission::Repeated) if header.records > 0 => {
                self.counters.duplicates += 1;
                return;
            }
            Some(Admission::Stale) => {
                self.counters.stale += 1;
                return;
            }
            Some(Admission::Overrun) => {
                self.counters.overrun += 1;
                return;
            }
            Some(Admission::Repeated) | None => return,
        }
        datagram.for_each(|record, bytes| {
            let needs = self.peers[at]
                .as_ref()
                .map_or(0, |peer| peer.receive[class].needs(record, datagram.len()));
            if needs == 0 || self.make_room(now, at, needs) {
                self.with_inbox(now, at, |peer, inbox| {
                    peer[class].record(inbox, record, bytes, datagram.len());
                });
            } else {
                self.counters.reassembly_evicted += 1;
            }
        });
    }

    /// Place of the sender of a datagram, if it has said Hello in this life.
    fn known_sender(&mut self, header: &LinkHeader) -> Option<usize> {
        let at = self.by_sender.get(&header.sender).copied();
        let phase = at.and_then(|at| self.peers[at].as_ref()).map(|peer| peer.phase);
        match phase {
            Some(Phase::Up | Phase::Suspect | Phase::Down) => at,
            Some(Phase::Gone) => {
                self.counters.stale += 1;
                None
            }
            Some(Phase::Connecting) | None => {
                self.counters.unknown_senders += 1;
                None
            }
        }
    }

    fn with_inbox<T>(
        &mut self,
        now: Instant,
        at: usize,
        act: impl FnOnce(&mut [super::receiver::ReceiveClass; 3], &mut Inbox<'_>) -> T,
    ) -> Option<T> {
        let peer = self.peers[at].as_mut()?;
        let mut inbox = Inbox {
            now,
            from: &peer.endpoint.flow,
            half_round_trip: peer.round_trip.measured().unwrap_or_default() / 2,
            events: &mut self.ledger.events,
            counters: &mut self.counters,
            hasher: &self.hasher,
        };
        Some(act(&mut peer.receive, &mut inbox))
    }

    /// Frees memory for `needs` bytes at the cost of the peer that takes most. Returns whether there is room.
    fn make_room(&mut self, now: Instant, at: usize, needs: usize) -> bool {
        let limit = self.config.limits.reassembly_bytes;
        loop {
            let reserved = self
                .peers
                .iter()
                .map(|peer| peer.as_ref().map_or(0, super::peer::Peer::reserved));
            let mut used = 0;
            let mut largest = (0, at);
            for (place, bytes) in reserved.enumerate() {
                used += bytes;
                let wants = if place == at { bytes + needs } else { bytes };
                largest = largest.max((wants, place));
            }
            if used + needs <= limit {
                return true;
            }
            let freed = self.with_inbox(now, largest.1, |classes, inbox| {
                // The least urgent class gives way first.
                classes.iter_mut().rev().any(|class| class.evict(inbox))
            });
            if freed != Some(true) {
                return false;
            }
        }
    }

    fn control_received(&mut self, now: Instant, header: &LinkHeader, body: Body) {
        if let Body::Hello(hello) = body {
            self.hello_received(now, header, hello);
            return;
        }
        let Some(at) = self.known_sender(header) else { return };
        let Some(peer) = &self.peers[at] else { return };
        let from = peer.endpoint.flow.clone();
        match body {
            Body::Feedback(feedback) => self.feedback_received(now, at, &feedback),
            Body::Goodbye(goodbye) if goodbye.epoch == peer.endpoint.epoch => self.goodbye_received(now, at),
            Body::Goodbye(_) => self.counters.stale += 1,
            Body::Delta(_) | Body::SnapshotRequest(_) | Body::Snapshot(_) => {
                if peer.is_connected() {
                    self.ledger.events.push_back(LinkEvent::Control { from, body });
                }
            }
            Body::Hello(_) => {}
        }
    }

    fn hello_received(&mut self, now: Instant, header: &LinkHeader, hello: Hello) {
        let (Ok(layer), Ok(node)) = (hello.layer.parse(), hello.node.parse()) else {
            self.counters.decode_errors += 1;
            return;
        };
        let flow = FlowId::new(layer, node);
        let speaks = hello.protocol_min <= u32::from(VERSION) && u32::from(VERSION) <= hello.protocol_max;
        if !speaks || super::wire::SenderId::of(&flow, hello.epoch) != header.sender {
            self.counters.decode_errors += 1;
            return;
        }
        let endpoint = Endpoint {
            flow: flow.clone(),
            epoch: hello.epoch,
        };
        let Some(at) = self.place_of(now, endpoint) else { return };
        let wall_ns = self.clocks.wall_ns(now);
        let now_ns = self.clocks.monotonic_ns(now);
        let Some(peer) = &mut self.peers[at] else { return };
        if peer.phase == Phase::Gone {
            self.counters.stale += 1;
            return;
        }
        peer.last_hello = Some(now);
        if let Some(clock) = &hello.clock {
            // An older Hello that was overtaken is of no use for the clocks.
            if peer
                .echo
                .is_none_or(|echo| echo.sent_monotonic_ns < clock.sent_monotonic_ns)
            {
                peer.echo = Some(Echo {
                    sent_monotonic_ns: clock.sent_monotonic_ns,
                    sent_wall_ns: clock.sent_wall_ns,
                    at: now,
                    wall_ns,
                });
            }
            let (sent, held) = (clock.echo_monotonic_ns, clock.echo_held_ns);
            if let Some(round_trip) = peer.round_trip.echo(now, now_ns, sent, held) {
                peer.clock.exchange(clock, wall_ns, round_trip);
            }
        }
        let hello = Box::new(hello);
        peer.hello = Some(hello.clone());
        if !peer.is_connected() {
            peer.phase = Phase::Up;
            peer.since = now;
            peer.hello_due = true;
            peer.hello_at = now + HELLO_EVERY;
            self.ledger.events.push_back(LinkEvent::PeerUp {
                flow: flow.clone(),
                epoch: hello.epoch,
            });
        }
        let new = self.addresses.learn(&hello.addresses);
        if !new.is_empty() {
            self.ledger.events.push_back(LinkEvent::Addresses(new));
        }
        self.ledger.events.push_back(LinkEvent::Hello { from: flow, hello });
    }

    fn feedback_received(&mut self, now: Instant, at: usize, feedback: &Feedback) {
        let now_ns = self.clocks.monotonic_ns(now);
        let Some(peer) = self.peers[at].as_mut() else { return };
        let missing = &feedback.missing;
        let pairs = missing.chunks_exact(2);
        let ascending = pairs.clone().all(|pair| pair[1] > 0)
            && missing.len().is_multiple_of(2)
            && missing.len() <= 2 * MAX_MISSING
            && pairs
                .clone()
                .zip(pairs.skip(1))
                .all(|(a, b)| a[0].saturating_add(a[1]) <= b[0]);
        let Some(class) = class_of(feedback.link_class).filter(|_| ascending) else {
            self.counters.decode_errors += 1;
            return;
        };
        if !peer.is_connected() {
            return;
        }
        let mut ctx = SendContext {
            now,
            send_ns: now_ns,
            sender: self.sender,
            round_trip: peer.round_trip.get(),
            ledger: &mut self.ledger,
            counters: &mut self.counters,
        };
        let view = FeedbackView {
            link_epoch: feedback.link_epoch,
            highest_sequence: feedback.highest_sequence,
            missing,
            received_bytes: feedback.received_bytes,
            window_bytes: feedback.window_bytes,
            delivered_message: feedback.delivered_message,
        };
        if !peer.send[class_index(class)].feedback(&mut ctx, &view) {
            self.counters.stale += 1;
            return;
        }
        peer.round_trip
            .echo(now, now_ns, feedback.echo_send_ns, feedback.echo_held_ns);
        peer.last_feedback = Some(now);
        if peer.phase == Phase::Suspect {
            peer.phase = Phase::Up;
            let flow = peer.endpoint.flow.clone();
            self.ledger.events.push_back(LinkEvent::PeerRecovered { flow });
        }
    }

    /// The peer stops: it is down at once and not waited for; late datagrams of that life are ignored.
    fn goodbye_received(&mut self, now: Instant, at: usize) {
        self.take_down(now, at, DownReason::Goodbye);
        let Some(peer) = &mut self.peers[at] else { return };
        peer.phase = Phase::Gone;
        peer.hello_due = false;
        self.ledger.events.push_back(LinkEvent::PeerForgotten {
            flow: peer.endpoint.flow.clone(),
            epoch: peer.endpoint.epoch,
        });
    }
}
