//! Values of JSON that are neither messages nor lists, from their text, which is valid JSON.

use std::borrow::Cow;
use std::str::FromStr;

use base64::DecodeSliceError;
use base64::Engine;
use base64::alphabet::STANDARD;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};

use super::Item;
use super::cdr::{Writer, check_length};
use super::error::Fault;

/// With and without padding.
const BASE64: GeneralPurpose = GeneralPurpose::new(
    &STANDARD,
    GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent),
);

type Done = Result<(), Box<Fault>>;

/// Writes one value.
///
/// # Errors
/// If the JSON is not a value of this kind.
pub(super) fn write(cdr: &mut Writer<'_>, item: Item, json: &str) -> Done {
    match item {
        Item::Bool => cdr.scalar([u8::from(bool(json)?)]),
        Item::Byte => cdr.scalar(integer::<u8>(json)?.to_le_bytes()),
        Item::Int8 => cdr.scalar(integer::<i8>(json)?.to_le_bytes()),
        Item::Int16 => cdr.scalar(integer::<i16>(json)?.to_le_bytes()),
        Item::UInt16 => cdr.scalar(integer::<u16>(json)?.to_le_bytes()),
        Item::Int32 => cdr.scalar(integer::<i32>(json)?.to_le_bytes()),
        Item::UInt32 => cdr.scalar(integer::<u32>(json)?.to_le_bytes()),
        Item::Int64 => cdr.scalar(integer::<i64>(digits(json))?.to_le_bytes()),
        Item::UInt64 => cdr.scalar(integer::<u64>(digits(json))?.to_le_bytes()),
        Item::Float32 => cdr.scalar(float32(json)?.to_le_bytes()),
        Item::Float64 => cdr.scalar(float64(json)?.to_le_bytes()),
        Item::Text(most) => {
            let text = text(json)?;
            check_length(text.len(), most, "bytes")?;
            write_text(cdr, &text)?;
        }
        Item::Wide(most) => write_wide(cdr, &text(json)?, most)?,
        Item::Message(_) => return Err(other_kind("an object", kind(json))),
    }
    Ok(())
}

/// Another kind of value than the one that the type has.
pub(super) fn other_kind(expected: &str, found: &str) -> Box<Fault> {
    Fault::text(format!("expected {expected}, found {found}"))
}

/// Kind of a valid JSON value, by its first character.
fn kind(json: &str) -> &'static str {
    match json.as_bytes().first() {
        Some(b'{') => "an object",
        Some(b'[') => "an array",
        Some(b'"') => "text",
        Some(b't' | b'f') => "a bool",
        Some(b'n') => "null",
        _ => "a number",
    }
}

fn bool(json: &str) -> Result<bool, Box<Fault>> {
    match json {
        "true" => Ok(true),
        "false" => Ok(false),
        _ => Err(other_kind("a bool", kind(json))),
    }
}

/// The digits of a text of digits; all else as it is.
fn digits(json: &str) -> &str {
    let inner = json.strip_prefix('"').and_then(|rest| rest.strip_suffix('"'));
    let is_number = |text: &&str| {
        let digits = text.strip_prefix('-').unwrap_or(text);
        !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit())
    };
    inner.filter(is_number).unwrap_or(json)
}

fn integer<T: TryFrom<i128> + FromStr>(json: &str) -> Result<T, Box<Fault>> {
    if let Ok(value) = json.parse() {
        return Ok(value);
    }
    if !json.starts_with(|first: char| first == '-' || first.is_ascii_digit()) {
        return Err(other_kind("an integer", kind(json)));
    }
    let out_of_range = || Fault::text(format!("{} is out of range", shortened(json)));
    if !json.contains(['.', 'e', 'E']) {
        // `-0` is an integer of an unsigned field, too.
        return json
            .parse()
            .ok()
            .and_then(|value: i128| T::try_from(value).ok())
            .ok_or_else(out_of_range);
    }
    let value: f64 =
        json.parse().ok().filter(|value: &f64| value.is_finite()).ok_or_else(out_of_range)?;
    if value.fract() != 0.0 {
        return Err(Fault::text(format!("expected an integer, found {}", shortened(json))));
    }
    // A cast of floats stops at the ends of the range, which no field has.
    T::try_from(value as i128).map_err(|_| out_of_range())
}

