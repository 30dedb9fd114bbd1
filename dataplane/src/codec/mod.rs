//! Compression of payloads for the inter scope (F8).
//!
//! ```text
//!                 effort: at which level? ◄── what it cost
//!                    │                             ▲
//! admitted ─► order: a place ─► pool: lz4 ─► order: finished ─► in the order of admission ─► lanes
//! received ─────────────────► pool: lz4, first of all ─► ingress
//! ```
//!
//! Each part is whole by itself: [`lz4`] is the codec, [`order`] keeps messages in order while some of them are with
//! the pool, [`pool`] are the threads, and [`effort`] picks the level. What connects them is not here.

use std::time::{Duration, Instant};

use bytes::Bytes;
use nix::time::{ClockId, clock_gettime};

pub mod effort;
pub mod lz4;
pub mod order;
pub mod pool;

use lz4::Refused;
use pool::{Completion, Job, Urgency};

/// What became of a payload that was to be compressed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Compressed {
    /// The LZ4 block; absent where the payload goes as it is, see [`lz4::compress`].
    pub block: Option<Bytes>,
    /// The level that was tried.
    pub level: u8,
    /// Bytes of the payload as it was.
    pub before: usize,
    /// Time on the processor.
    pub processor: Duration,
    /// Time that a thread of the pool was taken, waiting for a processor included: what [`effort::Effort`] wants to
    /// know.
    pub taken: Duration,
}

impl Compressed {
    /// Bytes of the payload as it goes.
    #[must_use]
    pub fn after(&self) -> usize {
        self.block.as_ref().map_or(self.before, Bytes::len)
    }
}

/// A job that compresses a payload. `done` is told nothing if the job is never run.
#[must_use]
pub fn compress_job(payload: Bytes, level: u8, done: Completion<Compressed>) -> Job {
    Job::new(Urgency::Compress, payload.len(), move || {
        let (began, began_on_processor) = (Instant::now(), processor_time());
        let block = lz4::compress(&payload, level);
        done.give(Compressed {
            block,
            level,
            before: payload.len(),
            processor: processor_time().saturating_sub(began_on_processor),
            taken: began.elapsed(),
        });
    })
}

/// A job that decompresses a payload, see [`lz4::decompress`]. `done` is told nothing if the job is never run.
#[must_use]
pub fn decompress_job(payload: Bytes, announced: u64, most: usize, done: Completion<Result<Bytes, Refused>>) -> Job {
    let result = usize::try_from(announced).unwrap_or(usize::MAX).min(most);
    Job::new(Urgency::Decompress, payload.len().max(result), move || {
        done.give(lz4::decompress(&payload, announced, most));
    })
}

/// Time that the calling thread has had a processor; zero where the system does not tell.
#[must_use]
pub fn processor_time() -> Duration {
    clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).map_or(Duration::ZERO, Duration::from)
}
