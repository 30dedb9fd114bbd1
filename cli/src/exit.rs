//! What a command ends with.

use std::fmt;
use std::process::ExitCode;

use blaze_domain::control::{ControlError, ErrorCode};
use serde_json::{Value, json};

use crate::config::Refusal;
use crate::http::Program;

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
    /// `diff` could not compare: there 1 means that something differs.
    DiffFailed = 8,
}

impl Exit {
    /// The exit code for a status of HTTP that is no success.
    #[must_use]
    pub fn of_status(status: u16) -> Self {
        match status {
            404 => Self::NotFound,
            409 | 412 | 428 => Self::Conflict,
            401 | 403 => Self::NotAllowed,
            400 | 413 | 415 | 422 => Self::Invalid,
            _ => Self::Failed,
        }
    }
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}

/// Faults, one a line, as they stand below a sentence.
pub(crate) fn lines(faults: &[impl fmt::Display]) -> String {
    let lines: Vec<String> = faults.iter().map(ToString::to_string).collect();
    lines.join("\n  ")
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
    #[error("no {program} answers at {address}: {reason}\n  {}", program.advice())]
    CannotConnect {
        /// Which program should answer.
        program: Program,
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
    #[error("{address} answered {status}{}",
        if detail.is_empty() { String::new() } else { format!(": {detail}") })]
    Refused {
        /// Who refused.
        address: String,
        /// HTTP status.
        status: u16,
        /// What it said.
        detail: String,
    },
    /// The answer is not what the contract says.
    #[error("{address} answers, but not as a {program} does: {reason}")]
    Answer {
        /// Which program should answer.
        program: Program,
        /// Who answered.
        address: String,
        /// What is wrong.
        reason: String,
    },
    /// The main service of BlazeConfig refused.
    #[error("{0}")]
    Problem(Box<Refusal>),
    /// Nobody answers as the main service of BlazeConfig.
    #[error("no BlazeConfig answers at {server}: {reason}\n  {advice}")]
    NoServer {
        /// Where it was tried.
        server: String,
        /// What the system or the deadline said.
        reason: String,
        /// What to do.
        advice: String,
    },
    /// What answers is not the main service of BlazeConfig, or not as the contract says.
    #[error("{server} answers, but not as BlazeConfig does: {reason}")]
    Foreign {
        /// Who answered.
        server: String,
        /// What is wrong.
        reason: String,
    },
    /// A change was sent and no answer came.
    #[error(
        "{server} took the change and did not answer ({reason}): whether it took effect is not \
         known.\n  Look before you try again: `blaze get` shows what is, `blaze history` who \
         changed it last."
    )]
    OutcomeUnknown {
        /// To whom it was sent.
        server: String,
        /// What the system or the deadline said.
        reason: String,
    },
    /// A called service has not replied.
    #[error("{}{}: {}", .0.code,
        if .0.pointer.is_empty() { String::new() } else { format!(" at {}", .0.pointer) }, .0.detail)]
    Call(Box<ControlError>),
    /// `diff` could not compare.
    #[error("{0}")]
    Diff(Box<CliError>),
    /// One of the others, and what else there is to say about it.
    #[error("{0}\n  {1}")]
    Advised(Box<CliError>, String),
    /// Whoever read our output has gone; no failure.
    #[error("the output was closed")]
    OutputClosed,
}

impl CliError {
    /// The same, with one more sentence for who reads it.
    #[must_use]
    pub fn advised(self, advice: impl Into<String>) -> Self {
        Self::Advised(Box::new(self), advice.into())
    }

    /// The same, with one more thing to do, if the main service refused with this code.
    #[must_use]
    pub fn hinted(self, code: &str, hint: &str) -> Self {
        match self {
            Self::Problem(refusal) if refusal.code() == code => {
                Self::Problem(Box::new(refusal.with_hint(hint)))
            }
            other => other,
        }
    }

