//! Short words for schemas, over the builders of utoipa.

use serde_json::Value;
use utoipa::openapi::schema::{
    AdditionalProperties, ArrayBuilder, Object, ObjectBuilder, OneOfBuilder, SchemaType, Type,
};
use utoipa::openapi::{KnownFormat, Ref, RefOr, Schema, SchemaFormat};

/// A schema, or a reference to one.
pub(super) type Shape = RefOr<Schema>;

/// A schema of the components.
pub(super) fn refer(name: &str) -> Shape {
    Ref::from_schema_name(name).into()
}

/// What a schema is for.
pub(super) fn said(shape: ObjectBuilder, description: &str) -> Shape {
    shape.description(Some(description)).into()
}

/// Any value.
pub(super) fn anything(description: &str) -> Shape {
    said(ObjectBuilder::new().schema_type(SchemaType::any()), description)
}

/// Text.
pub(super) fn text() -> ObjectBuilder {
    ObjectBuilder::new().schema_type(Type::String)
}

/// Text of a form.
pub(super) fn formed(pattern: &str, least: usize, most: usize) -> ObjectBuilder {
    text()
        .pattern(Some(pattern))
        .min_length(Some(least))
        .max_length(Some(most))
}

/// One of some words.
pub(super) fn word<'a>(words: impl IntoIterator<Item = &'a str>) -> ObjectBuilder {
    text().enum_values(Some(words))
}

/// A time, as RFC 3339 has it.
pub(super) fn time() -> ObjectBuilder {
    text().format(Some(SchemaFormat::KnownFormat(KnownFormat::DateTime)))
}

/// A whole number within bounds.
pub(super) fn whole(least: i64, most: i64) -> ObjectBuilder {
    ObjectBuilder::new()
        .schema_type(Type::Integer)
        .format(Some(SchemaFormat::KnownFormat(KnownFormat::Int64)))
        .minimum(Some(least))
        .maximum(Some(most))
}

/// `true` or `false`.
pub(super) fn flag() -> ObjectBuilder {
    ObjectBuilder::new().schema_type(Type::Boolean)
}

/// The same, or `null`.
pub(super) fn or_null(shape: ObjectBuilder) -> ObjectBuilder {
    let object: Object = shape.build();
    let schema_type = match object.schema_type.clone() {
        SchemaType::Type(own) => SchemaType::from_iter([own, Type::Null]),
        SchemaType::Array(own) => SchemaType::from_iter(own.into_iter().chain([Type::Null])),
        SchemaType::AnyValue => SchemaType::AnyValue,
    };
    ObjectBuilder::from(object).schema_type(schema_type)
}

/// A schema of the components, or `null`.
pub(super) fn refer_or_null(name: &str, description: &str) -> Shape {
    OneOfBuilder::new()
        .item(refer(name))
        .item(ObjectBuilder::new().schema_type(Type::Null))
        .description(Some(description))
        .into()
}

/// A list.
pub(super) fn list(of: impl Into<Shape>) -> ArrayBuilder {
    ArrayBuilder::new().items(of.into())
}

/// An object with free names.
pub(super) fn map(of: impl Into<Shape>) -> ObjectBuilder {
    let of: Shape = of.into();
    ObjectBuilder::new()
        .schema_type(Type::Object)
        .additional_properties(Some(AdditionalProperties::RefOr(of)))
}

/// An object whose members are anything.
pub(super) fn free() -> ObjectBuilder {
    ObjectBuilder::new()
        .schema_type(Type::Object)
        .additional_properties(Some(AdditionalProperties::<Schema>::FreeForm(true)))
}

/// An object of an answer: later versions may add members.
pub(super) fn answer<const N: usize>(required: &[&str], members: [(&str, Shape); N]) -> ObjectBuilder {
    let object = ObjectBuilder::new().schema_type(Type::Object);
    let object = members
        .into_iter()
        .fold(object, |object, (name, shape)| object.property(name, shape));
    required.iter().fold(object, |object, name| object.required(*name))
}

/// An object of a request: no other members.
pub(super) fn closed<const N: usize>(required: &[&str], members: [(&str, Shape); N]) -> ObjectBuilder {
    answer(required, members).additional_properties(Some(AdditionalProperties::<Schema>::FreeForm(false)))
}

/// With an example.
pub(super) fn like(shape: ObjectBuilder, example: Value) -> ObjectBuilder {
    shape.examples([example])
}
