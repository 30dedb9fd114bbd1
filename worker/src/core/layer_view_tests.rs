use serde_json::json;

use super::super::testing::{document, keys};
use super::*;

fn at(second: i64) -> Timestamp {
    Timestamp::from_millis(1_795_244_472_000 + second * 1000)
}

fn welcome(revision: u64, resumed: bool) -> Incoming {
    Incoming::Welcome { protocol: PROTOCOL, store_id: "store".to_owned(), revision, resumed }
}

fn node(name: &str, revision: u64) -> Document {
    document(&format!("Node/{name}"), revision, json!({"layer": "edge"}))
}

fn part(revision: u64, documents: Vec<Document>, last: bool) -> Incoming {
    Incoming::Snapshot { revision, documents, last }
}

fn put(revision: u64, previous: u64, document: Document) -> Incoming {
    Incoming::Commit { revision, previous, edits: vec![Edit::Put(document)] }
}

fn remove(revision: u64, previous: u64, document: Document) -> Incoming {
    Incoming::Commit { revision, previous, edits: vec![Edit::Remove(document.key)] }
}

fn bookmark(revision: u64, digest: &str) -> Incoming {
    Incoming::Bookmark { revision, digest: digest.to_owned(), beside: Vec::new() }
}

/// Two nodes at revision 10, from a snapshot.
fn view() -> LayerView {
    let mut view = LayerView::default();
    view.apply(welcome(10, false), at(0)).unwrap();
    let documents = vec![node("a", 3), node("b", 4)];
    view.apply(part(10, documents, true), at(0)).unwrap();
    view
}

/// The same as a copy of an earlier life that has just connected again.
fn resumed(revision: u64) -> LayerView {
    let mut copy = view();
    copy.apply(bookmark(revision, ""), at(0)).unwrap();
    let state = copy.state().clone();
    let mut view = LayerView::from_copy("store".to_owned(), state, at(0));
    view.apply(welcome(revision, true), at(1)).unwrap();
    view
}

fn change(applied: Result<Applied, SyncFault>) -> Change {
    match applied {
        Ok(Applied::Changed(change)) => *change,
        other => panic!("{other:?} instead of a change"),
    }
}

fn is_nothing(applied: &Result<Applied, SyncFault>) -> bool {
    matches!(applied, Ok(Applied::Nothing))
}

#[test]
fn a_snapshot_is_applied_whole_with_its_last_part() {
    let mut view = LayerView::default();
    assert_eq!(view.resume_point().revision, 0);
    assert!(is_nothing(&view.apply(welcome(12, false), at(0))));
    assert!(is_nothing(&view.apply(part(12, vec![node("a", 3)], false), at(0))));
    assert!(view.state().is_empty() && !view.is_in_sync());
    let change = change(view.apply(part(12, vec![node("b", 4)], true), at(5)));
    assert_eq!(change.keys, keys(["Node/a", "Node/b"]));
    assert_eq!((change.new.len(), change.new.revision()), (2, 12));
    assert!(view.is_in_sync());
    assert_eq!(view.as_of(), Some(at(5)));
    let digest = view.digest();
    let point = view.resume_point();
    assert_eq!((point.store_id.as_str(), point.revision, point.digest), ("store", 12, digest));
}

#[test]
fn a_snapshot_that_breaks_off_leaves_everything_as_it_was() {
    let mut view = view();
    view.disconnected();
    view.apply(welcome(20, false), at(1)).unwrap();
    view.apply(part(20, vec![node("c", 15)], false), at(1)).unwrap();
    view.disconnected();
    assert_eq!((view.state().len(), view.state().revision()), (2, 10));
    assert_eq!(view.resume_point().revision, 10);
    // The next snapshot begins anew: the part of the broken one is not in it.
    view.apply(welcome(21, false), at(2)).unwrap();
    let change = change(view.apply(part(21, vec![node("a", 3), node("d", 21)], true), at(2)));
    assert_eq!(change.keys, keys(["Node/b", "Node/d"]));
    assert_eq!(change.new.len(), 2);
}

#[test]
fn parts_of_two_snapshots_are_not_mixed() {
    let mut view = LayerView::default();
    view.apply(welcome(12, false), at(0)).unwrap();
    view.apply(part(12, vec![node("a", 3)], false), at(0)).unwrap();
    let fault = view.apply(part(13, vec![node("b", 13)], true), at(0)).unwrap_err();
    assert_eq!(fault, SyncFault::Mixed { expected: 12, got: 13 });
    assert!(view.state().is_empty());
}

