//! The envelope of a document as it comes in requests.

use serde_json::{Map, Value};

use super::fields::{At, Faults};
use crate::config::{FieldFault, Key, Kind, Labels};
use crate::names::{DocumentName, ServiceName};

/// Members of the envelope that a user writes.
const WRITTEN: &[&str] = &["kind", "name", "service", "labels", "annotations", "spec"];
/// The same in `apply`, where a document says itself what is to be done with it.
const APPLIED: &[&str] = &["kind", "name", "service", "labels", "annotations", "spec", "delete"];
/// Members that the server sets; in requests they are ignored.
const SERVER_SET: [&str; 6] =
    ["uid", "revision", "create_time", "update_time", "updated_by", "status"];

/// A document as a request gives it. What the path says is filled in.
#[derive(Debug, Clone, PartialEq)]
pub struct Envelope {
    /// `kind`.
    pub kind: Option<Kind>,
    /// `name`, of the right form.
    pub name: Option<String>,
    /// `service`, of the right form.
    pub service: Option<String>,
    /// `labels`; absent: none. Their form is checked with the spec.
    pub labels: Labels,
    /// `annotations`; absent: none. Their form is checked with the spec.
    pub annotations: Labels,
    /// `spec`, an object; empty where it may be absent.
    pub spec: Value,
    /// `revision`: what `apply` takes as the document's precondition.
    pub revision: Option<u64>,
    /// `delete`, in `apply`.
    pub delete: bool,
}

impl Envelope {
    /// Kind and name of the document.
    ///
    /// # Errors
    /// `kind` or `name` is missing, or `service` of an instance is, or something else has a
    /// service.
    pub fn key(&self) -> Result<Key, Vec<FieldFault>> {
        let faults = Faults::default();
        let key = self.read_key(&faults);
        key.ok_or_else(|| faults.into_vec())
    }

    fn read_key(&self, faults: &Faults) -> Option<Key> {
        let required = |pointer: &str, is_there: bool| {
            if !is_there {
                faults.add(pointer, "is required");
            }
        };
        required("/kind", self.kind.is_some());
        required("/name", self.name.is_some());
        let name =
            self.name.as_deref().and_then(|name| named::<DocumentName>("/name", name, faults));
        let service =
            self.service.as_deref().and_then(|name| named::<ServiceName>("/service", name, faults));
        match (self.kind?, service) {
            (Kind::Instance, None) if self.service.is_none() => {
                faults.add("/service", "is required of an Instance");
                None
            }
            (Kind::Instance, service) => Some(Key::instance(service?, name?)),
            (kind, _) if self.service.is_some() => {
                faults.add("/service", format!("a {kind} has no service"));
                None
            }
            (kind, _) => Key::new(kind, None, name?).ok(),
        }
    }
}

fn named<T: std::str::FromStr<Err: std::fmt::Display>>(
    pointer: &str,
    name: &str,
    faults: &Faults,
) -> Option<T> {
    At::new(&Value::from(name), pointer, faults).parsed()
}

/// What the path of a request says of its document.
#[derive(Default)]
struct Path<'p> {
    kind: Option<Kind>,
    service: Option<&'p str>,
    name: Option<&'p str>,
}

/// Reads the envelope of a request body: of a document whose key the path names, or, without
/// `expected`, of one that says itself which it is (`apply`).
///
/// # Errors
/// Every fault: unknown members, wrong types, names that break the rules, a `kind`, `name` or
/// `service` that contradicts the path, no `spec`.
pub fn parse_envelope(value: Value, expected: Option<&Key>) -> Result<Envelope, Vec<FieldFault>> {
    let path = expected.map_or_else(Path::default, |key| Path {
        kind: Some(key.kind()),
        service: key.service_name().map(ServiceName::as_str),
        name: Some(key.name().as_str()),
    });
    read(value, &path)
}

/// Reads the envelope of a new document, of which the path names the collection alone.
///
/// # Errors
/// As [`parse_envelope`].
pub fn parse_new(
    value: Value,
    kind: Kind,
    service: Option<&ServiceName>,
) -> Result<Envelope, Vec<FieldFault>> {
    let path = Path { kind: Some(kind), service: service.map(ServiceName::as_str), name: None };
    read(value, &path)
}

