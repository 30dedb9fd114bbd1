use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use serde_json::{Value, json};
use tokio::sync::watch::{Receiver, Sender, channel};

use super::*;
use crate::admin::{CheckStatus, Gate, Readiness};
use crate::supervisor::{Supervisor, TaskPolicy};

/// What the schema of these tests reads: `limit`, which lives, and `mode`, which does not.
type Values = (f64, String);

/// `limit` is a number; in mode `low` at most 10.
fn schema() -> Schema<Values> {
    Arc::new(|tree: &Value| {
        let mut faults = Vec::new();
        let known = |key: &&String| !["limit", "mode", "list"].contains(&key.as_str());
        let unknown = tree.as_object().into_iter().flat_map(|map| map.keys().filter(known));
        faults.extend(unknown.map(|key| (key.clone(), "unknown key".to_owned())));
        let limit = tree.get("limit").map_or(Some(1.0), Value::as_f64);
        let mode = tree.get("mode").and_then(Value::as_str).unwrap_or("high");
        match limit {
            None => faults.push(("limit".to_owned(), "expected a number".to_owned())),
            Some(limit) if mode == "low" && limit > 10.0 => {
                faults.push(("limit".to_owned(), "at most 10 in mode low".to_owned()));
            }
            Some(_) => {}
        }
        match (limit, faults.is_empty()) {
            (Some(limit), true) => Ok(((limit, mode.to_owned()), Vec::new())),
            _ => Err(faults),
        }
    })
}

fn overlay(revision: u64, tree: Value) -> Option<Overlay> {
    Some(Overlay {
        origin: Arc::from("BlazeConfig"),
        revision,
        hash: Arc::from(tree.to_string()),
        tree: Arc::new(tree),
    })
}

fn text(path: &Path, text: &str) -> compose::Seen {
    fs::write(path, text).unwrap();
    Sources::of_file(path).read_file()
}

struct Case {
    _folder: tempfile::TempDir,
    path: PathBuf,
    composition: compose::Composition<Values>,
    holds: Values,
}

impl Case {
    fn new(file: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("blaze.yaml");
        fs::write(&path, file).unwrap();
        let sources = Sources {
            overrides: vec![("list[0]".to_owned(), "set".to_owned())],
            ..Sources::of_file(&path)
        };
        let loaded = load_typed(&sources, &schema()).unwrap();
        Self {
            composition: compose::Composition::new(sources, schema(), &loaded.document),
            holds: loaded.value,
            path,
            _folder: folder,
        }
    }

    fn file(&mut self, content: &str) {
        let seen = text(&self.path, content);
        self.composition.see(seen);
    }

    fn over(&mut self, revision: u64, tree: Value) {
        self.composition.lay_over(overlay(revision, tree));
    }

    /// The limit that holds, faults of the file, faults of the overlay.
    fn judge(&mut self) -> (f64, Vec<String>, Option<Vec<String>>) {
        let judgement = self.composition.judge();
        if let Some(loaded) = judgement.loaded {
            self.holds = loaded.value;
        }
        let texts = |faults: Option<Arc<[LocatedFault]>>| -> Vec<String> {
            let faults = faults.as_deref().unwrap_or_default().iter();
            faults.map(|fault| format!("{}: {}", fault.place, fault.path)).collect()
        };
        (
            self.holds.0,
            texts(judgement.faults),
            judgement.overlay.map(|verdict| texts(verdict.faults)),
        )
    }
}

#[test]
fn what_one_says_wrongly_keeps_the_other_from_nothing() {
    let mut case = Case::new("limit: 1\n");
    let none = Vec::<String>::new;
    let name = case.path.display().to_string();
    case.over(1, json!({ "limit": 2 }));
    assert_eq!(case.judge(), (2.0, none(), Some(none())));
    // A faulty overlay changes nothing, and a change of the file counts.
    case.over(2, json!({ "limit": "x" }));
    let faulty = vec!["BlazeConfig revision 2: limit".to_owned()];
    assert_eq!(case.judge(), (2.0, none(), Some(faulty.clone())));
    case.file("limit: 3\nmode: low\n");
    assert_eq!(case.judge(), (2.0, none(), Some(faulty)));
    assert_eq!(case.holds.1, "low");
    // A faulty file changes nothing, and a change of the overlay counts.
    case.file("limit: 3\nspeed: 1\n");
    case.over(3, json!({ "limit": 4 }));
    assert_eq!(case.judge(), (4.0, vec![format!("{name}:2: speed")], Some(none())));
    assert_eq!(case.holds.1, "low");
    case.over(4, json!({ "limit": 11 }));
    assert_eq!(
        case.judge(),
        (
            4.0,
            vec![format!("{name}:2: speed")],
            Some(vec!["BlazeConfig revision 4: limit".to_owned()])
        )
    );
    // Both good again.
    case.file("mode: high\n");
    assert_eq!(case.judge(), (11.0, none(), Some(none())));
}

