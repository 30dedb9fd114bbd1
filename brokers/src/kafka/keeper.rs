//! One thread per broker asks the server whether it lives, makes what must be there, and puts right what has changed.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use super::consumer::Consumer;
use super::directory::{Listing, LookupError};
use super::inner::Inner;
use super::maker::Made;
use super::settings::Lot;
use super::topics::Topic;

/// How long the server has for an answer.
const ANSWER: Duration = Duration::from_secs(1);
/// How often the server is asked while all is well: with the time for the answer below the 2 s in which a loss must show.
const CALM: Duration = Duration::from_millis(700);
/// How often while something is missing.
const BUSY: Duration = Duration::from_millis(200);
/// Topics whose largest batch is asked for at once.
const MAX_ASKED: usize = 512;
/// Topics that a service asks for one by one in a round.
const PER_ROUND: usize = 8;

/// How often the clients that read and write are asked whether they get answers.
const LOOK: Duration = Duration::from_secs(5);
/// How long such an answer may take: somebody else got one just before.
const QUICK: Duration = Duration::from_millis(300);
/// A client that gets no answer for this long while the server gives some is made anew. The client library takes brokers that an answer
/// does not name off its list; of a server that named none, because it had lost itself for a moment, it then never hears again.
const FORSAKEN: Duration = Duration::from_secs(3);

/// Since when a client gets no answer.
#[derive(Default)]
struct Silence(Option<Instant>);

impl Silence {
    /// Takes whether there was an answer. Tells whether the client is to be made anew.
    fn note(&mut self, now: Instant, answered: bool) -> bool {
        if answered {
            self.0 = None;
            return false;
        }
        let since = *self.0.get_or_insert(now);
        let forsaken = now.saturating_duration_since(since) >= FORSAKEN;
        if forsaken {
            self.0 = Some(now);
        }
        forsaken
    }

    fn is_there(&self) -> bool {
        self.0.is_some()
    }
}

/// What of the clients is known.
#[derive(Default)]
struct Watch {
    directory: Silence,
    admin: Silence,
    consumers: HashMap<bool, Silence>,
    producers: HashMap<Lot, Silence>,
    looked: Option<Instant>,
}

/// Runs until the broker is closed.
pub(super) fn run(inner: &Inner) {
    let mut turn = 0_usize;
    let mut watch = Watch::default();
    while !inner.stop.is_cancelled() {
        let calm = round(inner, turn, &mut watch);
        turn = turn.wrapping_add(1);
        if !inner.stop.is_cancelled() {
            inner.bell.wait(if calm { CALM } else { BUSY });
        }
    }
    inner.directory.close();
    inner.close_admin();
}

impl Watch {
    /// The server answers nobody. What a client waits meanwhile says nothing about it: one that was not answered just before would
    /// else be given up right after, with all that it holds.
    fn nobody_is_answered(&mut self) {
        self.admin = Silence::default();
        self.consumers.clear();
        self.producers.clear();
        // Who is forsaken is so since the server has come back: they are looked at as soon as it answers.
        self.looked = None;
    }

    /// Looks whether the clients that read and write get answers, which the server has just given.
    fn look(&mut self, inner: &Inner) {
        let silent = self
            .consumers
            .values()
            .chain(self.producers.values())
            .any(Silence::is_there);
        let is_due = |at: Instant| at.elapsed() >= LOOK;
        if !silent && !self.looked.is_none_or(is_due) {
            return;
        }
        self.looked = Some(Instant::now());
        let (consumers, producers) = {
            let clients = inner.clients.lock();
            (clients.consumers.clone(), clients.producers.clone())
        };
        for (large, consumer) in consumers {
            let answered = consumer.is_answered(&inner.probe, QUICK);
            if self.consumers.entry(large).or_default().note(Instant::now(), answered) {
                tracing::warn!("the Kafka consumer is made anew: it gets no answer");
                if let Err(error) = consumer.remake(&inner.settings) {
                    inner.last_error.note(error);
                }
            }
        }
        for (lot, producer) in producers {
            let answered = producer.is_answered(&inner.probe, QUICK);
            if self.producers.entry(lot).or_default().note(Instant::now(), answered) {
                producer.remake();
            }
        }
    }
}

/// Asks once and acts on the answer. Returns whether nothing is missing.
fn round(inner: &Inner, turn: usize, watch: &mut Watch) -> bool {
    // Who makes topics needs to know all, for those that are missing; a service only whether someone answers.
    let one = (!inner.makes_topics()).then_some(&*inner.probe);
    let listed = inner.directory.list(one, ANSWER);
    let answered = listed.as_ref().is_ok_and(|listing| listing.brokers > 0);
    if watch.directory.note(Instant::now(), answered) {
        tracing::debug!("the client that asks is made anew");
        if let Err(error) = inner.directory.remake(&inner.settings, &inner.last_error) {
            inner.last_error.note(error.to_string());
        }
    }
    if !answered {
        watch.nobody_is_answered();
    }
    let listing = match listed {
        Ok(listing) if answered => listing,
        Ok(_) => return lost(inner, "no broker of the cluster is there"),
        Err(error) => return lost(inner, &error.to_string()),
    };
    if let Some(reason) = inner.supervisor.failure() {
        return lost(inner, &reason);
    }
    if inner.makes_topics() {
        let kept = inner.keep_topics(&listing);
        if watch.admin.note(Instant::now(), kept.is_ok()) {
            inner.close_admin();
        }
        match kept {
            Err(reason) => return lost(inner, &reason),
            Ok(Made::Needed) => return false,
            // They are there when the server lists them: the next round comes at once.
            Ok(Made::Topics) => inner.bell.ring(),
            Ok(Made::Nothing) => {}
        }
    }
    note_topics(inner, &listing);
    if !inner.was_up.load(Ordering::Acquire) {
        // A partition that had no leader for a moment may have been given up by the client: all are asked for again.
        for consumer in inner.consumers() {
            consumer.look_again();
        }
    }
    found(inner, listing.brokers);
    watch.look(inner);
    for consumer in inner.consumers() {
        keep_reading(inner, &consumer, &listing, turn);
    }
    inner.topics.absent(1).is_empty() && !inner.consumers().iter().any(|consumer| consumer.awaits_any())
}

