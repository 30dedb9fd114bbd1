//! Documents as registers: ten clients create, read, swap and delete twenty of them through two
//! processes, which are killed, as is the store. What all of them were told can be put into one
//! order.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use serde_json::json;
use tokio::task::JoinSet;

use blaze_tests::wait;

use super::checker::{Verdict, check};
use super::client::{Client, Must, Told, Via};
use super::count;
use super::register::{Content, Event, Op, Outcome};
use super::stage::{Main, Stage, blocking, micros, within};

const CLIENTS: usize = 10;
const KEYS: usize = 20;
/// Positions of one search. Those of a run without faults are about as many as there are
/// operations.
const SEARCH: usize = 500_000;
/// Before a client asks again that could not be answered.
const PAUSE: Duration = Duration::from_millis(20);

/// What is killed in the middle of a seed's run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    Nothing,
    Process(usize),
    Store,
}

impl Fault {
    fn of(seed: u64) -> Self {
        match seed % 4 {
            0 => Self::Process(usize::from(seed.is_multiple_of(8))),
            2 => Self::Store,
            _ => Self::Nothing,
        }
    }
}

/// What happened to each key, as the clients saw it.
type History = HashMap<usize, Vec<Event>>;

/// What a client knows of a key: its content, and the revision that this content has.
type Known = HashMap<usize, (Content, u64)>;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_ten_clients_are_told_fits_one_order() {
    let stage = Arc::new(Stage::mongo());
    let mains = [stage.start("one"), stage.start("two")];
    let client = Client::new(Via::Rest, &mains[0], &stage.admin_token());
    let mut unknown = 0;
    for seed in 1..=count(20, 4) as u64 {
        let limit = Duration::from_secs(300);
        let history = within("a seed", limit, run(seed, &stage, &mains, &client)).await;
        let begin = Instant::now();
        let all: Vec<&Event> = history.values().flatten().collect();
        let of = |wanted: Outcome| all.iter().filter(|event| event.outcome == wanted).count();
        let (done, refused, lost) = (of(Outcome::Done), of(Outcome::Refused), of(Outcome::Unknown));
        unknown += lost;
        for (key, events) in &history {
            let verdict = check(events, SEARCH);
            assert_eq!(verdict, Verdict::Linearizable, "seed {seed}, key {key}: {events:#?}");
        }
        println!(
            "seed {seed}, {:?}: {} operations, {done} done, {refused} refused, {lost} unknown; \
             ordered in {:?}",
            Fault::of(seed),
            all.len(),
            begin.elapsed()
        );
        assert!(done > CLIENTS && refused > 0, "the clients met");
    }
    println!("{unknown} of all are unknown");
}

async fn run(seed: u64, stage: &Arc<Stage>, mains: &[Arc<Main>; 2], client: &Client) -> History {
    let operations = count(100, 40);
    let begun = Arc::new(AtomicUsize::new(0));
    let mut clients = JoinSet::new();
    for index in 0..CLIENTS {
        let via = if index / 2 % 2 == 0 { Via::Rest } else { Via::Grpc };
        let user = User {
            client: client.at(via, &mains[index % 2]),
            number: u32::try_from(index).unwrap(),
            seed,
            random: StdRng::seed_from_u64(seed * 1000 + index as u64),
            known: Known::new(),
            events: Vec::new(),
        };
        clients.spawn(user.run(operations, Arc::clone(&begun)));
    }
    let (stage, killed) = (Arc::clone(stage), mains.clone());
    blocking(move || {
        let half = CLIENTS * operations / 2;
        let middle = || begun.load(Ordering::Relaxed) >= half;
        wait::until("half of the operations", Duration::from_secs(120), middle, String::new)
            .unwrap();
        match Fault::of(seed) {
            Fault::Nothing => {}
            Fault::Process(index) => {
                killed[index].kill();
                killed[index].start_again();
            }
            Fault::Store => stage.server().restart().unwrap(),
        }
    })
    .await;
    let mut history = History::new();
    for (key, event) in clients.join_all().await.into_iter().flatten() {
        history.entry(key).or_default().push(event);
    }
    // What is there at the end, through either process, must fit too.
    for (index, main) in mains.iter().enumerate() {
        let mut last = User {
            client: client.at(Via::Rest, main),
            number: u32::try_from(CLIENTS + index).unwrap(),
            seed,
            random: StdRng::seed_from_u64(seed),
            known: Known::new(),
            events: Vec::new(),
        };
        for key in 0..KEYS {
            while !last.get(key).await {
                tokio::time::sleep(PAUSE).await;
            }
        }
        for (key, event) in last.events {
            history.entry(key).or_default().push(event);
        }
    }
    history
}

