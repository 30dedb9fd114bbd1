//! Messages and nodes that are ignored, counted by reason.

/// Why a message, an answer or a node was ignored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ignored {
    /// It is not JSON of the expected form.
    Malformed,
    /// The message is longer than 1,200 bytes.
    TooLarge,
    /// It came from this node.
    Own,
    /// Its member `from` is not the node that published it.
    ForeignName,
    /// No ping waits for the answer: it is late, came twice, or is to a ping never sent.
    NotAwaited,
    /// The answer was held longer than its round trip took.
    Negative,
    /// It was overtaken by a message that its sender sent after a step of its clock.
    Overtaken,
    /// More answers wait than are allowed in all or for one node.
    TooManyPings,
    /// More nodes or offsets than are kept.
    TooMany,
}

impl Ignored {
    const ALL: [Self; 9] = [
        Self::Malformed,
        Self::TooLarge,
        Self::Own,
        Self::ForeignName,
        Self::NotAwaited,
        Self::Negative,
        Self::Overtaken,
        Self::TooManyPings,
        Self::TooMany,
    ];

    /// Value of the label `reason`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Malformed => "malformed",
            Self::TooLarge => "too_large",
            Self::Own => "own",
            Self::ForeignName => "foreign_name",
            Self::NotAwaited => "not_awaited",
            Self::Negative => "negative",
            Self::Overtaken => "overtaken",
            Self::TooManyPings => "too_many_pings",
            Self::TooMany => "too_many",
        }
    }
}

/// Counts by reason.
#[derive(Debug, Default)]
pub(super) struct Counts([u64; Ignored::ALL.len()]);

impl Counts {
    pub(super) fn add(&mut self, reason: Ignored, count: u64) {
        if let Some(slot) = self.0.get_mut(reason as usize) {
            *slot += count;
        }
    }

    pub(super) fn get(&self, reason: Ignored) -> u64 {
        self.0.get(reason as usize).copied().unwrap_or(0)
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (Ignored, u64)> {
        Ignored::ALL.into_iter().map(|reason| (reason, self.get(reason)))
    }
}
