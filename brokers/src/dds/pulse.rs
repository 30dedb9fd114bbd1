//! Whether a participant still works, seen from outside.

use std::net::{Ipv4Addr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::task::{Wake, Waker};
use std::time::{Duration, Instant, SystemTime};

use super::nudge::Nudge;
use super::participant::RawReader;
use super::{DdsError, FRAME_TYPE, Participant, Profile, Writer, create_error};

/// Time between two beats.
const BEAT: Duration = Duration::from_millis(400);
/// An event loop that did not answer for this long hangs.
const HANG: Duration = Duration::from_millis(1500);
/// After such a pause between two looks silence says nothing: this whole process may have stood
/// still.
const STALL: Duration = Duration::from_millis(800);
/// RustDDS orders best-effort samples by the time of day, and delivers none until a clock that was
/// set back has caught up; less than this is waited for.
const CLOCK_STEP: Duration = Duration::from_millis(500);

/// Why a participant must be replaced.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Illness {
    /// A thread of RustDDS or of a reader has ended, or stands still.
    #[error("a thread of RustDDS ended or stands still")]
    Stopped,
    /// The event loop does not answer.
    #[error("the event loop of RustDDS hangs")]
    Hangs,
    /// The time of day was set back.
    #[error("the clock was set back, so that RustDDS holds samples back")]
    ClockSetBack,
}

/// Feels whether a participant lives: it writes to a reader of the same participant, whose waker
/// the event loop then calls. Nothing of this depends on the network. Each look also lets it read
/// announcements on.
pub struct Pulse {
    writer: Writer,
    reader: RawReader,
    nudge: Nudge,
    answers: Arc<AtomicU64>,
    seen: u64,
    last_beat: Option<Instant>,
    /// `None` until the first answer, as writer and reader must find each other.
    last_answer: Option<Instant>,
    last_look: Instant,
    time_of_day: SystemTime,
}

struct Count(Arc<AtomicU64>);

impl Wake for Count {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

impl Pulse {
    /// Prepares it.
    ///
    /// # Errors
    /// [`DdsError`] when RustDDS refuses or has died.
    pub fn start(participant: &Participant) -> Result<Self, DdsError> {
        let topic = format!("blaze/pulse/{}", participant.prefix());
        let profile = Profile::best_effort(1);
        Ok(Self {
            reader: participant.raw_reader((&topic, FRAME_TYPE), profile)?,
            writer: participant.writer(&topic, profile)?,
            nudge: Nudge::new(participant).map_err(create_error("socket"))?,
            answers: Arc::default(),
            seen: 0,
            last_beat: None,
            last_answer: None,
            last_look: Instant::now(),
            time_of_day: SystemTime::now(),
        })
    }

    /// Looks at the participant; call it several times a second. A panic is seen at the next look,
    /// a standstill within 1.5 s.
    ///
    /// # Errors
    /// [`Illness`]: the participant must be replaced.
    pub fn feel(&mut self, participant: &Participant) -> Result<(), Illness> {
        let now = Instant::now();
        let passed = now.duration_since(self.last_look);
        self.last_look = now;
        if !participant.is_alive() {
            return Err(Illness::Stopped);
        }
        self.check_clock(passed)?;
        self.nudge.give();
        let answers = self.answers.load(Ordering::Relaxed);
        if answers != self.seen || (passed > STALL && self.last_answer.is_some()) {
            self.seen = answers;
            self.last_answer = Some(now);
        }
        if self.last_beat.is_none_or(|at| now.duration_since(at) >= BEAT) {
            self.last_beat = Some(now);
            self.reader.set_waker(Some(Waker::from(Arc::new(Count(Arc::clone(&self.answers))))));
            self.writer.write(b"?");
        }
        match self.last_answer {
            Some(at) if now.duration_since(at) > HANG => Err(Illness::Hangs),
            _ => Ok(()),
        }
    }

    /// Whether the participant ever answered, so that a later silence will be noticed.
    #[must_use]
    pub fn is_felt(&self) -> bool {
        self.last_answer.is_some()
    }

    fn check_clock(&mut self, passed: Duration) -> Result<(), Illness> {
        let time_of_day = SystemTime::now();
        let expected = self.time_of_day + passed;
        self.time_of_day = time_of_day;
        match expected.duration_since(time_of_day) {
            Ok(back) if back > CLOCK_STEP => Err(Illness::ClockSetBack),
            _ => Ok(()),
        }
    }
}

/// Whether nobody holds a UDP port. The event loop owns its sockets: when it has unwound, its ports
/// are free.
pub(super) fn port_is_free(port: u16) -> bool {
    UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok()
}
