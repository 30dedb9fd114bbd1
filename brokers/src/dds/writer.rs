//! Writes one topic.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use rustdds::dds::WriteError;
use rustdds::{DataWriterStatus, RTPSEntity, StatusEvented, WriteOptionsBuilder, no_key};

use super::GuidPrefix;
use super::own_readers::OwnReaders;
use super::sample::{Cdr, CdrAdapter, octet_sequence};

/// Identity of a reader or writer on the wire: its participant's and four bytes.
pub type EndpointId = [u8; 16];

pub(crate) fn endpoint_of(guid: rustdds::GUID) -> EndpointId {
    guid.to_bytes()
}

/// Whose reader or writer it is.
pub(crate) fn participant_of(endpoint: &EndpointId) -> GuidPrefix {
    let mut prefix = [0; 12];
    prefix.copy_from_slice(&endpoint[..12]);
    GuidPrefix(prefix)
}

/// What became of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Written {
    /// RustDDS has it, under this sequence number.
    Taken(i64),
    /// Nobody reads the topic.
    NoReader,
    /// Not now: a reader has not acknowledged, or the socket takes nothing.
    Full,
    /// RustDDS refused, or has died.
    Failed,
}

/// A best-effort sample up to this size is sent at once or not at all; a larger one waits for room
/// in the socket, and RustDDS then keeps it for six seconds.
const AT_ONCE_BYTES: usize = 2 * 1024 * 1024;

/// Events that RustDDS keeps for a writer; it drops later ones. Each reader that asks for more than
/// the writer offers makes one.
const STATUS_EVENTS: usize = 4;

/// Samples after which own readers acknowledge that RustDDS does not reach: it keeps the others.
const ACKNOWLEDGE_EVERY: i64 = 32;

/// The vendor of Cyclone DDS, with which its identities begin.
pub(super) const CYCLONE: [u8; 2] = [0x01, 0x10];
/// How long samples wait until readers have acknowledged those before.
const LONGEST_BEGIN: Duration = Duration::from_millis(200);

/// How far a writer is with readers of Cyclone DDS that it has just met. Such a reader, if volatile,
/// begins behind the last sample that it is told of first. RustDDS answers no questions as long as
/// it has no sample, and tells with the first datagram also of those that are still to come. So
/// nothing is written until all before is acknowledged, and the first one goes alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Begin {
    /// All readers know where they begin.
    Done,
    /// There is a new reader.
    New,
    /// A sample waits since then.
    Waits(Instant),
}

impl Begin {
    /// There is a new reader. One that waits already goes on as it is, so that readers that come
    /// one after the other hold nobody up.
    fn meet(&mut self) {
        if *self == Self::Done {
            *self = Self::New;
        }
    }

    /// Whether a sample may be written. `acknowledged`: all that is written; `wrote`: something is.
    fn allows(&mut self, now: Instant, acknowledged: bool, wrote: bool) -> bool {
        let may = match *self {
            Self::Done => true,
            Self::New => acknowledged,
            Self::Waits(since) => {
                acknowledged || now.saturating_duration_since(since) >= LONGEST_BEGIN
            }
        };
        *self = match *self {
            _ if may && wrote => Self::Done,
            Self::New if !may => Self::Waits(now),
            other => other,
        };
        may
    }
}

/// Writes one topic. Never waits.
pub struct Writer {
    writer: no_key::DataWriter<Cdr, CdrAdapter>,
    /// How many readers it has met.
    matched: AtomicUsize,
    begin: Mutex<Begin>,
    /// Number of the last sample that it has written; 0: none.
    last: AtomicI64,
    /// The topic, and own readers of it that RustDDS does not reach.
    own_readers: Option<(String, Arc<OwnReaders>)>,
    /// Late joiners get what was written before they came, so it is written without a reader, too.
    keeps: bool,
    failed: Arc<AtomicBool>,
}

impl Writer {
    /// `keeps`: late joiners get what was written before they came.
    pub(super) fn new(
        writer: no_key::DataWriter<Cdr, CdrAdapter>,
        keeps: bool,
        own_readers: Option<(String, Arc<OwnReaders>)>,
        failed: Arc<AtomicBool>,
    ) -> Self {
        Self {
            writer,
            matched: AtomicUsize::new(0),
            begin: Mutex::new(Begin::Done),
            last: AtomicI64::new(0),
            own_readers,
            keeps,
            failed,
        }
    }

    /// Hands octets to RustDDS, as a sample of [`FRAME_TYPE`](super::FRAME_TYPE). Returns whether
    /// they were taken, as [`write_cdr`](Self::write_cdr) tells.
    pub fn write(&self, octets: &[u8]) -> bool {
        let write = |cdr| self.write_cdr(cdr, WriteOptionsBuilder::new());
        octet_sequence(&[octets]).is_ok_and(|cdr| matches!(write(cdr), Written::Taken(_)))
    }

