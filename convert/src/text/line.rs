//! One line of a definition.

use super::{is_field_name, is_type_name};
use crate::description::{Constant, Field, FieldType, IndividualType};
use crate::kinds::{Base, Shape};
use crate::literal;

/// Adds the field or constant of the line. Types without a package are those of `package`.
///
/// # Errors
/// The expected form, and the text found.
pub(super) fn parse(line: &str, package: &str, ty: &mut IndividualType) -> Result<(), String> {
    let line = without_comment(line);
    if line.is_empty() {
        return Ok(());
    }
    let (type_text, rest) = line
        .split_once(char::is_whitespace)
        .map(|(type_text, rest)| (type_text, rest.trim_start()))
        .ok_or_else(|| format!("expected a type and a name, found {line:?}"))?;
    let end = rest.find(|c: char| c == '=' || c.is_whitespace()).unwrap_or(rest.len());
    let (name, rest) = rest.split_at(end);
    if !is_field_name(name) {
        return Err(format!("expected a name, found {name:?}"));
    }
    let ty_of = parse_type(type_text, package)?;
    match rest.trim_start().strip_prefix('=') {
        Some(value) => ty.constants.push(constant(type_text, name, value)),
        None => ty.fields.push(field(ty_of, name, rest.trim())),
    }
    Ok(())
}

/// The line up to `#`, which counts as text in quotes, and without blanks around it.
fn without_comment(line: &str) -> &str {
    let mut quote = None;
    let mut before = ' ';
    for (at, character) in line.char_indices() {
        match (quote, character) {
            (None, '#') => return line.get(..at).unwrap_or(line).trim(),
            (None, '"' | '\'') if may_open(before) && closes(line, at, character) => {
                quote = Some(character);
            }
            (Some(open), close) if open == close && before != '\\' => quote = None,
            _ => {}
        }
        before = character;
    }
    line.trim()
}

/// Whether a quote may stand after this: an apostrophe is none.
fn may_open(before: char) -> bool {
    before.is_whitespace() || matches!(before, '=' | '[' | ',')
}

fn closes(line: &str, at: usize, quote: char) -> bool {
    line.get(at + 1..).is_some_and(|rest| rest.contains(quote))
}

fn constant(type_text: &str, name: &str, value: &str) -> Constant {
    Constant { ty: type_text.to_owned(), name: name.to_owned(), value: value.trim().to_owned() }
}

fn field(ty: FieldType, name: &str, default: &str) -> Field {
    let single_text = ty.shape() == Some(Shape::Single) && ty.base().is_some_and(is_text);
    let default_value = if single_text { literal::unquoted(default) } else { default.to_owned() };
    Field { name: name.to_owned(), ty, default_value }
}

fn is_text(base: Base) -> bool {
    matches!(base.name(), "string" | "wstring")
}

/// `uint8[<=3]`, `string<=10[]`, `Point`, `geometry_msgs/Point[4]`
fn parse_type(text: &str, package: &str) -> Result<FieldType, String> {
    let (element, shape) = match text.strip_suffix(']').and_then(|rest| rest.rsplit_once('[')) {
        Some((element, size)) => (element, parse_shape(size)?),
        None => (text, Shape::Single),
    };
    let (name, bound) = match element.split_once("<=") {
        Some((name, bound)) => (name, parse_size(bound)?),
        None => (element, 0),
    };
    match Base::named(name) {
        Some(base) if bound == 0 || is_text(base) => Ok(FieldType::plain(base, shape, bound)),
        None if bound == 0 => Ok(FieldType::nested(full_name(name, package)?, shape)),
        _ => Err(format!("only strings have a bound, found {element:?}")),
    }
}

fn parse_shape(size: &str) -> Result<Shape, String> {
    match size.strip_prefix("<=") {
        _ if size.is_empty() => Ok(Shape::Unbounded),
        Some(most) => parse_size(most).map(Shape::Bounded),
        None => parse_size(size).map(Shape::Array),
    }
}

fn parse_size(text: &str) -> Result<u64, String> {
    let size = text.parse::<u32>().ok().filter(|size| *size > 0).map(u64::from);
    size.ok_or_else(|| format!("expected a size from 1 to {}, found {text:?}", u32::MAX))
}

/// `Point` and `geometry_msgs/Point` are messages; services and actions have three segments.
pub(super) fn full_name(name: &str, package: &str) -> Result<String, String> {
    let full = match name.matches('/').count() {
        0 if name.starts_with(|first: char| first.is_ascii_uppercase()) => {
            format!("{package}/msg/{name}")
        }
        1 => name.replacen('/', "/msg/", 1),
        _ => name.to_owned(),
    };
    if is_type_name(&full) { Ok(full) } else { Err(format!("{name:?} is not a type")) }
}
