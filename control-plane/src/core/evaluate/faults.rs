//! What is wrong with a request, as far as it is told.

use blaze_domain::config::{Code, FieldFault, Key, Problem};

use super::super::view::View;
use super::Form;
use blaze_domain::config::state::State;

/// Faults of one answer, at most.
const MAX_FAULTS: usize = 100;
/// Referrers that are named in a refusal.
const NAMED: usize = 5;
/// The same that are counted.
pub(super) const COUNTED: usize = 1000;

pub(in crate::core) fn invalid(pointer: &str, detail: &str) -> FieldFault {
    FieldFault {
        pointer: pointer.to_owned(),
        code: Code::ValidationFailed,
        detail: detail.to_owned(),
        document: None,
    }
}

pub(super) fn twice(key: &Key) -> FieldFault {
    invalid("/name", &format!("{key} stands in the request twice"))
}

pub(super) fn not_found(key: &Key) -> Problem {
    Problem::new(Code::NotFound, format!("there is no {key}"))
}

/// Names referrers as far as the token sees them, before the change (where what they stand on is
/// there) or after it. How many there are besides is nothing to who does not see them.
pub(super) fn in_use(key: &Key, referrers: &[Key], states: [&State; 2], view: &View) -> Problem {
    let is_seen = |key: &&Key| {
        states.iter().any(|state| {
            let held = state.get(key);
            held.is_some_and(|held| view.sees_document(state, &held.document))
        })
    };
    let seen = referrers.iter().filter(is_seen).count();
    let named = referrers.iter().filter(is_seen).take(NAMED);
    let mut named: Vec<String> = named.map(ToString::to_string).collect();
    match seen - named.len() {
        0 => {}
        1 => named.push("1 other".to_owned()),
        others if referrers.len() == COUNTED => named.push(format!("{others} or more others")),
        others => named.push(format!("{others} others")),
    }
    if seen < referrers.len() {
        named.push("documents that the token does not see".to_owned());
    }
    let detail = format!(
        "{key} is referred to by {}: delete those first, or use cascade=true",
        named.join(", ")
    );
    Problem::new(Code::InUse, detail)
}

/// Faults of the documents of one request: all that are invalid first, then all that conflict.
pub(super) struct Faults {
    form: Form,
    invalid: Vec<FieldFault>,
    conflicts: Vec<(usize, Problem)>,
}

impl Faults {
    pub(super) fn new(form: Form) -> Self {
        Self { form, invalid: Vec::new(), conflicts: Vec::new() }
    }

    /// How many more are told.
    pub(super) fn room(&self) -> usize {
        MAX_FAULTS - self.invalid.len().min(MAX_FAULTS)
    }

    pub(super) fn add(&mut self, index: usize, mut fault: FieldFault) {
        if self.room() == 0 {
            return;
        }
        if self.form == Form::Many {
            fault.document = Some(index);
        }
        self.invalid.push(fault);
    }

    pub(super) fn has_room_for_conflicts(&self) -> bool {
        self.conflicts.len() < MAX_FAULTS
    }

    pub(super) fn conflict(&mut self, index: usize, problem: Problem) {
        if self.has_room_for_conflicts() {
            self.conflicts.push((index, problem));
        }
    }

    /// A refusal of one document: of many, all are told; of one, it is the answer.
    pub(super) fn problem(&mut self, index: usize, problem: Problem) -> Result<(), Problem> {
        if self.form != Form::Many || !matches!(problem.code.http_status(), Some(409 | 422)) {
            return Err(problem);
        }
        if problem.code.http_status() == Some(409) {
            self.conflict(index, problem);
        } else {
            problem.errors.into_iter().for_each(|fault| self.add(index, fault));
        }
        Ok(())
    }

    pub(super) fn finish_invalid(&mut self) -> Result<(), Problem> {
        if self.invalid.is_empty() {
            return Ok(());
        }
        Err(Problem::faults(std::mem::take(&mut self.invalid)))
    }

    pub(super) fn finish_conflicts(&mut self) -> Result<(), Problem> {
        let Some((_, first)) = self.conflicts.first() else {
            return Ok(());
        };
        let mut problem = first.clone();
        if self.form == Form::Many {
            let fault = |(index, problem): &(usize, Problem)| FieldFault {
                pointer: String::new(),
                code: problem.code,
                detail: problem.detail.clone(),
                document: Some(*index),
            };
            problem.errors = self.conflicts.iter().map(fault).collect();
        }
        Err(problem)
    }
}
