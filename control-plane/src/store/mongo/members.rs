//! Which processes use the store, so that one that is alone may answer reads from its own memory.
//!
//! ```text
//! every 250 ms: read the table ─▶ count up my own member, leave out who has been silent for 120 s ─▶ write it, if it is
//!                                                                                  still the one that was read (`turn`)
//! others in the table: every read asks the database
//! nobody else:         reads are answered from memory for 800 ms from before the exchange
//! nobody has read for a while:                     an exchange every 10 s, a look every 500 ms; the next read asks the database
//! just come, or back after being left out: 1.1 s without reads and writes, for somebody may still read from memory
//! ```
//!
//! Why this holds, in the words of a client: what another process had acknowledged is never missing
//! from a read that begins later. A process reads and writes only 1.1 s after it stands in the
//! table; by then whoever was alone has seen it there, or could not look for 800 ms. Who is left
//! out was silent for 120 s, and had counted itself out after 60 s: a commit of it that is found in
//! the log all the same was answered with "unknown", and counts from when it is found.
//!
//! Times are those that a process measures by itself, as in [`super::fence`]: no two clocks are
//! compared.

use std::collections::BTreeMap;
use std::future::IntoFuture as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use mongodb::bson::{Document, doc};
use tokio::sync::{Notify, watch};
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout};
use tokio_util::sync::CancellationToken;

use super::client::{Connection, QUICK, limited};
use super::errors::{is_duplicate, store_error};
use super::fence::since_boot;
use super::{read, rows};
use crate::store::StoreError;
use crate::store::encode::corrupt;

/// Between two exchanges, while there are reads.
const BEAT: Duration = Duration::from_millis(250);
/// The same after [`IDLE_BEATS`] of them without reads: each one is a write to the disks of the
/// database.
const IDLE_BEAT: Duration = Duration::from_secs(10);
const IDLE_BEATS: u32 = 40;
/// Between two looks at the table meanwhile: whoever comes is seen before it writes.
const LOOK: Duration = Duration::from_millis(500);
/// How long a process that is alone may answer from memory, from before the exchange on.
const LEASE: Duration = Duration::from_millis(800);
/// How long one that has come waits for the leases of others to end.
const WAIT: Duration = Duration::from_millis(1_100);
/// How long a member stays one without an exchange, by its own clock.
const VALID: Duration = Duration::from_secs(60);
/// How long a member that is silent stays in the table, by the clock of whoever looks.
const SILENT: Duration = Duration::from_secs(120);
/// Tries of one exchange.
const TRIES: usize = 8;
/// Members of the table, at most.
const MOST: usize = 1_000;
/// `_id` of the table.
const TABLE: &str = "members";

/// Where this process stands.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Standing {
    /// How often it has come.
    joined: u64,
    /// When the last exchange began that left it in the table.
    beat: Option<Duration>,
    /// From when on it may read and write.
    from: Duration,
    /// It is alone, and others wrote nothing above this revision.
    alone: Option<u64>,
}

/// What a process may do at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum May {
    /// Read and write.
    Work,
    /// Nothing for so long.
    After(Duration),
    /// Nothing until it is in the table again.
    Not,
}

impl Standing {
    fn may(&self, now: Option<Duration>) -> May {
        let (Some(now), Some(beat)) = (now, self.beat) else {
            return May::Not;
        };
        match now.checked_sub(beat) {
            Some(age) if age > VALID => May::Not,
            // A clock that went back proves nothing.
            None => May::Not,
            Some(_) => match self.from.checked_sub(now) {
                None | Some(Duration::ZERO) => May::Work,
                Some(left) => May::After(left),
            },
        }
    }

    /// Whether one that is in the table at an exchange has been there since its last one. After
    /// long it may have been left out and be in it again, by an exchange of which it heard nothing.
    fn has_stayed(&self, asked: Option<Duration>) -> bool {
        let age = asked.zip(self.beat).and_then(|(asked, beat)| asked.checked_sub(beat));
        age.is_some_and(|age| age <= VALID)
    }

    /// The revision above which nobody else has written anything, while that is certain.
    fn alone(&self, now: Option<Duration>) -> Option<u64> {
        let age = now?.checked_sub(self.beat?)?;
        self.alone.filter(|_| age < LEASE && self.may(now) == May::Work)
    }
}

/// The members, as the database has them.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct Table {
    /// Counts every change.
    turn: i64,
    /// How often each has counted up.
    beats: BTreeMap<String, i64>,
}

