//! What the engine takes: LinkControl, and datagrams of messages.

use std::time::{Duration, Instant};

use blaze_domain::{FlowId, Priority};
use blaze_proto::link::LinkControl;
use blaze_proto::link::link_control::{Body, Feedback, Hello, Written, WrittenRequest};
use bytes::Bytes;
use prost::Message as _;

use super::engine::Engine;
use super::event::{DownReason, LinkEvent};
use super::peer::{Echo, HELLO_EVERY, Peer, Phase};
use super::receiver::{Admission, GIVEN_UP_TOLD, Inbox, MISSING_RANGES, MORE_RANGES, ReceiveClass};
use super::sender::{FeedbackView, SendContext};
use super::transport::Endpoint;
use super::wire::{Datagram, LinkHeader, SenderId, VERSION, class_of};
use crate::limit::capacity::Seen;

/// Without Feedback for this long the way to a peer may have become another one.
const LONG_SILENCE: Duration = Duration::from_secs(1);

/// What a Feedback lists, checked for form.
struct Told {
    /// First and count, ascending.
    missing: Vec<u64>,
    /// What it speaks for.
    highest_sequence: u64,
    /// Messages, ascending.
    given_up: Vec<u32>,
}

impl Told {
    /// `None`: no such Feedback.
    fn read(feedback: &Feedback) -> Option<Self> {
        let are_pairs = |length: usize, most: usize| length.is_multiple_of(2) && length <= 2 * most;
        let (some, more) = (&feedback.missing, &feedback.more_missing);
        let distances = &feedback.given_up;
        if !are_pairs(some.len(), MISSING_RANGES)
            || !are_pairs(more.len(), MORE_RANGES)
            || distances.len() > GIVEN_UP_TOLD
        {
            return None;
        }
        let (mut given_up, mut number) = (Vec::with_capacity(distances.len()), 0u32);
        for distance in distances {
            number = number.checked_add(*distance)?;
            given_up.push(number);
        }
        let (mut missing, mut end) = (some.clone(), feedback.highest_sequence);
        for pair in more.chunks_exact(2) {
            let (came, count) = (u64::from(pair[0]), u64::from(pair[1]));
            let first = end.checked_add(came)?.checked_add(1)?;
            missing.extend([first, count]);
            end = first.checked_add(count)?.checked_sub(1)?;
        }
        let highest_sequence = if more.is_empty() { end } else { feedback.more_highest };
        let pairs = missing.chunks_exact(2);
        let is_ascending = pairs.clone().all(|pair| pair[1] > 0)
            && pairs.clone().zip(pairs.skip(1)).all(|(a, b)| a[0].saturating_add(a[1]) <= b[0]);
        (is_ascending && end <= highest_sequence).then_some(Self {
            missing,
            highest_sequence,
            given_up,
        })
    }
}

impl Engine {
    /// Takes a datagram that came on the topic of a class.
    pub fn receive(&mut self, now: Instant, datagram: Bytes, class: Priority) {
        let Ok(datagram) = Datagram::parse(datagram, class) else {
            self.counters.decode_errors += 1;
            return;
        };
        if datagram.header.link_sequence == 0 {
            datagram.for_each(|_, bytes| match LinkControl::decode(bytes) {
                Ok(LinkControl { body: Some(body), .. }) => {
                    self.control_received(now, &datagram.header, body);
                }
                // A newer flow may say more than this one knows.
                Ok(LinkControl { body: None, .. }) => {}
                Err(_) => self.counters.decode_errors += 1,
            });
        } else {
            self.messages_received(now, &datagram);
        }
    }

