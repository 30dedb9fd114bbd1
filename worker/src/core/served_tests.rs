use std::sync::Arc;
use std::time::Duration;

use blaze_domain::config::Document;
use serde_json::json;

use super::super::asked::{ASKED_FOR, MAX_ASKED};
use super::super::notice::Scope;
use super::super::testing::{document, keys, labelled, place, site, state};
use super::*;

fn documents() -> Vec<Document> {
    vec![
        document("Layer/edge", 1, json!({"config": {"log": "info"}})),
        labelled("Node/robot-1", 2, json!({"layer": "edge"}), ("canary", "true")),
        document("Node/robot-2", 2, json!({"layer": "edge"})),
        document("Service/slam", 3, json!({"config": {"rate_hz": 30}})),
        document("Instance/slam/0", 4, json!({"node": "robot-1", "config": {"fov": 1}})),
        document("Instance/slam/1", 4, json!({"node": "robot-2"})),
        document("Instance/slam/2", 4, json!({"layer": "edge"})),
        document("Instance/slam/3", 4, json!({})),
    ]
}

/// What has been told at revision 10.
fn served(node: Option<&str>) -> Served {
    let mut served = Served::new(site(node));
    served.load(state(10, documents()), Source::Copy);
    served.flush(Instant::now());
    served.set_in_sync(true);
    served
}

/// Puts documents, as a commit of a revision does.
fn put(served: &mut Served, revision: u64, documents: Vec<Document>) {
    let mut change = begin(served);
    for document in documents {
        change.keys.push(document.key.clone());
        change.new.put(Arc::new(document));
    }
    change.new.advance(revision, []);
    served.apply(&change);
}

fn remove<const N: usize>(served: &mut Served, revision: u64, texts: [&str; N]) {
    let mut change = begin(served);
    change.keys = keys(texts);
    for key in &change.keys {
        change.new.remove(key);
    }
    change.new.advance(revision, []);
    served.apply(&change);
}

fn begin(served: &Served) -> Change {
    Change { keys: Vec::new(), new: served.next.state.clone() }
}

fn flush(served: &mut Served) -> Vec<Notice> {
    served.flush(Instant::now()).notices
}

fn places(notices: &[Notice]) -> Vec<String> {
    notices.iter().map(|notice| notice.place.to_string()).collect()
}

fn slam(rate: u64, revision: u64) -> Document {
    document("Service/slam", revision, json!({"config": {"rate_hz": rate}}))
}

#[test]
fn the_first_documents_are_told_to_everybody_who_has_one() {
    let mut served = Served::new(site(None));
    assert!(!served.is_ready() && served.source().is_none());
    served.load(state(10, documents()), Source::File);
    assert!(served.has_pending() && !served.is_ready());
    let flushed = served.flush(Instant::now());
    let expected = ["slam", "slam/0 at robot-1", "slam/1 at robot-2", "slam/2", "slam/3"];
    assert_eq!(places(&flushed.notices), expected);
    assert_eq!(flushed.tracked.len(), 5);
    assert!(
        flushed
            .notices
            .iter()
            .all(|notice| notice.previous_hash.is_none() && notice.revision == 10)
    );
    assert_eq!(flushed.notices[1].paths, ["/fov", "/log", "/rate_hz"]);
    assert_eq!(flushed.notices[1].scopes, [Scope::Layer, Scope::Service, Scope::Instance]);
    assert_eq!(flushed.notices[0].source, Source::File);
    assert!(served.is_ready() && !served.has_pending());
}

#[test]
fn on_a_node_those_are_told_that_may_run_there() {
    let served = served(Some("robot-1"));
    let told: Vec<String> = served.told().map(|(place, _)| place.to_string()).collect();
    let expected =
        ["slam at robot-1", "slam/0 at robot-1", "slam/2 at robot-1", "slam/3 at robot-1"];
    assert_eq!(told, expected);
}

