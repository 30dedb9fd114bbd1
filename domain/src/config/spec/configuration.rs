//! Configurations within documents: `config`, and `overrides` by service.

use serde_json::Value;

use super::fields::{At, Faults, Fields};
use super::{MAX_POINTER_BYTES, PROGRAMS, sections};
use crate::config::json;
use crate::config::secret::{self, Secret};
use crate::names::ServiceName;
use crate::node_file::words;

/// `config` and `overrides`, as far as the kind has them.
pub(super) fn check_configurations(spec: &Fields<'_>) {
    if let Some(at) = spec.get("config") {
        check_configuration(&at);
    }
    if let Some(at) = spec.get("overrides") {
        for (service, at) in at.entries() {
            check_override(service, &at);
            check_configuration(&at);
        }
    }
}

/// The service need not exist yet; a name that none can have is a slip.
pub(super) fn check_override(service: &str, at: &At<'_>) {
    match service.parse::<ServiceName>() {
        Ok(_) => check_program(service, &at.pointer, at.faults),
        Err(error) => {
            let shown: String = service.chars().take(64).collect();
            at.refuse::<()>(format!("the name of a service {}", words(&shown, &error)));
        }
    }
}

pub(super) fn check_configuration(at: &At<'_>) {
    let members = match at.value {
        Value::Object(members) if !secret::is_secret(at.value) => members,
        Value::Object(_) => {
            at.refuse::<()>(
                "is a secret as a whole; a configuration is an object, put $secret \
                below its members",
            );
            return;
        }
        _ => {
            at.expected::<()>("an object");
            return;
        }
    };
    let before = at.faults.count();
    check_values(at.value, &mut at.pointer.clone(), at.faults);
    if at.faults.count() == before {
        sections::check(members, &at.pointer, at.faults);
    }
}

fn check_values(value: &Value, pointer: &mut String, faults: &Faults) {
    if faults.are_enough() {
        return;
    }
    if pointer.len() > MAX_POINTER_BYTES {
        faults.add(pointer, format!("has a path of more than {MAX_POINTER_BYTES} bytes"));
        return;
    }
    match Secret::of(value) {
        Some(Ok(Secret::Text(_) | Secret::Redacted { .. } | Secret::Revealed { .. })) => return,
        Some(Ok(Secret::Stored { .. })) => {
            faults.add(
                pointer,
                "is a secret as the store alone writes it; write {\"$secret\":\"text\"}",
            );
            return;
        }
        Some(Err(detail)) => {
            faults.add(pointer, detail);
            return;
        }
        None => {}
    }
    match value {
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
        Value::Array(items) => {
            for (index, item) in items.iter().enumerate() {
                let length = json::append_index(pointer, index);
                check_values(item, pointer, faults);
                pointer.truncate(length);
            }
        }
        Value::Object(members) => {
            for (name, member) in members {
                let length = json::append(pointer, name);
                check_values(member, pointer, faults);
                pointer.truncate(length);
            }
        }
    }
}

/// Names of programs are theirs alone.
pub(super) fn check_program(service: &str, pointer: &str, faults: &Faults) {
    if service.starts_with("blaze-") && !PROGRAMS.contains(&service) {
        let programs = PROGRAMS.join(", ");
        faults.add(
            pointer,
            format!("{service:?} is reserved: names that begin with blaze- are {programs}"),
        );
    }
}
