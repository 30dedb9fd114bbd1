use parking_lot::Mutex;

use super::*;

/// A store that only remembers what was done.
#[derive(Default)]
struct Remembers {
    done: Mutex<Vec<Done>>,
    min_version: Mutex<u32>,
    fails_at: Option<u32>,
}

#[async_trait]
impl Target for Remembers {
    fn kind(&self) -> StoreKind {
        StoreKind::Sqlite
    }

    async fn state(&self) -> Result<(Vec<Done>, u32), StoreError> {
        Ok((self.done.lock().clone(), *self.min_version.lock()))
    }

    async fn perform(&self, _action: &Action, done: &Done) -> Result<(), StoreError> {
        if self.fails_at == Some(done.step) {
            return Err(StoreError::Unavailable("as asked for".to_owned()));
        }
        self.done.lock().push(done.clone());
        Ok(())
    }

    async fn raise_min_version(&self, version: u32) -> Result<(), StoreError> {
        *self.min_version.lock() = version;
        Ok(())
    }
}

fn migration(number: u32, min_version: u32, texts: &[&str]) -> Migration {
    let steps = texts.iter().enumerate().map(|(place, text)| Step {
        name: Cow::Owned(format!("step{place}")),
        action: Action::Sql(Cow::Owned((*text).to_owned())),
    });
    Migration {
        number,
        name: Cow::Borrowed("test"),
        min_version,
        sqlite: steps.collect(),
        mongodb: Vec::new(),
    }
}

fn only(all: Vec<Migration>) -> Migrations {
    Migrations { all, after_step: None }
}

#[tokio::test]
async fn steps_are_done_once_and_in_order() {
    let store = Remembers::default();
    let seen = Arc::new(Mutex::new(Vec::new()));
    let told = Arc::clone(&seen);
    let migrations = only(vec![migration(1, 1, &["a", "b"]), migration(2, 1, &["c"])])
        .after_step(Arc::new(move |label: &str| told.lock().push(label.to_owned())));
    let before = plan(&store, &migrations).await.unwrap();
    assert_eq!((before.version, before.target, before.pending.len()), (0, 2, 3));
    let labels = apply(&store, &migrations).await.unwrap();
    assert_eq!(labels, ["0001 test/step0", "0001 test/step1", "0002 test/step0"]);
    assert_eq!(*seen.lock(), labels);
    assert_eq!(apply(&store, &migrations).await.unwrap(), Vec::<String>::new());
    let after = plan(&store, &migrations).await.unwrap();
    assert_eq!((after.version, after.pending.len()), (2, 0));
}

#[tokio::test]
async fn after_a_failure_it_goes_on_from_there() {
    let migrations = only(vec![migration(1, 1, &["a", "b", "c"])]);
    let mut store = Remembers { fails_at: Some(1), ..Remembers::default() };
    apply(&store, &migrations).await.unwrap_err();
    assert_eq!(plan(&store, &migrations).await.unwrap().version, 0);
    store.fails_at = None;
    assert_eq!(apply(&store, &migrations).await.unwrap(), ["0001 test/step1", "0001 test/step2"]);
}

#[tokio::test]
async fn a_changed_migration_and_a_store_that_is_too_new_are_refused() {
    let store = Remembers::default();
    apply(&store, &only(vec![migration(1, 1, &["a"]), migration(2, 2, &["b"])])).await.unwrap();
    let changed =
        apply(&store, &only(vec![migration(1, 1, &["A"]), migration(2, 2, &["b"])])).await;
    assert!(
        matches!(
            &changed,
            Err(StoreError::Refused(text)) if text.contains("0001 test was changed"),
        ),
        "{changed:?}"
    );
    let old = apply(&store, &only(vec![migration(1, 1, &["a"])])).await;
    assert!(
        matches!(&old, Err(StoreError::Refused(text)) if text.contains("newer blaze-config")),
        "{old:?}"
    );
}

#[tokio::test]
async fn an_older_program_may_use_a_store_that_was_only_expanded() {
    let store = Remembers::default();
    apply(&store, &only(vec![migration(1, 1, &["a"]), migration(2, 1, &["b"])])).await.unwrap();
    let old = only(vec![migration(1, 1, &["a"])]);
    assert_eq!(apply(&store, &old).await.unwrap(), Vec::<String>::new());
}

#[test]
fn the_programs_own_are_numbered_from_one_on_and_have_steps_for_both() {
    let own = Migrations::default();
    for (place, migration) in own.all.iter().enumerate() {
        assert_eq!(usize::try_from(migration.number).unwrap(), place + 1);
        assert!(migration.min_version <= migration.number);
        assert!(!migration.sqlite.is_empty() && !migration.mongodb.is_empty());
        for step in &migration.mongodb {
            if let Action::Command(text) = &step.action {
                serde_json::from_str::<serde_json::Value>(text).unwrap();
            }
        }
    }
}
