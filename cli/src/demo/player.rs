//! Plays recordings at their recorded pace, from a thread of its own.
//!
//! ```text
//! Schedule ──► wait until due ──► payload (JPEG: from the decoder thread, a few pictures ahead) ──► sink
//! ```

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::{Condvar, Mutex};

use super::camera::{self, CameraError, Pictures};
use super::recording::{Body, Recording};
use super::schedule::{Due, Schedule};

/// Pictures that are decoded before they are due.
const PICTURES_AHEAD: usize = 4;

/// Time as the player sees it.
pub trait Clock {
    /// Time since playing began.
    fn now(&self) -> Duration;

    /// Waits until then; at once if that has passed. Returns whether to go on.
    fn wait_until(&mut self, at: Duration) -> bool;
}

/// A message that is published now.
#[derive(Debug, Clone)]
pub struct Played {
    /// Index of the recording.
    pub recording: usize,
    /// Index of the topic in it.
    pub topic: usize,
    /// What to publish.
    pub payload: Bytes,
}

/// How well the pace was kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PlayerReport {
    /// Messages handed to the sink.
    pub played: u64,
    /// Pictures that did not decode.
    pub unusable: u64,
    /// Messages more than 10 ms late.
    pub late: u64,
    /// Largest lateness.
    pub worst: Duration,
}

impl PlayerReport {
    const LATE: Duration = Duration::from_millis(10);

    fn note(&mut self, lateness: Duration) {
        self.played += 1;
        self.worst = self.worst.max(lateness);
        if lateness > Self::LATE {
            self.late += 1;
        }
    }
}

/// Plays until the clock says stop. `pictures` gives the JPEG messages of the schedule, decoded, in
/// its order.
pub fn play(
    schedule: Schedule,
    clock: &mut impl Clock,
    mut pictures: impl FnMut() -> Option<Result<Bytes, CameraError>>,
    mut sink: impl FnMut(Played),
) -> PlayerReport {
    let mut report = PlayerReport::default();
    let lookup = schedule.clone();
    for due in schedule {
        let Some(message) = lookup.message(&due) else { break };
        if !clock.wait_until(due.at) {
            break;
        }
        let payload = match &message.body {
            Body::Ready(bytes) => bytes.clone(),
            Body::Jpeg(_) => match pictures() {
                Some(Ok(bytes)) => bytes,
                Some(Err(_)) => {
                    report.unusable += 1;
                    continue;
                }
                None => break,
            },
        };
        report.note(clock.now().saturating_sub(due.at));
        sink(Played { recording: due.recording, topic: message.topic, payload });
    }
    report
}

/// A player that runs. Dropping it stops it.
pub struct Player {
    stop: Arc<StopSignal>,
    thread: Option<JoinHandle<PlayerReport>>,
}

#[derive(Default)]
struct StopSignal {
    stopped: Mutex<bool>,
    changed: Condvar,
}

struct WallClock {
    start: Instant,
    stop: Arc<StopSignal>,
}

impl Clock for WallClock {
    fn now(&self) -> Duration {
        self.start.elapsed()
    }

    fn wait_until(&mut self, at: Duration) -> bool {
        let deadline = self.start + at;
        let mut stopped = self.stop.stopped.lock();
        while !*stopped && Instant::now() < deadline {
            self.stop.changed.wait_until(&mut stopped, deadline);
        }
        !*stopped
    }
}

impl Player {
    /// Starts playing; `sink` is called on the player's thread and should not wait.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(
        recordings: &[Arc<Recording>],
        sink: impl FnMut(Played) + Send + 'static,
    ) -> std::io::Result<Self> {
        let stop = Arc::new(StopSignal::default());
        let schedule = Schedule::new(recordings);
        let pictures = start_decoder(recordings)?;
        let mut clock = WallClock { start: Instant::now(), stop: Arc::clone(&stop) };
        let thread = std::thread::Builder::new()
            .name("player".to_owned())
            .spawn(move || play(schedule, &mut clock, || pictures.as_ref()?.recv().ok(), sink))?;
        Ok(Self { stop, thread: Some(thread) })
    }

    /// Stops after the message that is being published, and says how it went.
    #[must_use]
    pub fn stop(mut self) -> PlayerReport {
        self.signal();
        self.thread.take().and_then(|thread| thread.join().ok()).unwrap_or_default()
    }

    fn signal(&self) {
        *self.stop.stopped.lock() = true;
        self.stop.changed.notify_all();
    }
}

impl Drop for Player {
    fn drop(&mut self) {
        self.signal();
    }
}

/// Starts the thread that decodes what stayed JPEG, if anything did. It ends when the player has
/// gone.
fn start_decoder(
    recordings: &[Arc<Recording>],
) -> std::io::Result<Option<Receiver<Result<Bytes, CameraError>>>> {
    let is_jpeg = |recording: &Arc<Recording>| {
        let mut messages = recording.messages.iter();
        messages.any(|message| matches!(message.body, Body::Jpeg(_)))
    };
    if !recordings.iter().any(is_jpeg) {
        return Ok(None);
    }
    let (sender, receiver) = sync_channel(PICTURES_AHEAD);
    let schedule = Schedule::new(recordings);
    let pictures: Vec<_> = recordings.iter().map(|recording| recording.pictures).collect();
    std::thread::Builder::new()
        .name("picture-decoder".to_owned())
        .spawn(move || decode_ahead(schedule, &pictures, &sender))?;
    Ok(Some(receiver))
}

fn decode_ahead(
    schedule: Schedule,
    pictures: &[Pictures],
    sender: &SyncSender<Result<Bytes, CameraError>>,
) {
    let lookup = schedule.clone();
    for due in schedule {
        let due: Due = due;
        let Some(message) = lookup.message(&due) else { return };
        let form = pictures.get(due.recording).copied().unwrap_or_default();
        if let Body::Jpeg(jpeg) = &message.body
            && sender.send(camera::decode(jpeg, form)).is_err()
        {
            return;
        }
    }
}

#[cfg(test)]
#[path = "player_tests.rs"]
mod tests;
