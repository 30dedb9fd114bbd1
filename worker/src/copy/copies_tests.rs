//! What reaches the copies, and when.

#[path = "copies_late_tests.rs"]
mod late;

use blaze_domain::config::Document;
use proptest::prelude::*;
use serde_json::json;
use tokio::sync::Semaphore;

use super::*;
use crate::copy::fake::Fake;
use crate::copy::samples::{loaded, notes, position, service};
use crate::copy::slot::MAX_KEYS;

const LONG: Duration = Duration::from_secs(300);

/// Where nothing is read late.
fn nobody() -> mpsc::Sender<Found> {
    mpsc::channel(1).0
}

struct Fixture {
    supervisor: Supervisor,
    fake: Arc<Fake>,
    copies: Copies,
    state: State,
}

impl Fixture {
    fn new(fake: Fake, is_current: bool) -> Self {
        let supervisor = Supervisor::new("test");
        let fake = Arc::new(fake);
        let copy = Arc::clone(&fake) as Arc<dyn LocalCopy>;
        let target = Target {
            copy,
            is_current,
            is_read: true,
        };
        let copies = Copies::start(&supervisor, vec![target], &Arc::default(), &nobody());
        Self {
            supervisor,
            fake,
            copies,
            state: State::default(),
        }
    }

    /// Stores a service that is new or another one.
    fn put(&mut self, name: &str, revision: u64) {
        let document = service(name, revision, json!({ "config": { "a": revision } }));
        let key = document.key.clone();
        self.state.put(Arc::new(document));
        self.store(revision, Changed::Keys(vec![key]), None);
    }

    fn store(&self, revision: u64, changed: Changed, notes: Option<Arc<Notes>>) {
        self.copies.store(&Update {
            position: position(revision),
            state: self.state.clone(),
            changed,
            notes,
        });
    }

    fn expected(&self) -> Vec<Arc<Document>> {
        self.state.all().map(|(_, held)| Arc::clone(&held.document)).collect()
    }

    fn held(&self) -> Loaded {
        self.fake.held.lock().clone().unwrap()
    }

    fn calls(&self) -> (usize, usize) {
        let number = |counter: &std::sync::atomic::AtomicUsize| counter.load(Ordering::Relaxed);
        (number(&self.fake.replaced), number(&self.fake.advanced))
    }
}

#[tokio::test(start_paused = true)]
async fn the_first_write_is_everything_and_then_only_what_changed() {
    let mut fixture = Fixture::new(Fake::new("fake"), false);
    fixture.put("a", 1);
    assert!(fixture.copies.flush(LONG).await);
    assert_eq!(fixture.calls(), (1, 0));
    fixture.put("b", 2);
    assert!(fixture.copies.flush(LONG).await);
    let key = "Service/a".parse().unwrap();
    fixture.state.remove(&key);
    fixture.store(3, Changed::Keys(vec![key]), Some(Arc::new(notes("uid", 3))));
    assert!(fixture.copies.flush(LONG).await);
    assert_eq!(fixture.calls(), (1, 2));
    let held = fixture.held();
    assert_eq!((held.documents, held.position), (fixture.expected(), position(3)));
    assert!(held.notes.has_failed("uid"));
    fixture.store(9, Changed::All, None);
    assert!(fixture.copies.flush(LONG).await);
    assert_eq!(fixture.calls(), (2, 2));
    assert!(fixture.held().notes.has_failed("uid"), "notes stay");
    assert!(fixture.supervisor.shutdown(LONG).await.is_clean());
}

#[tokio::test(start_paused = true)]
async fn a_copy_that_was_started_from_goes_on() {
    let mut fixture = Fixture::new(Fake::new("fake"), true);
    *fixture.fake.held.lock() = Some(loaded(1, []));
    fixture.put("a", 2);
    assert!(fixture.copies.flush(LONG).await);
    assert_eq!(fixture.calls(), (0, 1));
    // It was emptied by somebody: everything is written, and that is no failure.
    *fixture.fake.held.lock() = None;
    fixture.put("b", 3);
    assert!(fixture.copies.flush(LONG).await);
    assert_eq!(fixture.calls(), (1, 1));
    assert_eq!(fixture.held().documents, fixture.expected());
    assert_eq!(fixture.copies.counts()[0].failed, 0);
}

