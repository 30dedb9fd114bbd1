//! Many watchers at once: each is told everything, once, in order and whole, whatever happens to
//! its connection.

use std::sync::Arc;
use std::time::{Duration, Instant};

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use serde_json::json;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;

use blaze_tests::wait;

use super::client::{Client, Via};
use super::count;
use super::stage::{Main, Stage, blocking, within};
use super::stream::{Commit, Next, Stream};
use super::watcher::{Plan, Tally, Watcher, p99, state_of};
use super::writer::Writer;

const WRITERS: usize = 8;
/// Services of one writer; some commits change all of them.
const DOCUMENTS: usize = 100;
/// Commits that a watcher may be behind, as the contract has it.
const MAX_BEHIND: usize = 1000;

/// Two processes on one store, and a client of the first.
fn two() -> (Stage, [Arc<Main>; 2], Client) {
    let stage = Stage::mongo();
    let mains = [stage.start("one"), stage.start("two")];
    let client = Client::new(Via::Rest, &mains[0], &stage.admin_token());
    (stage, mains, client)
}

/// A writer at each process and interface in turn.
fn writer(client: &Client, mains: &[Arc<Main>; 2], index: usize, padding: usize) -> Writer {
    let via = if index.is_multiple_of(2) { Via::Rest } else { Via::Grpc };
    let client = client.at(via, &mains[index / 2 % 2]);
    Writer::new(client, &format!("w{index}"), DOCUMENTS, padding)
}