/// One client.
struct User {
    client: Client,
    number: u32,
    seed: u64,
    random: StdRng,
    known: Known,
    events: Vec<(usize, Event)>,
}

impl User {
    async fn run(mut self, operations: usize, begun: Arc<AtomicUsize>) -> Vec<(usize, Event)> {
        for number in 0..u32::try_from(operations).unwrap() {
            begun.fetch_add(1, Ordering::Relaxed);
            let key = self.random.random_range(0..KEYS);
            let new = self.number * 100_000 + number;
            let known = self.known.get(&key).copied();
            let draw = self.random.random_range(0..100);
            let was_answered = match (known, draw) {
                (_, 0..25) => self.get(key).await,
                (None, 25..80) => self.change(key, Op::Create(new), 0).await,
                (None, _) => self.change(key, Op::Delete { seen: None }, 0).await,
                (Some((seen, revision)), 25..75) => {
                    self.change(key, Op::Swap { seen, new }, revision).await
                }
                (Some((seen, revision)), 75..88) => {
                    self.change(key, Op::Delete { seen: Some(seen) }, revision).await
                }
                (Some(_), 88..92) => self.change(key, Op::Delete { seen: None }, 0).await,
                (Some(_), _) => self.change(key, Op::Create(new), 0).await,
            };
            if !was_answered {
                tokio::time::sleep(PAUSE).await;
            }
        }
        self.events
    }

    fn name(&self, key: usize) -> String {
        format!("s{}-{key}", self.seed)
    }

    fn note(&mut self, key: usize, op: Op, outcome: Outcome, begin: u64) {
        let end = if outcome == Outcome::Unknown { u64::MAX } else { micros() };
        self.events.push((key, Event { op, outcome, begin, end }));
    }

    /// `false` when there was no answer; then it was as if nobody had looked.
    async fn get(&mut self, key: usize) -> bool {
        let begin = micros();
        let Ok(found) = self.client.get(&self.name(key)).await else {
            return false;
        };
        let found = found.map(|(revision, config)| {
            (u32::try_from(config["v"].as_u64().unwrap()).unwrap(), revision)
        });
        self.note(key, Op::Get, Outcome::Found(found.map(|(content, _)| content)), begin);
        match found {
            Some(found) => self.known.insert(key, found),
            None => self.known.remove(&key),
        };
        true
    }

    /// `false` when it is certain that nothing was done, for no fault of its own, or when nobody
    /// knows.
    async fn change(&mut self, key: usize, op: Op, revision: u64) -> bool {
        let name = self.name(key);
        let begin = micros();
        let told = match op {
            Op::Create(new) => self.client.put(&name, &json!({ "v": new }), Must::BeAbsent).await,
            Op::Swap { new, .. } => {
                self.client.put(&name, &json!({ "v": new }), Must::HaveRevision(revision)).await
            }
            Op::Delete { seen: Some(_) } => {
                self.client.delete(&name, Must::HaveRevision(revision)).await
            }
            Op::Delete { seen: None } => self.client.delete(&name, Must::BeThere).await,
            Op::Get => panic!("a look changes nothing"),
        };
        // Whatever it was before, it may be something else now.
        self.known.remove(&key);
        match told {
            Told::Yes(written) => {
                self.note(key, op, Outcome::Done, begin);
                if let Op::Create(new) | Op::Swap { new, .. } = op {
                    self.known.insert(key, (new, written));
                }
                true
            }
            Told::Refused(code) => {
                let deletes = matches!(op, Op::Delete { .. });
                assert!(
                    code == "precondition_failed" || (deletes && code == "not_found"),
                    "{op:?}: {code}"
                );
                self.note(key, op, Outcome::Refused, begin);
                true
            }
            Told::Unknown(_) => {
                self.note(key, op, Outcome::Unknown, begin);
                false
            }
            Told::No(_) => false,
        }
    }
}