#[tokio::test(start_paused = true)]
async fn a_slow_copy_gets_the_newest_state_and_the_rest_is_counted() {
    let slow = Fake {
        permits: Semaphore::new(0),
        ..Fake::new("slow")
    };
    let mut fixture = Fixture::new(slow, false);
    fixture.put("a", 1);
    fixture.fake.called.notified().await;
    for revision in 2..=101 {
        fixture.put(&format!("s{revision}"), revision);
    }
    assert!(!fixture.copies.flush(Duration::from_secs(5)).await, "it hangs");
    assert!(!fixture.copies.counts()[0].is_current);
    fixture.fake.permits.add_permits(2);
    assert!(fixture.copies.flush(LONG).await);
    assert_eq!(fixture.calls(), (1, 1));
    assert_eq!(fixture.held().documents, fixture.expected());
    let counts = &fixture.copies.counts()[0];
    assert_eq!((counts.written, counts.coalesced, counts.is_current), (2, 99, true));
}

#[tokio::test(start_paused = true)]
async fn a_copy_that_comes_back_gets_everything() {
    let mut fixture = Fixture::new(Fake::new("fake"), false);
    fixture.put("a", 1);
    assert!(fixture.copies.flush(LONG).await);
    fixture.fake.is_away.store(true, Ordering::Relaxed);
    fixture.put("b", 2);
    assert!(!fixture.copies.flush(LONG).await);
    fixture.put("c", 3);
    let counts = fixture.copies.counts();
    assert!(counts[0].failed >= 8, "it is tried again and again: {counts:?}");
    assert!(counts[0].failed < 100, "with pauses: {counts:?}");
    assert!(counts[0].error.as_ref().unwrap().contains("told so"));
    fixture.fake.is_away.store(false, Ordering::Relaxed);
    assert!(fixture.copies.flush(LONG).await);
    assert_eq!(fixture.calls(), (2, 0));
    assert_eq!(fixture.held().documents, fixture.expected());
    assert_eq!(fixture.copies.counts()[0].error, None);
}

#[tokio::test(start_paused = true)]
async fn a_copy_that_is_away_does_not_hold_up_another_one() {
    let supervisor = Supervisor::new("test");
    let away = Arc::new(Fake {
        permits: Semaphore::new(0),
        ..Fake::new("away")
    });
    let good = Arc::new(Fake::new("good"));
    let target = |copy: &Arc<Fake>| Target {
        copy: Arc::clone(copy) as Arc<dyn LocalCopy>,
        is_current: false,
        is_read: true,
    };
    let targets = vec![target(&away), target(&good)];
    let copies = Copies::start(&supervisor, targets, &Arc::default(), &nobody());
    copies.store(&Update {
        position: position(1),
        state: State::default(),
        changed: Changed::All,
        notes: None,
    });
    assert!(!copies.flush(LONG).await);
    let is_current: Vec<bool> = copies.counts().iter().map(|counts| counts.is_current).collect();
    assert_eq!(is_current, [false, true]);
}

