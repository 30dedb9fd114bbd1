use std::os::unix::fs::PermissionsExt as _;
use std::sync::Arc;

use blaze_runtime::supervisor::Supervisor;
use tempfile::TempDir;

use super::*;
use crate::store::backup;
use crate::store::samples::{commit, commit_of, record};

/// Files in a folder.
struct Files {
    folder: TempDir,
    supervisor: Supervisor,
}

impl Files {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap(), supervisor: Supervisor::new("test") }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(format!("{name}.db"))
    }

    async fn store(&self) -> SqliteStore {
        SqliteStore::open(&self.path("store"), &self.supervisor).await.unwrap()
    }
}

#[tokio::test]
async fn the_log_is_copied_into_the_file_by_tidying_and_begun_anew() {
    let files = Files::new();
    let store = files.store().await;
    let log = files.folder.path().join("store.db-wal");
    let alone = files.path("alone");
    let mut sizes = Vec::new();
    for revision in 1..=50 {
        store.commit(&[record(commit(revision, &["a"]))]).await.unwrap();
        store.tidy().await.unwrap();
        // Without its log the file has it all.
        std::fs::copy(files.path("store"), &alone).unwrap();
        let copy = rusqlite::Connection::open(&alone).unwrap();
        let head: i64 =
            copy.query_row("SELECT max(revision) FROM events", [], |row| row.get(0)).unwrap();
        assert_eq!(head.unsigned_abs(), revision);
        sizes.push(std::fs::metadata(&log).unwrap().len());
    }
    assert_eq!(sizes[40..].iter().max(), sizes[5..40].iter().max(), "it does not grow: {sizes:?}");
    store.close().await;
    assert!(!log.exists());
}

