//! Write-behind queue to Redis: the flow's leases, and deletions of retained messages of removed
//! writers.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::WriterId;
use bytes::Bytes;
use parking_lot::Mutex;
use redis::Cmd;
use tokio::sync::Notify;

use super::publisher::hset_command;
use super::state::ScopeOwnership;
use super::{Shared, server};
use crate::pending::Pending;
use crate::port::BrokerError;

/// Leases that are kept at most: a flow has 10,000, and some are on their way out.
const MAX_LEASES: usize = 20_000;
/// Deletions of retained messages that wait at most; the oldest give way.
const MAX_DELETIONS: usize = 65_536;
/// Commands that are sent together.
const PER_BATCH: usize = 500;
/// After a refusal the server is left alone for this long.
const AFTER_REFUSAL: Duration = Duration::from_secs(1);
/// Until the leases must have been read.
const LOAD: Duration = Duration::from_secs(10);

/// A field of a hash, and what it is to hold; `None`: there is no such field.
type Change = ((Arc<str>, String), Option<Bytes>);

/// The leases, what the server does not know of them, and retained messages that are to be deleted.
#[derive(Debug)]
pub(super) struct Ledger {
    /// Name of their hash.
    hash: Arc<str>,
    kept: HashMap<String, Bytes>,
    pending: Pending<(Arc<str>, String), Option<Bytes>>,
    /// The hash is deleted before the leases are written, see `replace_all`.
    clear_first: bool,
    /// Fields of removed writers, in the hashes of retained messages.
    deletions: VecDeque<(Arc<str>, String)>,
    /// The last batch is not settled.
    under_way: bool,
}

/// Changes that are sent together.
#[derive(Debug, Default)]
struct Batch {
    /// The hash of the leases goes first.
    clears: bool,
    changes: Vec<Change>,
}

impl Ledger {
    fn new(hash: Arc<str>) -> Self {
        Self {
            hash,
            kept: HashMap::new(),
            pending: Pending::default(),
            clear_first: false,
            deletions: VecDeque::new(),
            under_way: false,
        }
    }

    /// Returns false where there are too many.
    fn put(&mut self, key: &str, value: Bytes) -> bool {
        if self.kept.len() >= MAX_LEASES && !self.kept.contains_key(key) {
            return false;
        }
        self.kept.insert(key.to_owned(), value.clone());
        self.note(key, Some(value));
        true
    }

    fn remove(&mut self, key: &str) {
        self.kept.remove(key);
        self.note(key, None);
    }

    fn note(&mut self, key: &str, value: Option<Bytes>) {
        if !self.pending.put(self.field(key), value) {
            self.replace_all();
        }
    }

    /// The queue of changes is full: delete the hash and write all current leases. They fit:
    /// `MAX_LEASES` < `MAX_PENDING`, so this does not recurse.
    fn replace_all(&mut self) {
        self.clear_first = true;
        self.pending.clear();
        self.rewrite_all();
    }

    fn delete_retained(&mut self, hash: Arc<str>, writer: WriterId) {
        if self.deletions.len() >= MAX_DELETIONS {
            self.deletions.pop_front();
        }
        self.deletions.push_back((hash, writer.to_string()));
    }

    /// The next changes; those of the call before are settled: written, or put back.
    fn take(&mut self) -> Option<Batch> {
        let mut changes = self.pending.take(PER_BATCH, |_| true);
        let room = (PER_BATCH - changes.len()).min(self.deletions.len());
        changes.extend(self.deletions.drain(..room).map(|field| (field, None)));
        let clears = std::mem::take(&mut self.clear_first);
        self.under_way = clears || !changes.is_empty();
        self.under_way.then_some(Batch { clears, changes })
    }

    /// Changes that may not have arrived wait again.
    fn put_back(&mut self, batch: Batch) {
        let is_lease = |((hash, _), _): &Change| *hash == self.hash;
        let (leases, deletions): (Vec<_>, Vec<_>) = batch.changes.into_iter().partition(is_lease);
        for (field, _) in deletions.into_iter().rev() {
            self.deletions.push_front(field);
        }
        // Otherwise all current leases were queued meanwhile.
        if !self.clear_first {
            self.pending.put_back(leases);
        }
        self.clear_first |= batch.clears;
    }

    fn is_settled(&self) -> bool {
        !self.under_way
            && !self.clear_first
            && self.pending.is_settled()
            && self.deletions.is_empty()
    }

    fn field(&self, key: &str) -> (Arc<str>, String) {
        (Arc::clone(&self.hash), key.to_owned())
    }

