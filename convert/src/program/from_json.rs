//! Writes CDR from JSON.
//!
//! Members in the order of the definition are written as they are read. A member that is ahead of
//! its turn is kept as text until then, so CDR is always written forwards.

use serde::Deserializer as _;
use serde::de::{DeserializeSeed, Error, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde_json::Deserializer;
use serde_json::value::RawValue;

use super::cdr::{Writer, check_length};
use super::error::{ConvertError, Fault};
use super::{Arity, FieldOp, Item, Program, scalar};
use crate::limits::MAX_MESSAGE_BYTES;

type Done = Result<(), Box<Fault>>;

/// Writes the message of which `json` is the text.
///
/// # Errors
/// As [`Program::to_cdr`].
pub(super) fn message(program: &Program, json: &[u8], cdr: Writer<'_>) -> Done {
    if json.len() > MAX_MESSAGE_BYTES {
        return Err(Fault::too_large());
    }
    let text = std::str::from_utf8(json).map_err(|error| Fault::text(error.to_string()))?;
    let mut encoder = Encoder { program, cdr, fault: None };
    encoder.parse(text, Item::Message(0), Arity::Single)?;
    // The last value may have been checked before it was written.
    encoder.cdr.room(0)
}

/// Whether the JSON is a value of the field.
///
/// # Errors
/// Says where it is not.
pub(super) fn check_default(
    program: &Program,
    field: &FieldOp,
    json: &str,
) -> Result<(), ConvertError> {
    let mut out = Vec::new();
    let mut encoder = Encoder { program, cdr: Writer::new(&mut out), fault: None };
    encoder.parse(json, field.item, field.arity).map_err(ConvertError::from)
}

struct Encoder<'a, 'o> {
    program: &'a Program,
    cdr: Writer<'o>,
    /// The fault, while the error of the parser returns through its callers.
    fault: Option<Box<Fault>>,
}

impl<'a> Encoder<'a, '_> {
    fn parse(&mut self, json: &str, item: Item, arity: Arity) -> Done {
        let mut parser = Deserializer::from_str(json);
        let done = Values { encoder: self, item, arity }.deserialize(&mut parser);
        done.and_then(|()| parser.end()).map_err(|error| self.take_fault(&error))
    }

    /// The fault of a value, else that of the text.
    fn take_fault(&mut self, error: &impl Error) -> Box<Fault> {
        self.fault.take().unwrap_or_else(|| Fault::text(error.to_string()))
    }

    /// Keeps the fault and returns an error that stops the parser.
    fn abort<E: Error>(&mut self, fault: Box<Fault>) -> E {
        self.fault = Some(fault);
        E::custom("")
    }

    fn abort_in_member<E: Error>(&mut self, field: &FieldOp, error: &E) -> E {
        let fault = self.take_fault(error).in_member(&field.name);
        self.abort(fault)
    }

    fn field(&self, message: usize, at: usize) -> Option<&'a FieldOp> {
        self.program.fields_of(message).get(at)
    }

    /// Writes the default of a missing member, or zeros.
    fn missing(&mut self, field: &FieldOp) -> Done {
        match &field.default {
            Some(json) => self.parse(json, field.item, field.arity),
            None => self.zeros(field.item, field.arity),
        }
        .map_err(|fault| fault.in_member(&field.name))
    }

    fn zeros(&mut self, item: Item, arity: Arity) -> Done {
        let count = match arity {
            Arity::Single => 1,
            Arity::Array(size) => size,
            Arity::Sequence(_) => {
                self.cdr.scalar([0; 4]);
                0
            }
        };
        self.cdr.room(count)?;
        if item == Item::Byte {
            self.cdr.zeros(count);
            return Ok(());
        }
        for _ in 0..count {
            self.zero(item)?;
            self.cdr.room(0)?;
        }
        Ok(())
    }

    fn zero(&mut self, item: Item) -> Done {
        match item {
            Item::Bool | Item::Byte | Item::Int8 => self.cdr.scalar([0; 1]),
            Item::Int16 | Item::UInt16 => self.cdr.scalar([0; 2]),
            Item::Int32 | Item::UInt32 | Item::Float32 | Item::Wide(_) => self.cdr.scalar([0; 4]),
            Item::Int64 | Item::UInt64 | Item::Float64 => self.cdr.scalar([0; 8]),
            Item::Text(_) => scalar::write_text(&mut self.cdr, "")?,
            Item::Message(number) => return self.missing_members(number, 0, &mut Vec::new()),
        }
        Ok(())
    }

    /// Writes the members from `next` on: pending ones, and defaults.
    fn missing_members(
        &mut self,
        message: usize,
        next: usize,
        pending: &mut [Option<&RawValue>],
    ) -> Done {
        let fields = self.program.fields_of(message);
        if fields.is_empty() {
            self.cdr.scalar([0; 1]);
        }
        for (at, field) in fields.iter().enumerate().skip(next) {
            match pending.get_mut(at).and_then(Option::take) {
                Some(json) => self.write_pending(field, json)?,
                None => self.missing(field)?,
            }
        }
        Ok(())
    }

    fn write_pending(&mut self, field: &FieldOp, json: &RawValue) -> Done {
        let done = self.parse(json.get(), field.item, field.arity);
        done.map_err(|fault| fault.in_member(&field.name))
    }

    /// One value that is no message and no list.
    fn scalar(&mut self, item: Item, arity: Arity, json: &str) -> Done {
        match arity {
            Arity::Single => scalar::write(&mut self.cdr, item, json)?,
            Arity::Array(size) => {
                let found = scalar::write_base64(&mut self.cdr, json, size)?;
                check_size(size, found)?;
            }
            Arity::Sequence(most) => {
                let place = self.cdr.count_later();
                let found = scalar::write_base64(&mut self.cdr, json, most)?;
                self.cdr.set_count(place, found);
            }
        }
        self.cdr.room(0)
    }
}

