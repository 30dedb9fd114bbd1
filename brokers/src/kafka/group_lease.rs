//! A lease as membership of a consumer group: whoever is assigned the one partition of a topic has it.
//!
//! ```text
//! hold(note) ─► thread ─► commit of offset 0 with the note, which the broker takes from the partition's member alone
//!                 │         yes ─► the member stays at least one session from then on
//!                 └─► polls: joins, rebalances, and is told what it has lost
//! ```
//!
//! A member that is dead or frozen is found so by the broker after its session; one that leaves makes way at once. Whoever
//! holds the lease may act until less than a session after it *asked*: an answer that the broker gave proves that it counted
//! the member as alive then, and so that nobody else gets the partition within a session from that instant. That a heartbeat
//! was sent proves nothing.
//!
//! The cooperative protocol leaves the partition where it is while members come and go. Brokers have a least session
//! (`group.min.session.timeout.ms`, 6 s unless set); where the wanted one is shorter, that is asked for.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use blaze_domain::node_file::KafkaBroker as Section;
use blaze_runtime::supervisor::{Supervisor, TaskPolicy};
use rdkafka::consumer::{BaseConsumer, CommitMode, Consumer as _};
use rdkafka::error::{KafkaError, RDKafkaErrorCode};
use rdkafka::topic_partition_list::{Offset, TopicPartitionList};
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;

use super::admin::{Admin, Purpose};
use super::context::LastError;
use super::group_member::{GroupContext, Seat};
use super::settings::Settings;
use crate::open::OpenError;

/// Between two looks at what the group says, while nobody asks.
const TURN: Duration = Duration::from_millis(50);
/// How long the broker has to tell the note.
const READ: Duration = Duration::from_secs(1);
/// Between two tries to make the topic.
const AGAIN: Duration = Duration::from_millis(500);
/// Sessions that are asked for, one after the other, where the broker refuses the one that is wanted: the first is the least
/// of a broker that is not told otherwise.
const SESSIONS: [Duration; 4] = [
    Duration::from_secs(6),
    Duration::from_secs(10),
    Duration::from_secs(30),
    Duration::from_secs(60),
];
/// Questions that wait for the thread.
const QUEUE: usize = 4;

/// What became of asking for the lease.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct GroupHeld {
    /// Whether this member has it.
    pub is_held: bool,
    /// What the last holder that left a note has left.
    pub note: Option<String>,
}

enum Question {
    Hold {
        note: Option<String>,
        answer: oneshot::Sender<Result<GroupHeld, String>>,
    },
    Release(oneshot::Sender<()>),
}

/// A member of a group that shares out one partition. It leaves when dropped.
pub struct GroupLease {
    questions: SyncSender<Question>,
    stop: CancellationToken,
    /// Of the thread, which ends with `stop`.
    _supervisor: Supervisor,
}