impl Table {
    fn read(found: &Document) -> Result<Self, StoreError> {
        let mut beats = BTreeMap::new();
        for member in rows::members(found, "members") {
            let member = member?;
            beats.insert(rows::text(member, "id")?, rows::integer(member, "beat")?);
        }
        Ok(Self { turn: rows::integer(found, "turn")?, beats })
    }

    fn write(&self) -> Document {
        let members = self.beats.iter().map(|(id, beat)| doc! { "id": id, "beat": beat });
        doc! { "_id": TABLE, "turn": self.turn, "members": members.collect::<Vec<_>>() }
    }

    /// The next one, in which a member has counted up and others are left out.
    fn next(&self, me: &str, silent: &[String]) -> Self {
        let mut next = self.clone();
        next.turn += 1;
        next.beats.retain(|id, _| !silent.contains(id));
        *next.beats.entry(me.to_owned()).or_default() += 1;
        next
    }

    fn has_others_than(&self, me: &str) -> bool {
        self.beats.keys().any(|id| id != me)
    }
}

/// How long others have been silent.
#[derive(Debug, Default)]
struct Heard(BTreeMap<String, (i64, Duration)>);

impl Heard {
    /// Notes a table; gives those that have not counted up for [`SILENT`].
    fn silent(&mut self, table: &Table, me: &str, now: Duration) -> Vec<String> {
        self.0.retain(|id, _| table.beats.contains_key(id));
        let mut silent = Vec::new();
        for (id, beat) in table.beats.iter().filter(|(id, _)| *id != me) {
            let (known, since) = self.0.entry(id.clone()).or_insert((*beat, now));
            if known != beat {
                (*known, *since) = (*beat, now);
            }
            if now.saturating_sub(*since) >= SILENT {
                silent.push(id.clone());
            }
        }
        silent
    }
}

/// This process among the members.
pub(super) struct Members {
    standing: watch::Receiver<Standing>,
    /// Ends with this.
    beating: tokio::sync::Mutex<JoinSet<Beating>>,
    leave: CancellationToken,
    reads: Arc<Reads>,
}

/// Whether anybody reads.
#[derive(Default)]
struct Reads {
    /// Exchanges since the last one.
    idle: AtomicU32,
    began: Notify,
}

impl Reads {
    fn note(&self) {
        // Most find that there was one just now, and write nothing that other threads have to hear
        // of.
        if self.idle.load(Ordering::Relaxed) > 0
            && self.idle.swap(0, Ordering::Relaxed) >= IDLE_BEATS
        {
            self.began.notify_one();
        }
    }

    /// Whether there was none for long. To be asked once for each exchange.
    fn are_idle(&self) -> bool {
        self.idle.fetch_add(1, Ordering::Relaxed) >= IDLE_BEATS
    }
}

impl Members {
    /// Enters the table, and stays in it until [`Members::leave`] or the end of the process.
    ///
    /// # Errors
    /// [`StoreError`].
    pub(super) async fn join(connection: &Arc<Connection>, id: &str) -> Result<Self, StoreError> {
        let (sender, standing) = watch::channel(Standing::default());
        let reads = Arc::new(Reads::default());
        let mut beating = Beating {
            reads: Arc::clone(&reads),
            connection: Arc::clone(connection),
            me: id.to_owned(),
            heard: Heard::default(),
            last: None,
            standing: sender,
        };
        beating.beat().await?;
        let leave = CancellationToken::new();
        let mut tasks = JoinSet::new();
        tasks.spawn(beating.run(leave.clone()));
        Ok(Self { standing, beating: tokio::sync::Mutex::new(tasks), leave, reads })
    }

    /// The revision above which nobody else has written anything; none if others may have.
    pub(super) fn alone(&self) -> Option<u64> {
        self.reads.note();
        self.standing.borrow().alone(since_boot())
    }

    /// Whether no other process was there at the last exchange, however long ago that is: half a
    /// second where all is well.
    pub(super) fn is_alone(&self) -> bool {
        self.standing.borrow().alone.is_some()
    }

    /// Waits until this process may read and write. Which time in the table it is, for
    /// [`Members::is_still`].
    ///
    /// # Errors
    /// [`StoreError::Unavailable`] if it may not within two seconds.
    pub(super) async fn admitted(&self) -> Result<u64, StoreError> {
        let standing = *self.standing.borrow();
        if standing.may(since_boot()) == May::Work {
            return Ok(standing.joined);
        }
        timeout(QUICK, self.wait()).await.unwrap_or_else(|_| Err(left_out()))
    }

