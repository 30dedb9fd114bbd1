//! What goes and what stays when history is trimmed.

use super::Fixture;
use super::samples::{self, record};
use super::tools::{Dice, Model, Outcome, commit, conflict, log, same, told};
use blaze_config::store::AuditQuery;
use blaze_config::store::upkeep::now;

/// The floor rises to what is asked for, never falls, and never passes the newest commit; commits up to it are gone;
/// revisions go on.
///
/// # Errors
/// How the store breaks the rule.
pub async fn the_floor_rises_and_commits_go(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "floor").await?;
    same(
        "the floor of an empty store",
        &told("trim", model.store.trim(5, 1).await)?,
        &0,
    )?;
    for _ in 0..9 {
        model.write(&[&["a", "b"]]).await?;
    }
    for (asked, expected) in [(4, 4), (2, 4), (4, 4), (6, 6)] {
        let floor = told("trim", model.store.trim(asked, 2).await)?;
        same(&format!("the floor after trim({asked})"), &floor, &expected)?;
        model.check_now().await?;
        let commits = model
            .commits
            .iter()
            .filter(|commit| commit.revision > expected)
            .cloned()
            .collect::<Vec<_>>();
        same(
            "commits above the floor",
            &log(model.store.as_ref(), expected).await?,
            &commits,
        )?;
        let below = told("commits_after", model.store.commits_after(expected - 1, 10).await)?;
        same("the floor that a reader below it is told", &below.floor, &expected)?;
        same(
            "the loaded floor",
            &told("load", model.store.load().await)?.floor,
            &expected,
        )?;
    }
    same(
        "the floor at the newest commit",
        &told("trim", model.store.trim(99, 1).await)?,
        &9,
    )?;
    model.check_now().await?;
    same("commits above it", &log(model.store.as_ref(), 9).await?.len(), &0)?;
    model.write(&[&["a"], &["c"]]).await?;
    model.check_now().await?;
    same(
        "commits after the floor",
        &log(model.store.as_ref(), 9).await?.len(),
        &2,
    )
}

/// Of each document stay the version that holds at the floor, all above it, and the newest ones that are to be kept.
///
/// # Errors
/// How the store breaks the rule.
pub async fn versions_that_hold_or_are_young_stay(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "stay").await?;
    // a: 1 2 3 4 5 9, b: 1 (holds for ever), c: 2 and deleted at 3.
    let commits: [&[&str]; 9] = [
        &["a", "b"],
        &["a", "c"],
        &["a", "-c"],
        &["a"],
        &["a"],
        &["d"],
        &["d"],
        &["d"],
        &["a"],
    ];
    for names in commits {
        model.write(&[names]).await?;
    }
    for (floor, keep, a, b) in [
        (4, 3, vec![9, 5, 4], vec![1]),
        (5, 3, vec![9, 5, 4], vec![1]),
        (8, 2, vec![9, 5], vec![1]),
        (9, 1, vec![9], vec![1]),
    ] {
        told("trim", model.store.trim(floor, keep).await)?;
        for (name, expected) in [("a", a), ("b", b), ("c", if keep > 1 { vec![3, 2] } else { vec![3] })] {
            let found = told("versions", model.store.versions(&samples::key(name), None, 20).await)?;
            let found: Vec<u64> = found.iter().map(|version| version.revision).collect();
            same(&format!("versions of {name}, trim({floor}, {keep})"), &found, &expected)?;
        }
        model.check_past(floor).await?;
        model.check_now().await?;
    }
    Ok(())
}

/// However long a history is, what is to spare of it goes, and nothing else.
///
/// # Errors
/// How the store breaks the rule.
pub async fn a_long_history_is_trimmed(fixture: &dyn Fixture) -> Outcome {
    // More than a store goes through at once.
    const GROUPS: u64 = 210;
    const GROUP: usize = 100;
    let newest = GROUPS * GROUP as u64;
    let mut model = Model::new(fixture, "long").await?;
    model.write(&[&["b"]]).await?;
    for _ in 0..GROUPS {
        model.write(&[&["a"][..]; GROUP]).await?;
    }
    let newest = newest + 1;
    let revisions = async |name: &str| -> Outcome<Vec<u64>> {
        let found = told("versions", model.store.versions(&samples::key(name), None, 1000).await)?;
        Ok(found.iter().map(|version| version.revision).collect())
    };
    for (floor, keep, oldest) in [
        (10, 1000, newest - 999),
        (newest - 300, 3, newest - 300),
        (newest, 1, newest),
    ] {
        same("the floor", &told("trim", model.store.trim(floor, keep).await)?, &floor)?;
        let expected: Vec<u64> = (oldest..=newest).rev().collect();
        same(
            &format!("versions of a, trim({floor}, {keep})"),
            &revisions("a").await?,
            &expected,
        )?;
        same("versions of b", &revisions("b").await?, &vec![1])?;
    }
    model.check_now().await
}

