//! The commands of the emulator: one JSON object a line.

use serde::{Deserialize, Serialize};

use super::shape::Change;

/// Which directions a command is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ways {
    /// From A to B.
    Forward,
    /// From B to A.
    Back,
    /// Both.
    Both,
}

impl Ways {
    /// The same, seen from the other end.
    #[must_use]
    pub fn flipped(self) -> Self {
        match self {
            Self::Forward => Self::Back,
            Self::Back => Self::Forward,
            Self::Both => Self::Both,
        }
    }
}

/// What the emulator is told while it runs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Command {
    /// Changes the quality from now on.
    Set(Ways, Vec<Change>),
    /// What is on the way is lost, and all that comes.
    Cut(Ways),
    /// Ends a cut; nothing else changes.
    Heal(Ways),
    /// Asks for [`super::LinkStats`].
    Stats,
}

impl std::str::FromStr for Command {
    type Err = serde_json::Error;

    fn from_str(line: &str) -> Result<Self, Self::Err> {
        serde_json::from_str(line)
    }
}
