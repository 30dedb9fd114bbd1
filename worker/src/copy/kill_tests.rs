//! A process that writes both copies of one folder is killed again and again, at no particular instant: what is found then
//! is one revision, whole, and none that was said to be written is missing.

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;

use blaze_runtime::Supervisor;
use blaze_runtime::environment::variable;
use serde_json::json;

use super::samples::{loaded, notes, service};
use super::{DATABASE_NAME, FileCopy, Loaded, LocalCopy, SqliteCopy, Vault};

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
            (0..40).map(|number| service(&format!("s{number}"), revision, json!({ "config": { "a": text } }))),
        )
    }
}

fn copies(folder: &Path, supervisor: &Supervisor) -> [Box<dyn LocalCopy>; 2] {
    let (layer, vault) = (|| "edge".parse().unwrap(), Vault::with_key([7; 32]));
    let database = SqliteCopy::new(folder.join(DATABASE_NAME), layer(), vault.clone(), supervisor);
    [
        Box::new(database.unwrap()),
        Box::new(FileCopy::new(folder, layer(), vault)),
    ]
}

/// Not a test of its own: it writes until it is killed, and says each revision that both copies hold.
#[tokio::test]
async fn a_process_that_writes_until_it_is_killed() {
    let Some(folder) = variable(FOLDER) else { return };
    let copies = copies(Path::new(&folder), &Supervisor::new("test"));
    let found = copies[0].load().await.unwrap();
    let start = found.map_or(0, |found| found.position.revision);
    for revision in start + 1.. {
        let whole = at(revision);
        for copy in &copies {
            let all = (&whole.position, &whole.documents, Some(&*whole.notes));
            if revision == 1 || revision % 3 == 0 || copy.writes_whole() {
                copy.replace(&whole).await.unwrap();
            } else {
                copy.advance(all.0, all.1, &[], all.2).await.unwrap();
            }
        }
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
        let supervisor = Supervisor::new("test");
        for copy in copies(folder.path(), &supervisor) {
            let found = copy.load().await.unwrap().unwrap();
            let revision = found.position.revision;
            assert!(
                revision >= last,
                "{} has {revision}, {last} was written",
                copy.describe()
            );
            assert!(found == at(revision), "{} is not whole at {revision}", copy.describe());
        }
    }
    assert!(last >= KILLS * (KILLS + 1), "it was written in between: {last}");
}
