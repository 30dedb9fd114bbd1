//! What the engine sends, and in which order: LinkControl and probes, then messages by class.

use std::time::Instant;

use blaze_domain::Priority;
use blaze_proto::link::LinkControl;
use blaze_proto::link::link_control::{Body, Clock, Goodbye, Hello};
use prost::Message as _;

use super::clock::nanoseconds;
use super::engine::Engine;
use super::event::Transmit;
use super::peer::{Peer, Phase};
use super::receiver::ReceiveClass;
use super::sender::{FIRST_WINDOW, SendContext};
use super::wire::{DatagramBuilder, LinkHeader, VERSION, class_code, kind_to_wire};

/// Bytes of a Feedback with all ranges that it tells by their sequences.
const LARGEST_FEEDBACK: usize = 760;
/// Bytes of any LinkControl, at most.
const LARGEST_CONTROL: usize = 1_200;

impl Engine {
    /// The next datagram that carries no message, LinkControl or a probe, for the next peer that
    /// has any.
    pub fn poll_control(&mut self, now: Instant) -> Option<Transmit> {
        let count = self.peers.len();
        for step in 1..=count {
            let at = (self.cursors[3] + step) % count;
            if let Some(transmit) =
                self.control_datagram(now, at).or_else(|| self.probe_datagram(now, at))
            {
                self.cursors[3] = at;
                return Some(transmit);
            }
        }
        None
    }

    fn control_datagram(&mut self, now: Instant, at: usize) -> Option<Transmit> {
        let peer = self.peers[at].as_ref()?;
        let feedback = peer.is_connected() && peer.receive.iter().any(ReceiveClass::feedback_due);
        if !(peer.hello_due || feedback || peer.goodbye_due || !peer.controls.is_empty())
            || peer.phase == Phase::Gone
        {
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
        self.budgets.spend(now, &to.flow.layer, &mut peer.path, datagram.len());
        Some(Transmit { to, class: Priority::Control, datagram, control: true })
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
                clock.echo_held_ns = nanoseconds(now.saturating_duration_since(echo.at));
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
            clock: Some(clock),
            egress: self.egress,
            answers_written: true,
            layer_away: self.layer_away,
            takes_lz4: true,
            ros2_network: self.ros2.map_or(0, |network| network.id.0),
            ros2_address: self.ros2.map(|network| network.address.to_string()).unwrap_or_default(),
            // Who is on the inter scope is a gateway, if its group has any.
            ..Hello::default()
        }
    }

    fn put_feedbacks(&mut self, now: Instant, at: usize, out: &mut DatagramBuilder) {
        let share = self.receive_share(at);
        let Some(peer) = &mut self.peers[at] else { return };
        for (index, class) in peer.receive.iter_mut().enumerate() {
            // One with all its ranges fits an empty datagram; those for which there is no room go
            // with the next.
            if class.feedback_due() && out.fits(LARGEST_FEEDBACK) {
                let room = out.room().min(LARGEST_CONTROL);
                let feedback = class.feedback(now, class_code(Priority::ALL[index]), share, room);
                put(out, Body::Feedback(feedback));
            }
        }
    }

    /// Memory for unfinished messages that a peer may still take: its share of the whole.
    fn receive_share(&self, at: usize) -> u64 {
        let connected = self.peers.iter().flatten().filter(|peer| peer.is_connected()).count();
        let share = self.config.limits.reassembly_bytes / connected.max(1);
        let used = self.peers[at].as_ref().map_or(0, Peer::reserved);
        (share.saturating_sub(used) as u64).max(FIRST_WINDOW)
    }

    fn probe_datagram(&mut self, now: Instant, at: usize) -> Option<Transmit> {
        let peer = self.peers[at].as_mut().filter(|peer| peer.is_connected())?;
        let mut ctx = SendContext {
            now,
            send_ns: self.clocks.monotonic_ns(now),
            sender: self.sender,
            round_trip: peer.round_trip.get(),
            packets: self.budgets.packets(),
            ledger: &mut self.ledger,
            counters: &mut self.counters,
        };
        for (index, class) in peer.send.iter_mut().enumerate() {
            if let Some(datagram) = class.probe(&mut ctx) {
                self.budgets.spend(now, &peer.endpoint.flow.layer, &mut peer.path, datagram.len());
                return Some(Transmit {
                    to: peer.endpoint.clone(),
                    class: Priority::ALL[index],
                    datagram,
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
        self.budgets.paced_until = None;
        for (index, class) in Priority::ALL.iter().copied().enumerate() {
            for step in 1..=count {
                let at = (self.cursors[index] + step) % count;
                let Some(peer) = self.peers[at].as_mut().filter(|peer| peer.phase == Phase::Up)
                else {
                    continue;
                };
                let layer = &peer.endpoint.flow.layer;
                if !peer.send[index].has_work()
                    || !self.budgets.may_send(now, layer, &mut peer.path)
                {
                    continue;
                }
                let mut ctx = SendContext {
                    now,
                    send_ns,
                    sender: self.sender,
                    round_trip: peer.round_trip.get(),
                    packets: self.budgets.packets(),
                    ledger: &mut self.ledger,
                    counters: &mut self.counters,
                };
                if let Some(datagram) = peer.send[index].transmit(&mut ctx) {
                    self.cursors[index] = at;
                    self.budgets.spend(now, layer, &mut peer.path, datagram.len());
                    return Some(Transmit {
                        to: peer.endpoint.clone(),
                        class,
                        datagram,
                        control: false,
                    });
                }
            }
        }
        None
    }
}

fn put(out: &mut DatagramBuilder, body: Body) {
    out.put_control(&LinkControl::from(body).encode_to_vec());
}
