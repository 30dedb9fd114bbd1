//! Definitions in parts: a message of the link holds some hundred bytes.

use blaze_proto::link::link_control::TypeDefinition;

use super::MessageType;

/// Bytes of text in one part: with the longest name of a type and its hash it fits a LinkControl.
const PART_BYTES: usize = 800;
/// Parts of one definition at most: 200 kB of text.
pub(crate) const MAX_PARTS: usize = 256;

/// A definition as text, in parts. One part without text says that there is none.
pub(crate) fn parts_of(ty: &MessageType, text: Option<&str>) -> Vec<TypeDefinition> {
    let texts = match text {
        // That of a message without fields is empty.
        Some("") => vec!["\n"],
        Some(text) => cut(text),
        None => vec![""],
    };
    let parts = u32::try_from(texts.len()).unwrap_or(u32::MAX);
    let part = |(part, text): (u32, &str)| TypeDefinition {
        r#type: ty.name.clone(),
        hash: ty.hash.clone(),
        part,
        parts,
        definition: text.to_owned(),
    };
    (0..).zip(texts).map(part).collect()
}

/// Pieces of a text, none of them empty; one without text where there would be too many.
fn cut(mut text: &str) -> Vec<&str> {
    let mut pieces = Vec::new();
    while !text.is_empty() {
        if pieces.len() == MAX_PARTS {
            return vec![""];
        }
        let (piece, rest) = text.split_at(text.floor_char_boundary(PART_BYTES));
        pieces.push(piece);
        text = rest;
    }
    pieces
}

/// The parts of one definition that have come.
#[derive(Debug, Default)]
pub(crate) struct Parts(Vec<Option<String>>);

impl Parts {
    /// Takes a part. Returns the text once all are there. Parts of another number than those before
    /// begin anew; what is no part changes nothing.
    pub(crate) fn take(&mut self, part: TypeDefinition) -> Option<String> {
        let TypeDefinition { part, parts, definition, .. } = part;
        let (part, parts) = (usize::try_from(part).ok()?, usize::try_from(parts).ok()?);
        let is_part = part < parts && parts <= MAX_PARTS && definition.len() <= PART_BYTES;
        if !is_part || (definition.is_empty() && parts > 1) {
            return None;
        }
        if self.0.len() != parts {
            self.0 = vec![None; parts];
        }
        self.0[part] = Some(definition);
        self.0.iter().map(Option::as_deref).collect()
    }
}

#[cfg(test)]
mod tests {
    use blaze_proto::link::LinkControl;
    use blaze_proto::link::link_control::Body;
    use proptest::prelude::*;
    use prost::Message as _;

    use super::*;

    fn ty() -> MessageType {
        MessageType { name: format!("a/msg/{}", "B".repeat(249)), hash: "R".repeat(71) }
    }

    #[test]
    fn a_definition_that_nobody_has_is_one_part_without_text() {
        for text in [None, Some(&*"x".repeat(PART_BYTES * MAX_PARTS + 1))] {
            let parts = parts_of(&ty(), text);
            assert_eq!(parts.len(), 1);
            assert_eq!(Parts::default().take(parts[0].clone()).as_deref(), Some(""));
        }
        let empty = parts_of(&ty(), Some(""));
        assert_eq!(Parts::default().take(empty[0].clone()).as_deref(), Some("\n"));
        let largest = "x".repeat(PART_BYTES * MAX_PARTS);
        assert_eq!(parts_of(&ty(), Some(&largest)).len(), MAX_PARTS);
    }

    #[test]
    fn what_is_no_part_changes_nothing() {
        let mut whole = Parts::default();
        let part = |part, parts, text: &str| TypeDefinition {
            part,
            parts,
            definition: text.to_owned(),
            ..TypeDefinition::default()
        };
        assert_eq!(whole.take(part(0, 2, "a")), None);
        let long = "x".repeat(PART_BYTES + 1);
        for lie in [
            part(2, 2, "z"),
            part(0, 0, "z"),
            part(1, u32::MAX, "z"),
            part(u32::MAX, u32::MAX, "z"),
            part(1, 2, ""),
            part(1, 2, &long),
        ] {
            assert_eq!(whole.take(lie), None);
        }
        assert_eq!(whole.take(part(1, 2, "b")).as_deref(), Some("ab"));
        assert_eq!(whole.take(part(0, 3, "a")), None, "another definition begins");
    }

    proptest! {
        #[test]
        fn parts_in_any_order_and_number_make_the_text(
            text in "(int32 [a-z]{1,40}\n|string s \"[äöü€𝄞]{1,30}\"\n){1,200}",
            order in prop::collection::vec(any::<prop::sample::Index>(), 0..60),
        ) {
            let parts = parts_of(&ty(), Some(&text));
            for part in &parts {
                let control = LinkControl::from(Body::TypeDefinition(part.clone()));
                prop_assert!(control.encoded_len() <= 1200);
            }
            let mut whole = Parts::default();
            let random = order.iter().map(|index| index.get(&parts));
            let results: Vec<_> =
                random.chain(&parts).map(|part| whole.take(part.clone())).collect();
            prop_assert_eq!(results.last(), Some(&Some(text.clone())));
            prop_assert!(results.iter().flatten().all(|result| *result == text));
        }
    }
}
