//! What a command ends with.

use std::process::ExitCode;

/// Exit codes; part of the contract.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Exit {
    /// Done.
    Done = 0,
    /// Failed.
    Failed = 1,
    /// Bad usage.
    Usage = 2,
    /// Cannot connect.
    CannotConnect = 3,
    /// Not found.
    NotFound = 4,
    /// Conflict.
    Conflict = 5,
    /// Not allowed.
    NotAllowed = 6,
    /// Refused as invalid.
    Invalid = 7,
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}

/// Why a command did not do what was asked.
#[derive(Debug, thiserror::Error)]
pub enum CliError {
    /// It was tried and failed.
    #[error("{0}")]
    Failed(String),
    /// The options make no sense together, or this build cannot do it.
    #[error("{0}")]
    Usage(String),
    /// Nobody answers at the address.
    #[error(
        "no flow answers at {address}: {reason}\n  A flow names its admin port in its line `ready admin=HOST:PORT`; give it with --flow HOST:PORT."
    )]
    CannotConnect {
        /// Where it was tried.
        address: String,
        /// What the system or the deadline said.
        reason: String,
    },
    /// The local broker, or the flow on it, does not answer.
    #[error("the {kind} does not answer within {waited_s} s: {detail}")]
    NoBroker {
        /// What does not answer.
        kind: String,
        /// How long was waited.
        waited_s: u64,
        /// What it said last, or what to do.
        detail: String,
    },
    /// What was given is refused as invalid: a node file, a name, a value.
    #[error("{0}")]
    Invalid(String),
    /// The server refused.
    #[error("{address} answered {status}{}", if detail.is_empty() { String::new() } else { format!(": {detail}") })]
    Refused {
        /// Who refused.
        address: String,
        /// HTTP status.
        status: u16,
        /// What it said.
        detail: String,
    },
    /// The answer is not what the contract says.
    #[error("{address} answers, but not as a flow does: {reason}")]
    Answer {
        /// Who answered.
        address: String,
        /// What is wrong.
        reason: String,
    },
    /// Whoever read our output has gone; no failure.
    #[error("the output was closed")]
    OutputClosed,
}

impl CliError {
    /// The exit code for it.
    #[must_use]
    pub fn exit(&self) -> Exit {
        match self {
            Self::Usage(_) => Exit::Usage,
            Self::CannotConnect { .. } | Self::NoBroker { .. } => Exit::CannotConnect,
            Self::Invalid(_) => Exit::Invalid,
            Self::Refused { status, .. } => match status {
                404 => Exit::NotFound,
                409 | 412 => Exit::Conflict,
                401 | 403 => Exit::NotAllowed,
                400 | 422 => Exit::Invalid,
                _ => Exit::Failed,
            },
            Self::OutputClosed => Exit::Done,
            Self::Failed(_) | Self::Answer { .. } => Exit::Failed,
        }
    }
}
