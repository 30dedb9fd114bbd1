//! Writes JSON from CDR.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::ser::{CompactFormatter, Formatter};

use super::cdr::{Reader, check_length};
use super::error::Fault;
use super::{Arity, Item, Program};
use crate::limits::MAX_MESSAGE_BYTES;

type Done = Result<(), Box<Fault>>;

/// Appends the JSON of the message that is read.
///
/// # Errors
/// As [`Program::to_json`].
pub(super) fn message(program: &Program, cdr: Reader<'_>, out: &mut Vec<u8>) -> Done {
    let mut decoder = Decoder { program, cdr, start: out.len(), out };
    decoder.message(0)?;
    decoder.cdr.end()
}

struct Decoder<'a, 'o> {
    program: &'a Program,
    cdr: Reader<'a>,
    out: &'o mut Vec<u8>,
    start: usize,
}

impl Decoder<'_, '_> {
    fn message(&mut self, number: usize) -> Done {
        let program = self.program;
        let fields = program.fields_of(number);
        if fields.is_empty() {
            self.cdr.skip_empty();
        }
        self.out.push(b'{');
        for (index, field) in fields.iter().enumerate() {
            self.separate(index);
            self.out.extend_from_slice(field.key.as_bytes());
            self.values(field.item, field.arity).map_err(|fault| fault.in_member(&field.name))?;
        }
        self.out.push(b'}');
        Ok(())
    }

    fn separate(&mut self, index: usize) {
        if index > 0 {
            self.out.push(b',');
        }
    }

    fn check_size(&self, more: usize) -> Done {
        let size = (self.out.len() - self.start).saturating_add(more);
        if size > MAX_MESSAGE_BYTES { Err(Fault::too_large()) } else { Ok(()) }
    }

    fn values(&mut self, item: Item, arity: Arity) -> Done {
        let count = match arity {
            Arity::Single => return self.value(item),
            Arity::Array(size) => size,
            Arity::Sequence(most) => self.cdr.count(most, 1)?,
        };
        match item {
            Item::Byte => return self.base64(count),
            Item::Int64 | Item::UInt64 | Item::Float64 if count == 0 => self.cdr.reserved(),
            _ => {}
        }
        self.out.push(b'[');
        for index in 0..count {
            self.separate(index);
            self.value(item).map_err(|fault| fault.in_element(index))?;
        }
        self.out.push(b']');
        Ok(())
    }

    fn base64(&mut self, count: usize) -> Done {
        let bytes = self.cdr.bytes(count)?;
        let size = count.div_ceil(3) * 4;
        self.check_size(size)?;
        self.out.push(b'"');
        let at = self.out.len();
        self.out.resize(at + size, 0);
        let place = self.out.get_mut(at..).unwrap_or_default();
        STANDARD.encode_slice(bytes, place).map_err(|error| Fault::text(error.to_string()))?;
        self.out.push(b'"');
        Ok(())
    }

    fn value(&mut self, item: Item) -> Done {
        match item {
            Item::Bool => self.bool()?,
            Item::Byte => self.integer(u8::from_le_bytes)?,
            Item::Int8 => self.integer(i8::from_le_bytes)?,
            Item::Int16 => self.integer(i16::from_le_bytes)?,
            Item::UInt16 => self.integer(u16::from_le_bytes)?,
            Item::Int32 => self.integer(i32::from_le_bytes)?,
            Item::UInt32 => self.integer(u32::from_le_bytes)?,
            Item::Int64 => self.integer(i64::from_le_bytes)?,
            Item::UInt64 => {
                let value = u64::from_le_bytes(self.cdr.scalar()?);
                let _ = CompactFormatter.write_u64(self.out, value);
            }
            Item::Float32 => self.float32()?,
            Item::Float64 => self.float64()?,
            Item::Text(most) => self.text(most)?,
            Item::Wide(most) => self.wide(most)?,
            Item::Message(number) => self.message(number)?,
        }
        self.check_size(0)
    }

    fn bool(&mut self) -> Done {
        let [byte] = self.cdr.scalar()?;
        let text: &[u8] = match byte {
            0 => b"false",
            1 => b"true",
            other => return Err(Fault::text(format!("expected a bool (0 or 1), found {other}"))),
        };
        self.out.extend_from_slice(text);
        Ok(())
    }

    /// Writing into memory does not fail.
    fn integer<const N: usize, T: Into<i64>>(&mut self, read: impl Fn([u8; N]) -> T) -> Done {
        let value = read(self.cdr.scalar()?).into();
        let _ = CompactFormatter.write_i64(self.out, value);
        Ok(())
    }

    fn float32(&mut self) -> Done {
        let value = f32::from_le_bytes(self.cdr.scalar()?);
        if value.is_finite() {
            let _ = CompactFormatter.write_f32(self.out, value);
        } else {
            self.not_finite(f64::from(value));
        }
        Ok(())
    }

    fn float64(&mut self) -> Done {
        let value = f64::from_le_bytes(self.cdr.scalar()?);
        if value.is_finite() {
            let _ = CompactFormatter.write_f64(self.out, value);
        } else {
            self.not_finite(value);
        }
        Ok(())
    }

    fn not_finite(&mut self, value: f64) {
        let text = match value {
            f64::INFINITY => "\"Infinity\"",
            f64::NEG_INFINITY => "\"-Infinity\"",
            _ => "\"NaN\"",
        };
        self.out.extend_from_slice(text.as_bytes());
    }

    /// Some writers send an empty text as no bytes, without the NUL that ends it.
    fn text(&mut self, most: usize) -> Done {
        let count = self.cdr.count(usize::MAX, 1)?;
        let bytes = self.cdr.bytes(count)?;
        let text = match bytes.split_last() {
            None => bytes,
            Some((0, text)) => text,
            Some(_) => return Err(Fault::text("expected a text that ends with NUL")),
        };
        if text.contains(&0) {
            return Err(Fault::text("a NUL within the text"));
        }
        check_length(text.len(), most, "bytes")?;
        self.quoted(&String::from_utf8_lossy(text));
        Ok(())
    }

    fn quoted(&mut self, text: &str) {
        let _ = serde_json::to_writer(&mut *self.out, text);
    }

    /// One UTF-16 unit in four bytes each, without NUL; half of a pair becomes U+FFFD.
    fn wide(&mut self, most: usize) -> Done {
        let count = self.cdr.count(usize::MAX, 4)?;
        check_length(count, most, "UTF-16 units")?;
        let mut units = Vec::with_capacity(count);
        for _ in 0..count {
            let unit = u32::from_le_bytes(self.cdr.scalar()?);
            match u16::try_from(unit) {
                Ok(0) => return Err(Fault::text("a NUL within the text")),
                Ok(unit) => units.push(unit),
                Err(_) => return Err(Fault::text(format!("{unit:#x} is not a UTF-16 unit"))),
            }
        }
        self.cdr.reserved();
        self.quoted(&String::from_utf16_lossy(&units));
        Ok(())
    }
}
