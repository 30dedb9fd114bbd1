//! One document out of a file, the environment and overrides of the command line.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde_json::{Map, Value};

use super::overlay::{self, Overlay};
use super::value_origin::{LocatedFault, Places, ValueOrigin, join};
use super::yaml::{self, MAX_DEPTH, Origin};
use crate::environment;

/// Largest file, in bytes.
pub const MAX_FILE_BYTES: u64 = 1024 * 1024;
/// Names of variables that override the file start with this.
const PREFIX: &str = "BLAZE__";

/// Name and content of a file, or of what counts as one.
pub type NamedText = (Arc<str>, Arc<str>);

/// Where a configuration comes from. Precedence: overrides > environment > [overlay](Overlay) >
/// file > defaults of the schema.
#[derive(Debug, Clone, Default)]
pub struct Sources {
    /// The file that was asked for (`--config`, else `BLAZE_CONFIG`). It must exist.
    pub file: Option<PathBuf>,
    /// A text that is read in place of any file, as programs have that make their configuration
    /// themselves.
    pub text: Option<NamedText>,
    /// Files to look for if none was asked for; the first that exists is taken.
    pub search: Vec<PathBuf>,
    /// Variables `BLAZE__SECTION__KEY` and their values, which are YAML.
    pub environment: Vec<(String, String)>,
    /// `section.key` and values, which are YAML, in the order of the command line.
    pub overrides: Vec<(String, String)>,
    /// Whether it is no fault if none of `search` exists.
    pub file_may_be_absent: bool,
}

impl Sources {
    /// The sources of a process: `--config`, else `BLAZE_CONFIG`, else `./blaze.yaml`, else
    /// `/etc/blaze/blaze.yaml`.
    #[must_use]
    pub fn of_process(config_option: Option<PathBuf>, overrides: Vec<(String, String)>) -> Self {
        Self {
            file: config_option
                .or_else(|| environment::variable("BLAZE_CONFIG").map(PathBuf::from)),
            search: vec![PathBuf::from("./blaze.yaml"), PathBuf::from("/etc/blaze/blaze.yaml")],
            environment: environment::variables(PREFIX),
            overrides,
            ..Self::default()
        }
    }

    /// One file, nothing else.
    #[must_use]
    pub fn of_file(file: impl Into<PathBuf>) -> Self {
        Self { file: Some(file.into()), ..Self::default() }
    }

    /// One text, nothing else. Faults are told with `name` as that of a file.
    #[must_use]
    pub fn of_text(name: &str, text: &str) -> Self {
        Self { text: Some((Arc::from(name), Arc::from(text))), ..Self::default() }
    }

    /// The file that is read now, if there is one.
    #[must_use]
    pub fn resolve_file(&self) -> Option<PathBuf> {
        if self.text.is_some() {
            return None;
        }
        self.file.clone().or_else(|| self.search.iter().find(|file| file.exists()).cloned())
    }

    /// The same sources, bound to the file that is read now: another file that appears later is not
    /// taken instead.
    #[must_use]
    pub fn pinned(&self) -> Self {
        Self { file: self.resolve_file(), ..self.clone() }
    }

    /// The text of the file; `Ok(None)` if there is none and none is needed.
    pub(super) fn read_file(&self) -> Result<Option<NamedText>, LocatedFault> {
        if self.text.is_some() {
            return Ok(self.text.clone());
        }
        let Some(file) = self.resolve_file() else {
            if self.file_may_be_absent {
                return Ok(None);
            }
            let looked =
                self.search.iter().map(|file| file.display().to_string()).collect::<Vec<_>>();
            return Err(LocatedFault {
                place: ValueOrigin::Nowhere,
                path: String::new(),
                detail: format!(
                    "no file: give --config FILE or BLAZE_CONFIG, or make one of {}",
                    looked.join(", ")
                ),
            });
        };
        let name: Arc<str> = Arc::from(file.display().to_string());
        match read_bounded(&file) {
            Ok(text) => Ok(Some((name, Arc::from(text)))),
            Err(detail) => Err(LocatedFault {
                place: ValueOrigin::File { file: name, line: 0 },
                path: String::new(),
                detail,
            }),
        }
    }
}

/// Reads one `section.key=value` of the command line.
///
/// # Errors
/// In words, if there is no `=` or no key before it.
pub fn parse_override(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((path, value)) if well_formed(path.trim()) => {
            Ok((path.trim().to_owned(), value.to_owned()))
        }
        _ => Err("give it as section.key=value, such as flow.bandwidth.limit_mbps=40".to_owned()),
    }
}

