//! One thread per broker asks the server for an answer, makes the topics that must be there, and
//! brings the clients into line with what the server has.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use super::consumer::Consumer;
use super::directory::{Listing, LookupError};
use super::inner::Inner;
use super::settings::Lot;

/// How long the server has for an answer.
const ANSWER: Duration = Duration::from_secs(1);
/// How often the server is asked while all is well: with the time for the answer below the 2 s in
/// which a loss must show.
const CALM: Duration = Duration::from_millis(700);
/// How often while something is missing.
const BUSY: Duration = Duration::from_millis(200);
/// Topics whose largest batch is asked for at once.
const MAX_ASKED: usize = 512;
/// Topics that are asked for one by one in a round.
const PER_ROUND: usize = 8;
/// Rounds in which each topic that is read is looked at once, at least.
const ROUNDS: usize = 4;
/// Rounds without anything missing after which the client that makes topics is ended.
const CALM_ROUNDS: usize = 20;

/// How often the clients that read and write are asked whether they get answers.
const LOOK: Duration = Duration::from_secs(5);
/// How long such an answer may take: another client got one just before.
const QUICK: Duration = Duration::from_millis(300);
/// A client that gets no answer for this long while the server gives some is made anew. The client
/// library takes brokers that an answer does not name off its list; of a server that named none,
/// because it had lost itself for a moment, it then never hears again.
const FORSAKEN: Duration = Duration::from_secs(3);

/// The clients of one broker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Client {
    Directory,
    Admin,
    Consumer { large: bool },
    Producer(Lot),
}

/// Clients that get no answer, and since when.
#[derive(Default)]
struct Silent {
    since: HashMap<Client, Instant>,
    looked: Option<Instant>,
    /// The client that asks was made anew since the last answer.
    asked_anew: bool,
}

impl Silent {
    /// Takes whether a client got an answer. Returns whether it is to be made anew.
    fn note(&mut self, client: Client, now: Instant, answered: bool) -> bool {
        if answered {
            self.since.remove(&client);
            return false;
        }
        let since = self.since.entry(client).or_insert(now);
        let forsaken = now.saturating_duration_since(*since) >= FORSAKEN;
        if forsaken {
            *since = now;
        }
        forsaken
    }

    /// The server answers no client. What the others wait meanwhile says nothing about them: one
    /// that was not answered just before would else be given up right after, with all that it
    /// holds.
    fn nobody_is_answered(&mut self) {
        self.since.retain(|client, _| *client == Client::Directory);
        // They are looked at as soon as the server answers again.
        self.looked = None;
    }

    /// Looks whether the clients that read and write get answers, which the server has just given.
    fn look(&mut self, inner: &Inner) {
        let any =
            self.since.keys().any(|client| !matches!(client, Client::Directory | Client::Admin));
        if !any && self.looked.is_some_and(|at| at.elapsed() < LOOK) {
            return;
        }
        self.looked = Some(Instant::now());
        let (consumers, producers) = {
            let clients = inner.clients.lock();
            (clients.consumers.clone(), clients.producers.clone())
        };
        for (large, consumer) in consumers {
            let answered = consumer.is_answered(&inner.probe, QUICK);
            if self.note(Client::Consumer { large }, Instant::now(), answered) {
                tracing::warn!("the Kafka consumer is made anew: it gets no answer");
                if let Err(error) = consumer.remake() {
                    inner.shared.last_error.note(error);
                }
            }
        }
        for (lot, producer) in producers {
            let answered = producer.is_answered(&inner.probe, QUICK);
            if self.note(Client::Producer(lot), Instant::now(), answered) {
                producer.remake();
            }
        }
    }
}

/// Runs until the broker is closed.
pub(super) fn run(inner: &Inner) {
    let mut turn = 0_usize;
    let (mut silent, mut calm_rounds) = (Silent::default(), 0_usize);
    while !inner.shared.stop.is_cancelled() {
        let calm = round(inner, turn, &mut silent);
        turn = turn.wrapping_add(1);
        calm_rounds = if calm { calm_rounds + 1 } else { 0 };
        if calm_rounds == CALM_ROUNDS {
            inner.close_admin();
            calm_rounds = 0;
        }
        if !inner.shared.stop.is_cancelled() {
            inner.waker.wait(if calm { CALM } else { BUSY });
        }
    }
    inner.directory.close();
    inner.close_admin();
}

