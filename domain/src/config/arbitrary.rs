//! Values for property tests: small alphabets, so that keys of two values meet.

use proptest::prelude::*;
use serde_json::Value;

use super::MAX_INTEGER;

fn leaf() -> impl Strategy<Value = Value> {
    prop_oneof![
        any::<bool>().prop_map(Value::from),
        (-3_i64..3).prop_map(Value::from),
        (-MAX_INTEGER..=MAX_INTEGER).prop_map(Value::from),
        prop::num::f64::NORMAL.prop_map(|value| Value::from(value % 1e12)),
        ".{0,6}".prop_map(Value::from),
    ]
}

fn name() -> impl Strategy<Value = String> {
    prop_oneof![
        8 => prop::sample::select(vec!["a", "b", "c", "d"]).prop_map(str::to_owned),
        1 => "[a-c/~\u{e4}\u{20ac}\u{1f600}]{0,3}",
    ]
}

fn tree(leaf: BoxedStrategy<Value>) -> impl Strategy<Value = Value> {
    leaf.prop_recursive(4, 48, 5, |inner| {
        prop_oneof![
            1 => prop::collection::vec(inner.clone(), 0..4).prop_map(Value::from),
            4 => prop::collection::btree_map(name(), inner, 0..5)
                .prop_map(|members| members.into_iter().collect()),
        ]
    })
}

/// Any JSON within the limits, without `null` and without secrets.
pub(super) fn any_json() -> impl Strategy<Value = Value> {
    tree(leaf().boxed())
}

/// The same with `null` here and there.
pub(super) fn any_patch() -> impl Strategy<Value = Value> {
    tree(prop_oneof![2 => leaf(), 1 => Just(Value::Null)].boxed())
}

/// An object with `null`s and secrets here and there: a part of a configuration.
pub(super) fn any_part() -> impl Strategy<Value = Value> {
    let secret = (0_u64..3).prop_map(
        |version| serde_json::json!({ "$secret": { "redacted": true, "version": version } }),
    );
    let leaf = prop_oneof![6 => leaf(), 3 => Just(Value::Null), 1 => secret].boxed();
    prop::collection::btree_map(name(), tree(leaf), 0..5)
        .prop_map(|members| members.into_iter().collect())
}
