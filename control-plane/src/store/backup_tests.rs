use std::io::Cursor;

use blaze_runtime::supervisor::Supervisor;

use super::*;
use crate::store::samples::{audit, commit, record, token};
use crate::store::upkeep::RESTORE_RAISES_BY;
use crate::store::{Archive as _, CommitLog as _, SqliteStore, TokenStore as _};

async fn store() -> SqliteStore {
    SqliteStore::in_memory(&Supervisor::new("test")).await.unwrap()
}

async fn filled() -> SqliteStore {
    let store = store().await;
    store.commit(&[record(commit(1, &["a", "b"])), record(commit(2, &["a"]))]).await.unwrap();
    store.append_audit(&[audit("x", None)]).await.unwrap();
    store.add_token(&token("t"), &audit("y", None)).await.unwrap();
    store
}

async fn backup_of(store: &SqliteStore) -> Vec<u8> {
    let mut file = Vec::new();
    let summary = write(|pieces| store.export(pieces), &mut file).await.unwrap();
    assert_eq!(summary.head.revision, 2);
    assert_eq!(summary, check(&mut Cursor::new(&file)).unwrap());
    file
}

#[tokio::test]
async fn what_was_backed_up_is_restored() {
    let file = backup_of(&filled().await).await;
    let (old, new) = (filled().await, store().await);
    let restored = restore(&new, &mut Cursor::new(file)).await.unwrap();
    assert_eq!(restored.revision, 2 + RESTORE_RAISES_BY);
    let (before, after) = (old.load().await.unwrap(), new.load().await.unwrap());
    assert_eq!((after.revision, after.floor), (restored.revision, restored.revision));
    assert_eq!(after.store_id, restored.store_id);
    let sorted = |mut documents: Vec<blaze_domain::config::Document>| {
        documents.sort_by(|one, other| one.key.cmp(&other.key));
        documents
    };
    assert_eq!(sorted(after.documents), sorted(before.documents));
    new.commit(&[record(commit(restored.revision + 1, &["c"]))]).await.unwrap();
}

#[tokio::test]
async fn a_file_that_was_cut_or_changed_restores_nothing() {
    let file = backup_of(&filled().await).await;
    let new = store().await;
    let text = String::from_utf8(file.clone()).unwrap();
    let without_a_line: String = text
        .split_inclusive('\n')
        .enumerate()
        .filter(|(at, _)| *at != 2)
        .map(|(_, line)| line)
        .collect();
    let mut broken = vec![
        Vec::new(),
        b"{}\n".to_vec(),
        without_a_line.into_bytes(),
        text.replacen("ops", "oops", 1).into_bytes(),
        text.replacen("\"format\":1", "\"format\":2", 1).into_bytes(),
        [file.clone(), b"{}\n".to_vec()].concat(),
    ];
    for cut in (0..file.len()).step_by(97) {
        broken.push(file[..cut].to_vec());
    }
    for file in broken {
        let error = restore(&new, &mut Cursor::new(file)).await.unwrap_err();
        assert!(matches!(error, BackupError::Line { .. }), "{error}");
    }
    assert_eq!(new.load().await.unwrap().revision, 0);
}

#[tokio::test]
async fn only_an_empty_store_is_filled() {
    let store = filled().await;
    let file = backup_of(&store).await;
    let error = restore(&store, &mut Cursor::new(file)).await.unwrap_err();
    assert!(matches!(error, BackupError::Store(StoreError::Refused(_))), "{error}");
}

/// A disk that is full after some bytes.
struct Full(usize);

impl Write for Full {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0 = self.0.checked_sub(bytes.len()).ok_or(std::io::ErrorKind::StorageFull)?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[tokio::test]
async fn a_full_disk_ends_the_export() {
    let store = filled().await;
    let error = write(|pieces| store.export(pieces), &mut Full(500)).await.unwrap_err();
    assert!(matches!(error, BackupError::File(_)), "{error}");
}