fn check_size(size: usize, found: usize) -> Done {
    if size != found {
        return Err(Fault::text(format!("expected {size} elements, found {found}")));
    }
    Ok(())
}

/// All values of a field.
struct Values<'w, 'a, 'o> {
    encoder: &'w mut Encoder<'a, 'o>,
    item: Item,
    arity: Arity,
}

impl<'de> DeserializeSeed<'de> for Values<'_, '_, '_> {
    type Value = ();

    fn deserialize<D: serde::Deserializer<'de>>(self, parser: D) -> Result<(), D::Error> {
        let Self { encoder, item, arity } = self;
        match (item, arity) {
            (Item::Message(number), Arity::Single) => {
                parser.deserialize_any(Members { encoder, message: number })
            }
            (item, arity) if arity == Arity::Single || item == Item::Byte => {
                let json: &RawValue = serde::Deserialize::deserialize(parser)?;
                // Bytes may also be written as numbers.
                if arity != Arity::Single && json.get().starts_with('[') {
                    let list = Elements { encoder, item, arity };
                    let read = Deserializer::from_str(json.get()).deserialize_any(list);
                    return read.map_err(D::Error::custom);
                }
                encoder.scalar(item, arity, json.get()).map_err(|fault| encoder.abort(fault))
            }
            (item, arity) => parser.deserialize_any(Elements { encoder, item, arity }),
        }
    }
}

/// The visits of values of another kind than the one that was expected.
macro_rules! other_kinds {
    ($expected:literal) => {
        fn expecting(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
            out.write_str($expected)
        }
        fn visit_bool<E: Error>(self, _: bool) -> Result<(), E> {
            Err(self.encoder.abort(scalar::other_kind($expected, "a bool")))
        }
        fn visit_i64<E: Error>(self, _: i64) -> Result<(), E> {
            Err(self.encoder.abort(scalar::other_kind($expected, "a number")))
        }
        fn visit_u64<E: Error>(self, _: u64) -> Result<(), E> {
            Err(self.encoder.abort(scalar::other_kind($expected, "a number")))
        }
        fn visit_f64<E: Error>(self, _: f64) -> Result<(), E> {
            Err(self.encoder.abort(scalar::other_kind($expected, "a number")))
        }
        fn visit_str<E: Error>(self, _: &str) -> Result<(), E> {
            Err(self.encoder.abort(scalar::other_kind($expected, "text")))
        }
        fn visit_unit<E: Error>(self) -> Result<(), E> {
            Err(self.encoder.abort(scalar::other_kind($expected, "null")))
        }
    };
}

/// A list.
struct Elements<'w, 'a, 'o> {
    encoder: &'w mut Encoder<'a, 'o>,
    item: Item,
    arity: Arity,
}

