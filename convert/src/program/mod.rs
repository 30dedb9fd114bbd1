//! A type as a program that takes its bytes to JSON and back.
//!
//! A description refers to its types by name; here each has a number, each field its JSON key, its
//! kind and its default, and types without an end have been refused. Both ways stream: there is no
//! tree of values between the bytes and the text.

mod cdr;
mod compile;
mod error;
mod from_json;
mod scalar;
mod to_json;

#[cfg(test)]
mod fuzz;
#[cfg(test)]
mod limit_tests;
#[cfg(test)]
mod properties;
#[cfg(test)]
mod samples;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod values;

use std::ops::Range;

pub use compile::CompileError;
pub use error::ConvertError;

use crate::description::TypeDescription;
use cdr::{ENCAPSULATION, Reader, Writer};
use error::Fault;

/// Type of one value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Item {
    Bool,
    /// `uint8`, `byte` and `char`: many of them are base64.
    Byte,
    Int8,
    Int16,
    UInt16,
    Int32,
    UInt32,
    Int64,
    UInt64,
    Float32,
    Float64,
    /// At most so many bytes.
    Text(usize),
    /// At most so many UTF-16 units.
    Wide(usize),
    /// The message of this number.
    Message(usize),
}

/// Number of values of a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Arity {
    Single,
    /// Always as many.
    Array(usize),
    /// A number, then at most as many.
    Sequence(usize),
}

#[derive(Debug, Clone)]
struct FieldOp {
    name: Box<str>,
    /// `"name":`
    key: Box<str>,
    item: Item,
    arity: Arity,
    /// JSON that stands for a missing member; zeros if there is none.
    default: Option<Box<str>>,
}

#[derive(Debug, Clone)]
struct MessageOp {
    fields: Range<usize>,
    /// Its fields in the order of their names, counted from its first.
    by_name: Box<[u32]>,
}

/// A type that was compiled. Any number of threads may use it.
#[derive(Debug, Clone)]
pub struct Program {
    /// The first one is the type itself.
    messages: Vec<MessageOp>,
    fields: Vec<FieldOp>,
}

impl Program {
    /// Prepares a type for conversion.
    ///
    /// # Errors
    /// For kinds of values that are not read, types that refer to themselves or are not in the
    /// description, nesting above [`MAX_NESTING`](crate::limits::MAX_NESTING), a type whose
    /// smallest value exceeds [`MAX_MESSAGE_BYTES`](crate::limits::MAX_MESSAGE_BYTES), and defaults
    /// that are no values.
    pub fn compile(description: &TypeDescription) -> Result<Self, CompileError> {
        compile::compile(description)
    }

    /// Appends the JSON of a message to `out`. `cdr` is the encapsulation (4 bytes) and the
    /// message, little or big endian. Up to 3 bytes may follow it, and 8 more for each wide string
    /// and each empty sequence of values of 8 bytes, for which Fast DDS reserves too much. More
    /// means that the bytes are not of this type.
    ///
    /// # Errors
    /// If the bytes are not of the type, are of another representation, or either side is larger
    /// than [`MAX_MESSAGE_BYTES`](crate::limits::MAX_MESSAGE_BYTES). `out` is as it was then.
    pub fn to_json(&self, cdr: &[u8], out: &mut Vec<u8>) -> Result<(), ConvertError> {
        let start = out.len();
        let done = Reader::new(cdr).and_then(|reader| to_json::message(self, reader, out));
        done.map_err(|fault| undone(fault, out, start))
    }

    /// Appends the CDR of a message to `out`: 4 bytes of encapsulation, then little endian.
    ///
    /// # Errors
    /// If the text is not JSON or not of the type, or either side is larger than
    /// [`MAX_MESSAGE_BYTES`](crate::limits::MAX_MESSAGE_BYTES). `out` is as it was then.
    pub fn to_cdr(&self, json: &[u8], out: &mut Vec<u8>) -> Result<(), ConvertError> {
        let start = out.len();
        out.extend_from_slice(&ENCAPSULATION);
        let done = from_json::message(self, json, Writer::new(out));
        done.map_err(|fault| undone(fault, out, start))
    }

    fn message(&self, number: usize) -> Option<&MessageOp> {
        self.messages.get(number)
    }

    fn fields_of(&self, number: usize) -> &[FieldOp] {
        let range = self.message(number).map(|message| message.fields.clone());
        range.and_then(|range| self.fields.get(range)).unwrap_or_default()
    }
}

fn undone(fault: Box<Fault>, out: &mut Vec<u8>, start: usize) -> ConvertError {
    out.truncate(start);
    fault.into()
}
