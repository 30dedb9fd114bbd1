//! One direction of a connection.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::{ReadHalf, WriteHalf};
use tokio::sync::watch;
use tokio::time::Instant;

use super::{Mode, Settings};

/// Read at a time.
const CHUNK: usize = 16 * 1024;
/// Held while it is delayed; then reading stops, and TCP holds up the sender.
const MAX_HELD: usize = 1024 * 1024;
/// A throttled direction writes so often.
const WRITES_PER_S: u64 = 50;

/// Moves bytes until the sender has ended and all was written.
pub(super) async fn pump(
    mut from: ReadHalf<'_>,
    mut to: WriteHalf<'_>,
    mut settings: watch::Receiver<Settings>,
    counter: &AtomicU64,
) -> std::io::Result<()> {
    let mut held = Held::default();
    let mut buffer = BytesMut::new();
    let mut ended = false;
    loop {
        let now = *settings.borrow_and_update();
        let flows = now.mode == Mode::Forward;
        buffer.reserve(CHUNK);
        tokio::select! {
            changed = settings.changed() => if changed.is_err() {
                // The proxy ends.
                return Ok(());
            },
            read = from.read_buf(&mut buffer), if flows && !ended && held.bytes < MAX_HELD => {
                ended = read? == 0;
                held.push(Instant::now() + now.delay, buffer.split().freeze());
            }
            () = tokio::time::sleep_until(held.due()), if flows && held.bytes > 0 => {
                let chunk = held.take(now.bytes_per_s);
                to.write_all(&chunk).await?;
                counter.fetch_add(chunk.len() as u64, Ordering::Relaxed);
            }
        }
        if ended && held.bytes == 0 {
            return to.shutdown().await;
        }
    }
}

/// What was read and not yet written.
struct Held {
    chunks: VecDeque<(Instant, Bytes)>,
    bytes: usize,
    /// When the throttle lets something pass again.
    free_at: Instant,
}

impl Default for Held {
    fn default() -> Self {
        Self {
            chunks: VecDeque::new(),
            bytes: 0,
            free_at: Instant::now(),
        }
    }
}

impl Held {
    fn push(&mut self, due: Instant, chunk: Bytes) {
        if !chunk.is_empty() {
            self.bytes += chunk.len();
            self.chunks.push_back((due, chunk));
        }
    }

    /// When something may be written; only asked when there is something.
    fn due(&self) -> Instant {
        self.chunks
            .front()
            .map_or(self.free_at, |(due, _)| self.free_at.max(*due))
    }

    fn take(&mut self, bytes_per_s: Option<u64>) -> Bytes {
        let Some((due, mut chunk)) = self.chunks.pop_front() else {
            return Bytes::new();
        };
        if let Some(rate) = bytes_per_s {
            let most = usize::try_from((rate / WRITES_PER_S).max(1)).unwrap_or(usize::MAX);
            let rest = chunk.split_off(most.min(chunk.len()));
            if !rest.is_empty() {
                self.chunks.push_front((due, rest));
            }
            let takes = Duration::from_secs_f64(chunk.len() as f64 / rate as f64);
            self.free_at = self.free_at.max(Instant::now()) + takes;
        }
        self.bytes -= chunk.len();
        chunk
    }
}
