//! A lease as membership of a consumer group: the member that has the one partition of a topic has
//! the lease.
//!
//! ```text
//! hold(note) ─► thread ─► assigned? no: what was committed last ─► not held
//!                 │            └─ yes: commit the note with a new number, read it back
//!                 │                      ├─ the same number: held, from before the commit
//!                 │                      └─ another one, and still assigned: nobody knows
//!                 └─► polls on in between; leaves the group when nobody asks any more
//! ```
//!
//! The coordinator takes a commit only from a member of the present generation, and counts it as a
//! heartbeat. So after a commit the partition stays for the session timeout, which is longer than
//! the lease is held; the assignor is cooperative and sticky, so a member that joins or leaves
//! takes it from nobody. Where it is taken nevertheless, the client gives it back only when the
//! lease that was told is over. The topic stays empty: the note is the metadata of the committed
//! offset.
//!
//! The commit is not waited for but read back, since the client waits for a commit without limit
//! while the group changes, and the group may wait for this thread.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::time::{Duration, Instant};

use blaze_domain::node_file::KafkaBroker as Section;
use blaze_runtime::supervisor::{Supervisor, TaskPolicy};
use parking_lot::Mutex;
use rdkafka::config::RDKafkaLogLevel;
use rdkafka::consumer::{BaseConsumer, CommitMode, Consumer as _, ConsumerContext, Rebalance};
use rdkafka::error::{KafkaError, KafkaResult, RDKafkaErrorCode};
use rdkafka::{ClientContext, Offset, TopicPartitionList};
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;

use super::admin::{Admin, Purpose};
use super::context::{self, LastError};
use super::settings::Settings;
use crate::open::OpenError;
use crate::worker_side::Held;

/// Between two looks at the group, while nobody asks.
const TURN: Duration = Duration::from_millis(50);
/// Between two tries to reach the broker.
const AGAIN: Duration = Duration::from_millis(250);
/// How long the coordinator waits for a member that says nothing, at least.
const SESSION: Duration = Duration::from_secs(10);
/// Bounds of the time that the broker has for an answer.
const PATIENCE: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(5));
/// Questions that wait for the thread.
const QUEUE: usize = 4;
/// The partition that is the lease.
const PARTITION: i32 = 0;
const GIVEN_UP: &str = "the lease was given up";

/// Which lease.
#[derive(Debug, Clone)]
pub struct GroupLeaseOptions {
    /// The channel whose topic has the partition.
    pub channel: &'static str,
    /// The group.
    pub group: String,
    /// How long it is held after it was asked for.
    pub time: Duration,
}

enum Question {
    Hold { note: Option<String>, answer: oneshot::Sender<Result<Held, String>> },
    Release(oneshot::Sender<()>),
}

/// A member that wants the lease. Dropped without [`GroupLease::release`], it leaves the group as
/// well.
pub struct GroupLease {
    questions: SyncSender<Question>,
    stop: CancellationToken,
    /// Of the thread, which ends with `stop`.
    _supervisor: Supervisor,
}

impl GroupLease {
    /// Begins to connect, in the background; makes the topic if there is none. Must be called on a
    /// Tokio runtime.
    ///
    /// # Errors
    /// [`OpenError`] as for a broker of this section.
    pub fn open(section: &Section, options: GroupLeaseOptions) -> Result<Self, OpenError> {
        let (settings, names) = super::read(section)?;
        let (questions, asked) = sync_channel(QUEUE);
        let (stop, supervisor) = (CancellationToken::new(), Supervisor::new("kafka-lease"));
        let member = Member {
            settings,
            topic: names.reserved(options.channel),
            patience: (options.time / 4).clamp(PATIENCE.0, PATIENCE.1),
            options,
            last_error: Arc::default(),
            stop: stop.clone(),
            is_warned: false,
            secrets: 0,
            consumer: None,
            asked: None,
            is_held: false,
            note: None,
            number: rand::random(),
        };
        supervisor
            .spawn_thread("kafka-lease", TaskPolicy::MayEnd, move || member.run(&asked))
            .map_err(|error| OpenError::Setting {
                key: "kafka".to_owned(),
                reason: error.to_string(),
            })?;
        Ok(Self { questions, stop, _supervisor: supervisor })
    }

