use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde_json::json;
use tempfile::TempDir;
use tokio::sync::watch::Receiver;

use super::*;
use crate::supervisor::Supervisor;

/// A schema that knows `limit` (a number) and `name`, and warns of `old`.
fn schema() -> Schema<(f64, String)> {
    Arc::new(|tree: &Value| {
        let mut faults = Vec::new();
        for key in tree.as_object().into_iter().flat_map(|map| map.keys()) {
            if !["limit", "name", "old"].contains(&key.as_str()) {
                faults.push((key.clone(), "unknown key".to_owned()));
            }
        }
        let limit = match tree.get("limit").map_or(Some(1.0), Value::as_f64) {
            Some(limit) => limit,
            None => {
                faults.push(("limit".to_owned(), "expected a number".to_owned()));
                0.0
            }
        };
        if !faults.is_empty() {
            return Err(faults);
        }
        let old = tree.get("old").map(|_| ("old".to_owned(), "not in effect".to_owned()));
        let name = tree.get("name").and_then(Value::as_str).unwrap_or("none").to_owned();
        Ok(((limit, name), old.into_iter().collect()))
    })
}

fn file(directory: &TempDir, text: &str) -> PathBuf {
    let path = directory.path().join("blaze.yaml");
    fs::write(&path, text).unwrap();
    path
}

fn pairs(pairs: &[(&str, &str)]) -> Vec<(String, String)> {
    pairs.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect()
}

fn texts(faults: &[LocatedFault]) -> Vec<String> {
    faults.iter().map(ToString::to_string).collect()
}

mod loading {
    use super::*;

    #[test]
    fn flag_stands_above_environment_above_file() {
        let directory = tempfile::tempdir().unwrap();
        let text = "flow:\n  bandwidth: { limit_mbps: 1, overhead: 2, share: fair }\n  topics:\n    - match: a\n";
        let path = file(&directory, text);
        let sources = Sources {
            environment: pairs(&[
                ("BLAZE__FLOW__BANDWIDTH__LIMIT_MBPS", "20"),
                ("BLAZE__FLOW__BANDWIDTH", "{ limit_mbps: 10, overhead: 10 }"),
                ("BLAZE__FLOW__TOPICS__0__PRIORITY", "bulk"),
            ]),
            overrides: pairs(&[
                ("flow.bandwidth.overhead", "3"),
                ("flow.topics[0].match", "b/**"),
                ("flow.topics[1].match", "c"),
                ("node.name", "robot-1"),
                ("log.level", ""),
            ]),
            ..Sources::of_file(&path)
        };
        let document = Document::load(&sources).unwrap();
        assert_eq!(
            *document.value(),
            json!({
                "flow": {
                    // A mapping replaces the file's: `share` is gone.
                    "bandwidth": { "limit_mbps": 20, "overhead": 3 },
                    "topics": [ { "match": "b/**", "priority": "bulk" }, { "match": "c" } ],
                },
                "node": { "name": "robot-1" },
                "log": { "level": null },
            })
        );
        let name = path.display();
        for (path, place) in [
            ("flow", format!("{name}:1")),
            ("flow.bandwidth", "environment BLAZE__FLOW__BANDWIDTH".to_owned()),
            (
                "flow.bandwidth.limit_mbps",
                "environment BLAZE__FLOW__BANDWIDTH__LIMIT_MBPS".to_owned(),
            ),
            ("flow.bandwidth.overhead", "--set flow.bandwidth.overhead".to_owned()),
            ("flow.bandwidth.share", "environment BLAZE__FLOW__BANDWIDTH".to_owned()),
            ("flow.topics[0]", format!("{name}:4")),
            ("flow.topics[0].priority", "environment BLAZE__FLOW__TOPICS__0__PRIORITY".to_owned()),
            ("flow.topics[0].match", "--set flow.topics[0].match".to_owned()),
            ("flow.topics[1]", "--set flow.topics[1].match".to_owned()),
            ("node", "--set node.name".to_owned()),
            ("state_dir", format!("{name}:1")),
        ] {
            assert_eq!(document.locate(path).to_string(), place, "{path}");
        }
    }

