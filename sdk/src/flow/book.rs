//! The leases of a service, as a state machine without input or output.
//!
//! ```text
//! ask ──► Asking ──answer ok──► Held ──► renews at a third of its time to live
//!           │ ▲ sends again with backoff      │
//!           │ └──────────── new terms ────────┤
//!           └─ refused ─► gone                ├─ a newer process has it ─► Superseded: asks on, until that one has ended
//!                                             └─ last holder leaves ─► Leaving ─ answer, or given up ─► gone
//! ```

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_domain::TopicName;
use blaze_domain::control::{
    Answer, ControlError, ControlMessage, ErrorCode, LeaseKind, WithdrawMessage,
};
use blaze_domain::names::ChannelName;
use tokio::sync::oneshot;

use super::{FlowError, LeaseState};

/// Leases of one service at most; a flow holds no more of all services together.
pub(super) const MAX_LEASES: usize = 10_000;
/// First pause before an unanswered message is sent again; doubles each time.
const FIRST_RETRY: Duration = Duration::from_millis(250);
const LONGEST_RETRY: Duration = Duration::from_secs(5);
/// How often a withdraw is sent, before the lease is left to lapse.
const WITHDRAW_ATTEMPTS: u32 = 4;
/// What is due within this time is sent together.
const TOGETHER: Duration = Duration::from_millis(20);
/// A returning flow is told of all leases within this time; 250 ms are allowed.
const RESEND_WITHIN: Duration = Duration::from_millis(200);

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct LeaseKey {
    pub(super) kind: LeaseKind,
    pub(super) topic: TopicName,
}

/// A holder's claim to a lease: it counts only as long as the lease was not replaced by another of
/// the same key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Claim {
    pub(super) key: LeaseKey,
    generation: u64,
}

pub(super) type AskResult = Result<(), FlowError>;

struct Record {
    generation: u64,
    holders: usize,
    /// What was last asked; its `id` is in [`Record::id`].
    asked: Arc<ControlMessage>,
    /// What the flow last agreed to.
    agreed: Option<Arc<ControlMessage>>,
    id: String,
    state: State,
    waiting: Vec<oneshot::Sender<AskResult>>,
}

#[derive(Debug, Clone, Copy)]
enum State {
    Asking {
        attempts: u32,
        next: Instant,
    },
    /// `next` is absent for a lease without an end.
    Held {
        next: Option<Instant>,
    },
    /// A newer process of the service has the lease.
    Superseded {
        next: Instant,
    },
    Leaving {
        attempts: u32,
        next: Instant,
    },
}

/// The leases of a service.
pub(super) struct LeaseBook {
    reply_to: ChannelName,
    ttl_s: u32,
    /// Random numbers of 0 to 1.
    random: Box<dyn FnMut() -> f64 + Send>,
    /// Begins all identities of messages, so that they differ from those of other services on a
    /// shared reply topic.
    id_prefix: String,
    records: HashMap<LeaseKey, Record>,
    by_id: HashMap<String, LeaseKey>,
    counter: u64,
    closed: bool,
}

impl LeaseBook {
    pub(super) fn new(
        reply_to: ChannelName,
        id_prefix: String,
        ttl_s: u32,
        random: Box<dyn FnMut() -> f64 + Send>,
    ) -> Self {
        Self {
            reply_to,
            ttl_s,
            random,
            id_prefix,
            records: HashMap::new(),
            by_id: HashMap::new(),
            counter: 0,
            closed: false,
        }
    }

    /// Asks for a lease, or for other terms of one that there is. The answer comes to `waiting`.
    /// The book says how long the lease lasts and where the answer goes.
    pub(super) fn ask(
        &mut self,
        mut message: ControlMessage,
        waiting: oneshot::Sender<AskResult>,
        now: Instant,
    ) -> Result<Claim, FlowError> {
        if self.closed {
            return Err(FlowError::Closed);
        }
        let kind = match &mut message {
            ControlMessage::Advertise(advertise) => {
                advertise.ttl_s = self.ttl_s;
                LeaseKind::Advertise
            }
            ControlMessage::Request(request) => {
                request.ttl_s = self.ttl_s;
                LeaseKind::Request
            }
            ControlMessage::Withdraw(_) | ControlMessage::Call(_) => {
                return Err(FlowError::Invalid { field: "op", reason: "is no lease" });
            }
        };
        let common = message.common_mut();
        common.reply_to = Some(self.reply_to.clone());
        let key = LeaseKey { kind, topic: common.topic.clone() };
        if self.records.len() >= MAX_LEASES && !self.records.contains_key(&key) {
            return Err(FlowError::TooManyLeases(MAX_LEASES));
        }
        let asked = Arc::new(message);
        let id = self.new_id(&key);
        let state = State::Asking { attempts: 0, next: now };
        let generation = self.counter;
        let record = match self.records.remove(&key) {
            // New terms for the holders that there are.
            Some(mut record) if !matches!(record.state, State::Leaving { .. }) => {
                self.by_id.remove(&record.id);
                record.holders += 1;
                record.asked = asked;
                record.id = id;
                record.state = state;
                record.waiting.push(waiting);
                record
            }
            other => {
                if let Some(leaving) = other {
                    self.forget(leaving, &Ok(()));
                }
                Record {
                    generation,
                    holders: 1,
                    asked,
                    agreed: None,
                    id,
                    state,
                    waiting: vec![waiting],
                }
            }
        };
        let generation = record.generation;
        self.records.insert(key.clone(), record);
        Ok(Claim { key, generation })
    }

