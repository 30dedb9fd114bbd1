//! A copy that could not be read at the start.

use super::*;

/// With a copy that could not be read at the start, which holds this.
fn unread(held: Loaded) -> (Fixture, mpsc::Receiver<Found>) {
    let fake = Fake { is_away: true.into(), ..Fake::new("fake") };
    *fake.held.lock() = Some(held);
    let (find, found) = mpsc::channel(1);
    let fixture = Fixture::new(fake, false, &find);
    (fixture, found)
}

#[tokio::test(start_paused = true)]
async fn a_copy_that_could_not_be_read_is_read_before_it_is_written() {
    let (mut fixture, mut found) = unread(loaded(5, []));
    fixture.put("a", 6);
    assert!(!fixture.copies.flush(Duration::from_secs(5)).await);
    assert!(fixture.copies.counts()[0].failed >= 3 && found.try_recv().is_err());
    fixture.fake.is_away.store(false, Ordering::Relaxed);
    let Found { place, loaded, taken, .. } = found.recv().await.unwrap();
    assert_eq!((place.as_str(), loaded.position), ("fake", position(5)));
    assert!(
        !fixture.copies.flush(Duration::from_secs(60)).await,
        "it is not taken into account yet"
    );
    assert_eq!(fixture.writes(), 0);
    taken.send(()).unwrap();
    assert!(fixture.copies.flush(LONG).await);
    assert_eq!((fixture.writes(), fixture.held().position), (1, position(6)));
}

#[tokio::test(start_paused = true)]
async fn what_is_newer_there_is_never_written_over_and_is_told() {
    let (mut fixture, mut found) = unread(loaded(5, []));
    fixture.fake.is_away.store(false, Ordering::Relaxed);
    fixture.put("a", 4);
    // As it could not be read, and again as it turns out to be newer when it is written.
    for is_of_another in [false, true] {
        let one = found.recv().await.unwrap();
        assert_eq!((&one.loaded.position, one.is_of_another), (&position(5), is_of_another));
        one.taken.send(()).unwrap();
    }
    assert!(fixture.copies.flush(LONG).await, "nothing of it is missing there");
    assert_eq!((fixture.writes(), fixture.held()), (0, loaded(5, [])));
    assert_eq!(fixture.copies.counts()[0].failed, 0);
    fixture.put("b", 6);
    assert!(fixture.copies.flush(LONG).await);
    assert_eq!(fixture.held().documents, fixture.expected());
}

#[tokio::test(start_paused = true)]
async fn who_is_always_second_reads_only_when_the_main_service_is_gone() {
    let (mut fixture, mut found) = unread(loaded(5, []));
    fixture.fake.is_away.store(false, Ordering::Relaxed);
    found.recv().await.unwrap().taken.send(()).unwrap();
    fixture.copies.set_main_answers(true);
    for revision in 1..=4 {
        fixture.put("a", revision);
        assert!(fixture.copies.flush(LONG).await, "nothing of it is missing there");
    }
    assert!(found.try_recv().is_err(), "the main service tells it");
    fixture.copies.set_main_answers(false);
    let one = found.recv().await.unwrap();
    assert_eq!((&one.loaded.position, one.is_of_another), (&position(5), true));
    one.taken.send(()).unwrap();
    // Once: it is known now.
    fixture.copies.set_main_answers(true);
    fixture.copies.set_main_answers(false);
    tokio::time::sleep(LONG).await;
    assert!(found.try_recv().is_err());
    assert_eq!(fixture.writes(), 0);
}
