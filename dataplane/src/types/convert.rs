//! Conversion of payloads: CDR to JSON and back.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_convert::limits::MAX_MESSAGE_BYTES;
use blaze_convert::{ConvertError, Program, TypeHash};
use blaze_domain::{DropReason, WhyCode};
use bytes::Bytes;

use super::{MessageType, Types};

/// Longest pointer and longest detail of a failure, in bytes: a message may name any member.
const MAX_TEXT: usize = 300;

/// An encoding that payloads are converted to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Encoding {
    /// JSON text.
    Json,
    /// CDR of ROS 2, little endian.
    Cdr,
}

impl fmt::Display for Encoding {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::Json => "JSON",
            Self::Cdr => "CDR",
        })
    }
}

/// Why a message was not converted. Its text is `/linear/x: expected a number, found text`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConvertFailure {
    /// `convert_error`, `type_unknown`, `type_mismatch` or `too_large`.
    pub code: WhyCode,
    /// JSON pointer of the value; empty for the whole message.
    pub pointer: String,
    /// For people.
    pub detail: String,
}

impl ConvertFailure {
    /// A failure of the whole message, with a bounded detail.
    #[must_use]
    pub fn new(code: WhyCode, detail: impl Into<String>) -> Self {
        Self { code, pointer: String::new(), detail: bounded(detail.into()) }
    }

    /// The reason that the message counts under.
    #[must_use]
    pub fn reason(&self) -> DropReason {
        match self.code {
            WhyCode::TypeMismatch => DropReason::TypeMismatch,
            WhyCode::TooLarge => DropReason::TooLarge,
            _ => DropReason::ConvertError,
        }
    }
}

fn bounded(mut text: String) -> String {
    if text.len() > MAX_TEXT {
        text.truncate(text.floor_char_boundary(MAX_TEXT));
        text.push('…');
    }
    text
}

impl fmt::Display for ConvertFailure {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { pointer, detail, .. } = self;
        write!(out, "{pointer}{}{detail}", if pointer.is_empty() { "" } else { ": " })
    }
}

impl From<ConvertError> for ConvertFailure {
    fn from(error: ConvertError) -> Self {
        match error {
            ConvertError::Value { pointer, text } => {
                Self { pointer: bounded(pointer), ..Self::new(WhyCode::ConvertError, text) }
            }
            ConvertError::TooLarge => Self::new(WhyCode::TooLarge, error.to_string()),
            ConvertError::Representation(_) => Self::new(WhyCode::ConvertError, error.to_string()),
        }
    }
}

/// A type that was found and compiled.
#[derive(Debug)]
pub struct CompiledType {
    /// Its name.
    pub name: String,
    /// Hash of its definition.
    pub hash: TypeHash,
    /// Converts its messages.
    pub program: Program,
}

/// A conversion for a thread of the pool, which may have to find the type first.
#[derive(Debug, Clone)]
pub struct Conversion {
    /// Finds the type.
    pub types: Arc<Types>,
    /// The type.
    pub ty: MessageType,
    /// The encoding that is wanted.
    pub to: Encoding,
}

/// A payload that was converted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Converted {
    /// The new payload.
    pub payload: Bytes,
    /// Name of its type.
    pub name: String,
    /// Hash of its type.
    pub hash: TypeHash,
    /// Time that it took.
    pub took: Duration,
}

impl Conversion {
    /// Converts a payload, on the thread of the caller. Reads files if the type is a new one.
    ///
    /// # Errors
    /// Why it cannot be converted.
    pub fn run(&self, payload: &[u8]) -> Result<Converted, ConvertFailure> {
        let ty = self.types.get(Instant::now(), self.ty.borrowed())?;
        ty.convert(self.to, payload)
    }
}

impl CompiledType {
    /// Converts a payload, on the thread of the caller.
    ///
    /// # Errors
    /// Why it cannot be converted.
    pub fn convert(&self, to: Encoding, payload: &[u8]) -> Result<Converted, ConvertFailure> {
        let began = Instant::now();
        let about = match to {
            Encoding::Json => payload.len().saturating_mul(2),
            Encoding::Cdr => payload.len(),
        };
        let mut out = Vec::with_capacity(about.min(MAX_MESSAGE_BYTES));
        match to {
            Encoding::Json => self.program.to_json(payload, &mut out)?,
            Encoding::Cdr => self.program.to_cdr(payload, &mut out)?,
        }
        Ok(Converted {
            payload: out.into(),
            name: self.name.clone(),
            hash: self.hash,
            took: began.elapsed(),
        })
    }
}