#[test]
fn a_change_is_told_to_those_whose_hash_it_changes() {
    let mut served = served(None);
    put(
        &mut served,
        11,
        vec![document("Instance/slam/0", 11, json!({"node": "robot-1", "config": {"fov": 2}}))],
    );
    let notices = flush(&mut served);
    assert_eq!(places(&notices), ["slam/0 at robot-1"]);
    let notice = &notices[0];
    assert_eq!((notice.revision, notice.source), (11, Source::Main));
    assert_eq!(notice.paths, ["/fov"]);
    assert_eq!(notice.scopes, [Scope::Instance]);
    assert_ne!(notice.hash, notice.previous_hash);
    let fresh = served.standing_of(&notice.place).unwrap();
    assert_eq!(notice.standing(), Some(fresh));
    // Those whose configuration is what it was keep their revision.
    let revision = |text: &str| served.standing_of(&place(text)).unwrap().revision;
    assert_eq!((revision("slam"), revision("slam/0@robot-1")), (10, 11));
}

#[test]
fn several_commits_become_one_notice_with_the_last_state() {
    let mut served = served(Some("robot-1"));
    put(&mut served, 11, vec![slam(31, 11)]);
    put(&mut served, 12, vec![document("Layer/edge", 12, json!({"config": {"log": "debug"}}))]);
    put(&mut served, 13, vec![slam(32, 13)]);
    let notices = flush(&mut served);
    assert_eq!(notices.len(), 4);
    for notice in &notices {
        assert_eq!(notice.revision, 13);
        assert_eq!(notice.paths, ["/log", "/rate_hz"]);
        assert_eq!(notice.scopes, [Scope::Layer, Scope::Service]);
        assert_eq!(notice.config.as_ref().unwrap().value()["rate_hz"], json!(32));
    }
    assert!(flush(&mut served).is_empty());
}

#[test]
fn a_deleted_service_is_told_once_to_all_its_places() {
    let now = Instant::now();
    let mut served = served(Some("robot-1"));
    served.ask(&place("slam/9@robot-1"), now).unwrap();
    let instances = ["Instance/slam/0", "Instance/slam/1", "Instance/slam/2", "Instance/slam/3"];
    remove(&mut served, 11, instances);
    remove(&mut served, 12, ["Service/slam"]);
    let flushed = served.flush(now);
    assert_eq!(flushed.notices.len(), 5);
    for notice in &flushed.notices {
        assert!(notice.hash.is_none() && notice.config.is_none() && notice.previous_hash.is_some());
        assert!(notice.paths.is_empty() && notice.scopes.is_empty() && notice.revision == 12);
    }
    assert_eq!(flushed.untracked.len(), 4, "all but the one that asked");
    assert!(served.flush(now).notices.is_empty());
    assert_eq!(served.ask(&place("slam/9@robot-1"), now), None);
    // It is there again: so it is for the one that asked.
    put(&mut served, 13, vec![slam(30, 13)]);
    let notices = served.flush(now).notices;
    assert_eq!(places(&notices), ["slam at robot-1", "slam/9 at robot-1"]);
    assert!(notices.iter().all(|notice| notice.previous_hash.is_none() && notice.revision == 13));
}

fn remembered(served: &Served) -> Vec<ServedTarget> {
    served.told().map(|(place, _)| place.clone()).collect()
}

#[test]
fn after_a_restart_nothing_older_is_told_and_places_that_asked_are_known() {
    let mut before = served(Some("robot-1"));
    put(&mut before, 20, vec![slam(31, 20)]);
    flush(&mut before);
    before.ask(&place("slam/9@robot-1"), Instant::now()).unwrap();
    let mut served = Served::new(site(Some("robot-1")));
    served.restore(before.floor(), remembered(&before), Instant::now());
    // The copy is older than what was told: nothing older is told, so the revision stays.
    served.load(state(10, documents()), Source::Copy);
    let notices = flush(&mut served);
    assert_eq!(notices.len(), 5);
    assert!(notices.iter().all(|notice| notice.revision == 20));
    // Then the main service comes back.
    put(&mut served, 21, vec![slam(31, 20)]);
    let notices = flush(&mut served);
    assert_eq!(notices.len(), 5);
    assert!(notices.iter().all(|notice| notice.revision == 21 && notice.paths == ["/rate_hz"]));
}