    /// A holder leaves; the last one takes the lease with it. `waiting` learns when the flow knows,
    /// or at once if there is nothing that it must know.
    pub(super) fn leave(
        &mut self,
        claim: &Claim,
        waiting: Option<oneshot::Sender<AskResult>>,
        now: Instant,
    ) {
        let done = |waiting: Option<oneshot::Sender<AskResult>>| {
            if let Some(waiting) = waiting {
                let _ = waiting.send(Ok(()));
            }
        };
        let Some(record) = self.records.get_mut(&claim.key) else {
            return done(waiting);
        };
        let is_leaving = matches!(record.state, State::Leaving { .. });
        if record.generation != claim.generation || is_leaving {
            return done(waiting);
        }
        record.holders = record.holders.saturating_sub(1);
        if record.holders > 0 {
            return done(waiting);
        }
        self.begin_leaving(&claim.key, waiting, now);
    }

    /// Withdraws everything; nothing new is taken.
    pub(super) fn leave_all(&mut self, now: Instant) {
        self.closed = true;
        let keys: Vec<LeaseKey> = self.records.keys().cloned().collect();
        for key in keys {
            self.begin_leaving(&key, None, now);
        }
    }

    fn begin_leaving(
        &mut self,
        key: &LeaseKey,
        waiting: Option<oneshot::Sender<AskResult>>,
        now: Instant,
    ) {
        let id = self.new_id(key);
        let Some(mut record) = self.records.remove(key) else {
            return;
        };
        if matches!(record.state, State::Leaving { .. }) {
            self.by_id.remove(&id);
            self.records.insert(key.clone(), record);
            return;
        }
        let is_unknown =
            record.agreed.is_none() && matches!(record.state, State::Asking { attempts: 0, .. });
        for asked in record.waiting.drain(..) {
            let _ = asked.send(Err(FlowError::Closed));
        }
        record.waiting.extend(waiting);
        if is_unknown {
            self.by_id.remove(&id);
            self.forget(record, &Ok(()));
            return;
        }
        self.by_id.remove(&record.id);
        record.id = id;
        record.holders = 0;
        record.state = State::Leaving { attempts: 0, next: now };
        self.records.insert(key.clone(), record);
    }

    /// A flow started, or the broker came back: all leases are sent again within 250 ms.
    pub(super) fn send_all_again(&mut self, now: Instant) {
        for record in self.records.values_mut() {
            let soon = now + RESEND_WITHIN.mul_f64((self.random)().clamp(0.0, 1.0));
            match &mut record.state {
                State::Held { next } => *next = Some(next.map_or(soon, |next| next.min(soon))),
                State::Asking { next, .. }
                | State::Superseded { next }
                | State::Leaving { next, .. } => {
                    *next = (*next).min(soon);
                }
            }
        }
    }

    /// An answer of a flow; those to others are left alone.
    pub(super) fn on_answer(&mut self, answer: &Answer, now: Instant) {
        let Some(id) = answer.id.as_deref() else { return };
        let Some(key) = self.by_id.get(id).cloned() else {
            return;
        };
        let Some(mut record) = self.records.remove(&key) else {
            return;
        };
        if matches!(record.state, State::Leaving { .. }) {
            let result = if answer.ok { Ok(()) } else { Err(refusal(answer)) };
            self.forget(record, &result);
            return;
        }
        if answer.ok {
            record.agreed = Some(Arc::clone(&record.asked));
            let lease = Duration::from_secs(answer.lease_s.unwrap_or(self.ttl_s).into());
            if matches!(record.state, State::Asking { .. } | State::Superseded { .. }) {
                record.state = State::Held { next: (!lease.is_zero()).then(|| now + lease / 3) };
            }
            settle(&mut record, &Ok(()));
        } else {
            let refusal = refusal(answer);
            if !matches!(record.state, State::Superseded { .. }) {
                tracing::warn!(
                    topic = %key.topic,
                    kind = ?key.kind,
                    error = %refusal,
                    "a flow refused a lease",
                );
            }
            let is_superseded =
                matches!(&refusal, FlowError::Refused { code: ErrorCode::StaleEpoch, .. });
            let Some(agreed) = record.agreed.clone() else {
                self.forget(record, &Err(refusal));
                return;
            };
            // The terms that the flow agreed to before still stand.
            settle(&mut record, &Err(refusal));
            record.asked = agreed;
            let next = now + self.renewal_pause();
            if is_superseded {
                record.state = State::Superseded { next };
            } else if matches!(record.state, State::Asking { .. } | State::Superseded { .. }) {
                record.state = State::Held { next: Some(next) };
            }
        }
        self.records.insert(key, record);
    }

