//! The documents of one store: what they hold, and what is known of them.

use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::Context as _;
use parking_lot::Mutex;
use rand::RngExt as _;
use serde_json::Value;

/// Bytes of a document's spec as JSON: the value in etcd, the same text in BlazeConfig.
const SPEC_BYTES: usize = 300;
/// Before the number of a step.
const STEP: &[u8] = b"\"step\":";

/// What was acknowledged of a document last.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Known {
    pub(crate) revision: u64,
    /// Which content it has.
    pub(crate) step: u64,
}

/// All documents of one store. No two writes have the same content.
pub(crate) struct Documents {
    known: Vec<Mutex<Known>>,
    next_step: AtomicU64,
}

impl Documents {
    pub(crate) fn new(count: u64) -> Self {
        Self { known: (0..count).map(|_| Mutex::default()).collect(), next_step: AtomicU64::new(1) }
    }

    pub(crate) fn count(&self) -> usize {
        self.known.len()
    }

    /// Any document.
    pub(crate) fn any(&self) -> usize {
        rand::rng().random_range(0..self.known.len())
    }

    /// Neighbours from any document on, each once.
    pub(crate) fn some(&self, count: usize) -> Vec<usize> {
        let first = self.any();
        (first..first + count).map(|number| number % self.known.len()).collect()
    }

    /// A content that no document has had.
    pub(crate) fn next_step(&self) -> u64 {
        self.next_step.fetch_add(1, Ordering::Relaxed)
    }

    /// What [`Documents::next_step`] gives next.
    pub(crate) fn peek_step(&self) -> u64 {
        self.next_step.load(Ordering::Relaxed)
    }

    /// Of a document that exists.
    ///
    /// # Errors
    /// When there is none of this number.
    pub(crate) fn known(&self, number: usize) -> anyhow::Result<Known> {
        Ok(*self.slot(number)?.lock())
    }

    /// A write was acknowledged. Of two at the same time the one with the higher revision holds.
    ///
    /// # Errors
    /// When there is no such document, or the revision was given twice.
    pub(crate) fn written(&self, number: usize, now: Known) -> anyhow::Result<()> {
        let mut known = self.slot(number)?.lock();
        anyhow::ensure!(
            now.revision != known.revision,
            "{}: {now:?} after {:?}",
            name(number),
            *known
        );
        if now.revision > known.revision {
            *known = now;
        }
        Ok(())
    }

    fn slot(&self, number: usize) -> anyhow::Result<&Mutex<Known>> {
        self.known.get(number).with_context(|| format!("no document {number}"))
    }
}

/// What a document is called.
pub(crate) fn name(number: usize) -> String {
    format!("bench-{number:05}")
}

/// The spec of a document, always of the same length.
pub(crate) fn spec(number: usize, step: u64) -> String {
    let start = format!(
        "{{\"config\":{{\"step\":{step},\"number\":{number},\"camera\":{{\"rate_hz\":30,\"width\":640,\"height\":480}},\
         \"planner\":{{\"frames\":[\"map\",\"odom\"],\"max_speed_m_s\":1.5}},\"log\":{{\"level\":\"info\"}},\"note\":\""
    );
    let end = "\"}}";
    let note = "x".repeat(SPEC_BYTES.saturating_sub(start.len() + end.len()));
    format!("{start}{note}{end}")
}

/// The step of a spec, as it is or somewhere in a larger text.
pub(crate) fn step_of(text: &[u8]) -> Option<u64> {
    let from = text.windows(STEP.len()).position(|window| window == STEP)? + STEP.len();
    let rest = text.get(from..)?;
    let digits = rest.iter().take_while(|byte| byte.is_ascii_digit()).count();
    std::str::from_utf8(rest.get(..digits)?).ok()?.parse().ok()
}

/// Whether a text is this document's spec, whatever blanks it has.
///
/// # Errors
/// When it is not.
pub(crate) fn check_spec(number: usize, step: u64, found: &Value) -> anyhow::Result<()> {
    let expected: Value = serde_json::from_str(&spec(number, step))?;
    anyhow::ensure!(*found == expected, "{}: {found} instead of {expected}", name(number));
    Ok(())
}
