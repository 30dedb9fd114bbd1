//! Merge patches (RFC 7396) from one picture to the next, and what makes them small.

use serde_json::{Map, Value};

/// The patch that makes `new` of `old`; `None` if they are equal. Neither may hold a `null` outside
/// of arrays ([`without_nulls`]): a patch could not say so.
#[must_use]
pub fn diff(old: &Value, new: &Value) -> Option<Value> {
    let (Value::Object(old), Value::Object(new)) = (old, new) else {
        return (old != new).then(|| new.clone());
    };
    let mut patch = Map::new();
    for (name, value) in new {
        let change = match old.get(name) {
            Some(before) => diff(before, value),
            None => Some(value.clone()),
        };
        patch.extend(change.map(|change| (name.clone(), change)));
    }
    let gone = old.keys().filter(|name| !new.contains_key(*name));
    patch.extend(gone.map(|name| (name.clone(), Value::Null)));
    (!patch.is_empty()).then_some(Value::Object(patch))
}

/// The same without members that are `null`: in a picture, what is absent is not known.
#[must_use]
pub fn without_nulls(value: Value) -> Value {
    match value {
        Value::Object(members) => {
            let known = members.into_iter().filter(|(_, member)| !member.is_null());
            Value::Object(known.map(|(name, member)| (name, without_nulls(member))).collect())
        }
        other => other,
    }
}

/// A number with three significant digits; `None` if it is none.
#[must_use]
pub fn rounded(value: f64) -> Option<Value> {
    if !value.is_finite() {
        return None;
    }
    if value == 0.0 {
        return Some(0.into());
    }
    let magnitude = value.abs().log10().floor() as i32;
    // Through text: a product of powers of ten would have digits of its own.
    let text = format!("{value:.2e}");
    let value: f64 = text.parse().ok()?;
    if magnitude >= 2 && value.abs() < 9e15 {
        return Some((value as i64).into());
    }
    serde_json::Number::from_f64(value).map(Value::Number)
}

#[cfg(test)]
mod tests {
    use blaze_domain::config::merge::merge_patch;
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    fn any_json() -> impl Strategy<Value = Value> {
        let leaf = prop_oneof![
            any::<bool>().prop_map(Value::from),
            (0_i64..5).prop_map(Value::from),
            "[a-c]{0,2}".prop_map(Value::from),
            Just(json!([1, null, { "a": null }])),
            Just(Value::Null),
        ];
        leaf.prop_recursive(4, 64, 4, |inner| {
            prop_oneof![
                proptest::collection::vec(inner.clone(), 0..3).prop_map(Value::from),
                proptest::collection::btree_map("[a-d]", inner, 0..4)
                    .prop_map(|members| Value::Object(members.into_iter().collect())),
            ]
        })
    }

    proptest! {
        #[test]
        fn snapshot_and_deltas_are_the_newest(
            pictures in proptest::collection::vec(any_json(), 2..8),
        ) {
            let pictures: Vec<Value> = pictures
                .into_iter()
                .map(|picture| without_nulls(json!({ "x": picture })))
                .collect();
            let mut held = pictures[0].clone();
            for pair in pictures.windows(2) {
                match diff(&pair[0], &pair[1]) {
                    Some(patch) => merge_patch(&mut held, &patch),
                    None => prop_assert_eq!(&pair[0], &pair[1]),
                }
                prop_assert_eq!(&held, &pair[1]);
            }
        }

        #[test]
        fn rounding_moves_less_than_one_in_two_hundred(value in -1e12_f64..1e12) {
            let rounded = rounded(value).unwrap().as_f64().unwrap();
            prop_assert!((rounded - value).abs() <= value.abs() / 199.0, "{value} {rounded}");
        }
    }

    #[test]
    fn a_delta_holds_what_moved() {
        let old = json!({ "a": { "b": 1, "c": 2 }, "d": [1], "e": 1 });
        let new = json!({ "a": { "b": 1, "c": 3 }, "d": [2], "f": { "g": 1 } });
        let expected = json!({ "a": { "c": 3 }, "d": [2], "e": null, "f": { "g": 1 } });
        assert_eq!(diff(&old, &new), Some(expected));
        assert_eq!(diff(&new, &new), None);
    }

    #[test]
    fn three_digits_are_kept() {
        for (value, text) in [
            (0.0, "0"),
            (0.123_456, "0.123"),
            (52_148.0, "52100"),
            (9.999, "10.0"),
            (-1.234, "-1.23"),
        ] {
            assert_eq!(rounded(value).unwrap().to_string(), text);
        }
        assert_eq!(rounded(f64::NAN), None);
    }
}
