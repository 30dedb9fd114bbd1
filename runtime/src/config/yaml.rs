//! YAML text to a tree of values, with the line of every value.
//!
//! The core schema of YAML 1.2 (so `on` and `off` are texts), one document. Anchors, aliases, duplicate keys and tags
//! other than `!!str` are refused with their line: they make a file mean something else than it seems to say.

use std::collections::HashSet;
use std::sync::Arc;

use saphyr_parser::{Event, Parser, ScalarStyle, Span, Tag};
use serde_json::{Map, Value};

use super::place::{LocatedFault, Place, Places, join};
use super::scalar::core_schema;

/// Deepest nesting.
pub(super) const MAX_DEPTH: usize = 32;
/// More faults than these help nobody.
const MAX_FAULTS: usize = 200;

/// What a text holds.
pub(super) struct Parsed {
    /// The tree as far as it could be read; `None` where the text is no YAML at all.
    pub(super) value: Option<Value>,
    pub(super) places: Places,
    pub(super) faults: Vec<LocatedFault>,
}

/// Where the lines of a text belong.
#[derive(Clone)]
pub(super) enum Origin {
    /// Each line has its own place.
    File(Arc<str>),
    /// One place for all: a variable or an option.
    Single(Place),
}

impl Origin {
    pub(super) fn place(&self, line: usize) -> Place {
        match self {
            Self::File(file) => Place::File {
                file: Arc::clone(file),
                line,
            },
            Self::Single(place) => place.clone(),
        }
    }
}

/// Reads a text whose root stands at `root` in the whole document (empty for a file).
pub(super) fn parse(text: &str, origin: &Origin, root: &str) -> Parsed {
    let mut builder = Builder {
        origin,
        root,
        stack: Vec::new(),
        document: None,
        documents: 0,
        places: Places::default(),
        faults: Vec::new(),
    };
    builder.places.set(root, origin.place(1));
    let mut parser = Parser::new_from_str(text);
    let mut whole = true;
    while let Some(event) = parser.next_event() {
        let step = match event {
            Ok((event, span)) => builder.event(event, span),
            Err(error) => {
                builder.fault(
                    error.marker().line(),
                    root.to_owned(),
                    format!("is not YAML: {}", error.info()),
                );
                Err(Stop)
            }
        };
        if step.is_err() || builder.faults.len() >= MAX_FAULTS {
            whole = false;
            break;
        }
    }
    Parsed {
        value: whole.then(|| builder.document.unwrap_or(Value::Null)),
        places: builder.places,
        faults: builder.faults,
    }
}

/// The text cannot be read further.
struct Stop;

/// A collection that is still open.
enum Open {
    List(Vec<Value>),
    Map {
        entries: Map<String, Value>,
        /// The key whose value comes next.
        key: Option<Key>,
        seen: HashSet<String>,
    },
}

struct Key {
    name: String,
    line: usize,
    /// The key came before: its value is read and forgotten.
    repeated: bool,
}

struct Frame {
    path: String,
    open: Open,
}

struct Builder<'a> {
    origin: &'a Origin,
    root: &'a str,
    stack: Vec<Frame>,
    document: Option<Value>,
    documents: usize,
    places: Places,
    faults: Vec<LocatedFault>,
}

