//! A watch of all services that is cut again and again, and checks everything that it is told.
//!
//! ```text
//! list ─▶ watch since its revision ─▶ commits, each the next one ─▶ cut ─▶ resume at the next process
//!  ▲                                                                         │
//!  └────────────────────────────── 410 ──────────────────────────────────────┘
//! ```
//!
//! What is checked of each commit: it is the next revision (so none is missing, none comes twice,
//! all are in order), it is whole (a [`Writer`](super::writer::Writer) says in each document how
//! many belong together), and each change fits what is known of its document.

use std::collections::BTreeMap;

use serde_json::Value;
use tokio::sync::watch;

use super::client::{Client, Seen, Via};
use super::stage::micros;
use super::stream::{Change, Commit, Next, Op, Stream};

/// How often opening a watch and listing are tried while the history is trimmed away under them.
const TRIES: usize = 1000;

/// All services, by name.
pub(crate) type State = BTreeMap<String, Seen>;

/// When a watcher is cut off, and when it ends.
pub(crate) struct Plan {
    /// Revisions after which it is cut off, the last one first.
    pub(crate) cuts: Vec<u64>,
    /// After each so many cuts it comes back only once its revision was trimmed.
    pub(crate) late: usize,
    /// The smallest revision that a watch may start after, as far as it was told.
    pub(crate) floor: watch::Receiver<u64>,
    /// The last revision, as soon as it is known.
    pub(crate) end: watch::Receiver<Option<u64>>,
}

/// What a watcher went through.
#[derive(Debug, Clone, Default)]
pub(crate) struct Tally {
    pub(crate) commits: usize,
    pub(crate) cuts: usize,
    /// The first list, and one after each 410.
    pub(crate) lists: usize,
    /// How often its process ended.
    pub(crate) left: usize,
    /// How often it was ended because it was too slow.
    pub(crate) slow: usize,
    /// From before a write was sent until it was told, in microseconds; of writes that began while
    /// the watch was open.
    pub(crate) delays: Vec<u64>,
}

/// A watcher.
pub(crate) struct Watcher {
    /// At each of the processes that it asks in turn.
    clients: Vec<Client>,
    turn: usize,
    stream: Option<Stream>,
    opened: u64,
    pub(crate) state: State,
    /// Everything up to this revision is in `state`.
    pub(crate) cursor: u64,
    pub(crate) tally: Tally,
}

impl Watcher {
    /// Lists, and watches from there.
    pub(crate) async fn start(clients: Vec<Client>) -> Self {
        let mut watcher = Self {
            clients,
            turn: 0,
            stream: None,
            opened: 0,
            state: State::new(),
            cursor: 0,
            tally: Tally::default(),
        };
        watcher.list().await;
        watcher.open().await;
        watcher
    }

    /// Watches until the end.
    pub(crate) async fn run(mut self, mut plan: Plan) -> Self {
        let planned = plan.cuts.len();
        loop {
            while plan.cuts.pop_if(|cut| *cut <= self.cursor).is_some() {
                self.cut().await;
                if self.tally.cuts.is_multiple_of(plan.late) {
                    let cursor = self.cursor;
                    tokio::select! {
                        () = reaches(&mut plan.floor, |floor| *floor > cursor) => {}
                        () = reaches(&mut plan.end, Option::is_some) => {}
                    }
                }
                self.open().await;
            }
            let end = *plan.end.borrow_and_update();
            if end.is_some_and(|end| self.cursor >= end) {
                assert_eq!(self.tally.cuts, planned);
                return self;
            }
            tokio::select! {
                () = self.next() => {}
                changed = plan.end.changed() => changed.unwrap(),
            }
        }
    }

    /// Goes on until this revision.
    pub(crate) async fn catch_up(&mut self, revision: u64) {
        while self.cursor < revision {
            self.next().await;
        }
    }

    /// From now on it asks these.
    pub(crate) async fn move_to(&mut self, clients: Vec<Client>) {
        self.cut().await;
        self.turn = 0;
        self.clients = clients;
    }

    /// The interface that it asks by.
    pub(crate) fn via(&self) -> Via {
        self.client().via
    }

    /// Takes the next event. May be given up at any time.
    async fn next(&mut self) {
        if self.stream.is_none() {
            self.open().await;
        }
        let Some(stream) = &mut self.stream else { return };
        match stream.next().await {
            Next::Commit(commit) => self.take(&commit),
            // It watches everything, so there is nothing to skip.
            Next::Bookmark(revision) => assert_eq!(revision, self.cursor),
            Next::Ended(code) if code == "watch_too_slow" => {
                self.tally.slow += 1;
                self.stream = None;
            }
            // As the contract has it, it goes on at another process.
            Next::Ended(code) if code == "shutting_down" => {
                self.tally.left += 1;
                self.stream = None;
                self.turn = (self.turn + 1) % self.clients.len();
            }
            // While it was still reading what had been before.
            Next::Ended(code) if code == "revision_trimmed" => {
                self.stream = None;
                self.list().await;
            }
            other @ (Next::Ended(_) | Next::Over) => {
                panic!("{:?} ends with {other:?}", self.client().main)
            }
        }
    }