/// Audit entries and answers to repeat are there once each, however often their commits are trimmed away; a key that is
/// taken stays taken.
///
/// # Errors
/// How the store breaks the rule.
pub async fn what_outlives_a_commit_stays(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "outlives").await?;
    let mut written = Vec::new();
    for number in 0..6 {
        let mut next = model.record(&["a", "b"]);
        next.idempotency = Some(samples::answer(&format!("answer-{number}"), model.revision()));
        commit(model.store.as_ref(), &[next.clone()]).await?;
        written.push(next);
    }
    for floor in [0, 2, 2, 5, 6] {
        told("trim", model.store.trim(floor, 1).await)?;
        told("tidy", model.store.tidy().await)?;
        let query = AuditQuery {
            limit: 100,
            ..AuditQuery::default()
        };
        let audit = told("audit", model.store.audit(&query).await)?;
        let mut expected: Vec<_> = written.iter().flat_map(|record| record.audit.clone()).collect();
        expected.sort_by(|one, other| other.id.cmp(&one.id));
        same(&format!("the audit, trimmed to {floor}"), &audit, &expected)?;
        for record in &written {
            let expected = record.idempotency.clone();
            let id = expected.as_ref().map_or("", |answer| answer.id.as_str());
            let found = told("idempotency", model.store.idempotency(id, now()).await)?;
            same(&format!("an answer, trimmed to {floor}"), &found, &expected)?;
        }
        let mut again = record(samples::commit(7, &["late"]));
        again.idempotency = Some(samples::answer("answer-1", 7));
        conflict("an answer that is there", model.store.commit(&[again]).await)?;
    }
    model.check_now().await
}

/// Whatever is written and trimmed, what was at each revision from the floor on can be told, exactly.
///
/// # Errors
/// How the store breaks the rule.
pub async fn every_revision_from_the_floor_on_can_be_told(fixture: &dyn Fixture) -> Outcome {
    for seed in 1..=3 {
        let mut dice = Dice::new(seed * 7_919);
        let mut model = Model::new(fixture, "past").await?;
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
                        .map(|name| {
                            if delete && exists(&name) {
                                format!("-{name}")
                            } else {
                                name
                            }
                        })
                        .collect::<Vec<_>>(),
                );
            }
            let borrowed: Vec<Vec<&str>> = group
                .iter()
                .map(|names| names.iter().map(String::as_str).collect())
                .collect();
            let group: Vec<&[&str]> = borrowed.iter().map(Vec::as_slice).collect();
            model.write(&group).await?;
            if dice.roll(4) == 0 {
                floor += dice.roll(model.revision() - floor + 1);
                let keep = u32::try_from(dice.roll(4)).unwrap_or(0);
                same("the floor", &told("trim", model.store.trim(floor, keep).await)?, &floor)?;
            }
        }
        model.check_now().await?;
        model
            .check_past(floor)
            .await
            .map_err(|error| format!("seed {seed}, floor {floor}: {error}"))?;
        let expected: Vec<_> = model
            .commits
            .iter()
            .filter(|commit| commit.revision > floor)
            .cloned()
            .collect();
        same(
            "the log above the floor",
            &log(model.store.as_ref(), floor).await?,
            &expected,
        )?;
    }
    Ok(())
}

/// A process that was away while its next revision was given to another one and trimmed away does not get it again.
///
/// # Errors
/// How the store breaks the rule.
pub async fn a_writer_that_slept_through_a_trim_is_refused(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "slept").await?;
    for _ in 0..10 {
        model.write(&[&["a"]]).await?;
    }
    for floor in [5, 10] {
        told("trim", model.store.trim(floor, 1).await)?;
        for revision in [1, 3, floor] {
            let late = record(samples::commit(revision, &["late"]));
            conflict(
                &format!("revision {revision} below the floor {floor}"),
                model.store.commit(&[late]).await,
            )?;
            let gone = record(samples::commit_of(
                revision,
                vec![samples::change(
                    blaze_config::store::Op::Delete,
                    "a",
                    revision,
                    Some(10),
                )],
            ));
            conflict("a deletion below the floor", model.store.commit(&[gone]).await)?;
        }
        model.check_now().await?;
    }
    model.write(&[&["b"]]).await?;
    model.check_now().await
}
