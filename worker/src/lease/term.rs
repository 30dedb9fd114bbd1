//! Whether this worker leads, for everybody in it who must know.
//!
//! ```text
//! keep ──Holder──▶ leader: number of the term (an event), term: until when (looked at before each act), noted: the mark
//!      ◀───────── told: how far services were told            Leadership ──▶ engine, speaker
//! ```

use std::sync::Arc;

use parking_lot::Mutex;
use tokio::sync::watch;
use tokio::time::Instant;

use super::Mark;

/// Until when this worker leads. Clones share it. Whoever acts for the layer looks at it
/// immediately before: a process that was stopped and goes on has not yet heard of anything that
/// happened meanwhile.
#[derive(Debug, Clone)]
pub struct Term(Arc<Mutex<Until>>);

#[derive(Debug, Clone, Copy)]
enum Until {
    Always,
    Time(Instant),
    Over,
}

impl Term {
    /// There is nobody else.
    #[must_use]
    pub fn always() -> Self {
        Self(Arc::new(Mutex::new(Until::Always)))
    }

    /// It does not lead yet.
    #[must_use]
    pub fn over() -> Self {
        Self(Arc::new(Mutex::new(Until::Over)))
    }

    /// Whether it leads at this instant.
    #[must_use]
    pub fn is_on(&self) -> bool {
        match *self.0.lock() {
            Until::Always => true,
            Until::Time(until) => Instant::now() < until,
            Until::Over => false,
        }
    }

    fn set(&self, until: Option<Instant>) {
        *self.0.lock() = until.map_or(Until::Over, Until::Time);
    }
}

/// What whoever keeps the lease says, and hears.
pub struct Holder {
    leader: watch::Sender<Option<u64>>,
    term: Term,
    noted: watch::Sender<Option<Mark>>,
    told: watch::Receiver<Option<Mark>>,
    rival: watch::Sender<Option<String>>,
    /// How often it began to lead.
    terms: u64,
}

/// What the rest of the worker knows of the lease.
pub struct Leadership {
    /// The number of the term in which it leads; `None`: it does not. Two terms have different
    /// numbers, also if nobody looked in between.
    pub leader: watch::Receiver<Option<u64>>,
    /// Until when.
    pub term: Term,
    /// How far services were told, as it lies beside the lease.
    pub noted: watch::Receiver<Option<Mark>>,
    /// How far this worker has told them, for whoever follows; `None`: nothing new.
    pub told: watch::Sender<Option<Mark>>,
    /// On a node: another worker, which was started later and serves instead, for people.
    pub rival: watch::Receiver<Option<String>>,
}

/// Both sides, for a worker that is one of several.
#[must_use]
pub fn leadership() -> (Holder, Leadership) {
    let (leader, led) = watch::channel(None);
    let (noted, notes) = watch::channel(None);
    let (tell, told) = watch::channel(None);
    let (rival, rivals) = watch::channel(None);
    let term = Term::over();
    let holder = Holder { leader, term: term.clone(), noted, told, rival, terms: 0 };
    let leadership = Leadership { leader: led, term, noted: notes, told: tell, rival: rivals };
    (holder, leadership)
}

impl Leadership {
    /// That of a worker that is alone.
    #[must_use]
    pub fn alone() -> Self {
        Self {
            leader: watch::channel(Some(1)).1,
            term: Term::always(),
            noted: watch::channel(None).1,
            told: watch::channel(None).0,
            rival: watch::channel(None).1,
        }
    }
}

impl Holder {
    /// What is to be left beside the lease.
    pub(super) fn told(&self) -> Option<Mark> {
        self.told.borrow().clone()
    }

    /// What lies beside the lease.
    pub(super) fn note(&self, mark: Option<Mark>) {
        let Some(mark) = mark else { return };
        self.noted.send_if_modified(|noted| {
            let is_new = noted.as_ref() != Some(&mark);
            if is_new {
                *noted = Some(mark);
            }
            is_new
        });
    }

    /// Another worker of the node serves instead, or none does.
    pub(super) fn note_rival(&self, rival: Option<String>) {
        let is_new = *self.rival.borrow() != rival;
        if is_new {
            if let Some(other) = &rival {
                tracing::warn!(
                    other,
                    "another worker of this node was started later and serves: stop one, or give \
                        it a node of its own"
                );
            }
            self.rival.send_replace(rival);
        }
    }

    /// It leads until then, or not.
    pub(crate) fn lead(&mut self, until: Option<Instant>) {
        let until = until.filter(|until| Instant::now() < *until);
        self.term.set(until);
        let was = *self.leader.borrow();
        match (was, until) {
            (None, Some(_)) => {
                self.terms += 1;
                self.leader.send_replace(Some(self.terms));
            }
            (Some(_), None) => {
                self.leader.send_replace(None);
            }
            (None, None) | (Some(_), Some(_)) => {}
        }
    }
}
