//! Definitions of several types in one text: each but the first after a line of `=` and a line with
//! its name, `MSG: geometry_msgs/Vector3`.

use super::line::full_name;
use super::{TextError, check_size, package_of, parse_part};
use crate::description::TypeDescription;
use crate::pool::Pool;

/// Kind of a definition.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Message,
    Service,
    Action,
}

/// One part of a text.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Section<'a> {
    pub(crate) kind: Kind,
    /// As it stands in the text.
    pub(crate) name: &'a str,
    pub(crate) text: String,
    /// Number of its first line, from 1.
    pub(crate) line: usize,
}

/// The parts of a text. The first has no name if no line of `=` is before it.
pub(crate) fn sections(text: &str) -> Vec<Section<'_>> {
    let first = Section { kind: Kind::Message, name: "", text: String::new(), line: 1 };
    let mut sections = vec![first];
    let mut separated = false;
    for (index, line) in text.lines().enumerate() {
        match named(line).filter(|_| separated) {
            Some((kind, name)) => {
                sections.push(Section { kind, name, text: String::new(), line: index + 2 });
            }
            None if !is_separator(line) => {
                if let Some(section) = sections.last_mut() {
                    section.text.push_str(line);
                    section.text.push('\n');
                }
            }
            None => {}
        }
        separated = is_separator(line);
    }
    sections
}

fn is_separator(line: &str) -> bool {
    let line = line.trim_end();
    line.len() >= 3 && line.bytes().all(|byte| byte == b'=')
}

fn named(line: &str) -> Option<(Kind, &str)> {
    let (kind, name) = line.split_once(':')?;
    let kind = match kind {
        "MSG" => Kind::Message,
        "SRV" => Kind::Service,
        "ACTION" => Kind::Action,
        _ => return None,
    };
    Some((kind, name.trim()))
}

/// Reads the definition of a message and of all that it refers to, joined as MCAP files have them.
/// A type that the text does not have is sought among `known`.
///
/// # Errors
/// As [`parse_message`](super::parse_message), and for a type that is missing.
pub fn parse_joined(
    type_name: &str,
    text: &str,
    known: Option<&Pool>,
) -> Result<TypeDescription, TextError> {
    check_size(text)?;
    let package = package_of(type_name)?;
    let mut pool = Pool::default();
    for section in sections(text) {
        let full = match section.name {
            "" => type_name.to_owned(),
            name => full_name(name, package).map_err(|fault| TextError::Line {
                type_name: type_name.to_owned(),
                line: section.line - 1,
                fault,
            })?,
        };
        let package = package_of(&full)?;
        pool.add([parse_part(&full, package, section.line, &section.text)?]);
    }
    let find = |name: &str| pool.get(name).or_else(|| known.and_then(|known| known.get(name)));
    Ok(Pool::collect(type_name, |name| find(name).cloned())?)
}