#[test]
fn without_the_overlay_the_file_counts_again() {
    let mut case = Case::new("limit: 1\n");
    case.over(1, json!({ "limit": 5, "mode": "low" }));
    assert_eq!(case.judge(), (5.0, Vec::new(), Some(Vec::new())));
    case.over(2, json!({ "mode": "low" }));
    assert_eq!(case.judge(), (1.0, Vec::new(), Some(Vec::new())));
    case.file("limit: 7\n");
    assert_eq!(case.judge().0, 7.0);
    case.composition.lay_over(None);
    assert_eq!(case.judge(), (7.0, Vec::new(), None));
    assert_eq!(case.holds.1, "high");
}

#[test]
fn a_file_that_needs_the_overlay_keeps_it() {
    let mut case = Case::new("limit: 1\nmode: low\n");
    case.over(1, json!({ "limit": 9 }));
    case.judge();
    case.file("limit: 20\nmode: low\n");
    assert_eq!(case.judge().0, 9.0);
    case.composition.lay_over(None);
    let (limit, faults, verdict) = case.judge();
    assert_eq!((limit, faults.len(), verdict), (9.0, 1, None), "{faults:?}");
}

#[test]
fn an_emptied_file_counts_as_faulty_also_under_an_overlay() {
    let mut case = Case::new("limit: 1\n");
    case.over(1, json!({ "mode": "low" }));
    case.judge();
    case.file("\n");
    let (limit, faults, verdict) = case.judge();
    assert_eq!((limit, faults.len(), verdict), (1.0, 1, Some(Vec::new())));
    fs::remove_file(&case.path).unwrap();
    case.composition.see(Sources::of_file(&case.path).read_file());
    case.over(2, json!({ "limit": 3 }));
    let (limit, faults, _) = case.judge();
    assert_eq!((limit, faults.len()), (3.0, 1));
}

#[test]
fn a_text_counts_as_a_file_does() {
    let name = "node file of a";
    let sources = Sources::of_text(name, "limit: 1\nmode: low\n");
    assert_eq!(sources.resolve_file(), None, "there is nothing to watch");
    let loaded = load_typed(&sources, &schema()).unwrap();
    let mut composition = compose::Composition::new(sources.clone(), schema(), &loaded.document);
    assert!(!composition.see(sources.read_file()), "it stays as it is");
    let mut limit = |over| {
        composition.lay_over(over);
        composition.judge().loaded.map(|loaded| loaded.value.0)
    };
    assert_eq!(limit(overlay(1, json!({ "limit": 5 }))), Some(5.0));
    assert_eq!(limit(overlay(2, json!({ "limit": 11 }))), None);
    assert_eq!(limit(None), Some(1.0));
    let faults = load_typed(&Sources::of_text(name, "speed: 1\n"), &schema()).unwrap_err();
    assert_eq!(faults[0].to_string(), "node file of a:1: speed: unknown key");
}

#[test]
fn environment_and_options_stand_above_the_overlay() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("blaze.yaml");
    fs::write(&path, "limit: 1\n").unwrap();
    let sources = Sources {
        environment: vec![("BLAZE__LIMIT".to_owned(), "2".to_owned())],
        overrides: vec![("mode".to_owned(), "low".to_owned())],
        ..Sources::of_file(&path)
    };
    let over = overlay(1, json!({ "limit": 3, "mode": "high", "list": [1] }));
    let text = sources.read_file().unwrap();
    let (document, faults) = Document::from_text(&sources, text, over.as_ref());
    assert!(faults.is_empty());
    let document = document.unwrap();
    assert_eq!(*document.value(), json!({ "limit": 2, "mode": "low", "list": [1] }));
    assert_eq!(document.locate("limit").to_string(), "environment BLAZE__LIMIT");
    assert_eq!(document.locate("list").to_string(), "BlazeConfig revision 1");
}

