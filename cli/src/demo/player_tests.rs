use std::path::PathBuf;
use std::sync::mpsc::sync_channel;

use super::*;
use crate::demo::recording::RecordedMessage;

fn recording(offsets_ms: &[u64], period_ms: u64) -> Arc<Recording> {
    let messages = offsets_ms.iter().enumerate().map(|(index, offset)| RecordedMessage {
        topic: 0,
        offset: Duration::from_millis(*offset),
        body: Body::Ready(Bytes::from(vec![index as u8])),
    });
    Arc::new(Recording {
        path: PathBuf::new(),
        topics: Vec::new(),
        messages: messages.collect(),
        period: Duration::from_millis(period_ms),
        skipped: Vec::new(),
        unusable_messages: 0,
        cut: None,
        shortened: (0, Duration::ZERO),
        pictures: Pictures::Rgb,
    })
}

fn milliseconds(count: u64) -> Duration {
    Duration::from_millis(count)
}

/// Waits take no real time; now and then one takes longer than asked.
struct FakeClock {
    now: Duration,
    end: Duration,
    oversleep: Vec<(Duration, Duration)>,
}

impl Clock for FakeClock {
    fn now(&self) -> Duration {
        self.now
    }

    fn wait_until(&mut self, at: Duration) -> bool {
        self.now = self.now.max(at);
        if let Some(place) = self.oversleep.iter().position(|(from, _)| *from <= self.now) {
            self.now += self.oversleep.remove(place).1;
        }
        self.now < self.end
    }
}

fn no_pictures() -> Option<Result<Bytes, CameraError>> {
    None
}

#[test]
fn recordings_loop_each_for_itself() {
    let schedule = Schedule::new(&[recording(&[0, 10], 20), recording(&[0], 15)]);
    let due: Vec<(u64, usize, usize)> = schedule
        .take(7)
        .map(|due| (due.at.as_millis() as u64, due.recording, due.message))
        .collect();
    assert_eq!(
        due,
        [(0, 0, 0), (0, 1, 0), (10, 0, 1), (15, 1, 0), (20, 0, 0), (30, 0, 1), (30, 1, 0)]
    );
}

#[test]
fn nothing_to_play_ends() {
    assert_eq!(Schedule::new(&[]).next(), None);
}

#[test]
fn the_schedule_does_not_drift() {
    let mut last = Duration::ZERO;
    for due in Schedule::new(&[recording(&[0, 7], 33)]).take(2_000_000) {
        last = due.at;
    }
    assert_eq!(last, milliseconds(33) * 999_999 + milliseconds(7));
}

#[test]
fn lateness_is_caught_up_and_reported() {
    let mut clock = FakeClock {
        now: Duration::ZERO,
        end: milliseconds(1_000),
        oversleep: vec![(milliseconds(100), milliseconds(55))],
    };
    let mut seen = Vec::new();
    let report = play(Schedule::new(&[recording(&[0], 20)]), &mut clock, no_pictures, |played| {
        seen.push(played.payload);
    });
    // 0, 20, … 980: none is left out, though those due at 100, 120 and 140 came at 155.
    assert_eq!((report.played, seen.len()), (50, 50));
    assert_eq!(report.worst, milliseconds(55));
    assert_eq!(report.late, 3);
}

#[test]
fn pictures_come_from_the_decoder_in_order() {
    let mut mixed = (*recording(&[0, 10, 20], 30)).clone();
    mixed.messages[1].body = Body::Jpeg(Bytes::from_static(b"one"));
    mixed.messages[2].body = Body::Jpeg(Bytes::from_static(b"two"));
    let mut decoded =
        vec![Err(CameraError::Jpeg("broken".to_owned())), Ok(Bytes::from_static(b"picture"))];
    let mut clock = FakeClock { now: Duration::ZERO, end: milliseconds(40), oversleep: Vec::new() };
    let mut seen = Vec::new();
    let report = play(
        Schedule::new(&[Arc::new(mixed)]),
        &mut clock,
        || decoded.pop(),
        |played| seen.push(played.payload),
    );
    assert_eq!((report.played, report.unusable), (3, 1));
    assert_eq!(seen, [&b"\0"[..], b"picture", b"\0"]);
}

#[test]
fn a_player_stops_at_once() {
    let (sender, receiver) = sync_channel(10);
    let player = Player::start(&[recording(&[0, 3_600_000], 7_200_000)], move |played| {
        let _ = sender.send(played.payload);
    })
    .unwrap();
    assert_eq!(receiver.recv_timeout(Duration::from_secs(10)).unwrap(), Bytes::from_static(b"\0"));
    let before = Instant::now();
    assert_eq!(player.stop().played, 1);
    assert!(
        before.elapsed() < Duration::from_secs(10),
        "it waited for the message that is due in an hour"
    );
}