#[tokio::test]
async fn a_second_opening_is_refused_until_the_first_is_closed() {
    let files = Files::new();
    let first = files.store().await;
    let refused = SqliteStore::open(&files.path("store"), &files.supervisor).await.err().unwrap();
    assert!(
        matches!(
            &refused,
            StoreError::Refused(text) if text.contains("one process per SQLite file"),
        ),
        "{refused}"
    );
    // By another path to the same file, too.
    let link = files.path("link");
    std::os::unix::fs::symlink(files.path("store"), &link).unwrap();
    assert!(SqliteStore::open(&link, &files.supervisor).await.is_err());
    first.close().await;
    files.store().await.close().await;
    drop(first);
    let ended = async {
        while !files.supervisor.running().is_empty() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(std::time::Duration::from_secs(10), ended)
        .await
        .expect("threads and tasks end");
}

#[tokio::test]
async fn a_long_read_holds_up_neither_commits_nor_health() {
    let files = Files::new();
    let store = files.store().await;
    let (begin, began) = tokio::sync::oneshot::channel();
    let (end, ended) = std::sync::mpsc::sync_channel::<()>(1);
    let long = store.read(move |_| {
        begin.send(()).unwrap();
        // Ends with the other side, whatever becomes of the test.
        let _ = ended.recv();
        Ok(())
    });
    let others = async {
        began.await.unwrap();
        assert_eq!(store.head().await.unwrap(), 0);
        assert_eq!(store.idempotency("x", now()).await.unwrap(), None);
        assert!(store.tokens(now()).await.unwrap().is_empty());
        store.commit(&[record(commit(1, &["a"]))]).await.unwrap();
        assert_eq!(store.head().await.unwrap(), 1);
        drop(end);
    };
    let both = async { tokio::join!(long, others) };
    let (long, ()) = tokio::time::timeout(std::time::Duration::from_secs(10), both).await.unwrap();
    long.unwrap();
}

#[tokio::test]
async fn a_folder_that_is_not_there_is_refused_at_once() {
    let files = Files::new();
    for path in
        [files.folder.path().join("missing").join("store.db"), PathBuf::from("/dev/null/store.db")]
    {
        let error = SqliteStore::open(&path, &files.supervisor).await.err().unwrap();
        assert!(
            matches!(
                &error,
                StoreError::Refused(text) if text.contains("control_plane.store.sqlite.path"),
            ),
            "{error}"
        );
        assert!(!error.is_transient());
    }
}

#[tokio::test]
async fn a_shutdown_ends_its_threads() {
    let files = Files::new();
    let store = files.store().await;
    store.commit(&[record(commit(1, &["a"]))]).await.unwrap();
    let report = files.supervisor.shutdown(std::time::Duration::from_secs(10)).await;
    assert!(report.is_clean(), "{report:?}");
    assert!(matches!(store.head().await, Err(StoreError::Unavailable(_))));
    let again = SqliteStore::open(&files.path("store"), &Supervisor::new("again")).await.unwrap();
    assert_eq!(again.head().await.unwrap(), 1);
}

#[tokio::test]
async fn a_full_disk_is_an_error_and_goes_on_when_there_is_room() {
    let files = Files::new();
    let store = files.store().await;
    store.commit(&[record(commit(1, &["a"]))]).await.unwrap();
    let pages = |limit: i64| {
        store.write(move |connection| {
            let set = connection
                .pragma_update_and_check(None, "max_page_count", limit, |row| row.get::<_, i64>(0));
            set.map_err(errors::store_error)
        })
    };
    let now = pages(1).await.unwrap();
    let mut large = commit(2, &["b"]);
    let mut document = (*large.changes[0].document).clone();
    document.spec = Arc::new(serde_json::json!({ "config": { "text": "x".repeat(200_000) } }));
    large.changes[0].document = Arc::new(document);
    let error = store.commit(&[record(large.clone())]).await.unwrap_err();
    let CommitError::NotWritten(StoreError::Unavailable(text)) = &error else { panic!("{error}") };
    assert!(text.contains("free space"), "{text}");
    assert_eq!(store.load().await.unwrap().revision, 1);
    pages(now + 10_000).await.unwrap();
    store.commit(&[record(large)]).await.unwrap();
    assert_eq!(store.load().await.unwrap().documents.len(), 2);
}

#[tokio::test]
async fn a_file_that_may_not_be_written_is_an_error() {
    let files = Files::new();
    let store = files.store().await;
    store.commit(&[record(commit(1, &["a"]))]).await.unwrap();
    store
        .write(|connection| {
            connection.pragma_update(None, "query_only", "ON").map_err(errors::store_error)
        })
        .await
        .unwrap();
    let error = store.commit(&[record(commit(2, &["a"]))]).await.unwrap_err();
    assert!(matches!(&error, CommitError::NotWritten(StoreError::Unavailable(_))), "{error}");
    assert_eq!(store.head().await.unwrap(), 1);
}

#[tokio::test]
async fn a_file_of_another_program_is_left_alone() {
    let files = Files::new();
    let path = files.path("store");
    Connection::open(&path).unwrap().execute_batch("CREATE TABLE addresses (name TEXT)").unwrap();
    let before = std::fs::read(&path).unwrap();
    let error = SqliteStore::open(&path, &files.supervisor).await.err().unwrap();
    assert!(
        matches!(&error, StoreError::Refused(text) if text.contains("another program")),
        "{error}"
    );
    assert_eq!(std::fs::read(&path).unwrap(), before);
    std::fs::write(&path, "no database at all, but long enough to be looked at as one".repeat(20))
        .unwrap();
    let error = SqliteStore::open(&path, &files.supervisor).await.err().unwrap();
    assert!(matches!(error, StoreError::Corrupt(_)), "{error}");
}

#[tokio::test]
async fn only_its_owner_reads_the_file() {
    let files = Files::new();
    let store = files.store().await;
    store.commit(&[record(commit(1, &["a"]))]).await.unwrap();
    for entry in std::fs::read_dir(files.folder.path()).unwrap() {
        let entry = entry.unwrap();
        let mode = entry.metadata().unwrap().permissions().mode() & 0o777;
        assert_eq!(mode, 0o600, "{:?}", entry.path());
    }
}

#[tokio::test]
async fn a_plan_changes_nothing() {
    let files = Files::new();
    let path = files.path("store");
    let plan = SqliteStore::plan(&path, &Migrations::default()).await.unwrap();
    assert_eq!((plan.version, plan.pending.len()), (0, 1));
    assert!(!path.exists());
    files.store().await.close().await;
    let plan = SqliteStore::plan(&path, &Migrations::default()).await.unwrap();
    assert_eq!((plan.version, plan.target, plan.pending.len()), (1, 1, 0));
}

#[tokio::test]
async fn a_backup_is_made_beside_a_running_process() {
    let files = Files::new();
    let store = files.store().await;
    store.commit(&[record(commit(1, &["a"])), record(commit(2, &["b"]))]).await.unwrap();
    let mut file = Vec::new();
    let path = files.path("store");
    let summary = backup::write(
        |pieces| SqliteStore::export_beside(&path, &files.supervisor, pieces),
        &mut file,
    )
    .await;
    assert_eq!(summary.unwrap().head.revision, 2);
    let missing = files.path("missing");
    let refused = backup::write(
        |pieces| SqliteStore::export_beside(&missing, &files.supervisor, pieces),
        &mut file,
    )
    .await;
    assert!(matches!(refused, Err(backup::BackupError::Store(StoreError::Refused(_)))));
    assert!(!missing.exists());
}

#[tokio::test]
async fn in_memory_it_is_a_store_as_well() {
    let supervisor = Supervisor::new("test");
    let store = SqliteStore::in_memory(&supervisor).await.unwrap();
    assert!(!store.is_shared());
    store.commit(&[record(commit(1, &["a"])), record(commit(2, &["b"]))]).await.unwrap();
    assert_eq!(store.load().await.unwrap().documents.len(), 2);
    assert_eq!(store.trim(1, 1).await.unwrap(), 1);
    assert_eq!(store.commits_after(1, 10).await.unwrap().commits.len(), 1);
    assert!(matches!(
        store.commit(&[record(commit_of(9, Vec::new()))]).await,
        Err(CommitError::NotWritten(_))
    ));
    drop(store);
    let other = SqliteStore::in_memory(&supervisor).await.unwrap();
    assert_eq!(other.head().await.unwrap(), 0);
}