fn read(mut value: Value, path: &Path<'_>) -> Result<Envelope, Vec<FieldFault>> {
    let revision = server_set(&mut value);
    let spec = value.get_mut("spec").map(Value::take);
    let faults = Faults::default();
    let envelope = read_members(&value, path, &faults);
    let (is_spec_there, is_apply) = (spec.is_some(), path.kind.is_none());
    let spec = spec.unwrap_or_else(|| Value::Object(Map::new()));
    if !spec.is_object() {
        At::new(&spec, "/spec", &faults).expected::<()>("an object");
    }
    let deletes = envelope.as_ref().is_some_and(|envelope| envelope.delete);
    if value.is_object() && !is_spec_there && !deletes {
        faults.add("/spec", "is required");
    }
    let revision = revision.and_then(|revision| match revision.as_u64() {
        None if is_apply => At::new(&revision, "/revision", &faults).expected("a revision"),
        revision => revision,
    });
    match envelope {
        Some(envelope) if faults.count() == 0 => Ok(Envelope { spec, revision, ..envelope }),
        _ => Err(faults.into_vec()),
    }
}

/// Takes out what the server sets; gives the revision.
fn server_set(value: &mut Value) -> Option<Value> {
    let members = value.as_object_mut()?;
    let revision = members.get_mut("revision").map(Value::take);
    members.retain(|name, _| !SERVER_SET.contains(&name.as_str()));
    revision
}

/// Everything but the spec and the revision.
fn read_members(value: &Value, path: &Path<'_>, faults: &Faults) -> Option<Envelope> {
    let is_apply = path.kind.is_none();
    let fields = At::new(value, "", faults).fields(if is_apply { APPLIED } else { WRITTEN })?;
    let kind = fields.get("kind").and_then(|at| at.parsed::<Kind>().map(|kind| (kind, at)));
    let name = fields.get("name").and_then(|at| at.parsed::<DocumentName>().map(|name| (name, at)));
    let service =
        fields.get("service").and_then(|at| at.parsed::<ServiceName>().map(|name| (name, at)));
    if let Some((kind, at)) = &kind {
        contradiction(path.kind.map(Kind::as_str), kind.as_str(), at);
    }
    if let Some((name, at)) = &name {
        contradiction(path.name, name.as_str(), at);
    }
    if let Some((service, at)) = &service {
        match path.kind {
            Some(kind) if kind != Kind::Instance => {
                at.refuse::<()>(format!("a {kind} has no service"))
            }
            _ => contradiction(path.service, service.as_str(), at),
        };
    }
    let texts = |name: &str| fields.get(name).map(|at| labels(&at)).unwrap_or_default();
    let delete = fields.get("delete").is_some_and(|at| match at.value {
        Value::Bool(delete) => *delete,
        _ => at.expected("true or false").unwrap_or(false),
    });
    let text = |given: Option<&str>, of_path: Option<&str>| given.or(of_path).map(str::to_owned);
    Some(Envelope {
        kind: kind.map(|(kind, _)| kind).or(path.kind),
        name: text(name.as_ref().map(|(name, _)| name.as_str()), path.name),
        service: text(service.as_ref().map(|(service, _)| service.as_str()), path.service),
        labels: texts("labels"),
        annotations: texts("annotations"),
        spec: Value::Null,
        revision: None,
        delete,
    })
}

fn contradiction(of_path: Option<&str>, given: &str, at: &At<'_>) -> Option<()> {
    match of_path {
        Some(of_path) if of_path != given => {
            at.refuse(format!("is {given:?}, but the path says {of_path:?}"))
        }
        _ => Some(()),
    }
}

/// Labels or annotations; their form is checked with the spec.
fn labels(at: &At<'_>) -> Labels {
    let entry = |(key, at): (&str, At<'_>)| Some((key.to_owned(), at.text(usize::MAX)?.to_owned()));
    at.entries().into_iter().filter_map(entry).collect()
}