    /// Asks whether this member has the lease, for its time from before the call. A member that had
    /// it at the last call, too, leaves `note`; one that has got it since does not, and learns what
    /// the one before has left.
    ///
    /// # Errors
    /// For people: nobody knows.
    pub async fn hold(&self, note: Option<&str>) -> Result<Held, String> {
        let (answer, answered) = oneshot::channel();
        let question = Question::Hold { note: note.map(str::to_owned), answer };
        self.questions.try_send(question).map_err(|error| match error {
            TrySendError::Full(_) => {
                "the broker has not answered the last questions yet".to_owned()
            }
            TrySendError::Disconnected(_) => GIVEN_UP.to_owned(),
        })?;
        answered.await.unwrap_or_else(|_| Err(GIVEN_UP.to_owned()))
    }

    /// Leaves the group, so that another member has it at once; it is not asked for again. The
    /// caller no longer acts as the owner.
    pub async fn release(&self) {
        // Before the question, which the thread does not see while it waits for the end of the
        // lease.
        self.stop.cancel();
        let (answer, answered) = oneshot::channel();
        if self.questions.try_send(Question::Release(answer)).is_ok() {
            // If the thread has ended, it has left the group.
            let _ = answered.await;
        }
    }
}

impl Drop for GroupLease {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

/// What the client calls back with, on the thread that polls.
struct Context {
    last_error: Arc<LastError>,
    /// Until then the lease was told to be held.
    promised: Mutex<Option<Instant>>,
    /// Why it is no member of the group; `None` once the group has taken it in.
    trouble: Mutex<Option<String>>,
    stop: CancellationToken,
}

impl Context {
    /// Waits until the lease that was told is over, or its owner has stopped.
    fn wait_until_over(&self) {
        let Some(until) = self.promised.lock().take() else {
            return;
        };
        while !self.stop.is_cancelled() {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            std::thread::sleep(left.min(TURN));
        }
    }
}

impl ClientContext for Context {
    fn log(&self, level: RDKafkaLogLevel, facility: &str, line: &str) {
        context::log(level, facility, line);
    }