fn lost(inner: &Inner, reason: &str) -> bool {
    inner.gate.set_up(false);
    let reason = inner.last_error.take().unwrap_or_else(|| reason.to_owned());
    inner.set_server(false, format!("{}: {reason}", inner.settings.place()));
    false
}

fn found(inner: &Inner, brokers: usize) {
    let cluster = inner.cluster.get_or_init_with(|| inner.directory.cluster());
    let cluster = cluster.map_or_else(String::new, |id| format!("cluster {id}, "));
    let plural = if brokers == 1 { "" } else { "s" };
    inner.last_error.take();
    inner.gate.set_up(true);
    inner.set_server(true, format!("kafka ({cluster}{brokers} broker{plural})"));
}

/// What is written and was missing may have come.
fn note_topics(inner: &Inner, listing: &Listing) {
    let came = if inner.makes_topics() {
        let listed: HashMap<&str, usize> = listing.topics.iter().map(|(name, n)| (name.as_str(), *n)).collect();
        learn_limits(inner, |topic| listed.contains_key(&*topic.name));
        inner.topics.note_all(&listed)
    } else {
        let found: Vec<(String, usize)> = inner
            .topics
            .absent(PER_ROUND)
            .iter()
            .flat_map(|name| inner.directory.list(Some(name), ANSWER).unwrap_or_default().topics)
            .collect();
        let is_found = |topic: &Topic| found.iter().any(|(name, _)| **name == *topic.name);
        learn_limits(inner, |topic| topic.partitions().is_some() || is_found(topic));
        found.iter().fold(false, |came, (name, partitions)| {
            came | inner.topics.note(name, *partitions)
        })
    };
    if came || !inner.was_up.load(Ordering::Acquire) {
        inner.wake_writers();
    }
}

/// Asks for the largest batch of topics that are new, before anything is written to them.
fn learn_limits(inner: &Inner, is_there: impl Fn(&Topic) -> bool) {
    let names = inner.topics.without_limit(is_there, MAX_ASKED);
    if names.is_empty() {
        return;
    }
    let found = inner
        .admin()
        .and_then(|admin| admin.largest_batches(&names).map_err(|error| error.to_string()));
    let limits: HashMap<Arc<str>, usize> = match found {
        Ok(limits) => limits.into_iter().collect(),
        Err(error) => {
            tracing::debug!(error, topics = names.len(), "the largest batches are not known");
            HashMap::new()
        }
    };
    for name in names {
        inner.topics.note_limit(&name, limits.get(&name).copied());
    }
}

/// The topics whose turn it is to be looked at.
fn watched(topics: &[Arc<str>], turn: usize) -> Vec<Arc<str>> {
    let rounds = topics.len().div_ceil(PER_ROUND).max(1);
    let mine = topics
        .iter()
        .enumerate()
        .filter(|(number, _)| number % rounds == turn % rounds);
    mine.map(|(_, topic)| Arc::clone(topic)).collect()
}

fn keep_reading(inner: &Inner, consumer: &Arc<Consumer>, listing: &Listing, turn: usize) {
    consumer.sweep();
    let topics = consumer.topics();
    if inner.makes_topics() {
        for (name, partitions) in &listing.topics {
            consumer.note_partitions(name, *partitions);
        }
    } else if !topics.is_empty() {
        // One of all in a round: that a topic gets more partitions is rare.
        if let Ok(found) = inner.directory.list(Some(&topics[turn % topics.len()]), ANSWER) {
            for (name, partitions) in &found.topics {
                consumer.note_partitions(name, *partitions);
            }
        }
    }
    let lost_position = consumer.take_lost_position();
    let waiting = topics.iter().filter(|topic| consumer.is_awaited(topic)).count();
    let mut looks = 0;
    let watched = watched(&topics, turn);
    for topic in topics {
        let awaited = consumer.is_awaited(&topic);
        if awaited {
            looks += 1;
            // The list of who makes topics holds all that there is; a service asks for some of what it waits for, in turn.
            let listed = listing.topics.iter().any(|(name, _)| **name == *topic);
            if (inner.makes_topics() && !listed) || !(looks + turn).is_multiple_of(waiting.div_ceil(PER_ROUND).max(1)) {
                continue;
            }
        }
        let resume = consumer.is_idle(&topic) && inner.gate.lets(false);
        if !resume && !lost_position && !watched.contains(&topic) {
            continue;
        }
        let deadline = Instant::now() + ANSWER;
        let looked = inner.directory.topic(&topic, ANSWER).and_then(|info| {
            let marks = inner.directory.marks(&topic, info.partitions, deadline)?;
            Ok((info, marks))
        });
        match looked {
            Ok((info, marks)) if resume => consumer.resume(&topic, &info, &marks, || inner.gate.lets(false)),
            Ok((info, marks)) if lost_position => consumer.check_positions(Instant::now(), &topic, &info, &marks),
            Ok((info, marks)) => consumer.watch(&topic, &info, &marks),
            Err(error) => {
                tracing::debug!(%topic, %error, "could not be looked at");
                if lost_position {
                    consumer.look_again();
                }
                if matches!(error, LookupError::Away(_)) && Instant::now() >= deadline {
                    // It would be so with the others: whether the server is there at all is what is to be found out next.
                    return;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