    async fn wait(&self) -> Result<u64, StoreError> {
        let mut changes = self.standing.clone();
        loop {
            let standing = *changes.borrow_and_update();
            match standing.may(since_boot()) {
                May::Work => return Ok(standing.joined),
                May::After(left) => tokio::time::sleep(left).await,
                May::Not => changes.changed().await.map_err(|_| left_out())?,
            }
        }
    }

    /// Whether it has been a member all the time since [`Members::admitted`] gave this.
    pub(super) fn is_still(&self, joined: u64) -> bool {
        let standing = *self.standing.borrow();
        standing.joined == joined && standing.may(since_boot()) == May::Work
    }

    /// Leaves the table. Nothing can be read or written afterwards.
    pub(super) async fn leave(&self) {
        self.leave.cancel();
        let mut tasks = self.beating.lock().await;
        if let Some(Ok(mut beating)) = tasks.join_next().await {
            beating.leave().await;
        }
    }
}

fn left_out() -> StoreError {
    let text = "MongoDB: this process could not enter itself among those that use the database, \
        see the collection `meta`";
    StoreError::Unavailable(text.to_owned())
}

/// The task that exchanges.
struct Beating {
    reads: Arc<Reads>,
    connection: Arc<Connection>,
    me: String,
    heard: Heard,
    /// What was written last, as long as nobody else is known to have written.
    last: Option<Table>,
    standing: watch::Sender<Standing>,
}

impl Beating {
    async fn run(mut self, leave: CancellationToken) -> Self {
        loop {
            tokio::select! {
                () = leave.cancelled() => return self,
                () = self.next_time() => {}
            }
            if let Err(error) = self.beat().await {
                tracing::debug!(%error, "no exchange with the other processes");
            }
        }
    }

    /// Waits for the time of the next exchange: when nobody reads, until somebody does, or another
    /// process comes.
    async fn next_time(&self) {
        if !self.reads.are_idle() {
            return tokio::time::sleep(BEAT).await;
        }
        let until = Instant::now() + IDLE_BEAT;
        while Instant::now() < until {
            let has_begun = timeout(LOOK, self.reads.began.notified()).await.is_ok();
            let is_mine =
                |table: Table| self.last.as_ref().is_some_and(|last| last.turn == table.turn);
            if has_begun || !self.read().await.is_ok_and(is_mine) {
                return;
            }
        }
    }

    /// One exchange.
    async fn beat(&mut self) -> Result<(), StoreError> {
        for _ in 0..TRIES {
            let asked = since_boot();
            let is_mine = self.last.is_some();
            let table = match self.last.take() {
                Some(table) => table,
                None => self.read().await?,
            };
            let silent =
                asked.map_or_else(Vec::new, |now| self.heard.silent(&table, &self.me, now));
            let next = table.next(&self.me, &silent);
            if next.beats.len() > MOST {
                let text = format!("MongoDB: {MOST} processes use this database already");
                return Err(StoreError::Unavailable(text));
            }
            if !self.write(&table, &next).await? {
                continue;
            }
            let before = *self.standing.borrow();
            let stayed = table.beats.contains_key(&self.me) && before.has_stayed(asked);
            let has_others = next.has_others_than(&self.me);
            let mut standing = Standing { beat: asked, ..before };
            if !stayed {
                standing.joined += 1;
                standing.alone = None;
                // Whoever is left out by this could not read from memory for long.
                let rest = if has_others { WAIT } else { Duration::ZERO };
                standing.from = since_boot().unwrap_or(Duration::MAX).saturating_add(rest);
            }
            standing.alone = match standing.alone {
                _ if has_others => None,
                Some(above) if is_mine && stayed => Some(above),
                // Nobody else can write from now on, so this is all.
                _ => Some(read::newest(&self.connection.tables()).await?),
            };
            self.last = Some(next);
            self.standing.send_replace(standing);
            return Ok(());
        }
        Err(StoreError::Unavailable(
            "MongoDB: other processes were always first at the table of members".to_owned(),
        ))
    }

    async fn read(&self) -> Result<Table, StoreError> {
        let found =
            limited(QUICK, self.connection.tables().meta.find_one(doc! { "_id": TABLE })).await?;
        found.as_ref().map_or_else(|| Ok(Table::default()), Table::read)
    }

