//! The end of waiting: messages are settled, and those that waited for them are handed out.

use blaze_domain::DropReason;
use smallvec::SmallVec;

use super::{GIVEN_UP_TOLD, Inbox, MAX_GIVEN_UP, MAX_MESSAGE_RANGES, ReceiveClass};
use crate::link::assembly::Assembly;

impl ReceiveClass {
    /// Notes that a message is delivered or given up, and hands out what waited for it.
    pub(super) fn settle(&mut self, inbox: &mut Inbox<'_>, number: u32) {
        let mut next: SmallVec<[u32; 4]> = SmallVec::from_slice(&[number]);
        while let Some(number) = next.pop() {
            self.note_settled(number);
            let Some(mut waiting) = self.waiters.remove(&number) else {
                continue;
            };
            waiting.sort_unstable();
            for number in waiting {
                if let Some(held) = self.held.remove(&number) {
                    self.reserved = self.reserved.saturating_sub(held.bytes);
                    self.deliver(inbox, number, held.message);
                    next.push(number);
                }
            }
        }
        if self.settled.len() > MAX_MESSAGE_RANGES
            && let Some((first, end)) = self.settled.first()
        {
            for number in self.unfinished_below(first) {
                self.give_up(inbox, number, DropReason::ReassemblyTimeout);
            }
            self.give_up_below(inbox, end + 1);
        }
    }

    fn note_settled(&mut self, number: u32) {
        self.settled.insert(u64::from(number), u64::from(number));
        while let Some((first, last)) = self.settled.first()
            && first <= self.message_floor
        {
            self.message_floor = self.message_floor.max(last + 1);
            self.settled.remove_through(last);
        }
    }

    /// Everything below `floor` that has not come is given up, and counted by its sender.
    pub(super) fn give_up_below(&mut self, inbox: &mut Inbox<'_>, floor: u64) {
        if floor <= self.message_floor {
            return;
        }
        self.message_floor = floor;
        self.settled.remove_through(floor - 1);
        if let Some((first, last)) = self.settled.first()
            && first <= floor
        {
            self.message_floor = last + 1;
            self.settled.remove_through(last);
        }
        for number in self.unfinished_below(self.message_floor) {
            self.remove_assembly(number);
        }
        self.release_ready(inbox);
    }

    /// Hands out what waits for something that is settled by now, in order.
    fn release_ready(&mut self, inbox: &mut Inbox<'_>) {
        if self.held.is_empty() {
            return;
        }
        let numbers: Vec<u32> = self.held.keys().copied().collect();
        for number in numbers {
            if let Some(before) = self.held.get(&number).map(|held| held.before)
                && self.is_settled(before)
            {
                self.settle_held(inbox, number);
            }
        }
    }

    /// Hands out one held message and what waited for it.
    fn settle_held(&mut self, inbox: &mut Inbox<'_>, number: u32) {
        let Some(held) = self.held.remove(&number) else { return };
        self.reserved = self.reserved.saturating_sub(held.bytes);
        if let Some(waiting) = self.waiters.get_mut(&held.before) {
            waiting.retain(|waiter| *waiter != number);
            if waiting.is_empty() {
                self.waiters.remove(&held.before);
            }
        }
        self.deliver(inbox, number, held.message);
        self.settle(inbox, number);
    }

    fn unfinished_below(&self, floor: u64) -> Vec<u32> {
        self.assemblies.keys().copied().filter(|number| u64::from(*number) < floor).collect()
    }

    fn drop_assembly(&mut self, inbox: &mut Inbox<'_>, number: u32, reason: DropReason) {
        if let Some(assembly) = self.remove_assembly(number) {
            inbox.counters.reassembly_timeouts +=
                u64::from(reason == DropReason::ReassemblyTimeout);
            inbox.dropped(assembly.topic(), reason);
        }
    }

    /// Gives up an unfinished message. It is to be settled. Its sender is told, unless there are too
    /// many: one that waits to be told is taken for delivered if its parts come after all.
    pub(super) fn give_up(&mut self, inbox: &mut Inbox<'_>, number: u32, reason: DropReason) {
        if self.given_up.len() >= GIVEN_UP_TOLD {
            self.drop_assembly(inbox, number, reason);
        } else if self.remove_assembly(number).is_some() {
            let is_timeout = reason == DropReason::ReassemblyTimeout;
            inbox.counters.reassembly_timeouts += u64::from(is_timeout);
            self.given_up.insert(number);
        }
    }

    /// There is no memory for a part that its sender will not send again: the message is over.
    pub(crate) fn refuse(&mut self, inbox: &mut Inbox<'_>, number: u32) {
        if !self.is_settled(number) && !self.held.contains_key(&number) {
            let assembly = self.remove_assembly(number);
            inbox.dropped(assembly.as_ref().map_or("", Assembly::topic), DropReason::QueueFull);
            self.settle(inbox, number);
        }
    }

    /// Stops waiting for the message that is behind all that this held one waits for.
    pub(super) fn give_up_before(&mut self, inbox: &mut Inbox<'_>, number: u32) {
        let mut at = number;
        while let Some(held) = self.held.get(&at) {
            at = held.before;
        }
        if at != number {
            if self.assemblies.contains_key(&at) {
                self.give_up(inbox, at, DropReason::ReassemblyTimeout);
            } else if self.given_up.len() < MAX_GIVEN_UP {
                self.given_up.insert(at);
            } else if let Some(held) = self.held.get(&number) {
                inbox.dropped(held.message.frame.topic(), DropReason::ReassemblyTimeout);
            }
            self.settle(inbox, at);
        }
    }

    /// Hands out all complete messages in order and drops the unfinished ones: nothing more is
    /// expected.
    pub(crate) fn release_all(&mut self, inbox: &mut Inbox<'_>) {
        let unfinished: Vec<u32> = self.assemblies.keys().copied().collect();
        for number in unfinished {
            self.drop_assembly(inbox, number, DropReason::ReassemblyTimeout);
            self.settle(inbox, number);
        }
        while let Some((&number, _)) = self.held.first_key_value() {
            self.give_up_before(inbox, number);
        }
    }

    /// Frees memory: drops the oldest unfinished message, or stops waiting. Returns whether there
    /// was anything to free.
    pub(crate) fn evict(&mut self, inbox: &mut Inbox<'_>) -> bool {
        let oldest = self.assemblies.iter().min_by_key(|(_, assembly)| assembly.first_part);
        if let Some(number) = oldest.map(|(number, _)| *number) {
            inbox.counters.reassembly_evicted += 1;
            self.drop_assembly(inbox, number, DropReason::QueueFull);
            self.settle(inbox, number);
            return true;
        }
        let Some((&number, _)) = self.held.first_key_value() else {
            return false;
        };
        self.give_up_before(inbox, number);
        true
    }
}