    /// Writes all current leases again: the server may have lost them.
    pub(super) fn rewrite_all(&mut self) {
        let (hash, pending) = (&self.hash, &mut self.pending);
        let mut all = self.kept.iter();
        if !all
            .all(|(key, value)| pending.put((Arc::clone(hash), key.clone()), Some(value.clone())))
        {
            self.replace_all();
        }
    }

    /// Takes over what the server has, where nothing newer is known.
    fn merge(&mut self, loaded: &[(String, Bytes)]) {
        for (key, value) in loaded {
            if self.kept.len() < MAX_LEASES && !self.pending.contains(&self.field(key)) {
                self.kept.entry(key.clone()).or_insert_with(|| value.clone());
            }
        }
    }
}

/// The ledger and its writer's wake-ups.
pub(super) struct Leases {
    pub(super) ledger: Mutex<Ledger>,
    changed: Notify,
    settled: Notify,
}

impl Leases {
    pub(super) fn new(hash: Arc<str>) -> Self {
        Self {
            ledger: Mutex::new(Ledger::new(hash)),
            changed: Notify::new(),
            settled: Notify::new(),
        }
    }

    pub(super) fn put(&self, key: &str, value: Bytes) {
        let taken = self.ledger.lock().put(key, value);
        if !taken {
            tracing::warn!(
                key,
                limit = MAX_LEASES,
                "too many leases: this one does not survive a restart"
            );
        }
        self.wake();
    }

    pub(super) fn remove(&self, key: &str) {
        self.ledger.lock().remove(key);
        self.wake();
    }

    /// Deletes the retained message of a removed writer.
    pub(super) fn delete_retained(&self, hash: Arc<str>, writer: WriterId) {
        self.ledger.lock().delete_retained(hash, writer);
        self.wake();
    }

    pub(super) fn wake(&self) {
        self.changed.notify_one();
    }

    /// Name of their hash.
    pub(super) fn hash(&self) -> Arc<str> {
        Arc::clone(&self.ledger.lock().hash)
    }

    /// How many the server is to have.
    pub(super) fn count(&self) -> usize {
        self.ledger.lock().kept.len()
    }

    /// Writes all again: the server has lost them.
    pub(super) fn rewrite_all(&self) {
        self.ledger.lock().rewrite_all();
        self.wake();
    }
}

/// Writes changes, of each field the last, while the scope is ours, until the broker is closed.
pub(super) async fn write(shared: Arc<Shared>, leases: Arc<Leases>) {
    shared.stop.run_until_cancelled(write_on(&shared, &leases)).await;
}

async fn write_on(shared: &Shared, leases: &Leases) {
    loop {
        // An owner's claim rings, too, so nothing stays unwritten after an outage.
        leases.changed.notified().await;
        while is_owned(shared) {
            let Some(batch) = leases.ledger.lock().take() else {
                leases.settled.notify_one();
                break;
            };
            let mut connection = shared.commands().await;
            let pipeline = pipeline(&batch, &shared.settings.names.leases());
            let answers = connection.send_packed_commands(&pipeline, 0, pipeline.len()).await;
            if let Err(why) = judge(answers) {
                leases.ledger.lock().put_back(batch);
                if let Some(why) = why {
                    tracing::warn!(why, "redis refuses leases");
                }
                tokio::time::sleep(AFTER_REFUSAL).await;
            }
        }
    }
}

pub(super) fn is_owned(shared: &Shared) -> bool {
    shared.state.read(|conditions| *conditions.scope() == ScopeOwnership::Owned)
}

/// Waits until the server has all changes, if it takes any.
pub(super) async fn drained(shared: &Shared, leases: &Leases, most: Duration) {
    let settled = async {
        while is_owned(shared) && !leases.ledger.lock().is_settled() {
            leases.settled.notified().await;
        }
    };
    let _ = tokio::time::timeout(most, settled).await;
}

/// Whether all was written; if the server refused, its words.
fn judge(answers: redis::RedisResult<Vec<redis::Value>>) -> Result<(), Option<String>> {
    let refusal = |answer| match answer {
        redis::Value::ServerError(error) => Some(error.to_string()),
        _ => None,
    };
    match answers {
        Ok(answers) => answers.into_iter().find_map(refusal).map_or(Ok(()), |why| Err(Some(why))),
        Err(_) => Err(None),
    }
}

fn pipeline(batch: &Batch, leases: &str) -> redis::Pipeline {
    let mut pipeline = redis::Pipeline::with_capacity(batch.changes.len() + 1);
    if batch.clears {
        pipeline.add_command(command("DEL", &[leases]));
    }
    for ((hash, field), value) in &batch.changes {
        pipeline.add_command(match value {
            Some(value) => hset_command(hash, field, &value[..], value.len()),
            None => command("HDEL", &[hash, field]),
        });
    }
    pipeline
}

