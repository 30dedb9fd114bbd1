//! YAML text to trees of values, with the line of every value or fault.
//!
//! The core schema of YAML 1.2 (so `on` and `off` are texts). Anchors, aliases, duplicate keys,
//! tags (but `!!str` in the configuration of a process) and directives other than `%YAML 1.2` are
//! refused with their line: they make a text mean something else than it seems to say.
//!
//! ```text
//! a file of one document ──[parse]──▶ tree, place of every value, faults        (the configuration of a process)
//! a text of several ──[yaml_documents]──▶ trees, or every fault                 (documents of the whole system)
//! ```

use std::collections::HashSet;
use std::sync::Arc;

use saphyr_parser::{Event, Parser, ScalarStyle, Span, Tag};
use serde_json::{Map, Value};

use super::scalar::core_schema;
use super::value_origin::{LocatedFault, Places, TOO_MANY_DOCUMENTS, ValueOrigin, join};

/// Deepest nesting.
pub(super) const MAX_DEPTH: usize = 32;
/// More faults than these help nobody.
const MAX_FAULTS: usize = 200;
/// Longest key, in bytes: faults repeat all keys on the way to them.
const MAX_KEY_BYTES: usize = 1024;

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
    Single(ValueOrigin),
    /// Each line has its own place, of a text that is no file.
    Text,
}

impl Origin {
    pub(super) fn place(&self, line: usize) -> ValueOrigin {
        match self {
            Self::File(file) => ValueOrigin::File { file: Arc::clone(file), line },
            Self::Single(place) => place.clone(),
            Self::Text => ValueOrigin::Line(line),
        }
    }
}

/// Reads a text of one document whose root stands at `root` in the whole document (empty for a
/// file).
pub(super) fn parse(text: &str, origin: &Origin, root: &str) -> Parsed {
    let mut places = Places::default();
    places.set(root, origin.place(1));
    let mut builder = Builder::new(origin, root, Documents::One, Some(places));
    let whole = builder.read(text);
    Parsed {
        value: whole.then(|| builder.document.unwrap_or(Value::Null)),
        places: builder.places.unwrap_or_default(),
        faults: builder.faults,
    }
}

/// Reads a text of several documents, split by `---`, such as `apply` takes. Empty documents are
/// left out. Places of faults are lines of the text.
///
/// # Errors
/// Every fault of form: what is no YAML, repeated keys, anchors, aliases, tags, directives other
/// than `%YAML 1.2`, nesting deeper than 32, numbers that cannot be held. More than `max_documents`
/// are one fault ([`LocatedFault::is_too_many_documents`]).
pub fn yaml_documents(text: &str, max_documents: usize) -> Result<Vec<Value>, Vec<LocatedFault>> {
    let located = located_documents(text, max_documents)?;
    Ok(located.into_iter().map(|(_, value)| value).collect())
}

/// The same, each with the line on which its content begins.
///
/// # Errors
/// As [`yaml_documents`].
pub fn located_documents(
    text: &str,
    max_documents: usize,
) -> Result<Vec<(usize, Value)>, Vec<LocatedFault>> {
    let documents = Documents::Many { limit: max_documents, finished: Vec::new() };
    let origin = Origin::Text;
    let mut builder = Builder::new(&origin, "", documents, None);
    builder.read(text.strip_prefix('\u{feff}').unwrap_or(text));
    match builder.documents {
        Documents::Many { finished, .. } if builder.faults.is_empty() => Ok(finished),
        Documents::Many { .. } | Documents::One => Err(builder.faults),
    }
}

/// The text cannot be read further.
struct Stop;

/// Finds directives, which the parser follows and does not tell of. They stand between two
/// documents.
struct Directives<'a> {
    /// Where it has come to.
    rest: &'a str,
    /// Number of the line that begins there.
    line: usize,
    /// The line of the end of the last document.
    end: usize,
}

impl<'a> Directives<'a> {
    fn of(text: &'a str) -> Self {
        Self { rest: text, line: 1, end: 1 }
    }

    /// Lines of directives that are not taken, before a document that begins.
    fn refused(&mut self, event: &Event<'_>, span: Span) -> Vec<usize> {
        let mut refused = Vec::new();
        match event {
            Event::DocumentEnd => self.end = span.start.line(),
            Event::DocumentStart(true) => {
                while self.line < span.start.line() && !self.rest.is_empty() {
                    let (number, line) = (self.line, self.next_line());
                    let directive = line.split(" #").next().unwrap_or_default();
                    let is_known = directive.split_whitespace().eq(["%YAML", "1.2"]);
                    if number >= self.end && line.starts_with('%') && !is_known {
                        refused.push(number);
                    }
                }
            }
            _ => {}
        }
        refused
    }

