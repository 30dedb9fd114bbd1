//! RIHS01, the hash by which ROS 2 tells two definitions of one name apart.

use std::fmt::{self, Write};
use std::str::FromStr;

use sha2::{Digest, Sha256};

use crate::description::{Field, IndividualType, TypeDescription};

const PREFIX: &str = "RIHS01_";

/// Hash of a type: `RIHS01_` and 64 hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TypeHash([u8; 32]);

/// The text is not a hash of a type.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("not a type hash: expected RIHS01_ and 64 hexadecimal digits")]
pub struct HashError;

impl TypeHash {
    /// SHA-256 over the description as JSON, without defaults.
    #[must_use]
    pub fn of(description: &TypeDescription) -> Self {
        Self(Sha256::digest(hashed_text(description)).into())
    }
}

impl fmt::Display for TypeHash {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(PREFIX)?;
        self.0.iter().try_for_each(|byte| write!(out, "{byte:02x}"))
    }
}

impl fmt::Debug for TypeHash {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, out)
    }
}

impl FromStr for TypeHash {
    type Err = HashError;

    fn from_str(text: &str) -> Result<Self, HashError> {
        let digits = text.strip_prefix(PREFIX).ok_or(HashError)?.as_bytes();
        let (pairs, rest) = digits.as_chunks::<2>();
        let mut hash = [0; 32];
        if pairs.len() != hash.len() || !rest.is_empty() {
            return Err(HashError);
        }
        for (byte, [high, low]) in hash.iter_mut().zip(pairs) {
            *byte = digit(*high)? << 4 | digit(*low)?;
        }
        Ok(Self(hash))
    }
}

fn digit(character: u8) -> Result<u8, HashError> {
    let value = char::from(character).to_digit(16).ok_or(HashError)?;
    u8::try_from(value).map_err(|_| HashError)
}

/// The text whose blanks are those of Python's `json.dumps`. Names were checked, so none needs an
/// escape.
fn hashed_text(description: &TypeDescription) -> String {
    let mut text = String::from("{\"type_description\": ");
    write_type(&mut text, &description.type_description);
    text.push_str(", \"referenced_type_descriptions\": [");
    for (index, ty) in description.referenced_type_descriptions.iter().enumerate() {
        text.push_str(separator(index));
        write_type(&mut text, ty);
    }
    text.push_str("]}");
    text
}

fn separator(index: usize) -> &'static str {
    if index == 0 { "" } else { ", " }
}

fn write_type(text: &mut String, ty: &IndividualType) {
    let _ = write!(text, "{{\"type_name\": \"{}\", \"fields\": [", ty.type_name);
    for (index, field) in ty.fields.iter().enumerate() {
        text.push_str(separator(index));
        write_field(text, field);
    }
    text.push_str("]}");
}

fn write_field(text: &mut String, Field { name, ty, .. }: &Field) {
    let _ = write!(
        text,
        "{{\"name\": \"{name}\", \"type\": {{\"type_id\": {}, \"capacity\": {}, \
         \"string_capacity\": {}, \"nested_type_name\": \"{}\"}}}}",
        ty.type_id, ty.capacity, ty.string_capacity, ty.nested_type_name
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Distro, built_in};

    #[test]
    fn hashes_are_those_of_ros_2() {
        let known = [
            (
                "std_srvs/srv/SetBool",
                "abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a",
            ),
            (
                "std_srvs/srv/SetBool_Event",
                "3c4c20015afb4303eafd347b1d6a786f171a89c814726961a9593ef10df878cf",
            ),
            (
                "service_msgs/msg/ServiceEventInfo",
                "41bcbbe07a75c9b52bc96bfd5c24d7f0fc0a08c0cb7921b3373c5732345a6f45",
            ),
        ];
        let types = built_in(Distro::Jazzy);
        for (name, digits) in known {
            let hash = types.describe(name).expect("it is built in").hash();
            assert_eq!(hash.to_string(), format!("RIHS01_{digits}"), "{name}");
            assert_eq!(hash.to_string().parse(), Ok(hash));
        }
    }

    #[test]
    fn other_text_is_no_hash() {
        for bad in ["", "RIHS01_", "RIHS01_zz", "RIHS02_00", &format!("RIHS01_{}", "0".repeat(66))]
        {
            assert_eq!(bad.parse::<TypeHash>(), Err(HashError), "{bad}");
        }
    }
}
