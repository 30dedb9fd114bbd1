//! The flow's leases on the server: an own copy, what is still to be written, and the task that writes it.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::WriterId;
use bytes::Bytes;
use parking_lot::Mutex;
use redis::Cmd;
use tokio::sync::Notify;

use super::Shared;
use super::publisher::hset_command;
use super::state::Scope;
use crate::port::BrokerError;

/// Leases that are kept at most: a flow has 10,000, and some are on their way out.
pub const MAX_LEASES: usize = 20_000;
/// Leases that wait to be written one by one; beyond that all are written anew.
const MAX_PENDING: usize = 2 * MAX_LEASES;
/// Writers that wait to be forgotten; the oldest give way.
const MAX_FORGOTTEN: usize = 65_536;
/// Commands that are sent together.
const PER_BATCH: usize = 500;
/// After a refusal the server is left alone for this long.
const AFTER_REFUSAL: Duration = Duration::from_secs(1);
/// Until the leases must have been read.
const LOAD: Duration = Duration::from_secs(10);

/// One change of the server's data.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Change {
    /// All leases go; those that live follow.
    Clear,
    Put(String, Bytes),
    Remove(String),
    Forget(Arc<str>, WriterId),
}

/// The leases, and how far the server knows them. Changes of one lease that were not written yet become one.
#[derive(Debug, Default)]
pub(super) struct Ledger {
    kept: HashMap<String, Bytes>,
    pending: VecDeque<String>,
    is_pending: HashSet<String>,
    /// Too much happened while the server was away.
    clear_first: bool,
    forgotten: VecDeque<(Arc<str>, WriterId)>,
    /// Changes that the server has not confirmed.
    under_way: bool,
}

impl Ledger {
    /// Returns false where there are too many.
    fn put(&mut self, key: &str, value: Bytes) -> bool {
        if self.kept.len() >= MAX_LEASES && !self.kept.contains_key(key) {
            return false;
        }
        self.kept.insert(key.to_owned(), value);
        self.note(key);
        true
    }

    fn remove(&mut self, key: &str) {
        self.kept.remove(key);
        self.note(key);
    }

    fn note(&mut self, key: &str) {
        if self.is_pending.insert(key.to_owned()) {
            self.pending.push_back(key.to_owned());
        }
        if self.pending.len() > MAX_PENDING {
            self.clear_first = true;
            self.rewrite_all();
        }
    }

    /// The server may have lost everything.
    pub(super) fn rewrite_all(&mut self) {
        let removed = self.pending.iter().filter(|key| !self.kept.contains_key(*key));
        let mut all: VecDeque<String> = if self.clear_first {
            VecDeque::new()
        } else {
            removed.cloned().collect()
        };
        all.extend(self.kept.keys().cloned());
        self.is_pending = all.iter().cloned().collect();
        self.pending = all;
    }

    fn forget(&mut self, hash: Arc<str>, writer: WriterId) {
        if self.forgotten.len() >= MAX_FORGOTTEN {
            self.forgotten.pop_front();
        }
        self.forgotten.push_back((hash, writer));
    }

    /// The next changes, in order.
    fn take(&mut self, limit: usize) -> Vec<Change> {
        let mut changes = Vec::new();
        if std::mem::take(&mut self.clear_first) {
            changes.push(Change::Clear);
        }
        while changes.len() < limit
            && let Some(key) = self.pending.pop_front()
        {
            self.is_pending.remove(&key);
            changes.push(match self.kept.get(&key) {
                Some(value) => Change::Put(key, value.clone()),
                None => Change::Remove(key),
            });
        }
        while changes.len() < limit
            && let Some((hash, writer)) = self.forgotten.pop_front()
        {
            changes.push(Change::Forget(hash, writer));
        }
        self.under_way = !changes.is_empty();
        changes
    }

    fn is_settled(&self) -> bool {
        !self.under_way && !self.clear_first && self.pending.is_empty() && self.forgotten.is_empty()
    }

    /// Changes that may not have reached the server are to be made first.
    fn put_back(&mut self, changes: Vec<Change>) {
        for change in changes.into_iter().rev() {
            match change {
                Change::Clear => self.clear_first = true,
                Change::Put(key, _) | Change::Remove(key) => {
                    if self.is_pending.insert(key.clone()) {
                        self.pending.push_front(key);
                    }
                }
                Change::Forget(hash, writer) => self.forgotten.push_front((hash, writer)),
            }
        }
    }

    /// Takes over what the server has, where nothing newer is known.
    fn merge(&mut self, loaded: &[(String, Bytes)]) {
        for (key, value) in loaded {
            if self.kept.len() < MAX_LEASES && !self.is_pending.contains(key) {
                self.kept.entry(key.clone()).or_insert_with(|| value.clone());
            }
        }
    }
}

/// The ledger and its writer's bell.
#[derive(Default)]
pub(super) struct Leases {
    pub(super) ledger: Mutex<Ledger>,
    changed: Notify,
    settled: Notify,
}

impl Leases {
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

    pub(super) fn forget(&self, hash: Arc<str>, writer: WriterId) {
        self.ledger.lock().forget(hash, writer);
        self.wake();
    }

    pub(super) fn wake(&self) {
        self.changed.notify_one();
    }
}

/// Writes changes in their order while the scope is ours, until the broker is closed.
pub(super) async fn write(shared: Arc<Shared>, leases: Arc<Leases>) {
    let stop = shared.stop.clone();
    tokio::select! {
        biased;
        () = stop.cancelled() => {}
        () = write_on(&shared, &leases) => {}
    }
}

