//! A lease as records of a partition, whose order decides.
//!
//! ```text
//! hold(note) ─► thread ─► what does the log say?   it is mine: renew · it is over: claim and renew · else: wait
//!                 │          └─► write ─► read up to what was written ─► does the log say that it is mine?
//!                 └─► reads on in between, so that it knows since when it was not renewed
//! ```
//!
//! Whoever holds it may act until its time after it *asked*; the others read its record later than that, and wait for the same
//! time from there. So the clocks of the machines do not matter. One that has just begun to read does not know how old the last
//! record is: it claims once, and that counts if the server's clock says that the time is over (`LogAppendTime`).
//!
//! Why not membership of a group: a broker takes nobody for dead in less than `group.min.session.timeout.ms`, 6 s unless set.
//! The group is there all the same: its position shows the tools of Kafka how far whoever leads has read.

mod client;
mod ledger;
#[cfg(test)]
mod tests;

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::time::{Duration, Instant};

use blaze_domain::node_file::KafkaBroker as Section;
use blaze_runtime::supervisor::{Supervisor, TaskPolicy};
use rdkafka::error::{KafkaError, RDKafkaErrorCode};
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;

use super::admin::{Admin, Purpose};
use super::context::LastError;
use super::settings::Settings;
use crate::open::OpenError;
use client::{Broken, Link};
use ledger::{Act, Entry, Step};

/// Between two looks at the log, while nobody asks.
const TURN: Duration = Duration::from_millis(50);
/// Between two tries to reach the log.
const AGAIN: Duration = Duration::from_millis(250);
/// The least time that the server has for an answer.
const LEAST_PATIENCE: Duration = Duration::from_millis(100);
/// The longest.
const LONGEST_PATIENCE: Duration = Duration::from_secs(5);
/// Questions that wait for the thread.
const QUEUE: usize = 4;
const GIVEN_UP: &str = "the lease was given up";

/// What became of asking for the lease.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct LogHeld {
    /// Whether this owner has it.
    pub is_held: bool,
    /// What the last holder that left a note has left.
    pub note: Option<String>,
}

/// Which lease, and for whom.
#[derive(Debug, Clone)]
pub struct LogLeaseOptions {
    /// The channel whose topic has the records; of all leases.
    pub channel: &'static str,
    /// Which of the leases there.
    pub name: String,
    /// The group whose position is shown.
    pub group: String,
    /// Who wants it; nobody else has this name, also not after a restart.
    pub owner: String,
    /// How long it is held without being renewed.
    pub time: Duration,
}

impl LogLeaseOptions {
    fn entry(&self, term: u64, act: Act, note: Option<String>) -> Entry {
        Entry {
            owner: self.owner.clone(),
            term,
            act,
            time_ms: u64::try_from(self.time.as_millis()).unwrap_or(u64::MAX),
            note,
        }
    }
}

enum Question {
    Hold {
        note: Option<String>,
        answer: oneshot::Sender<Result<LogHeld, String>>,
    },
    Release(oneshot::Sender<()>),
}

/// One that wants a lease which lies in the log of a topic. Dropped without [`LogLease::release`], the lease runs out.
pub struct LogLease {
    questions: SyncSender<Question>,
    stop: CancellationToken,
    /// Of the thread, which ends with `stop`.
    _supervisor: Supervisor,
}

impl LogLease {
    /// Begins to read, in the background; makes the topic if there is none. Must be called on a Tokio runtime.
    ///
    /// # Errors
    /// [`OpenError`] as for a broker of this section.
    pub fn open(section: &Section, options: LogLeaseOptions) -> Result<Self, OpenError> {
        let (settings, names) = super::read(section)?;
        let (questions, asked) = sync_channel(QUEUE);
        let (stop, supervisor) = (CancellationToken::new(), Supervisor::new("kafka-lease"));
        let reader = Reader {
            settings,
            topic: names.reserved(options.channel),
            patience: (options.time / 4).clamp(LEAST_PATIENCE, LONGEST_PATIENCE),
            options,
            last_error: Arc::default(),
            is_made: false,
            is_warned: false,
            link: None,
            held: None,
            not_before: None,
        };
        let stopped = stop.clone();
        supervisor
            .spawn_thread("kafka-lease", TaskPolicy::MayEnd, move || reader.run(&asked, &stopped))
            .map_err(|error| OpenError::Setting {
                key: "kafka".to_owned(),
                reason: error.to_string(),
            })?;
        Ok(Self {
            questions,
            stop,
            _supervisor: supervisor,
        })
    }