    /// Lines end as YAML has it: with line feed, carriage return, or both.
    fn next_line(&mut self) -> &'a str {
        let end = self.rest.find(['\n', '\r']).unwrap_or(self.rest.len());
        let (line, rest) = self.rest.split_at(end);
        self.rest = rest
            .strip_prefix("\r\n")
            .or_else(|| rest.strip_prefix(['\n', '\r']))
            .unwrap_or_default();
        self.line += 1;
        line
    }
}

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

/// How many documents a text may hold.
enum Documents {
    One,
    Many {
        limit: usize,
        /// Those that are complete and not empty, with their lines.
        finished: Vec<(usize, Value)>,
    },
}

struct Builder<'a> {
    origin: &'a Origin,
    root: &'a str,
    /// What is open, from the root on; together they are the path of what is read now.
    stack: Vec<Open>,
    document: Option<Value>,
    /// Line on which the content of the document begins.
    begins: usize,
    documents: Documents,
    started: usize,
    /// `None`: nobody asks for them.
    places: Option<Places>,
    faults: Vec<LocatedFault>,
}

impl<'a> Builder<'a> {
    fn new(
        origin: &'a Origin,
        root: &'a str,
        documents: Documents,
        places: Option<Places>,
    ) -> Self {
        Self {
            origin,
            root,
            stack: Vec::new(),
            document: None,
            begins: 0,
            documents,
            started: 0,
            places,
            faults: Vec::new(),
        }
    }

