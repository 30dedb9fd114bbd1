//! Whether effective configurations keep to their size and match the schemas of their services.

use std::sync::Arc;

use blaze_domain::ServiceName;
use blaze_domain::config::spec::NODE_FILE_SECTIONS;
use blaze_domain::config::{Code, Document, FieldFault, Key, Kind, MAX_EFFECTIVE_BYTES};
use jsonschema::error::ValidationErrorKind;
use jsonschema::{ValidationError, Validator};
use serde_json::Value;

use super::affected::{MAX_CANDIDATES, touched};
use super::cost::{self, MAX_WORK, MAX_WORK_OF_ALL_FAULTS, MAX_WORK_OF_COMMIT, MAX_WORK_OF_FAULTS};
use super::effective::{At, Sources};
use super::schema::{Compiled, Schemas, with_placeholders};
use super::state::State;
use super::view::View;

/// Faults that are told, at most.
const MAX_FAULTS: usize = 20;
/// Steps that finding a schema again, or compiling it, counts as.
const STEPS_OF_SCHEMA: u64 = 10_000;
/// Steps that merging one value counts as.
const STEPS_OF_MERGE: u64 = 2;
/// Bytes of documents that can be gone through in one step.
const BYTES_PER_STEP: usize = 64;

impl Schemas {
    /// Checks every effective configuration that changed documents can concern: its size, and its service's schema. Of
    /// what is outside the view no more is told than that it would not do. What would take too long is refused: nothing is
    /// left unchecked.
    pub(crate) fn check_effective(&self, state: &State, keys: &[Key], view: &View) -> Vec<FieldFault> {
        self.check_within(state, keys, view, MAX_CANDIDATES, MAX_WORK_OF_COMMIT)
    }

    fn check_within(&self, state: &State, keys: &[Key], view: &View, places: usize, work: u64) -> Vec<FieldFault> {
        // Most writes concern no schema at all; to find the places that they touch would cost more than the write.
        let matters = |key: &&Key| {
            state.has_big()
                || match (key.kind(), key.service_name()) {
                    (Kind::Service, _) => state.has_schema(&ServiceName::from(key.name())),
                    (Kind::Instance, Some(service)) => state.has_schema(service),
                    _ => state.has_schemas(),
                }
        };
        let keys: Vec<Key> = keys.iter().filter(matters).cloned().collect();
        if keys.is_empty() {
            return Vec::new();
        }
        let is_wanted = |service: &ServiceName| state.has_big() || state.has_schema(service);
        let Some(found) = touched(state, &keys, &is_wanted, places) else {
            return vec![too_many()];
        };
        let mut check = Check {
            schemas: self,
            state,
            view,
            left: work,
            known: Vec::new(),
            is_refused_outside: false,
            faults: Vec::new(),
        };
        for at in &found {
            if check.faults.len() >= MAX_FAULTS {
                break;
            }
            if check.place(at).is_err() {
                check.faults.push(too_many());
                break;
            }
        }
        check.faults.truncate(MAX_FAULTS);
        check.faults
    }
}

/// There is more to check than one commit may take.
struct Exhausted;

/// A service as it was met, with its schema compiled.
type Known = (Arc<Document>, Option<Arc<Compiled>>);

/// A check of many places, one after the other.
struct Check<'c> {
    schemas: &'c Schemas,
    state: &'c State,
    view: &'c View,
    /// Steps that it may still take.
    left: u64,
    /// The service of the last place, as it is and as a roll-out makes it: places come by service.
    known: Vec<Known>,
    is_refused_outside: bool,
    faults: Vec<FieldFault>,
}