    /// Whether it was still the old one that was replaced.
    async fn write(&self, old: &Table, new: &Table) -> Result<bool, StoreError> {
        if old.turn == 0 {
            let insert =
                timeout(QUICK, self.connection.tables().meta.insert_one(new.write()).into_future())
                    .await;
            return match insert {
                Ok(Ok(_)) => Ok(true),
                Ok(Err(error)) if is_duplicate(&error) => Ok(false),
                Ok(Err(error)) => Err(store_error(error)),
                Err(_) => Err(left_out()),
            };
        }
        let which = doc! { "_id": TABLE, "turn": old.turn };
        let done =
            limited(QUICK, self.connection.tables().meta.replace_one(which, new.write())).await?;
        match done.matched_count {
            0 => Ok(false),
            1 => Ok(true),
            count => Err(corrupt(format_args!("{count} tables of members"))),
        }
    }

    /// Takes itself out of the table. If that fails, others do it later.
    async fn leave(&mut self) {
        self.standing.send_modify(|standing| {
            standing.beat = None;
            standing.alone = None;
        });
        for _ in 0..TRIES {
            let Ok(table) = self.read().await else { return };
            let mut next = table.clone();
            next.turn += 1;
            if next.beats.remove(&self.me).is_none() {
                return;
            }
            match self.write(&table, &next).await {
                Ok(false) => {}
                Ok(true) | Err(_) => return,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(milliseconds: u64) -> Duration {
        Duration::from_millis(milliseconds)
    }

    #[test]
    fn one_that_is_alone_reads_from_memory_for_a_while() {
        let standing =
            Standing { joined: 1, beat: Some(at(10_000)), from: at(10_010), alone: Some(7) };
        for (now, may, alone) in [
            (9_999, May::Not, None),
            (10_000, May::After(at(10)), None),
            (10_010, May::Work, Some(7)),
            (10_799, May::Work, Some(7)),
            (10_800, May::Work, None),
            (70_000, May::Work, None),
            (70_001, May::Not, None),
        ] {
            assert_eq!(standing.may(Some(at(now))), may, "{now}");
            assert_eq!(standing.alone(Some(at(now))), alone, "{now}");
        }
        assert_eq!(standing.may(None), May::Not);
        assert_eq!(standing.alone(None), None);
        assert_eq!(Standing::default().may(Some(at(1))), May::Not);
        let others = Standing { alone: None, ..standing };
        assert_eq!(others.alone(Some(at(10_020))), None);
    }

    #[test]
    fn one_that_heard_nothing_for_long_comes_anew() {
        let standing = Standing { beat: Some(at(10_000)), ..Standing::default() };
        for (asked, stayed) in [
            (Some(10_000), true),
            (Some(70_000), true),
            (Some(70_001), false),
            (Some(9_999), false),
            (None, false),
        ] {
            assert_eq!(standing.has_stayed(asked.map(at)), stayed, "{asked:?}");
        }
        assert!(!Standing::default().has_stayed(Some(at(1))));
    }

    #[test]
    fn leases_end_before_anybody_else_begins() {
        // Also where one clock is a third faster than the other.
        assert!(LEASE * 4 / 3 <= WAIT);
        assert!(VALID * 2 <= SILENT);
        assert!(BEAT * 3 <= LEASE);
        assert!(LOOK * 2 < WAIT);
    }

    #[test]
    fn a_member_that_is_silent_is_left_out_by_the_clock_of_whoever_looks() {
        let mut heard = Heard::default();
        let mut table = Table::default().next("a", &[]).next("b", &[]);
        assert!(table.has_others_than("a") && table.has_others_than("c"));
        assert_eq!(heard.silent(&table, "a", at(5_000)), [""; 0]);
        assert_eq!(heard.silent(&table, "a", at(124_999)), [""; 0]);
        assert_eq!(heard.silent(&table, "a", at(125_000)), ["b"]);
        // One sign of life, and it begins anew.
        table = table.next("b", &[]);
        assert_eq!(heard.silent(&table, "a", at(125_000)), [""; 0]);
        assert_eq!(heard.silent(&table, "a", at(245_000)), ["b"]);
        let next = table.next("a", &["b".to_owned()]);
        assert!(!next.has_others_than("a"));
        assert_eq!((next.turn, next.beats["a"]), (4, 2));
        assert_eq!(heard.silent(&next, "a", at(300_000)), [""; 0]);
        assert!(heard.0.is_empty(), "whoever left is forgotten");
    }

    #[test]
    fn a_table_is_read_as_it_was_written() {
        let table = Table::default().next("a", &[]).next("b", &[]).next("a", &[]);
        assert_eq!(Table::read(&table.write()).unwrap(), table);
        assert!(Table::read(&doc! { "members": [] }).is_err());
    }
}
