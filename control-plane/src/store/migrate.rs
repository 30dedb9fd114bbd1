//! How a store gets from one schema to the next.
//!
//! ```text
//! migrations/NNNN_name.{sql,mongodb.json}  ──▶ steps, in order, each idempotent
//! store: which steps are done, with the checksum of their migration; min_version
//! open: refuse what is too new or was changed ─▶ do the next step ─▶ record it ─▶ …
//! ```
//!
//! A migration is never changed once it was released: its checksum is in every store that it was
//! applied to. A schema changes by expanding first (new things beside the old, `min_version` stays,
//! so that programs of the version before run on) and contracting in a later release (`min_version`
//! rises, and older programs refuse to start).

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::Arc;

use async_trait::async_trait;
use blaze_domain::config::Document;
use sha2::{Digest as _, Sha256};

use super::StoreError;

/// One change of the schema, in both kinds of stores.
#[derive(Debug, Clone)]
pub struct Migration {
    /// Its place in the order; the first is 1.
    pub number: u32,
    /// What it does, in a word.
    pub name: Cow<'static, str>,
    /// Programs whose newest migration is older than this cannot use the store afterwards.
    pub min_version: u32,
    /// Its steps on SQLite.
    pub sqlite: Vec<Step>,
    /// Its steps on MongoDB.
    pub mongodb: Vec<Step>,
}

/// What is done and then recorded. It may be done twice: a process can die between the two.
#[derive(Debug, Clone)]
pub struct Step {
    /// For people.
    pub name: Cow<'static, str>,
    /// What to do.
    pub action: Action,
}

/// What a step does.
#[derive(Debug, Clone)]
pub enum Action {
    /// SQL statements, in one transaction (SQLite).
    Sql(Cow<'static, str>),
    /// A database command as JSON (MongoDB): one that does nothing when it is done again.
    Command(Cow<'static, str>),
    /// Each document and each version of one is replaced by what the function makes of it; `None`
    /// leaves it. The function leaves what it has made.
    Rewrite {
        /// Stands for the function in the checksum.
        text: Cow<'static, str>,
        /// Makes the new form.
        function: fn(&Document) -> Option<Document>,
    },
}

/// Which kind of store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StoreKind {
    Sqlite,
    #[cfg_attr(not(feature = "mongodb"), expect(dead_code, reason = "its store is not built"))]
    MongoDb,
}

/// Called after each step was recorded, with `number name/step`. For tests that end the process
/// there.
pub type AfterStep = Arc<dyn Fn(&str) + Send + Sync>;

/// The migrations that a program knows.
#[derive(Clone)]
pub struct Migrations {
    all: Vec<Migration>,
    after_step: Option<AfterStep>,
}

impl Default for Migrations {
    /// Those of this program.
    fn default() -> Self {
        Self { all: vec![first()], after_step: None }
    }
}

impl Migrations {
    /// With further ones behind those of the program, for tests.
    #[must_use]
    pub fn and(mut self, further: impl IntoIterator<Item = Migration>) -> Self {
        self.all.extend(further);
        self
    }

    /// With something to do after each step, for tests.
    #[must_use]
    pub fn after_step(mut self, call: AfterStep) -> Self {
        self.after_step = Some(call);
        self
    }

    /// The number of the newest.
    #[must_use]
    pub fn version(&self) -> u32 {
        self.all.iter().map(|migration| migration.number).max().unwrap_or(0)
    }
}

/// What there is to do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Plan {
    /// Number of the newest migration that is wholly applied.
    pub version: u32,
    /// Number of the newest that this program knows.
    pub target: u32,
    /// Steps that are to be done, as `number name/step`.
    pub pending: Vec<String>,
}

/// A step that was done, as the store has it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Done {
    pub(crate) number: u32,
    /// Place among the steps of its migration, from 0.
    pub(crate) step: u32,
    pub(crate) name: String,
    pub(crate) checksum: String,
}

/// A store that migrations are applied to.
#[async_trait]
pub(crate) trait Target: Send + Sync {
    fn kind(&self) -> StoreKind;

    /// Steps that were done, and the smallest version of programs that may use the store.
    async fn state(&self) -> Result<(Vec<Done>, u32), StoreError>;

    /// Does a step, then records it.
    async fn perform(&self, action: &Action, done: &Done) -> Result<(), StoreError>;

    /// Raises the smallest version of programs that may use the store.
    async fn raise_min_version(&self, version: u32) -> Result<(), StoreError>;
}

/// What is to be done on a store.
///
/// # Errors
/// [`StoreError::Refused`] if the store is too new for this program, or a migration was changed
/// after it was applied.
pub(crate) async fn plan(target: &dyn Target, migrations: &Migrations) -> Result<Plan, StoreError> {
    let (done, min_version) = target.state().await?;
    let pending = pending(target.kind(), migrations, &done, min_version)?;
    let complete =
        |migration: &&Migration| !pending.iter().any(|step| step.done.number == migration.number);
    let version =
        migrations.all.iter().take_while(complete).map(|migration| migration.number).max();
    Ok(Plan {
        version: version.unwrap_or(0),
        target: migrations.version(),
        pending: pending.iter().map(PendingStep::label).collect(),
    })
}

