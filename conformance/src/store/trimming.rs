//! What goes and what stays when history is trimmed.

use std::time::Duration;

use blaze_domain::config::Timestamp;

use super::Fixture;
use super::samples::{self, record};
use super::tools::{Dice, Model, commit, conflict, log, store_name};
use blaze_config::store::AuditQuery;
use blaze_config::store::upkeep::now;

/// The floor rises to what is asked for, never falls, and never passes the newest commit; commits
/// up to it are gone; revisions go on.
pub async fn the_floor_rises_and_commits_go(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "floor").await;
    assert_eq!(model.store.trim(5, 1).await.unwrap(), 0, "the floor of an empty store");
    for _ in 0..9 {
        model.write(&[&["a", "b"]]).await;
    }
    for (asked, expected) in [(4, 4), (2, 4), (4, 4), (6, 6)] {
        let floor = model.store.trim(asked, 2).await.unwrap();
        assert_eq!(floor, expected, "the floor after trim({asked})");
        model.check_now().await;
        let commits = model
            .commits
            .iter()
            .filter(|commit| commit.revision > expected)
            .cloned()
            .collect::<Vec<_>>();
        assert_eq!(log(model.store.as_ref(), expected).await, commits, "commits above the floor");
        let below = model.store.commits_after(expected - 1, 10).await.unwrap();
        assert_eq!(below.floor, expected, "the floor that a reader below it is told");
        assert_eq!(model.store.load().await.unwrap().floor, expected, "the loaded floor");
    }
    assert_eq!(model.store.trim(99, 1).await.unwrap(), 9, "the floor at the newest commit");
    model.check_now().await;
    assert_eq!(log(model.store.as_ref(), 9).await.len(), 0, "commits above it");
    model.write(&[&["a"], &["c"]]).await;
    model.check_now().await;
    assert_eq!(log(model.store.as_ref(), 9).await.len(), 2, "commits after the floor");
}

/// Of each document stay the version that holds at the floor, all above it, and the newest ones
/// that are to be kept.
pub async fn versions_that_hold_or_are_young_stay(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "stay").await;
    // a: 1 2 3 4 5 9, b: 1 (holds for ever), c: 2 and deleted at 3.
    let commits: [&[&str]; 9] =
        [&["a", "b"], &["a", "c"], &["a", "-c"], &["a"], &["a"], &["d"], &["d"], &["d"], &["a"]];
    for names in commits {
        model.write(&[names]).await;
    }
    for (floor, keep, a, b) in [
        (4, 3, vec![9, 5, 4], vec![1]),
        (5, 3, vec![9, 5, 4], vec![1]),
        (8, 2, vec![9, 5], vec![1]),
        (9, 1, vec![9], vec![1]),
    ] {
        model.store.trim(floor, keep).await.unwrap();
        for (name, expected) in
            [("a", a), ("b", b), ("c", if keep > 1 { vec![3, 2] } else { vec![3] })]
        {
            let found = model.store.versions(&samples::key(name), None, 20).await.unwrap();
            let found: Vec<u64> = found.iter().map(|version| version.revision).collect();
            assert_eq!(found, expected, "versions of {name}, trim({floor}, {keep})");
        }
        model.check_past(floor).await;
        model.check_now().await;
    }
}

/// However long a history is, what is to spare of it goes, and nothing else.
pub async fn a_long_history_is_trimmed(fixture: &dyn Fixture) {
    // More than a store goes through at once.
    const GROUPS: u64 = 210;
    const GROUP: usize = 100;
    let newest = GROUPS * GROUP as u64;
    let mut model = Model::new(fixture, "long").await;
    model.write(&[&["b"]]).await;
    for _ in 0..GROUPS {
        model.write(&[&["a"][..]; GROUP]).await;
    }
    let newest = newest + 1;
    let revisions = async |name: &str| -> Vec<u64> {
        let found = model.store.versions(&samples::key(name), None, 1000).await.unwrap();
        found.iter().map(|version| version.revision).collect()
    };
    for (floor, keep, oldest) in
        [(10, 1000, newest - 999), (newest - 300, 3, newest - 300), (newest, 1, newest)]
    {
        assert_eq!(model.store.trim(floor, keep).await.unwrap(), floor, "the floor");
        let expected: Vec<u64> = (oldest..=newest).rev().collect();
        assert_eq!(revisions("a").await, expected, "versions of a, trim({floor}, {keep})");
        assert_eq!(revisions("b").await, [1], "versions of b");
    }
    model.check_now().await;
}

/// Newer versions of a document count, also where many commits of others came since.
pub async fn many_commits_of_others_hide_no_version(fixture: &dyn Fixture) {
    // More than a store looks through at once.
    const OTHERS: usize = 205;
    let mut model = Model::new(fixture, "hidden").await;
    for name in ["a", "a", "b", "b", "a"].into_iter().chain(["b"; OTHERS]) {
        model.write(&[&[name]]).await;
    }
    assert_eq!(model.store.trim(4, 2).await.unwrap(), 4, "the floor");
    let found = model.store.versions(&samples::key("a"), None, 20).await.unwrap();
    let found: Vec<u64> = found.iter().map(|version| version.revision).collect();
    assert_eq!(found, [5, 2], "versions of a");
    model.check_past(4).await;
    model.check_now().await;
}