    /// Hands a sample to RustDDS: not without a reader, unless it is kept for late joiners, and not
    /// into the full window of a reliable writer. Best effort lets the oldest that still wait give
    /// way. `options` travel with the sample.
    pub fn write_cdr(&self, cdr: Cdr, options: WriteOptionsBuilder) -> Written {
        self.contain(|| {
            if !(self.matched_now() > 0 || self.keeps) {
                return Some(Written::NoReader);
            }
            if !self.may_begin() {
                return Some(Written::Full);
            }
            // Best effort gives up a sample of which the socket cannot take the rest at once.
            let waits = cdr.payload().len() > AT_ONCE_BYTES;
            let options = options.best_effort_may_block(waits).build();
            match self.writer.write_with_options(cdr, options) {
                Ok(sample) => {
                    let number = sample.sequence_number.into();
                    self.last.store(number, Ordering::Relaxed);
                    if number % ACKNOWLEDGE_EVERY == 0 {
                        self.acknowledge();
                    }
                    Some(Written::Taken(number))
                }
                Err(WriteError::WouldBlock { .. }) => {
                    self.acknowledge();
                    Some(Written::Full)
                }
                Err(_) => Some(Written::Failed),
            }
        })
        .unwrap_or(Written::Failed)
    }

    /// Whether all readers have acknowledged all samples; always true for best effort.
    #[must_use]
    pub fn is_acknowledged(&self) -> bool {
        let acknowledged =
            self.contain(|| self.writer.wait_for_acknowledgments(Duration::ZERO).ok());
        if acknowledged == Some(false) {
            self.acknowledge();
        }
        acknowledged.unwrap_or(true)
    }

    /// Its identity on the wire.
    #[must_use]
    pub fn id(&self) -> EndpointId {
        endpoint_of(self.writer.guid())
    }

    /// Whether a reader is there. Where many came and went at once, it may say so although the last
    /// has gone.
    #[must_use]
    pub fn is_matched(&self) -> bool {
        self.contain(|| (self.matched_now() > 0).then_some(())).is_some()
    }

    /// Whether so many readers are there, as far as RustDDS tells.
    pub(super) fn has_met(&self, readers: usize) -> bool {
        self.contain(|| Some(self.matched_now() >= readers.min(STATUS_EVENTS))).unwrap_or(false)
    }

    fn may_begin(&self) -> bool {
        let mut begin = self.begin.lock();
        *begin == Begin::Done || {
            let wrote = self.last.load(Ordering::Relaxed) > 0;
            begin.allows(Instant::now(), self.is_acknowledged(), wrote)
        }
    }

    /// In the name of own readers.
    fn acknowledge(&self) {
        if let Some((topic, own_readers)) = &self.own_readers {
            own_readers.acknowledge(topic, &self.id(), self.last.load(Ordering::Relaxed));
        }
    }

    fn matched_now(&self) -> usize {
        let mut events = 0;
        while let Some(status) = self.writer.try_recv_status() {
            events += 1;
            if let DataWriterStatus::PublicationMatched { current, reader, .. } = status {
                let count = usize::try_from(current.count()).unwrap_or(0);
                self.matched.store(count, Ordering::Relaxed);
                if current.count_change() > 0 && endpoint_of(reader).starts_with(&CYCLONE) {
                    self.begin.lock().meet();
                }
            }
        }
        if events >= STATUS_EVENTS {
            // Others may have been lost. A sample without a reader costs nothing, a reader without
            // its samples does.
            self.matched.fetch_max(STATUS_EVENTS, Ordering::Relaxed);
            self.begin.lock().meet();
        }
        self.matched.load(Ordering::Relaxed)
    }

    fn contain<T>(&self, call: impl FnOnce() -> Option<T>) -> Option<T> {
        catch_unwind(AssertUnwindSafe(call)).unwrap_or_else(|_| {
            self.failed.store(true, Ordering::Relaxed);
            None
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_sample_to_a_new_reader_of_cyclone_goes_alone() {
        let (now, mut begin) = (Instant::now(), Begin::New);
        assert!(begin.allows(now, true, false), "the first one");
        assert!(!begin.allows(now, false, true), "it is not acknowledged");
        assert!(!begin.allows(now, false, true) && begin == Begin::Waits(now));
        assert!(begin.allows(now, true, true) && begin == Begin::Done);
        assert!(begin.allows(now, false, true), "from then on without a pause");
        // A reader comes later, while others have not acknowledged all.
        begin = Begin::New;
        assert!(!begin.allows(now, false, true));
        assert!(begin.allows(now + LONGEST_BEGIN, false, true), "not for ever");
        assert_eq!(begin, Begin::Done);
    }
}