fn read_bounded(file: &Path) -> Result<String, String> {
    use std::io::Read;
    let open = std::fs::File::open(file).map_err(|error| format!("cannot be opened: {error}"))?;
    let mut bytes = Vec::new();
    // One byte more than allowed tells a file that is too large.
    let mut limited = open.take(MAX_FILE_BYTES + 1);
    limited.read_to_end(&mut bytes).map_err(|error| format!("cannot be read: {error}"))?;
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return Err(format!("is larger than {MAX_FILE_BYTES} bytes"));
    }
    let text = String::from_utf8(bytes).map_err(|error| {
        let good = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let line = 1 + good.iter().filter(|byte| **byte == b'\n').count();
        format!("line {line} is not UTF-8")
    })?;
    Ok(text.strip_prefix('\u{feff}').map(str::to_owned).unwrap_or(text))
}

/// A configuration as a tree, with the place of every value.
#[derive(Debug, Clone)]
pub struct Document {
    value: Value,
    places: Places,
    file: Option<PathBuf>,
    text: Option<Arc<str>>,
}

impl Document {
    /// Reads all sources.
    ///
    /// # Errors
    /// Every fault of form: what is no YAML, duplicate keys, anchors, overrides that fit nowhere.
    pub fn load(sources: &Sources) -> Result<Self, Vec<LocatedFault>> {
        match Self::load_with_faults(sources) {
            (Some(document), faults) if faults.is_empty() => Ok(document),
            (_, faults) => Err(faults),
        }
    }

    /// Reads all sources; the document is there as far as it could be read, so that a schema can
    /// look for its own faults in the same run.
    #[must_use]
    pub fn load_with_faults(sources: &Sources) -> (Option<Self>, Vec<LocatedFault>) {
        match sources.read_file() {
            Ok(text) => Self::from_text(sources, text, None),
            Err(fault) => {
                let (_, mut faults) = Self::from_text(sources, None, None);
                faults.insert(0, fault);
                (None, faults)
            }
        }
    }

    pub(super) fn from_text(
        sources: &Sources,
        text: Option<NamedText>,
        over: Option<&Overlay>,
    ) -> (Option<Self>, Vec<LocatedFault>) {
        let parsed = match &text {
            Some((name, text)) => yaml::parse(text, &Origin::File(Arc::clone(name)), ""),
            None => yaml::parse("", &Origin::Single(ValueOrigin::Nowhere), ""),
        };
        let whole = parsed.value.is_some();
        let mut faults = parsed.faults;
        let mut document = Self {
            value: parsed.value.unwrap_or(Value::Null),
            places: parsed.places,
            file: text.as_ref().map(|(name, _)| PathBuf::from(&**name)),
            text: text.map(|(_, text)| text),
        };
        if let Some(over) = over {
            overlay::merge(&mut document.value, &mut document.places, &over.tree, &over.place());
        }
        for (path, place, value) in overrides(sources, &mut faults) {
            if let Err(fault) = document.put(&path, &place, value) {
                faults.extend(fault);
            }
        }
        (whole.then_some(document), faults)
    }

    /// The tree; `null` for an empty file.
    #[must_use]
    pub fn value(&self) -> &Value {
        &self.value
    }

    /// The file that was read, or the name of the text in place of one.
    #[must_use]
    pub fn file(&self) -> Option<&Path> {
        self.file.as_deref()
    }

    /// The text of the file that was read, if any.
    pub(super) fn text(&self) -> Option<&Arc<str>> {
        self.text.as_ref()
    }

    /// Where a value comes from; for one that is missing, where its nearest ancestor does.
    #[must_use]
    pub fn locate(&self, path: &str) -> ValueOrigin {
        self.places.locate(path)
    }

    /// A fault or warning of a schema, with its place.
    #[must_use]
    pub fn fault(&self, path: impl Into<String>, detail: impl Into<String>) -> LocatedFault {
        let path = path.into();
        LocatedFault { place: self.locate(&path), path, detail: detail.into() }
    }

