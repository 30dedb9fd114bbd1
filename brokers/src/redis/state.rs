//! What is known of the connections and of the scope, and what follows from it: the status, and who
//! may read and write.
//!
//! ```text
//! writer, reader, owner ──► State::change ──► Conditions ──┬─► status
//!                                                          ├─► gates of the publishers
//!                                                          └─► whether messages are delivered
//! ```

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use parking_lot::Mutex;
use tokio::sync::watch;

use super::gate::Gate;
use crate::port::{BrokerStatus, Health, StatusCell};

/// One TCP connection. Large messages have connections of their own, so that small ones never stand
/// behind them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Line {
    PublishSmall,
    PublishLarge,
    ReadSmall,
    ReadLarge,
}

impl Line {
    pub(super) const ALL: [Self; 4] =
        [Self::PublishSmall, Self::PublishLarge, Self::ReadSmall, Self::ReadLarge];

    pub(super) fn publish(large: bool) -> Self {
        if large { Self::PublishLarge } else { Self::PublishSmall }
    }

    pub(super) fn read(large: bool) -> Self {
        if large { Self::ReadLarge } else { Self::ReadSmall }
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::PublishSmall => "publish",
            Self::PublishLarge => "publish-large",
            Self::ReadSmall => "read",
            Self::ReadLarge => "read-large",
        }
    }

    pub(super) fn is_large(self) -> bool {
        matches!(self, Self::PublishLarge | Self::ReadLarge)
    }

    pub(super) fn reads(self) -> bool {
        matches!(self, Self::ReadSmall | Self::ReadLarge)
    }

    pub(super) fn index(self) -> usize {
        self as usize
    }
}

/// Why there is no connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Failure {
    /// The server answered and said no; otherwise nobody is there, or the connection was lost.
    pub(super) is_refusal: bool,
    /// For people.
    pub(super) why: String,
}

impl Failure {
    pub(super) fn away(why: &str) -> Self {
        Self { is_refusal: false, why: why.to_owned() }
    }

    pub(super) fn refused(why: &str) -> Self {
        Self { is_refusal: true, why: why.to_owned() }
    }
}

/// What one connection is doing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum LineState {
    /// Nobody needs it.
    Unused,
    /// Its first connection is being made.
    Starting,
    /// The server answers, and all channels are subscribed.
    Up,
    /// The connection stands and the server does not answer.
    Silent,
    /// No connection.
    Failed(Failure),
}

impl LineState {
    /// Whether a connection stands and was up.
    pub(super) fn is_connected(&self) -> bool {
        matches!(self, Self::Up | Self::Silent)
    }
}

/// Whose scope it is, as far as the server told.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum ScopeOwnership {
    /// A service: the scope is none of its business.
    Free,
    /// A flow that has not claimed it yet.
    Unclaimed,
    /// Ours.
    Owned,
    /// Another flow's, whose name this is.
    HeldBy(String),
    /// It was ours and could not be renewed, or could not be claimed.
    Lost(String),
}

/// All that the status depends on.
#[derive(Debug)]
pub(super) struct Conditions {
    lines: [LineState; 4],
    scope: ScopeOwnership,
    /// A flow to which this one gives way.
    pub(super) stand_back: Option<String>,
    /// Program and version of the server.
    pub(super) server: String,
    pub(super) closed: bool,
    /// How often a reading connection was lost while it was up.
    interruptions: u64,
    place: String,
    was_up: bool,
    was_owned: bool,
}

impl Conditions {
    fn new(scope: ScopeOwnership, place: String) -> Self {
        // Those for large messages come with the first large publisher or reader.
        let start = |line: Line| {
            if line.is_large() { LineState::Unused } else { LineState::Starting }
        };
        Self {
            lines: Line::ALL.map(start),
            scope,
            stand_back: None,
            server: String::new(),
            closed: false,
            interruptions: 0,
            place,
            was_up: false,
            was_owned: false,
        }
    }

