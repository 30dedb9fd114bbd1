//! Creates the topics that are to be there, and creates them again when they vanish: those that
//! this program itself needs, and those that were prepared for others.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_domain::names::ChannelName;
use parking_lot::Mutex;
use rdkafka::error::RDKafkaErrorCode;

use super::admin::Purpose;
use super::directory::Listing;
use super::inner::Inner;
use super::names::{self, collide};
use super::topics::Topic;
use crate::port::BrokerError;

/// What the server refused to make is asked for again after this.
const TRY_AGAIN: Duration = Duration::from_secs(10);
/// The same where it could not make it just then.
const TRY_SOON: Duration = Duration::from_secs(1);
/// Topics that are asked for in one request: the server makes one after the other, and has a second
/// and a half for all.
const AT_ONCE: usize = 100;

/// Whether a server that refuses to make a topic would refuse it again, for what it is or for who
/// asks. All else passes: too few brokers for as many replicas as it gives, a controller that
/// changes, no answer in time.
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

/// What a round has asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Created {
    /// Topics that this program itself needs.
    pub(super) needed: bool,
    /// Topics that were not asked for in the round before.
    pub(super) anew: bool,
}

/// A topic that is to be there.
pub(super) struct Prepared {
    /// Its channel; `None`: this program itself needs it.
    channel: Option<ChannelName>,
    /// Present where it was prepared for a channel.
    pub(super) topic: Option<Arc<Topic>>,
    purpose: Purpose,
    /// What it keeps of each writer, where that is what it keeps.
    pub(super) depth: u32,
    /// Whether it is known to keep what it shall.
    keeps: bool,
    /// Why and when the server refused to create it when it was last asked.
    refused: Option<(RDKafkaErrorCode, Instant)>,
    /// It was asked for in the last round.
    asked: bool,
}

#[derive(Default)]
struct State {
    prepared: BTreeMap<Arc<str>, Prepared>,
    /// The server's topics, as they were last listed.
    listed: HashMap<String, usize>,
    /// Channels whose name another topic has, until they are taken.
    collisions: Vec<(ChannelName, String)>,
}

/// All topics that are to be there.
pub(super) struct TopicCreator(Mutex<State>);

impl TopicCreator {
    /// `needed`: topics that this program itself cannot do without.
    pub(super) fn new(needed: impl Iterator<Item = (Arc<str>, Purpose)>) -> Self {
        let prepared = needed.map(|(name, purpose)| (name, Prepared::new(None, purpose)));
        Self(Mutex::new(State { prepared: prepared.collect(), ..State::default() }))
    }

    /// Creates what is missing. Fails where a topic that this program itself needs could not be
    /// created; a topic of a service that cannot be created holds up no other, and is tried again
    /// after a while.
    pub(super) fn create(&self, inner: &Inner, listing: &Listing) -> Result<Created, String> {
        let (missing, created) = self.0.lock().missing(listing);
        if !missing.is_empty() {
            match inner.admin()?.make(&missing) {
                Ok(refused) => self.0.lock().note_refused(&missing, &refused)?,
                Err(error) if created.needed => return Err(error.to_string()),
                Err(error) => {
                    tracing::warn!(
                        %error,
                        topics = missing.len(),
                        "topics could not be made, trying on",
                    );
                }
            }
        }
        if !created.needed {
            self.keep_last_values(inner);
        }
        Ok(created)
    }

    /// Topics that were there before, for something else, shall keep the last values of their keys.
    fn keep_last_values(&self, inner: &Inner) {
        let is_there = |prepared: &Prepared| {
            prepared.topic.as_ref().is_some_and(|topic| topic.partitions().is_some())
        };
        let to_check: Vec<Arc<str>> = {
            let state = self.0.lock();
            let open = state.prepared.iter().filter(|(_, prepared)| {
                prepared.purpose.keeps() && !prepared.keeps && is_there(prepared)
            });
            open.map(|(name, _)| Arc::clone(name)).take(AT_ONCE).collect()
        };
        for name in to_check {
            let done = inner
                .admin()
                .and_then(|admin| admin.keep_last_values(&name).map_err(|error| error.to_string()));
            match done {
                Ok(()) => {
                    if let Some(prepared) = self.0.lock().prepared.get_mut(&name) {
                        prepared.keeps = true;
                    }
                }
                Err(error) => {
                    tracing::debug!(
                        topic = %name,
                        error,
                        "could not be made to keep the last values",
                    );
                }
            }
        }
    }