impl Check<'_> {
    fn take(&mut self, work: u64) -> Result<(), Exhausted> {
        self.left = self.left.checked_sub(work).ok_or(Exhausted)?;
        Ok(())
    }

    fn place(&mut self, at: &At) -> Result<(), Exhausted> {
        let is_seen = self.view.sees_place(self.state, at);
        if self.is_refused_outside && !is_seen {
            return Ok(());
        }
        let sources = Sources::at(self.state, at);
        let mut found = Vec::new();
        if self.state.has_big() {
            let bound = sources.size_bound();
            self.take(steps_of_bytes(bound))?;
            if bound > MAX_EFFECTIVE_BYTES {
                self.take(steps_of_bytes(bound))?;
                found.extend(size_fault(&sources, at));
            }
        }
        self.schema(&sources, at, &mut found)?;
        if is_seen {
            self.faults.append(&mut found);
        } else if !found.is_empty() {
            self.is_refused_outside = true;
            self.faults.push(FieldFault {
                pointer: "/spec".to_owned(),
                code: Code::SchemaMismatch,
                detail: "a service outside the token's layer does not take this".to_owned(),
                document: None,
            });
        }
        Ok(())
    }

    fn schema(&mut self, sources: &Sources, at: &At, found: &mut Vec<FieldFault>) -> Result<(), Exhausted> {
        // With what a roll-out makes of it there.
        let Some(service) = &sources.service else { return Ok(()) };
        let Some(schema) = service.spec_member("schema").filter(|schema| !schema.is_null()) else {
            return Ok(());
        };
        let Some(compiled) = self.compiled(service, schema)? else {
            return Ok(());
        };
        let (mut config, secrets) = with_placeholders(sources.merged());
        self.take(cost::values(&config).saturating_mul(STEPS_OF_MERGE))?;
        if let Value::Object(members) = &mut config {
            members.retain(|name, _| !NODE_FILE_SECTIONS.contains(&name.as_str()));
        }
        let values = cost::values(&config);
        let work = values.saturating_mul(compiled.steps());
        if work > MAX_WORK {
            found.push(too_costly(at, values, compiled.steps()));
            return Ok(());
        }
        self.take(work)?;
        let validator = compiled.validator(at.instance.is_some());
        if validator.is_valid(&config) {
            return Ok(());
        }
        if secrets.is_empty() && work > MAX_WORK_OF_FAULTS {
            found.push(some_fault(at));
            return Ok(());
        }
        // Once more, to tell what is wrong.
        self.take(work)?;
        // Whether the text of a secret has a length or matches a pattern is not told.
        let is_told = |error: &ValidationError<'_>| {
            !secrets.contains(error.instance_path().as_str())
                || matches!(
                    error.kind(),
                    ValidationErrorKind::Type { .. } | ValidationErrorKind::FalseSchema
                )
        };
        if work > MAX_WORK_OF_ALL_FAULTS {
            found.push(first_fault(validator, &config, at, is_told).unwrap_or_else(|| {
                // What is wrong beside the secret is not known, so it cannot be let through.
                too_costly(at, values, compiled.steps())
            }));
            return Ok(());
        }
        let errors = validator.iter_errors(&config).filter(is_told);
        let left = MAX_FAULTS.saturating_sub(self.faults.len());
        found.extend(errors.take(left).map(|error| mismatch(&error, at)));
        Ok(())
    }

    /// The schema of a service, compiled, if it can be.
    fn compiled(&mut self, service: &Arc<Document>, schema: &Value) -> Result<Option<Arc<Compiled>>, Exhausted> {
        self.known.retain(|(known, _)| known.key == service.key);
        let same = |(known, _): &&Known| Arc::ptr_eq(known, service) || known.spec_member("schema") == Some(schema);
        if let Some((_, compiled)) = self.known.iter().find(same) {
            return Ok(compiled.clone());
        }
        self.take(STEPS_OF_SCHEMA)?;
        let compiled = self.schemas.compiled(schema);
        if compiled.is_err() {
            // It was sound when it was written; a newer program may see it otherwise, and must not block every write.
            tracing::warn!(service = %service.key, "the stored schema cannot be compiled; it is not checked");
        }
        let compiled = compiled.ok();
        self.known.push((Arc::clone(service), compiled.clone()));
        Ok(compiled)
    }
}

fn steps_of_bytes(bytes: usize) -> u64 {
    u64::try_from(bytes / BYTES_PER_STEP).unwrap_or(u64::MAX)
}

/// A fault of which it would take too much to say where it is: a choice of subschemas tells what is wrong with each.
fn some_fault(at: &At) -> FieldFault {
    FieldFault {
        pointer: "/spec/config".to_owned(),
        code: Code::SchemaMismatch,
        detail: format!(
            "effective configuration of {}: it does not match the schema; the two are too large together to say where",
            described(at)
        ),
        document: None,
    }
}

