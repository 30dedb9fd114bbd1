//! Makes the topics that are to be there, and makes them again when they vanish: those that this program itself needs, and
//! those that were prepared for others.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_domain::names::ChannelName;
use parking_lot::Mutex;
use rdkafka::error::RDKafkaErrorCode;

use super::admin::Purpose;
use super::directory::Listing;
use super::inner::Inner;
use super::names::collide;
use super::topics::Topic;
use crate::port::BrokerError;

/// What the server refused to make is asked for again after this.
const TRY_AGAIN: Duration = Duration::from_secs(10);
/// The same where it could not make it just then.
const TRY_SOON: Duration = Duration::from_secs(1);
/// Topics that are asked for in one request: the server makes one after the other, and has a second and a half for all.
const AT_ONCE: usize = 100;

/// Whether a server that refuses to make a topic would refuse it again, for what it is or for who asks. All else passes: too few
/// brokers for as many replicas as it gives, a controller that changes, no answer in time.
pub(super) fn is_final(code: RDKafkaErrorCode) -> bool {
    matches!(
        code,
        RDKafkaErrorCode::InvalidTopic
            | RDKafkaErrorCode::TopicAuthorizationFailed
            | RDKafkaErrorCode::ClusterAuthorizationFailed
            | RDKafkaErrorCode::PolicyViolation
    )
}

/// Whether what the server refused so long ago is to be asked for again.
fn is_due(code: RDKafkaErrorCode, ago: Duration) -> bool {
    match code {
        // An impossible name stays one; what the server did not want may come to be wanted.
        RDKafkaErrorCode::InvalidTopic => false,
        code if is_final(code) => ago >= TRY_AGAIN,
        _ => ago >= TRY_SOON,
    }
}

/// What a round has made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Made {
    /// Topics that this program itself needs: until they are listed there is nothing else to do.
    Needed,
    /// Topics of services, for the first time.
    Topics,
    /// Nothing, or what was asked for in the round before.
    Nothing,
}

/// A topic that is to be there.
pub(super) struct Prepared {
    channel: ChannelName,
    pub(super) topic: Arc<Topic>,
    purpose: Purpose,
    /// What it keeps of each writer, where that is what it keeps.
    pub(super) depth: u32,
    /// Whether it is known to keep what it shall.
    keeps: bool,
}

/// All topics that are to be there.
pub(super) struct Maker {
    needed: Vec<(Arc<str>, Purpose)>,
    prepared: Mutex<BTreeMap<Arc<str>, Prepared>>,
    /// Names of the server's topics, as they were last listed.
    listed: Mutex<HashSet<Arc<str>>>,
    /// Topics that could not be made, told once.
    refused: Mutex<HashMap<Arc<str>, (RDKafkaErrorCode, Instant)>>,
    /// Channels whose name somebody else's topic has, to be told.
    collisions: Mutex<Vec<(ChannelName, String)>>,
    /// What was asked to be made in the last round.
    asked: Mutex<HashSet<Arc<str>>>,
}

impl Maker {
    /// `needed`: what this program itself cannot do without.
    pub(super) fn new(needed: Vec<(Arc<str>, Purpose)>) -> Self {
        Self {
            needed,
            prepared: Mutex::default(),
            listed: Mutex::default(),
            refused: Mutex::default(),
            collisions: Mutex::default(),
            asked: Mutex::default(),
        }
    }

