//! Watches that begin at every revision around the one that the history was trimmed to: each gets exactly what happened
//! since, or is told that this is not known any more.

use std::sync::Arc;
use std::time::Duration;

use serde_json::json;

use super::client::{Client, Via};
use super::count;
use super::stage::{Main, Stage, blocking, within};
use super::stream::{Commit, Next, Refused, Stream};
use super::writer::Writer;

/// Commits behind the last revision that is resumed at.
const BEHIND: usize = 20;

/// A history, and what it is resumed by.
struct World {
    clients: [Client; 2],
    main: Arc<Main>,
    /// The commit of revision n + 1 at n.
    history: Vec<Commit>,
}

impl World {
    async fn trim(&self, floor: u64) {
        let body = json!({ "before": floor + 1 });
        let answer = self.clients[0]
            .rest
            .post(self.main.at().rest, "/api/v1/trim", &body)
            .await;
        assert_eq!(answer.body["oldest_revision"], floor);
    }

    /// What a watch since a revision is told, until now: everything, or why not.
    async fn told(&self, since: u64) -> Result<Vec<Commit>, Refused> {
        // In turn: by REST and gRPC, as a new watch and as one that goes on.
        let client = &self.clients[usize::from(since % 2 == 1)];
        let mut stream = match since / 2 % 2 {
            0 => Stream::open(client, since).await?,
            _ => Stream::resume(client, since).await?,
        };
        assert_eq!(stream.next().await, Next::Bookmark(since));
        match stream.until(self.history.len() as u64).await {
            Ok(commits) => Ok(commits),
            // It was trimmed away while it was read.
            Err(Next::Ended(code)) => Err(Refused {
                code,
                oldest_revision: None,
            }),
            Err(other) => panic!("{since}: {other:?}"),
        }
    }

    /// Whether that was exact.
    async fn resumes(&self, since: u64) -> bool {
        match within("a resume", Duration::from_secs(60), self.told(since)).await {
            Ok(commits) => {
                self.check(since, commits);
                true
            }
            Err(refused) => {
                assert_eq!(refused.code, "revision_trimmed", "{since}");
                assert!(
                    refused.oldest_revision.is_none_or(|oldest| oldest > since),
                    "{since}: {refused:?}"
                );
                false
            }
        }
    }

    fn check(&self, since: u64, commits: Vec<Commit>) {
        let skipped = usize::try_from(since).unwrap();
        assert_eq!(commits.len(), self.history.len() - skipped, "{since}");
        for (found, expected) in commits.into_iter().zip(&self.history[skipped..]) {
            assert!(
                found.previous.is_none_or(|previous| previous == expected.revision - 1),
                "{since}: {found:?}"
            );
            let found = Commit {
                previous: None,
                ..found
            };
            assert_eq!(found, *expected, "{since}");
        }
    }
}

/// Makes so many commits, and takes them down as they come.
async fn world(stage: &Stage, commits: usize) -> World {
    let main = stage.start("main");
    let client = Client::new(Via::Rest, &main, &stage.admin_token());
    let mut stream = Stream::open(&client, 0)
        .await
        .unwrap_or_else(|refused| panic!("{refused:?}"));
    let mut writer = Writer::new(client.at(Via::Grpc, &main), "w", 3, 0);
    let mut history = Vec::new();
    for revision in 1..=commits as u64 {
        assert_eq!(writer.write().await, revision);
        let told = stream.until(revision).await.unwrap_or_else(|other| panic!("{other:?}"));
        let [commit] = <[Commit; 1]>::try_from(told).unwrap();
        history.push(commit);
    }
    World {
        clients: [client.clone(), client.at(Via::Grpc, &main)],
        main,
        history,
    }
}

/// Another process, which has nothing in memory but the documents.
async fn start_anew(main: &Arc<Main>) {
    let main = Arc::clone(main);
    blocking(move || {
        main.kill();
        main.start_again();
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn at_every_offset_around_the_trim_point_a_resume_is_exact_or_410() {
    let stage = Stage::sqlite();
    let around = count(500, 20);
    let world = world(&stage, 2 * around + BEHIND).await;
    let floor = around as u64;
    world.trim(floor).await;
    // First from memory, then by a process that knows only what the store still has.
    for starts_anew in [false, true] {
        if starts_anew {
            start_anew(&world.main).await;
        }
        for since in 0..2 * around as u64 {
            assert_eq!(world.resumes(since).await, since >= floor, "{since}");
        }
    }
    println!("{} resumes, {} commits", 4 * around, world.history.len());
}

/// The history is trimmed by one more revision at the very time of each resume.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn while_the_trim_point_moves_a_resume_is_exact_or_410() {
    let stage = Stage::sqlite();
    let resumes = count(1000, 60);
    let world = world(&stage, resumes + BEHIND).await;
    let (mut exact, mut gone, mut raced) = (0, 0, [0, 0]);
    for floor in 0..resumes as u64 {
        if floor == resumes as u64 / 2 {
            start_anew(&world.main).await;
        }
        let since = (floor + floor % 4).saturating_sub(1);
        let (is_exact, ()) = tokio::join!(world.resumes(since), world.trim(floor + 1));
        if since < floor {
            assert!(!is_exact, "{since} of {floor}");
            gone += 1;
        } else if since > floor {
            assert!(is_exact, "{since} of {floor}");
            exact += 1;
        } else {
            raced[usize::from(is_exact)] += 1;
        }
    }
    println!(
        "{exact} exact, {gone} times 410, at the moving point itself {} exact and {} times 410",
        raced[1], raced[0]
    );
    assert!(exact > 0 && gone > 0 && raced[0] + raced[1] > 0);
}
