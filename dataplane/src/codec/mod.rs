//! Compression of payloads for the inter scope, and the threads that convert large ones.
//!
//! ```text
//!                 effort: at which level? ◄──────────── what it cost
//!                    │                                       ▲
//! admitted ─► order: a place ─► pool: a turn ─► lz4 ─► order: finished ─► in the order of each writer ─► lanes
//! received, and not seen before ─► order: a place ─► pool: a turn, first ─► lz4 ─► in order ─► bridges to brokers
//! for a broker, as JSON or CDR ──► order: a place ─► pool: a turn ─► types ─► in order ─► broker
//! ```
//!
//! Each part is whole by itself: [`lz4`] is the codec, [`order`] keeps messages in order while some
//! of them are with the pool, and says whose turn it is, [`pool`] are the threads, and [`effort`]
//! picks the level. What connects them is [`compress_stage`](crate::lane::compress_stage), without
//! threads, and [`plane`](crate::flow::plane).

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use bytes::Bytes;
use nix::time::{ClockId, clock_gettime};

use crate::types::{Conversion, ConvertFailure, Converted};

pub mod effort;
pub mod lz4;
pub mod order;
pub mod pool;

#[cfg(test)]
mod tests;

/// What is to be done with a payload.
#[derive(Debug, Clone)]
pub enum Work {
    /// Compress it at a level.
    Compress(u8),
    /// Decompress it; so large it says that it will be.
    Decompress(u64),
    /// Convert it to another encoding.
    Convert(Conversion),
}

/// What became of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Done {
    /// It was compressed, or goes as it is.
    Compressed(Compressed),
    /// It was decompressed.
    Decompressed(Bytes),
    /// It cannot be.
    Refused(lz4::Refused),
    /// It was converted, or cannot be.
    Converted(Result<Converted, ConvertFailure>),
    /// The codec has panicked.
    Failed,
}

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
    /// Time that a thread of the pool was taken, waiting for a processor included: what
    /// [`effort::Effort`] wants to know.
    pub taken: Duration,
}

impl Compressed {
    /// Bytes of the payload as it goes.
    #[must_use]
    pub fn after(&self) -> usize {
        self.block.as_ref().map_or(self.before, Bytes::len)
    }
}

impl Work {
    /// Does it, on the thread of the caller.
    #[must_use]
    pub fn run(&self, payload: &[u8]) -> Done {
        match self {
            Self::Compress(level) => {
                let level = *level;
                let (began, began_on_processor) = (Instant::now(), processor_time());
                let block = lz4::compress(payload, level);
                Done::Compressed(Compressed {
                    block,
                    level,
                    before: payload.len(),
                    processor: processor_time().saturating_sub(began_on_processor),
                    taken: began.elapsed(),
                })
            }
            Self::Decompress(announced) => match lz4::decompress(payload, *announced) {
                Ok(payload) => Done::Decompressed(payload),
                Err(reason) => Done::Refused(reason),
            },
            Self::Convert(conversion) => Done::Converted(conversion.run(payload)),
        }
    }
}

/// What a codec gives; where it panics that is [`Done::Failed`]. Only the codec is to run in here:
/// a panic of anything else must end the process.
pub fn guarded(work: impl FnOnce() -> Done) -> Done {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        tracing::error!("the codec panicked");
        // To drop what was thrown may throw again.
        std::mem::forget(panic);
        Done::Failed
    })
}

/// Time that the calling thread has had a processor; zero where the system does not tell.
#[must_use]
pub fn processor_time() -> Duration {
    clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).map_or(Duration::ZERO, Duration::from)
}