    /// The exit code for it.
    #[must_use]
    pub fn exit(&self) -> Exit {
        match self {
            Self::Usage(_) => Exit::Usage,
            Self::CannotConnect { .. } | Self::NoBroker { .. } => Exit::CannotConnect,
            Self::Invalid(_) => Exit::Invalid,
            Self::Refused { status, .. } => Exit::of_status(*status),
            Self::Problem(refusal) => refusal.exit(),
            Self::NoServer { .. } => Exit::CannotConnect,
            Self::Call(error) => match error.code {
                ErrorCode::NoServer => Exit::NotFound,
                ErrorCode::ConvertError => Exit::Invalid,
                _ => Exit::Failed,
            },
            Self::Diff(inner) => match inner.exit() {
                Exit::Failed => Exit::DiffFailed,
                exit => exit,
            },
            Self::Advised(inner, _) => inner.exit(),
            Self::OutputClosed => Exit::Done,
            Self::Failed(_)
            | Self::Answer { .. }
            | Self::Foreign { .. }
            | Self::OutcomeUnknown { .. } => Exit::Failed,
        }
    }

    /// What `-o json` prints on stderr: the problem as the server told it, else one of the same
    /// form.
    #[must_use]
    pub fn to_json(&self) -> Value {
        let (code, title) = match self {
            Self::Problem(refusal) => return refusal.problem.clone(),
            Self::Diff(inner) => return inner.to_json(),
            Self::Advised(inner, advice) => {
                let mut problem = inner.to_json();
                if let Value::Object(members) = &mut problem {
                    members.insert("hint".to_owned(), advice.as_str().into());
                }
                return problem;
            }
            Self::Usage(_) => ("usage", "The options make no sense together."),
            Self::CannotConnect { .. } | Self::NoBroker { .. } | Self::NoServer { .. } => {
                ("cannot_connect", "Nobody answers.")
            }
            Self::Invalid(_) => ("invalid", "What was given is invalid."),
            Self::Refused { .. } => ("refused", "The server refused."),
            Self::Answer { .. } | Self::Foreign { .. } => {
                ("foreign_answer", "Something else answers there.")
            }
            Self::OutcomeUnknown { .. } => {
                ("outcome_unknown", "Whether the change took effect is not known.")
            }
            Self::Call(error) => (error.code.as_str(), "The called service has not replied."),
            Self::Failed(_) | Self::OutputClosed => ("failed", "It was tried and failed."),
        };
        let applied = match self {
            Self::OutcomeUnknown { .. } => "unknown",
            _ => "no",
        };
        json!({
            "type": "about:blank", "title": title, "detail": self.to_string(), "code": code,
            "applied": applied,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statuses_have_the_exit_codes_of_the_contract() {
        for (statuses, exit) in [
            (&[404_u16][..], 4),
            (&[409, 412, 428], 5),
            (&[401, 403], 6),
            (&[400, 413, 415, 422], 7),
            (&[405, 406, 410, 414, 429, 431, 500, 503, 504], 1),
        ] {
            for status in statuses {
                assert_eq!(Exit::of_status(*status) as u8, exit, "{status}");
            }
        }
    }

    #[test]
    fn in_diff_one_means_different() {
        let diff = |inner: CliError| CliError::Diff(Box::new(inner)).exit() as u8;
        assert_eq!(diff(CliError::Failed("x".to_owned())), 8);
        assert_eq!(diff(CliError::Invalid("x".to_owned())), 7);
        assert_eq!(diff(CliError::Usage("x".to_owned())), 2);
    }

    #[test]
    fn every_failure_has_a_problem_object() {
        let lost = CliError::OutcomeUnknown {
            server: "http://127.0.0.1:8080".to_owned(),
            reason: "the connection broke".to_owned(),
        };
        assert_eq!(lost.exit(), Exit::Failed);
        let problem = lost.to_json();
        assert_eq!(problem["code"], "outcome_unknown");
        assert_eq!(problem["applied"], "unknown");
        assert!(problem["detail"].as_str().unwrap().contains("Look before you try again"));
        assert_eq!(CliError::Usage("x".to_owned()).to_json()["applied"], "no");
    }

    #[test]
    fn advice_changes_nothing_but_what_is_said() {
        let error = CliError::Usage("x".to_owned()).advised("Try y.");
        assert_eq!((error.exit(), error.to_string().as_str()), (Exit::Usage, "x\n  Try y."));
        let problem = error.to_json();
        assert_eq!((&problem["code"], &problem["hint"]), (&json!("usage"), &json!("Try y.")));
        assert_eq!(problem["detail"], "x");
    }
}