#[test]
fn more_documents_than_a_store_may_have_are_not_taken() {
    let mut view = LayerView::default();
    view.apply(welcome(12, false), at(0)).unwrap();
    let one = node("a", 3);
    let many = vec![one; MAX_DOCUMENTS];
    view.apply(part(12, many, false), at(0)).unwrap();
    let fault = view.apply(part(12, vec![node("b", 4)], true), at(0)).unwrap_err();
    assert_eq!(fault, SyncFault::TooMany);
    assert!(view.state().is_empty());
}

#[test]
fn commits_in_a_row_are_applied() {
    let mut view = view();
    let first = change(view.apply(put(12, 10, node("c", 12)), at(1)));
    assert_eq!((first.keys, first.new.revision()), (keys(["Node/c"]), 12));
    let second = change(view.apply(remove(15, 12, node("a", 3)), at(2)));
    assert_eq!(second.new.len(), 2);
    change(view.apply(remove(16, 15, node("c", 12)), at(3)));
    change(view.apply(put(17, 16, node("b", 17)), at(4)));
    assert_eq!((view.state().len(), view.state().revision()), (1, 17));
    assert_eq!(view.as_of(), Some(at(4)));
}

#[test]
fn a_lost_commit_is_noticed_and_leads_to_a_snapshot() {
    let mut view = view();
    let fault = view.apply(put(14, 12, node("c", 14)), at(1)).unwrap_err();
    assert_eq!(fault, SyncFault::Gap { expected: 10, got: 12 });
    assert!(!view.is_in_sync());
    // What was there is still served, and nothing else comes in before a new stream.
    assert_eq!((view.state().len(), view.state().revision()), (2, 10));
    let after = view.apply(put(11, 10, node("c", 11)), at(1));
    assert!(matches!(after, Err(SyncFault::Unexpected { .. })));
    assert_eq!(
        view.resume_point(),
        ResumePoint { store_id: String::new(), revision: 0, digest: String::new() }
    );
    view.disconnected();
    view.apply(welcome(14, false), at(2)).unwrap();
    change(view.apply(part(14, vec![node("a", 3), node("b", 4), node("c", 14)], true), at(2)));
    assert_eq!(view.resume_point().revision, 14);
}

#[test]
fn a_bookmark_raises_the_revision_but_not_what_commits_follow_on() {
    let mut view = view();
    let digest = view.digest();
    assert!(is_nothing(&view.apply(bookmark(30, &digest), at(7))));
    assert_eq!((view.state().revision(), view.as_of()), (30, Some(at(7))));
    assert!(is_nothing(&view.apply(bookmark(20, "whatever"), at(7))));
    assert_eq!(view.state().revision(), 30);
    // The last commit that was told is still the one of the snapshot.
    change(view.apply(put(31, 10, node("c", 31)), at(8)));
    let fault = view.apply(put(31, 31, node("c", 31)), at(8)).unwrap_err();
    assert_eq!(fault, SyncFault::Gap { expected: 31, got: 31 });
}

#[test]
fn a_commit_below_the_bookmark_is_a_gap() {
    let mut view = view();
    view.apply(bookmark(30, ""), at(7)).unwrap();
    let fault = view.apply(put(25, 10, node("c", 25)), at(8)).unwrap_err();
    assert_eq!(fault, SyncFault::Gap { expected: 10, got: 25 });
}

#[test]
fn other_documents_at_the_same_revision_are_noticed() {
    let mut view = view();
    assert!(is_nothing(&view.apply(bookmark(11, ""), at(1))));
    let ours = view.digest();
    let fault = view.apply(bookmark(12, "sha256:other"), at(2)).unwrap_err();
    let theirs = "sha256:other".to_owned();
    assert_eq!(fault, SyncFault::Digest { revision: 12, ours, theirs });
    assert_eq!((view.resume_point().revision, view.as_of()), (0, Some(at(1))));
}

#[test]
fn the_digest_follows_the_documents() {
    let mut view = view();
    let before = view.digest();
    change(view.apply(put(12, 10, node("c", 12)), at(1)));
    let during = view.digest();
    assert_ne!(during, before);
    change(view.apply(remove(13, 12, node("c", 12)), at(1)));
    assert_eq!(view.digest(), before);
}