    #[test]
    fn all_faults_come_at_once_in_the_order_of_the_lines() {
        let directory = tempfile::tempdir().unwrap();
        let path = file(&directory, "# comment\nlimit: fast\nname: &n x\n\nspeed: 3\nname: y\n");
        let sources = Sources {
            environment: pairs(&[
                ("BLAZE__SPEED", "4"),
                ("BLAZE____X", "1"),
                ("BLAZE__NAME__X", "1"),
            ]),
            overrides: pairs(&[("colour", "[1"), ("limit[0]", "5"), ("a..b", "6"), ("extra", "1")]),
            ..Sources::of_file(&path)
        };
        let faults = load_typed(&sources, &schema()).unwrap_err();
        let name = path.display();
        let expected = [
            format!("{name}:2: limit: expected a number"),
            format!("{name}:3: name: anchors (&name) are not allowed: write the value out"),
            format!("{name}:6: name: is given twice"),
            "environment BLAZE__NAME__X: name: holds a value, so nothing can be set below it"
                .to_owned(),
            "environment BLAZE__SPEED: speed: unknown key".to_owned(),
            "environment BLAZE____X: is not of the form BLAZE__SECTION__KEY".to_owned(),
            "--set a..b: is not of the form section.key=value".to_owned(),
        ];
        let texts = texts(&faults);
        assert_eq!(texts[..7], expected);
        assert!(texts[7].starts_with("--set colour: colour: is not YAML: "), "{texts:?}");
        assert_eq!(
            texts[8..],
            [
                "--set colour: colour: unknown key",
                "--set extra: extra: unknown key",
                "--set limit[0]: limit: holds a value, so nothing can be set below it",
            ]
        );
    }

    #[test]
    fn warnings_have_their_place() {
        let directory = tempfile::tempdir().unwrap();
        let path = file(&directory, "limit: 5\nold: 1\n");
        let loaded = load_typed(&Sources::of_file(&path), &schema()).unwrap();
        assert_eq!(loaded.value.0, 5.0);
        assert_eq!(texts(&loaded.warnings), [format!("{}:2: old: not in effect", path.display())]);
    }

    #[test]
    fn the_first_file_that_exists_is_taken() {
        let directory = tempfile::tempdir().unwrap();
        let second = file(&directory, "limit: 2\n");
        let first = directory.path().join("first.yaml");
        let search = vec![first.clone(), second.clone()];
        let sources = Sources { search, ..Sources::default() };
        assert_eq!(Document::load(&sources).unwrap().file(), Some(second.as_path()));
        let pinned = sources.pinned();
        fs::write(&first, "limit: 1\n").unwrap();
        assert_eq!(Document::load(&sources).unwrap().file(), Some(first.as_path()));
        assert_eq!(Document::load(&pinned).unwrap().file(), Some(second.as_path()));
    }

    #[test]
    fn a_missing_file_says_what_was_looked_for() {
        let nowhere =
            vec![PathBuf::from("/nonexistent/a.yaml"), PathBuf::from("/nonexistent/b.yaml")];
        let mut sources = Sources { search: nowhere, ..Sources::default() };
        assert_eq!(
            texts(&Document::load(&sources).unwrap_err()),
            ["configuration: no file: give --config FILE or BLAZE_CONFIG, or make one of \
              /nonexistent/a.yaml, \
              /nonexistent/b.yaml"]
        );
        sources.file_may_be_absent = true;
        sources.overrides = pairs(&[("limit", "7")]);
        assert_eq!(load_typed(&sources, &schema()).unwrap().value.0, 7.0);
        // A file that was asked for must exist all the same.
        sources.file = Some(PathBuf::from("/nonexistent/c.yaml"));
        let faults = texts(&Document::load(&sources).unwrap_err());
        assert!(faults[0].starts_with("/nonexistent/c.yaml: cannot be opened: "), "{faults:?}");
    }

    #[test]
    fn files_are_bounded_and_text() {
        let directory = tempfile::tempdir().unwrap();
        let large = file(&directory, &"#".repeat(usize::try_from(MAX_FILE_BYTES).unwrap() + 1));
        assert!(
            texts(&Document::load(&Sources::of_file(&large)).unwrap_err())[0]
                .contains("is larger than 1048576")
        );
        fs::write(&large, b"a: 1\nb: \xff\n").unwrap();
        assert!(
            texts(&Document::load(&Sources::of_file(&large)).unwrap_err())[0]
                .ends_with("line 2 is not UTF-8")
        );
        fs::write(&large, "\u{feff}limit: 3\n").unwrap();
        assert_eq!(
            *Document::load(&Sources::of_file(&large)).unwrap().value(),
            json!({ "limit": 3 })
        );
    }

