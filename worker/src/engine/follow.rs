//! What the main service says, and what follows from it.

use std::time::Duration;

use blaze_domain::config::Key;
use blaze_proto::v1;
use tokio::time::Instant;

use super::{Engine, now};
use crate::core::messages::Delivery;
use crate::core::{Applied, Incoming, PROTOCOL};
use crate::sync::SyncEvent;

/// After an outage services hear of the final state, not of each step to it: what they are told
/// waits until everything up to where the store stood has come, or nothing comes for so long.
const CATCH_UP: Duration = Duration::from_secs(3);
/// The same, however much still comes.
const CATCH_UP_AT_MOST: Duration = Duration::from_secs(30);

/// What was missed is coming.
#[derive(Debug, Clone, Copy)]
pub(super) struct CatchingUp {
    /// Nobody is told before this time.
    pub(super) until: Instant,
    at_most: Instant,
}

/// Other workers of this node that the main service sees.
#[derive(Debug, Default)]
pub(super) struct Beside {
    /// With their addresses.
    pub(super) others: Vec<String>,
    is_told: bool,
}

impl Beside {
    /// Takes what the main service says, every 15 s. Whether it is to be told: the worker before
    /// this one may still be among them at first.
    fn note(&mut self, others: &[String]) -> bool {
        let is_again = !others.is_empty() && self.others == others;
        let is_new = is_again && !self.is_told;
        self.is_told = is_again;
        self.others = others.to_vec();
        is_new
    }
}

impl Engine {
    pub(super) fn on_sync(&mut self, event: SyncEvent) {
        match event {
            SyncEvent::Greeting { is_safe, answer } => {
                // Whoever asked may have gone.
                let _ = answer.send(self.hello(is_safe));
            }
            SyncEvent::Opened(stream) => {
                self.stream = Some(stream);
                self.fault = None;
                // It may have been away for longer than anybody waits.
                self.catching_up = self.catching_up.filter(|wait| wait.at_most > Instant::now());
                self.tell_copies_of_stream();
            }
            SyncEvent::Said(incoming) => {
                if let Incoming::Bookmark { beside, .. } = &incoming {
                    self.note_beside(beside);
                }
                let applied = self.view.apply(self.without_texts(incoming), now());
                if matches!(applied, Ok(Applied::Nothing | Applied::Changed(_))) {
                    // Both understand each other: what was the matter before is so no more.
                    self.reason = None;
                }
                match applied {
                    // It is known to be the newest by now, which the copies are to know too.
                    Ok(Applied::Nothing) if self.view.is_in_sync() => self.keep(false),
                    Ok(Applied::Nothing) => {}
                    Ok(Applied::Changed(change)) => {
                        self.wants_all = false;
                        self.served.set_store(self.view.store_id());
                        self.served.apply(&change);
                        self.note_services(change.keys.iter().map(Key::kind));
                        self.note_catching_up();
                        self.note_texts(&change);
                        self.owe_notes();
                        // Of another store, whose revisions began anew.
                        if self.served.floor() > self.view.state().revision() {
                            self.renew_notes();
                        }
                        self.keep(true);
                        self.flush_soon();
                    }
                    Ok(Applied::GoAway { retry_after, reason }) => {
                        tracing::info!(reason, ?retry_after, "the main service ends the stream");
                        self.fault = Some(reason);
                    }
                    Err(fault) => {
                        tracing::warn!(%fault, "the stream begins anew");
                        self.fault = Some(fault.to_string());
                        self.counts.faults += 1;
                        if let Some(stream) = &self.stream {
                            stream.cancel();
                        }
                    }
                }
                self.note_sync();
            }
            SyncEvent::Closed { reason, is_unreadable } => {
                self.wants_all |= is_unreadable;
                // What ended it says more than that it has ended.
                let reason = self.fault.take().unwrap_or(reason);
                self.beside = Beside::default();
                let was_there = self.stream.take().is_some();
                self.tell_copies_of_stream();
                if was_there || self.reason.as_ref() != Some(&reason) {
                    tracing::warn!(reason, "the main service is away; services get what is here");
                }
                self.reason = Some(reason);
                self.view.disconnected();
                // A time that is still to come stays: else a link that comes and goes would put it
                // off for ever.
                self.catching_up = self.catching_up.filter(|wait| wait.until > Instant::now());
                self.note_sync();
            }
        }
    }

    /// Other workers of this node that the main service sees. One that has just ended may be among
    /// them once.
    fn note_beside(&mut self, beside: &[String]) {
        if self.identity.site.node.is_none() {
            // Those of a layer may share a node, and have a lease.
            return;
        }
        if self.beside.note(beside) {
            tracing::warn!(
                this = self.identity.worker_id,
                others = beside.join(", "),
                "several workers of this node run: stop all but one, or give each node a name of \
                    its own"
            );
        }
    }

    fn tell_copies_of_stream(&self) {
        if let Some(copies) = &self.outputs.copies {
            copies.set_main_answers(self.stream.is_some());
        }
    }

    fn hello(&mut self, is_safe: bool) -> v1::Hello {
        self.view.disconnected();
        let resume = self.view.resume_point();
        let site = &self.identity.site;
        let mut hello = v1::Hello {
            protocol: PROTOCOL,
            layer: site.layer.to_string(),
            node: self.identity.node.to_string(),
            worker_id: self.identity.worker_id.clone(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            store_id: resume.store_id,
            revision: resume.revision,
            digest: resume.digest,
            without_texts: self.identity.delivery == Delivery::Redacted,
        };
        // Texts come over a safe connection alone, and with a snapshot: what is here has the newest
        // revision already.
        if self.wants_all || (is_safe && self.lacks_texts && !hello.without_texts) {
            (hello.store_id, hello.revision, hello.digest) = Default::default();
        }
        hello
    }

    /// What nobody is told as text is not kept as text either. A main service that knows it does
    /// not send it.
    fn without_texts(&self, incoming: Incoming) -> Incoming {
        match self.identity.delivery {
            Delivery::Text => incoming,
            Delivery::Redacted => incoming.redacted(),
        }
    }

    /// What was missed in an outage comes in steps, of which only the last is told.
    fn note_catching_up(&mut self) {
        if self.view.is_in_sync() {
            return;
        }
        let now = Instant::now();
        let at_most = self.catching_up.map_or(now + CATCH_UP_AT_MOST, |wait| wait.at_most);
        let until = at_most.min(now + CATCH_UP);
        if until > now {
            self.catching_up = Some(CatchingUp { until, at_most });
            self.flush_at = Some(until);
        }
    }

    fn note_sync(&mut self) {
        let in_sync = self.view.is_in_sync();
        if in_sync && self.catching_up.take().is_some() {
            self.flush_soon();
        }
        let was = self.served.source();
        self.served.set_in_sync(in_sync);
        if was != self.served.source() {
            tracing::info!(
                in_sync,
                revision = self.view.state().revision(),
                "source of configurations"
            );
        }
        self.begin_telling();
        self.acknowledge_soon();
    }
}