#[tokio::test(start_paused = true)]
async fn a_copy_that_writes_everything_rests() {
    let whole = Fake {
        is_whole: true,
        ..Fake::new("file")
    };
    let mut fixture = Fixture::new(whole, true);
    let began = Instant::now();
    for revision in 1..=4 {
        fixture.put("a", revision);
        while !fixture.copies.counts()[0].is_current {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }
    assert_eq!(fixture.calls(), (4, 0));
    assert!((REST_BOUNDS.0 * 3..REST_BESIDE).contains(&began.elapsed()));
}

#[tokio::test(start_paused = true)]
async fn it_rests_for_longer_while_another_copy_has_everything_and_is_woken_in_the_end() {
    for is_away in [false, true] {
        let supervisor = Supervisor::new("test");
        let database = Arc::new(Fake {
            permits: Semaphore::new(if is_away { 0 } else { 1_000 }),
            ..Fake::new("database")
        });
        let file = Arc::new(Fake {
            is_whole: true,
            ..Fake::new("file")
        });
        let target = |copy: &Arc<Fake>| Target {
            copy: Arc::clone(copy) as Arc<dyn LocalCopy>,
            is_current: true,
            is_read: true,
        };
        let targets = vec![target(&database), target(&file)];
        let copies = Copies::start(&supervisor, targets, &Arc::default(), &nobody());
        let store = |revision| {
            copies.store(&Update {
                position: position(revision),
                state: State::default(),
                changed: Changed::Keys(Vec::new()),
                notes: None,
            });
        };
        // A change each 100 ms, for 4 s.
        for revision in 1..=40 {
            store(revision);
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        let written = file.replaced.load(Ordering::Relaxed);
        let expected = if is_away { 35..=40 } else { 4..=6 };
        assert!(expected.contains(&written), "{written} times, away: {is_away}");
        store(41);
        let began = Instant::now();
        let limit = Duration::from_secs(1);
        assert_eq!(copies.flush(limit).await, !is_away);
        assert!(is_away || began.elapsed() < REST_BOUNDS.0);
        let held = file.held.lock().clone().unwrap();
        assert_eq!(held.position.revision, 41);
        assert!(supervisor.shutdown(LONG).await.is_clean());
    }
}

#[tokio::test(start_paused = true)]
async fn a_copy_that_writes_everything_is_spared_writes_for_the_time_alone() {
    let whole = Fake {
        is_whole: true,
        ..Fake::new("file")
    };
    let fixture = Fixture::new(whole, false);
    let later = |seconds: i64| {
        let as_of = position(1).as_of.as_millis() + seconds * 1_000;
        let as_of = blaze_domain::config::Timestamp::from_millis(as_of);
        Position { as_of, ..position(1) }
    };
    let store = |position: Position, notes: Option<Arc<Notes>>| {
        let (state, changed) = (fixture.state.clone(), Changed::Keys(Vec::new()));
        fixture.copies.store(&Update {
            position,
            state,
            changed,
            notes,
        });
        fixture.copies.flush(LONG)
    };
    assert!(store(later(0), None).await);
    for seconds in [15, 30, 299] {
        assert!(store(later(seconds), None).await);
    }
    assert_eq!(fixture.calls(), (1, 0));
    assert!(store(later(300), None).await);
    assert_eq!((fixture.calls(), fixture.held().position), ((2, 0), later(300)));
    assert!(store(later(315), Some(Arc::new(notes("uid", 1)))).await);
    assert_eq!(fixture.calls(), (3, 0));
    assert!(store(position(2), None).await);
    assert_eq!(fixture.calls(), (4, 0));
}

#[tokio::test(start_paused = true)]
async fn very_many_keys_are_everything() {
    let slow = Fake {
        permits: Semaphore::new(0),
        ..Fake::new("slow")
    };
    let fixture = Fixture::new(slow, true);
    *fixture.fake.held.lock() = Some(loaded(1, []));
    fixture.store(2, Changed::Keys(Vec::new()), None);
    fixture.fake.called.notified().await;
    for number in 0..=MAX_KEYS {
        let key = format!("Service/s{number}").parse().unwrap();
        fixture.store(3, Changed::Keys(vec![key]), None);
    }
    fixture.fake.permits.add_permits(2);
    assert!(fixture.copies.flush(LONG).await);
    assert_eq!(fixture.calls(), (1, 1));
}

#[derive(Debug, Clone)]
enum Act {
    Put(u8),
    Remove(u8),
    All,
    Away(bool),
    Wait,
}

fn any_act() -> impl Strategy<Value = Act> {
    prop_oneof![
        4 => (0_u8..6).prop_map(Act::Put),
        2 => (0_u8..6).prop_map(Act::Remove),
        1 => Just(Act::All),
        1 => any::<bool>().prop_map(Act::Away),
        2 => Just(Act::Wait),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn whatever_happens_the_copy_ends_with_the_newest_state(acts in prop::collection::vec(any_act(), 0..30)) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build().unwrap();
        runtime.block_on(async {
            let mut fixture = Fixture::new(Fake::new("fake"), false);
            for (revision, act) in (1..).zip(acts) {
                let key = |number: u8| format!("Service/s{number}").parse::<Key>().unwrap();
                match act {
                    Act::Put(number) => fixture.put(&format!("s{number}"), revision),
                    Act::Remove(number) => {
                        fixture.state.remove(&key(number));
                        fixture.store(revision, Changed::Keys(vec![key(number)]), None);
                    }
                    Act::All => fixture.store(revision, Changed::All, None),
                    Act::Away(is_away) => fixture.fake.is_away.store(is_away, Ordering::Relaxed),
                    Act::Wait => drop(fixture.copies.flush(Duration::from_secs(1)).await),
                }
            }
            fixture.fake.is_away.store(false, Ordering::Relaxed);
            fixture.store(99, Changed::Keys(Vec::new()), None);
            assert!(fixture.copies.flush(LONG).await);
            let held = fixture.held();
            assert_eq!((held.position, held.documents), (position(99), fixture.expected()));
        });
    }
}
