//! Makes a program of a description.

use std::collections::HashMap;

use super::{Arity, FieldOp, Item, MessageOp, Program, from_json};
use crate::description::{DescriptionError, Field, IndividualType, TypeDescription};
use crate::kinds::{Base, Shape};
use crate::limits::{MAX_MESSAGE_BYTES, MAX_NESTING};
use crate::literal;

/// Why a type cannot be converted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CompileError {
    /// Names or sizes are not those of a description.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// A field is of a kind that is not read.
    #[error("{field}: type {type_id} is not supported")]
    Unsupported {
        /// Type and field.
        field: String,
        /// Number of the kind.
        type_id: u8,
    },
    /// An array without elements, or a bound of 0.
    #[error("{0}: expected a size above 0")]
    Size(String),
    /// A field is of a type that the description does not have.
    #[error("{field}: {type_name} is not in the description")]
    Missing {
        /// Type and field.
        field: String,
        /// The type that is missing.
        type_name: String,
    },
    /// A type has itself as a part.
    #[error("{0} contains itself")]
    Recursive(String),
    /// Values would be nested too deeply.
    #[error("{0} is nested deeper than {MAX_NESTING}")]
    TooDeep(String),
    /// No value fits into a message.
    #[error("{0} has no value of at most {MAX_MESSAGE_BYTES} bytes")]
    TooLarge(String),
    /// A default is not a value of its field.
    #[error("{field}: default {default:?}: {fault}")]
    Default {
        /// Type and field.
        field: String,
        /// As the definition has it.
        default: String,
        /// The reason.
        fault: String,
    },
}

/// # Errors
/// As [`Program::compile`].
pub(super) fn compile(description: &TypeDescription) -> Result<Program, CompileError> {
    description.check()?;
    let mut numbers = HashMap::new();
    let mut types = Vec::new();
    for ty in description.types() {
        numbers.entry(ty.type_name.as_str()).or_insert_with(|| {
            types.push(ty);
            types.len() - 1
        });
    }
    let mut program = Program { messages: Vec::new(), fields: Vec::new() };
    for ty in &types {
        add_message(&mut program, ty, &numbers)?;
    }
    let mut sizes = Sizes { program: &program, types: &types, known: vec![None; types.len()] };
    for number in 0..types.len() {
        sizes.of(number, &mut Vec::new())?;
    }
    add_defaults(&mut program, &types)?;
    Ok(program)
}

fn add_message(
    program: &mut Program,
    ty: &IndividualType,
    numbers: &HashMap<&str, usize>,
) -> Result<(), CompileError> {
    let first = program.fields.len();
    if !ty.is_empty() {
        for field in &ty.fields {
            program.fields.push(field_op(ty, field, numbers)?);
        }
    }
    let fields = program.fields.get(first..).unwrap_or_default();
    let mut by_name: Vec<u32> = (0u32..).take(fields.len()).collect();
    by_name.sort_by_key(|at| fields.get(*at as usize).map(|field| &field.name));
    program.messages.push(MessageOp {
        fields: first..program.fields.len(),
        by_name: by_name.into_boxed_slice(),
    });
    Ok(())
}

fn place(ty: &IndividualType, field: &Field) -> String {
    format!("{}/{}", ty.type_name, field.name)
}

fn field_op(
    ty: &IndividualType,
    field: &Field,
    numbers: &HashMap<&str, usize>,
) -> Result<FieldOp, CompileError> {
    let unsupported =
        || CompileError::Unsupported { field: place(ty, field), type_id: field.ty.type_id };
    let base = field.ty.base().ok_or_else(unsupported)?;
    let shape = field.ty.shape().ok_or_else(unsupported)?;
    let arity = match shape {
        Shape::Single => Arity::Single,
        Shape::Array(0) | Shape::Bounded(0) => return Err(CompileError::Size(place(ty, field))),
        Shape::Array(size) => Arity::Array(bound(size)),
        Shape::Bounded(size) => Arity::Sequence(bound(size)),
        Shape::Unbounded => Arity::Sequence(usize::MAX),
    };
    Ok(FieldOp {
        name: field.name.as_str().into(),
        key: format!("\"{}\":", field.name).into(),
        item: item(ty, field, base, numbers)?,
        arity,
        default: None,
    })
}

fn bound(size: u64) -> usize {
    usize::try_from(size).unwrap_or(usize::MAX)
}