    /// Makes what is missing, and gives it. Fails where what this program itself needs could not be made; a topic of a service
    /// that cannot be made holds up nobody else, and is tried again after a while.
    pub(super) fn make(&self, inner: &Inner, listing: &Listing) -> Result<(Made, HashSet<Arc<str>>), String> {
        let there: HashSet<Arc<str>> = listing
            .topics
            .iter()
            .map(|(name, _)| Arc::from(name.as_str()))
            .collect();
        self.refuse_collisions(&there);
        let missing = self.missing(&there);
        *self.listed.lock() = there;
        let needs = missing.iter().any(|(name, _)| self.is_needed(name));
        if !missing.is_empty() {
            match inner.admin()?.make(&missing) {
                Ok(refused) => self.note_refused(&missing, &refused)?,
                Err(error) if needs => return Err(error.to_string()),
                Err(error) => tracing::warn!(%error, topics = missing.len(), "topics could not be made, trying on"),
            }
        }
        let asked: HashSet<Arc<str>> = missing.into_iter().map(|(name, _)| name).collect();
        let before = std::mem::replace(&mut *self.asked.lock(), asked.clone());
        let made = match (needs, asked.is_subset(&before)) {
            (true, _) => Made::Needed,
            (false, true) => Made::Nothing,
            (false, false) => Made::Topics,
        };
        if made != Made::Needed {
            self.keep_last_values(inner);
        }
        Ok((made, asked))
    }

    /// What was prepared before its name was known to be taken is no longer made.
    fn refuse_collisions(&self, there: &HashSet<Arc<str>>) {
        let mut prepared = self.prepared.lock();
        let mut gone = Vec::new();
        for name in prepared.keys().filter(|name| !there.contains(*name)) {
            let other = there.iter().find(|other| collide(name, other));
            gone.extend(other.map(|other| (Arc::clone(name), other.to_string())));
        }
        for (name, other) in gone {
            if let Some(prepared) = prepared.remove(&name) {
                tracing::warn!(topic = %name, other, "their names are one to Kafka: the topic is not made");
                self.collisions.lock().push((prepared.channel, other));
            }
        }
    }

    /// Whether this program itself cannot do without a topic.
    fn is_needed(&self, name: &Arc<str>) -> bool {
        self.needed.iter().any(|(needed, _)| needed == name)
    }

    fn missing(&self, there: &HashSet<Arc<str>>) -> Vec<(Arc<str>, Purpose)> {
        let refused = self.refused.lock();
        let prepared = self.prepared.lock();
        let wanted = prepared.iter().map(|(name, prepared)| (name, prepared.purpose));
        let needed = self.needed.iter().map(|(name, purpose)| (name, *purpose));
        needed
            .chain(wanted)
            .filter(|(name, _)| !there.contains(*name))
            .filter(|(name, _)| match refused.get(*name) {
                Some((RDKafkaErrorCode::InvalidTopic, _)) => false,
                Some((code, at)) => self.is_needed(name) || is_due(*code, at.elapsed()),
                None => true,
            })
            .map(|(name, purpose)| (Arc::clone(name), purpose))
            .take(AT_ONCE)
            .collect()
    }

    fn note_refused(
        &self,
        asked: &[(Arc<str>, Purpose)],
        refused: &[(Arc<str>, RDKafkaErrorCode)],
    ) -> Result<(), String> {
        let mut known = self.refused.lock();
        for (name, _) in asked {
            if !refused.iter().any(|(refused, _)| refused == name) {
                known.remove(name);
            }
        }
        let mut needed = Ok(());
        for (name, code) in refused {
            let before = known.insert(Arc::clone(name), (*code, Instant::now()));
            if before.is_none_or(|(before, _)| before != *code) {
                tracing::warn!(topic = %name, %code, "the topic could not be made");
            }
            if self.is_needed(name) {
                needed = Err(format!("topic {name} could not be made: {code}"));
            }
        }
        needed
    }

    /// Topics that were there before, for something else, shall keep the last values of their keys.
    fn keep_last_values(&self, inner: &Inner) {
        let to_check: Vec<Arc<str>> = {
            let prepared = self.prepared.lock();
            let open = prepared
                .iter()
                .filter(|(_, prepared)| prepared.purpose.keeps() && !prepared.keeps);
            open.filter(|(_, prepared)| prepared.topic.partitions().is_some())
                .map(|(name, _)| Arc::clone(name))
                .take(AT_ONCE)
                .collect()
        };
        for name in to_check {
            let done = inner
                .admin()
                .and_then(|admin| admin.keep_last_values(&name).map_err(|error| error.to_string()));
            match done {
                Ok(()) => {
                    if let Some(prepared) = self.prepared.lock().get_mut(&name) {
                        prepared.keeps = true;
                    }
                }
                Err(error) => tracing::debug!(topic = %name, error, "could not be made to keep the last values"),
            }
        }
    }