/// Asks once and acts on the answer. Returns whether nothing is missing.
fn round(inner: &Inner, turn: usize, silent: &mut Silent) -> bool {
    // The creator of topics needs to know all, for those that are missing; a service only whether
    // there is an answer.
    let one = inner.creator().is_none().then_some(&*inner.probe);
    let listed = inner.directory.list(one, ANSWER);
    let answered = listed.as_ref().is_ok_and(|listing| listing.brokers > 0);
    if silent.note(Client::Directory, Instant::now(), answered) {
        tracing::debug!("the client that asks is made anew");
        match inner.directory.remake() {
            Ok(()) => silent.asked_anew = true,
            Err(error) => inner.shared.last_error.note(error.to_string()),
        }
    }
    if !answered {
        silent.nobody_is_answered();
    }
    let listing = match listed {
        Ok(listing) if answered => listing,
        Ok(_) => return lost(inner, "no broker of the cluster is there"),
        Err(error) => return lost(inner, &error.to_string()),
    };
    if let Some(reason) = inner.shared.supervisor.failure() {
        return lost(inner, &reason);
    }
    // One broker of several may refuse what the others do not ask for again.
    let is_refused = inner.shared.last_error.take_refused();
    if std::mem::take(&mut silent.asked_anew) || is_refused {
        inner.follow_secrets();
    }
    if let Some(flow) = &inner.flow {
        flow.follow_leases_topic(inner, &listing);
    }
    if let Some(creator) = inner.creator() {
        let created = creator.create(inner, &listing);
        if silent.note(Client::Admin, Instant::now(), created.is_ok()) {
            inner.close_admin();
        }
        match created {
            Err(reason) => return lost(inner, &reason),
            // Until they are listed there is nothing else to do.
            Ok(created) if created.needed => return false,
            // They are there when the server lists them: the next round comes at once.
            Ok(created) if created.anew => inner.waker.wake(),
            Ok(_) => {}
        }
    }
    note_topics(inner, &listing);
    if !inner.was_up.load(Ordering::Acquire) {
        // A partition that had no leader for a moment may have been given up by the client: all are
        // asked for again.
        for consumer in inner.consumers() {
            consumer.look_again();
        }
    }
    found(inner, listing.brokers);
    silent.look(inner);
    for consumer in inner.consumers() {
        keep_reading(inner, &consumer, &listing, turn);
    }
    inner.topics.absent(1).is_empty()
        && !inner.consumers().iter().any(|consumer| consumer.awaits_any())
}

fn lost(inner: &Inner, reason: &str) -> bool {
    inner.shared.gate.set_up(false);
    let reason = inner.shared.last_error.get().unwrap_or_else(|| reason.to_owned());
    inner.set_server(false, format!("{}: {reason}", inner.shared.settings.place()));
    false
}

fn found(inner: &Inner, brokers: usize) {
    if inner.cluster.get().is_none()
        && let Some(id) = inner.directory.cluster()
    {
        let _ = inner.cluster.set(id);
    }
    let cluster = inner.cluster.get().map_or_else(String::new, |id| format!("cluster {id}, "));
    let plural = if brokers == 1 { "" } else { "s" };
    inner.shared.last_error.take();
    inner.shared.gate.set_up(true);
    inner.set_server(true, format!("kafka ({cluster}{brokers} broker{plural})"));
}

/// Topics that are written and were missing may have come.
fn note_topics(inner: &Inner, listing: &Listing) {
    let all = inner.creator().is_some();
    let found = if all {
        listing.topics.clone()
    } else {
        let ask =
            |name: &Arc<str>| inner.directory.list(Some(name), ANSWER).unwrap_or_default().topics;
        inner.topics.absent(PER_ROUND).iter().flat_map(ask).collect()
    };
    learn_limits(inner, &found);
    let came = inner.topics.note(&found, all);
    if came || !inner.was_up.load(Ordering::Acquire) {
        inner.wake_writers();
    }
}

/// Asks for the largest batch of topics that are new, before anything is written to them.
fn learn_limits(inner: &Inner, found: &HashMap<String, usize>) {
    let names = inner.topics.without_limit(found, MAX_ASKED);
    if names.is_empty() {
        return;
    }
    let limits = inner
        .admin()
        .and_then(|admin| admin.largest_batches(&names).map_err(|error| error.to_string()));
    let limits = limits.unwrap_or_else(|error| {
        tracing::debug!(error, topics = names.len(), "the largest batches are not known");
        HashMap::new()
    });
    for name in names {
        inner.topics.note_limit(&name, limits.get(&name).copied());
    }
}

/// Whether it is the turn of a topic with this number, of so many, in at least so many rounds.
fn has_turn(number: usize, count: usize, least: usize, turn: usize) -> bool {
    let rounds = count.div_ceil(PER_ROUND).max(least);
    number % rounds == turn % rounds
}

fn keep_reading(inner: &Inner, consumer: &Consumer, listing: &Listing, turn: usize) {
    let topics = consumer.topics();
    let lost_position = consumer.take_lost_position();
    let (awaited, read): (Vec<_>, Vec<_>) = topics.into_iter().partition(|known| known.is_awaited);
    let (is_creator, waiting, count) = (inner.creator().is_some(), awaited.len(), read.len());
    // A creator's listing holds all that there is; a service asks for some of what it waits for, in
    // turn.
    let awaited = awaited.into_iter().enumerate().filter(|(number, known)| {
        known.is_idle
            && if is_creator {
                listing.topics.contains_key(&*known.topic)
            } else {
                has_turn(*number, waiting, 1, turn)
            }
    });
    let read = read.into_iter().enumerate().filter(|(number, known)| {
        let least = if known.is_behind { 1 } else { ROUNDS };
        known.is_idle || lost_position || has_turn(*number, count, least, turn)
    });
    for (_, known) in awaited.chain(read) {
        let topic = &known.topic;
        let deadline = Instant::now() + ANSWER;
        let looked = inner.directory.topic(topic, ANSWER).and_then(|info| {
            let marks = inner.directory.marks(topic, info.partitions, deadline)?;
            Ok((info, marks))
        });
        match looked {
            Ok((info, marks)) => {
                consumer.follow(Instant::now(), topic, (&info, &marks), lost_position);
            }
            Err(error) => {
                tracing::debug!(%topic, %error, "could not be looked at");
                if lost_position {
                    consumer.look_again();
                }
                if matches!(error, LookupError::Away(_)) && Instant::now() >= deadline {
                    // It would be so with the others: the next question is whether the server is
                    // there at all.
                    return;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
