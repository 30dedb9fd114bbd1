//! One text per value: JCS (RFC 8785), and hashes over it.
//!
//! Members are ordered by the UTF-16 units of their names, numbers are written as ECMAScript does,
//! nothing is between the tokens. All numbers are those of IEEE 754; integers within ±(2^53 - 1),
//! the only ones that are taken ([`json`](super::json)), are exact.

use serde_json::{Number, Value};
use sha2::{Digest as _, Sha256};

use super::{Kind, MAX_INTEGER, secret};

/// The canonical text of a value.
#[must_use]
pub fn to_string(value: &Value) -> String {
    let mut out = String::new();
    write_value(value, &mut out);
    out
}

/// `sha256:` and the hash of a configuration in hex, of each secret the version alone. It does not
/// matter in which form the secrets are.
#[must_use]
pub fn hash(config: &Value) -> String {
    sha256(to_string(&secret::for_hash(config)).as_bytes())
}

/// `sha256:` and the hash in hex over one line per document, sorted: what a layer's worker and the
/// main service compare. Each entry is kind, service (of an instance), name and revision.
#[must_use]
pub fn digest<'a>(
    entries: impl IntoIterator<Item = (Kind, Option<&'a str>, &'a str, u64)>,
) -> String {
    let line = |(kind, service, name, revision): (Kind, Option<&str>, &str, u64)| {
        format!("{kind} {} {name} {revision}\n", service.unwrap_or("-"))
    };
    let mut lines: Vec<String> = entries.into_iter().map(line).collect();
    lines.sort_unstable();
    sha256(lines.concat().as_bytes())
}

fn sha256(bytes: &[u8]) -> String {
    let hash = Sha256::digest(bytes);
    let hex: String = hash.iter().map(|byte| format!("{byte:02x}")).collect();
    format!("sha256:{hex}")
}

fn write_value(value: &Value, out: &mut String) {
    match value {
        // Texts are escaped as JCS wants it: what must be, with the short form where there is one.
        Value::Null | Value::Bool(_) | Value::String(_) => out.push_str(&value.to_string()),
        Value::Number(number) => write_number(number, out),
        Value::Array(items) => {
            out.push('[');
            for (index, item) in items.iter().enumerate() {
                if index > 0 {
                    out.push(',');
                }
                write_value(item, out);
            }
            out.push(']');
        }
        Value::Object(members) => {
            let mut members: Vec<(&String, &Value)> = members.iter().collect();
            members.sort_unstable_by(|(one, _), (other, _)| {
                one.encode_utf16().cmp(other.encode_utf16())
            });
            out.push('{');
            for (index, (name, member)) in members.into_iter().enumerate() {
                if index > 0 {
                    out.push(',');
                }
                write_value(&Value::from(name.as_str()), out);
                out.push(':');
                write_value(member, out);
            }
            out.push('}');
        }
    }
}

fn write_number(number: &Number, out: &mut String) {
    match number.as_i64().filter(|value| value.unsigned_abs() <= MAX_INTEGER.unsigned_abs()) {
        Some(value) => out.push_str(&value.to_string()),
        None => write_float(number.as_f64().unwrap_or_default(), out),
    }
}

/// `Number::toString` of ECMAScript. What is not finite is no number of JSON and becomes `null`, as
/// there.
fn write_float(value: f64, out: &mut String) {
    let Some(number) = Number::from_f64(value.abs()) else {
        return out.push_str("null");
    };
    if value == 0.0 {
        return out.push('0');
    }
    if value < 0.0 {
        out.push('-');
    }
    // The shortest digits that read back as the same number, nearest to it, of two that are equally
    // near the even ones: so ECMAScript wants them and so they are printed here. `{:e}` rounds up
    // instead.
    let (digits, exponent) = digits_of(&number.to_string());
    // Where the point stands, counted in digits from the left.
    let point = exponent + 1;
    let count = i32::try_from(digits.len()).unwrap_or(i32::MAX);
    let zeros = |count: i32| "0".repeat(usize::try_from(count).unwrap_or(0));
    match point {
        1..=21 if point >= count => {
            out.push_str(&digits);
            out.push_str(&zeros(point - count));
        }
        1..=21 => {
            let (whole, rest) = digits.split_at(usize::try_from(point).unwrap_or(0));
            out.extend([whole, ".", rest]);
        }
        -5..=0 => {
            out.push_str("0.");
            out.push_str(&zeros(-point));
            out.push_str(&digits);
        }
        _ => {
            let (first, rest) = digits.split_at(1);
            out.push_str(first);
            if !rest.is_empty() {
                out.extend([".", rest]);
            }
            out.push_str(if exponent < 0 { "e-" } else { "e+" });
            out.push_str(&exponent.unsigned_abs().to_string());
        }
    }
}

