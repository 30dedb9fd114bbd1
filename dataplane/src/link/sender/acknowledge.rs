//! What a Feedback settles: samples are received or lost, messages are out or have to be repaired.

use std::time::Duration;

use blaze_domain::DropReason;

use super::super::outgoing::{Part, PartRef};
use super::{FeedbackView, LAST_NUMBER, REORDERING, SendClass, SendContext};

impl SendClass {
    /// Takes what the receiver reports. Returns whether it is of this link epoch.
    pub(crate) fn feedback(&mut self, ctx: &mut SendContext<'_>, view: &FeedbackView<'_>) -> bool {
        if view.link_epoch != self.link_epoch || view.highest_sequence >= self.next_sequence() {
            return false;
        }
        // First: the repair of one may have come since, and counts for nothing there.
        self.drop_given_up(ctx, view.given_up);
        if view.highest_sequence >= self.highest_reported {
            self.highest_reported = view.highest_sequence;
            self.window = view.window_bytes;
            self.missing.clear();
            for pair in view.missing.chunks_exact(2) {
                self.missing.push((pair[0], pair[0].saturating_add(pair[1].saturating_sub(1))));
            }
            self.settle(ctx, view.highest_sequence);
            self.rate.total(ctx.now, view.received_bytes);
        }
        if self.highest_reported >= self.last_user_sequence && self.announce.is_none() {
            self.probe_at = None;
        }
        self.settle_delivered(ctx, view.delivered_message);
        self.renew_numbers();
        true
    }

    /// Goes through the samples up to `highest`: those not missing are received; of those missing,
    /// some are lost.
    pub(super) fn settle(&mut self, ctx: &mut SendContext<'_>, highest: u64) {
        let late = ctx.round_trip + ctx.round_trip / 8 + Duration::from_millis(2);
        let (mut received, mut lost) = (0, 0);
        let mut range = 0;
        self.recheck = None;
        let count = usize::try_from((highest + 1).saturating_sub(self.base)).unwrap_or(usize::MAX);
        for at in 0..count.min(self.in_flight.len()) {
            let sequence = self.base + at as u64;
            while self.missing.get(range).is_some_and(|missing| missing.1 < sequence) {
                range += 1;
            }
            let is_missing = self.missing.get(range).is_some_and(|missing| missing.0 <= sequence);
            let sample = &mut self.in_flight[at];
            if sample.settled {
                continue;
            }
            let lost_at = sample.sent + late;
            if is_missing && highest - sequence < REORDERING && ctx.now < lost_at {
                let at = self.recheck.map_or(lost_at, |next| next.0.min(lost_at));
                self.recheck = Some((at, highest));
                continue;
            }
            sample.settled = true;
            self.outstanding = self.outstanding.saturating_sub(sample.bytes as usize);
            let parts = std::mem::take(&mut sample.parts);
            // A probe is no message: its size says nothing of the link.
            if !sample.probe {
                let bytes = sample.bytes as usize;
                let wire_bytes = ctx.packets.map_or(bytes, |packets| packets.wire_bytes(bytes));
                self.settled[usize::from(is_missing)] += wire_bytes as u64;
            }
            if is_missing && sample.announces.is_some() {
                self.announce = self.announce.max(sample.announces);
                self.probe_due = true;
            }
            if is_missing {
                lost += 1;
                self.lose(ctx, &parts, sequence);
            } else {
                received += 1;
                self.acknowledge(ctx, &parts);
            }
        }
        while self.in_flight.front().is_some_and(|sample| sample.settled) {
            self.in_flight.pop_front();
            self.base += 1;
        }
        if self.outstanding == 0 {
            self.outstanding_since = None;
        }
        if received + lost > 0 {
            self.loss.add(ctx.now, received, lost);
        }
    }

    fn lose(&mut self, ctx: &mut SendContext<'_>, parts: &[PartRef], sequence: u64) {
        for part in parts {
            let Some(message) = self.messages.get_mut(part.key) else {
                continue;
            };
            if message.parts[part.part] != Part::Carried(sequence) {
                continue;
            }
            message.parts[part.part] = Part::Lost;
            message.lost += 1;
            if message.is_expired(ctx.now) {
                self.drop_message(part.key, DropReason::Lifespan, ctx.ledger);
            } else {
                self.repairs.push_back(*part);
            }
        }
    }

