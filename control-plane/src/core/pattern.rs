//! Keywords of a schema that look at a text: `pattern`, `minLength` and `maxLength`. They wrap
//! those of the library for two reasons.
//!
//! - Of a secret nothing may be told, so they hold at what stands in its place: see
//!   [`placeholder`].
//! - Matching is linear in the text, but a text may be long and a pattern large: it ends at a
//!   deadline, see [`within`].

use std::cell::Cell;
use std::sync::LazyLock;
use std::time::Instant;

use jsonschema::{Keyword, PatternOptions, Regex, ValidationError, Validator};
use serde_json::{Value, json};

/// Bytes that a compiled pattern may take.
const MAX_BYTES: usize = 64 * 1024;
/// Bytes that matching one pattern may keep for the next time.
const CACHE_BYTES: usize = 64 * 1024;
/// Stands for secrets; nobody can write it, for it is another one in each process.
static PLACEHOLDER: LazyLock<String> = LazyLock::new(|| format!("secret {}", uuid::Uuid::new_v4()));

thread_local! {
    /// When matching on this thread ends.
    static DEADLINE: Cell<Option<Instant>> = const { Cell::new(None) };
}

/// What stands in place of a secret. They differ, as secrets may.
pub(super) fn placeholder(number: usize) -> Value {
    Value::from(format!("{} {number}", *PLACEHOLDER))
}

/// Does a check in which no text is matched after a deadline; `None`: it came, so that the result
/// would mean nothing.
pub(super) fn within<T>(deadline: Instant, check: impl FnOnce() -> T) -> Option<T> {
    DEADLINE.set(Some(deadline));
    let out = check();
    DEADLINE.set(None);
    (Instant::now() < deadline).then_some(out)
}

/// The engine that takes time linear in the text.
pub(super) fn options() -> PatternOptions<Regex> {
    PatternOptions::regex().size_limit(MAX_BYTES).dfa_size_limit(CACHE_BYTES)
}

/// A keyword about texts, beyond what stands for a secret.
struct OfText(Validator);

/// Wraps the keyword `name`.
#[allow(clippy::result_large_err, reason = "the form of jsonschema")]
pub(super) fn keyword<'a>(
    name: &str,
    schema: &'a Value,
) -> Result<Box<dyn for<'i> Keyword<'i>>, ValidationError<'a>> {
    let built = jsonschema::options()
        .with_draft(jsonschema::Draft::Draft202012)
        .with_pattern_options(options())
        .offline()
        .build(&json!({ name: schema }));
    let wrong = |_| {
        ValidationError::custom(format!(
            "{name} {schema} cannot be used: it is no regular expression (look-around and \
             back-references are not part of \
             what is understood), or takes more than {MAX_BYTES} bytes, compiled"
        ))
    };
    Ok(Box::new(OfText(built.map_err(wrong)?)))
}

impl OfText {
    fn is_left_out(instance: &Value) -> bool {
        instance.as_str().is_none_or(|text| text.starts_with(PLACEHOLDER.as_str()))
            || DEADLINE.get().is_some_and(|deadline| Instant::now() >= deadline)
    }
}

impl<'i> Keyword<'i> for OfText {
    fn validate(&self, instance: &'i Value) -> Result<(), ValidationError<'i>> {
        match Self::is_left_out(instance) {
            true => Ok(()),
            false => self.0.validate(instance),
        }
    }

    fn is_valid(&self, instance: &'i Value) -> bool {
        Self::is_left_out(instance) || self.0.is_valid(instance)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::super::schema::Schemas;
    use super::*;

    fn is_valid(schema: &Value, value: &Value) -> bool {
        let compiled = Schemas::default().compiled(schema).unwrap();
        compiled.validator(true).is_valid(value)
    }

    #[test]
    fn texts_are_measured_in_characters_and_matched_anywhere() {
        for (schema, text, expected) in [
            (json!({ "minLength": 3 }), "äöü", true),
            (json!({ "minLength": 4.0 }), "äöü", false),
            (json!({ "maxLength": 3 }), "äöü", true),
            (json!({ "minLength": 1, "maxLength": 2 }), "äöü", false),
            (json!({ "pattern": "b+" }), "abbc", true),
            (json!({ "pattern": "^b+$" }), "abbc", false),
            (json!({ "pattern": "^\\d\\w\\s\\cA\\u0041\\p{Lu}\\/$" }), "1_ \u{1}AÄ/", true),
            // As ECMAScript reads them: ASCII digits alone.
            (json!({ "pattern": "^\\d$" }), "٣", false),
            (json!({ "propertyNames": { "pattern": "^a" } }), "no object", true),
        ] {
            assert_eq!(is_valid(&schema, &json!(text)), expected, "{schema} {text:?}");
        }
        for no_text in [json!(7), json!([]), json!(null)] {
            assert!(is_valid(&json!({ "minLength": 3, "maxLength": 0, "pattern": "a" }), &no_text));
        }
        let names = json!({ "propertyNames": { "pattern": "^a" } });
        assert!(is_valid(&names, &json!({ "ab": 1 })) && !is_valid(&names, &json!({ "b": 1 })));
    }

    #[test]
    fn what_stands_for_a_secret_holds() {
        let schema = json!({ "minLength": 1000, "maxLength": 0, "pattern": "^$" });
        assert!(is_valid(&schema, &placeholder(1)));
        assert!(!is_valid(&schema, &json!("secret 1")));
        assert_ne!(placeholder(1), placeholder(2));
        assert!(!is_valid(&json!({ "type": "integer" }), &placeholder(1)));
    }

    #[test]
    fn matching_ends_at_the_deadline() {
        let schema = json!({ "items": { "not": { "pattern": "(a|b)*a(a|b){300}c$" } } });
        let compiled = Schemas::default().compiled(&schema).unwrap();
        let texts = json!(vec!["ab".repeat(1000); 2000]);
        let begun = Instant::now();
        // It has passed: how fast this machine matches must not decide.
        let out = within(begun, || compiled.validator(true).is_valid(&texts));
        assert_eq!(out, None);
        assert!(begun.elapsed() < Duration::from_secs(5), "{:?}", begun.elapsed());
        // The next one has its own.
        let later = Instant::now() + Duration::from_secs(3600);
        let one = within(later, || compiled.validator(true).is_valid(&json!(["abab"])));
        assert_eq!(one, Some(true));
    }

    #[test]
    fn a_pattern_takes_linear_time() {
        let text = Value::from("a".repeat(200_000) + "!");
        assert!(!is_valid(&json!({ "pattern": "^(a+)+$" }), &text));
    }

    #[test]
    fn patterns_have_a_size() {
        let schemas = Schemas::default();
        for bad in [
            json!({ "pattern": "[a-z]{100000}" }),
            json!({ "patternProperties": { "[a-z]{100000}": true } }),
            json!({ "patternProperties": { (format!("^[ab]*{}c$", "()".repeat(1900))): true } }),
        ] {
            assert!(schemas.check(&bad).is_err(), "{bad}");
        }
        for good in [
            json!({ "pattern": "^\\p{L}+$" }),
            json!({ "patternProperties": { "^(a|b)(c|d){2,9}$": true } }),
            json!({ "pattern": "^[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?(\\.[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?)*$" }),
        ] {
            assert!(schemas.check(&good).is_ok(), "{good}");
        }
    }
}
