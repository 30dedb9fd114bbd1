//! The types themselves, in the form of ROS 2's own type descriptions.
//!
//! The members are named as in `type_description_interfaces/msg/TypeDescription`, so the same
//! structures read the `.json` files of a `share` tree and the responses of nodes.

use serde::{Deserialize, Serialize};

use crate::hash::TypeHash;
use crate::limits::{MAX_DEFINITION_BYTES, MAX_FIELDS, MAX_NAME_BYTES, MAX_TYPES};

/// The only field of a message without fields: C knows no empty structures. It is one byte in CDR
/// and nothing in JSON.
pub(crate) const EMPTY_FIELD: &str = "structure_needs_at_least_one_member";

/// A type and all types that it refers to, directly or not.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TypeDescription {
    /// The type itself.
    pub type_description: IndividualType,
    /// The others, sorted by name.
    pub referenced_type_descriptions: Vec<IndividualType>,
}

/// One type.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct IndividualType {
    /// `geometry_msgs/msg/Twist`
    pub type_name: String,
    /// In the order of the definition, which is that of the bytes.
    pub fields: Vec<Field>,
    /// Constants of the definition's text. Type descriptions have none.
    #[serde(skip)]
    pub constants: Vec<Constant>,
}

/// One field.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Field {
    /// Its name, which is that of the JSON member.
    pub name: String,
    /// Its type.
    #[serde(rename = "type")]
    pub ty: FieldType,
    /// Empty for none; as written in the definition, a single string without quotes.
    #[serde(default)]
    pub default_value: String,
}

/// Type of a field.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FieldType {
    /// A number of `type_description_interfaces/msg/FieldType`.
    pub type_id: u8,
    /// Elements of an array, most elements of a bounded sequence, else 0.
    pub capacity: u64,
    /// Most bytes of a bounded string, most UTF-16 units of a wide one, else 0.
    pub string_capacity: u64,
    /// Full name of a nested type, else empty.
    pub nested_type_name: String,
}

/// One constant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Constant {
    /// `uint8`
    pub ty: String,
    /// `STATUS_FIX`
    pub name: String,
    /// As written.
    pub value: String,
}

/// Why a description is not one.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DescriptionError {
    /// It is not JSON of the expected members.
    #[error("not a type description: {0}")]
    Syntax(String),
    /// The answer of a node that does not have it.
    #[error("the node has no description: {0}")]
    Refused(String),
    /// A name that is none.
    #[error("{0:?} is not a name of a type")]
    TypeName(String),
    /// A name of a field that is none.
    #[error("{type_name}: {name:?} is not a name of a field")]
    FieldName {
        /// The type that has the field.
        type_name: String,
        /// The name given.
        name: String,
    },
    /// Two fields of one name.
    #[error("{type_name} has two fields {name}")]
    RepeatedField {
        /// The type that has the fields.
        type_name: String,
        /// Their name.
        name: String,
    },
    /// Larger than a limit.
    #[error("has {found} {what}, at most {limit} are allowed")]
    TooLarge {
        /// The unit that was counted.
        what: &'static str,
        /// The number found.
        found: usize,
        /// The number allowed.
        limit: usize,
    },
}

/// A file of a `share` tree.
#[derive(Deserialize)]
struct DescriptionFile {
    type_description_msg: TypeDescription,
}

impl TypeDescription {
    /// Reads the JSON of `type_description_interfaces/msg/TypeDescription`.
    ///
    /// # Errors
    /// For JSON of other members, names that are none, and more than the limits allow.
    pub fn from_json(json: &[u8]) -> Result<Self, DescriptionError> {
        read::<Self>(json)?.checked()
    }

    /// Reads a `.json` file of a `share` tree. Other types that the file has (the parts of a
    /// service) are among the referenced ones.
    ///
    /// # Errors
    /// As [`TypeDescription::from_json`].
    pub fn from_file(json: &[u8]) -> Result<Self, DescriptionError> {
        read::<DescriptionFile>(json)?.type_description_msg.checked()
    }

    /// The hash that ROS 2 gives the type.
    #[must_use]
    pub fn hash(&self) -> TypeHash {
        TypeHash::of(self)
    }

    /// All types, the type itself first.
    pub fn types(&self) -> impl Iterator<Item = &IndividualType> {
        std::iter::once(&self.type_description).chain(&self.referenced_type_descriptions)
    }

    /// Memory that it takes, in bytes, about.
    pub(crate) fn bytes(&self) -> usize {
        let of_field = |field: &Field| {
            let texts = [&field.name, &field.default_value, &field.ty.nested_type_name];
            size_of::<Field>() + texts.map(String::len).iter().sum::<usize>()
        };
        let of_type = |ty: &IndividualType| {
            let fields: usize = ty.fields.iter().map(of_field).sum();
            size_of::<IndividualType>() + ty.type_name.len() + fields
        };
        self.types().map(of_type).sum()
    }

    /// The same with the referenced types sorted by name, as the hash needs them.
    ///
    /// # Errors
    /// As [`TypeDescription::check`].
    pub(crate) fn checked(mut self) -> Result<Self, DescriptionError> {
        self.check()?;
        self.referenced_type_descriptions.sort_by(|a, b| a.type_name.cmp(&b.type_name));
        Ok(self)
    }

