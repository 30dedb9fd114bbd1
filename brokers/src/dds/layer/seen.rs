//! How far a channel has come with one writer: what it had, and what is missing.

/// What a channel has seen of a writer.
#[derive(Debug, Default)]
pub(super) struct Seen {
    last: Option<i64>,
    /// The last one came since the channel is read, so what is missing behind it is lost.
    since_opened: bool,
}

impl Seen {
    /// Takes a sample. `None`: the channel had it. Else how many of this writer, between the last one and this, never came.
    pub(super) fn take(&mut self, sequence: i64, since_opened: bool) -> Option<u64> {
        let missing = match self.last {
            Some(last) if sequence <= last => return None,
            Some(last) if self.since_opened => sequence.saturating_sub(last).saturating_sub(1),
            // RustDDS may hold samples of readers before, and of a late joiner's writer what came before is not known.
            _ => 0,
        };
        self.last = Some(sequence);
        self.since_opened = since_opened;
        Some(u64::try_from(missing).unwrap_or(0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_missing_is_counted_from_the_first_sample_since_the_channel_is_read() {
        let mut seen = Seen::default();
        assert_eq!(seen.take(500, false), Some(0));
        assert_eq!(
            seen.take(900, true),
            Some(0),
            "what a reader before has left does not count"
        );
        assert_eq!(seen.take(901, true), Some(0));
        assert_eq!(seen.take(901, true), None);
        assert_eq!(seen.take(900, true), None);
        assert_eq!(seen.take(1_000, true), Some(98));
        assert_eq!(seen.take(i64::MAX, true), Some(i64::MAX as u64 - 1_001));
        let mut new = Seen::default();
        assert_eq!(new.take(7, true), Some(0));
        assert_eq!(new.take(9, true), Some(1));
    }
}
