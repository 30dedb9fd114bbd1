//! A process that writes the file is killed again and again, at no particular instant: what is
//! found then is one revision, whole, and none that was said to be written is missing.

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;

use blaze_runtime::environment::variable;
use serde_json::json;

use super::samples::{loaded, notes, service};
use super::{FileCopy, Loaded, LocalCopy, Vault};

/// Names the folder to the process that is killed.
const FOLDER: &str = "BLAZE_TEST_COPY_FOLDER";
/// How often it is killed.
const KILLS: u64 = 8;

fn at(revision: u64) -> Loaded {
    let text = format!("{revision} ").repeat(500);
    Loaded {
        notes: Arc::new(notes(&format!("uid-{revision}"), revision)),
        ..loaded(
            revision,
            (0..40).map(|number| {
                service(&format!("s{number}"), revision, json!({ "config": { "a": text } }))
            }),
        )
    }
}

fn copy(folder: &Path) -> FileCopy {
    FileCopy::new(folder, "edge".parse().unwrap(), Vault::with_key([7; 32]))
}

/// Not a test of its own: it writes until it is killed, and says each revision that the file holds.
#[tokio::test]
async fn a_process_that_writes_until_it_is_killed() {
    let Some(folder) = variable(FOLDER) else { return };
    let copy = copy(Path::new(&folder));
    let found = copy.load().await.unwrap();
    let start = found.map_or(0, |found| found.position.revision);
    for revision in start + 1.. {
        copy.replace(&at(revision)).await.unwrap();
        println!("\nwritten {revision}");
    }
}

#[tokio::test]
async fn a_process_that_is_killed_leaves_one_revision_whole() {
    let folder = tempfile::tempdir().unwrap();
    let mut last = 0;
    for kill in 1..=KILLS {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args([
                "--exact",
                "copy::kill_tests::a_process_that_writes_until_it_is_killed",
                "--nocapture",
            ])
            .env(FOLDER, folder.path())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let said = BufReader::new(child.stdout.take().unwrap()).lines();
        let written = said
            .map_while(Result::ok)
            .filter_map(|line| line.strip_prefix("written ")?.parse().ok());
        // A different number of writes each time; the next one has begun.
        last = written.take(usize::try_from(kill * 2).unwrap()).last().unwrap_or(last);
        child.kill().unwrap();
        child.wait().unwrap();
        let found = copy(folder.path()).load().await.unwrap().unwrap();
        let revision = found.position.revision;
        assert!(revision >= last, "it has {revision}, {last} was written");
        assert!(found == at(revision), "it is not whole at {revision}");
    }
    assert!(last >= KILLS * (KILLS + 1), "it was written in between: {last}");
}