fn command(name: &str, arguments: &[&str]) -> Cmd {
    let mut command = redis::cmd(name);
    command.arg(arguments);
    command
}

/// Reads all leases that the server has.
pub(super) async fn load(
    shared: &Shared,
    leases: &Leases,
) -> Result<Vec<(String, Bytes)>, BrokerError> {
    if let Some(why) = shared.state.why_not_up() {
        return Err(BrokerError::Away(why));
    }
    let mut connection = shared.commands().await;
    let hash = shared.settings.names.leases();
    let fields = server::fields(&mut connection, (&hash, "the leases"), LOAD).await?;
    let mut loaded: Vec<(String, Bytes)> = fields
        .into_iter()
        .filter_map(|(key, value)| Some((String::from_utf8(key).ok()?, Bytes::from(value))))
        .collect();
    if loaded.len() > MAX_LEASES {
        tracing::warn!(
            found = loaded.len(),
            limit = MAX_LEASES,
            "too many leases on the server: some are left out"
        );
        loaded.truncate(MAX_LEASES);
    }
    leases.ledger.lock().merge(&loaded);
    Ok(loaded)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(text: &'static str) -> Bytes {
        Bytes::from_static(text.as_bytes())
    }

    fn take(ledger: &mut Ledger) -> Vec<(String, Option<Bytes>)> {
        let taken = ledger.take().unwrap_or_default().changes;
        let mut all: Vec<_> = taken.into_iter().map(|((_, key), value)| (key, value)).collect();
        all.sort();
        all
    }

    fn changes(changes: &[(&str, Option<&'static str>)]) -> Vec<(String, Option<Bytes>)> {
        changes.iter().map(|(key, text)| ((*key).to_owned(), text.map(value))).collect()
    }

    #[test]
    fn a_server_that_lost_everything_gets_everything() {
        let mut ledger = Ledger::new(Arc::from("h"));
        ledger.put("a", value("1"));
        ledger.put("b", value("1"));
        take(&mut ledger);
        ledger.remove("b");
        ledger.rewrite_all();
        assert_eq!(take(&mut ledger), changes(&[("a", Some("1")), ("b", None)]));
    }

    #[test]
    fn loading_overwrites_nothing_that_is_newer() {
        let mut ledger = Ledger::new(Arc::from("h"));
        ledger.put("a", value("new"));
        ledger.remove("b");
        ledger.merge(&["a", "b", "c"].map(|key| (key.to_owned(), value("old"))));
        assert_eq!(take(&mut ledger), changes(&[("a", Some("new")), ("b", None)]));
        ledger.rewrite_all();
        assert_eq!(take(&mut ledger), changes(&[("a", Some("new")), ("c", Some("old"))]));
        for number in 0..=MAX_LEASES {
            ledger.put(&format!("key-{number}"), value("x"));
        }
        assert_eq!(ledger.kept.len(), MAX_LEASES);
    }

    #[test]
    fn of_changes_that_are_too_many_the_outcome_is_written() {
        let mut ledger = Ledger::new(Arc::from("h"));
        for key in ["a", "b"] {
            ledger.put(key, value("1"));
        }
        let under_way = ledger.take().unwrap();
        ledger.remove("a");
        for number in 0.. {
            ledger.remove(&format!("gone-{number}"));
            if ledger.clear_first {
                break;
            }
        }
        ledger.put_back(under_way);
        let batch = ledger.take().unwrap();
        assert!(batch.clears && !ledger.is_settled());
        assert_eq!(batch.changes, [(ledger.field("b"), Some(value("1")))]);
        ledger.put_back(batch);
        let batch = ledger.take().unwrap();
        assert!(batch.clears, "it may not have arrived");
        assert_eq!(batch.changes.len(), 1);
        assert!(ledger.take().is_none() && ledger.is_settled());
        for number in 0..=MAX_DELETIONS {
            ledger.delete_retained(
                Arc::from("other"),
                WriterId([u8::try_from(number % 200).unwrap(); 16]),
            );
        }
        assert_eq!(ledger.deletions.len(), MAX_DELETIONS);
        let batch = ledger.take().unwrap();
        assert!(!batch.clears && batch.changes.len() == PER_BATCH);
        ledger.put_back(batch);
        assert_eq!(ledger.deletions.len(), MAX_DELETIONS, "what was refused waits again");
    }
}
