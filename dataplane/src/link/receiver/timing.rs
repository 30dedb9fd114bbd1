//! What time makes due: Feedback, and giving up.

use std::time::{Duration, Instant};

use blaze_domain::DropReason;
use blaze_proto::link::link_control::Feedback;
use prost::{Message as _, length_delimiter_len};

use super::{
    FEEDBACK_IDLE, GIVEN_UP_TOLD, Held, Inbox, LONGEST_PATIENCE, MISSING_RANGES, MORE_RANGES,
    PATIENCE, ReceiveClass, SWEEP,
};
use crate::link::clock::nanoseconds;

/// What the lists of a Feedback that fill its datagram take besides their numbers, at most: tags
/// and lengths, that of the Feedback itself included, and `more_highest`.
const FRAMING_BYTES: usize = 24;

impl ReceiveClass {
    /// When something has to be done: report, or give up.
    pub(crate) fn next_timeout(&self, connected: bool) -> Option<Instant> {
        let idle = self.last_feedback.map(|last| last + FEEDBACK_IDLE);
        let feedback =
            if self.feedback_due || !connected { None } else { self.feedback_at.or(idle) };
        [feedback, self.sweep_at, self.hand_out_at].into_iter().flatten().min()
    }

    /// Does what time has made due.
    pub(crate) fn handle_timeout(&mut self, inbox: &mut Inbox<'_>) {
        let now = inbox.now;
        let idle = self.last_feedback.map(|last| last + FEEDBACK_IDLE);
        if self.feedback_at.or(idle).is_some_and(|at| at <= now) {
            self.feedback_due = true;
        }
        if self.hand_out_at.is_some_and(|at| at <= now) {
            self.hand_out(inbox, |_, held| held.hand_out_at().is_some_and(|at| at <= now));
            self.hand_out_at = self.held.values().filter_map(Held::hand_out_at).min();
        }
        if self.sweep_at.is_some_and(|at| at <= now) {
            self.sweep(inbox);
        }
    }

    fn is_overdue(&self, now: Instant, since: Instant, active: Duration) -> bool {
        self.active.saturating_sub(active) >= PATIENCE
            || now.saturating_duration_since(since) >= LONGEST_PATIENCE
    }

    /// Hands out the held messages that must not wait any longer.
    fn hand_out(&mut self, inbox: &mut Inbox<'_>, must: impl Fn(&Self, &Held) -> bool) {
        let numbers =
            (self.held.iter()).filter(|(_, held)| must(self, held)).map(|(number, _)| *number);
        for number in numbers.collect::<Vec<_>>() {
            self.give_up_before(inbox, number);
        }
    }

    fn sweep(&mut self, inbox: &mut Inbox<'_>) {
        let now = inbox.now;
        self.hand_out(inbox, |class, held| class.is_overdue(now, held.since, held.active));
        let mut gone = Vec::new();
        for (number, assembly) in &self.assemblies {
            if assembly.expires.is_some_and(|at| at <= now) {
                gone.push((*number, DropReason::Lifespan));
            } else if self.is_overdue(now, assembly.last_part, assembly.active) {
                gone.push((*number, DropReason::ReassemblyTimeout));
            }
        }
        for (number, reason) in gone {
            self.give_up(inbox, number, reason);
            self.settle(inbox, number);
        }
        let idle = self.assemblies.is_empty() && self.held.is_empty();
        self.sweep_at = (!idle).then(|| now + SWEEP);
    }

    /// Whether a Feedback is to be sent.
    pub(crate) fn feedback_due(&self) -> bool {
        self.feedback_due && self.link_epoch != 0
    }

    /// What to report now. `share` is how much memory this peer may still take, `room` how many
    /// bytes the Feedback may take as a `LinkControl`; those of its first ranges are taken in any
    /// case.
    pub(crate) fn feedback(
        &mut self,
        now: Instant,
        class_code: u8,
        share: u64,
        room: usize,
    ) -> Feedback {
        self.feedback_due = false;
        self.feedback_at = None;
        self.samples = 0;
        self.last_feedback = Some(now);
        let (feedback, untold) = self.report(now, class_code, share, room);
        self.untold = untold;
        feedback
    }

    /// The Feedback, and whether more is missing than it tells.
    fn report(&self, now: Instant, class_code: u8, share: u64, room: usize) -> (Feedback, bool) {
        let newest = self.sequences.last().unwrap_or(self.sequence_floor);
        let mut gaps = self.sequences.gaps(self.sequence_floor).peekable();
        let (mut missing, mut end) = (Vec::new(), self.sequence_floor);
        for (first, last) in gaps.by_ref().take(MISSING_RANGES) {
            missing.extend([first, last - first + 1]);
            end = last;
        }
        let (echo_send_ns, echo_held_ns) = self.echo.map_or((0, 0), |(sent, at)| {
            let held = now.saturating_duration_since(at);
            (sent, nanoseconds(held))
        });
        let mut feedback = Feedback {
            link_epoch: self.link_epoch,
            link_class: u32::from(class_code),
            // What lies beyond the last range that fits is not told yet.
            highest_sequence: if gaps.peek().is_some() { end } else { newest },
            missing,
            received_bytes: self.received_bytes,
            window_bytes: share + self.expected() as u64,
            delivered_message: u32::try_from(self.message_floor - 1).unwrap_or(u32::MAX),
            echo_send_ns,
            echo_held_ns,
            more_missing: Vec::new(),
            more_highest: 0,
            given_up: Vec::new(),
        };
        let mut room = room.saturating_sub(feedback.encoded_len() + FRAMING_BYTES);
        let mut before = 0u32;
        for &number in &self.given_up {
            let bytes = length_delimiter_len((number - before) as usize);
            if bytes > room || feedback.given_up.len() >= GIVEN_UP_TOLD {
                // Until it is told its sender must not take it for delivered.
                feedback.delivered_message =
                    feedback.delivered_message.min(number.saturating_sub(1));
                break;
            }
            room -= bytes;
            feedback.given_up.push(number - before);
            before = number;
        }
        while let Some(&(first, last)) = gaps.peek() {
            let (Ok(came), Ok(count)) =
                (u32::try_from(first - end - 1), u32::try_from(last - first + 1))
            else {
                break;
            };
            let bytes = length_delimiter_len(came as usize) + length_delimiter_len(count as usize);
            if bytes > room || feedback.more_missing.len() >= 2 * MORE_RANGES {
                break;
            }
            room -= bytes;
            feedback.more_missing.extend([came, count]);
            end = last;
            gaps.next();
        }
        let untold = gaps.peek().is_some();
        if !feedback.more_missing.is_empty() {
            feedback.more_highest = if untold { end } else { newest };
        }
        (feedback, untold)
    }
}