impl Builder<'_> {
    fn fault(&mut self, line: usize, path: String, detail: impl Into<String>) {
        self.faults.push(LocatedFault {
            place: self.origin.place(line),
            path,
            detail: detail.into(),
        });
    }

    fn event(&mut self, event: Event<'_>, span: Span) -> Result<(), Stop> {
        let line = span.start.line();
        match event {
            Event::Nothing | Event::StreamStart | Event::StreamEnd | Event::DocumentEnd => Ok(()),
            Event::DocumentStart(_) => {
                self.documents += 1;
                if self.documents > 1 {
                    self.fault(line, self.root.to_owned(), "holds a second document; one is allowed");
                    return Err(Stop);
                }
                Ok(())
            }
            Event::Alias(_) => self.alias(line),
            Event::Scalar(text, style, anchor, tag) => {
                self.refuse_anchor(anchor, line);
                if self.wants_key() {
                    return self.key(text.into_owned(), line);
                }
                let (path, line) = self.next_place(line);
                let value = self.scalar(&text, style, tag.as_deref(), line, &path);
                self.put(&path, line, value);
                Ok(())
            }
            Event::SequenceStart(anchor, tag) => self.open(Open::List(Vec::new()), anchor, tag.as_deref(), line),
            Event::MappingStart(anchor, tag) => {
                let map = Open::Map {
                    entries: Map::new(),
                    key: None,
                    seen: HashSet::new(),
                };
                self.open(map, anchor, tag.as_deref(), line)
            }
            Event::SequenceEnd | Event::MappingEnd => {
                self.close();
                Ok(())
            }
        }
    }

    fn wants_key(&self) -> bool {
        matches!(
            self.stack.last(),
            Some(Frame {
                open: Open::Map { key: None, .. },
                ..
            })
        )
    }

    fn key(&mut self, name: String, line: usize) -> Result<(), Stop> {
        let Some(Frame {
            path,
            open: Open::Map { key, seen, .. },
        }) = self.stack.last_mut()
        else {
            return Err(Stop);
        };
        let repeated = !seen.insert(name.clone());
        let at = join(path, &name);
        *key = Some(Key { name, line, repeated });
        if repeated {
            self.fault(line, at, "is given twice");
        }
        Ok(())
    }

    fn alias(&mut self, line: usize) -> Result<(), Stop> {
        if self.wants_key() {
            self.fault(line, self.here(), "an alias cannot be a key");
            return Err(Stop);
        }
        let (path, line) = self.next_place(line);
        self.fault(
            line,
            path.clone(),
            "aliases (*name) are not allowed: write the value out",
        );
        self.put(&path, line, Value::Null);
        Ok(())
    }

    fn open(&mut self, open: Open, anchor: usize, tag: Option<&Tag>, line: usize) -> Result<(), Stop> {
        self.refuse_anchor(anchor, line);
        if self.wants_key() {
            self.fault(line, self.here(), "a key must be text");
            return Err(Stop);
        }
        let (path, line) = self.next_place(line);
        if self.stack.len() >= MAX_DEPTH {
            self.fault(line, path, format!("is nested deeper than {MAX_DEPTH}"));
            return Err(Stop);
        }
        if tag.is_some() {
            self.fault(line, path.clone(), "tags are not allowed");
        }
        self.note_place(&path, line);
        self.stack.push(Frame { path, open });
        Ok(())
    }

    fn close(&mut self) {
        if let Some(Frame { path, open }) = self.stack.pop() {
            let value = match open {
                Open::List(items) => Value::Array(items),
                Open::Map { entries, .. } => Value::Object(entries),
            };
            self.put(&path, 0, value);
        }
    }

    fn refuse_anchor(&mut self, anchor: usize, line: usize) {
        if anchor != 0 {
            self.fault(
                line,
                self.here(),
                "anchors (&name) are not allowed: write the value out",
            );
        }
    }

    /// The path of what is read now, for faults.
    fn here(&self) -> String {
        match self.stack.last() {
            None => self.root.to_owned(),
            Some(frame) => match &frame.open {
                Open::Map { key: Some(key), .. } => join(&frame.path, &key.name),
                Open::Map { key: None, .. } => frame.path.clone(),
                Open::List(items) => format!("{}[{}]", frame.path, items.len()),
            },
        }
    }

    /// Path and line of the next value. A value of a mapping has the line of its key: there a person looks first, and
    /// an absent value has no line of its own.
    fn next_place(&self, line: usize) -> (String, usize) {
        let line = match self.stack.last() {
            Some(Frame {
                open: Open::Map { key: Some(key), .. },
                ..
            }) => key.line,
            _ => line,
        };
        (self.here(), line)
    }

    /// The first place of a path stays, so that a repeated key does not hide the first one.
    fn note_place(&mut self, path: &str, line: usize) {
        if line > 0 && (path == self.root || !self.places.knows(path)) {
            self.places.set(path, self.origin.place(line));
        }
    }

    /// A value is complete: it goes into the open collection.
    fn put(&mut self, path: &str, line: usize, value: Value) {
        self.note_place(path, line);
        match self.stack.last_mut() {
            None => self.document = Some(value),
            Some(Frame {
                open: Open::List(items),
                ..
            }) => items.push(value),
            Some(Frame {
                open: Open::Map { entries, key, .. },
                ..
            }) => {
                if let Some(key) = key.take().filter(|key| !key.repeated) {
                    entries.insert(key.name, value);
                }
            }
        }
    }

    fn scalar(&mut self, text: &str, style: ScalarStyle, tag: Option<&Tag>, line: usize, path: &str) -> Value {
        let text_tag = tag.is_some_and(|tag| tag.is_yaml_core_schema() && tag.suffix == "str");
        if tag.is_some() && !text_tag {
            self.fault(line, path.to_owned(), "tags other than !!str are not allowed");
        }
        if text_tag || style != ScalarStyle::Plain {
            return Value::String(text.to_owned());
        }
        core_schema(text).unwrap_or_else(|detail| {
            self.fault(line, path.to_owned(), detail);
            Value::Null
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    fn read(text: &str) -> Parsed {
        parse(text, &Origin::File(Arc::from("f")), "")
    }

    fn value(text: &str) -> Value {
        let parsed = read(text);
        assert_eq!(parsed.faults, [], "{text}");
        parsed.value.unwrap()
    }

    fn faults(text: &str) -> Vec<String> {
        read(text).faults.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn quotes_and_tags_make_text() {
        let text = "a: 150\nb: \"150\"\nc: 'true'\nd: !!str 150\ne:\nf: off\n";
        let expected = json!({ "a": 150, "b": "150", "c": "true", "d": "150", "e": null, "f": "off" });
        assert_eq!(value(text), expected);
        assert_eq!(value(""), Value::Null);
        assert_eq!(value("# only a comment\n"), Value::Null);
    }

    #[test]
    fn every_value_has_its_line() {
        let parsed = read("a: 1\nb:\n  c: [x,\n    y]\n  d:\n    - e: 5\n      f:\n    - 7\n");
        let line = |path: &str| parsed.places.locate(path).to_string();
        for (path, expected) in [
            ("", "f:1"),
            ("a", "f:1"),
            ("b", "f:2"),
            ("b.c", "f:3"),
            ("b.c[0]", "f:3"),
            ("b.c[1]", "f:4"),
            ("b.d", "f:5"),
            ("b.d[0]", "f:6"),
            ("b.d[0].e", "f:6"),
            ("b.d[0].f", "f:7"),
            ("b.d[1]", "f:8"),
            ("b.d[9]", "f:5"),
        ] {
            assert_eq!(line(path), expected, "{path}");
        }
    }

    #[test]
    fn what_misleads_is_refused_with_its_line() {
        assert_eq!(faults("a: 1\nb: 2\na: 3\n"), ["f:3: a: is given twice"]);
        assert_eq!(
            faults("a: &x 1\nb: *x\nc: !thing 4\nd: .inf\n"),
            [
                "f:1: a: anchors (&name) are not allowed: write the value out",
                "f:2: b: aliases (*name) are not allowed: write the value out",
                "f:3: c: tags other than !!str are not allowed",
                "f:4: d: is not a finite number",
            ]
        );
        assert_eq!(
            faults("a: 1\n---\nb: 2\n"),
            ["f:2: holds a second document; one is allowed"]
        );
        assert_eq!(faults("a:\n  ? [x]\n  : 1\n"), ["f:2: a: a key must be text"]);
        assert!(
            faults("a: 1\nb: [1, 2\nc: 3\n")[0].starts_with("f:3: is not YAML: "),
            "{:?}",
            faults("b: [1")
        );
        assert_eq!(value("a: 1\nb: {}\n"), json!({ "a": 1, "b": {} }));
    }

    #[test]
    fn a_repeated_key_does_not_replace_the_first() {
        let parsed = read("a: { x: 1 }\na: { x: 2 }\n");
        assert_eq!(parsed.value, Some(json!({ "a": { "x": 1 } })));
        assert_eq!(parsed.places.locate("a.x").to_string(), "f:1");
    }

    #[test]
    fn depth_is_bounded() {
        let deep = |n: usize| format!("{}1{}", "[".repeat(n), "]".repeat(n));
        assert!(read(&deep(MAX_DEPTH)).faults.is_empty());
        assert_eq!(read(&deep(MAX_DEPTH + 1)).faults.len(), 1);
        assert_eq!(read(&"[".repeat(1 << 20)).faults.len(), 1);
        assert!(!read(&"? ".repeat(1 << 19)).faults.is_empty());
        assert!(!read(&"- ".repeat(1 << 19)).faults.is_empty());
        assert!(!read(&"&a ".repeat(1 << 18)).faults.is_empty());
    }

    proptest! {
        #[test]
        fn no_text_panics(text in "[-?:,\\[\\]{}#&*!|>'\"%@` \n\ta-c0-9.~]{0,60}") {
            let _ = read(&text);
        }

        #[test]
        fn no_characters_panic(text in any::<String>()) {
            let _ = read(&text);
        }

        #[test]
        fn json_is_yaml(numbers in prop::collection::vec(any::<i64>(), 0..5), text in "[a-z \"\\\\\n\u{e4}]{0,20}") {
            let tree = json!({ "numbers": numbers, "text": text, "inner": { "list": [[], {}, null, true] } });
            prop_assert_eq!(value(&serde_json::to_string_pretty(&tree).unwrap()), tree);
        }
    }
}