fn item(
    ty: &IndividualType,
    field: &Field,
    base: Base,
    numbers: &HashMap<&str, usize>,
) -> Result<Item, CompileError> {
    let most = bound(field.ty.string_capacity);
    Ok(match base {
        Base::Bool => Item::Bool,
        Base::UInt8 | Base::Byte | Base::Char => Item::Byte,
        Base::Int8 => Item::Int8,
        Base::Int16 => Item::Int16,
        Base::UInt16 => Item::UInt16,
        Base::Int32 => Item::Int32,
        Base::UInt32 => Item::UInt32,
        Base::Int64 => Item::Int64,
        Base::UInt64 => Item::UInt64,
        Base::Float32 => Item::Float32,
        Base::Float64 => Item::Float64,
        Base::String => Item::Text(usize::MAX),
        Base::WString => Item::Wide(usize::MAX),
        Base::BoundedString | Base::BoundedWString if most == 0 => {
            return Err(CompileError::Size(place(ty, field)));
        }
        Base::BoundedString => Item::Text(most),
        Base::BoundedWString => Item::Wide(most),
        Base::Nested => {
            let type_name = &field.ty.nested_type_name;
            let number = numbers.get(type_name.as_str()).ok_or_else(|| CompileError::Missing {
                field: place(ty, field),
                type_name: type_name.clone(),
            })?;
            Item::Message(*number)
        }
    })
}

/// Depth and least bytes of messages, each found once.
struct Sizes<'a> {
    program: &'a Program,
    types: &'a [&'a IndividualType],
    known: Vec<Option<(usize, usize)>>,
}

impl Sizes<'_> {
    /// `above`: the messages that this one is in.
    fn of(
        &mut self,
        number: usize,
        above: &mut Vec<usize>,
    ) -> Result<(usize, usize), CompileError> {
        if let Some(Some(known)) = self.known.get(number) {
            return Ok(*known);
        }
        let name = || self.types.get(number).map_or_else(String::new, |ty| ty.type_name.clone());
        if above.contains(&number) {
            return Err(CompileError::Recursive(name()));
        }
        if above.len() >= MAX_NESTING {
            return Err(self.too_deep());
        }
        above.push(number);
        // A message without fields has one byte.
        let (mut depth, mut least) = (1, usize::from(self.program.fields_of(number).is_empty()));
        for field in self.program.fields_of(number) {
            let (below, bytes) = self.of_field(field, above)?;
            depth = depth.max(1 + below);
            least = bytes.saturating_add(least);
        }
        above.pop();
        if depth > MAX_NESTING {
            return Err(self.too_deep());
        }
        if least > MAX_MESSAGE_BYTES {
            return Err(CompileError::TooLarge(name()));
        }
        if let Some(known) = self.known.get_mut(number) {
            *known = Some((depth, least));
        }
        Ok((depth, least))
    }

    fn too_deep(&self) -> CompileError {
        let root = self.types.first().map(|ty| ty.type_name.clone());
        CompileError::TooDeep(root.unwrap_or_default())
    }

    fn of_field(
        &mut self,
        field: &FieldOp,
        above: &mut Vec<usize>,
    ) -> Result<(usize, usize), CompileError> {
        let (depth, least) = match field.item {
            Item::Bool | Item::Byte | Item::Int8 => (0, 1),
            Item::Int16 | Item::UInt16 => (0, 2),
            Item::Int32 | Item::UInt32 | Item::Float32 | Item::Text(_) | Item::Wide(_) => (0, 4),
            Item::Int64 | Item::UInt64 | Item::Float64 => (0, 8),
            Item::Message(number) => self.of(number, above)?,
        };
        Ok(match field.arity {
            Arity::Single => (depth, least),
            Arity::Array(size) => (depth + 1, least.saturating_mul(size)),
            Arity::Sequence(_) => (depth + 1, 4),
        })
    }
}

fn add_defaults(program: &mut Program, types: &[&IndividualType]) -> Result<(), CompileError> {
    let declared = types.iter().filter(|ty| !ty.is_empty());
    let declared = declared.flat_map(|ty| ty.fields.iter().map(move |field| (*ty, field)));
    let mut defaults = Vec::new();
    for (op, (ty, field)) in program.fields.iter().zip(declared) {
        let json = if field.default_value.is_empty() { None } else { Some(default(ty, field)?) };
        if let Some(json) = &json {
            from_json::check_default(program, op, json)
                .map_err(|fault| faulty(ty, field, fault.to_string()))?;
        }
        defaults.push(json.map(String::into_boxed_str));
    }
    for (op, default) in program.fields.iter_mut().zip(defaults) {
        op.default = default;
    }
    Ok(())
}

fn default(ty: &IndividualType, field: &Field) -> Result<String, CompileError> {
    let (base, shape) = field.ty.base().zip(field.ty.shape()).unzip();
    let base = base.unwrap_or(Base::Nested);
    let shape = shape.unwrap_or(Shape::Single);
    literal::to_json(&field.default_value, base, shape)
        .map_err(|fault| faulty(ty, field, fault.to_owned()))
}

fn faulty(ty: &IndividualType, field: &Field, fault: String) -> CompileError {
    CompileError::Default { field: place(ty, field), default: field.default_value.clone(), fault }
}