/// The first fault, if it may be told.
fn first_fault(
    validator: &Validator,
    config: &Value,
    at: &At,
    is_told: impl Fn(&ValidationError<'_>) -> bool,
) -> Option<FieldFault> {
    let error = validator.validate(config).err()?;
    is_told(&error).then(|| mismatch(&error, at))
}

fn mismatch(error: &ValidationError<'_>, at: &At) -> FieldFault {
    let found: String = error.masked().to_string().chars().take(300).collect();
    FieldFault {
        pointer: format!("/spec/config{}", error.instance_path().as_str()),
        code: Code::SchemaMismatch,
        detail: format!("effective configuration of {}: {found}", described(at)),
        document: None,
    }
}

fn too_costly(at: &At, values: u64, steps: u64) -> FieldFault {
    FieldFault {
        pointer: "/spec/config".to_owned(),
        code: Code::ValidationFailed,
        detail: format!(
            "effective configuration of {}: too costly to check: {values} values, for each of which the schema takes up to \
             {steps} steps, together more than {MAX_WORK}; make the configuration smaller or the schema simpler",
            described(at)
        ),
        document: None,
    }
}

fn too_many() -> FieldFault {
    FieldFault {
        pointer: String::new(),
        code: Code::ValidationFailed,
        detail:
            "the change touches too many effective configurations to check them all at once: make it in parts, or make \
                 the schemas simpler"
                .to_owned(),
        document: None,
    }
}

fn size_fault(sources: &Sources, at: &At) -> Option<FieldFault> {
    let bytes = sources.merged().to_string().len();
    (bytes > MAX_EFFECTIVE_BYTES).then(|| FieldFault {
        pointer: "/spec/config".to_owned(),
        code: Code::ValidationFailed,
        detail: format!(
            "effective configuration of {}: {bytes} bytes, at most {MAX_EFFECTIVE_BYTES} are allowed",
            described(at)
        ),
        document: None,
    })
}

fn described(at: &At) -> String {
    let mut out = at.service.as_ref().map(ToString::to_string).unwrap_or_default();
    if let Some(instance) = &at.instance {
        out.push_str(&format!("/{instance}"));
    }
    match (&at.node, &at.layer) {
        (Some(node), _) => out.push_str(&format!(" on node {node}")),
        (None, Some(layer)) => out.push_str(&format!(" in layer {layer}")),
        (None, None) => {}
    }
    out
}

#[cfg(test)]
pub(super) mod tests {
    use blaze_domain::config::{Labels, Timestamp};
    use serde_json::json;

    use super::*;
    use crate::core::view::view;

    /// A document with nothing but its spec.
    pub(in crate::core) fn document(key: &str, spec: Value) -> Document {
        Document {
            key: key.parse().unwrap(),
            uid: key.to_owned(),
            revision: 1,
            create_time: Timestamp::default(),
            update_time: Timestamp::default(),
            updated_by: String::new(),
            labels: Labels::new(),
            annotations: Labels::new(),
            spec: Arc::new(spec),
            status: None,
        }
    }

    /// A service with a schema and another one without, each with so many instances.
    fn state(instances: usize) -> State {
        let schema = json!({ "properties": { "n": { "type": "integer" } } });
        let mut all = vec![
            document("Layer/edge", json!({ "kind": "edge" })),
            document("Service/plain", json!({})),
            document("Service/strict", json!({ "schema": schema })),
        ];
        for number in 0..instances {
            for service in ["plain", "strict"] {
                all.push(document(
                    &format!("Instance/{service}/i{number}"),
                    json!({ "layer": "edge" }),
                ));
            }
        }
        State::new(1, all)
    }

    #[test]
    fn places_of_services_without_schema_do_not_count_and_none_is_left_unchecked() {
        let (schemas, state) = (Schemas::default(), state(20));
        let whole = view(&crate::auth::dev::claims());
        let keys = ["Layer/edge".parse().unwrap()];
        let faults = |places, work| schemas.check_within(&state, &keys, &whole, places, work);
        // The instances and the service without instance.
        assert_eq!(faults(21, MAX_WORK_OF_COMMIT), []);
        let refused = faults(20, MAX_WORK_OF_COMMIT);
        assert_eq!(refused.len(), 1);
        assert!(refused[0].detail.contains("in parts"), "{refused:?}");
        // One schema for all of them, and less than that.
        assert_eq!(faults(100, STEPS_OF_SCHEMA + 1000), []);
        assert_eq!(faults(100, STEPS_OF_SCHEMA - 1).len(), 1);
        let refused = faults(100, STEPS_OF_SCHEMA + 20);
        assert!(refused[0].detail.contains("in parts"), "{refused:?}");
    }

    #[test]
    fn what_takes_too_many_steps_for_its_values_is_refused() {
        let (schemas, whole) = (Schemas::default(), view(&crate::auth::dev::claims()));
        let keys = ["Service/s".parse().unwrap()];
        let faults = |steps: usize, items: usize, item: Value| {
            let schema = json!({ "properties": { "list": { "items": { "allOf": vec![json!({ "type": "integer" }); steps] } } } });
            let config = json!({ "list": vec![item; items] });
            let service = document("Service/s", json!({ "schema": schema, "config": config }));
            let state = State::new(1, [document("Layer/edge", json!({ "kind": "edge" })), service]);
            schemas.check_effective(&state, &keys, &whole)
        };
        assert_eq!(faults(1000, 9000, json!(1)), []);
        let refused = faults(1000, 11_000, json!(1));
        assert!(refused[0].detail.contains("too costly"), "{refused:?}");
        // Many faults are not all collected, nor one that tells of many.
        assert_eq!(faults(1000, 9000, json!("x")).len(), 1);
        let choice = json!({ "anyOf": vec![json!({ "items": { "type": "integer" } }); 100] });
        let service = json!({ "schema": { "properties": { "list": choice } }, "config": { "list": vec!["x"; 1000] } });
        let layer = document("Layer/edge", json!({ "kind": "edge" }));
        let state = State::new(1, [layer, document("Service/s", service)]);
        let refused = schemas.check_effective(&state, &keys, &whole);
        assert!(
            refused.len() == 1 && refused[0].detail.contains("too large together"),
            "{refused:?}"
        );
        assert_eq!(faults(10, 9, json!("x")).len(), MAX_FAULTS);
        assert_eq!(faults(1, 9, json!("x")).len(), 9);
    }
}