    /// Whether names and sizes are within the limits.
    ///
    /// # Errors
    /// For a name that is none, a repeated field, too many types or fields.
    pub fn check(&self) -> Result<(), DescriptionError> {
        at_most("types", 1 + self.referenced_type_descriptions.len(), MAX_TYPES)?;
        at_most("fields", self.types().map(|ty| ty.fields.len()).sum(), MAX_FIELDS)?;
        self.types().try_for_each(IndividualType::check)
    }
}

impl IndividualType {
    fn check(&self) -> Result<(), DescriptionError> {
        if !is_type_name(&self.type_name) {
            return Err(DescriptionError::TypeName(self.type_name.clone()));
        }
        let mut names: Vec<&str> = self.fields.iter().map(|field| field.name.as_str()).collect();
        if let Some(name) = names.iter().find(|name| !is_field_name(name)) {
            let (type_name, name) = (self.type_name.clone(), (*name).to_owned());
            return Err(DescriptionError::FieldName { type_name, name });
        }
        names.sort_unstable();
        if let Some([name, _]) = names.array_windows().find(|[one, other]| one == other) {
            let (type_name, name) = (self.type_name.clone(), (*name).to_owned());
            return Err(DescriptionError::RepeatedField { type_name, name });
        }
        self.fields.iter().try_for_each(Field::check)
    }

    /// Whether the definition has no fields.
    pub(crate) fn is_empty(&self) -> bool {
        matches!(self.fields.as_slice(), [only] if only.name == EMPTY_FIELD)
    }
}

impl Field {
    fn check(&self) -> Result<(), DescriptionError> {
        let nested = &self.ty.nested_type_name;
        if !nested.is_empty() && !is_type_name(nested) {
            return Err(DescriptionError::TypeName(nested.clone()));
        }
        Ok(())
    }
}

fn read<'a, T: Deserialize<'a>>(json: &'a [u8]) -> Result<T, DescriptionError> {
    at_most("bytes", json.len(), MAX_DEFINITION_BYTES)?;
    serde_json::from_slice(json).map_err(|error| DescriptionError::Syntax(error.to_string()))
}

/// # Errors
/// If more was found than the limit allows.
pub(crate) fn at_most(
    what: &'static str,
    found: usize,
    limit: usize,
) -> Result<(), DescriptionError> {
    if found > limit {
        return Err(DescriptionError::TooLarge { what, found, limit });
    }
    Ok(())
}

/// Whether the text has the form `package/msg/Name`; `srv` and `action` likewise.
pub(crate) fn is_type_name(text: &str) -> bool {
    let mut segments = text.split('/');
    let package = segments.next().is_some_and(is_field_name);
    let group = matches!(segments.next(), Some("msg" | "srv" | "action"));
    let name = segments.next().is_some_and(is_field_name);
    package && group && name && segments.next().is_none() && text.len() <= MAX_NAME_BYTES
}

/// Whether the text can be a name in C: JSON and paths of files need no escape then.
pub(crate) fn is_field_name(text: &str) -> bool {
    text.len() <= MAX_NAME_BYTES
        && text.starts_with(|first: char| first.is_ascii_alphabetic())
        && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO: &str = r#"{"type_description": {"type_name": "a/msg/B", "fields": [
        {"name": "x", "type": {"type_id": 1, "capacity": 0, "string_capacity": 0,
         "nested_type_name": "a/msg/C"}, "default_value": ""}]},
        "referenced_type_descriptions": [{"type_name": "a/msg/C", "fields": []}]}"#;

    #[test]
    fn json_of_a_description_is_read() {
        let read = TypeDescription::from_json(TWO.as_bytes()).expect("a description");
        assert_eq!(read.types().count(), 2);
        let file = format!(r#"{{"type_description_msg": {TWO}, "type_hashes": []}}"#);
        assert_eq!(TypeDescription::from_file(file.as_bytes()), Ok(read));
    }

    #[test]
    fn names_are_checked() {
        for bad in ["a/msg/B\\\"", "a/msg/", "a/B", "../msg/B", "a/msg/B/c", "a/idl/B"] {
            let json = TWO.replacen("a/msg/B", bad, 1);
            assert!(TypeDescription::from_json(json.as_bytes()).is_err(), "{bad}");
        }
        let json = TWO.replace("\"x\"", "\"x y\"");
        let error = TypeDescription::from_json(json.as_bytes()).expect_err("a bad name");
        assert_eq!(error.to_string(), "a/msg/B: \"x y\" is not a name of a field");
    }

    #[test]
    fn a_field_stands_once() {
        let mut two = TypeDescription::from_json(TWO.as_bytes()).expect("a description");
        let field = two.type_description.fields[0].clone();
        two.type_description.fields.push(field);
        let error = two.check().expect_err("twice");
        assert_eq!(error.to_string(), "a/msg/B has two fields x");
    }

    #[test]
    fn sizes_have_limits() {
        let large = vec![b' '; MAX_DEFINITION_BYTES + 1];
        let error = TypeDescription::from_json(&large).expect_err("too large");
        assert_eq!(error.to_string(), "has 1048577 bytes, at most 1048576 are allowed");
        let mut many = TypeDescription::from_json(TWO.as_bytes()).expect("a description");
        let one = many.referenced_type_descriptions[0].clone();
        many.referenced_type_descriptions = vec![one; MAX_TYPES];
        let error = many.check().expect_err("too many");
        assert_eq!(error.to_string(), "has 1001 types, at most 1000 are allowed");
    }
}
