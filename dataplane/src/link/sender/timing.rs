//! What time makes due: probes, and the end of lifespans.

use std::time::{Duration, Instant};

use blaze_domain::DropReason;
use smallvec::SmallVec;

use super::super::wire::{DatagramBuilder, HEADER_BYTES};
use super::{SWEEP, Sample, SendClass, SendContext};

impl SendClass {
    /// Does what time has made due.
    pub(crate) fn handle_timeout(&mut self, ctx: &mut SendContext<'_>) {
        if self.probe_at.is_some_and(|at| at <= ctx.now) {
            self.probe_due = true;
        }
        if let Some((at, highest)) = self.recheck
            && at <= ctx.now
        {
            self.settle(ctx, highest);
            self.renew_numbers();
        }
        if self.sweep_at().is_some_and(|at| at <= ctx.now) {
            self.sweep(ctx);
        }
        self.messages.shrink_if_empty();
    }

    fn sweep_at(&self) -> Option<Instant> {
        let next = self.next_expiry?;
        Some(self.last_sweep.map_or(next, |last| next.max(last + SWEEP)))
    }

    fn sweep(&mut self, ctx: &mut SendContext<'_>) {
        self.last_sweep = Some(ctx.now);
        // Of one that is wholly on the way it is not known whether it arrived in time.
        let expired =
            self.messages.keys(|message| message.is_expired(ctx.now) && message.is_to_be_sent());
        for key in &expired {
            self.drop_message(*key, DropReason::Lifespan, ctx.ledger);
        }
        if !expired.is_empty() {
            self.prune_waiting();
        }
        let deadlines = self.messages.iter().filter_map(|message| message.deadline);
        self.next_expiry = deadlines.filter(|deadline| *deadline > ctx.now).min();
    }

    /// When [`SendClass::handle_timeout`] has something to do.
    pub(crate) fn next_timeout(&self) -> Option<Instant> {
        let recheck = self.recheck.map(|recheck| recheck.0);
        let probe = if self.probe_due { None } else { self.probe_at };
        [probe, recheck, self.sweep_at()].into_iter().flatten().min()
    }

    /// A sample without records, if one is due: makes the receiver report at once.
    pub(crate) fn probe(&mut self, ctx: &mut SendContext<'_>) -> Option<bytes::Bytes> {
        let spacing = ctx.round_trip.max(Duration::from_millis(50));
        if !self.probe_due || self.last_probe.is_some_and(|last| ctx.now < last + spacing) {
            if self.probe_due {
                self.probe_at = self.last_probe.map(|last| last + spacing);
                self.probe_due = false;
            }
            return None;
        }
        self.probe_due = false;
        self.last_probe = Some(ctx.now);
        let next_number = self.next_number;
        // A probe repeats the number of the one before it if nothing came between, so that
        // unanswered ones do not pile up.
        let unanswered = self.in_flight.back().is_some_and(|last| last.probe && !last.settled);
        let mut header = self.header(ctx, self.next_sequence(), next_number);
        let announces = self.announcement(&header);
        let repeats = unanswered && announces.is_none();
        if repeats {
            header.link_sequence -= 1;
            header.unsettled -= 1;
        } else {
            self.in_flight.push_back(Sample {
                sent: ctx.now,
                bytes: 0,
                next_number,
                settled: false,
                probe: true,
                announces,
                parts: SmallVec::new(),
            });
        }
        if announces.is_some() {
            self.last_user_sequence = header.link_sequence;
        }
        let unreported = self.highest_reported < self.last_user_sequence || self.announce.is_some();
        self.probe_at = unreported.then(|| ctx.now + spacing);
        ctx.counters.probes += 1;
        Some(DatagramBuilder::new(HEADER_BYTES).finish(&header))
    }
}
