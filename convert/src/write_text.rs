//! A description as the text of message files, the parts joined as MCAP joins them.

use std::fmt::Write;

use crate::description::{Field, FieldType, IndividualType, TypeDescription};
use crate::kinds::{Base, Shape};
use crate::literal;

/// The definition of a message as text: its own lines, and after a line of `=` and `MSG: pkg/Name`
/// those of each type that it refers to. [`parse_joined`](crate::parse_joined) reads it.
#[must_use]
pub fn definition_text(description: &TypeDescription) -> String {
    let mut text = String::new();
    write_type(&mut text, &description.type_description);
    for ty in &description.referenced_type_descriptions {
        let _ = writeln!(text, "{}\nMSG: {}", "=".repeat(80), short_name(&ty.type_name));
        write_type(&mut text, ty);
    }
    text
}

/// `geometry_msgs/msg/Point` as `geometry_msgs/Point`; types of services and actions in full.
fn short_name(name: &str) -> String {
    name.replacen("/msg/", "/", 1)
}

fn write_type(text: &mut String, ty: &IndividualType) {
    for constant in &ty.constants {
        let _ = writeln!(text, "{} {}={}", constant.ty, constant.name, constant.value);
    }
    if ty.is_empty() {
        return;
    }
    for field in &ty.fields {
        let _ = write!(text, "{} {}", type_text(&field.ty), field.name);
        if !field.default_value.is_empty() {
            let _ = write!(text, " {}", default_text(field));
        }
        text.push('\n');
    }
}

fn type_text(ty: &FieldType) -> String {
    let mut text = match ty.base() {
        None | Some(Base::Nested) => short_name(&ty.nested_type_name),
        Some(base) => base.name().to_owned(),
    };
    if ty.string_capacity > 0 {
        let _ = write!(text, "<={}", ty.string_capacity);
    }
    let _ = match ty.shape() {
        None | Some(Shape::Single) => Ok(()),
        Some(Shape::Array(size)) => write!(text, "[{size}]"),
        Some(Shape::Bounded(size)) => write!(text, "[<={size}]"),
        Some(Shape::Unbounded) => write!(text, "[]"),
    };
    text
}

/// In the notation of message files; a list of texts that cannot be read stays as it is.
fn default_text(Field { ty, default_value, .. }: &Field) -> String {
    let text = match (ty.base(), ty.shape()) {
        (Some(base), Some(shape)) if matches!(base.name(), "string" | "wstring") => (base, shape),
        _ => return default_value.to_ascii_lowercase().replace('(', "[").replace(')', "]"),
    };
    match text {
        (_, Shape::Single) => format!("\"{}\"", default_value.replace('"', "\\\"")),
        (base, shape) => {
            literal::to_json(default_value, base, shape).unwrap_or_else(|_| default_value.clone())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Distro, built_in, parse_joined};

    #[test]
    fn text_is_that_of_mcap() {
        let types = built_in(Distro::Jazzy);
        let pose = types.describe("geometry_msgs/msg/Pose").expect("it is built in");
        let line = "=".repeat(80);
        assert_eq!(
            definition_text(&pose),
            format!(
                "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n\
                 {line}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n\
                 {line}\nMSG: geometry_msgs/Quaternion\n\
                 float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"
            )
        );
    }

    #[test]
    fn every_built_in_type_comes_back_from_its_text() {
        for distro in Distro::ALL {
            let types = built_in(distro);
            for name in types.names() {
                let Ok(description) = types.describe(name) else { continue };
                let text = definition_text(&description);
                let read = parse_joined(name, &text, None).expect("our own text");
                assert_eq!(read.hash(), description.hash(), "{name}:\n{text}");
            }
        }
    }

    #[test]
    fn defaults_of_type_descriptions_are_written_as_in_message_files() {
        let text =
            "bool b True\nstring s a \"b\"\nfloat32[2] f (1.5, -inf)\nstring[] t ('a', \"b\")\n";
        let read = parse_joined("a/msg/B", text, None).expect("a definition");
        assert_eq!(
            definition_text(&read),
            "bool b true\nstring s \"a \\\"b\\\"\"\nfloat32[2] f [1.5, -inf]\n\
             string[] t [\"a\",\"b\"]\n"
        );
    }
}