impl GroupLease {
    /// Begins to join, in the background; makes the topic, given as a channel, if there is none. A member that is not asked
    /// to hold the lease for a session leaves, and joins again when it is. Must be called on a Tokio runtime.
    ///
    /// # Errors
    /// [`OpenError`] as for a broker of this section.
    pub fn open(section: &Section, group: &str, channel: &str, session: Duration) -> Result<Self, OpenError> {
        let (settings, names) = super::read(section)?;
        let (questions, asked) = sync_channel(QUEUE);
        let (stop, supervisor) = (CancellationToken::new(), Supervisor::new("kafka-lease"));
        let worker = Worker {
            settings,
            group: group.to_owned(),
            topic: names.reserved(channel),
            session,
            last_error: Arc::default(),
            is_made: false,
            member: None,
            asked_at: Instant::now(),
            held: None,
            note: None,
            looked: None,
        };
        let stopped = stop.clone();
        supervisor
            .spawn_thread("kafka-lease", TaskPolicy::MayEnd, move || worker.run(&asked, &stopped))
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

    /// Asks the broker whether this member has the lease. Who had it at the last call, too, leaves `note`; who has got it
    /// since does not, and learns what the one before has left.
    ///
    /// # Errors
    /// For people: the broker does not say.
    pub async fn hold(&self, note: Option<&str>) -> Result<GroupHeld, String> {
        let (answer, answered) = oneshot::channel();
        let question = Question::Hold {
            note: note.map(str::to_owned),
            answer,
        };
        let busy = |_| "the broker has not answered the last question yet".to_owned();
        self.questions.try_send(question).map_err(busy)?;
        answered
            .await
            .unwrap_or_else(|_| Err("the member has left the group".to_owned()))
    }

    /// Leaves the group, so that another member has the lease at once; it is not joined again.
    pub async fn release(&self) {
        let (answer, answered) = oneshot::channel();
        if self.questions.try_send(Question::Release(answer)).is_ok() {
            // If the thread has ended, the group has been left.
            let _ = answered.await;
        }
        self.stop.cancel();
    }
}

impl Drop for GroupLease {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

/// What the thread owns.
struct Worker {
    settings: Settings,
    group: String,
    topic: Arc<str>,
    session: Duration,
    last_error: Arc<LastError>,
    is_made: bool,
    member: Option<BaseConsumer<GroupContext>>,
    /// When the lease was last asked for.
    asked_at: Instant,
    /// The seat in which it was held at the last call.
    held: Option<Seat>,
    note: Option<String>,
    /// When the note of others was last looked at.
    looked: Option<Instant>,
}

impl Worker {
    fn run(mut self, questions: &Receiver<Question>, stop: &CancellationToken) {
        while !stop.is_cancelled() {
            if let Err(error) = self.tend() {
                tracing::debug!(error, group = self.group, "the group cannot be joined yet");
                self.member = None;
            }
            match questions.recv_timeout(self.pause()) {
                // Whoever asked has given up waiting, and asks again.
                Ok(Question::Hold { answer, .. }) if answer.is_closed() => {}
                Ok(Question::Hold { note, answer }) => {
                    self.asked_at = Instant::now();
                    // Whoever asked may have given up waiting.
                    let _ = answer.send(self.hold(note));
                }
                Ok(Question::Release(answer)) => {
                    self.member = None;
                    // Whoever asked may have given up waiting.
                    let _ = answer.send(());
                    return;
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    fn pause(&self) -> Duration {
        if self.member.is_some() { TURN } else { AGAIN }
    }

    /// Joins if that is wanted, and hears what the group says.
    fn tend(&mut self) -> Result<(), String> {
        let is_wanted = self.asked_at.elapsed() < self.session;
        if !is_wanted && self.member.take().is_some() {
            tracing::warn!(group = self.group, "nobody asks for the lease, so the group is left");
        }
        if is_wanted && self.member.is_none() {
            self.make_topic()?;
            self.join()?;
        }
        self.listen()
    }

    fn make_topic(&mut self) -> Result<(), String> {
        if self.is_made {
            return Ok(());
        }
        let away = |error: KafkaError| self.last_error.take().unwrap_or_else(|| error.to_string());
        let admin = Admin::new(&self.settings, &self.last_error).map_err(away)?;
        let refused = admin
            .make(&[(Arc::clone(&self.topic), Purpose::LastValues)])
            .map_err(away)?;
        for (topic, code) in refused {
            match code {
                // Somebody with more rights may have made it.
                RDKafkaErrorCode::TopicAuthorizationFailed | RDKafkaErrorCode::ClusterAuthorizationFailed => {
                    tracing::warn!(%topic, %code, "the topic of the lease must be made by an administrator, with one partition");
                }
                _ => return Err(format!("the topic {topic} could not be made: {code}")),
            }
        }
        self.is_made = true;
        Ok(())
    }

    fn join(&mut self) -> Result<(), String> {
        let context = GroupContext::new(&self.topic, &self.last_error);
        let config = self.settings.group_member(&self.group, self.session);
        let member: BaseConsumer<GroupContext> = config.create_with_context(context).map_err(|e| e.to_string())?;
        member.subscribe(&[&self.topic]).map_err(|error| error.to_string())?;
        self.held = None;
        self.member = Some(member);
        Ok(())
    }

    /// Serves what waits: rebalances reach the context from here alone. After a fault the group is joined anew.
    fn listen(&mut self) -> Result<(), String> {
        let Some(member) = &self.member else { return Ok(()) };
        let (mut fault, mut is_too_short) = (None, false);
        while let Some(event) = member.poll(Duration::ZERO) {
            match event {
                // There are no records, and if there were they would say nothing.
                Ok(_) => {}
                Err(error) if error.rdkafka_error_code() == Some(RDKafkaErrorCode::InvalidSessionTimeout) => {
                    is_too_short = true;
                    break;
                }
                Err(error) if member.client().fatal_error().is_some() => {
                    fault = Some(format!("the client must begin anew: {error}"));
                    break;
                }
                Err(error) => tracing::debug!(%error, group = self.group, "the group says"),
            }
        }
        if is_too_short {
            fault = Some(self.ask_for_longer_session());
        }
        match fault {
            None => Ok(()),
            Some(fault) => {
                (self.member, self.held) = (None, None);
                Err(fault)
            }
        }
    }

    fn ask_for_longer_session(&mut self) -> String {
        let refused = self.session;
        match SESSIONS.into_iter().find(|session| *session > refused) {
            Some(longer) => {
                self.session = longer;
                tracing::warn!(
                    group = self.group,
                    refused_ms = refused.as_millis(),
                    session_ms = longer.as_millis(),
                    "the broker has a longer least session (group.min.session.timeout.ms): a takeover takes as long"
                );
                "a longer session is asked for".to_owned()
            }
            None => format!("the broker refuses a session of {} s", refused.as_secs()),
        }
    }

    fn hold(&mut self, note: Option<String>) -> Result<GroupHeld, String> {
        self.listen()?;
        let Some(member) = &self.member else {
            return Err(self
                .last_error
                .take()
                .unwrap_or_else(|| "the group is not joined yet".to_owned()));
        };
        let Some(seat) = member.context().seat() else {
            self.held = None;
            self.look_at_note();
            return Ok(self.answer(false));
        };
        if self.held == Some(seat) {
            self.note = note.or(self.note.take());
        } else {
            // Whoever had it before may have left something that was not seen yet, and that is not to be lost.
            self.note = self.read_note()?;
        }
        let commit = commit_of(&self.topic, self.note.as_deref()).map_err(|error| error.to_string())?;
        let Some(member) = &self.member else {
            return Ok(self.answer(false));
        };
        if let Err(error) = member.commit(&commit, CommitMode::Sync) {
            let is_out = matches!(
                error.rdkafka_error_code(),
                Some(
                    RDKafkaErrorCode::UnknownMemberId
                        | RDKafkaErrorCode::IllegalGeneration
                        | RDKafkaErrorCode::FencedInstanceId
                )
            );
            if !is_out {
                return Err(error.to_string());
            }
            self.held = None;
            return Ok(self.answer(false));
        }
        // It may have been lost meanwhile.
        self.listen()?;
        let is_held = self.member.as_ref().and_then(|member| member.context().seat()) == Some(seat);
        self.held = is_held.then_some(seat);
        Ok(self.answer(is_held))
    }

    fn answer(&self, is_held: bool) -> GroupHeld {
        GroupHeld {
            is_held,
            note: self.note.clone(),
        }
    }

    /// Whoever waits looks now and then: what it learns late it learns when it takes over.
    fn look_at_note(&mut self) {
        if self.looked.is_some_and(|looked| looked.elapsed() < self.session / 3) {
            return;
        }
        self.looked = Some(Instant::now());
        match self.read_note() {
            Ok(note) => self.note = note,
            Err(error) => tracing::debug!(error, group = self.group, "the note was not read"),
        }
    }

    fn read_note(&self) -> Result<Option<String>, String> {
        let Some(member) = &self.member else { return Ok(None) };
        let mut list = TopicPartitionList::new();
        list.add_partition(&self.topic, 0);
        let found = member
            .committed_offsets(list, READ)
            .map_err(|error| error.to_string())?;
        let note = found
            .find_partition(&self.topic, 0)
            .map(|found| found.metadata().to_owned());
        Ok(note.filter(|note| !note.is_empty()))
    }
}

/// Says nothing of what was read: the offset is always the first.
fn commit_of(topic: &str, note: Option<&str>) -> Result<TopicPartitionList, KafkaError> {
    let mut list = TopicPartitionList::new();
    list.add_partition_offset(topic, 0, Offset::Offset(0))?;
    if let (Some(note), Some(mut partition)) = (note, list.find_partition(topic, 0)) {
        partition.set_metadata(note);
    }
    Ok(list)
}