/// What a follower was given: limits, and verdicts with what was said besides.
#[derive(Default)]
struct Given {
    limits: Vec<f64>,
    verdicts: Vec<(Option<u64>, bool, String)>,
}

struct Stage {
    folder: tempfile::TempDir,
    over: Sender<Option<Overlay>>,
    readiness: Readiness,
    given: Arc<Mutex<Given>>,
    _supervisor: Supervisor,
}

fn stage(file: &str) -> Stage {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("blaze.yaml");
    fs::write(&path, file).unwrap();
    let supervisor = Supervisor::new("test");
    let readiness = Readiness::new();
    readiness.add("config", Gate::Shows, CheckStatus::Ok, "");
    let sources = Sources::of_file(&path);
    let initial = load_typed(&sources, &schema()).unwrap();
    let (over, overlays) = channel(None);
    let told = follower_told(&supervisor, sources, initial, overlays);
    let given = Arc::<Mutex<Given>>::default();
    let follower = Follower {
        told,
        readiness: readiness.clone(),
        keys: Keys { read: &["limit", "mode"], live: &["limit"] },
        needs_restart: |started, now| started.1 != now.1,
    };
    let (taken, judged) = (Arc::clone(&given), Arc::clone(&given));
    supervisor.spawn(
        "follow",
        TaskPolicy::MayEnd,
        follow(
            follower,
            move |loaded| taken.lock().limits.push(loaded.value.0),
            move |verdict, besides| {
                let row = (
                    verdict.map(|verdict| verdict.overlay.revision),
                    verdict.is_some_and(|verdict| verdict.faults.is_none()),
                    besides.to_owned(),
                );
                judged.lock().verdicts.push(row);
            },
        ),
    );
    Stage { folder, over, readiness, given, _supervisor: supervisor }
}

fn follower_told(
    supervisor: &Supervisor,
    sources: Sources,
    initial: Loaded<Values>,
    overlays: Receiver<Option<Overlay>>,
) -> Receiver<Current<Values>> {
    let settings = WatchSettings {
        debounce: Duration::from_millis(20),
        hangup: false,
        ..WatchSettings::default()
    };
    watch_with(supervisor, sources, schema(), initial, settings, overlays)
}

impl Stage {
    async fn until(&self, what: &str, holds: impl Fn(&Given, &str, CheckStatus) -> bool) {
        let wait = async {
            loop {
                let report = self.readiness.report();
                let check = &report.checks["config"];
                if holds(&self.given.lock(), &check.detail, check.status) {
                    return;
                }
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        assert!(tokio::time::timeout(Duration::from_secs(10), wait).await.is_ok(), "{what}");
    }
}

#[tokio::test]
async fn what_holds_is_taken_and_what_does_not_is_shown() {
    let stage = stage("limit: 1\nmode: high\n");
    stage.over.send_replace(overlay(1, json!({ "limit": 2 })));
    stage
        .until("the overlay is taken", |given, _, _| {
            given.limits == [2.0] && given.verdicts == [(Some(1), true, String::new())]
        })
        .await;
    stage.over.send_replace(overlay(2, json!({ "limit": "x" })));
    stage
        .until("it is shown", |given, detail, status| {
            status == CheckStatus::Failed
                && detail == "BlazeConfig revision 2: limit: expected a number"
                && given.verdicts.last() == Some(&(Some(2), false, String::new()))
                && given.limits.len() == 1
        })
        .await;
    assert!(stage.readiness.is_ready(), "the check is shown alone");
    stage.over.send_replace(overlay(3, json!({ "mode": "low" })));
    let alone = "BlazeConfig revision 3 gives what counts in the node file alone: mode";
    stage
        .until("what does not live is named", |given, detail, status| {
            status == CheckStatus::Ok
                && detail == alone
                && given.verdicts.last() == Some(&(Some(3), true, alone.to_owned()))
        })
        .await;
    fs::write(stage.folder.path().join("blaze.yaml"), "limit: 4\nmode: other\n").unwrap();
    stage.over.send_replace(None);
    stage
        .until("the file alone", |given, detail, _| {
            detail == "the node file has changes that need a restart: mode"
                && given.verdicts.last().is_some_and(|(revision, ..)| revision.is_none())
                && given.limits.last() == Some(&4.0)
        })
        .await;
}