/// Does what is to be done. Returns the labels of the steps.
///
/// # Errors
/// As [`plan`], and when a step fails: what was done before stays, and the next call goes on from
/// there.
pub(crate) async fn apply(
    target: &dyn Target,
    migrations: &Migrations,
) -> Result<Vec<String>, StoreError> {
    let (done, min_version) = target.state().await?;
    let mut labels = Vec::new();
    for step in pending(target.kind(), migrations, &done, min_version)? {
        let label = step.label();
        tracing::info!(step = label, "migrating the store");
        // Programs that would not understand must not start from now on, so this comes before.
        if step.done.step == 0 && step.min_version > min_version {
            target.raise_min_version(step.min_version).await?;
        }
        target.perform(&step.action, &step.done).await?;
        if let Some(call) = &migrations.after_step {
            call(&label);
        }
        labels.push(label);
    }
    Ok(labels)
}

struct PendingStep {
    done: Done,
    action: Action,
    migration: String,
    min_version: u32,
}

impl PendingStep {
    fn label(&self) -> String {
        format!("{:04} {}/{}", self.done.number, self.migration, self.done.name)
    }
}

fn pending(
    kind: StoreKind,
    migrations: &Migrations,
    done: &[Done],
    min_version: u32,
) -> Result<Vec<PendingStep>, StoreError> {
    let version = migrations.version();
    if min_version > version {
        return Err(StoreError::Refused(format!(
            "the store needs a program that knows schema {min_version}, and this one knows \
             {version}: start a newer \
             blaze-config, or restore a backup that was made before the upgrade"
        )));
    }
    let known: BTreeMap<(u32, u32), &Done> =
        done.iter().map(|done| ((done.number, done.step), done)).collect();
    let mut pending = Vec::new();
    for migration in &migrations.all {
        let checksum = checksum(kind, migration);
        for (place, step) in migration.steps(kind).iter().enumerate() {
            let place = u32::try_from(place).unwrap_or(u32::MAX);
            match known.get(&(migration.number, place)) {
                None => pending.push(PendingStep {
                    done: Done {
                        number: migration.number,
                        step: place,
                        name: step.name.to_string(),
                        checksum: checksum.clone(),
                    },
                    action: step.action.clone(),
                    migration: migration.name.to_string(),
                    min_version: migration.min_version,
                }),
                Some(done) if done.checksum == checksum => {}
                Some(_) => {
                    return Err(StoreError::Refused(format!(
                        "migration {:04} {} was changed after it was applied to this store: run \
                         the released program, \
                         or restore a backup into an empty store",
                        migration.number, migration.name
                    )));
                }
            }
        }
    }
    Ok(pending)
}

impl Migration {
    fn steps(&self, kind: StoreKind) -> &[Step] {
        match kind {
            StoreKind::Sqlite => &self.sqlite,
            StoreKind::MongoDb => &self.mongodb,
        }
    }
}

fn checksum(kind: StoreKind, migration: &Migration) -> String {
    let mut hash = Sha256::new();
    for step in migration.steps(kind) {
        let text = match &step.action {
            Action::Sql(text) | Action::Command(text) | Action::Rewrite { text, .. } => text,
        };
        for part in [step.name.as_ref(), text.as_ref()] {
            hash.update(part.len().to_be_bytes());
            hash.update(part);
        }
    }
    hex(&hash.finalize())
}

/// Bytes as text.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn first() -> Migration {
    const SQL: &str = include_str!("../../../migrations/0001_first.sql");
    let commands: [(&'static str, &'static str); 11] = [
        ("events", include_str!("../../../migrations/0001_first.mongodb/01_events.json")),
        ("versions", include_str!("../../../migrations/0001_first.mongodb/02_versions.json")),
        ("documents", include_str!("../../../migrations/0001_first.mongodb/03_documents.json")),
        ("audit", include_str!("../../../migrations/0001_first.mongodb/04_audit.json")),
        ("idempotency", include_str!("../../../migrations/0001_first.mongodb/05_idempotency.json")),
        ("tokens", include_str!("../../../migrations/0001_first.mongodb/06_tokens.json")),
        (
            "versions-index",
            include_str!("../../../migrations/0001_first.mongodb/07_versions_index.json"),
        ),
        ("audit-index", include_str!("../../../migrations/0001_first.mongodb/08_audit_index.json")),
        (
            "idempotency-index",
            include_str!("../../../migrations/0001_first.mongodb/09_idempotency_index.json"),
        ),
        (
            "tokens-index",
            include_str!("../../../migrations/0001_first.mongodb/10_tokens_index.json"),
        ),
        (
            "events-index",
            include_str!("../../../migrations/0001_first.mongodb/11_events_index.json"),
        ),
    ];
    Migration {
        number: 1,
        name: Cow::Borrowed("first"),
        min_version: 1,
        sqlite: vec![Step {
            name: Cow::Borrowed("tables"),
            action: Action::Sql(Cow::Borrowed(SQL)),
        }],
        mongodb: commands
            .into_iter()
            .map(|(name, text)| Step {
                name: Cow::Borrowed(name),
                action: Action::Command(Cow::Borrowed(text)),
            })
            .collect(),
    }
}

#[cfg(test)]
#[path = "migrate_tests.rs"]
mod tests;
