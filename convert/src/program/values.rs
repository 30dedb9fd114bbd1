//! Random values of any type, for tests.

use super::cdr::{ENCAPSULATION, Writer};
use super::{Arity, Item, Program, scalar};

/// The source of the values: bytes, and then zeros, so every value ends.
pub(super) struct Entropy<'a>(pub(super) &'a [u8]);

impl Entropy<'_> {
    fn bytes<const N: usize>(&mut self) -> [u8; N] {
        let mut taken = [0; N];
        let count = N.min(self.0.len());
        let (now, later) = self.0.split_at(count);
        taken[..count].copy_from_slice(now);
        self.0 = later;
        taken
    }

    fn below(&mut self, end: usize) -> usize {
        usize::from(u8::from_le_bytes(self.bytes())) % end.max(1)
    }

    /// One character in three is not ASCII.
    fn character(&mut self) -> char {
        let wide = self.below(3) == 0;
        let number = u32::from_le_bytes(self.bytes()) % if wide { 0x11_0000 } else { 0x80 };
        char::from_u32(number).filter(|c| *c != '\0').unwrap_or('\u{fffd}')
    }

    /// A text of at most so many units, which `len` counts.
    fn text(&mut self, most: usize, len: fn(char) -> usize) -> String {
        let mut text = String::new();
        let mut size = 0;
        for _ in 0..self.below(12) {
            let character = self.character();
            size += len(character);
            if size > most {
                break;
            }
            text.push(character);
        }
        text
    }
}

/// CDR of a random value, with zeros as padding and one NaN for all.
pub(super) fn cdr(program: &Program, entropy: &mut Entropy<'_>) -> Vec<u8> {
    let mut out = ENCAPSULATION.to_vec();
    let mut maker = Maker { program, cdr: Writer::new(&mut out), entropy };
    maker.message(0, 0);
    out
}

struct Maker<'a, 'o, 'e> {
    program: &'a Program,
    cdr: Writer<'o>,
    entropy: &'a mut Entropy<'e>,
}

impl Maker<'_, '_, '_> {
    fn message(&mut self, number: usize, depth: usize) {
        let fields = self.program.fields_of(number);
        if fields.is_empty() {
            self.cdr.scalar([0]);
        }
        for field in fields {
            let count = match field.arity {
                Arity::Single => 1,
                Arity::Array(size) => size,
                Arity::Sequence(most) => {
                    let count = self.entropy.below(if depth < 3 { 5 } else { 2 }).min(most);
                    self.cdr.scalar((count as u32).to_le_bytes());
                    count
                }
            };
            for _ in 0..count {
                self.value(field.item, depth);
            }
        }
    }

    fn value(&mut self, item: Item, depth: usize) {
        match item {
            Item::Bool => self.cdr.scalar([self.entropy.bytes::<1>()[0] & 1]),
            Item::Byte | Item::Int8 => self.cdr.scalar(self.entropy.bytes::<1>()),
            Item::Int16 | Item::UInt16 => self.cdr.scalar(self.entropy.bytes::<2>()),
            Item::Int32 | Item::UInt32 => self.cdr.scalar(self.entropy.bytes::<4>()),
            Item::Int64 | Item::UInt64 => self.cdr.scalar(self.entropy.bytes::<8>()),
            Item::Float32 => {
                let value = f32::from_le_bytes(self.entropy.bytes());
                self.cdr.scalar(if value.is_nan() { f32::NAN } else { value }.to_le_bytes());
            }
            Item::Float64 => {
                let value = f64::from_le_bytes(self.entropy.bytes());
                self.cdr.scalar(if value.is_nan() { f64::NAN } else { value }.to_le_bytes());
            }
            Item::Text(most) => {
                let text = self.entropy.text(most, char::len_utf8);
                scalar::write_text(&mut self.cdr, &text).expect("no NUL");
            }
            Item::Wide(most) => {
                let text = self.entropy.text(most, char::len_utf16);
                let units: Vec<u16> = text.encode_utf16().collect();
                self.cdr.scalar((units.len() as u32).to_le_bytes());
                for unit in units {
                    self.cdr.scalar(u32::from(unit).to_le_bytes());
                }
            }
            Item::Message(number) => self.message(number, depth + 1),
        }
    }
}
