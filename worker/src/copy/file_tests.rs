//! What concerns the file as a file; the rest is in [`conformance`](crate::copy::conformance).

use serde_json::json;
use tempfile::TempDir;

use super::*;
use crate::copy::samples::{loaded, service, with_secret};

fn layer(name: &str) -> LayerName {
    name.parse().unwrap()
}

fn copy(folder: &TempDir, vault: Vault) -> FileCopy {
    FileCopy::new(folder.path(), layer("edge"), vault)
}

fn names(folder: &TempDir) -> Vec<String> {
    let entries = fs::read_dir(folder.path()).unwrap();
    let mut names: Vec<String> =
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[tokio::test]
async fn only_its_owner_reads_it_and_nothing_else_is_left() {
    let folder = tempfile::tempdir().unwrap();
    let file = copy(&folder, Vault::default());
    assert_eq!(file.load().await, Ok(None));
    // One that a crash has left, readable by all.
    fs::write(folder.path().join("last-known-good.new"), "rest").unwrap();
    file.replace(&loaded(7, [service("slam", 7, json!({}))])).await.unwrap();
    assert_eq!(names(&folder), [FILE_NAME]);
    let mode = fs::metadata(folder.path().join(FILE_NAME)).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o600);
}

#[tokio::test]
async fn what_cannot_be_read_is_moved_aside_by_the_first_write() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(FILE_NAME);
    let right = Vault::with_key([7; 32]);
    let whole = loaded(7, [with_secret("slam", 7, "canary")]);
    copy(&folder, right.clone()).replace(&whole).await.unwrap();
    let content = fs::read(&path).unwrap();
    // Started with the wrong key, and then with the right one again: nothing is lost.
    let wrong = copy(&folder, Vault::with_key([8; 32]));
    assert!(matches!(wrong.load().await, Err(CopyError::OtherKey { .. })));
    assert_eq!(names(&folder), [FILE_NAME]);
    assert_eq!(copy(&folder, right).load().await.unwrap(), Some(whole));
    let next = loaded(8, [service("slam", 8, json!({}))]);
    wrong.replace(&next).await.unwrap();
    assert_eq!(wrong.load().await.unwrap(), Some(next));
    assert_eq!(names(&folder), [FILE_NAME, "last-known-good.broken"]);
    assert_eq!(fs::read(folder.path().join("last-known-good.broken")).unwrap(), content);
    // What is written over is what could be read.
    wrong.replace(&loaded(9, [])).await.unwrap();
    assert_eq!(names(&folder).len(), 2);
}

#[tokio::test]
async fn a_folder_that_is_not_there_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let file = FileCopy::new(&folder.path().join("missing"), layer("edge"), Vault::default());
    assert_eq!(file.load().await, Ok(None));
    let error = file.replace(&loaded(7, [])).await.unwrap_err();
    assert!(
        matches!(&error, CopyError::Refused { place, .. } if place.contains("missing")),
        "{error}"
    );
}