#[test]
fn after_a_resume_what_was_applied_already_may_come_again() {
    for (repeats, previous) in
        [(vec![(9, 5), (12, 9)], 12), (vec![(14, 9)], 14), (vec![(9, 5)], 14), (vec![], 14)]
    {
        let mut view = resumed(14);
        for (revision, previous) in repeats {
            let again = view.apply(remove(revision, previous, node("a", 3)), at(2));
            assert!(is_nothing(&again));
            assert_eq!(view.state().len(), 2);
        }
        change(view.apply(put(16, previous, node("c", 16)), at(3)));
        // From now on nothing comes twice.
        let fault = view.apply(remove(14, 9, node("a", 3)), at(4)).unwrap_err();
        assert_eq!(fault, SyncFault::Gap { expected: 16, got: 9 });
    }
}

#[test]
fn after_a_resume_a_gap_is_one_all_the_same() {
    let mut view = resumed(14);
    let fault = view.apply(put(18, 16, node("c", 18)), at(2)).unwrap_err();
    assert_eq!(fault, SyncFault::Gap { expected: 14, got: 16 });
}

#[test]
fn a_resume_of_another_store_or_of_an_older_one_is_a_fault() {
    for (store_id, revision) in [("other", 14), ("store", 9)] {
        let state = resumed(14).state().clone();
        let mut view = LayerView::from_copy("store".to_owned(), state, at(0));
        let incoming = Incoming::Welcome {
            protocol: PROTOCOL,
            store_id: store_id.to_owned(),
            revision,
            resumed: true,
        };
        let fault = view.apply(incoming, at(0)).unwrap_err();
        assert!(matches!(fault, SyncFault::OtherStore { ours: 14, .. }), "{fault}");
        assert_eq!(view.resume_point().revision, 0);
    }
}

#[test]
fn who_is_behind_the_store_is_not_in_sync_yet() {
    let state = resumed(14).state().clone();
    let mut view = LayerView::from_copy("store".to_owned(), state, at(0));
    view.apply(welcome(16, true), at(5)).unwrap();
    assert!(!view.is_in_sync());
    change(view.apply(put(15, 14, node("c", 15)), at(6)));
    assert_eq!((view.is_in_sync(), view.as_of()), (false, Some(at(0))));
    view.apply(bookmark(16, ""), at(7)).unwrap();
    assert_eq!((view.is_in_sync(), view.as_of()), (true, Some(at(7))));
    view.disconnected();
    assert_eq!((view.is_in_sync(), view.as_of()), (false, Some(at(7))));
}

#[test]
fn messages_out_of_order_are_faults() {
    let mut view = LayerView::default();
    let fault = view.apply(bookmark(3, ""), at(0)).unwrap_err();
    assert_eq!(fault, SyncFault::Unexpected { message: "Bookmark", waited_for: "a Welcome" });
    // Nothing is known to be wrong with the copy.
    let mut view = self::view();
    view.apply(welcome(10, true), at(0)).unwrap_err();
    assert_eq!(view.resume_point().revision, 10);
    view.disconnected();
}

#[test]
fn a_main_service_one_version_older_is_understood_and_no_other() {
    let welcome = |protocol| Incoming::Welcome {
        protocol,
        store_id: String::new(),
        revision: 1,
        resumed: false,
    };
    let met = |theirs| {
        let mut view = self::view();
        view.disconnected();
        view.apply(welcome(theirs), at(0))
    };
    for theirs in [PROTOCOL - 1, PROTOCOL] {
        assert!(met(theirs).is_ok(), "{theirs}");
    }
    for theirs in [OLDEST_PROTOCOL - 1, PROTOCOL + 1] {
        let fault = met(theirs).unwrap_err();
        assert_eq!(fault, SyncFault::Protocol { theirs });
        assert!(fault.to_string().contains("update the older of the two"), "{fault}");
    }
}

#[test]
fn no_secret_is_shown() {
    let spec =
        json!({"layer": "edge", "config": {"pw": {"$secret": {"text": "canary", "version": 3}}}});
    let document = document("Node/a", 3, spec);
    for incoming in [part(10, vec![document.clone()], true), put(11, 10, document.clone())] {
        assert!(!format!("{incoming:?}").contains("canary"));
    }
    let mut view = view();
    let applied = view.apply(put(11, 10, document), at(0)).unwrap();
    assert!(!format!("{applied:?}").contains("canary"));
}
