//! What a service says of a configuration that it got.

/// How a service gets on with its configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum AckStatus {
    /// It runs with it.
    Applied,
    /// It does not take it, and goes on with the one before.
    Rejected,
    /// It runs with it, and not well.
    Unhealthy,
    /// It runs well again.
    Healthy,
}

impl AckStatus {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Applied, Self::Rejected, Self::Unhealthy, Self::Healthy];

    /// The word in messages.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Applied => "applied",
            Self::Rejected => "rejected",
            Self::Unhealthy => "unhealthy",
            Self::Healthy => "healthy",
        }
    }

    /// `None`: no such word.
    #[must_use]
    pub fn from_word(word: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|status| status.as_str() == word)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_is_read_from_its_own_word_alone() {
        for status in AckStatus::ALL {
            assert_eq!(AckStatus::from_word(status.as_str()), Some(status));
        }
        assert_eq!(AckStatus::from_word("Applied"), None);
    }
}