    pub(super) fn line(&self, line: Line) -> &LineState {
        &self.lines[line.index()]
    }

    pub(super) fn set_line(&mut self, line: Line, state: LineState) {
        if line.reads() && self.line(line).is_connected() && matches!(state, LineState::Failed(_)) {
            self.interruptions += 1;
        }
        self.lines[line.index()] = state;
        self.was_up |= self.core_is_up();
    }

    pub(super) fn scope(&self) -> &ScopeOwnership {
        &self.scope
    }

    pub(super) fn set_scope(&mut self, scope: ScopeOwnership) {
        self.was_owned |= scope == ScopeOwnership::Owned;
        self.scope = scope;
    }

    /// The server may have lost whose scope it is: until the next claim it is nobody's.
    pub(super) fn forget_owner(&mut self) {
        if self.scope == ScopeOwnership::Owned {
            self.scope = ScopeOwnership::Unclaimed;
        }
    }

    fn core_is_up(&self) -> bool {
        let up = |line: Line| *self.line(line) == LineState::Up;
        up(Line::PublishSmall) && up(Line::ReadSmall)
    }

    fn scope_open(&self) -> bool {
        !self.closed
            && self.stand_back.is_none()
            && matches!(self.scope, ScopeOwnership::Free | ScopeOwnership::Owned)
    }

    /// Whether messages for a connection are taken.
    fn accepts(&self, line: Line) -> bool {
        self.scope_open()
            && match self.line(line) {
                LineState::Up => true,
                LineState::Starting => self.core_is_up(),
                _ => false,
            }
    }

    fn health(&self) -> (Health, String) {
        if self.closed {
            return (Health::Closed, "closed".to_owned());
        }
        if let Some(trouble) = self.trouble() {
            return trouble;
        }
        let in_use = |whom: &str| (Health::InUse, format!("scope_in_use: {whom} holds it"));
        if let Some(whom) = &self.stand_back {
            return in_use(whom);
        }
        match &self.scope {
            ScopeOwnership::Unclaimed => {
                let health = if self.was_owned { Health::Down } else { Health::Connecting };
                (health, format!("claiming the scope at {}", self.place))
            }
            ScopeOwnership::HeldBy(whom) => in_use(whom),
            ScopeOwnership::Lost(why) => (Health::Down, why.clone()),
            ScopeOwnership::Free | ScopeOwnership::Owned => (Health::Up, self.server_detail()),
        }
    }

    fn server_detail(&self) -> String {
        match self.interruptions {
            0 => self.server.clone(),
            1 => format!("{}; reading was interrupted once", self.server),
            count => format!("{}; reading was interrupted {count} times", self.server),
        }
    }

    /// What is wrong with the connections.
    fn trouble(&self) -> Option<(Health, String)> {
        let waiting = if self.was_up { Health::Down } else { Health::Connecting };
        let place = &self.place;
        for state in &self.lines {
            match state {
                LineState::Failed(Failure { is_refusal, why }) => {
                    let health = if *is_refusal { Health::Down } else { waiting };
                    return Some((health, format!("{place}: {why}")));
                }
                LineState::Silent => return Some((waiting, format!("{place} does not answer"))),
                LineState::Unused | LineState::Starting | LineState::Up => {}
            }
        }
        (!self.core_is_up()).then(|| (waiting, format!("connecting to {place}")))
    }
}

/// The conditions, and what follows from them.
pub(super) struct State {
    conditions: Mutex<Conditions>,
    status: StatusCell,
    /// Counts changes of the conditions.
    version: watch::Sender<u64>,
    gates: [Arc<Gate>; 2],
    delivers: AtomicBool,
    /// Whether it was told that the server could not be reached from the beginning.
    told: AtomicBool,
}

