//! The worker at work: one task that owns what is known and does one thing after the other, so that
//! nothing needs a lock and every order is kept. It waits for nobody: what goes out is taken by
//! tasks of their own.
//!
//! ```text
//! sync::follow ──SyncEvent──▶┌────────┐──Ack (newest)──▶ sync::follow
//! broker: get ──────────────▶│ Engine │──reply─────────▶ broker
//! acks, watchdogs: Sign ────▶│        │
//! mounted file ─────────────▶│        │──Told──────────▶ serve::Speaker ─▶ keys, notices
//! copies: Found ────────────▶│        │
//! lease: leader? ───────────▶│        │──Update────────▶ copy::Copies
//! admin: Query ─────────────▶└────────┘
//! ```

mod ask;
mod ends;
mod follow;
mod found;
mod hear;
mod lead;
mod own;
mod ports;
mod status;
mod tell;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::config::state::State;
use blaze_domain::config::{Document, Kind, Timestamp};
use blaze_proto::v1;
use blaze_runtime::on_beat;
use tokio::time::{Instant, sleep_until};
use tokio_util::sync::CancellationToken;

use crate::copy::{Loaded, Notes, Position, Update, defaults, lacks_text};
use crate::core::{Gate, LayerView, Served, ServedTarget, Signs, Source};
use crate::lease::Mark;
use ends::Ends;

pub use hear::Sign;
pub use own::Own;
pub use ports::{Counts, Identity, Inputs, Outputs, Replies};
pub use status::Status;

/// Within this time several changes may become one notice.
const TOGETHER: Duration = Duration::from_millis(20);
/// Between two looks whether the broker has taken what waits.
const SETTLE: Duration = Duration::from_millis(200);
/// What the worker has is said this long after it became so, and with it what came meanwhile.
const ACK_AFTER: Duration = Duration::from_millis(50);
/// While there is always something new it is said so often: the digest over everything is worked
/// out each time.
const ACK_PACE: Duration = Duration::from_secs(1);
/// It is said again after this time without news.
const ACK_AGAIN: Duration = Duration::from_secs(15);
/// Between two looks whether a sign of life has run out.
const LOOK: Duration = Duration::from_secs(1);
/// Events that wait for the engine.
pub const QUEUE: usize = 256;

/// What the engine owns. Everything that it does happens in [`Engine::run`].
pub struct Engine {
    identity: Identity,
    outputs: Outputs,
    view: LayerView,
    served: Served,
    /// As they are kept, and the version of the places in them.
    notes: Arc<Notes>,
    notes_version: u64,
    /// What came could not be read, and would come again: everything is to be asked for.
    wants_all: bool,
    /// The text of a secret is not here.
    lacks_texts: bool,
    /// It has come, and nobody has been told yet.
    owes_texts: bool,
    /// Until then whoever has secrets gets everything, also if the hash is the same: the texts have
    /// come just now.
    texts_until: Option<Instant>,
    signs: Signs,
    gate: Gate,
    look_at: Instant,
    stream: Option<CancellationToken>,
    /// Why there is no stream.
    reason: Option<String>,
    beside: follow::Beside,
    /// Why the stream was ended from here.
    fault: Option<String>,
    /// The number of the term in which it leads.
    leads: Option<u64>,
    /// Since when.
    led_at: Instant,
    /// It leads and knows enough to notify services.
    tells: bool,
    /// Every place was notified since it does.
    has_announced: bool,
    /// How far services were notified, by whomever.
    noted: Option<Mark>,
    /// The state that is shown.
    shown: Option<Mark>,
    flushed: Option<Instant>,
    flush_at: Option<Instant>,
    catching_up: Option<follow::CatchingUp>,
    /// When to look whether the broker has taken what places are told.
    settle_at: Option<Instant>,
    ack_at: Instant,
    /// When it was said last.
    acked: Instant,
    /// Places whose key is kept.
    keyed: BTreeMap<String, ServedTarget>,
    /// Keys of an earlier life were looked for.
    has_swept: bool,
    /// Places that are not notified any more.
    ends: Ends,
    defaults_problem: Option<String>,
    counts: Counts,
}