    /// Asks whether this owner has the lease, for its time from before the call. Who had it at the last call, too, leaves
    /// `note`; who has got it since does not, and learns what the one before has left.
    ///
    /// # Errors
    /// For people: nobody knows.
    pub async fn hold(&self, note: Option<&str>) -> Result<LogHeld, String> {
        let (answer, answered) = oneshot::channel();
        let question = Question::Hold {
            note: note.map(str::to_owned),
            answer,
        };
        self.questions.try_send(question).map_err(|error| match error {
            TrySendError::Full(_) => "the broker has not answered the last questions yet".to_owned(),
            TrySendError::Disconnected(_) => GIVEN_UP.to_owned(),
        })?;
        answered.await.unwrap_or_else(|_| Err(GIVEN_UP.to_owned()))
    }

    /// Gives it up, so that another one has it at once; it is not asked for again.
    pub async fn release(&self) {
        let (answer, answered) = oneshot::channel();
        if self.questions.try_send(Question::Release(answer)).is_ok() {
            // If the thread has ended, it runs out.
            let _ = answered.await;
        }
        self.stop.cancel();
    }
}

impl Drop for LogLease {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

/// What the thread owns.
struct Reader {
    settings: Settings,
    topic: Arc<str>,
    options: LogLeaseOptions,
    /// How long the server has for an answer: whoever holds the lease asks every third of it.
    patience: Duration,
    last_error: Arc<LastError>,
    is_made: bool,
    /// It was said that somebody else must make it.
    is_warned: bool,
    link: Option<Link>,
    /// The term in which it was held at the last call.
    held: Option<u64>,
    /// Nothing is claimed before: somebody may hold it by a log that is gone.
    not_before: Option<Instant>,
}

impl Reader {
    fn run(mut self, questions: &Receiver<Question>, stop: &CancellationToken) {
        while !stop.is_cancelled() {
            if let Err(error) = self.tend() {
                tracing::debug!(
                    error,
                    lease = self.options.name,
                    "the log of the lease cannot be read yet"
                );
            }
            let pause = if self.link.is_some() { TURN } else { AGAIN };
            match questions.recv_timeout(pause) {
                // Whoever asked has given up waiting, and asks again.
                Ok(Question::Hold { answer, .. }) if answer.is_closed() => {}
                Ok(Question::Hold { note, answer }) => {
                    let held = self.hold(note);
                    // Whoever asked may have given up waiting.
                    let _ = answer.send(held);
                }
                Ok(Question::Release(answer)) => {
                    self.release();
                    // Whoever asked may have given up waiting.
                    let _ = answer.send(());
                    return;
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    /// Reads what is new, from the beginning if need be.
    fn tend(&mut self) -> Result<(), String> {
        if self.link.is_none() {
            // Where it is there already, nobody need be able to make it.
            let made = self.make_topic();
            let place = (&self.topic, &*self.options.name, &*self.options.group);
            match Link::open(&self.settings, &self.last_error, place, self.patience) {
                Ok(link) => self.link = Some(link),
                Err(error) => {
                    // It may have been taken away.
                    self.is_made = false;
                    made?;
                    return Err(self.last_error.take().unwrap_or_else(|| error.to_string()));
                }
            }
        }
        self.with_link(|link, _| link.read(None, Instant::now()).map(|_| ()))
            .map(|_| ())
    }

    /// After a fault of the log it is read anew.
    fn with_link<T>(
        &mut self,
        act: impl FnOnce(&mut Link, &LogLeaseOptions) -> Result<T, Broken>,
    ) -> Result<T, String> {
        let Some(link) = &mut self.link else {
            let why = self.last_error.take();
            return Err(why.unwrap_or_else(|| "the log of the lease is not read yet".to_owned()));
        };
        let broken = match act(link, &self.options) {
            Ok(done) => return Ok(done),
            Err(broken) => broken,
        };
        self.not_before = self.not_before.max(link.ledger().ends());
        // The topic may have been taken away.
        (self.link, self.held, self.is_made) = (None, None, false);
        Err(broken.to_string())
    }

    fn make_topic(&mut self) -> Result<(), String> {
        if self.is_made {
            return Ok(());
        }
        let away = |error: KafkaError| self.last_error.take().unwrap_or_else(|| error.to_string());
        let admin = Admin::new(&self.settings, &self.last_error).map_err(away)?;
        let refused = admin.make(&[(Arc::clone(&self.topic), Purpose::Terms)]).map_err(away)?;
        for (topic, code) in refused {
            match code {
                // Somebody with more rights may have made it.
                RDKafkaErrorCode::TopicAuthorizationFailed | RDKafkaErrorCode::ClusterAuthorizationFailed => {
                    if !std::mem::replace(&mut self.is_warned, true) {
                        tracing::warn!(%topic, %code, "the topic of the lease must be made by an administrator, as the documentation of the worker says");
                    }
                }
                _ => return Err(format!("the topic {topic} could not be made: {code}")),
            }
        }
        self.is_made = true;
        Ok(())
    }

    fn hold(&mut self, note: Option<String>) -> Result<LogHeld, String> {
        let (now, before) = (Instant::now(), self.held);
        let deadline = now + self.patience;
        let is_too_early = self.not_before.is_some_and(|until| now < until);
        let held = self.with_link(|link, options| {
            if !link.read(None, deadline)? {
                return Ok(Err("the log of the lease was not read to its end yet".to_owned()));
            }
            let left = link.ledger().note().map(str::to_owned);
            let (term, act, note) = match link.ledger().step(&options.owner, now) {
                Step::Renew(term) if before == Some(term) => (term, Act::Renew, note.or(left)),
                // Whoever had it before may have left something that is not to be lost.
                Step::Renew(term) => (term, Act::Renew, left),
                Step::Claim { term, act } if !is_too_early => (term, act, left),
                Step::Claim { .. } | Step::Wait => return Ok(Ok(None)),
            };
            if act != Act::Renew {
                let claimed = link.write(&options.entry(term, act, note.clone()), deadline)?;
                let is_own = claimed.map(|offset| link.ledger().own_term(&options.owner) == Some((term, offset)));
                if is_own != Ok(true) {
                    link.forget_claim(&options.owner);
                    return Ok(is_own.map(|_| None));
                }
            }
            // It is held by whoever has gone on with it: of that the log keeps the last record.
            let written = link.write(&options.entry(term, Act::Renew, note), deadline)?;
            Ok(written.map(|offset| {
                // One that was given up may have come after it.
                let own = link.ledger().own_term(&options.owner);
                let is_held = own.is_some_and(|(own, last)| own == term && last >= offset);
                if act != Act::Renew {
                    link.forget_claim(&options.owner);
                }
                if is_held {
                    link.show_position();
                }
                is_held.then_some(term)
            }))
        })??;
        self.held = held;
        let note = self
            .link
            .as_mut()
            .and_then(|link| link.ledger().note().map(str::to_owned));
        Ok(LogHeld {
            is_held: held.is_some(),
            note,
        })
    }

    fn release(&mut self) {
        let deadline = Instant::now() + self.patience;
        let released = self.with_link(|link, options| {
            let note = link.ledger().note().map(str::to_owned);
            let Some((term, _)) = link.ledger().own_term(&options.owner) else {
                return Ok(Ok(0));
            };
            link.write(&options.entry(term, Act::Release, note), deadline)
        });
        if let Err(error) | Ok(Err(error)) = released {
            tracing::debug!(
                error,
                lease = self.options.name,
                "the lease was not given up; it runs out"
            );
        }
    }
}