impl State {
    pub(super) fn new(scope: ScopeOwnership, place: String, gates: [Arc<Gate>; 2]) -> Self {
        let conditions = Conditions::new(scope, place);
        let (health, detail) = conditions.health();
        Self {
            conditions: Mutex::new(conditions),
            status: StatusCell::new(health, detail),
            version: watch::Sender::new(0),
            gates,
            delivers: AtomicBool::new(false),
            told: AtomicBool::new(false),
        }
    }

    /// Changes the conditions; all that follows is done when this returns.
    pub(super) fn change(&self, change: impl FnOnce(&mut Conditions)) {
        let mut conditions = self.conditions.lock();
        change(&mut conditions);
        self.delivers.store(conditions.scope_open(), Ordering::Release);
        for (gate, line) in self.gates.iter().zip([Line::PublishSmall, Line::PublishLarge]) {
            gate.set_open(conditions.accepts(line));
        }
        self.tell(&conditions);
        self.version.send_modify(|version| *version += 1);
    }

    /// Sets what a connection is doing, if it is not doing that already.
    pub(super) fn set_line(&self, line: Line, state: LineState) {
        if self.read(|conditions| *conditions.line(line) != state) {
            self.change(|conditions| conditions.set_line(line, state));
        }
    }

    /// Sets whether the server answers on a connection that stands. Returns whether that changed.
    pub(super) fn set_silent(&self, line: Line, silent: bool) -> bool {
        let (from, to) = if silent {
            (LineState::Up, LineState::Silent)
        } else {
            (LineState::Silent, LineState::Up)
        };
        let changes = self.read(|conditions| *conditions.line(line) == from);
        if changes {
            self.change(|conditions| conditions.set_line(line, to));
        }
        changes
    }

    /// Sets whose scope it is, if that is not known already.
    pub(super) fn set_scope(&self, scope: ScopeOwnership) {
        if self.read(|conditions| *conditions.scope() != scope) {
            self.change(|conditions| conditions.set_scope(scope));
        }
    }

    fn tell(&self, conditions: &Conditions) {
        let (health, detail) = conditions.health();
        let is_away =
            |line: &LineState| matches!(line, LineState::Failed(failure) if !failure.is_refusal);
        let unreachable = health == Health::Connecting && conditions.lines.iter().any(is_away);
        if unreachable && !self.told.swap(true, Ordering::AcqRel) {
            tracing::warn!(detail, "redis cannot be reached, trying on");
        }
        let Some(turned) = self.status.set(health, &detail) else {
            return;
        };
        match health {
            Health::Up if turned => tracing::info!(detail, "redis is up"),
            Health::Down | Health::InUse if turned => {
                tracing::warn!(detail, "redis cannot be used");
            }
            _ => tracing::debug!(?health, detail, "redis"),
        }
    }

    /// Looks at the conditions.
    pub(super) fn read<T>(&self, look: impl FnOnce(&Conditions) -> T) -> T {
        look(&self.conditions.lock())
    }

