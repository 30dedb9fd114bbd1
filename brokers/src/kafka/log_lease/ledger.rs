//! Who has the lease, as the records of one partition tell it: whoever has read them to the same offset knows the same.
//!
//! ```text
//! claim ─► counts if nothing was written of the term before since its writer looked ─► a term begins
//! renew, release ─► count if they are of the term that is on
//! ```
//!
//! Two claims of one term, or a claim and a renewal, meet in the log, and the first of them counts. So nobody can take what
//! was renewed in time, and nobody can renew what was taken.
//!
//! Whoever has claimed a term holds it once it has gone on with it. What goes on with terms has one key, and each claim the
//! one of its writer, which takes it away when it knows what became of it. So of what was compacted there is the last record
//! that went on with a term; claims before it rest on nothing that can be read, and are believed only until one is read.

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

/// The longest lease that is believed.
const LONGEST: Duration = Duration::from_secs(600);
/// The largest record that is read, in bytes.
const MAX_BYTES: usize = 4096;

/// A record of the log.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Entry {
    /// Who writes.
    pub(super) owner: String,
    /// Which term: each is one more than the one before.
    pub(super) term: u64,
    pub(super) act: Act,
    /// How long it is held from here on, in milliseconds.
    pub(super) time_ms: u64,
    /// What lies beside the lease.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) note: Option<String>,
}

/// What a record does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "is")]
pub(super) enum Act {
    /// Begins a term.
    Claim {
        /// Offset of the last record of the term before, as far as its writer knows; `None`: there was none.
        after: Option<i64>,
        /// Whether its writer has itself waited as long as the term before was held. If not it counts where the server's
        /// clock says so.
        has_waited: bool,
    },
    /// Goes on with a term.
    Renew,
    /// Ends a term before its time.
    Release,
}

impl Entry {
    /// `None`: it is no record of a lease.
    pub(super) fn parse(bytes: &[u8]) -> Option<Self> {
        if bytes.len() > MAX_BYTES {
            return None;
        }
        serde_json::from_slice(bytes).ok()
    }

    /// As it is written.
    ///
    /// # Errors
    /// For people: it would be too large to be read.
    pub(super) fn to_bytes(&self) -> Result<Vec<u8>, String> {
        let bytes = serde_json::to_vec(self).map_err(|error| error.to_string())?;
        if bytes.len() > MAX_BYTES {
            return Err(format!(
                "a record of {} bytes is too large for a lease, which takes {MAX_BYTES}",
                bytes.len()
            ));
        }
        Ok(bytes)
    }

    fn time(&self) -> Duration {
        Duration::from_millis(self.time_ms).min(LONGEST)
    }
}

/// Where a record lies.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub(super) offset: i64,
    /// When the server took it by its clock, in milliseconds since 1970; `None`: the topic does not keep that.
    pub(super) appended_ms: Option<i64>,
    /// When it was read.
    pub(super) read: Instant,
    /// It was there before anybody here read, and so may have been what is not there any more.
    pub(super) is_after_gap: bool,
}

/// A term as far as it was read.
#[derive(Debug, Clone)]
struct Term {
    number: u64,
    owner: String,
    time: Duration,
    /// The last record of it.
    last: Place,
    /// It begins with a claim, and what that rests on was not read.
    is_doubtful: bool,
    /// Its owner has gone on with it.
    is_renewed: bool,
    is_released: bool,
}

/// What one may do who wants the lease.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Step {
    /// It has it and may go on with this term.
    Renew(u64),
    /// It may try to begin this term.
    Claim { term: u64, act: Act },
    /// It is another one's turn.
    Wait,
}

/// What was read.
#[derive(Debug, Default)]
pub(super) struct Ledger {
    term: Option<Term>,
    note: Option<String>,
    /// Whether what there is was there before it was read: nobody knows by his own clock how old it is.
    is_of_before: bool,
}

impl Ledger {
    /// What lies beside the lease.
    pub(super) fn note(&self) -> Option<&str> {
        self.note.as_deref()
    }

    /// The term of this owner, with the offset of its last record.
    pub(super) fn own_term(&self, owner: &str) -> Option<(u64, i64)> {
        let term = self.term.as_ref()?;
        (term.owner == owner && !term.is_released).then_some((term.number, term.last.offset))
    }

    /// When others may take it, for whoever has waited himself.
    pub(super) fn ends(&self) -> Option<Instant> {
        let term = self.term.as_ref().filter(|term| !term.is_released)?;
        Some(term.last.read + term.time)
    }

    /// All that was there is read. What follows is read as it is written.
    pub(super) fn is_caught_up(&mut self) {
        self.is_of_before = self.term.is_some();
    }

    /// Takes a record in.
    pub(super) fn apply(&mut self, entry: Entry, place: Place) {
        let is_claim = matches!(entry.act, Act::Claim { .. });
        let counts = match (entry.act, &self.term) {
            // What came before was compacted away, or there was nothing.
            (_, None) => true,
            (Act::Claim { after, has_waited }, Some(term)) => {
                let is_over = has_waited || term.is_released || is_over(term, &place);
                let is_next =
                    entry.term == term.number.saturating_add(1) && after.is_some_and(|after| after >= term.last.offset);
                // What it rests on may be what was taken away.
                let may_be_next = term.is_doubtful && entry.term > term.number;
                is_over && (is_next || may_be_next)
            }
            (Act::Renew | Act::Release, Some(term)) => {
                // Whoever goes on with a term has read that it counts.
                // Two that go on with one term have read different remains of what was compacted: one of them is to stay.
                let is_same = entry.term == term.number && entry.owner <= term.owner;
                term.is_doubtful || is_same || entry.term > term.number
            }
        };
        if !counts {
            return;
        }
        self.is_of_before = false;
        self.term = Some(Term {
            number: entry.term,
            time: entry.time(),
            owner: entry.owner,
            last: place,
            is_doubtful: is_claim && place.is_after_gap && self.term.as_ref().is_none_or(|term| term.is_doubtful),
            is_renewed: !is_claim,
            is_released: entry.act == Act::Release,
        });
        self.note = entry.note;
    }

    /// What this owner may do now.
    pub(super) fn step(&mut self, owner: &str, now: Instant) -> Step {
        let Some(term) = &self.term else {
            let act = Act::Claim {
                after: None,
                has_waited: true,
            };
            return Step::Claim { term: 1, act };
        };
        let has_waited = term.is_released || now >= term.last.read + term.time;
        // A claim that its owner did not go on with in time is as good as none.
        if term.owner == owner && !term.is_released && (term.is_renewed || !has_waited) {
            return Step::Renew(term.number);
        }
        // The server's clock is asked once: its answer is read like any other record.
        if !has_waited && !std::mem::take(&mut self.is_of_before) {
            return Step::Wait;
        }
        let act = Act::Claim {
            after: Some(term.last.offset),
            has_waited,
        };
        Step::Claim {
            term: term.number.saturating_add(1),
            act,
        }
    }
}

/// Whether the term was over by the server's clock when a record was taken.
fn is_over(term: &Term, place: &Place) -> bool {
    let (Some(last), Some(now)) = (term.last.appended_ms, place.appended_ms) else {
        return false;
    };
    let held_ms = i64::try_from(term.time.as_millis()).unwrap_or(i64::MAX);
    now.saturating_sub(last) > held_ms
}