    fn error(&self, error: KafkaError, reason: &str) {
        self.last_error.note_event(&error, reason);
    }
}

impl ConsumerContext for Context {
    fn pre_rebalance(&self, _consumer: &BaseConsumer<Self>, rebalance: &Rebalance<'_>) {
        match rebalance {
            // Also where it gets no partition.
            Rebalance::Assign(_) => *self.trouble.lock() = None,
            // Until this returns, nobody else gets the partition.
            Rebalance::Revoke(_) => self.wait_until_over(),
            Rebalance::Error(_) => {}
        }
    }
}

/// What the thread owns.
struct Member {
    settings: Settings,
    topic: Arc<str>,
    options: GroupLeaseOptions,
    patience: Duration,
    last_error: Arc<LastError>,
    stop: CancellationToken,
    /// A refusal was logged since the lease was last held.
    is_warned: bool,
    /// [`Settings::secrets`] that the consumer was made with.
    secrets: u64,
    consumer: Option<BaseConsumer<Context>>,
    /// When the last question was dealt with.
    asked: Option<Instant>,
    /// Whether it was held at the last call.
    is_held: bool,
    /// The last note that is known.
    note: Option<String>,
    /// Of the last commit. No other member has it.
    number: u64,
}

impl Member {
    fn run(mut self, questions: &Receiver<Question>) {
        while !self.stop.is_cancelled() {
            let question =
                questions.recv_timeout(if self.consumer.is_some() { TURN } else { AGAIN });
            match question {
                // Whoever asked has given up waiting, and asks again.
                Ok(Question::Hold { answer, .. }) if answer.is_closed() => {
                    self.asked = Some(Instant::now());
                }
                Ok(Question::Hold { note, answer }) => {
                    let held = self.hold(note);
                    self.is_held = held.as_ref().is_ok_and(|held| held.is_held);
                    self.asked = Some(Instant::now());
                    // Whoever asked may have given up waiting.
                    let _ = answer.send(held);
                }
                Ok(Question::Release(answer)) => {
                    self.leave();
                    // Whoever asked may have given up waiting.
                    let _ = answer.send(());
                    return;
                }
                // The client stays a member by itself, whatever becomes of the one who asks.
                Err(RecvTimeoutError::Timeout)
                    if self.asked.is_some_and(|at| at.elapsed() > self.options.time) =>
                {
                    self.leave();
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            self.poll();
        }
        self.leave();
    }

    /// Leaves the group once the lease that was told is over; whoever asks joins it again.
    fn leave(&mut self) {
        if let Some(consumer) = self.consumer.take() {
            consumer.context().wait_until_over();
            consumer.unsubscribe();
        }
        (self.asked, self.is_held) = (None, false);
    }

    fn join(&mut self) -> Result<(), String> {
        // Where the topic is there already, nobody need be able to make it.
        let trouble = self.make_topic().err();
        let session = SESSION.max(self.options.time);
        let context = Context {
            last_error: Arc::clone(&self.last_error),
            promised: Mutex::default(),
            trouble: Mutex::new(trouble),
            stop: self.stop.clone(),
        };
        let away = |error: KafkaError| error.to_string();
        self.secrets = self.settings.secrets();
        let config = self.settings.lease_member(&self.options.group, session);
        let consumer: BaseConsumer<Context> = config.create_with_context(context).map_err(away)?;
        consumer.subscribe(&[&self.topic]).map_err(away)?;
        self.consumer = Some(consumer);
        Ok(())
    }

    fn make_topic(&self) -> Result<(), String> {
        let away = |error: KafkaError| self.last_error.take().unwrap_or_else(|| error.to_string());
        let admin = Admin::new(&self.settings, &self.last_error).map_err(away)?;
        let refused = admin.make(&[(Arc::clone(&self.topic), Purpose::Notices)]).map_err(away)?;
        refused.first().map_or(Ok(()), |(topic, code)| {
            Err(format!("the topic {topic} could not be made, so an administrator has to: {code}"))
        })
    }

    /// Has the client call back.
    fn poll(&mut self) {
        let Some(consumer) = &self.consumer else { return };
        let mut is_gone = consumer.client().fatal_error().is_some();
        while let Some(polled) = consumer.poll(Duration::ZERO) {
            let Err(error) = polled else { continue };
            tracing::debug!(%error, topic = %self.topic, "the group of the lease");
            let mut trouble = consumer.context().trouble.lock();
            if is_topic_gone(&error) {
                is_gone = true;
            } else if is_refusal(&error) {
                *trouble = Some(error.to_string());
            } else {
                continue;
            }
            // A topic that is not there is no trouble where it can be made.
            if let Some(why) = &*trouble
                && !std::mem::replace(&mut self.is_warned, true)
            {
                tracing::warn!(topic = %self.topic, why, "the lease cannot be had");
            }
        }
        if is_gone {
            // Joined anew, it makes the topic.
            self.leave();
        }
    }

    fn hold(&mut self, note: Option<String>) -> Result<Held, String> {
        let now = Instant::now();
        if self.consumer.is_none() {
            self.join()?;
        }
        self.poll();
        let Some(consumer) = self.consumer.take() else {
            return Err("the group of the lease is joined anew".to_owned());
        };
        let held = self.ask(&consumer, note, now);
        let is_gone = held.as_ref().is_err_and(is_topic_gone);
        let trouble = consumer.context().trouble.lock().clone();
        // A server that refuses a password wants the present one.
        let is_over = consumer.context().promised.lock().is_none_or(|until| until <= now);
        let is_refused = held.is_err() && is_over && self.settings.secrets() != self.secrets;
        self.consumer = Some(consumer);
        if is_gone || is_refused {
            self.leave();
        }
        let held = held.map_err(|error| error.to_string());
        let is_held = held.as_ref().is_ok_and(|held| held.is_held);
        trouble.filter(|_| !is_held).map_or(held, Err)
    }

    fn ask(
        &mut self,
        consumer: &BaseConsumer<Context>,
        note: Option<String>,
        now: Instant,
    ) -> KafkaResult<Held> {
        let is_own = || {
            let assigned = consumer.assignment();
            let is_assigned = assigned
                .is_ok_and(|assigned| assigned.find_partition(&self.topic, PARTITION).is_some());
            is_assigned && !consumer.assignment_lost()
        };
        let is_assigned = is_own();
        // A member that has just got the partition leaves what the one before has left.
        let note = match is_assigned && self.is_held {
            true => note,
            false => committed(consumer, &self.topic, self.patience)?.1,
        };
        self.note = note.or(self.note.take());
        let is_held = is_assigned && {
            self.number = self.number.wrapping_add(1);
            let position = position(&self.topic, Some((self.number, self.note.as_deref())))?;
            consumer.commit(&position, CommitMode::Async)?;
            // The coordinator answers in the order of the requests.
            let (number, _) = committed(consumer, &self.topic, self.patience)?;
            let is_own = is_own();
            // A coordinator takes no commit from its members while another one joins them, and the
            // one that has the partition keeps it.
            if is_own && number != Some(self.number) {
                return Err(KafkaError::ConsumerCommit(RDKafkaErrorCode::RebalanceInProgress));
            }
            is_own
        };
        if is_held {
            self.is_warned = false;
            *consumer.context().promised.lock() = Some(now + self.options.time);
        }
        Ok(Held { is_held, note: self.note.clone() })
    }
}

fn is_topic_gone(error: &KafkaError) -> bool {
    matches!(
        error.rdkafka_error_code(),
        Some(
            RDKafkaErrorCode::UnknownTopicOrPartition
                | RDKafkaErrorCode::UnknownTopic
                | RDKafkaErrorCode::UnknownPartition
        )
    )
}

/// Whether a server said no; the other errors are of connections, which the client makes again.
fn is_refusal(error: &KafkaError) -> bool {
    error.rdkafka_error_code().is_some_and(|code| code as i32 > 0)
}

/// The partition with the number of a commit and its note.
fn position(topic: &str, commit: Option<(u64, Option<&str>)>) -> KafkaResult<TopicPartitionList> {
    let mut list = TopicPartitionList::new();
    list.add_partition_offset(topic, PARTITION, Offset::Offset(0))?;
    if let (Some((number, note)), Some(mut partition)) =
        (commit, list.find_partition(topic, PARTITION))
    {
        partition.set_metadata(format!("{number:016x} {}", note.unwrap_or_default()));
    }
    Ok(list)
}

/// The number and the note of the last commit.
fn committed(
    consumer: &BaseConsumer<Context>,
    topic: &str,
    patience: Duration,
) -> KafkaResult<(Option<u64>, Option<String>)> {
    let found = consumer.committed_offsets(position(topic, None)?, patience)?;
    let Some(partition) = found.find_partition(topic, PARTITION) else {
        return Ok((None, None));
    };
    partition.error()?;
    let Some((number, note)) = partition.metadata().split_once(' ') else {
        return Ok((None, None));
    };
    let note = Some(note.to_owned()).filter(|note| !note.is_empty());
    Ok((u64::from_str_radix(number, 16).ok(), note))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rdkafka::ClientConfig;

    /// The client gives the partition back when the callback returns.
    #[test]
    fn a_partition_is_given_back_only_when_the_lease_that_was_told_is_over() {
        let until = Instant::now() + Duration::from_millis(300);
        let context = Context {
            last_error: Arc::default(),
            promised: Mutex::new(Some(until)),
            trouble: Mutex::default(),
            stop: CancellationToken::new(),
        };
        let mut config = ClientConfig::new();
        // Nobody listens there: the client never joins.
        config.set("bootstrap.servers", "127.0.0.1:9").set("group.id", "lease");
        let consumer: BaseConsumer<Context> = config.create_with_context(context).unwrap();
        let (context, partitions) = (Arc::clone(consumer.context()), TopicPartitionList::new());
        context.pre_rebalance(&consumer, &Rebalance::Assign(&partitions));
        assert_eq!(*context.promised.lock(), Some(until), "getting more takes nothing away");
        context.pre_rebalance(&consumer, &Rebalance::Revoke(&partitions));
        assert!(Instant::now() >= until);
        assert_eq!(*context.promised.lock(), None, "waited for once");
    }
}