impl Engine {
    /// An engine that serves what is found at the start, if anything is.
    #[must_use]
    pub fn new(identity: Identity, outputs: Outputs, start: Option<Loaded>) -> Self {
        let now = Instant::now();
        let mut engine = Self {
            served: Served::new(identity.site.clone()),
            view: LayerView::default(),
            notes: Arc::default(),
            notes_version: 0,
            wants_all: false,
            lacks_texts: false,
            owes_texts: false,
            texts_until: None,
            signs: Signs::new(identity.site.clone()),
            gate: Gate::default(),
            look_at: on_beat(now + LOOK),
            stream: None,
            reason: None,
            beside: follow::Beside::default(),
            fault: None,
            leads: None,
            led_at: now,
            tells: false,
            has_announced: false,
            noted: None,
            shown: None,
            flushed: None,
            flush_at: None,
            catching_up: None,
            settle_at: None,
            ack_at: now + ACK_AGAIN,
            acked: now.checked_sub(ACK_PACE).unwrap_or(now),
            keyed: BTreeMap::new(),
            has_swept: false,
            ends: Ends::default(),
            defaults_problem: None,
            counts: Counts::default(),
            identity,
            outputs,
        };
        if let Some(loaded) = start {
            engine.begin_with(loaded, now);
        }
        engine
    }

    fn begin_with(&mut self, loaded: Loaded, now: Instant) {
        let Position { store_id, revision, as_of, .. } = loaded.position;
        let state = self.state_of(revision, loaded.documents.iter().cloned());
        let is_same = |document: &Arc<Document>| {
            let held = state.get(&document.key);
            held.is_some_and(|held| Arc::ptr_eq(&held.document, document))
        };
        let is_as_kept = loaded.documents.iter().all(is_same);
        self.take_notes(&loaded.notes);
        self.notes = loaded.notes;
        self.view = LayerView::from_copy(store_id, state.clone(), as_of);
        self.served.set_store(self.view.store_id());
        self.served.load(state, Source::Copy);
        self.lacks_texts = lacks_texts(self.view.state());
        self.note_all_services();
        self.flush_at = Some(now);
        // The one of the copies that is behind the other catches up; both lose the texts that
        // nobody is told.
        self.keep(!is_as_kept);
    }

    /// Documents of a copy or of a file, as they are kept here.
    fn state_of(&self, revision: u64, documents: impl IntoIterator<Item = Arc<Document>>) -> State {
        let mut state = State::new(revision, []);
        for document in documents {
            state.put(self.identity.delivery.kept(document));
        }
        state
    }

    fn note_all_services(&mut self) {
        self.note_services([Kind::Service]);
    }

    /// Works until `stop`.
    pub async fn run(mut self, mut inputs: Inputs, stop: CancellationToken) {
        self.noted = inputs.noted.borrow_and_update().clone();
        let term = *inputs.leader.borrow_and_update();
        self.lead(term);
        self.take_defaults(&inputs.defaults.borrow_and_update().clone());
        loop {
            let flush_at = self.flush_at;
            let settle_at = self.settle_at;
            tokio::select! {
                biased;
                () = stop.cancelled() => return,
                () = sleep_until(flush_at.unwrap_or_else(Instant::now)),
                if flush_at.is_some() => self.flush(),
                Some(asked) = inputs.queries.recv() => {
                    // Whoever asked may have gone.
                    let _ = asked.send(self.status());
                }
                Some(found) = inputs.found.recv() => self.on_found(found),
                // Before the term that it is of: whoever takes over must not be behind it.
                Ok(()) = inputs.noted.changed() => {
                    let mark = inputs.noted.borrow_and_update().clone();
                    self.note_told(mark);
                }
                Ok(()) = inputs.leader.changed() => {
                    let term = *inputs.leader.borrow_and_update();
                    self.lead(term);
                }
                // What is due is done before what comes, of which there may always be more. Each of
                // these is due again only later.
                () = sleep_until(self.look_at) => {
                    self.look_at_signs();
                    self.look_at_ends();
                }
                () = sleep_until(settle_at.unwrap_or_else(Instant::now)),
                if settle_at.is_some() => self.settle(),
                () = sleep_until(self.ack_at) => self.acknowledge(),
                Some(event) = inputs.sync.recv() => self.on_sync(event),
                Some(sign) = inputs.signs.recv() => self.on_sign(sign),
                Some(request) = inputs.gets.recv() => self.on_get(&request),
                Ok(()) = inputs.defaults.changed() => {
                    let status = inputs.defaults.borrow_and_update().clone();
                    self.take_defaults(&status);
                }
            }
        }
    }

