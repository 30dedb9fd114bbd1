//! At which level the payloads of a topic are compressed, what came of it, and how large they are
//! as sent.

use std::time::Instant;

use blaze_domain::node_file::{Codec, Compression};

use crate::codec::Compressed;
use crate::codec::effort::Effort;
use crate::lane::path::TopicPath;
use crate::limit::size::SizeMeter;

/// The level of one topic over time. It is there once something was compressed by an adaptive rule.
#[derive(Debug, Default)]
pub struct TopicEffort(Option<Effort>);

impl TopicEffort {
    pub(super) fn get_mut(&mut self) -> Option<&mut Effort> {
        self.0.as_mut()
    }

    /// The level for the next message; `None`: it goes as it is.
    pub(super) fn next(&mut self, now: Instant, rule: Compression) -> Option<u8> {
        if !rule.adaptive {
            return Some(rule.level);
        }
        self.0.get_or_insert_with(|| Effort::new(rule.level, now)).next(now)
    }

    pub(super) fn compressed(&mut self, now: Instant, done: &Compressed) {
        if let Some(effort) = &mut self.0 {
            effort.compressed(now, done.level, done.taken.as_secs_f64(), done.before, done.after());
        }
    }
}

/// Bytes before and after, and what it cost.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CompressStats {
    /// Messages that were compressed, or tried.
    pub messages: u64,
    /// Bytes of their payloads before.
    pub before: u64,
    /// And after.
    pub after: u64,
    /// Seconds of processor time.
    pub seconds: f64,
}

impl CompressStats {
    pub(super) fn note(&mut self, done: &Compressed) {
        self.messages += 1;
        self.before += done.before as u64;
        self.after += done.after() as u64;
        self.seconds += done.processor.as_secs_f64();
    }
}

impl TopicPath {
    /// The level of now; 0: payloads go as they are.
    #[must_use]
    pub fn level(&self) -> u8 {
        match (self.compression.codec, &self.effort.0) {
            (Codec::None, _) => 0,
            (Codec::Lz4, Some(effort)) => effort.level().unwrap_or(0),
            (Codec::Lz4, None) => self.compression.level,
        }
    }

    /// Whether the rule wants a payload of that size to be compressed.
    pub(super) fn is_worth(&self, bytes: usize) -> bool {
        self.compression.codec == Codec::Lz4
            && bytes > 0
            && bytes >= self.compression.min_bytes as usize
    }

    /// Another rule: what was found out by the one before holds no more.
    pub(super) fn set_compression(&mut self, rule: Compression) {
        if self.compression != rule {
            self.compression = rule;
            self.effort = TopicEffort::default();
            self.sent_level = 0;
        }
    }

    /// Notes a payload that is worth compressing as it is sent, and at which level that is; 0: as
    /// it is. At a higher level than before they become smaller, and the largest of before says
    /// nothing any more. Returns whether the largest is another one.
    pub(super) fn note_sent(&mut self, now: Instant, bytes: usize, level: u8) -> bool {
        if level > self.sent_level {
            self.sent_size = SizeMeter::default();
        }
        self.sent_level = level;
        self.sent_size.note(now, bytes as u64)
    }
}
