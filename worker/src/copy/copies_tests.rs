//! What reaches the copies, and when.

#[path = "copies_late_tests.rs"]
mod late;

use blaze_domain::config::{Document, Key};
use proptest::prelude::*;
use serde_json::json;
use tokio::sync::Semaphore;

use super::*;
use crate::copy::fake::Fake;
use crate::copy::samples::{loaded, position, service};

const LONG: Duration = Duration::from_secs(300);

fn target(copy: &Arc<Fake>, is_read: bool) -> Target {
    let copy = Arc::clone(copy) as Arc<dyn LocalCopy>;
    Target { copy, is_read, written: None }
}

struct Fixture {
    /// Ends the tasks at the end.
    _supervisor: Supervisor,
    fake: Arc<Fake>,
    copies: Copies,
    state: State,
    notes: Arc<Notes>,
}

impl Fixture {
    fn new(fake: Fake, is_read: bool, found: &mpsc::Sender<Found>) -> Self {
        let supervisor = Supervisor::new("test");
        let fake = Arc::new(fake);
        let copies = Copies::start(&supervisor, vec![target(&fake, is_read)], found);
        Self {
            _supervisor: supervisor,
            fake,
            copies,
            state: State::default(),
            notes: Arc::default(),
        }
    }

    /// A copy from which nothing is read late.
    fn read(fake: Fake) -> Self {
        Self::new(fake, true, &mpsc::channel(1).0)
    }

    /// Stores a service that is new or another one.
    fn put(&mut self, name: &str, revision: u64) {
        let document = service(name, revision, json!({ "config": { "a": revision } }));
        self.state.put(Arc::new(document));
        self.store(position(revision), true);
    }

    fn store(&self, position: Position, has_changed: bool) {
        self.copies.store(&Update {
            position,
            state: self.state.clone(),
            notes: Arc::clone(&self.notes),
            has_changed,
        });
    }

    fn expected(&self) -> Vec<Arc<Document>> {
        self.state.all().map(|(_, held)| Arc::clone(&held.document)).collect()
    }

    fn held(&self) -> Loaded {
        self.fake.held.lock().clone().unwrap()
    }

    fn writes(&self) -> usize {
        self.fake.replaced.load(Ordering::Relaxed)
    }
}

#[tokio::test(start_paused = true)]
async fn a_slow_copy_gets_the_newest_state() {
    let slow = Fake { permits: Semaphore::new(0), ..Fake::new("slow") };
    let mut fixture = Fixture::read(slow);
    fixture.put("a", 1);
    fixture.fake.called.notified().await;
    for revision in 2..=101 {
        fixture.put(&format!("s{revision}"), revision);
    }
    assert!(!fixture.copies.flush(Duration::from_secs(5)).await, "it hangs");
    assert!(!fixture.copies.counts()[0].is_current);
    fixture.fake.permits.add_permits(2);
    assert!(fixture.copies.flush(LONG).await);
    assert_eq!(fixture.held().documents, fixture.expected());
    let counts = &fixture.copies.counts()[0];
    assert_eq!((counts.written, counts.is_current), (2, true));
}

#[tokio::test(start_paused = true)]
async fn a_copy_that_comes_back_gets_everything() {
    let mut fixture = Fixture::read(Fake::new("fake"));
    fixture.put("a", 1);
    assert!(fixture.copies.flush(LONG).await);
    fixture.fake.is_away.store(true, Ordering::Relaxed);
    fixture.put("b", 2);
    assert!(!fixture.copies.flush(LONG).await);
    fixture.put("c", 3);
    let counts = fixture.copies.counts();
    assert!(counts[0].failed >= 8, "it is tried again and again: {counts:?}");
    assert!(counts[0].failed < 100, "with pauses: {counts:?}");
    fixture.fake.is_away.store(false, Ordering::Relaxed);
    assert!(fixture.copies.flush(LONG).await);
    assert_eq!((fixture.writes(), fixture.held().documents), (2, fixture.expected()));
}

#[tokio::test(start_paused = true)]
async fn a_copy_that_is_away_does_not_hold_up_another_one() {
    let supervisor = Supervisor::new("test");
    let away = Arc::new(Fake { permits: Semaphore::new(0), ..Fake::new("away") });
    let good = Arc::new(Fake::new("good"));
    let targets = vec![target(&away, true), target(&good, true)];
    let copies = Copies::start(&supervisor, targets, &mpsc::channel(1).0);
    copies.store(&Update {
        position: position(1),
        state: State::default(),
        notes: Arc::default(),
        has_changed: true,
    });
    assert!(!copies.flush(LONG).await);
    let is_current: Vec<bool> = copies.counts().iter().map(|counts| counts.is_current).collect();
    assert_eq!(is_current, [false, true]);
}

