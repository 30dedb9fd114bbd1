//! What every lease must do, run on each of them on real servers by the tests of the workspace.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::{Held, Lease, Mark};

/// Time that the lease is asked for: whoever has it must ask again within it, and an answer may
/// take long.
pub const TIME: Duration = Duration::from_secs(3);
/// What an answer may take on a machine that does much else.
pub const BUSY: Duration = Duration::from_secs(2);

/// Leases of one kind, with a server behind them.
struct Fixture<'f> {
    lease: &'f dyn Fn(&str, &str) -> Arc<dyn Lease>,
    first_within: Duration,
}

/// Runs the whole suite. `lease`: the one of a layer for an owner; no owner is asked for twice.
/// `first_within`: how long the first may have to wait for one that nobody has had.
///
/// # Errors
/// The first rule that does not hold, for people.
pub async fn run_all(
    lease: &dyn Fn(&str, &str) -> Arc<dyn Lease>,
    first_within: Duration,
) -> Result<(), String> {
    let fixture = &Fixture { lease, first_within };
    let named =
        |rule: &str, result: Result<(), String>| result.map_err(|error| format!("{rule}: {error}"));
    named("one at a time", one_at_a_time(fixture).await)?;
    named("marks", marks(fixture).await)?;
    named("what is given up", what_is_given_up(fixture).await)?;
    named("what runs out", what_runs_out(fixture).await)?;
    named("many at once", many_at_once(fixture).await)
}

fn check(is_so: bool, what: impl Into<String>) -> Result<(), String> {
    if is_so { Ok(()) } else { Err(what.into()) }
}

/// Asks until it is had; returns how long that took.
async fn take(lease: &dyn Lease, within: Duration) -> Result<(Held, Duration), String> {
    let start = Instant::now();
    loop {
        let answer = lease.hold(TIME, None).await;
        if let Ok(held) = &answer
            && held.is_held
        {
            return Ok((held.clone(), start.elapsed()));
        }
        check(
            start.elapsed() < within,
            format!("{} was not had within {within:?}: {answer:?}", lease.describe()),
        )?;
        tokio::time::sleep(TIME / 50).await;
    }
}

/// Asks again as who has it. Where nobody knows for a moment, because a server is busy, it is asked
/// for again as long as it is had.
async fn renew(lease: &dyn Lease, told: Option<&Mark>) -> Result<Held, String> {
    let start = Instant::now();
    loop {
        match lease.hold(TIME, told).await {
            Err(_) if start.elapsed() < TIME * 9 / 10 => tokio::time::sleep(TIME / 50).await,
            answer => return answer,
        }
    }
}

fn mark(revision: u64) -> Mark {
    Mark { store_id: "0197c1d2-7f3a".to_owned(), revision }
}

/// Of two that ask one has it, and goes on having it for as long as it asks; those of two layers
/// are two.
async fn one_at_a_time(fixture: &Fixture<'_>) -> Result<(), String> {
    let (one, other) = ((fixture.lease)("a", "one"), (fixture.lease)("a", "other"));
    take(&*one, fixture.first_within).await?;
    let elsewhere = (fixture.lease)("b", "elsewhere");
    take(&*elsewhere, fixture.first_within).await?;
    let start = Instant::now();
    while start.elapsed() < (TIME + BUSY) * 2 {
        check(renew(&*one, None).await?.is_held, "who has it has lost it")?;
        // Nobody knows, or it is not had.
        let other = other.hold(TIME, None).await.unwrap_or_default();
        check(!other.is_held, "two have it")?;
        tokio::time::sleep(TIME / 10).await;
    }
    one.release().await;
    other.release().await;
    elsewhere.release().await;
    Ok(())
}