    /// Says what is here, if somebody listens.
    fn acknowledge(&mut self) {
        self.acked = Instant::now();
        self.ack_at = self.acked + ACK_AGAIN;
        // Also those who have not asked for long are to be forgotten when nothing else happens.
        self.flush_soon();
        if self.stream.is_none() {
            return;
        }
        let ack = v1::Ack {
            revision: self.view.state().revision(),
            digest: self.view.digest(),
            services: self.services_of_ack(),
            rollouts: self.rollouts_of_ack(),
        };
        self.outputs.acks.send_replace(Some(ack));
    }

    /// Has the newest state kept, with the notes. `has_changed`: not only the time has moved on.
    fn keep(&self, has_changed: bool) {
        let Some(copies) = &self.outputs.copies else { return };
        let (Some(store_id), Some(as_of)) = (self.view.store_id(), self.view.as_of()) else {
            return;
        };
        copies.store(&Update {
            position: Position {
                store_id: store_id.to_owned(),
                layer: self.identity.site.layer.clone(),
                revision: self.view.state().revision(),
                as_of,
            },
            state: self.view.state().clone(),
            notes: Arc::clone(&self.notes),
            has_changed,
        });
    }

    /// Has places that came or went kept, and roll-outs that failed.
    fn keep_notes(&mut self) {
        if self.notes_version != self.served.places_version() {
            let before = Arc::clone(&self.notes);
            self.renew_notes();
            // The revision of the documents is kept with them.
            let revision = self.view.state().revision();
            let kept = |notes: &Notes| Notes { floor: notes.floor.max(revision), ..notes.clone() };
            if kept(&before) != kept(&self.notes) {
                self.keep(true);
            }
        }
        self.owe_notes();
    }

    fn renew_notes(&mut self) {
        self.notes_version = self.served.places_version();
        self.notes = Arc::new(Notes {
            failed: self.served.failed().to_vec(),
            places: self.places(),
            ended: self.ends.places().cloned().collect(),
            floor: self.served.floor(),
        });
    }

    /// Has a place kept soon that was not known before.
    fn note_new_places(&mut self) {
        if self.notes_version != self.served.places_version() {
            self.owe_notes();
            self.settle_soon();
        }
    }

    /// Copies without what is still to come do not count as current.
    fn owe_notes(&self) {
        if let Some(copies) = &self.outputs.copies {
            let is_owed = self.notes_version != self.served.places_version();
            copies.owe(self.served.has_pending() || is_owed);
        }
    }

    fn take_defaults(&mut self, status: &defaults::Status) {
        self.defaults_problem = status.problem.as_ref().map(ToString::to_string);
        let Some(current) = &status.current else { return };
        let state = self.state_of(0, current.documents.iter().cloned());
        // What came from the main service or a copy of it is better.
        if self.served.load(state, Source::File) {
            self.note_all_services();
            self.flush_soon();
        }
    }
}

/// Whether the text of a secret is not here: it came over a connection that others could read, or
/// from a copy without a key.
fn lacks_texts(state: &State) -> bool {
    state.all().any(|(_, held)| lacks_text(&held.document.spec))
}

/// The time, for people.
fn now() -> Timestamp {
    let since =
        std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    Timestamp::from_millis(i64::try_from(since.as_millis()).unwrap_or(i64::MAX))
}