    /// Has a topic made from now on. `depth`: what it keeps of each writer.
    pub(super) fn prepare(
        &self,
        inner: &Inner,
        channel: &ChannelName,
        purpose: Purpose,
        depth: u32,
    ) -> Result<(), BrokerError> {
        let name = inner.names.topic(channel)?;
        let mut prepared = self.prepared.lock();
        if let Some(prepared) = prepared.get_mut(&name) {
            if purpose.keeps() && !prepared.purpose.keeps() {
                (prepared.purpose, prepared.keeps) = (purpose, false);
            }
            prepared.depth = prepared.depth.max(depth);
        } else {
            let listed = self.listed.lock();
            let other = prepared.keys().chain(listed.iter()).find(|other| collide(&name, other));
            if let Some(other) = other {
                return Err(BrokerError::Collision {
                    channel: channel.to_string(),
                    other: other.to_string(),
                });
            }
            let new = Prepared {
                channel: channel.clone(),
                topic: inner.topics.of(&name, false).0,
                purpose,
                depth,
                keeps: false,
            };
            prepared.insert(Arc::clone(&name), new);
        }
        drop(prepared);
        self.refused.lock().remove(&name);
        inner.bell.ring();
        Ok(())
    }

    /// It stays as it is.
    pub(super) fn release(&self, name: &Arc<str>) {
        self.prepared.lock().remove(name);
    }

    /// What is known of a prepared topic.
    pub(super) fn with<T>(&self, name: &Arc<str>, look: impl FnOnce(&Prepared) -> T) -> Option<T> {
        self.prepared.lock().get(name).map(look)
    }

    /// How many are prepared.
    pub(super) fn count(&self) -> usize {
        self.prepared.lock().len()
    }

    /// Why the server did not want to make a topic when it was last asked.
    pub(super) fn refusal(&self, name: &Arc<str>) -> Option<RDKafkaErrorCode> {
        self.refused.lock().get(name).map(|(code, _)| *code)
    }

    /// Channels that turned out to have somebody else's name, since the last call.
    pub(super) fn take_collisions(&self) -> Vec<(ChannelName, String)> {
        std::mem::take(&mut *self.collisions.lock())
    }
}

impl Inner {
    /// Whether it makes topics, for which it must know all that there are.
    pub(super) fn makes_topics(&self) -> bool {
        self.flow.is_some() || self.worker.is_some()
    }

    /// Makes the topics that are missing, if it makes any.
    pub(super) fn keep_topics(&self, listing: &Listing) -> Result<Made, String> {
        match (&self.flow, &self.worker) {
            (Some(flow), _) => flow.keep_topics(self, listing),
            (None, Some(worker)) => worker.maker.make(self, listing).map(|(made, _)| made),
            (None, None) => Ok(Made::Nothing),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_passes_is_tried_again_soon_and_what_is_refused_for_good_is_not() {
        let second = Duration::from_secs(1);
        for passing in [
            RDKafkaErrorCode::InvalidReplicationFactor,
            RDKafkaErrorCode::RequestTimedOut,
            RDKafkaErrorCode::OperationTimedOut,
            RDKafkaErrorCode::NotController,
            RDKafkaErrorCode::BrokerNotAvailable,
        ] {
            assert!(!is_final(passing) && is_due(passing, second), "{passing}");
        }
        for refused in [
            RDKafkaErrorCode::PolicyViolation,
            RDKafkaErrorCode::TopicAuthorizationFailed,
            RDKafkaErrorCode::ClusterAuthorizationFailed,
        ] {
            assert!(
                is_final(refused) && !is_due(refused, second) && is_due(refused, TRY_AGAIN),
                "{refused}"
            );
        }
        let name = RDKafkaErrorCode::InvalidTopic;
        assert!(is_final(name) && !is_due(name, TRY_AGAIN * 100));
    }
}
