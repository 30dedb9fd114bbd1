//! Whether effective configurations keep to their size and match the schemas of their services.

use std::collections::HashSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_domain::config::spec::NODE_FILE_SECTIONS;
use blaze_domain::config::{Code, Document, FieldFault, Key, Kind, MAX_EFFECTIVE_BYTES};
use blaze_domain::{LayerName, NodeName, ServiceName};
use jsonschema::ValidationError;
use jsonschema::error::ValidationErrorKind;
use serde_json::Value;

use super::affected::{MAX_CANDIDATES, touched};
use super::cost::{MAX_WORK, MAX_WORK_OF_FAULTS, values};
use super::pattern;
use super::schema::{Compiled, Schemas, with_placeholders};
use super::view::View;
use blaze_domain::config::effective::{ConfigTarget, Sources};
use blaze_domain::config::state::State;

/// Faults that are told, at most.
const MAX_FAULTS: usize = 20;
/// How long the schemas and the effective configurations of one commit are checked: nobody else can
/// write meanwhile.
pub(super) const TIME: Duration = Duration::from_secs(8);

/// The deadline of a check came.
struct TooLate;

impl Schemas {
    /// Checks every effective configuration that changed documents can concern: its size, and its
    /// service's schema. Of what is outside the view no more is told than that it would not do.
    /// What would take too long is refused: nothing is left unchecked, but for what was too costly
    /// before the change.
    pub(crate) fn check_effective(
        &self,
        before: &State,
        state: &State,
        keys: &[Key],
        view: &View,
        deadline: Instant,
    ) -> Vec<FieldFault> {
        self.check_within([before, state], keys, view, MAX_CANDIDATES, deadline)
    }

