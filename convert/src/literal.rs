//! Defaults of definitions, in the notations of message files (`[true, false]`, `"text"`) and of
//! type descriptions (`(True, False)`, `text`), as the JSON that stands for the same value.

use crate::kinds::{Base, Shape};

/// A fault of a default, in words.
type Fault = &'static str;

/// The default as JSON.
///
/// # Errors
/// The expected form.
pub(crate) fn to_json(text: &str, base: Base, shape: Shape) -> Result<String, Fault> {
    let mut rest = Rest(text.trim());
    if shape == Shape::Single {
        return if is_text(base) { Ok(quoted(text)) } else { scalar(rest.0, base) };
    }
    let mut elements = Vec::new();
    let close = match rest.next() {
        Some('[') => ']',
        Some('(') => ')',
        _ => return Ok(format!("[{}]", element(&mut Rest(text.trim()), base)?)),
    };
    loop {
        rest.skip_blanks();
        if rest.eat(close) {
            break;
        }
        elements.push(element(&mut rest, base)?);
        rest.skip_blanks();
        if !rest.eat(',') && !rest.0.starts_with(close) {
            return Err("expected a comma or the end of the list");
        }
    }
    if rest.0.is_empty() {
        Ok(format!("[{}]", elements.join(",")))
    } else {
        Err("text after the list")
    }
}

/// A text without its quotes, as `string` defaults of message files have them; text without quotes
/// as it is. Of backslashes only those before a quote count.
pub(crate) fn unquoted(text: &str) -> String {
    for quote in ['"', '\''] {
        let inner = text.strip_prefix(quote).and_then(|rest| rest.strip_suffix(quote));
        if let Some(inner) = inner {
            return inner.replace(&format!("\\{quote}"), &quote.to_string());
        }
    }
    text.to_owned()
}

fn is_text(base: Base) -> bool {
    matches!(base, Base::String | Base::WString | Base::BoundedString | Base::BoundedWString)
}

fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

struct Rest<'a>(&'a str);

impl<'a> Rest<'a> {
    fn next(&mut self) -> Option<char> {
        let mut all = self.0.chars();
        let first = all.next();
        self.0 = all.as_str();
        first
    }

    fn eat(&mut self, wanted: char) -> bool {
        let rest = self.0.strip_prefix(wanted);
        self.0 = rest.unwrap_or(self.0);
        rest.is_some()
    }

    fn skip_blanks(&mut self) {
        self.0 = self.0.trim_start();
    }

    fn word(&mut self) -> &'a str {
        let end = self.0.find([',', ')', ']']).unwrap_or(self.0.len());
        let (word, rest) = self.0.split_at(end);
        self.0 = rest;
        word.trim()
    }

    /// A text in quotes whose inner ones have a backslash.
    fn text(&mut self) -> Result<String, Fault> {
        let Some(quote @ ('"' | '\'')) = self.next() else {
            return Err("expected a text in quotes");
        };
        let mut text = String::new();
        loop {
            match self.next().ok_or("expected the closing quote")? {
                '\\' => text.push(self.next().ok_or("expected the closing quote")?),
                end if end == quote => return Ok(text),
                other => text.push(other),
            }
        }
    }
}

fn element(rest: &mut Rest<'_>, base: Base) -> Result<String, Fault> {
    match rest.0.starts_with(['"', '\'']) && is_text(base) {
        true => rest.text().map(|text| quoted(&text)),
        false if is_text(base) => Ok(quoted(rest.word())),
        false => scalar(rest.word(), base),
    }
}

fn scalar(word: &str, base: Base) -> Result<String, Fault> {
    match base {
        Base::Bool => match word.to_ascii_lowercase().as_str() {
            "true" | "1" => Ok("true".into()),
            "false" | "0" => Ok("false".into()),
            _ => Err("expected true or false"),
        },
        Base::Float32 | Base::Float64 => float(word),
        Base::Nested => Err("a nested type has no default"),
        _ => integer(word).map(|number| number.to_string()).ok_or("expected an integer"),
    }
}

fn float(word: &str) -> Result<String, Fault> {
    let number: f64 = word.parse().map_err(|_| "expected a number")?;
    Ok(match number {
        _ if number.is_nan() => "\"NaN\"".into(),
        f64::INFINITY => "\"Infinity\"".into(),
        f64::NEG_INFINITY => "\"-Infinity\"".into(),
        _ => format!("{number:e}"),
    })
}

/// Decimal, or with the prefixes that message files allow.
fn integer(word: &str) -> Option<i128> {
    let (sign, digits) = word.strip_prefix('-').map_or((1, word), |digits| (-1, digits));
    let digits = digits.to_ascii_lowercase();
    let radix = match digits.get(..2) {
        Some("0x") => 16,
        Some("0o") => 8,
        Some("0b") => 2,
        _ => return word.parse().ok(),
    };
    let digits = digits.get(2..).filter(|digits| !digits.starts_with(['+', '-']))?;
    i128::from_str_radix(digits, radix).ok()?.checked_mul(sign)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_notations_become_json() {
        let list = Shape::Unbounded;
        for (text, base, shape, json) in [
            ("true", Base::Bool, Shape::Single, "true"),
            ("False", Base::Bool, Shape::Single, "false"),
            ("0x1f", Base::UInt8, Shape::Single, "31"),
            ("-50", Base::Int8, Shape::Single, "-50"),
            ("1.125", Base::Float32, Shape::Single, "1.125e0"),
            ("nan", Base::Float64, Shape::Single, "\"NaN\""),
            ("-inf", Base::Float64, Shape::Single, "\"-Infinity\""),
            ("it's", Base::String, Shape::Single, "\"it's\""),
            ("[0, 1, 255]", Base::Byte, list, "[0,1,255]"),
            ("(0, 1,)", Base::Byte, list, "[0,1]"),
            ("5", Base::Byte, list, "[5]"),
            ("[]", Base::Int64, list, "[]"),
            ("['', 'max, value', \"a\\\"b\"]", Base::String, list, r#"["","max, value","a\"b"]"#),
            ("[a, b]", Base::WString, list, r#"["a","b"]"#),
        ] {
            assert_eq!(to_json(text, base, shape), Ok(json.to_owned()), "{text}");
        }
    }

    #[test]
    fn other_text_is_a_fault() {
        for (text, base, shape, fault) in [
            ("yes", Base::Bool, Shape::Single, "expected true or false"),
            ("0x", Base::UInt8, Shape::Single, "expected an integer"),
            ("0x-1", Base::UInt8, Shape::Single, "expected an integer"),
            ("é", Base::UInt8, Shape::Single, "expected an integer"),
            ("one", Base::Float32, Shape::Single, "expected a number"),
            ("[1", Base::Byte, Shape::Unbounded, "expected a comma or the end of the list"),
            ("[1] 2", Base::Byte, Shape::Unbounded, "text after the list"),
            ("['a", Base::String, Shape::Unbounded, "expected the closing quote"),
            ("x", Base::Nested, Shape::Single, "a nested type has no default"),
        ] {
            assert_eq!(to_json(text, base, shape), Err(fault), "{text}");
        }
    }

    #[test]
    fn quotes_go() {
        for (text, inner) in [
            ("\"Hello\"", "Hello"),
            ("'Hello\\'s'", "Hello's"),
            ("\"", "\""),
            ("Hello\\'s", "Hello\\'s"),
        ] {
            assert_eq!(unquoted(text), inner);
        }
    }
}
