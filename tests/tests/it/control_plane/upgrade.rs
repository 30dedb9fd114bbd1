//! Two processes are replaced one after the other, as an upgrade does it, while users write and watch: nobody is refused
//! for good, and nothing is lost or told twice.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use blaze_tests::wait;
use serde_json::json;
use tokio::sync::watch;
use tokio::task::JoinSet;

use super::client::{Client, Must, Told, Via};
use super::count;
use super::stage::{Main, Stage, blocking, within};
use super::stream::{Next, Stream};

const WATCHERS: usize = 4;
const WRITERS: usize = 4;
/// How often one write is tried, at the processes in turn.
const TRIES: usize = 200;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_processes_are_replaced_one_by_one_under_load() {
    let stage = Stage::mongo();
    let mains = [stage.start("one"), stage.start("two")];
    let client = Client::new(Via::Rest, &mains[0], &stage.admin_token());
    let both = |index: usize| {
        let via = if index.is_multiple_of(2) { Via::Rest } else { Via::Grpc };
        let mut clients = [client.at(via, &mains[0]), client.at(via, &mains[1])];
        clients.rotate_left(index / 2 % 2);
        clients
    };
    let (end, end_seen) = watch::channel(None);
    let mut watching = JoinSet::new();
    for index in 0..WATCHERS {
        watching.spawn(follow(both(index), end_seen.clone()));
    }
    let (over, written) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicUsize::new(0)));
    let mut writing = JoinSet::new();
    for index in 0..WRITERS {
        let (over, written) = (Arc::clone(&over), Arc::clone(&written));
        writing.spawn(write(both(index), format!("w{index}"), over, written));
    }
    all_are_at(&mains).await;

    for round in 0..count(10, 2) {
        for main in &mains {
            let enough = written.load(Ordering::Relaxed) + 50;
            let (main, written) = (Arc::clone(main), Arc::clone(&written));
            blocking(move || {
                let has_written = || written.load(Ordering::Relaxed) >= enough;
                wait::until("50 more writes", Duration::from_secs(60), has_written, || {
                    format!("{} of {enough}", written.load(Ordering::Relaxed))
                })
                .unwrap();
                assert_eq!(main.stop(), Some(0), "round {round}: {main:?} ends well");
                main.start_again();
            })
            .await;
            all_are_at(&mains).await;
        }
    }
    over.store(true, Ordering::Relaxed);
    let outcomes = within("the writers", Duration::from_secs(60), writing.join_all()).await;
    let last = outcomes.iter().map(|outcome| outcome.last).max().unwrap();
    end.send_replace(Some(last));
    let seen = within("the watchers", Duration::from_secs(60), watching.join_all()).await;
    let unknown: usize = outcomes.iter().map(|outcome| outcome.unknown).sum();
    let turned: usize = outcomes.iter().map(|outcome| outcome.turned).sum();
    println!(
        "{} writes, {turned} went to the other process, {unknown} had to be read back; watches were resumed {seen:?} times",
        written.load(Ordering::Relaxed)
    );
    for outcome in &outcomes {
        for index in 0..4 {
            let [client, _] = both(index);
            let (revision, config) = client.get(&outcome.name).await.unwrap().unwrap();
            let found = (revision, config["n"].as_u64());
            assert_eq!(
                found,
                (outcome.last, Some(outcome.number)),
                "{:?} {:?}",
                client.via,
                client.main
            );
        }
    }
    assert!(
        seen.iter().all(|resumed| *resumed > 0),
        "every watch was ended by a process that left"
    );
}

/// What a writer has done.
struct Outcome {
    /// Its service.
    name: String,
    /// What its service says in the end.
    number: u64,
    /// Revision of its last write.
    last: u64,
    /// Writes that no process told the outcome of.
    unknown: usize,
    /// Writes that one process did not take and the other did.
    turned: usize,
}

/// Counts up in a service of its own, at one process as long as it takes writes, then at the other.
async fn write(clients: [Client; 2], name: String, over: Arc<AtomicBool>, written: Arc<AtomicUsize>) -> Outcome {
    let mut outcome = Outcome {
        name: name.clone(),
        number: 0,
        last: 0,
        unknown: 0,
        turned: 0,
    };
    let mut turn = 0;
    while !over.load(Ordering::Relaxed) {
        let number = outcome.number + 1;
        let must = match outcome.last {
            0 => Must::BeAbsent,
            last => Must::HaveRevision(last),
        };
        let config = json!({ "n": number });
        let mut tries = 0;
        outcome.last = loop {
            tries += 1;
            assert!(tries < TRIES, "{name}: nobody takes {number}");
            match clients[turn].put(&name, &config, must).await {
                Told::Yes(revision) => break revision,
                Told::No(_) => {
                    outcome.turned += 1;
                    turn = 1 - turn;
                    tokio::time::sleep(Duration::from_millis(10)).await;
                }
                Told::Unknown(_) => {
                    outcome.unknown += 1;
                    turn = 1 - turn;
                    if let Ok(Some((revision, found))) = clients[turn].get(&name).await
                        && found == config
                    {
                        break revision;
                    }
                }
                Told::Refused(code) => panic!("{name}: {number} is refused: {code}"),
            }
        };
        outcome.number = number;
        written.fetch_add(1, Ordering::Relaxed);
    }
    outcome
}

/// Watches until the end, at one process until that leaves, then at the other. How often it was resumed.
async fn follow(clients: [Client; 2], mut end: watch::Receiver<Option<u64>>) -> usize {
    let (mut turn, mut cursor, mut resumed) = (0, 0, 0);
    loop {
        let opened = match cursor {
            0 => Stream::open(&clients[turn], 0).await,
            _ => Stream::resume(&clients[turn], cursor).await,
        };
        let mut stream = opened.unwrap_or_else(|refused| panic!("{:?}: {refused:?}", clients[turn].main));
        loop {
            if end.borrow_and_update().is_some_and(|end| cursor >= end) {
                return resumed;
            }
            let next = tokio::select! {
                next = stream.next() => next,
                changed = end.changed() => {
                    changed.unwrap();
                    continue;
                }
            };
            match next {
                Next::Commit(commit) => {
                    assert_eq!(commit.revision, cursor + 1, "each once, in order");
                    cursor = commit.revision;
                }
                Next::Bookmark(revision) => assert_eq!(revision, cursor),
                Next::Ended(code) => {
                    assert_eq!(code, "shutting_down");
                    break;
                }
                Next::Over => panic!("{:?} ends without a word", clients[turn].main),
            }
        }
        turn = 1 - turn;
        resumed += 1;
    }
}

/// Waits until every watcher is at some process.
async fn all_are_at(mains: &[Arc<Main>; 2]) {
    let admins = mains.clone().map(|main| main.admin());
    blocking(move || {
        let open = || {
            let open = admins
                .iter()
                .filter_map(|admin| admin.metric("blaze_config_watchers", &[]));
            open.sum::<f64>()
        };
        let all_are_open = || open() == WATCHERS as f64;
        let state = || format!("{} of {WATCHERS}", open());
        wait::until("all watches", Duration::from_secs(60), all_are_open, state).unwrap();
    })
    .await;
}
