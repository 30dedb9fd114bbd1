//! Who wrote a record that says nothing of it: its place on the server.

use std::collections::HashMap;
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use blaze_domain::WriterId;
use parking_lot::Mutex;
use sha2::{Digest as _, Sha256};

/// Topics whose identities are known at most; above, all are forgotten and learnt again as they are
/// asked for.
const MAX_KNOWN: usize = 65_536;

/// The identity that the server gives a topic when it is made: a topic made anew has another one.
/// In Kafka's own text form, 22 characters of URL-safe base64.
#[derive(Clone, PartialEq, Eq, Hash)]
pub(super) struct TopicUuid(Arc<str>);

impl TopicUuid {
    /// From ordinary base64 of 16 bytes, with or without padding; `None` for anything else and for
    /// the zero identity, which old servers give to all topics.
    pub(super) fn from_base64(text: &str) -> Option<Self> {
        let text = text.trim_end_matches('=').replace('+', "-").replace('/', "_");
        let good = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_');
        let zero = text.chars().all(|c| c == 'A');
        (text.len() == 22 && text.chars().all(good) && !zero).then(|| Self(Arc::from(text)))
    }

    /// The text.
    #[cfg(test)]
    pub(super) fn as_str(&self) -> &str {
        &self.0
    }

    /// The writer of all bare records of a partition.
    pub(super) fn bare_writer(&self, layer: &str, partition: usize) -> WriterId {
        let hash = Sha256::digest(format!("kafka|{layer}|{}|{partition}", self.0));
        let mut id = [0; 16];
        id.copy_from_slice(&hash[..16]);
        WriterId(id)
    }
}

impl fmt::Debug for TopicUuid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// What one client of librdkafka knows of the identities of its topics.
///
/// librdkafka keeps the identity to itself, but for one line of its debug log, `Topic T changed id
/// from A to B`, which it writes whenever it learns one, before it hands out a record read under
/// it. That line comes through the same queue as the records, so what it says holds for those
/// behind it; and it needs no connection beside that of the client.
#[derive(Debug, Default)]
pub(super) struct Identities {
    known: Mutex<HashMap<String, TopicUuid>>,
    changes: AtomicU64,
}

impl Identities {
    /// Looks at one line of the log.
    pub(super) fn read_log(&self, line: &str) {
        let Some((topic, uuid)) = parse_change(line) else {
            return;
        };
        let mut known = self.known.lock();
        if known.len() >= MAX_KNOWN && !known.contains_key(topic) {
            known.clear();
        }
        if known.get(topic) != Some(&uuid) {
            known.insert(topic.to_owned(), uuid);
            self.changes.fetch_add(1, Ordering::Release);
        }
    }

    /// What is known of a topic.
    pub(super) fn of(&self, topic: &str) -> Option<TopicUuid> {
        self.known.lock().get(topic).cloned()
    }

    /// Grows with every change, so that a reader need not look each time.
    pub(super) fn changes(&self) -> u64 {
        self.changes.load(Ordering::Acquire)
    }
}

fn parse_change(line: &str) -> Option<(&str, TopicUuid)> {
    let (before, after) = line.split_once(" changed id from ")?;
    let (_, topic) = before.rsplit_once("Topic ")?;
    let (_, uuid) = after.split_once(" to ")?;
    Some((topic, TopicUuid::from_base64(uuid.trim())?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identities_come_from_the_log() {
        let identities = Identities::default();
        identities.read_log(
            "[thrd:main]: Topic fog.imu.data changed id from AAAAAAAAAAAAAAAAAAAAAA to \
             a+b/cdefghijklmnopqrst",
        );
        let uuid = identities.of("fog.imu.data").unwrap();
        assert_eq!(uuid.as_str(), "a-b_cdefghijklmnopqrst");
        assert_eq!(identities.changes(), 1);
        identities.read_log(
            "[thrd:main]: Topic fog.imu.data changed id from AAAA to a+b/cdefghijklmnopqrst",
        );
        assert_eq!(identities.changes(), 1, "the same again is no change");
        for line in [
            "Topic t changed id from x to AAAAAAAAAAAAAAAAAAAAAA",
            "Topic t changed id from x to short",
            "Topic t changed id from x to ",
            "changed id from  to ",
            "",
        ] {
            identities.read_log(line);
            assert_eq!(identities.of("t"), None, "{line}");
        }
    }

    #[test]
    fn the_bare_writer_is_as_the_contract_says() {
        let uuid = TopicUuid::from_base64("ABCDEFGHIJKLMNOPQRSTUV==").unwrap();
        let expected = Sha256::digest("kafka|fog|ABCDEFGHIJKLMNOPQRSTUV|3");
        assert_eq!(uuid.bare_writer("fog", 3).0[..], expected[..16]);
        assert_ne!(uuid.bare_writer("fog", 3), uuid.bare_writer("fog", 2));
    }
}