/// A number for a message to people.
fn shortened(json: &str) -> Cow<'_, str> {
    match json.get(..32) {
        Some(start) if json.len() > 32 => Cow::Owned(format!("{start}…")),
        _ => Cow::Borrowed(json),
    }
}

fn float32(json: &str) -> Result<f32, Box<Fault>> {
    match not_finite(json) {
        Some(value) => Ok(value as f32),
        None => number(json, f32::is_finite),
    }
}

fn float64(json: &str) -> Result<f64, Box<Fault>> {
    match not_finite(json) {
        Some(value) => Ok(value),
        None => number(json, f64::is_finite),
    }
}

fn not_finite(json: &str) -> Option<f64> {
    match json {
        "\"NaN\"" | "null" => Some(f64::NAN),
        "\"Infinity\"" => Some(f64::INFINITY),
        "\"-Infinity\"" => Some(f64::NEG_INFINITY),
        _ => None,
    }
}

fn number<T: FromStr + Copy>(json: &str, finite: fn(T) -> bool) -> Result<T, Box<Fault>> {
    if kind(json) != "a number" {
        return Err(other_kind("a number", kind(json)));
    }
    let value = json.parse().ok().filter(|value| finite(*value));
    value.ok_or_else(|| Fault::text(format!("{} is out of range", shortened(json))))
}

/// # Errors
/// If the JSON is no text, or has half a surrogate pair.
fn text(json: &str) -> Result<Cow<'_, str>, Box<Fault>> {
    let Some(inner) = json.strip_prefix('"').and_then(|rest| rest.strip_suffix('"')) else {
        return Err(other_kind("text", kind(json)));
    };
    if !inner.contains('\\') {
        return Ok(Cow::Borrowed(inner));
    }
    // Its escapes are valid, so nothing else can be wrong.
    let text = serde_json::from_str(json).map_err(|_| Fault::text("half of a surrogate pair"));
    text.map(Cow::Owned)
}

fn check_nul(text: &str) -> Done {
    if text.contains('\0') { Err(Fault::text("a NUL within the text")) } else { Ok(()) }
}

fn count_bytes(count: usize) -> [u8; 4] {
    u32::try_from(count).unwrap_or(u32::MAX).to_le_bytes()
}

/// Its bytes and a NUL.
///
/// # Errors
/// If the text has a NUL.
pub(super) fn write_text(cdr: &mut Writer<'_>, text: &str) -> Done {
    check_nul(text)?;
    cdr.scalar(count_bytes(text.len() + 1));
    cdr.bytes(text.as_bytes());
    cdr.bytes(&[0]);
    Ok(())
}

/// One UTF-16 unit in four bytes each, without NUL.
fn write_wide(cdr: &mut Writer<'_>, text: &str, most: usize) -> Done {
    check_nul(text)?;
    let count = text.encode_utf16().count();
    check_length(count, most, "UTF-16 units")?;
    cdr.room(count.saturating_mul(4))?;
    cdr.scalar(count_bytes(count));
    for unit in text.encode_utf16() {
        cdr.scalar(u32::from(unit).to_le_bytes());
    }
    Ok(())
}

/// Writes the bytes of a base64 text. Returns their number.
///
/// # Errors
/// If the JSON is no such text, or has more bytes than `most`.
pub(super) fn write_base64(
    cdr: &mut Writer<'_>,
    json: &str,
    most: usize,
) -> Result<usize, Box<Fault>> {
    if kind(json) != "text" {
        return Err(other_kind("base64 or an array", kind(json)));
    }
    let text = text(json)?;
    let room = base64::decoded_len_estimate(text.len());
    let written = BASE64.decode_slice(text.as_bytes(), cdr.zeros(room));
    let written = written.map_err(|error| match error {
        DecodeSliceError::DecodeError(error) => Fault::text(format!("not base64: {error}")),
        DecodeSliceError::OutputSliceTooSmall => Fault::too_large(),
    })?;
    cdr.take_back(room - written);
    check_length(written, most, "elements")?;
    Ok(written)
}