#[tokio::test(start_paused = true)]
async fn a_copy_rests_after_a_write_and_is_woken_in_the_end() {
    let mut fixture = Fixture::read(Fake::new("file"));
    // A change each 10 ms, for 4 s.
    for revision in 1..=400 {
        fixture.put("a", revision);
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let written = fixture.writes();
    assert!((19..=21).contains(&written), "{written} times");
    fixture.put("a", 401);
    let began = Instant::now();
    assert!(fixture.copies.flush(LONG).await);
    assert!(began.elapsed() < REST_BOUNDS.0);
    assert_eq!(fixture.held().position.revision, 401);
}

#[tokio::test(start_paused = true)]
async fn a_small_copy_rests_shortly_and_an_urgent_state_does_not_wait() {
    let slow = Fake { permits: Semaphore::new(0), ..Fake::new("slow") };
    let mut fixture = Fixture::read(slow);
    fixture.put("a", 1);
    tokio::time::sleep(Duration::from_secs(5)).await;
    fixture.fake.permits.add_permits(9);
    tokio::time::sleep(Duration::from_millis(10)).await;
    assert_eq!(fixture.writes(), 1, "it took five seconds");
    fixture.put("a", 2);
    tokio::time::sleep(SMALL.1).await;
    assert_eq!(fixture.writes(), 2);
    fixture.put("a", 3);
    fixture.copies.hurry();
    tokio::time::sleep(Duration::from_millis(10)).await;
    assert_eq!(fixture.held().position.revision, 3);
}

#[tokio::test(start_paused = true)]
async fn a_copy_that_is_current_at_the_start_is_not_written() {
    for (written, writes) in [(position(5), 0), (position(4), 1)] {
        let (supervisor, fake) = (Supervisor::new("test"), Arc::new(Fake::new("file")));
        let target = Target { written: Some(written), ..target(&fake, true) };
        let copies = Copies::start(&supervisor, vec![target], &mpsc::channel(1).0);
        copies.store(&Update {
            position: position(5),
            state: State::default(),
            notes: Arc::default(),
            has_changed: false,
        });
        assert!(copies.flush(LONG).await);
        assert_eq!(fake.replaced.load(Ordering::Relaxed), writes);
    }
}

#[tokio::test(start_paused = true)]
async fn a_copy_is_spared_writes_for_the_time_alone() {
    let fixture = Fixture::read(Fake::new("file"));
    let later = |seconds: i64| {
        let as_of = position(1).as_of.as_millis() + seconds * 1_000;
        let as_of = blaze_domain::config::Timestamp::from_millis(as_of);
        Position { as_of, ..position(1) }
    };
    for (position, has_changed, writes) in [
        (later(0), false, 1),
        (later(15), false, 1),
        (later(299), false, 1),
        (later(300), false, 2),
        (later(315), true, 3),
        (position(2), false, 4),
    ] {
        fixture.store(position.clone(), has_changed);
        assert!(fixture.copies.flush(LONG).await);
        assert_eq!(fixture.writes(), writes, "{position:?}");
    }
}

#[derive(Debug, Clone)]
enum Act {
    Put(u8),
    Remove(u8),
    Away(bool),
    Wait,
}

fn any_act() -> impl Strategy<Value = Act> {
    prop_oneof![
        4 => (0_u8..6).prop_map(Act::Put),
        2 => (0_u8..6).prop_map(Act::Remove),
        1 => any::<bool>().prop_map(Act::Away),
        2 => Just(Act::Wait),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn whatever_happens_the_copy_ends_with_the_newest_state(acts in prop::collection::vec(any_act(),
        0..30)) {
        let runtime =
            tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build()
            .unwrap();
        runtime.block_on(async {
            let mut fixture = Fixture::read(Fake::new("fake"));
            for (revision, act) in (1..).zip(acts) {
                let key = |number: u8| format!("Service/s{number}").parse::<Key>().unwrap();
                match act {
                    Act::Put(number) => fixture.put(&format!("s{number}"), revision),
                    Act::Remove(number) => {
                        fixture.state.remove(&key(number));
                        fixture.store(position(revision), true);
                    }
                    Act::Away(is_away) => fixture.fake.is_away.store(is_away, Ordering::Relaxed),
                    Act::Wait => drop(fixture.copies.flush(Duration::from_secs(1)).await),
                }
            }
            fixture.fake.is_away.store(false, Ordering::Relaxed);
            fixture.store(position(99), false);
            assert!(fixture.copies.flush(LONG).await);
            let held = fixture.held();
            assert_eq!((held.position, held.documents), (position(99), fixture.expected()));
        });
    }
}
