//! The mounted file: what counts of it, and when it is read again.

use std::fs;
use std::os::unix::fs::symlink;

use tempfile::TempDir;

use super::*;

const SOON: Duration = Duration::from_secs(20);

const GOOD: &str = "\
# blaze export --layer edge
---
kind: Layer
name: edge
spec: { kind: edge, config: { log: { level: info } } }
---
kind: Node
name: robot-1
labels: { canary: \"true\" }
spec: { layer: edge }
---
kind: Service
name: slam
spec: { config: { rate: 30, password: { $secret: canary-5f1c } } }
---
kind: Instance
service: slam
name: \"0\"
spec: { node: robot-1 }
";

/// A list of documents counts as its entries.
const ELSEWHERE: &str = "\
---
- { kind: Layer, name: fog, spec: { kind: fog } }
- { kind: Node, name: fog-1, spec: { layer: fog } }
- { kind: Service, name: map, spec: { layers: [fog] } }
- { kind: Instance, service: slam, name: far, spec: { node: fog-1 } }
- kind: Rollout
  name: slower
  spec:
    { target: { kind: Service, name: slam }, patch: { config: { rate: 10 } }, canary: { node_selector: canary=true },
      gate: { window_s: 60, max_unhealthy: 0 } }
";

fn layer() -> LayerName {
    "edge".parse().unwrap()
}

fn write(folder: &TempDir, text: &str) -> PathBuf {
    let path = folder.path().join("defaults.yaml");
    fs::write(&path, text).unwrap();
    path
}

fn names(defaults: &Defaults) -> Vec<String> {
    defaults.documents.iter().map(|document| document.key.to_string()).collect()
}

const SEEN: [&str; 4] = ["Layer/edge", "Node/robot-1", "Service/slam", "Instance/slam/0"];

#[test]
fn the_view_of_the_layer_counts_and_the_rest_is_counted() {
    let folder = tempfile::tempdir().unwrap();
    let found = read(&write(&folder, &format!("{GOOD}{ELSEWHERE}")), &layer()).unwrap();
    let mut names = names(&found);
    names.sort();
    let mut seen = SEEN.to_vec();
    seen.sort_unstable();
    assert_eq!(names, seen);
    assert_eq!(found.left_out, 4);
    for document in &found.documents {
        assert_eq!((document.revision, document.updated_by.as_str()), (0, "file"));
        assert_eq!(document.uid, format!("file:{}", document.key));
    }
    assert!(!format!("{found:?}").contains("canary-5f1c"));
}

#[test]
fn every_fault_is_told_with_its_place_and_no_secret() {
    let folder = tempfile::tempdir().unwrap();
    let text = "\
kind: Layer
name: edge
spec: { kind: rim }
---
kind: Service
name: Slam
spec: {}
---
kind: Service
name: slam
spec: { config: { a: { $secret: canary-5f1c, b: 1 } } }
---
kind: Service
name: log
delete: true
---
- { kind: Service, name: a, spec: {} }
- { kind: Service, name: a, spec: {} }
";
    let DefaultsError(faults) = read(&write(&folder, text), &layer()).unwrap_err();
    for (number, said) in
        [(1, "/spec/kind"), (2, "/name"), (3, "/spec/config/a"), (4, "/delete"), (6, "twice")]
    {
        let place = format!("defaults.yaml (document {number}): ");
        let found = faults.iter().any(|fault| fault.contains(&place) && fault.contains(said));
        assert!(found, "{number} {said}: {faults:#?}");
    }
    assert!(!format!("{faults:?}").contains("canary-5f1c"));
    // Faults of form have a line.
    let DefaultsError(faults) = read(&write(&folder, "a: 1\nb: [\n"), &layer()).unwrap_err();
    assert!(faults[0].contains("defaults.yaml:"), "{faults:?}");
    fs::write(folder.path().join("defaults.yaml"), b"a: 1\nb: \xff\n").unwrap();
    let DefaultsError(faults) = read(&folder.path().join("defaults.yaml"), &layer()).unwrap_err();
    assert!(faults[0].contains("defaults.yaml:2: is not UTF-8"), "{faults:?}");
    let DefaultsError(faults) = read(&folder.path().join("missing"), &layer()).unwrap_err();
    assert!(faults[0].contains("missing: cannot be read"), "{faults:?}");
}

#[test]
fn an_empty_file_says_nothing_and_is_no_fault() {
    let folder = tempfile::tempdir().unwrap();
    for text in ["", "# nothing yet\n", "---\n---\n"] {
        let found = read(&write(&folder, text), &layer()).unwrap();
        assert!(found.documents.is_empty(), "{text:?}");
    }
}

async fn wait(told: &mut watch::Receiver<Status>, what: impl FnMut(&Status) -> bool) -> Status {
    let status = tokio::time::timeout(SOON, told.wait_for(what)).await;
    status.expect("in time").unwrap().clone()
}

fn has(status: &Status, name: &str) -> bool {
    let current = status.current.as_ref();
    current.is_some_and(|current| names(current).iter().any(|found| found == name))
}

#[tokio::test]
async fn a_config_map_that_is_swapped_is_read_again() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    for (name, service) in [("..one", "slam"), ("..two", "mapping")] {
        fs::create_dir(path(name)).unwrap();
        fs::write(path(name).join("defaults.yaml"), GOOD.replace("slam", service)).unwrap();
    }
    // As Kubernetes lays it out: file -> ..data/file, ..data -> folder with the time in its name.
    symlink("..one", path("..data")).unwrap();
    symlink("..data/defaults.yaml", path("defaults.yaml")).unwrap();
    let supervisor = Supervisor::new("test");
    let mut told =
        watch_file(&supervisor, path("defaults.yaml"), layer(), Duration::from_millis(20));
    wait(&mut told, |status| has(status, "Service/slam")).await;
    symlink("..two", path("..data_tmp")).unwrap();
    fs::rename(path("..data_tmp"), path("..data")).unwrap();
    let status = wait(&mut told, |status| has(status, "Service/mapping")).await;
    assert!(!has(&status, "Service/slam") && status.problem.is_none());
    assert!(supervisor.shutdown(SOON).await.is_clean());
}

#[tokio::test]
async fn a_faulty_or_missing_file_keeps_what_was_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = write(&folder, GOOD);
    let supervisor = Supervisor::new("test");
    let mut told = watch_file(&supervisor, path.clone(), layer(), Duration::from_millis(20));
    wait(&mut told, |status| has(status, "Service/slam")).await;
    fs::write(&path, "kind: Layer\nname: edge\nspec: { kind: rim }\n").unwrap();
    let status = wait(&mut told, |status| status.problem.is_some()).await;
    assert!(has(&status, "Service/slam"));
    assert!(status.problem.unwrap().to_string().contains("/spec/kind"));
    fs::remove_file(&path).unwrap();
    let gone = |status: &Status| {
        let problem = status.problem.as_ref();
        problem.is_some_and(|problem| problem.to_string().contains("cannot be read"))
    };
    assert!(has(&wait(&mut told, gone).await, "Service/slam"));
    fs::write(&path, GOOD.replace("slam", "mapping")).unwrap();
    let status = wait(&mut told, |status| status.problem.is_none()).await;
    assert!(has(&status, "Service/mapping"));
}
