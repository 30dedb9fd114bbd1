//! Processes and their store are killed, or replaced as an upgrade does it, while many write. What
//! each writer was told is true: what took effect is there, once and whole; what did not is
//! nowhere; of what nobody knows it is one or the other, whole.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use serde_json::{Value, json};
use tokio::task::JoinSet;

use blaze_tests::wait;

use super::client::{Client, Must, Told, Via};
use super::count;
use super::stage::{Main, Stage, blocking, within};
use super::stream::{Commit, Op, Stream};
use super::watcher::{State, state_of};

const WRITERS: usize = 8;
/// Services of one writer.
const DOCUMENTS: usize = 5;
/// One of so many writes changes all services of its writer.
const APPLY: usize = 5;
/// Before a writer tries again that was not told yes.
const PAUSE: Duration = Duration::from_millis(20);

/// One write.
struct Attempt {
    batch: String,
    /// In order.
    names: Vec<String>,
    told: Told,
}

/// What is killed.
#[derive(Debug, Clone, Copy)]
enum Victim {
    Process(usize),
    /// It is asked to end, as an upgrade does it.
    Replaced(usize),
    Store,
}

/// Counts writes that took effect, for all writers.
struct Progress {
    yes: AtomicUsize,
    goal: usize,
}

impl Progress {
    fn yes(&self) -> usize {
        self.yes.load(Ordering::Acquire)
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_writers_are_told_is_true_while_the_service_on_sqlite_is_killed() {
    let stage = Arc::new(Stage::sqlite());
    let mains = vec![stage.start("main")];
    let victims = vec![Victim::Process(0); count(10, 3)];
    told_the_truth(&stage, &mains, victims, count(20_000, 400)).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_writers_are_told_is_true_while_two_services_and_mongodb_go_and_come() {
    let stage = Arc::new(Stage::mongo());
    let mains = vec![stage.start("one"), stage.start("two")];
    let each =
        |index: usize| [Victim::Process(index % 2), Victim::Store, Victim::Replaced(index % 2)];
    let victims = (0..count(10, 2)).flat_map(each).collect();
    told_the_truth(&stage, &mains, victims, count(20_000, 400)).await;
}

async fn told_the_truth(
    stage: &Arc<Stage>,
    mains: &[Arc<Main>],
    victims: Vec<Victim>,
    goal: usize,
) {
    let limit = Duration::from_secs(if blaze_tests::long() { 1800 } else { 120 });
    let client = Client::new(Via::Rest, &mains[0], &stage.admin_token());
    let progress = Arc::new(Progress { yes: AtomicUsize::new(0), goal });
    let begin = Instant::now();
    let mut writers = JoinSet::new();
    for index in 0..WRITERS {
        let via = if index % 2 == 0 { Via::Rest } else { Via::Grpc };
        let client = client.at(via, &mains[index / 2 % mains.len()]);
        writers.spawn(write(client, index, Arc::clone(&progress)));
    }
    let kills = victims.len();
    let killing = {
        let (stage, mains, progress) = (Arc::clone(stage), mains.to_vec(), Arc::clone(&progress));
        blocking(move || kill_all(&stage, &mains, &victims, &progress))
    };
    within("the kills", limit, killing).await;
    let attempts: Vec<Attempt> =
        within("the writers", limit, writers.join_all()).await.into_iter().flatten().collect();
    let of = |one: fn(&Told) -> bool| attempts.iter().filter(|attempt| one(&attempt.told)).count();
    println!(
        "{} writes and {kills} kills in {:?}: yes {}, no {}, unknown {}",
        attempts.len(),
        begin.elapsed(),
        of(|told| matches!(told, Told::Yes(_))),
        of(|told| matches!(told, Told::No(_))),
        of(|told| matches!(told, Told::Unknown(_))),
    );
    let history = within("the history", limit, history(&client)).await;
    check(&attempts, &history);
    for main in mains {
        let (_, items) = client.rest.list(main.at().rest, "services").await;
        assert_eq!(state_of(&items), folded(&history), "the documents are those of the history");
    }
    audited(&client, &history).await;
}

/// Kills one after the other, in the middle of the writes.
fn kill_all(stage: &Stage, mains: &[Arc<Main>], victims: &[Victim], progress: &Progress) {
    let mut random = StdRng::seed_from_u64(5);
    for (index, victim) in victims.iter().enumerate() {
        let due = progress.goal * (index + 1) / (victims.len() + 1);
        wait::until(
            &format!("{due} writes"),
            Duration::from_secs(300),
            || progress.yes() >= due,
            || format!("there are {}", progress.yes()),
        )
        .unwrap();
        // Not on a condition: it is to hit any point of a commit.
        std::thread::sleep(Duration::from_micros(random.random_range(0..10_000)));
        match *victim {
            Victim::Process(index) => {
                mains[index].kill();
                mains[index].start_again();
            }
            Victim::Replaced(index) => {
                assert_eq!(mains[index].stop(), Some(0), "it ends well");
                mains[index].start_again();
            }
            Victim::Store => stage.server().restart().unwrap(),
        }
    }
}

/// Writes until all writers together were told yes often enough.
async fn write(client: Client, number: usize, progress: Arc<Progress>) -> Vec<Attempt> {
    let names: Vec<String> = (0..DOCUMENTS).map(|index| format!("w{number}-{index}")).collect();
    let mut attempts = Vec::new();
    while progress.yes() < progress.goal {
        let count = attempts.len();
        let batch = format!("{number}-{count}");
        let is_made = attempts.iter().any(|attempt: &Attempt| matches!(attempt.told, Told::Yes(_)));
        // The first one that took effect has made all of them.
        let (names, told) = if !is_made || count.is_multiple_of(APPLY) {
            let documents: Vec<(String, Value)> =
                names.iter().map(|name| (name.clone(), content(&batch))).collect();
            (names.clone(), client.apply(&documents).await)
        } else {
            let name = &names[count % DOCUMENTS];
            (vec![name.clone()], client.put(name, &content(&batch), Must::BeThere).await)
        };
        if let Told::Yes(_) = told {
            progress.yes.fetch_add(1, Ordering::AcqRel);
        } else {
            assert!(!matches!(told, Told::Refused(_)), "{batch}: {told:?}");
            tokio::time::sleep(PAUSE).await;
        }
        attempts.push(Attempt { batch, names, told });
    }
    attempts
}

fn content(batch: &str) -> Value {
    json!({ "batch": batch })
}

/// Every commit there ever was.
async fn history(client: &Client) -> Vec<Commit> {
    let head = client.rest.list(client.main.at().rest, "services").await.0;
    let mut stream = Stream::open(client, 0).await.unwrap_or_else(|refused| panic!("{refused:?}"));
    let commits = stream.until(head).await.unwrap_or_else(|other| panic!("{other:?}"));
    let revisions: Vec<u64> = commits.iter().map(|commit| commit.revision).collect();
    assert_eq!(revisions, (1..=head).collect::<Vec<u64>>(), "no revision is missing");
    commits
}

/// Compares what writers were told with what happened.
fn check(attempts: &[Attempt], history: &[Commit]) {
    let mut found: BTreeMap<&str, Vec<(u64, Vec<&str>)>> = BTreeMap::new();
    for commit in history {
        let batch = commit.changes[0].config["batch"].as_str().unwrap();
        assert!(commit.changes.iter().all(|change| change.config["batch"] == batch), "{commit:?}");
        assert!(
            commit.changes.iter().all(|change| change.revision == commit.revision),
            "{commit:?}"
        );
        let names = commit.changes.iter().map(|change| change.name.as_str()).collect();
        found.entry(batch).or_default().push((commit.revision, names));
    }
    for attempt in attempts {
        let there = found.remove(attempt.batch.as_str()).unwrap_or_default();
        let whole = || there.len() == 1 && there[0].1 == attempt.names;
        let is_true = match attempt.told {
            Told::Yes(revision) => whole() && there[0].0 == revision,
            Told::Unknown(_) => there.is_empty() || whole(),
            Told::No(_) | Told::Refused(_) => there.is_empty(),
        };
        assert!(
            is_true,
            "{}, {:?}: told {:?}, found {there:?}",
            attempt.batch, attempt.names, attempt.told
        );
    }
    assert!(found.is_empty(), "nobody wrote {found:?}");
}

/// The documents that a history leads to.
fn folded(history: &[Commit]) -> State {
    let mut state = State::new();
    for change in history.iter().flat_map(|commit| &commit.changes) {
        let before = state.insert(change.name.clone(), (change.revision, change.config.clone()));
        assert_eq!(change.op, if before.is_some() { Op::Update } else { Op::Create });
    }
    state
}

/// Each change is in the audit, once, and in the history of its document; nothing else is.
async fn audited(client: &Client, history: &[Commit]) {
    let at = client.main.at().rest;
    let mut expected: Vec<(u64, &str)> = Vec::new();
    for commit in history {
        expected
            .extend(commit.changes.iter().map(|change| (commit.revision, change.name.as_str())));
    }
    expected.sort_unstable();
    let entries = client.rest.pages(at, "/api/v1/audit?outcome=allowed").await;
    let of_audit =
        |entry: &Value| Some((entry["revision"].as_u64()?, entry["name"].as_str()?.to_owned()));
    let mut audit: Vec<(u64, String)> = entries.iter().filter_map(of_audit).collect();
    audit.sort_unstable();
    assert!(
        audit
            .iter()
            .map(|(revision, name)| (*revision, name.as_str()))
            .eq(expected.iter().copied()),
        "the audit differs"
    );
    // A writer whose service was down all the while may have made none.
    let changes = || history.iter().flat_map(|commit| &commit.changes);
    let names: BTreeSet<&str> = changes().map(|change| change.name.as_str()).collect();
    assert!(names.len() >= DOCUMENTS);
    for name in names.into_iter().take(DOCUMENTS) {
        let path = format!("/api/v1/services/{name}/history?view=full");
        let versions = client.rest.pages(at, &path).await;
        let versions = versions.iter().rev().map(|version| {
            let document = &version["document"];
            assert_eq!(version["revision"], document["revision"]);
            (document["revision"].as_u64().unwrap(), document["spec"]["config"].clone())
        });
        let changes = changes().filter(|change| change.name == name);
        let changes = changes.map(|change| (change.revision, change.config.clone()));
        assert!(versions.eq(changes), "the history of {name} differs");
    }
}
