//! The commands of `blaze-wan`, one a line.

use std::str::FromStr;

use super::shape::Change;

/// Characters of a line that are looked at; a longer one is refused.
const MAX_LINE: usize = 1_000;

/// Which directions a command is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Ways {
    /// From A to B, `a>b`.
    Forward,
    /// From B to A, `b>a`.
    Back,
    /// `both`
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

    fn word(self) -> &'static str {
        match self {
            Self::Forward => "a>b",
            Self::Back => "b>a",
            Self::Both => "both",
        }
    }
}

impl FromStr for Ways {
    type Err = CommandError;

    fn from_str(text: &str) -> Result<Self, CommandError> {
        [Self::Forward, Self::Back, Self::Both]
            .into_iter()
            .find(|ways| ways.word() == text)
            .ok_or_else(|| CommandError::UnknownWay(text.to_owned()))
    }
}

/// What the emulator is told while it runs.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    /// `set WAY NAME VALUE …`
    Set {
        /// Which directions.
        ways: Ways,
        /// At least one.
        changes: Vec<Change>,
    },
    /// `cut WAY`: what is on the way is lost, and all that comes.
    Cut(Ways),
    /// `heal WAY`: ends a cut; nothing else changes.
    Heal(Ways),
    /// `stats`
    Stats,
}

/// Why a line is no command.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CommandError {
    /// The first word.
    #[error("`{0}` is no command: set WAY NAME VALUE …, cut WAY, heal WAY or stats is expected")]
    UnknownCommand(String),
    /// The second word.
    #[error("`{0}` is no way: a>b, b>a or both is expected")]
    UnknownWay(String),
    /// A name after `set`.
    #[error("`{0}` is no setting: delay, jitter, reorder, loss, rate, queue or mtu is expected")]
    UnknownSetting(String),
    /// A value that is no number, or out of range.
    #[error("`{value}` is no value for {setting}")]
    Value {
        /// Its name.
        setting: String,
        /// What was given.
        value: String,
    },
    /// Words are missing or left over.
    #[error("`{0}` has too few or too many words")]
    Words(String),
    /// More than a thousand characters.
    #[error("a line of {0} characters is too long")]
    TooLong(usize),
}

impl FromStr for Command {
    type Err = CommandError;

    fn from_str(line: &str) -> Result<Self, CommandError> {
        if line.len() > MAX_LINE {
            return Err(CommandError::TooLong(line.len()));
        }
        let words: Vec<&str> = line.split_whitespace().collect();
        let miscounted = || CommandError::Words(line.trim().to_owned());
        match words[..] {
            ["stats"] => Ok(Self::Stats),
            ["cut", ways] => Ok(Self::Cut(ways.parse()?)),
            ["heal", ways] => Ok(Self::Heal(ways.parse()?)),
            ["set", ways, ref pairs @ ..] => {
                let ways = ways.parse()?;
                if pairs.is_empty() || pairs.len() % 2 != 0 {
                    return Err(miscounted());
                }
                let changes = pairs.chunks(2).map(|pair| Change::parse(pair[0], pair[1]));
                Ok(Self::Set {
                    ways,
                    changes: changes.collect::<Result<_, _>>()?,
                })
            }
            ["stats" | "cut" | "heal" | "set", ..] => Err(miscounted()),
            _ => Err(CommandError::UnknownCommand(
                words.first().copied().unwrap_or_default().to_owned(),
            )),
        }
    }
}

impl std::fmt::Display for Command {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Set { ways, changes } => {
                write!(f, "set {}", ways.word())?;
                changes.iter().try_for_each(|change| write!(f, " {change}"))
            }
            Self::Cut(ways) => write!(f, "cut {}", ways.word()),
            Self::Heal(ways) => write!(f, "heal {}", ways.word()),
            Self::Stats => f.write_str("stats"),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_words_of_the_manual_are_understood() {
        let command: Command = "set a>b delay 25 jitter 0.5 loss 0.0001 rate 160M queue 250k mtu 1400 reorder on"
            .parse()
            .unwrap();
        assert_eq!(
            command,
            Command::Set {
                ways: Ways::Forward,
                changes: vec![
                    Change::Delay(Duration::from_millis(25)),
                    Change::Jitter(Duration::from_micros(500)),
                    Change::Loss(0.000_1),
                    Change::Rate(Some(160_000_000)),
                    Change::Queue(250_000),
                    Change::Mtu(1400),
                    Change::Reorder(true),
                ]
            }
        );
        assert_eq!("cut a>b".parse(), Ok(Command::Cut(Ways::Forward)));
        assert_eq!(" heal  both ".parse(), Ok(Command::Heal(Ways::Both)));
        assert_eq!("stats".parse(), Ok(Command::Stats));
        assert_eq!(
            "set both rate none".parse(),
            Ok(Command::Set {
                ways: Ways::Both,
                changes: vec![Change::Rate(None)]
            })
        );
    }

    #[test]
    fn what_makes_no_sense_is_refused() {
        for line in [
            "",
            "sett a>b delay 1",
            "set a>b",
            "set a>b delay",
            "set a>b delay x",
            "set a>b delay -1",
            "set a>b delay 60001",
            "set a>b delay NaN",
            "set a>b loss 1.1",
            "set a>b rate 10",
            "set a>b rate k",
            "set a>b queue 2G",
            "set a>b mtu 20",
            "set a>b reorder maybe",
            "set c delay 1",
            "cut",
            "cut a>b b>a",
            "stats now",
        ] {
            assert!(line.parse::<Command>().is_err(), "{line}");
        }
        assert_eq!("x".repeat(1_001).parse::<Command>(), Err(CommandError::TooLong(1_001)));
    }

    fn ways() -> impl Strategy<Value = Ways> {
        prop_oneof![Just(Ways::Forward), Just(Ways::Back), Just(Ways::Both)]
    }

    fn change() -> impl Strategy<Value = Change> {
        let time = || (0_u64..=60_000_000).prop_map(Duration::from_micros);
        prop_oneof![
            time().prop_map(Change::Delay),
            time().prop_map(Change::Jitter),
            any::<bool>().prop_map(Change::Reorder),
            (0.0..=1.0).prop_map(Change::Loss),
            proptest::option::of(1_000_u64..).prop_map(Change::Rate),
            (0_u64..=1_000_000_000).prop_map(Change::Queue),
            (68_u32..=65_535).prop_map(Change::Mtu),
        ]
    }

    proptest! {
        #[test]
        fn a_command_is_read_as_it_was_written(ways in ways(), changes in proptest::collection::vec(change(), 1..8)) {
            for command in [Command::Set { ways, changes }, Command::Cut(ways), Command::Heal(ways), Command::Stats] {
                prop_assert_eq!(command.to_string().parse::<Command>(), Ok(command));
            }
        }

        #[test]
        fn any_line_is_a_command_or_an_error(line in ".{0,200}") {
            let _ = line.parse::<Command>();
        }
    }
}