    /// The control messages that are due now.
    pub(super) fn poll(&mut self, now: Instant) -> Vec<ControlMessage> {
        let due: Vec<LeaseKey> = self
            .records
            .iter()
            .filter(|(_, record)| record.next().is_some_and(|next| next <= now + TOGETHER))
            .map(|(key, _)| key.clone())
            .collect();
        if due.is_empty()
            || self.records.values().all(|record| record.next().is_none_or(|next| next > now))
        {
            return Vec::new();
        }
        due.into_iter().filter_map(|key| self.send(&key, now)).collect()
    }

    /// When [`LeaseBook::poll`] has something to send next.
    pub(super) fn next_due(&self) -> Option<Instant> {
        self.records.values().filter_map(Record::next).min()
    }

    fn renewal_pause(&self) -> Duration {
        match self.ttl_s {
            // A lease without an end.
            0 => LONGEST_RETRY,
            ttl_s => Duration::from_secs(ttl_s.into()) / 3,
        }
    }

    fn send(&mut self, key: &LeaseKey, now: Instant) -> Option<ControlMessage> {
        let renewal_pause = self.renewal_pause();
        let jitter = 0.75 + 0.5 * (self.random)().clamp(0.0, 1.0);
        let record = self.records.get_mut(key)?;
        let is_withdraw = match &mut record.state {
            State::Asking { attempts, next } => {
                *next = now + pause_after(*attempts).mul_f64(jitter);
                *attempts = attempts.saturating_add(1);
                false
            }
            State::Held { next } => {
                *next = Some(now + renewal_pause);
                false
            }
            State::Superseded { next } => {
                *next = now + renewal_pause;
                false
            }
            State::Leaving { attempts, .. } if *attempts >= WITHDRAW_ATTEMPTS => {
                let attempts = *attempts;
                let record = self.records.remove(key)?;
                self.forget(record, &Err(FlowError::NoAnswer { attempts }));
                return None;
            }
            State::Leaving { attempts, next } => {
                *next = now + pause_after(*attempts).mul_f64(jitter);
                *attempts += 1;
                true
            }
        };
        let mut message = if is_withdraw {
            ControlMessage::Withdraw(WithdrawMessage {
                common: record.asked.common().clone(),
                kind: Some(key.kind),
            })
        } else {
            ControlMessage::clone(&record.asked)
        };
        message.common_mut().id = Some(record.id.clone());
        Some(message)
    }

    pub(super) fn state(&self, claim: &Claim) -> LeaseState {
        match self.records.get(&claim.key) {
            Some(record) if record.generation == claim.generation => match record.state {
                State::Asking { .. } if record.agreed.is_none() => LeaseState::Asking,
                State::Asking { .. } | State::Held { .. } => LeaseState::Held,
                State::Superseded { .. } | State::Leaving { .. } => LeaseState::Ended,
            },
            _ => LeaseState::Ended,
        }
    }

    /// How often a lease was asked for since the last answer.
    pub(super) fn attempts(&self, claim: &Claim) -> u32 {
        match self.records.get(&claim.key).map(|record| record.state) {
            Some(State::Asking { attempts, .. } | State::Leaving { attempts, .. }) => attempts,
            _ => 0,
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.records.is_empty()
    }

    /// The broker was closed: nobody will answer.
    pub(super) fn close(&mut self) {
        self.closed = true;
        self.by_id.clear();
        for (_, mut record) in self.records.drain() {
            settle(&mut record, &Err(FlowError::Closed));
        }
    }

    fn forget(&mut self, mut record: Record, result: &AskResult) {
        self.by_id.remove(&record.id);
        settle(&mut record, result);
    }

    fn new_id(&mut self, key: &LeaseKey) -> String {
        self.counter += 1;
        let id = format!("{}-{}", self.id_prefix, self.counter);
        self.by_id.insert(id.clone(), key.clone());
        id
    }
}

impl Record {
    fn next(&self) -> Option<Instant> {
        match self.state {
            State::Asking { next, .. }
            | State::Superseded { next }
            | State::Leaving { next, .. } => Some(next),
            State::Held { next } => next,
        }
    }
}

fn settle(record: &mut Record, result: &AskResult) {
    for waiting in record.waiting.drain(..) {
        let _ = waiting.send(result.clone());
    }
}

fn pause_after(attempts: u32) -> Duration {
    FIRST_RETRY.saturating_mul(2_u32.saturating_pow(attempts.min(10))).min(LONGEST_RETRY)
}

fn refusal(answer: &Answer) -> FlowError {
    let unknown = || ControlError::new(ErrorCode::InvalidValue, "", "the flow gave no reason");
    let error = answer.error.clone().unwrap_or_else(unknown);
    FlowError::Refused {
        code: error.code,
        pointer: error.pointer_in_object().to_owned(),
        detail: error.detail,
        flow: answer.flow.clone(),
    }
}

#[cfg(test)]
#[path = "book_tests.rs"]
mod tests;