impl<'de> Visitor<'de> for Elements<'_, '_, '_> {
    type Value = ();

    other_kinds!("an array");

    fn visit_map<A: MapAccess<'de>>(self, _: A) -> Result<(), A::Error> {
        Err(self.encoder.abort(scalar::other_kind("an array", "an object")))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<(), A::Error> {
        let Self { encoder, item, arity } = self;
        let (place, most) = match arity {
            Arity::Single => (None, 1),
            Arity::Array(size) => (None, size),
            Arity::Sequence(most) => (Some(encoder.cdr.count_later()), most),
        };
        let mut count = 0;
        while count < most {
            let next = Values { encoder: &mut *encoder, item, arity: Arity::Single };
            match list.next_element_seed(next) {
                Ok(Some(())) => count += 1,
                Ok(None) => break,
                Err(error) => {
                    let fault = encoder.take_fault(&error).in_element(count);
                    return Err(encoder.abort(fault));
                }
            }
        }
        let mut found = count;
        while found >= most && list.next_element::<IgnoredAny>()?.is_some() {
            found += 1;
        }
        if let Some(place) = place {
            encoder.cdr.set_count(place, count);
            return check_length(found, most, "elements").map_err(|fault| encoder.abort(fault));
        }
        check_size(most, found).map_err(|fault| encoder.abort(fault))
    }
}

/// An object.
struct Members<'w, 'a, 'o> {
    encoder: &'w mut Encoder<'a, 'o>,
    message: usize,
}

impl<'de> Visitor<'de> for Members<'_, '_, '_> {
    type Value = ();

    other_kinds!("an object");

    fn visit_seq<A: SeqAccess<'de>>(self, _: A) -> Result<(), A::Error> {
        Err(self.encoder.abort(scalar::other_kind("an object", "an array")))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<(), A::Error> {
        let Self { encoder, message } = self;
        let mut next = 0;
        let mut pending: Vec<Option<&'de RawValue>> = Vec::new();
        loop {
            let name = Name { encoder: &mut *encoder, message, next, pending: &pending };
            let Some(at) = members.next_key_seed(name)? else { break };
            let Some(field) = encoder.field(message, at) else { break };
            if at != next {
                pending.resize(encoder.program.fields_of(message).len(), None);
                let json =
                    members.next_value().map_err(|error| encoder.abort_in_member(field, &error))?;
                if let Some(kept) = pending.get_mut(at) {
                    *kept = Some(json);
                }
                continue;
            }
            let value = Values { encoder: &mut *encoder, item: field.item, arity: field.arity };
            members
                .next_value_seed(value)
                .map_err(|error| encoder.abort_in_member(field, &error))?;
            next += 1;
            while let Some(json) = pending.get_mut(next).and_then(Option::take) {
                let Some(field) = encoder.field(message, next) else { break };
                encoder.write_pending(field, json).map_err(|fault| encoder.abort(fault))?;
                next += 1;
            }
        }
        encoder.missing_members(message, next, &mut pending).map_err(|fault| encoder.abort(fault))
    }
}

/// The name of a member: which field it is.
struct Name<'w, 'a, 'o, 'e> {
    encoder: &'w mut Encoder<'a, 'o>,
    message: usize,
    /// The next field to be written.
    next: usize,
    pending: &'e [Option<&'e RawValue>],
}

impl Name<'_, '_, '_, '_> {
    fn place(&self, name: &str) -> Option<usize> {
        let fields = self.encoder.program.fields_of(self.message);
        if fields.get(self.next).is_some_and(|field| *field.name == *name) {
            return Some(self.next);
        }
        let by_name = &self.encoder.program.message(self.message)?.by_name;
        let name_at = |at: &u32| fields.get(*at as usize).map(|field| &*field.name);
        let found = by_name.binary_search_by(|at| name_at(at).cmp(&Some(name))).ok()?;
        by_name.get(found).map(|at| *at as usize)
    }
}

impl<'de> DeserializeSeed<'de> for Name<'_, '_, '_, '_> {
    type Value = usize;

    fn deserialize<D: serde::Deserializer<'de>>(self, parser: D) -> Result<usize, D::Error> {
        parser.deserialize_str(self)
    }
}

impl Visitor<'_> for Name<'_, '_, '_, '_> {
    type Value = usize;

    fn expecting(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.write_str("a name")
    }

    fn visit_str<E: Error>(self, name: &str) -> Result<usize, E> {
        let fault = match self.place(name) {
            None => "no such member",
            Some(at) if at < self.next || self.pending.get(at).is_some_and(Option::is_some) => {
                "the member is there twice"
            }
            Some(at) => return Ok(at),
        };
        Err(self.encoder.abort(Fault::text(fault).in_member(name)))
    }
}