    #[test]
    fn options_are_split_at_the_first_equals_sign() {
        assert_eq!(parse_override("a.b=c=d").unwrap(), ("a.b".to_owned(), "c=d".to_owned()));
        for bad in ["a", "=1", "a..b=1", ".=", "[0]=1"] {
            assert!(parse_override(bad).is_err(), "{bad}");
        }
    }

    proptest::proptest! {
        #[test]
        fn no_override_panics(path in "[a-c.\\[\\]0-2]{0,12}", value in "[a-c0-9:,\\[\\]{} \
            &*]{0,12}") {
            let sources = Sources {
                file_may_be_absent: true,
                overrides: vec![("a".to_owned(), "[1, {b: 2}]".to_owned()), (path, value)],
                ..Sources::default()
            };
            let _ = Document::load(&sources);
        }
    }
}

mod watching {
    use super::*;

    const LONG: Duration = Duration::from_secs(3600);

    /// Directory events alone.
    fn events() -> WatchSettings {
        WatchSettings {
            debounce: Duration::from_millis(20),
            poll: LONG,
            directory_events: true,
            hangup: false,
        }
    }

    /// Polling alone.
    fn polling() -> WatchSettings {
        WatchSettings { poll: Duration::from_millis(20), directory_events: false, ..events() }
    }

    type Told = Receiver<Current<(f64, String)>>;

    fn start(path: &Path, settings: WatchSettings) -> (Supervisor, Told) {
        let supervisor = Supervisor::new("test");
        let sources = Sources::of_file(path);
        let initial = load_typed(&sources, &schema()).unwrap();
        let told = watch(&supervisor, sources, schema(), initial, settings);
        (supervisor, told)
    }

    async fn until(
        told: &mut Told,
        what: &str,
        holds: impl FnMut(&Current<(f64, String)>) -> bool,
    ) {
        let waited = tokio::time::timeout(Duration::from_secs(10), told.wait_for(holds)).await;
        assert!(waited.is_ok_and(|told| told.is_ok()), "{what}");
    }

    async fn limit_becomes(told: &mut Told, limit: f64) {
        until(told, &format!("limit {limit}"), |now| {
            now.loaded.value.0 == limit && now.faults.is_none()
        })
        .await;
    }

    /// The layout of a mounted ConfigMap: `blaze.yaml` → `..data/blaze.yaml`, `..data` → `..N`.
    fn config_map(root: &Path, generation: u32, text: &str) {
        let data = root.join(format!("..{generation}"));
        fs::create_dir(&data).unwrap();
        fs::write(data.join("blaze.yaml"), text).unwrap();
        symlink(format!("..{generation}"), root.join("..data_tmp")).unwrap();
        fs::rename(root.join("..data_tmp"), root.join("..data")).unwrap();
        if generation > 1 {
            fs::remove_dir_all(root.join(format!("..{}", generation - 1))).unwrap();
        }
    }

    #[tokio::test]
    async fn a_config_map_reloads_each_time_it_is_swapped() {
        let directory = tempfile::tempdir().unwrap();
        config_map(directory.path(), 1, "limit: 1\n");
        let path = directory.path().join("blaze.yaml");
        symlink("..data/blaze.yaml", &path).unwrap();
        let (supervisor, mut told) = start(&path, events());
        for generation in 2..6 {
            config_map(directory.path(), generation, &format!("limit: {generation}\n"));
            limit_becomes(&mut told, f64::from(generation)).await;
        }
        assert!(supervisor.shutdown(Duration::from_secs(5)).await.is_clean());
    }