    fn acknowledge(&mut self, ctx: &mut SendContext<'_>, parts: &[PartRef]) {
        for part in parts {
            let Some(message) = self.messages.get_mut(part.key) else {
                continue;
            };
            match message.parts[part.part] {
                Part::Acknowledged => continue,
                // It came after all, before it was repaired.
                Part::Lost => message.lost -= 1,
                Part::Unsent | Part::Carried(_) => {}
            }
            message.parts[part.part] = Part::Acknowledged;
            message.acknowledged += 1;
            if message.acknowledged == message.parts.len()
                && let Some(message) = self.take(part.key)
            {
                ctx.ledger.out(message.lane, message.payload_bytes());
            }
        }
    }

    /// Drops what the receiver has given up before it was complete. It counts nothing of that.
    fn drop_given_up(&mut self, ctx: &mut SendContext<'_>, numbers: &[u32]) {
        for number in numbers {
            let Ok(at) = self.started.binary_search_by_key(number, |started| started.0) else {
                continue;
            };
            let key = self.started[at].1;
            let Some(message) = self.messages.get(key) else {
                continue;
            };
            let reason = if message.is_expired(ctx.now) {
                DropReason::Lifespan
            } else {
                DropReason::ReassemblyTimeout
            };
            self.drop_message(key, reason, ctx.ledger);
        }
    }

    /// Settles what the receiver is through with: delivered, or given up there before it was
    /// complete.
    fn settle_delivered(&mut self, ctx: &mut SendContext<'_>, delivered: u32) {
        if delivered >= self.next_number {
            return;
        }
        while let Some(&(number, key)) = self.started.front()
            && number <= delivered
        {
            self.started.pop_front();
            let Some(message) = self.messages.get(key) else {
                continue;
            };
            if !message.is_sent() {
                self.drop_message(key, DropReason::ReassemblyTimeout, ctx.ledger);
            } else if let Some(message) = self.take(key) {
                ctx.ledger.out(message.lane, message.payload_bytes());
            }
        }
    }

    /// Begins a new link epoch when the numbers are used up and nothing is on the way.
    pub(super) fn renew_numbers(&mut self) {
        if self.next_number < LAST_NUMBER || self.started_bytes > 0 || !self.in_flight.is_empty() {
            return;
        }
        self.link_epoch = self.link_epoch.saturating_add(1);
        self.next_number = 1;
        self.base = 1;
        self.last_user_sequence = 0;
        self.highest_reported = 0;
        self.started.clear();
        self.streams.clear();
        self.missing.clear();
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use blaze_domain::Priority;

    use super::*;
    use crate::link::budget::ETHERNET;
    use crate::link::event::{LaneId, Ledger, LinkCounters, StreamKey, Submit};
    use crate::link::sender::SendLimits;
    use crate::link::sim::{Post, flow, frame, writer};
    use crate::link::wire::SenderId;

    #[test]
    fn what_arrives_counts_with_the_headers_of_all_its_packets() {
        let (now, to) = (Instant::now(), flow("fog/b"));
        let (mut ledger, mut counters) = (Ledger::default(), LinkCounters::default());
        let mut ctx = SendContext {
            now,
            send_ns: 1,
            sender: SenderId::of(&flow("edge/a"), 1),
            round_trip: Duration::from_millis(10),
            packets: Some(ETHERNET),
            ledger: &mut ledger,
            counters: &mut counters,
        };
        let limits = SendLimits { queue_bytes: 1 << 20, streams: 8, max_datagram: 60_000 };
        let mut class = SendClass::new(Priority::Bulk, 1, limits);
        let submit = Submit {
            to: &to,
            class: Priority::Bulk,
            lane: LaneId(1),
            stream: StreamKey { topic: 1, writer: writer(1) },
            frame: frame(Post::large(1, 30_000), 1),
            arrived: now,
            reliable: true,
            lifespan: None,
            keep_newest: 0,
        };
        class.submit(submit, ctx.ledger);
        let datagram = class.transmit(&mut ctx).unwrap();
        let view = FeedbackView {
            link_epoch: 1,
            highest_sequence: 1,
            missing: &[],
            given_up: &[],
            received_bytes: datagram.len() as u64,
            window_bytes: 1 << 20,
            delivered_message: 1,
        };
        assert!(class.feedback(&mut ctx, &view));
        let wire_bytes = ETHERNET.wire_bytes(datagram.len());
        assert_eq!(class.take_settled(), (wire_bytes as u64, 0));
        assert!(wire_bytes > datagram.len() + 2_000, "{wire_bytes} bytes of 24 packets");
        assert_eq!(class.take_settled(), (0, 0));
    }
}
