//! When each recorded message is due: every recording loops for itself, all start at 0.

use std::sync::Arc;
use std::time::Duration;

use super::recording::{RecordedMessage, Recording};

/// One message that is due.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Due {
    /// When, from the start of playing.
    pub at: Duration,
    /// Index of its recording.
    pub recording: usize,
    /// Index of the message in it.
    pub message: usize,
}

/// All messages of all recordings in the order in which they are due, without end. Times are
/// absolute, so that lateness of one message delays no later one.
#[derive(Debug, Clone)]
pub struct Schedule {
    tracks: Vec<Track>,
}

#[derive(Debug, Clone)]
struct Track {
    recording: Arc<Recording>,
    loop_start: Duration,
    next: usize,
}

impl Schedule {
    /// A schedule that begins with the first messages.
    #[must_use]
    pub fn new(recordings: &[Arc<Recording>]) -> Self {
        let tracks = recordings
            .iter()
            .map(|recording| Track {
                recording: Arc::clone(recording),
                loop_start: Duration::ZERO,
                next: 0,
            })
            .collect();
        Self { tracks }
    }

    /// The message behind an entry.
    #[must_use]
    pub fn message(&self, due: &Due) -> Option<&RecordedMessage> {
        self.tracks.get(due.recording)?.recording.messages.get(due.message)
    }
}

impl Track {
    fn due(&self) -> Option<Duration> {
        let message = self.recording.messages.get(self.next)?;
        Some(self.loop_start + message.offset)
    }

    fn advance(&mut self) {
        self.next += 1;
        if self.next >= self.recording.messages.len() {
            self.next = 0;
            self.loop_start += self.recording.period;
        }
    }
}

impl Iterator for Schedule {
    type Item = Due;

    fn next(&mut self) -> Option<Due> {
        let (recording, at) = self
            .tracks
            .iter()
            .enumerate()
            .filter_map(|(index, track)| Some((index, track.due()?)))
            .min_by_key(|(_, at)| *at)?;
        let track = self.tracks.get_mut(recording)?;
        let message = track.next;
        track.advance();
        Some(Due { at, recording, message })
    }
}