/// Who has it leaves a mark, which the others see and who takes it gets; who does not have it
/// leaves none.
async fn marks(fixture: &Fixture<'_>) -> Result<(), String> {
    let (one, other) = ((fixture.lease)("marks", "one"), (fixture.lease)("marks", "other"));
    let (held, _) = take(&*one, fixture.first_within).await?;
    check(held.told.is_none(), "there was a mark before anybody left one")?;
    let held = renew(&*one, Some(&mark(7))).await?;
    check(held.told == Some(mark(7)), format!("left was 7, found is {:?}", held.told))?;
    let held = renew(&*one, None).await?;
    check(held.told == Some(mark(7)), "a call without a mark takes it away")?;
    let start = Instant::now();
    loop {
        let seen = other.hold(TIME, Some(&mark(99))).await.unwrap_or_default();
        check(!seen.is_held, "two have it")?;
        let held = renew(&*one, Some(&mark(8))).await?;
        check(held.told == Some(mark(8)), format!("left was 8, found is {:?}", held.told))?;
        if seen.told == Some(mark(8)) {
            break;
        }
        check(
            start.elapsed() < fixture.first_within + TIME * 2,
            format!("who waits does not see the mark, but {seen:?}"),
        )?;
        tokio::time::sleep(TIME / 20).await;
    }
    one.release().await;
    let start = Instant::now();
    loop {
        // Who takes it has told nothing yet, whatever it says.
        let taken = other.hold(TIME, Some(&mark(99))).await.unwrap_or_default();
        check(
            taken.told.is_none() || taken.told == Some(mark(8)),
            format!("who takes it finds {:?} instead of 8", taken.told),
        )?;
        if taken.is_held {
            check(taken.told == Some(mark(8)), "who takes it finds no mark")?;
            break;
        }
        check(start.elapsed() < BUSY, "it was not given on")?;
        tokio::time::sleep(TIME / 50).await;
    }
    let late = one.hold(TIME, Some(&mark(9))).await.unwrap_or_default();
    check(!late.is_held && late.told != Some(mark(9)), "who gave it up leaves a mark")?;
    let held = renew(&*other, Some(&mark(10))).await?;
    check(held.is_held && held.told == Some(mark(10)), format!("left was 10, found is {held:?}"))?;
    other.release().await;
    Ok(())
}

/// The next one has it at once.
async fn what_is_given_up(fixture: &Fixture<'_>) -> Result<(), String> {
    let (one, other) = ((fixture.lease)("given", "one"), (fixture.lease)("given", "other"));
    take(&*one, fixture.first_within).await?;
    let start = Instant::now();
    while start.elapsed() < TIME {
        check(renew(&*one, None).await?.is_held, "who has it has lost it")?;
        let seen = other.hold(TIME, None).await.unwrap_or_default();
        check(!seen.is_held, "two have it")?;
        tokio::time::sleep(TIME / 20).await;
    }
    // Nobody gives up what another has.
    let third = (fixture.lease)("given", "third");
    third.release().await;
    check(renew(&*one, None).await?.is_held, "somebody else gave it up")?;
    one.release().await;
    let (_, took) = take(&*other, BUSY).await?;
    println!("{}: given on in {took:?}", other.describe());
    other.release().await;
    Ok(())
}

/// The next one has it after that time, and not before; the one before learns that it has lost it.
async fn what_runs_out(fixture: &Fixture<'_>) -> Result<(), String> {
    let (one, other) = ((fixture.lease)("out", "one"), (fixture.lease)("out", "other"));
    take(&*one, fixture.first_within).await?;
    let asked = Instant::now();
    check(renew(&*one, None).await?.is_held, "who has it has lost it")?;
    take(&*other, TIME + BUSY).await?;
    let took = asked.elapsed();
    println!("{}: ran out in {took:?}", other.describe());
    check(took >= TIME, format!("another one had it after {took:?} of {TIME:?}"))?;
    let late = one.hold(TIME, None).await.unwrap_or_default();
    check(!late.is_held, "two have it")?;
    other.release().await;
    Ok(())
}

/// Of many that ask for one that nobody has ever had, one has it.
async fn many_at_once(fixture: &Fixture<'_>) -> Result<(), String> {
    let leases: Vec<_> =
        (0..6).map(|number| (fixture.lease)("many", &format!("w{number}"))).collect();
    let (start, mut winner) = (Instant::now(), None);
    while start.elapsed() < fixture.first_within + TIME {
        let asked = Instant::now();
        let answers =
            futures::future::join_all(leases.iter().map(|lease| lease.hold(TIME, None))).await;
        let have: Vec<usize> = answers
            .iter()
            .enumerate()
            .filter(|(_, answer)| answer.as_ref().is_ok_and(|held| held.is_held))
            .map(|(number, _)| number)
            .collect();
        check(have.len() <= 1, format!("{have:?} have it"))?;
        if let Some(number) = have.first() {
            let was = *winner.get_or_insert(*number);
            check(was == *number, format!("{was} has lost it to {number}, and asked in time"))?;
        }
        tokio::time::sleep((TIME / 10).saturating_sub(asked.elapsed())).await;
    }
    check(winner.is_some(), "nobody has it")?;
    for lease in leases {
        lease.release().await;
    }
    Ok(())
}