    pub(super) fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.status.subscribe()
    }

    /// Changes whenever a condition does.
    pub(super) fn version(&self) -> watch::Receiver<u64> {
        self.version.subscribe()
    }

    /// Whether messages are handed to subscribers.
    pub(super) fn delivers(&self) -> bool {
        self.delivers.load(Ordering::Acquire)
    }

    /// Why nothing can be asked of the server, if it is not up.
    pub(super) fn why_not_up(&self) -> Option<String> {
        let status = self.status.borrow();
        (status.health != Health::Up).then(|| status.detail.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn conditions(scope: ScopeOwnership) -> Conditions {
        let mut conditions = Conditions::new(scope, "host:1".to_owned());
        conditions.server = "redis 7".to_owned();
        conditions
    }

    fn away(why: &str) -> LineState {
        LineState::Failed(Failure::away(why))
    }

    fn up(scope: ScopeOwnership) -> Conditions {
        let mut conditions = conditions(scope);
        conditions.set_line(Line::PublishSmall, LineState::Up);
        conditions.set_line(Line::ReadSmall, LineState::Up);
        conditions
    }

    #[test]
    fn up_needs_both_core_connections() {
        let mut c = conditions(ScopeOwnership::Free);
        assert_eq!(c.health().0, Health::Connecting);
        c.set_line(Line::PublishSmall, LineState::Up);
        assert_eq!(c.health().0, Health::Connecting);
        c.set_line(Line::ReadSmall, LineState::Up);
        assert_eq!(c.health(), (Health::Up, "redis 7".to_owned()));
        assert!(c.accepts(Line::PublishSmall) && !c.accepts(Line::PublishLarge));
        c.set_line(Line::PublishLarge, LineState::Starting);
        assert_eq!(
            c.health().0,
            Health::Up,
            "a connection that is first needed now takes nothing away"
        );
        assert!(c.accepts(Line::PublishLarge));
        c.set_line(Line::PublishLarge, away("refused"));
        assert_eq!(c.health(), (Health::Down, "host:1: refused".to_owned()));
        assert!(!c.accepts(Line::PublishLarge) && c.accepts(Line::PublishSmall));
    }

    #[test]
    fn a_server_that_was_never_there_is_connecting_and_one_that_says_no_is_down() {
        let mut c = conditions(ScopeOwnership::Free);
        c.set_line(Line::ReadSmall, away("connection refused"));
        assert_eq!(c.health(), (Health::Connecting, "host:1: connection refused".to_owned()));
        let refused = Failure { is_refusal: true, why: "WRONGPASS".to_owned() };
        c.set_line(Line::PublishSmall, LineState::Failed(refused));
        assert_eq!(c.health(), (Health::Down, "host:1: WRONGPASS".to_owned()));
    }

    #[test]
    fn a_silent_server_is_down_and_takes_nothing() {
        let mut c = up(ScopeOwnership::Free);
        c.set_line(Line::PublishSmall, LineState::Silent);
        assert_eq!(c.health().0, Health::Down);
        assert!(!c.accepts(Line::PublishSmall));
    }

    #[test]
    fn a_scope_that_is_not_ours_is_neither_read_nor_written() {
        for (scope, health) in [
            (ScopeOwnership::Unclaimed, Health::Connecting),
            (ScopeOwnership::HeldBy("edge/other".to_owned()), Health::InUse),
            (ScopeOwnership::Lost("not renewed".to_owned()), Health::Down),
        ] {
            let c = up(scope.clone());
            assert_eq!(c.health().0, health, "{scope:?}");
            assert!(!c.scope_open() && !c.accepts(Line::PublishSmall), "{scope:?}");
        }
        let mut c = up(ScopeOwnership::Owned);
        assert_eq!(c.health().0, Health::Up);
        c.set_scope(ScopeOwnership::Owned);
        c.forget_owner();
        assert_eq!(c.health().0, Health::Down, "the server was restarted");
        c.set_scope(ScopeOwnership::Owned);
        c.stand_back = Some("fog/first".to_owned());
        assert_eq!(c.health(), (Health::InUse, "scope_in_use: fog/first holds it".to_owned()));
        assert!(!c.accepts(Line::PublishSmall));
    }

    #[test]
    fn interruptions_of_reading_are_counted() {
        let mut c = up(ScopeOwnership::Free);
        for _ in 0..2 {
            c.set_line(Line::ReadSmall, away("reset"));
            c.set_line(Line::ReadSmall, away("refused"));
            c.set_line(Line::ReadSmall, LineState::Up);
        }
        c.set_line(Line::PublishSmall, away("reset"));
        c.set_line(Line::PublishSmall, LineState::Up);
        assert_eq!(c.health(), (Health::Up, "redis 7; reading was interrupted 2 times".to_owned()));
        c.closed = true;
        assert_eq!(c.health().0, Health::Closed);
    }
}