/// Audit entries and answers to repeat are there once each, however often their commits are trimmed
/// away; a key that is taken stays taken.
pub async fn what_outlives_a_commit_stays(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "outlives").await;
    let mut written = Vec::new();
    for number in 0..6 {
        let mut next = model.record(&["a", "b"]);
        next.idempotency = Some(samples::answer(&format!("answer-{number}"), model.revision()));
        commit(model.store.as_ref(), &[next.clone()]).await;
        written.push(next);
    }
    for floor in [0, 2, 2, 5, 6] {
        model.store.trim(floor, 1).await.unwrap();
        model.store.tidy().await.unwrap();
        let query = AuditQuery { limit: 100, ..AuditQuery::default() };
        let audit = model.store.audit(&query).await.unwrap();
        let mut expected: Vec<_> = written.iter().flat_map(|record| record.audit.clone()).collect();
        expected.sort_by(|one, other| other.id.cmp(&one.id));
        assert_eq!(audit, expected, "the audit, trimmed to {floor}");
        for record in &written {
            let expected = record.idempotency.clone();
            let id = expected.as_ref().map_or("", |answer| answer.id.as_str());
            let found = model.store.idempotency(id, now()).await.unwrap();
            assert_eq!(found, expected, "an answer, trimmed to {floor}");
        }
        let mut again = record(samples::commit(7, &["late"]));
        again.idempotency = Some(samples::answer("answer-1", 7));
        conflict("an answer that is there", &model.store.commit(&[again]).await);
    }
    model.check_now().await;
}

/// Whatever is written and trimmed, what was at each revision from the floor on can be told,
/// exactly.
pub async fn every_revision_from_the_floor_on_can_be_told(fixture: &dyn Fixture) {
    for seed in 1..=3 {
        let mut dice = Dice::new(seed * 7_919);
        let mut model = Model::new(fixture, "past").await;
        let mut floor = 0;
        for _ in 0..30 {
            let mut group = Vec::new();
            for _ in 0..=dice.roll(3) {
                let mut names = std::collections::BTreeSet::new();
                for _ in 0..=dice.roll(3) {
                    names.insert(dice.roll(6));
                }
                let exists = |name: &String| model.documents.contains_key(&samples::key(name));
                // Only the first commit of a group knows what exists, so only it deletes.
                let delete = group.is_empty() && dice.roll(3) == 0;
                let names = names.into_iter().map(|number| format!("n{number}"));
                group.push(
                    names
                        .map(|name| if delete && exists(&name) { format!("-{name}") } else { name })
                        .collect::<Vec<_>>(),
                );
            }
            let borrowed: Vec<Vec<&str>> =
                group.iter().map(|names| names.iter().map(String::as_str).collect()).collect();
            let group: Vec<&[&str]> = borrowed.iter().map(Vec::as_slice).collect();
            model.write(&group).await;
            if dice.roll(4) == 0 {
                floor += dice.roll(model.revision() - floor + 1);
                let keep = u32::try_from(dice.roll(4)).unwrap_or(0);
                assert_eq!(model.store.trim(floor, keep).await.unwrap(), floor, "the floor");
            }
        }
        model.check_now().await;
        println!("seed {seed}, floor {floor}");
        model.check_past(floor).await;
        let expected: Vec<_> =
            model.commits.iter().filter(|commit| commit.revision > floor).cloned().collect();
        assert_eq!(log(model.store.as_ref(), floor).await, expected, "the log above the floor");
    }
}

/// A process that was away while its next revision was given to another one and trimmed away does
/// not get it again.
pub async fn a_writer_that_slept_through_a_trim_is_refused(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "slept").await;
    for _ in 0..10 {
        model.write(&[&["a"]]).await;
    }
    for floor in [5, 10] {
        model.store.trim(floor, 1).await.unwrap();
        for revision in [1, 3, floor] {
            let late = record(samples::commit(revision, &["late"]));
            conflict(
                &format!("revision {revision} below the floor {floor}"),
                &model.store.commit(&[late]).await,
            );
            let gone = record(samples::commit_of(
                revision,
                vec![samples::change(blaze_config::store::Op::Delete, "a", revision, Some(10))],
            ));
            conflict("a deletion below the floor", &model.store.commit(&[gone]).await);
        }
        model.check_now().await;
    }
    model.write(&[&["b"]]).await;
    model.check_now().await;
}

/// The time by which records expire follows the clock in steps, also over lives of the process, and
/// at once where that goes back. What is young by it stays.
pub async fn a_clock_that_leaps_ahead_makes_nothing_expire_at_once(fixture: &dyn Fixture) {
    const HOUR: Duration = Duration::from_secs(3_600);
    let start = now();
    let at = |time: Duration| {
        let ms = i64::try_from(time.as_millis()).unwrap_or(i64::MAX);
        Timestamp::from_millis(start.as_millis() + ms)
    };
    let (future, name) = (at(500 * 24 * HOUR), store_name("leap"));
    {
        let store = fixture.open(&name).await;
        assert_eq!(store.expiry_time(start, Duration::ZERO).await.unwrap(), start, "at first");
        store.append_audit(&[samples::audit("trim", None)]).await.unwrap();
        assert_eq!(store.expiry_time(future, HOUR).await.unwrap(), at(HOUR), "one step");
        store.close().await;
    }
    let store = fixture.open(&name).await;
    assert_eq!(store.expiry_time(future, HOUR).await.unwrap(), at(2 * HOUR), "another life");
    store.trim(0, 1).await.unwrap();
    let query = AuditQuery { limit: 10, ..AuditQuery::default() };
    assert_eq!(store.audit(&query).await.unwrap().len(), 1, "entries of the audit");
    assert_eq!(store.expiry_time(at(HOUR), HOUR).await.unwrap(), at(HOUR), "the clock is right");
    drop(store);
    // Before it was ever moved on, the newest commit says what time it was.
    let mut model = Model::new(fixture, "leap-at-first").await;
    model.write(&[&["a"]]).await;
    let newest = model.commits[0].time;
    assert_eq!(model.store.expiry_time(future, Duration::ZERO).await.unwrap(), newest);
}