    /// Reads a text; whether to its end.
    fn read(&mut self, text: &str) -> bool {
        let mut parser = Parser::new_from_str(text);
        let mut directives = Directives::of(text);
        while let Some(event) = parser.next_event() {
            let step = match event {
                Ok((event, span)) => {
                    for line in directives.refused(&event, span) {
                        let detail = "directives other than %YAML 1.2 are not allowed";
                        self.fault(line, self.root.to_owned(), detail);
                    }
                    self.event(event, span)
                }
                Err(error) => {
                    let detail = format!("is not YAML: {}", error.info());
                    self.fault(error.marker().line(), self.root.to_owned(), detail);
                    Err(Stop)
                }
            };
            if step.is_err() || self.faults.len() >= MAX_FAULTS {
                return false;
            }
        }
        true
    }

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
            Event::Nothing | Event::StreamStart | Event::StreamEnd => Ok(()),
            Event::DocumentStart(_) => self.start_document(line),
            Event::DocumentEnd => self.end_document(line),
            Event::Alias(_) => self.alias(line),
            Event::Scalar(text, style, anchor, tag) => {
                self.refuse_anchor(anchor, line);
                if self.wants_key() {
                    self.refuse_tag(tag.as_deref(), line);
                    return self.key(text.into_owned(), line);
                }
                let line = self.line_of_value(line);
                self.note_place(line);
                let value = self.scalar(&text, style, tag.as_deref(), line);
                self.put(value);
                Ok(())
            }
            Event::SequenceStart(anchor, tag) => {
                self.open(Open::List(Vec::new()), anchor, tag.as_deref(), line)
            }
            Event::MappingStart(anchor, tag) => {
                let map = Open::Map { entries: Map::new(), key: None, seen: HashSet::new() };
                self.open(map, anchor, tag.as_deref(), line)
            }
            Event::SequenceEnd | Event::MappingEnd => {
                self.close();
                Ok(())
            }
        }
    }

    fn start_document(&mut self, line: usize) -> Result<(), Stop> {
        self.started += 1;
        if matches!(self.documents, Documents::One) && self.started > 1 {
            self.fault(line, self.root.to_owned(), "holds a second document; one is allowed");
            return Err(Stop);
        }
        Ok(())
    }

    fn end_document(&mut self, line: usize) -> Result<(), Stop> {
        let Documents::Many { limit, finished } = &mut self.documents else {
            return Ok(());
        };
        let limit = *limit;
        match self.document.take() {
            None | Some(Value::Null) => Ok(()),
            Some(_) if finished.len() >= limit => {
                self.fault(
                    line,
                    String::new(),
                    format!("{TOO_MANY_DOCUMENTS}: at most {limit} are allowed"),
                );
                Err(Stop)
            }
            Some(document) => {
                finished.push((self.begins, document));
                Ok(())
            }
        }
    }

    fn wants_key(&self) -> bool {
        matches!(self.stack.last(), Some(Open::Map { key: None, .. }))
    }

    fn key(&mut self, name: String, line: usize) -> Result<(), Stop> {
        if name.len() > MAX_KEY_BYTES {
            let detail =
                format!("has a key of {} bytes, at most {MAX_KEY_BYTES} are allowed", name.len());
            self.fault(line, self.here(), detail);
            return Err(Stop);
        }
        let Some(Open::Map { key, seen, .. }) = self.stack.last_mut() else {
            return Err(Stop);
        };
        let repeated = !seen.insert(name.clone());
        *key = Some(Key { name, line, repeated });
        if repeated {
            self.fault(line, self.here(), "is given twice");
        }
        Ok(())
    }

    fn alias(&mut self, line: usize) -> Result<(), Stop> {
        if self.wants_key() {
            self.fault(line, self.here(), "an alias cannot be a key");
            return Err(Stop);
        }
        let line = self.line_of_value(line);
        self.fault(line, self.here(), "aliases (*name) are not allowed: write the value out");
        self.note_place(line);
        self.put(Value::Null);
        Ok(())
    }

    fn open(
        &mut self,
        open: Open,
        anchor: usize,
        tag: Option<&Tag>,
        line: usize,
    ) -> Result<(), Stop> {
        self.refuse_anchor(anchor, line);
        if self.wants_key() {
            self.fault(line, self.here(), "a key must be text");
            return Err(Stop);
        }
        let line = self.line_of_value(line);
        if self.stack.len() >= MAX_DEPTH {
            self.fault(line, self.here(), format!("is nested deeper than {MAX_DEPTH}"));
            return Err(Stop);
        }
        if tag.is_some() {
            self.fault(line, self.here(), "tags are not allowed");
        }
        self.note_place(line);
        self.stack.push(open);
        Ok(())
    }

    fn close(&mut self) {
        match self.stack.pop() {
            Some(Open::List(items)) => self.put(Value::Array(items)),
            Some(Open::Map { entries, .. }) => self.put(Value::Object(entries)),
            None => {}
        }
    }

    fn refuse_anchor(&mut self, anchor: usize, line: usize) {
        if anchor != 0 {
            self.fault(line, self.here(), "anchors (&name) are not allowed: write the value out");
        }
    }

    /// Of scalars and keys.
    fn refuse_tag(&mut self, tag: Option<&Tag>, line: usize) {
        let Some(tag) = tag else { return };
        let detail = match self.documents {
            Documents::One if tag.is_yaml_core_schema() && tag.suffix == "str" => return,
            Documents::One => "tags other than !!str are not allowed",
            Documents::Many { .. } => "tags are not allowed",
        };
        self.fault(line, self.here(), detail);
    }

    /// The path of what is read now. It is put together only where it is needed, for it may be
    /// long.
    fn here(&self) -> String {
        let mut path = self.root.to_owned();
        for open in &self.stack {
            match open {
                Open::Map { key: Some(key), .. } => path = join(&path, &key.name),
                Open::Map { key: None, .. } => {}
                Open::List(items) => path.push_str(&format!("[{}]", items.len())),
            }
        }
        path
    }

    /// Line of the next value. A value of a mapping has the line of its key: there a person looks
    /// first, and an absent value has no line of its own.
    fn line_of_value(&self, line: usize) -> usize {
        match self.stack.last() {
            Some(Open::Map { key: Some(key), .. }) => key.line,
            Some(Open::Map { key: None, .. } | Open::List(_)) | None => line,
        }
    }

    /// Notes where the next value stands. The first place of a path stays, so that a repeated key
    /// does not hide the first one.
    fn note_place(&mut self, line: usize) {
        if self.stack.is_empty() {
            self.begins = line;
        }
        if self.places.is_none() {
            return;
        }
        let (path, place) = (self.here(), self.origin.place(line));
        if let Some(places) =
            self.places.as_mut().filter(|places| path == self.root || !places.knows(&path))
        {
            places.set(&path, place);
        }
    }

    /// A value is complete: it goes into the open collection.
    fn put(&mut self, value: Value) {
        match self.stack.last_mut() {
            None => self.document = Some(value),
            Some(Open::List(items)) => items.push(value),
            Some(Open::Map { entries, key, .. }) => {
                if let Some(key) = key.take().filter(|key| !key.repeated) {
                    entries.insert(key.name, value);
                }
            }
        }
    }

    fn scalar(&mut self, text: &str, style: ScalarStyle, tag: Option<&Tag>, line: usize) -> Value {
        let has_tag = tag.is_some();
        self.refuse_tag(tag, line);
        if has_tag || style != ScalarStyle::Plain {
            return Value::String(text.to_owned());
        }
        core_schema(text).unwrap_or_else(|detail| {
            self.fault(line, self.here(), detail);
            Value::Null
        })
    }
}

#[cfg(test)]
#[path = "yaml_tests.rs"]
mod tests;
