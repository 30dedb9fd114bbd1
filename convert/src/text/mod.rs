//! Reads message, service and action files, and message files that were joined as MCAP joins them.
//!
//! One line has one field or constant: `TYPE NAME`, `TYPE NAME DEFAULT` or `TYPE NAME=VALUE`; `#`
//! starts a comment. Services and actions have their parts between lines of `---`.

mod joined;
mod line;

use crate::description::{DescriptionError, EMPTY_FIELD, FieldType, IndividualType};
use crate::description::{is_field_name, is_type_name};
use crate::kinds::{Base, Shape};
use crate::limits::MAX_DEFINITION_BYTES;
use crate::parts;
use crate::pool::PoolError;

pub use joined::parse_joined;
pub(crate) use joined::{Kind, sections};

/// Why a text is not a definition.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TextError {
    /// A line that is neither a field nor a constant.
    #[error("{type_name} line {line}: {fault}")]
    Line {
        /// The type whose text has the line.
        type_name: String,
        /// Its number, from 1.
        line: usize,
        /// The expected form, and the text found.
        fault: String,
    },
    /// A service needs one line of `---`, an action two.
    #[error("{type_name} has {found} parts, expected {expected}")]
    Parts {
        /// The type whose text it is.
        type_name: String,
        /// Parts between lines of `---`.
        found: usize,
        /// Parts that such a file has.
        expected: usize,
    },
    /// The text is larger than [`MAX_DEFINITION_BYTES`].
    #[error("has {bytes} bytes, at most {MAX_DEFINITION_BYTES} are allowed")]
    TooLarge {
        /// Bytes given.
        bytes: usize,
    },
    /// Names or sizes are not those of a description.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// A type that the text refers to is missing.
    #[error(transparent)]
    Pool(#[from] PoolError),
}

/// Reads the text of a message file. `type_name` is its full name, `std_msgs/msg/Header`.
///
/// # Errors
/// For the first line that is none, a bad name, and more than the limits allow.
pub fn parse_message(type_name: &str, text: &str) -> Result<IndividualType, TextError> {
    check_size(text)?;
    let package = package_of(type_name)?;
    parse_part(type_name, package, 1, text)
}

/// Reads the text of a service file: the service, its request, its response and its event.
///
/// # Errors
/// As [`parse_message`], and for another number of parts than two.
pub fn parse_service(type_name: &str, text: &str) -> Result<Vec<IndividualType>, TextError> {
    let [request, response] = parse_parts(type_name, text, ["_Request", "_Response"])?;
    Ok(parts::service(type_name, request, response))
}

/// Reads the text of an action file: the action, goal, result and feedback, and the types of its
/// services and topics.
///
/// # Errors
/// As [`parse_message`], and for another number of parts than three.
pub fn parse_action(type_name: &str, text: &str) -> Result<Vec<IndividualType>, TextError> {
    let suffixes = ["_Goal", "_Result", "_Feedback"];
    let [goal, result, feedback] = parse_parts(type_name, text, suffixes)?;
    Ok(parts::action(type_name, goal, result, feedback))
}

fn check_size(text: &str) -> Result<(), TextError> {
    match text.len() {
        bytes if bytes > MAX_DEFINITION_BYTES => Err(TextError::TooLarge { bytes }),
        _ => Ok(()),
    }
}

fn package_of(type_name: &str) -> Result<&str, DescriptionError> {
    let package = type_name.split('/').next().filter(|_| is_type_name(type_name));
    package.ok_or_else(|| DescriptionError::TypeName(type_name.to_owned()))
}

fn parse_parts<const N: usize>(
    type_name: &str,
    text: &str,
    suffixes: [&str; N],
) -> Result<[IndividualType; N], TextError> {
    check_size(text)?;
    let package = package_of(type_name)?;
    let parts = split_parts(text);
    let found = parts.len();
    let wrong = || TextError::Parts { type_name: type_name.to_owned(), found, expected: N };
    let parts: [(usize, String); N] = parts.try_into().map_err(|_| wrong())?;
    let mut types = Vec::new();
    for (suffix, (line, part)) in suffixes.iter().zip(&parts) {
        types.push(parse_part(&format!("{type_name}{suffix}"), package, *line, part)?);
    }
    types.try_into().map_err(|_| wrong())
}

/// Each part with the number of its first line.
fn split_parts(text: &str) -> Vec<(usize, String)> {
    let mut parts = vec![(1, String::new())];
    for (index, line) in text.lines().enumerate() {
        if line.trim_end() == "---" {
            parts.push((index + 2, String::new()));
        } else if let Some((_, part)) = parts.last_mut() {
            part.push_str(line);
            part.push('\n');
        }
    }
    parts
}

fn parse_part(
    type_name: &str,
    package: &str,
    first_line: usize,
    text: &str,
) -> Result<IndividualType, TextError> {
    let mut ty = IndividualType {
        type_name: type_name.to_owned(),
        fields: Vec::new(),
        constants: Vec::new(),
    };
    for (index, line) in text.lines().enumerate() {
        line::parse(line, package, &mut ty).map_err(|fault| TextError::Line {
            type_name: type_name.to_owned(),
            line: first_line + index,
            fault,
        })?;
    }
    Ok(filled(ty))
}

/// A message without fields gets the one that stands for none.
pub(crate) fn filled(mut ty: IndividualType) -> IndividualType {
    if ty.fields.is_empty() {
        let byte = FieldType::plain(Base::UInt8, Shape::Single, 0);
        ty.fields.push(parts::field(EMPTY_FIELD, byte));
    }
    ty
}

#[cfg(test)]
mod tests;