async fn write_on(shared: &Shared, leases: &Leases) {
    loop {
        // An owner's claim rings, too, so nothing stays unwritten after an outage.
        leases.changed.notified().await;
        while is_owned(shared) {
            let changes = leases.ledger.lock().take(PER_BATCH);
            if changes.is_empty() {
                leases.settled.notify_one();
                break;
            }
            let mut connection = shared.commands().await;
            let pipeline = pipeline(&changes, &shared.settings.names.leases());
            let answers = connection.send_packed_commands(&pipeline, 0, pipeline.len()).await;
            if let Err(why) = judge(answers) {
                leases.ledger.lock().put_back(changes);
                if let Some(why) = why {
                    tracing::warn!(why, "redis refuses leases");
                }
                tokio::time::sleep(AFTER_REFUSAL).await;
            }
        }
    }
}

fn is_owned(shared: &Shared) -> bool {
    shared.state.read(|conditions| *conditions.scope() == Scope::Owned)
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
        Ok(answers) => answers
            .into_iter()
            .find_map(refusal)
            .map_or(Ok(()), |why| Err(Some(why))),
        Err(_) => Err(None),
    }
}

fn pipeline(changes: &[Change], hash: &str) -> redis::Pipeline {
    let mut pipeline = redis::Pipeline::with_capacity(changes.len());
    for change in changes {
        pipeline.add_command(match change {
            Change::Clear => command("DEL", &[hash]),
            Change::Put(key, value) => hset_command(hash, key, &value[..], value.len()),
            Change::Remove(key) => command("HDEL", &[hash, key]),
            Change::Forget(hash, writer) => command("HDEL", &[hash, &writer.to_string()]),
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
pub(super) async fn load(shared: &Shared, leases: &Leases) -> Result<Vec<(String, Bytes)>, BrokerError> {
    if let Some(why) = shared.state.why_not_up() {
        return Err(BrokerError::Away(why));
    }
    let mut connection = shared.commands().await;
    let hash = shared.settings.names.leases();
    let command = command("HGETALL", &[&hash]);
    let answer = tokio::time::timeout(LOAD, command.query_async::<Vec<(Vec<u8>, Vec<u8>)>>(&mut connection)).await;
    let fields = match answer {
        Ok(Ok(fields)) => fields,
        Ok(Err(error)) => return Err(BrokerError::Away(error.to_string())),
        Err(_) => return Err(BrokerError::Away("the leases were not read in time".to_owned())),
    };
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

    fn put(key: &str, text: &'static str) -> Change {
        Change::Put(key.to_owned(), value(text))
    }

    fn remove(key: &str) -> Change {
        Change::Remove(key.to_owned())
    }

    #[test]
    fn changes_are_written_in_order_and_the_last_of_a_lease_counts() {
        let mut ledger = Ledger::default();
        ledger.put("a", value("1"));
        ledger.put("b", value("1"));
        ledger.put("a", value("2"));
        ledger.remove("c");
        ledger.forget(Arc::from("h"), WriterId([1; 16]));
        let forget = Change::Forget(Arc::from("h"), WriterId([1; 16]));
        assert_eq!(ledger.take(2), [put("a", "2"), put("b", "1")]);
        assert_eq!(ledger.take(9), [remove("c"), forget]);
        assert!(ledger.take(9).is_empty());
    }

    #[test]
    fn what_did_not_arrive_is_written_again_unless_it_is_out_of_date() {
        let mut ledger = Ledger::default();
        ledger.put("a", value("1"));
        ledger.put("b", value("1"));
        let lost = ledger.take(9);
        ledger.put("c", value("1"));
        ledger.remove("a");
        ledger.put_back(lost);
        assert_eq!(ledger.take(9), [put("b", "1"), put("c", "1"), remove("a")]);
    }

    #[test]
    fn a_server_that_lost_everything_gets_everything() {
        let mut ledger = Ledger::default();
        ledger.put("a", value("1"));
        ledger.put("b", value("1"));
        ledger.take(9);
        ledger.remove("b");
        ledger.rewrite_all();
        assert_eq!(ledger.take(9), [remove("b"), put("a", "1")]);
    }

    #[test]
    fn loading_overwrites_nothing_that_is_newer() {
        let mut ledger = Ledger::default();
        ledger.put("a", value("new"));
        ledger.remove("b");
        ledger.merge(&["a", "b", "c"].map(|key| (key.to_owned(), value("old"))));
        assert_eq!(ledger.take(9), [put("a", "new"), remove("b")]);
        ledger.rewrite_all();
        let mut all = ledger.take(9);
        all.sort_by_key(|change| format!("{change:?}"));
        assert_eq!(all, [put("a", "new"), put("c", "old")]);
    }

    #[test]
    fn the_ledger_is_bounded() {
        let mut ledger = Ledger::default();
        for number in 0..=MAX_LEASES {
            ledger.put(&format!("key-{number}"), value("x"));
        }
        assert_eq!(ledger.kept.len(), MAX_LEASES);
        for number in 0..MAX_PENDING {
            ledger.remove(&format!("gone-{number}"));
        }
        assert!(ledger.pending.len() <= MAX_PENDING);
        assert_eq!(ledger.take(1), [Change::Clear], "too much to tell: all is written anew");
        for number in 0..=MAX_FORGOTTEN {
            ledger.forget(Arc::from("h"), WriterId([u8::try_from(number % 200).unwrap(); 16]));
        }
        assert_eq!(ledger.forgotten.len(), MAX_FORGOTTEN);
    }
}
