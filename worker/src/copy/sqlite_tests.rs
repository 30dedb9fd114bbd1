//! What concerns the SQLite file as a file; the rest is in [`conformance`](crate::copy::conformance).

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::time::Duration;

use rusqlite::Connection;
use serde_json::json;
use tempfile::TempDir;

use super::*;
use crate::copy::samples::{loaded, service, with_secret};

const CANARY: &str = "canary-5f1c";

struct Fixture {
    folder: TempDir,
    supervisor: Supervisor,
}

impl Fixture {
    fn new() -> Self {
        Self {
            folder: tempfile::tempdir().unwrap(),
            supervisor: Supervisor::new("test"),
        }
    }

    fn path(&self) -> PathBuf {
        self.folder.path().join(DATABASE_NAME)
    }

    fn copy(&self, vault: Vault) -> SqliteCopy {
        SqliteCopy::new(self.path(), "edge".parse().unwrap(), vault, &self.supervisor).unwrap()
    }

    fn aside(&self) -> usize {
        let names = fs::read_dir(self.folder.path()).unwrap();
        let is_aside = |name: &str| name.contains(".broken-") && !name.ends_with("-wal") && !name.ends_with("-shm");
        names
            .filter(|entry| is_aside(entry.as_ref().unwrap().file_name().to_str().unwrap()))
            .count()
    }
}

#[tokio::test]
async fn only_its_owner_reads_it_and_reading_makes_none() {
    let fixture = Fixture::new();
    let copy = fixture.copy(Vault::default());
    assert_eq!(copy.load().await, Ok(None));
    assert!(!fixture.path().exists());
    copy.replace(&loaded(7, [service("slam", 7, json!({}))])).await.unwrap();
    for entry in fs::read_dir(fixture.folder.path()).unwrap() {
        let entry = entry.unwrap();
        let mode = entry.metadata().unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600, "{:?}", entry.file_name());
    }
    assert!(fixture.supervisor.shutdown(Duration::from_secs(10)).await.is_clean());
}

#[tokio::test]
async fn a_broken_file_is_moved_aside_and_begun_anew() {
    for content in [
        "no database at all, but a long text that is none".repeat(100),
        String::new(),
    ] {
        let fixture = Fixture::new();
        fs::write(fixture.path(), &content).unwrap();
        let copy = fixture.copy(Vault::default());
        let is_broken = !content.is_empty();
        assert_eq!(matches!(copy.load().await, Err(CopyError::Broken { .. })), is_broken);
        let whole = loaded(7, [service("slam", 7, json!({}))]);
        copy.replace(&whole).await.unwrap();
        assert_eq!(copy.load().await, Ok(Some(whole)));
        assert_eq!(fixture.aside(), usize::from(is_broken));
    }
}

#[tokio::test]
async fn a_file_of_another_program_a_newer_format_or_with_broken_rows_is_kept() {
    let ours = |fixture: &Fixture| {
        let copy = fixture.copy(Vault::default());
        async move { copy.replace(&loaded(7, [service("slam", 7, json!({}))])).await.unwrap() }
    };
    for (change, is_ours) in [
        ("CREATE TABLE theirs (a)", false),
        ("PRAGMA user_version = 2", true),
        ("UPDATE documents SET document = '{}'", true),
        ("UPDATE head SET notes = '['", true),
        ("UPDATE head SET revision = -1", true),
        ("UPDATE head SET layer = 'fog'", true),
        ("DROP TABLE documents", true),
    ] {
        let fixture = Fixture::new();
        if is_ours {
            ours(&fixture).await;
        }
        Connection::open(fixture.path()).unwrap().execute_batch(change).unwrap();
        let copy = fixture.copy(Vault::default());
        assert!(copy.load().await.unwrap_err().is_unreadable(), "{change}");
        let whole = loaded(8, [service("log", 8, json!({}))]);
        copy.replace(&whole).await.unwrap();
        assert_eq!(copy.load().await, Ok(Some(whole)), "{change}");
        assert_eq!(fixture.aside(), 1, "{change}");
    }
}

#[tokio::test]
async fn no_text_of_a_secret_is_in_the_file_or_its_log() {
    for vault in [Vault::default(), Vault::with_key([7; 32])] {
        let fixture = Fixture::new();
        let copy = fixture.copy(vault);
        copy.replace(&loaded(7, [with_secret("slam", 7, CANARY)]))
            .await
            .unwrap();
        for entry in fs::read_dir(fixture.folder.path()).unwrap() {
            let content = fs::read(entry.unwrap().path()).unwrap();
            assert!(!String::from_utf8_lossy(&content).contains(CANARY));
        }
    }
}

#[tokio::test]
async fn a_file_that_was_taken_away_is_written_again() {
    let fixture = Fixture::new();
    let copy = fixture.copy(Vault::default());
    let whole = loaded(7, [service("slam", 7, json!({}))]);
    copy.replace(&whole).await.unwrap();
    for entry in fs::read_dir(fixture.folder.path()).unwrap() {
        fs::remove_file(entry.unwrap().path()).unwrap();
    }
    let behind = copy.advance(&whole.position, &[], &[], None).await.unwrap_err();
    assert!(matches!(behind, CopyError::Behind { .. }), "{behind}");
    copy.replace(&whole).await.unwrap();
    assert_eq!(fixture.copy(Vault::default()).load().await, Ok(Some(whole)));
}

#[tokio::test]
async fn what_was_not_committed_is_not_there_after_a_crash() {
    let fixture = Fixture::new();
    let copy = fixture.copy(Vault::default());
    let whole = loaded(7, [service("slam", 7, json!({}))]);
    copy.replace(&whole).await.unwrap();
    // A second connection that writes as we do and never commits: the log is as a crash leaves it.
    let crashed = Connection::open(fixture.path()).unwrap();
    crashed
        .execute_batch("BEGIN IMMEDIATE; DELETE FROM documents; UPDATE head SET revision = 9")
        .unwrap();
    let taken = tempfile::tempdir().unwrap();
    for entry in fs::read_dir(fixture.folder.path()).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), taken.path().join(entry.file_name())).unwrap();
    }
    let path = taken.path().join(DATABASE_NAME);
    let after = SqliteCopy::new(path, "edge".parse().unwrap(), Vault::default(), &fixture.supervisor).unwrap();
    assert_eq!(after.load().await, Ok(Some(whole)));
}