    #[tokio::test]
    async fn a_file_reloads_when_written_in_place_and_when_replaced() {
        let directory = tempfile::tempdir().unwrap();
        let path = file(&directory, "limit: 1\n");
        let (_supervisor, mut told) = start(&path, events());
        fs::write(&path, "limit: 2\n").unwrap();
        limit_becomes(&mut told, 2.0).await;
        let other = directory.path().join("other");
        fs::write(&other, "limit: 3\n").unwrap();
        fs::rename(&other, &path).unwrap();
        limit_becomes(&mut told, 3.0).await;
    }

    #[tokio::test]
    async fn a_faulty_file_changes_nothing_and_is_told() {
        let directory = tempfile::tempdir().unwrap();
        let path = file(&directory, "limit: 1\n");
        let (_supervisor, mut told) = start(&path, events());
        for (text, expected) in [
            ("limit: 2\nspeed: 1\n", ":2: speed: unknown key"),
            ("limit: [\n", "is not YAML"),
            ("\n", ":1: has become empty"),
        ] {
            fs::write(&path, text).unwrap();
            let fault = |now: &Current<(f64, String)>| {
                texts(now.faults.as_deref().unwrap_or_default()).join("\n")
            };
            until(&mut told, expected, |now| fault(now).contains(expected)).await;
            assert_eq!(told.borrow().loaded.value.0, 1.0);
        }
        fs::remove_file(&path).unwrap();
        let gone = |now: &Current<_>| {
            now.faults.iter().any(|faults| faults[0].detail.contains("cannot be opened"))
        };
        until(&mut told, "the file is gone", gone).await;
        fs::write(&path, "limit: 4\n").unwrap();
        limit_becomes(&mut told, 4.0).await;
    }

    #[tokio::test]
    async fn polling_repairs_what_events_miss() {
        let directory = tempfile::tempdir().unwrap();
        let path = file(&directory, "limit: 1\n");
        let (_supervisor, mut told) = start(&path, polling());
        fs::write(&path, "limit: 2\n").unwrap();
        limit_becomes(&mut told, 2.0).await;
    }

    #[tokio::test]
    async fn the_same_content_is_told_once() {
        let directory = tempfile::tempdir().unwrap();
        let path = file(&directory, "limit: 1\n");
        let (_supervisor, mut told) = start(&path, polling());
        fs::write(&path, "limit: 2\n").unwrap();
        limit_becomes(&mut told, 2.0).await;
        fs::write(&path, "limit: 2\n").unwrap();
        fs::write(&path, "limit: 3\n").unwrap();
        limit_becomes(&mut told, 3.0).await;
        // At most one reading more: of the moment when `write` had emptied the file.
        assert!(told.borrow().serial <= 4, "{}", told.borrow().serial);
    }

    #[tokio::test]
    async fn a_replaced_directory_is_watched_anew() {
        let parent = tempfile::tempdir().unwrap();
        let directory = parent.path().join("etc");
        fs::create_dir(&directory).unwrap();
        let path = directory.join("blaze.yaml");
        fs::write(&path, "limit: 1\n").unwrap();
        let (_supervisor, mut told) =
            start(&path, WatchSettings { poll: Duration::from_millis(50), ..events() });
        fs::rename(&directory, parent.path().join("old")).unwrap();
        fs::create_dir(&directory).unwrap();
        fs::write(&path, "limit: 2\n").unwrap();
        limit_becomes(&mut told, 2.0).await;
        fs::write(&path, "limit: 3\n").unwrap();
        limit_becomes(&mut told, 3.0).await;
    }

    #[tokio::test]
    async fn hangup_reads_again_what_has_not_changed() {
        let directory = tempfile::tempdir().unwrap();
        let path = file(&directory, "limit: 1\n");
        // Registered before the signal is sent, whatever the watch has got to.
        let _handler =
            tokio::signal::unix::signal(tokio::signal::unix::SignalKind::hangup()).unwrap();
        let (_supervisor, mut told) = start(&path, WatchSettings { hangup: true, ..polling() });
        fs::write(&path, "limit: 2\n").unwrap();
        // The watch runs, so it has its handler.
        limit_becomes(&mut told, 2.0).await;
        let before = told.borrow().serial;
        let sent = std::process::Command::new("kill")
            .args(["-HUP", &std::process::id().to_string()])
            .status();
        assert!(sent.unwrap().success());
        until(&mut told, "told again", |now| now.serial > before).await;
        assert!(told.borrow().faults.is_none());
    }
}