    fn check_within(
        &self,
        [before, state]: [&State; 2],
        keys: &[Key],
        view: &View,
        places: usize,
        deadline: Instant,
    ) -> Vec<FieldFault> {
        // Most writes concern no schema at all; to find the places that they touch would cost more
        // than the write.
        let matters = |key: &&Key| {
            if is_other_in_name_only(before, state, key) {
                return false;
            }
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
            before,
            state,
            view,
            deadline,
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

/// Whether a document is as it was in all that configurations are made of: its labels place
/// nothing, but a roll-out finds its nodes by them.
fn is_other_in_name_only(before: &State, after: &State, key: &Key) -> bool {
    let (Some(was), Some(is)) = (before.get(key), after.get(key)) else {
        return false;
    };
    key.kind() != Kind::Node
        && was.document.spec == is.document.spec
        && was.document.status == is.document.status
}

/// A service as it was met, with its schema compiled.
type Known = (Arc<Document>, Option<Arc<Compiled>>);

/// A check of many places, one after the other.
struct Check<'c> {
    schemas: &'c Schemas,
    before: &'c State,
    state: &'c State,
    view: &'c View,
    deadline: Instant,
    /// The service of the last place, as it is and as a roll-out makes it: places come by service.
    known: Vec<Known>,
    is_refused_outside: bool,
    faults: Vec<FieldFault>,
}

impl Check<'_> {
    fn place(&mut self, at: &ConfigTarget) -> Result<(), TooLate> {
        if Instant::now() >= self.deadline {
            return Err(TooLate);
        }
        let is_seen = self.view.sees_place(self.state, at);
        if self.is_refused_outside && !is_seen {
            return Ok(());
        }
        let sources = Sources::at(self.state, at);
        let mut found = Vec::new();
        if self.state.has_big() && sources.size_bound() > MAX_EFFECTIVE_BYTES {
            found.extend(size_fault(&sources, at));
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

    fn schema(
        &mut self,
        sources: &Sources,
        at: &ConfigTarget,
        found: &mut Vec<FieldFault>,
    ) -> Result<(), TooLate> {
        let Some(compiled) = self.compiled(sources) else {
            return Ok(());
        };
        let (config, secrets) = checked(sources);
        let work = work(&compiled, &config);
        if work > MAX_WORK {
            if self.was_too_costly(at) {
                tracing::warn!(
                    place = described(at),
                    "the configuration is too costly to check, as it was before; it is not checked"
                );
            } else {
                found.push(too_costly(at, compiled.steps, values(&config)));
            }
            return Ok(());
        }
        let validator = compiled.validator(at.instance.is_some());
        if pattern::within(self.deadline, || validator.is_valid(&config)).ok_or(TooLate)? {
            return Ok(());
        }
        if work > MAX_WORK_OF_FAULTS {
            found.push(some_fault(at));
            return Ok(());
        }
        // What a secret is, beyond that it is a text, is not told.
        let is_told = |error: &ValidationError<'_>| {
            !secrets.contains(error.instance_path().as_str())
                || matches!(
                    error.kind(),
                    ValidationErrorKind::Type { .. } | ValidationErrorKind::FalseSchema
                )
        };
        let left = MAX_FAULTS.saturating_sub(self.faults.len());
        let faults = || -> Vec<FieldFault> {
            let errors = validator.iter_errors(&config).filter(is_told);
            errors.take(left).map(|error| mismatch(&error, at)).collect()
        };
        found
            .extend(pattern::within(self.deadline, faults).unwrap_or_else(|| vec![some_fault(at)]));
        Ok(())
    }

    /// Whether the configuration of a place was too costly to check before the change already:
    /// stored when more was allowed, it must not stand in the way of other changes.
    fn was_too_costly(&mut self, at: &ConfigTarget) -> bool {
        is_place(self.before, at) && {
            let sources = Sources::at(self.before, at);
            let compiled = self.compiled(&sources);
            compiled.is_some_and(|compiled| work(&compiled, &checked(&sources).0) > MAX_WORK)
        }
    }

    /// The schema of a place's service, with what a roll-out makes of it there, compiled, if it can
    /// be.
    fn compiled(&mut self, sources: &Sources) -> Option<Arc<Compiled>> {
        let service = sources.service.as_ref()?;
        let schema = service.spec_member("schema").filter(|schema| !schema.is_null())?;
        self.known.retain(|(known, _)| known.key == service.key);
        let same = |(known, _): &&Known| {
            Arc::ptr_eq(known, service) || known.spec_member("schema") == Some(schema)
        };
        if let Some((_, compiled)) = self.known.iter().find(same) {
            return compiled.clone();
        }
        let compiled = self.schemas.compiled(schema).inspect_err(|reason| {
            // It was sound when it was written; a newer program may see it otherwise, and must not
            // block every write.
            tracing::warn!(
                service = %service.key,
                reason,
                "the stored schema cannot be compiled; it is not checked",
            );
        });
        let compiled = compiled.ok();
        self.known.push((Arc::clone(service), compiled.clone()));
        compiled
    }
}

/// Steps that a check takes, at most.
fn work(compiled: &Compiled, config: &Value) -> u64 {
    compiled.steps.saturating_mul(values(config))
}

/// The configuration that a schema is about, and where its secrets are.
fn checked(sources: &Sources) -> (Value, HashSet<String>) {
    let (mut config, secrets) = with_placeholders(sources.merged());
    if let Value::Object(members) = &mut config {
        members.retain(|name, _| !NODE_FILE_SECTIONS.contains(&name.as_str()));
    }
    (config, secrets)
}

/// Whether a place is one whose configuration is checked: the instance is placed there, or the
/// service may be seen there.
fn is_place(state: &State, at: &ConfigTarget) -> bool {
    let Some(service) = &at.service else { return false };
    if let Some(instance) = &at.instance {
        let held = state.get(&Key::instance(service.clone(), instance.clone()));
        return held.is_some_and(|held| Sources::placed(state, service, &held.document) == *at);
    }
    let is_seen = |layer: &LayerName| {
        let service = state.get(&Key::service(service));
        service.is_some_and(|held| held.document.is_for_layer(layer.as_str()))
            && state.get(&Key::layer(layer)).is_some()
    };
    let is_there = |node: &NodeName| {
        let held = state.get(&Key::node(node));
        held.is_some_and(|held| {
            held.document.spec_layer() == at.layer.as_ref().map(LayerName::as_str)
        })
    };
    at.layer.as_ref().is_some_and(is_seen) && at.node.as_ref().is_none_or(is_there)
}

/// A fault of which it would take too much to say where it is: a choice of subschemas tells what is
/// wrong with each.
fn some_fault(at: &ConfigTarget) -> FieldFault {
    FieldFault {
        pointer: "/spec/config".to_owned(),
        code: Code::SchemaMismatch,
        detail: format!(
            "effective configuration of {}: it does not match the schema; the two are too large \
             together to say where (of a \
             secret, `const` and `enum` do not hold)",
            described(at)
        ),
        document: None,
    }
}

fn mismatch(error: &ValidationError<'_>, at: &ConfigTarget) -> FieldFault {
    let found: String = error.masked().to_string().chars().take(300).collect();
    FieldFault {
        pointer: format!("/spec/config{}", error.instance_path().as_str()),
        code: Code::SchemaMismatch,
        detail: format!("effective configuration of {}: {found}", described(at)),
        document: None,
    }
}

fn too_costly(at: &ConfigTarget, steps: u64, values: u64) -> FieldFault {
    FieldFault {
        pointer: "/spec/config".to_owned(),
        code: Code::ValidationFailed,
        detail: format!(
            "effective configuration of {}: too costly to check: {values} values, for each of \
             which the schema takes up to \
             {steps} steps, are more than {MAX_WORK} steps; make the configuration smaller or the \
             schema simpler",
            described(at)
        ),
        document: None,
    }
}

/// Refuses what cannot be checked in [`TIME`].
pub(super) fn too_many() -> FieldFault {
    FieldFault {
        pointer: String::new(),
        code: Code::ValidationFailed,
        detail: "the change takes too long to check: make it in parts, or make the schemas or the \
                 texts that they match \
                 simpler"
            .to_owned(),
        document: None,
    }
}

fn size_fault(sources: &Sources, at: &ConfigTarget) -> Option<FieldFault> {
    let bytes = sources.merged().to_string().len();
    (bytes > MAX_EFFECTIVE_BYTES).then(|| FieldFault {
        pointer: "/spec/config".to_owned(),
        code: Code::ValidationFailed,
        detail: format!(
            "effective configuration of {}: {bytes} bytes, at most {MAX_EFFECTIVE_BYTES} are \
             allowed",
            described(at)
        ),
        document: None,
    })
}

fn described(at: &ConfigTarget) -> String {
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

    fn schema() -> Value {
        json!({ "properties": { "n": { "type": "integer" } } })
    }

    /// A service with a schema and another one without, each with so many instances.
    fn state(instances: usize) -> State {
        let mut all = vec![
            document("Layer/edge", json!({ "kind": "edge" })),
            document("Service/plain", json!({})),
            document("Service/strict", json!({ "schema": schema() })),
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

    fn later() -> Instant {
        Instant::now() + Duration::from_secs(3600)
    }

    #[test]
    fn places_of_services_without_schema_do_not_count_and_none_is_left_unchecked() {
        let (schemas, state) = (Schemas::default(), state(20));
        let whole = view(&crate::auth::dev::claims());
        let keys = ["Layer/edge".parse().unwrap()];
        let before = State::new(0, []);
        let faults = |places, deadline| {
            schemas.check_within([&before, &state], &keys, &whole, places, deadline)
        };
        // The instances and the service without instance.
        assert_eq!(faults(21, later()), []);
        for refused in [faults(20, later()), faults(21, Instant::now())] {
            assert_eq!(refused.len(), 1);
            assert!(refused[0].detail.contains("in parts"), "{refused:?}");
        }
    }

    /// What is wrong with a service that is written, alone in its layer.
    fn faults_of(spec: Value) -> Vec<FieldFault> {
        faults_after(&State::new(0, []), spec)
    }

    fn faults_after(before: &State, spec: Value) -> Vec<FieldFault> {
        let keys = ["Service/s".parse().unwrap()];
        let whole = view(&crate::auth::dev::claims());
        Schemas::default().check_effective(before, &with_service(spec), &keys, &whole, later())
    }

    fn with_service(spec: Value) -> State {
        let layer = document("Layer/edge", json!({ "kind": "edge" }));
        State::new(1, [layer, document("Service/s", spec)])
    }

    #[test]
    fn what_takes_too_many_steps_for_its_values_is_refused() {
        let faults = |steps: usize, items: usize, item: Value| {
            let schema = json!({ "properties": { "list": { "items": { "allOf": vec![json!({ "type": "integer" }); steps] } } } });
            faults_of(json!({ "schema": schema, "config": { "list": vec![item; items] } }))
        };
        assert_eq!(faults(1000, 9000, json!(1)), []);
        let refused = faults(1000, 11_000, json!(1));
        assert!(refused[0].detail.contains("too costly"), "{refused:?}");
        // Many faults are not all collected, nor one that tells of many.
        assert_eq!(faults(1000, 9000, json!("x")).len(), 1);
        let choice = json!({ "anyOf": vec![json!({ "items": { "type": "integer" } }); 100] });
        let refused = faults_of(json!({
            "schema": { "properties": { "list": choice } },
            "config": { "list": vec!["x"; 1000] },
        }));
        assert!(
            refused.len() == 1 && refused[0].detail.contains("too large together"),
            "{refused:?}"
        );
        assert_eq!(faults(10, 9, json!("x")).len(), MAX_FAULTS);
        assert_eq!(faults(1, 9, json!("x")).len(), 9);
    }

    #[test]
    fn texts_that_take_long_to_match_are_refused_at_the_deadline() {
        let hostile = json!({ "items": { "not": { "pattern": "(a|b)*a(a|b){300}c$" } } });
        let list = vec!["ab".repeat(1000); 100];
        let spec =
            json!({ "schema": { "properties": { "list": hostile } }, "config": { "list": list } });
        let keys = ["Service/s".parse().unwrap()];
        let whole = view(&crate::auth::dev::claims());
        let faults = |deadline| {
            let after = with_service(spec.clone());
            Schemas::default().check_effective(&State::new(0, []), &after, &keys, &whole, deadline)
        };
        // It has passed: how fast this machine matches must not decide.
        let refused = faults(Instant::now());
        assert!(refused.len() == 1 && refused[0].detail.contains("too long"), "{refused:?}");
        assert_eq!(faults(later()), []);
    }

    #[test]
    fn what_was_too_costly_before_stands_in_nobodys_way() {
        let steps = |count: usize| json!({ "items": { "allOf": vec![json!({ "type": "integer" }); count] } });
        let service = |schema: Value, items: usize, rate: u64| {
            json!({
                "schema": { "properties": { "list": schema } },
                "config": { "list": vec![1; items], "rate": rate },
            })
        };
        let before = with_service(service(steps(1000), 11_000, 1));
        assert_eq!(faults_after(&before, service(steps(1000), 11_000, 2)), []);
        let cheap = with_service(service(steps(1000), 1000, 1));
        assert_eq!(faults_after(&cheap, service(steps(1000), 11_000, 2)).len(), 1);
        // Where it could not be seen before it was not checked either.
        let mut unseen = service(steps(1000), 11_000, 1);
        unseen["layers"] = json!([]);
        assert_eq!(faults_after(&with_service(unseen), service(steps(1000), 11_000, 2)).len(), 1);
    }

    #[test]
    fn a_secret_fits_a_costly_schema() {
        let items = json!({ "items": { "allOf": vec![json!({ "type": "integer" }); 1000] } });
        let secret = json!({ "type": "string", "minLength": 100, "pattern": "^key-" });
        let schema = json!({ "properties": { "list": items, "key": secret } });
        let config = |item: Value| json!({ "list": vec![item; 2000], "key": { "$secret": "x" } });
        assert_eq!(faults_of(json!({ "schema": schema, "config": config(json!(1)) })), []);
        let refused = faults_of(json!({ "schema": schema, "config": config(json!("x")) }));
        assert!(
            refused.len() == 1 && refused[0].detail.contains("too large together"),
            "{refused:?}"
        );
    }

    #[test]
    fn a_change_of_names_alone_is_not_checked_but_of_a_node() {
        let whole = view(&crate::auth::dev::claims());
        let labelled = |key: &str, spec: Value| Document {
            labels: Labels::from([("site".to_owned(), "two".to_owned())]),
            ..document(key, spec)
        };
        let strict = document(
            "Service/s",
            json!({ "schema": { "properties": { "n": false } }, "config": { "n": 1 } }),
        );
        let layer = json!({ "kind": "edge" });
        let node = json!({ "layer": "edge", "type": "static", "config": { "s": 1 } });
        let before = State::new(
            1,
            [
                strict.clone(),
                document("Layer/edge", layer.clone()),
                document("Node/n", node.clone()),
            ],
        );
        let after =
            State::new(2, [strict, labelled("Layer/edge", layer), labelled("Node/n", node)]);
        let faults = |key: &str| {
            let keys = [key.parse().unwrap()];
            Schemas::default().check_effective(&before, &after, &keys, &whole, later()).len()
        };
        assert_eq!((faults("Layer/edge"), faults("Node/n")), (0, 1));
    }
}
