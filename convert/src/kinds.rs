//! The numbers of `type_description_interfaces/msg/FieldType` and their meaning.

use crate::description::FieldType;

/// Type of a field, or of one element of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Base {
    /// Another type, by its name.
    Nested = 1,
    /// `int8`
    Int8 = 2,
    /// `uint8`, and `char` of message files
    UInt8 = 3,
    /// `int16`
    Int16 = 4,
    /// `uint16`
    UInt16 = 5,
    /// `int32`
    Int32 = 6,
    /// `uint32`
    UInt32 = 7,
    /// `int64`
    Int64 = 8,
    /// `uint64`
    UInt64 = 9,
    /// `float32`
    Float32 = 10,
    /// `float64`
    Float64 = 11,
    /// `char` of IDL files
    Char = 13,
    /// `bool`
    Bool = 15,
    /// `byte`
    Byte = 16,
    /// `string`
    String = 17,
    /// `wstring`
    WString = 18,
    /// `string<=N`
    BoundedString = 21,
    /// `wstring<=N`
    BoundedWString = 22,
}

/// All supported types and their names in message files, which have no `long double`, `wchar` or
/// strings of fixed length. A bounded string has its name and its bound; a nested type has none.
const NAMES: &[(Base, &str)] = &[
    (Base::Nested, ""),
    (Base::Bool, "bool"),
    (Base::Byte, "byte"),
    (Base::Int8, "int8"),
    (Base::UInt8, "uint8"),
    // In message files it is `uint8`, in IDL files a type of its own.
    (Base::UInt8, "char"),
    (Base::Char, "char"),
    (Base::Int16, "int16"),
    (Base::UInt16, "uint16"),
    (Base::Int32, "int32"),
    (Base::UInt32, "uint32"),
    (Base::Int64, "int64"),
    (Base::UInt64, "uint64"),
    (Base::Float32, "float32"),
    (Base::Float64, "float64"),
    (Base::String, "string"),
    (Base::WString, "wstring"),
    (Base::BoundedString, "string"),
    (Base::BoundedWString, "wstring"),
];

impl Base {
    /// The type that message files call so.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        let found = NAMES.iter().find(|(_, known)| *known == name && !name.is_empty());
        found.map(|(base, _)| *base)
    }

    /// Its name in message files, without a bound; empty for a nested type.
    #[must_use]
    pub fn name(self) -> &'static str {
        NAMES.iter().find(|(base, _)| *base == self).map_or("", |(_, name)| name)
    }
}

/// Number of values of a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// One.
    Single,
    /// `[N]`: always as many.
    Array(u64),
    /// `[<=N]`: at most as many.
    Bounded(u64),
    /// `[]`
    Unbounded,
}

/// Distance between the numbers of one shape and those of the next.
const STEP: u8 = 48;

impl Shape {
    fn number(self) -> (u8, u64) {
        match self {
            Self::Single => (0, 0),
            Self::Array(size) => (1, size),
            Self::Bounded(size) => (2, size),
            Self::Unbounded => (3, 0),
        }
    }
}

impl FieldType {
    /// A type of values that are not nested. `bound` is that of a string, 0 for none.
    #[must_use]
    pub fn plain(base: Base, shape: Shape, bound: u64) -> Self {
        let base = match (base, bound) {
            (Base::String, 1..) => Base::BoundedString,
            (Base::WString, 1..) => Base::BoundedWString,
            (base, _) => base,
        };
        let (step, capacity) = shape.number();
        Self {
            type_id: base as u8 + step * STEP,
            capacity,
            string_capacity: bound,
            nested_type_name: String::new(),
        }
    }

    /// Values of another type.
    #[must_use]
    pub fn nested(name: impl Into<String>, shape: Shape) -> Self {
        Self { nested_type_name: name.into(), ..Self::plain(Base::Nested, shape, 0) }
    }

    /// Type of the value, or of one element. `None` for a number of no supported type.
    #[must_use]
    pub fn base(&self) -> Option<Base> {
        let number = self.type_id % STEP;
        NAMES.iter().map(|(base, _)| *base).find(|base| *base as u8 == number)
    }

    /// Number of values. `None` for a number of no supported type.
    #[must_use]
    pub fn shape(&self) -> Option<Shape> {
        match self.type_id / STEP {
            0 => Some(Shape::Single),
            1 => Some(Shape::Array(self.capacity)),
            2 => Some(Shape::Bounded(self.capacity)),
            3 => Some(Shape::Unbounded),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_those_of_the_type_descriptions() {
        assert_eq!(FieldType::plain(Base::Int32, Shape::Unbounded, 0).type_id, 150);
        assert_eq!(FieldType::plain(Base::UInt8, Shape::Array(16), 0).type_id, 51);
        assert_eq!(FieldType::nested("a/msg/B", Shape::Bounded(1)).type_id, 97);
        let bounded = FieldType::plain(Base::String, Shape::Single, 22);
        assert_eq!((bounded.type_id, bounded.string_capacity), (21, 22));
    }

    #[test]
    fn what_is_not_read_has_no_base() {
        for type_id in [0, 12, 14, 19, 20, 23, 47, 48, 255] {
            let unknown = FieldType { type_id, ..FieldType::plain(Base::Bool, Shape::Single, 0) };
            assert!(unknown.base().is_none() || unknown.shape().is_none(), "{type_id}");
        }
    }
}