    fn client(&self) -> &Client {
        &self.clients[self.turn]
    }

    /// Loses the stream, every other time with its connection, and turns to the next process.
    async fn cut(&mut self) {
        self.stream = None;
        if self.tally.cuts.is_multiple_of(2) {
            self.client().disconnect().await;
        }
        self.turn = (self.turn + 1) % self.clients.len();
        self.tally.cuts += 1;
    }

    /// Opens a watch where it was, or lists first where that was trimmed.
    pub(crate) async fn open(&mut self) {
        for _ in 0..TRIES {
            let opened = match self.tally.commits {
                0 => Stream::open(self.client(), self.cursor).await,
                _ => Stream::resume(self.client(), self.cursor).await,
            };
            match opened {
                Ok(stream) => {
                    self.opened = micros();
                    self.stream = Some(stream);
                    return;
                }
                Err(refused) => {
                    assert_eq!(refused.code, "revision_trimmed", "{refused:?}");
                    let oldest = refused.oldest_revision.unwrap();
                    assert!(
                        oldest > self.cursor,
                        "{} would do, {oldest} is said to be the oldest",
                        self.cursor
                    );
                    self.list().await;
                }
            }
        }
        panic!("{TRIES} lists were trimmed away before they could be watched");
    }

    async fn list(&mut self) {
        let client = self.client();
        let (revision, items) = client.rest.list(client.main.at().rest, "services").await;
        assert!(revision >= self.cursor, "a list of {revision} after a commit of {}", self.cursor);
        self.state = state_of(&items);
        self.cursor = revision;
        self.tally.lists += 1;
    }

    fn take(&mut self, commit: &Commit) {
        let revision = commit.revision;
        assert_eq!(revision, self.cursor + 1, "{:?}", self.client().main);
        assert!(commit.previous.is_none_or(|previous| previous == self.cursor), "{commit:?}");
        for change in &commit.changes {
            self.take_one(commit, change);
        }
        let first = &commit.changes[0];
        if first.op != Op::Delete {
            assert_eq!(first.config["of"], commit.changes.len(), "{revision} is not whole");
            let at = first.config["at"].as_u64().unwrap();
            if at >= self.opened {
                self.tally.delays.push(micros() - at);
            }
        }
        self.cursor = revision;
        self.tally.commits += 1;
    }

    fn take_one(&mut self, commit: &Commit, change: &Change) {
        let (name, revision) = (&change.name, commit.revision);
        assert_eq!(change.kind, "Service", "{revision}");
        if change.op == Op::Delete {
            let last = self.state.remove(name);
            assert_eq!(
                last,
                Some((change.revision, change.config.clone())),
                "{revision} deletes {name}"
            );
            assert_eq!(commit.changes.len(), 1);
            return;
        }
        assert_eq!(change.revision, revision);
        assert_eq!(
            change.config["batch"], commit.changes[0].config["batch"],
            "{revision} is of several writes"
        );
        let before = self.state.insert(name.clone(), (revision, change.config.clone()));
        let op = if before.is_some() { Op::Update } else { Op::Create };
        assert_eq!(change.op, op, "{revision} {name}");
        assert!(
            before.is_none_or(|(before, _)| before < revision),
            "{revision} holds {name} twice"
        );
    }
}

/// Waits until a value holds, or nobody sets it any more.
async fn reaches<T>(receiver: &mut watch::Receiver<T>, holds: impl FnMut(&T) -> bool) {
    let _ = receiver.wait_for(holds).await;
}

/// What a list shows.
pub(crate) fn state_of(items: &[Value]) -> State {
    let one = |item: &Value| {
        let name = item["name"].as_str().unwrap().to_owned();
        (name, (item["revision"].as_u64().unwrap(), item["spec"]["config"].clone()))
    };
    items.iter().map(one).collect()
}

/// The delay that 99 of 100 do not exceed, in microseconds.
pub(crate) fn p99(delays: impl IntoIterator<Item = u64>) -> u64 {
    let mut sorted: Vec<u64> = delays.into_iter().collect();
    sorted.sort_unstable();
    sorted[(sorted.len() * 99).div_ceil(100) - 1]
}