#[test]
fn a_service_that_went_while_the_worker_was_down_is_told() {
    let mut before = served(Some("robot-1"));
    before.ask(&place("slam/9@robot-1"), Instant::now()).unwrap();
    let mut served = Served::new(site(Some("robot-1")));
    served.restore(before.floor(), remembered(&before), Instant::now());
    served.load(state(12, [document("Layer/edge", 1, json!({}))]), Source::Copy);
    let notices = flush(&mut served);
    assert_eq!(notices.len(), 5);
    assert!(notices.iter().all(|notice| notice.hash.is_none() && notice.revision == 12));
}

#[test]
fn an_announcement_is_of_all_places_and_of_the_newest_revision() {
    let mut served = served(Some("robot-1"));
    put(&mut served, 20, vec![slam(31, 20)]);
    flush(&mut served);
    put(&mut served, 21, vec![document("Service/nav", 21, json!({ "description": "x" }))]);
    flush(&mut served);
    let notices = served.announce();
    assert_eq!(notices.len(), served.told().filter(|(_, told)| told.hash.is_some()).count());
    assert!(notices.iter().all(|notice| notice.revision == 21 && notice.previous_hash.is_none()));
    assert_eq!(served.standing_of(&notices[0].place).unwrap().revision, 21);
}

#[test]
fn a_weaker_source_never_replaces_a_stronger_one() {
    let mut served = served(Some("robot-1"));
    for source in [Source::File, Source::Copy] {
        assert!(!served.load(state(99, []), source), "{source:?}");
    }
    assert!(!served.has_pending());
    assert_eq!(served.source(), Some(Source::Main));
    served.set_in_sync(false);
    assert_eq!(
        served.source(),
        Some(Source::Copy),
        "it may be older than what the main service has"
    );
    assert!(!served.load(state(99, []), Source::Copy));
    let mut file = Served::new(site(None));
    for (source, revision) in [(Source::File, 0), (Source::File, 0), (Source::Copy, 8)] {
        assert!(file.load(state(revision, [slam(revision, revision)]), source));
        flush(&mut file);
    }
    assert!(!file.load(state(0, []), Source::File));
}

#[test]
fn a_store_that_is_behind_makes_no_revision_go_back() {
    let mut served = served(Some("robot-1"));
    put(&mut served, 50, vec![slam(31, 50)]);
    flush(&mut served);
    let change = Change {
        keys: keys(["Service/slam"]),
        new: {
            let mut new = served.state().clone();
            new.put(Arc::new(slam(32, 7)));
            new.advance(7, []);
            new
        },
    };
    served.apply(&change);
    assert!(flush(&mut served).iter().all(|notice| notice.revision == 50));
    let new = served.ask(&place("slam/9@robot-1"), Instant::now()).unwrap();
    assert_eq!(new.revision, 50);
}

#[test]
fn places_that_asked_are_bounded() {
    let now = Instant::now();
    let mut served = served(Some("robot-1"));
    for number in 0..=MAX_ASKED {
        served.ask(&place(&format!("slam/a{number}@robot-1")), now).unwrap();
    }
    assert_eq!(served.told().count(), MAX_ASKED + 4);
    assert_eq!(served.flush(now).untracked, [place("slam/a0@robot-1")]);
    let later = served.flush(now + ASKED_FOR + Duration::from_secs(1));
    assert_eq!((later.untracked.len(), served.told().count()), (MAX_ASKED, 4));
}

#[test]
fn no_secret_is_shown() {
    let mut served = served(Some("robot-1"));
    let spec = json!({"config": {"pw": {"$secret": {"text": "canary", "version": 11}}}});
    put(&mut served, 11, vec![document("Service/slam", 11, spec)]);
    let flushed = served.flush(Instant::now());
    assert_eq!(flushed.notices.len(), 4);
    assert!(!format!("{flushed:?}").contains("canary"));
}

#[path = "served_rollout_tests.rs"]
mod rollouts;