    /// Puts the YAML text of an override at its path, in place of what stands there.
    fn put(
        &mut self,
        path: &str,
        place: &ValueOrigin,
        text: &str,
    ) -> Result<(), Vec<LocatedFault>> {
        let steps = steps(path);
        let faulty = |path: &str, detail: String| {
            vec![LocatedFault { place: place.clone(), path: path.to_owned(), detail }]
        };
        if steps.len() >= MAX_DEPTH {
            return Err(faulty("", format!("is nested deeper than {MAX_DEPTH}")));
        }
        let mut at = String::new();
        let mut made = Vec::new();
        let mut slot = &mut self.value;
        for step in &steps {
            let fresh = slot.is_null();
            (slot, at) = descend(slot, step, at).map_err(|(at, detail)| faulty(&at, detail))?;
            made.push((at.clone(), fresh || slot.is_null()));
        }
        let parsed = yaml::parse(text, &Origin::Single(place.clone()), &at);
        let read = match parsed.value {
            Some(value) if parsed.faults.is_empty() => {
                *slot = value;
                Ok(())
            }
            _ => Err(parsed.faults),
        };
        self.places.forget_below(&at);
        // Sections that exist only because of the override have its place too.
        for (path, fresh) in made {
            if fresh && !self.places.knows(&path) {
                self.places.set(&path, place.clone());
            }
        }
        self.places.set(&at, place.clone());
        read
    }
}

/// All overrides in the order in which they are applied: the environment from the general to the
/// particular, then the command line as it stands.
fn overrides<'s>(
    sources: &'s Sources,
    faults: &mut Vec<LocatedFault>,
) -> Vec<(String, ValueOrigin, &'s str)> {
    let mut refuse = |place: &ValueOrigin, detail: &str| {
        faults.push(LocatedFault {
            place: place.clone(),
            path: String::new(),
            detail: detail.to_owned(),
        });
    };
    let mut out = Vec::new();
    for (name, value) in &sources.environment {
        let place = ValueOrigin::Environment(Arc::from(name.as_str()));
        let path =
            name.strip_prefix(PREFIX).unwrap_or(name).to_ascii_lowercase().replace("__", ".");
        if well_formed(&path) {
            out.push((path, place, value.as_str()));
        } else {
            refuse(&place, "is not of the form BLAZE__SECTION__KEY");
        }
    }
    out.sort_by_key(|(path, ..)| path.split('.').count());
    for (path, value) in &sources.overrides {
        let place = ValueOrigin::Override(Arc::from(path.as_str()));
        if well_formed(path) {
            out.push((path.clone(), place, value.as_str()));
        } else {
            refuse(&place, "is not of the form section.key=value");
        }
    }
    out
}

fn well_formed(path: &str) -> bool {
    let good = |step: &str| !step.is_empty() && !step.starts_with('[');
    path.len() <= 512 && path.split('.').all(good)
}

/// One step from a value to one below it.
#[derive(Debug, PartialEq)]
enum Step<'a> {
    Key(&'a str),
    Index(usize),
}

/// The steps of `flow.topics[0].match`; `flow.topics.0.match` is the same where a list stands.
fn steps(path: &str) -> Vec<Step<'_>> {
    let mut out = Vec::new();
    for part in path.split('.') {
        let (key, mut rest) = part.split_at(part.find('[').unwrap_or(part.len()));
        out.push(Step::Key(key));
        while let Some((index, behind)) =
            rest.strip_prefix('[').and_then(|rest| rest.split_once(']'))
        {
            match index.parse() {
                Ok(index) => out.push(Step::Index(index)),
                // No index: then it is part of a key, which no schema knows and which is refused by
                // name.
                Err(_) => out.push(Step::Key(index)),
            }
            rest = behind;
        }
    }
    out
}

/// The slot one step further, made where nothing stands. The error is a path and what is wrong
/// there.
fn descend<'v>(
    slot: &'v mut Value,
    step: &Step<'_>,
    at: String,
) -> Result<(&'v mut Value, String), (String, String)> {
    let index = match (step, &*slot) {
        (Step::Index(index), _) => Some(*index),
        (Step::Key(key), Value::Array(_)) => key.parse().ok(),
        (Step::Key(_), _) => None,
    };
    if slot.is_null() {
        *slot = match index {
            Some(_) => Value::Array(Vec::new()),
            None => Value::Object(Map::new()),
        };
    }
    match (slot, index, step) {
        (Value::Array(items), Some(index), _) => {
            if index > items.len() {
                return Err((
                    at,
                    format!("has {} entries, so the next one is [{}]", items.len(), items.len()),
                ));
            }
            if index == items.len() {
                items.push(Value::Null);
            }
            Ok((&mut items[index], format!("{at}[{index}]")))
        }
        (Value::Object(map), None, Step::Key(key)) => {
            let at = join(&at, key);
            Ok((map.entry(*key).or_insert(Value::Null), at))
        }
        (Value::Array(_), None, _) => Err((at, "is a list: give an index".to_owned())),
        _ => Err((at, "holds a value, so nothing can be set below it".to_owned())),
    }
}
