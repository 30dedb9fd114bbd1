//! Faults of messages and their places.

use std::fmt;

use crate::limits::MAX_MESSAGE_BYTES;

/// Why a message cannot be converted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ConvertError {
    /// One side is larger than [`MAX_MESSAGE_BYTES`].
    TooLarge,
    /// The encapsulation is not that of plain CDR: such a message is carried, not converted.
    Representation(u16),
    /// A value is not one of the type.
    Value {
        /// JSON pointer of the value, empty for the message itself.
        pointer: String,
        /// The expected and the found value.
        text: String,
    },
}

impl std::error::Error for ConvertError {}

impl fmt::Display for ConvertError {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooLarge => write!(out, "larger than {MAX_MESSAGE_BYTES} bytes"),
            Self::Representation(id) => write!(
                out,
                "data representation {id:#06x} is not converted, expected 0x0000 or 0x0001"
            ),
            Self::Value { pointer, text } if pointer.is_empty() => out.write_str(text),
            Self::Value { pointer, text } => write!(out, "{pointer}: {text}"),
        }
    }
}

/// A step from a value to the one that it is in.
#[derive(Debug)]
enum Step {
    Member(Box<str>),
    Element(usize),
}

/// An error on its way up: each level adds where it was.
#[derive(Debug)]
pub(super) struct Fault {
    what: What,
    /// The innermost first.
    steps: Vec<Step>,
}

#[derive(Debug)]
enum What {
    TooLarge,
    Representation(u16),
    Text(String),
}

impl Fault {
    fn of(what: What) -> Box<Self> {
        Box::new(Self { what, steps: Vec::new() })
    }

    pub(super) fn too_large() -> Box<Self> {
        Self::of(What::TooLarge)
    }

    pub(super) fn representation(id: u16) -> Box<Self> {
        Self::of(What::Representation(id))
    }

    pub(super) fn text(text: impl Into<String>) -> Box<Self> {
        Self::of(What::Text(text.into()))
    }

    pub(super) fn in_member(mut self: Box<Self>, name: &str) -> Box<Self> {
        self.steps.push(Step::Member(name.into()));
        self
    }

    pub(super) fn in_element(mut self: Box<Self>, index: usize) -> Box<Self> {
        self.steps.push(Step::Element(index));
        self
    }

    fn pointer(&self) -> String {
        let segment = |step: &Step| match step {
            Step::Member(name) => format!("/{}", name.replace('~', "~0").replace('/', "~1")),
            Step::Element(index) => format!("/{index}"),
        };
        self.steps.iter().rev().map(segment).collect()
    }
}

impl From<Box<Fault>> for ConvertError {
    fn from(fault: Box<Fault>) -> Self {
        let pointer = fault.pointer();
        match fault.what {
            What::TooLarge => Self::TooLarge,
            What::Representation(id) => Self::Representation(id),
            What::Text(text) => Self::Value { pointer, text },
        }
    }
}