/// Half of the watchers by REST, half by gRPC; half of each begin at the one process, half at the
/// other.
fn clients_of(client: &Client, mains: &[Arc<Main>; 2], index: usize) -> Vec<Client> {
    let via = if index.is_multiple_of(2) { Via::Rest } else { Via::Grpc };
    let mut clients = vec![client.at(via, &mains[0]), client.at(via, &mains[1])];
    if index / 2 % 2 == 1 {
        clients.reverse();
    }
    clients
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_is_told_everything_once_while_it_is_cut_and_the_history_is_trimmed() {
    let (_stage, mains, client) = two();
    let (watchers, cuts) = (2 * count(100, 8), count(50, 8));
    let writes = count(20_000, 640);
    let limit = Duration::from_secs(if blaze_tests::long() { 1800 } else { 90 });
    let (floor, floor_seen) = watch::channel(0);
    let (end, end_seen) = watch::channel(None);
    let mut random = StdRng::seed_from_u64(11);
    let mut following: JoinSet<Watcher> = JoinSet::new();
    for index in 0..watchers {
        let mut cuts: Vec<u64> = (0..cuts).map(|_| random.random_range(1..writes as u64)).collect();
        cuts.sort_unstable_by(|one, other| other.cmp(one));
        let plan = Plan { cuts, late: 4, floor: floor_seen.clone(), end: end_seen.clone() };
        let clients = clients_of(&client, &mains, index);
        following.spawn(async move { Watcher::start(clients).await.run(plan).await });
    }
    let (head, head_seen) = watch::channel(0);
    let trimming = trim_on(client.clone(), mains.clone(), head_seen, floor, random);
    let writing = async {
        let mut writing = JoinSet::new();
        let head = Arc::new(head);
        for index in 0..WRITERS {
            let (mut writer, head) = (writer(&client, &mains, index, 0), Arc::clone(&head));
            writing.spawn(async move {
                for _ in 0..writes / WRITERS {
                    let revision = writer.write().await;
                    head.send_if_modified(|head| {
                        let newer = revision > *head;
                        *head = revision.max(*head);
                        newer
                    });
                }
            });
        }
        while let Some(done) = writing.join_next().await {
            done.unwrap();
        }
        *head.borrow()
    };
    let begin = Instant::now();
    let (last, (trims, longest)) =
        within("writing", limit, async { tokio::join!(writing, trimming) }).await;
    assert_eq!(last, writes as u64, "each write is a commit of its own");
    end.send_replace(Some(last));
    println!("{writes} writes and {trims} trims in {:?}, the longest {longest:?}", begin.elapsed());
    let seen = within("the watchers", limit, following.join_all()).await;
    println!("all {} watchers are at the end after {:?}", seen.len(), begin.elapsed());
    for main in &mains {
        let (revision, items) = client.rest.list(main.at().rest, "services").await;
        assert_eq!(revision, last);
        let state = state_of(&items);
        for watcher in &seen {
            assert_eq!(watcher.state, state, "{:?}", watcher.tally);
        }
    }
    let sum =
        |one: fn(&Tally) -> usize| seen.iter().map(|watcher| one(&watcher.tally)).sum::<usize>();
    let gone = sum(|tally| tally.lists) - seen.len();
    println!(
        "{} commits told, {} cuts, {gone} times 410, {} times too slow",
        sum(|t| t.commits),
        sum(|t| t.cuts),
        sum(|t| t.slow)
    );
    assert_eq!(sum(|tally| tally.cuts), watchers * cuts);
    assert!(trims > 0 && gone > 0, "the history was trimmed, and some came too late");
}

/// Trims close behind the newest revision as long as somebody writes; how often, and how long the
/// longest took.
async fn trim_on(
    client: Client,
    mains: [Arc<Main>; 2],
    mut head: watch::Receiver<u64>,
    floor: watch::Sender<u64>,
    mut random: StdRng,
) -> (usize, Duration) {
    let (mut next, mut trims, mut longest) = (30, 0, Duration::ZERO);
    loop {
        let revision = match head.wait_for(|head| *head >= next).await {
            Ok(revision) => *revision,
            Err(_) => return (trims, longest),
        };
        let before = revision - random.random_range(0..10);
        let at = mains[trims % 2].at().rest;
        let begun = Instant::now();
        let answer = client.rest.post(at, "/api/v1/trim", &json!({ "before": before })).await;
        let oldest = answer.body["oldest_revision"].as_u64().unwrap();
        assert_eq!(oldest, before - 1);
        longest = longest.max(begun.elapsed());
        floor.send_replace(oldest);
        next = revision + random.random_range(10..60);
        trims += 1;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_goes_on_at_the_other_process_while_one_is_replaced() {
    const WATCHERS: usize = 4;
    let (_stage, mains, client) = two();
    let (end, end_seen) = watch::channel(None);
    let following = follow(&client, &mains, WATCHERS, &end_seen);
    let mut last = 0;
    for (leaving, staying) in [(0, 1), (1, 0)] {
        all_open(&mains, WATCHERS).await;
        // Commits before the process is asked to end, until it has ended, and afterwards.
        let mut writer = writer(&client, &mains, 2 * staying, 0);
        for _ in 0..20 {
            last = writer.write().await;
        }
        let main = Arc::clone(&mains[leaving]);
        let stopping = blocking(move || main.stop());
        let writing = async {
            let mut stopping = std::pin::pin!(stopping);
            loop {
                last = writer.write().await;
                if let Some(code) = futures::FutureExt::now_or_never(stopping.as_mut()) {
                    return code;
                }
            }
        };
        let code = within("the end of a process", Duration::from_secs(60), writing).await;
        assert_eq!(code, Some(0), "it ends well");
        for _ in 0..20 {
            last = writer.write().await;
        }
        let main = Arc::clone(&mains[leaving]);
        blocking(move || main.start_again()).await;
    }
    end.send_replace(Some(last));
    let seen = within("the watchers", Duration::from_secs(60), following.join_all()).await;
    for main in &mains {
        let (revision, items) = client.rest.list(main.at().rest, "services").await;
        assert_eq!(revision, last);
        let state = state_of(&items);
        for watcher in &seen {
            assert_eq!(watcher.state, state, "{:?}", watcher.tally);
        }
    }
    for Watcher { tally, .. } in &seen {
        assert!(tally.left > 0 && tally.lists == 1, "it goes on where it was: {tally:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_that_stands_still_is_ended_and_holds_up_nobody() {
    let (_stage, mains, client) = two();
    let long = blaze_tests::long();
    let watchers = 2 * count(100, 5);
    let limit = Duration::from_secs(if long { 600 } else { 60 });
    let (stands, pause) = match long {
        true => (Duration::from_secs(60), Duration::from_millis(60)),
        false => (Duration::ZERO, Duration::from_millis(1)),
    };
    let mut writers: Vec<Writer> =
        (0..4).map(|index| writer(&client, &mains, index, 1024)).collect();
    let mut first = 0;
    for writer in &mut writers {
        first = writer.put_all().await;
    }
    let mut standing = Vec::new();
    for (via, client) in [(Via::Rest, narrow(&client)), (Via::Grpc, client.clone())] {
        let client = client.at(via, &mains[0]);
        let mut stream =
            Stream::open(&client, first).await.unwrap_or_else(|refused| panic!("{refused:?}"));
        // The second one says that it has caught up.
        for _ in 0..2 {
            assert_eq!(stream.next().await, Next::Bookmark(first));
        }
        standing.push((client, stream));
    }
    let (end, end_seen) = watch::channel(None);
    let following = follow(&client, &mains, watchers, &end_seen);
    all_open(&mains, watchers + 2).await;

    let before = mains[0].resident_bytes();
    let begin = Instant::now();
    let mut writing = JoinSet::new();
    for mut writer in writers {
        writing.spawn(async move {
            let mut ticks = tokio::time::interval(pause);
            ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
            let (mut last, mut written) = (0, 0);
            // Four of them: 1.5 times what anybody may be behind. Buffers hold less than the
            // difference.
            while begin.elapsed() < stands || written < MAX_BEHIND * 3 / 8 {
                ticks.tick().await;
                last = writer.put_one().await;
                written += 1;
            }
            last
        });
    }
    let mut most = before;
    let mut look = tokio::time::interval(Duration::from_millis(50));
    let mut last = first;
    within("writing", limit, async {
        loop {
            tokio::select! {
                done = writing.join_next() => match done {
                    Some(done) => last = last.max(done.unwrap()),
                    None => break,
                },
                _ = look.tick() => most = most.max(mains[0].resident_bytes()),
            }
        }
    })
    .await;
    end.send_replace(Some(last));
    let seen = within("the watchers", limit, following.join_all()).await;
    let stood = begin.elapsed();
    for (client, stream) in standing {
        within("the end of who stands still", limit, ended(&client, stream, first, last)).await;
    }

    let slow: usize = seen.iter().map(|watcher| watcher.tally.slow).sum();
    let delay = Duration::from_micros(p99(seen
        .iter()
        .flat_map(|watcher| watcher.tally.delays.iter().copied())));
    let grown = most.saturating_sub(before) / 1024 / 1024;
    println!(
        "{} commits in {stood:?} to {watchers} watchers: p99 {delay:?}, {slow} times too slow; RSS \
         {} MiB, at most {grown} MiB more",
        last - first,
        before / 1024 / 1024
    );
    assert!(grown <= 64, "{grown} MiB");
    if long {
        assert!(stood >= stands && slow == 0, "{stood:?}, {slow} others were ended");
        assert!(delay <= Duration::from_millis(100), "{delay:?}");
    }
}

/// REST over HTTP/2 with a small window: what is not read stays with the service, not in buffers of
/// the system.
fn narrow(client: &Client) -> Client {
    let http = reqwest::Client::builder().no_proxy().http2_prior_knowledge();
    client.over(http.http2_initial_stream_window_size(65_535).build().unwrap())
}

/// Watchers that read on until `end`, at both processes and interfaces in turn, and are never cut.
fn follow(
    client: &Client,
    mains: &[Arc<Main>; 2],
    watchers: usize,
    end: &watch::Receiver<Option<u64>>,
) -> JoinSet<Watcher> {
    let following = (0..watchers).map(|index| {
        let plan = Plan { cuts: Vec::new(), late: 1, floor: watch::channel(0).1, end: end.clone() };
        let clients = clients_of(client, mains, index);
        async move { Watcher::start(clients).await.run(plan).await }
    });
    following.collect()
}

/// Waits until so many watches are open.
async fn all_open(mains: &[Arc<Main>; 2], watchers: usize) {
    let admins = mains.clone().map(|main| main.admin());
    blocking(move || {
        let open = || {
            admins
                .iter()
                .filter_map(|admin| admin.metric("blaze_config_watchers", &[]))
                .sum::<f64>()
        };
        wait::until(
            "all watches",
            Duration::from_secs(60),
            || open() == watchers as f64,
            || format!("{} of {watchers} are open", open()),
        )
        .unwrap();
    })
    .await;
}

/// Who stood still reads on: what comes has no gap, then it is told why it ends; and it can go on
/// where it was.
async fn ended(client: &Client, mut stream: Stream, first: u64, last: u64) {
    let mut cursor = first;
    let code = loop {
        match stream.next().await {
            Next::Commit(commit) => {
                assert_eq!(commit.revision, cursor + 1);
                cursor = commit.revision;
            }
            Next::Bookmark(_) => {}
            Next::Ended(code) => break code,
            Next::Over => panic!("it ends without a word"),
        }
    };
    println!("{:?} got {} of {} commits", client.via, cursor - first, last - first);
    assert_eq!(code, "watch_too_slow");
    assert!(cursor + (MAX_BEHIND as u64) < last, "it was not behind");
    let mut stream =
        Stream::resume(client, cursor).await.unwrap_or_else(|refused| panic!("{refused:?}"));
    let rest: Vec<Commit> = stream.until(last).await.unwrap_or_else(|other| panic!("{other:?}"));
    let revisions: Vec<u64> = rest.iter().map(|commit| commit.revision).collect();
    assert_eq!(revisions, (cursor + 1..=last).collect::<Vec<u64>>());
}