    fn messages_received(&mut self, now: Instant, datagram: &Datagram) {
        let header = &datagram.header;
        let Some(at) = self.known_sender(header) else { return };
        let class = header.class as usize;
        let admission = self
            .with_inbox(now, at, |peer, inbox| peer[class].admit(inbox, header, datagram.len()));
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
                self.with_inbox(now, at, |peer, inbox| peer[class].refuse(inbox, record.message));
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
        act: impl FnOnce(&mut [ReceiveClass; 3], &mut Inbox<'_>) -> T,
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

    /// Frees memory for `needs` bytes at the cost of the peer that takes most. Returns whether
    /// there is room.
    fn make_room(&mut self, now: Instant, at: usize, needs: usize) -> bool {
        let limit = self.config.limits.reassembly_bytes;
        loop {
            let reserved = self.peers.iter().map(|peer| peer.as_ref().map_or(0, Peer::reserved));
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
            Body::WrittenRequest(WrittenRequest { topic, token }) if peer.is_connected() => {
                self.ledger.events.push_back(LinkEvent::WrittenAsked { from, topic, token });
            }
            Body::Written(Written { token }) => {
                self.ledger.events.push_back(LinkEvent::Written { from, token });
            }
            Body::WrittenRequest(_) => {}
            Body::Goodbye(goodbye) if goodbye.epoch == peer.endpoint.epoch => {
                self.goodbye_received(now, at);
            }
            Body::Goodbye(_) => self.counters.stale += 1,
            Body::Delta(_)
            | Body::SnapshotRequest(_)
            | Body::Snapshot(_)
            | Body::TypeRequest(_)
            | Body::TypeDefinition(_) => {
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
        let speaks =
            hello.protocol_min <= u32::from(VERSION) && u32::from(VERSION) <= hello.protocol_max;
        if !speaks || SenderId::of(&flow, hello.epoch) != header.sender {
            self.counters.decode_errors += 1;
            return;
        }
        let endpoint = Endpoint { flow: flow.clone(), epoch: hello.epoch };
        let Some(at) = self.place_of(now, endpoint, true) else { return };
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
            if peer.echo.is_none_or(|echo| echo.sent_monotonic_ns < clock.sent_monotonic_ns) {
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
            if std::mem::replace(&mut peer.was_heard, true) {
                peer.path.outage(now);
            }
            self.missed.remove(&flow);
            peer.hello_due = true;
            peer.hello_at = now + HELLO_EVERY;
            let endpoint = peer.endpoint.clone();
            self.ledger.events.push_back(LinkEvent::PeerUp(endpoint));
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
        let (Some(class), Some(told)) = (class_of(feedback.link_class), Told::read(feedback))
        else {
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
            packets: self.budgets.packets(),
            ledger: &mut self.ledger,
            counters: &mut self.counters,
        };
        let view = FeedbackView {
            link_epoch: feedback.link_epoch,
            highest_sequence: told.highest_sequence,
            missing: &told.missing,
            given_up: &told.given_up,
            received_bytes: feedback.received_bytes,
            window_bytes: feedback.window_bytes,
            delivered_message: feedback.delivered_message,
        };
        let sender = &mut peer.send[class as usize];
        if !sender.feedback(&mut ctx, &view) {
            self.counters.stale += 1;
            return;
        }
        let (delivered_bytes, lost_bytes) = sender.take_settled();
        let round_trip =
            peer.round_trip.echo(now, now_ns, feedback.echo_send_ns, feedback.echo_held_ns);
        let seen = Seen { delivered_bytes, lost_bytes, round_trip };
        peer.path.feedback(now, &seen);
        let silent =
            peer.last_feedback.replace(now).map(|last| now.saturating_duration_since(last));
        if peer.phase == Phase::Suspect {
            peer.phase = Phase::Up;
            // After a moment the way is the same one; a slow start would cost more than it spares.
            if silent.is_none_or(|silent| silent >= LONG_SILENCE) {
                peer.path.outage(now);
            }
            let flow = peer.endpoint.flow.clone();
            self.ledger.events.push_back(LinkEvent::PeerRecovered { flow });
        }
    }

    /// The peer stops: it is down at once and not waited for; late datagrams of that life are
    /// ignored.
    fn goodbye_received(&mut self, now: Instant, at: usize) {
        self.take_down(now, at, DownReason::Goodbye);
        let Some(peer) = &mut self.peers[at] else { return };
        peer.phase = Phase::Gone;
        peer.hello_due = false;
        let endpoint = peer.endpoint.clone();
        self.ledger.events.push_back(LinkEvent::PeerForgotten(endpoint));
        self.admit_waiting(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn feedback(missing: &[u64], highest_sequence: u64) -> Feedback {
        Feedback { highest_sequence, missing: missing.to_vec(), ..Feedback::default() }
    }

    #[test]
    fn missing_ranges_go_on_where_the_first_ones_end() {
        let short = Told::read(&feedback(&[3, 2, 9, 1], 20)).unwrap();
        assert_eq!((short.missing, short.highest_sequence), (vec![3, 2, 9, 1], 20));
        let long = Feedback {
            more_missing: vec![5, 1, 1, 10],
            more_highest: 40,
            ..feedback(&[3, 2, 9, 1], 9)
        };
        let long = Told::read(&long).unwrap();
        assert_eq!((long.missing, long.highest_sequence), (vec![3, 2, 9, 1, 15, 1, 17, 10], 40));
    }

    #[test]
    fn ranges_that_contradict_one_another_are_refused() {
        let more = |more_missing: &[u32], more_highest: u64, highest_sequence: u64| {
            Told::read(&Feedback {
                more_missing: more_missing.to_vec(),
                more_highest,
                ..feedback(&[3, 2], highest_sequence)
            })
        };
        assert!(more(&[5, 1], 10, 4).is_some());
        assert!(more(&[5, 1], 9, 4).is_none(), "speaks for less than it lists");
        assert!(more(&[5, 0], 40, 4).is_none(), "an empty range");
        assert!(more(&[5], 40, 4).is_none(), "half a pair");
        assert!(more(&[5, 1], u64::MAX, u64::MAX - 3).is_none(), "beyond all numbers");
        assert!(more(&[1; 2 * MORE_RANGES + 2], u64::MAX, 4).is_none(), "too many");
        assert!(Told::read(&feedback(&[3, 2, 4, 1], 20)).is_none(), "they overlap");
        assert!(Told::read(&feedback(&[1; 2 * MISSING_RANGES + 2], 20)).is_none());
    }

    #[test]
    fn messages_that_were_given_up_are_told_by_distances() {
        let given_up = |distances: &[u32]| {
            let told = Told::read(&Feedback { given_up: distances.to_vec(), ..feedback(&[], 20) });
            told.map(|told| told.given_up)
        };
        assert_eq!(given_up(&[]), Some(vec![]));
        assert_eq!(given_up(&[1_000, 1, 20]), Some(vec![1_000, 1_001, 1_021]));
        assert_eq!(given_up(&[u32::MAX, 1]), None);
        assert_eq!(given_up(&[1; GIVEN_UP_TOLD + 1]), None);
    }
}
