//! Readers of single values: texts, numbers, words of closed sets, each with its own words for what
//! is wrong.

use std::str::FromStr;

use serde_json::Value;

use super::walk::Node;

/// Longest text, in bytes.
const MAX_TEXT_BYTES: usize = 4096;

/// Any text that is not empty.
pub(super) fn text(node: &Node<'_>) -> Option<String> {
    match free_text(node)? {
        text if text.is_empty() => node.fault("is empty"),
        text => Some(text),
    }
}

/// Any text, also an empty one.
pub(super) fn free_text(node: &Node<'_>) -> Option<String> {
    match node.value {
        Value::String(text) if text.len() > MAX_TEXT_BYTES => {
            node.fault(format!("has {} bytes, at most {MAX_TEXT_BYTES} are allowed", text.len()))
        }
        Value::String(text) if text.contains('\0') => node.fault("holds a zero byte"),
        Value::String(text) => Some(text.clone()),
        _ => node.expected("text"),
    }
}

/// A file or directory; whether it exists is asked by the program that opens it.
pub(super) fn path(node: &Node<'_>) -> Option<std::path::PathBuf> {
    text(node).map(Into::into)
}

pub(super) fn boolean(node: &Node<'_>) -> Option<bool> {
    match node.value {
        Value::Bool(value) => Some(*value),
        _ => node.expected("true or false"),
    }
}

/// A text that a type reads: names, words of a closed set, addresses.
pub(super) fn parsed<T>(node: &Node<'_>) -> Option<T>
where
    T: FromStr,
    T::Err: std::fmt::Display,
{
    let text = text(node)?;
    match text.parse() {
        Ok(value) => Some(value),
        Err(error) => node.fault(words(&text, &error)),
    }
}

/// Words of an error for a text. Errors of names do not repeat the text, those of words do.
pub(crate) fn words(text: &str, error: &impl std::fmt::Display) -> String {
    let error = error.to_string();
    if error.starts_with('"') { error } else { format!("{text:?} {error}") }
}

/// A text with a form that only `read` knows; `wanted` says it in words.
pub(super) fn formed<T>(
    wanted: &'static str,
    read: impl Fn(&str) -> Option<T>,
) -> impl Fn(&Node<'_>) -> Option<T> {
    move |node| {
        let text = text(node)?;
        read(&text).or_else(|| node.fault(format!("{text:?} is not {wanted}")))
    }
}

/// A whole number between two bounds, both included.
pub(super) fn whole<T>(least: T, most: T) -> impl Fn(&Node<'_>) -> Option<T>
where
    T: Copy + TryFrom<u64> + Into<u64>,
{
    move |node| {
        let (least, most): (u64, u64) = (least.into(), most.into());
        let Value::Number(number) = node.value else {
            return node.expected(&format!("a whole number from {least} to {most}"));
        };
        match number.as_u64().filter(|value| (least..=most).contains(value)).map(T::try_from) {
            Some(Ok(value)) => Some(value),
            _ => node.fault(format!("{number} is not a whole number from {least} to {most}")),
        }
    }
}

/// A number between two bounds, both included.
pub(super) fn number(least: f64, most: f64) -> impl Fn(&Node<'_>) -> Option<f64> {
    move |node| {
        let Value::Number(number) = node.value else {
            return node.expected(&format!("a number from {least} to {most}"));
        };
        match number.as_f64().filter(|value| (least..=most).contains(value)) {
            Some(value) => Some(value),
            None => node.fault(format!("{number} is not between {least} and {most}")),
        }
    }
}