    /// Has a topic created from now on. `depth`: what it keeps of each writer.
    pub(super) fn prepare(
        &self,
        inner: &Inner,
        channel: &ChannelName,
        purpose: Purpose,
        depth: u32,
    ) -> Result<(), BrokerError> {
        let name = inner.names.topic(channel)?;
        let mut state = self.0.lock();
        let State { prepared, listed, .. } = &mut *state;
        if !prepared.contains_key(&name) {
            let named =
                prepared.keys().map(|name| &**name).chain(listed.keys().map(String::as_str));
            if let Some(other) = named.into_iter().find(|other| collide(&name, other)) {
                return Err(BrokerError::Collision {
                    channel: channel.to_string(),
                    other: other.to_owned(),
                });
            }
        }
        let entry = prepared
            .entry(Arc::clone(&name))
            .or_insert_with(|| Prepared::new(Some(channel.clone()), purpose));
        entry.topic.get_or_insert_with(|| inner.topics.of(&name, names::stays_open(channel)).0);
        if purpose.keeps() && !entry.purpose.keeps() {
            (entry.purpose, entry.keeps) = (purpose, false);
        }
        entry.depth = entry.depth.max(depth);
        entry.refused = None;
        drop(state);
        inner.waker.wake();
        Ok(())
    }

    /// It stays as it is.
    pub(super) fn release(&self, name: &Arc<str>) {
        let prepared = &mut self.0.lock().prepared;
        if prepared.get(name).is_some_and(|prepared| prepared.channel.is_some()) {
            prepared.remove(name);
        }
    }

    /// What is known of a prepared topic.
    pub(super) fn with<T>(&self, name: &Arc<str>, look: impl FnOnce(&Prepared) -> T) -> Option<T> {
        self.0.lock().prepared.get(name).map(look)
    }

    /// How many are prepared.
    pub(super) fn count(&self) -> usize {
        self.0.lock().prepared.len()
    }

    /// Channels that turned out to have another topic's name, since the last call.
    pub(super) fn take_collisions(&self) -> Vec<(ChannelName, String)> {
        std::mem::take(&mut self.0.lock().collisions)
    }
}

impl Prepared {
    fn new(channel: Option<ChannelName>, purpose: Purpose) -> Self {
        Self { channel, topic: None, purpose, depth: 0, keeps: false, refused: None, asked: false }
    }

    /// Why the server refused to create the topic when it was last asked.
    pub(super) fn refusal(&self) -> Option<RDKafkaErrorCode> {
        self.refused.map(|(code, _)| code)
    }

    fn is_needed(&self) -> bool {
        self.channel.is_none()
    }

    fn is_due(&self) -> bool {
        match self.refused {
            None => true,
            Some((RDKafkaErrorCode::InvalidTopic, _)) => false,
            Some((code, at)) => self.is_needed() || is_due(code, at.elapsed()),
        }
    }
}

impl State {
    /// Takes what the server has. Returns what is to be created, up to a limit.
    fn missing(&mut self, listing: &Listing) -> (Vec<(Arc<str>, Purpose)>, Created) {
        self.listed.clone_from(&listing.topics);
        self.refuse_collisions();
        let mut missing = Vec::new();
        let mut created = Created { needed: false, anew: false };
        let listed = &self.listed;
        // What this program itself needs comes first.
        let (needed, others): (Vec<_>, Vec<_>) =
            self.prepared.iter_mut().partition(|(_, prepared)| prepared.is_needed());
        for (name, prepared) in needed.into_iter().chain(others) {
            let before = std::mem::take(&mut prepared.asked);
            if listed.contains_key(&**name) || !prepared.is_due() || missing.len() == AT_ONCE {
                continue;
            }
            prepared.asked = true;
            created.needed |= prepared.is_needed();
            created.anew |= !before;
            missing.push((Arc::clone(name), prepared.purpose));
        }
        (missing, created)
    }

    /// What was prepared before its name was known to be taken is no longer created.
    fn refuse_collisions(&mut self) {
        let Self { prepared, listed, collisions } = self;
        prepared.retain(|name, prepared| {
            let Some(channel) = &prepared.channel else { return true };
            if listed.contains_key(&**name) {
                return true;
            }
            let Some(other) = listed.keys().find(|other| collide(name, other)) else {
                return true;
            };
            tracing::warn!(
                topic = %name,
                other,
                "their names are one to Kafka: the topic is not made",
            );
            collisions.push((channel.clone(), other.clone()));
            false
        });
    }

    fn note_refused(
        &mut self,
        asked: &[(Arc<str>, Purpose)],
        refused: &[(Arc<str>, RDKafkaErrorCode)],
    ) -> Result<(), String> {
        let mut needed = Ok(());
        for (name, _) in asked {
            let Some(prepared) = self.prepared.get_mut(name) else {
                continue;
            };
            let code = refused.iter().find(|(refused, _)| refused == name).map(|(_, code)| *code);
            if let Some(code) = code.filter(|code| prepared.refusal() != Some(*code)) {
                tracing::warn!(topic = %name, %code, "the topic could not be made");
            }
            prepared.refused = code.map(|code| (code, Instant::now()));
            if let (Some(code), true) = (code, prepared.is_needed()) {
                needed = Err(format!("topic {name} could not be made: {code}"));
            }
        }
        needed
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