/// The digits of a decimal above zero, without zeros at the ends, and the power of ten of the
/// first.
fn digits_of(text: &str) -> (String, i32) {
    let (mantissa, power) = text.split_once(['e', 'E']).unwrap_or((text, "0"));
    let (whole, fraction) = mantissa.split_once('.').unwrap_or((mantissa, ""));
    let all = format!("{whole}{fraction}");
    let leading = all.len() - all.trim_start_matches('0').len();
    let digits = all.trim_matches('0').to_owned();
    let shift = |length: usize| i32::try_from(length).unwrap_or(i32::MAX);
    let exponent =
        power.parse::<i32>().unwrap_or_default() + shift(whole.len()) - 1 - shift(leading);
    (if digits.is_empty() { "0".to_owned() } else { digits }, exponent)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;
    use crate::config::arbitrary::{any_json, any_part};

    fn number(bits: u64) -> String {
        let mut out = String::new();
        write_float(f64::from_bits(bits), &mut out);
        out
    }

    #[test]
    fn numbers_of_rfc_8785() {
        // Appendix B.
        for (bits, expected) in [
            (0x0000_0000_0000_0000, "0"),
            (0x8000_0000_0000_0000, "0"),
            (0x0000_0000_0000_0001, "5e-324"),
            (0x8000_0000_0000_0001, "-5e-324"),
            (0x7fef_ffff_ffff_ffff, "1.7976931348623157e+308"),
            (0xffef_ffff_ffff_ffff, "-1.7976931348623157e+308"),
            (0x4340_0000_0000_0000, "9007199254740992"),
            (0xc340_0000_0000_0000, "-9007199254740992"),
            (0x4430_0000_0000_0000, "295147905179352830000"),
            (0x44b5_2d02_c7e1_4af5, "9.999999999999997e+22"),
            (0x44b5_2d02_c7e1_4af6, "1e+23"),
            (0x44b5_2d02_c7e1_4af7, "1.0000000000000001e+23"),
            (0x444b_1ae4_d6e2_ef4e, "999999999999999700000"),
            (0x444b_1ae4_d6e2_ef4f, "999999999999999900000"),
            (0x444b_1ae4_d6e2_ef50, "1e+21"),
            (0x3eb0_c6f7_a0b5_ed8c, "9.999999999999997e-7"),
            (0x3eb0_c6f7_a0b5_ed8d, "0.000001"),
            (0x41b3_de43_5555_5553, "333333333.3333332"),
            (0x41b3_de43_5555_5554, "333333333.33333325"),
            (0x41b3_de43_5555_5555, "333333333.3333333"),
            (0x41b3_de43_5555_5556, "333333333.3333334"),
            (0x41b3_de43_5555_5557, "333333333.33333343"),
            (0xbecb_f647_612f_3696, "-0.0000033333333333333333"),
            (0x4314_3ff3_c1cb_0959, "1424953923781206.2"),
        ] {
            assert_eq!(number(bits), expected, "{bits:x}");
        }
        assert_eq!(number(f64::NAN.to_bits()), "null");
    }

    #[test]
    fn the_example_of_rfc_8785() {
        // Section 3.2.2.
        let text = "{
            \"numbers\": [333333333.33333329, 1E30, 4.50, 2e-3, 0.000000000000000000000000001],
            \"string\": \"\\u20ac$\\u000F\\u000aA'\\u0042\\u0022\\u005c\\\\\\\"\\/\",
            \"literals\": [null, true, false]
        }";
        let value = serde_json::from_str::<Value>(text).unwrap();
        assert_eq!(
            to_string(&value),
            "{\"literals\":[null,true,false],\"numbers\":[333333333.3333333,1e+30,4.5,0.002,1e-27],\
             \"string\":\"\u{20ac}$\\u000f\\nA'B\\\"\\\\\\\\\\\"/\"}"
        );
    }

    #[test]
    fn names_are_ordered_by_utf_16() {
        // Section 3.2.3: by code points the emoji would come last.
        let value = json!({
            "\u{20ac}": "Euro Sign", "\r": "Carriage Return", "\u{fb33}": "Hebrew Letter Dalet \
                With Dagesh",
            "1": "One", "\u{1f600}": "Emoji: Grinning Face", "\u{80}": "Control",
            "\u{f6}": "Latin Small Letter O",
        });
        assert_eq!(
            to_string(&value),
            "{\"\\r\":\"Carriage Return\",\"1\":\"One\",\"\u{80}\":\"Control\",\"\u{f6}\":\"Latin Small Letter O\",\
             \"\u{20ac}\":\"Euro Sign\",\"\u{1f600}\":\"Emoji: Grinning Face\",\
             \"\u{fb33}\":\"Hebrew Letter Dalet With Dagesh\"}"
        );
    }

    #[test]
    fn controls_are_escaped_and_nothing_else() {
        let text: String = ('\0'..='\u{20}').chain(['\u{7f}', '\u{2028}', '/', '<']).collect();
        assert_eq!(
            to_string(&Value::from(text)),
            "\"\\u0000\\u0001\\u0002\\u0003\\u0004\\u0005\\u0006\\u0007\\b\\t\\n\\u000b\\f\\r\\u000e\\u000f\
             \\u0010\\u0011\\u0012\\u0013\\u0014\\u0015\\u0016\\u0017\\u0018\\u0019\\u001a\\u001b\\u001c\\u001d\\u001e\\u001f\
             \u{20}\u{7f}\u{2028}/<\""
        );
    }

    #[test]
    fn hashes_are_those_of_the_text() {
        // printf '{}' | sha256sum; printf '{"a":1,"b":[]}' | sha256sum
        assert_eq!(
            hash(&json!({})),
            "sha256:44136fa355b3678a1146ad16f7e8649e94fb4fc21fe77e8310c060f61caaff8a"
        );
        assert_eq!(
            hash(&json!({ "b": [], "a": 1.0 })),
            "sha256:f87e4099e9be5e75094e0a4f46d3dc18a9c37429314a5a2490fb78d31e7e170c"
        );
    }

    #[test]
    fn the_hash_covers_versions_of_secrets() {
        let stored = json!({ "pw": { "$secret": { "key": "e1", "nonce": "n", "data": "d",
            "version": 7 } } });
        let redacted = json!({ "pw": { "$secret": { "redacted": true, "version": 7 } } });
        assert_eq!(hash(&stored), hash(&redacted));
        assert_eq!(hash(&stored), hash(&secret::for_hash(&stored)));
        assert_eq!(hash(&stored), sha256(b"{\"pw\":{\"$secret\":{\"version\":7}}}"));
    }

    #[test]
    fn a_digest_is_over_sorted_lines() {
        let entries = [
            (Kind::Service, None, "slam", 3),
            (Kind::Instance, Some("slam"), "0", 88),
            (Kind::Layer, None, "edge", 412),
            (Kind::Node, None, "robot-1", 40),
        ];
        let text = b"Instance slam 0 88\nLayer - edge 412\nNode - robot-1 40\nService - slam 3\n";
        assert_eq!(digest(entries), sha256(text));
        assert_eq!(digest(entries.into_iter().rev()), sha256(text));
        assert_eq!(digest([]), sha256(b""));
    }

    proptest! {
        #[test]
        fn the_text_reads_as_the_value(value in any_json()) {
            let text = to_string(&value);
            let read = serde_json::from_str::<Value>(&text).unwrap();
            prop_assert_eq!(to_string(&read), text);
        }

        #[test]
        fn every_float_reads_back(bits in any::<u64>()) {
            let value = f64::from_bits(bits);
            if value.is_finite() {
                prop_assert_eq!(number(bits).parse::<f64>().unwrap(), value);
            }
        }

        #[test]
        fn the_order_of_members_does_not_count(value in any_part()) {
            let mut sorted = value.clone();
            sorted.sort_all_objects();
            prop_assert_eq!(hash(&sorted), hash(&value));
        }
    }
}
