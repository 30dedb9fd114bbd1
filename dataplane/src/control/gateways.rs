//! Whether this flow is on the inter scope for the flows that share its layer broker, and how it
//! comes there and goes.
//!
//! ```text
//! listening ─► joining ─► gateway ─► leaving (2 s: both ways) ─► closing ─┐
//!     │           ▲                                                     ▼
//!     └───────────┴──────────────────── member ◄────────────────────────┘
//! ```
//!
//! A gateway whose inter scope stops working joins anew, and meanwhile is none; likewise one that
//! reaches nobody there while another gateway of its group does.
//!
//! A flow that joins says so when it knows what is outside. One that leaves says so first: the
//! others carry for it while what it sends itself still arrives, so nothing is missed, and repeats
//! have the same identity.

use std::time::{Duration, Instant};

use blaze_domain::FlowId;
use blaze_domain::node_file::AutoBool;

use super::replicas::KNOW_OTHERS;
use super::{ControlConfig, ControlCore, LISTEN, Output};
use crate::plan::gateway::{self, Choice};
use crate::world::{FlowState, Role};

/// A flow that is needed joins when it has seemed so for this long …
const NEEDED_FOR: Duration = Duration::from_millis(500);
/// … one that may, because the group has become small, after this …
const WELCOME_FOR: Duration = Duration::from_secs(60);
/// … and one that is not needed any more leaves after this.
const UNNEEDED_FOR: Duration = Duration::from_secs(5);
/// A flow that cannot join within this time says that it cannot, and another one does.
const CANNOT: Duration = Duration::from_secs(15);
/// A gateway that has reached nobody for this long, though another one does, is none until it does.
const CUT_OFF: Duration = Duration::from_secs(5);
/// Whoever leaves the inter scope has heard of the flows there from the gateways within this time.
const HEARD_OF: Duration = Duration::from_secs(30);
/// A flow that was of use before it became a gateway lets another one carry for it so long: well
/// below the two seconds in which that one does, and above what messages need on their way over it.
const ENTER: Duration = Duration::from_secs(1);
/// One that leaves sends and takes what it did before for this long; its peers are told half way.
const LEAVE: Duration = Duration::from_secs(2);

/// Where a flow is on its way to the inter scope and from there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Stage {
    /// It listens on the channel of the layer broker who is there.
    #[default]
    Listening,
    /// It joins the inter scope, and listens there once it has.
    Joining {
        /// Since when it tries.
        since: Instant,
        /// Since when it is there.
        there: Option<Instant>,
    },
    /// It is there.
    Gateway,
    /// It has said that it will not be, and takes and sends both ways.
    Leaving {
        /// Since when.
        since: Instant,
    },
    /// What is on its way is let out.
    Closing,
    /// It is not there.
    Member,
}

impl Stage {
    /// As people read it.
    #[must_use]
    pub fn as_str(&self) -> &'static str {
        match self {
            Self::Listening => "listening",
            Self::Joining { .. } => "joining",
            Self::Gateway => "gateway",
            Self::Leaving { .. } => "leaving",
            Self::Closing => "closing",
            Self::Member => "member",
        }
    }
}

/// What the core remembers of it.
#[derive(Debug, Default)]
pub(super) struct Gateways {
    stage: Stage,
    /// Since when the channel of the layer broker is heard.
    heard_since: Option<Instant>,
    /// When it last left the inter scope.
    left: Option<Instant>,
    /// What was chosen last, and since when.
    choice: Option<(Choice, Instant)>,
    /// It did not come to the inter scope in time, or has lost it.
    cannot: bool,
    /// Since when it has reached nobody there, though others do.
    cut_off: Option<Instant>,
    /// Since when it is a gateway, while another flow still carries for it.
    entered: Option<Instant>,
    /// What Hello on the inter scope says.
    shown: FlowState,
}

impl ControlConfig {
    /// Whether the flow is on the inter scope from its start, because nobody else could be for it,
    /// or it is to be always.
    #[must_use]
    pub fn begins_inside(&self) -> bool {
        self.inter_scope && (self.replicas.is_none() || self.gateway == AutoBool::Yes)
    }
}

impl Gateways {
    pub(super) fn new(config: &ControlConfig) -> Self {
        let stage = match (config.replicas, config.inter_scope) {
            (None, _) => Stage::Gateway,
            (Some(_), true) if config.gateway == AutoBool::Yes => Stage::Gateway,
            (Some(_), true) if config.gateway == AutoBool::Auto => Stage::Listening,
            (Some(_), _) => Stage::Member,
        };
        Self { stage, ..Self::default() }
    }

    pub(super) fn role(&self) -> Role {
        match self.stage {
            Stage::Gateway if self.entered.is_some() => Role::NewGateway,
            Stage::Gateway => Role::Gateway,
            Stage::Leaving { .. } => Role::Leaving,
            Stage::Listening | Stage::Joining { .. } | Stage::Closing | Stage::Member => {
                Role::Member
            }
        }
    }

    /// Whether what is heard on the inter scope is for this flow.
    pub(super) fn is_inside(&self) -> bool {
        !matches!(self.stage, Stage::Listening | Stage::Member)
    }

    /// What it says that its node file says.
    pub(super) fn setting(&self, config: &ControlConfig) -> AutoBool {
        if self.cannot || !config.inter_scope { AutoBool::No } else { config.gateway }
    }

    /// Whether flows elsewhere that are unknown now may become known another way in a moment.
    pub(super) fn has_just_left(&self, now: Instant) -> bool {
        self.left.is_some_and(|at| now.saturating_duration_since(at) < HEARD_OF)
    }

    fn heard_for(&self, now: Instant) -> Duration {
        self.heard_since.map_or(Duration::ZERO, |since| now.saturating_duration_since(since))
    }

    /// How long the same has been chosen.
    fn chosen_for(&mut self, now: Instant, choice: Choice) -> Duration {
        match self.choice {
            Some((held, since)) if held == choice => now.saturating_duration_since(since),
            _ => {
                self.choice = Some((choice, now));
                Duration::ZERO
            }
        }
    }
}

impl ControlCore {
    /// The channel of the layer broker is heard from now on.
    pub fn hears_replicas(&mut self, now: Instant) {
        self.gateways.heard_since.get_or_insert(now);
    }

    /// The flow is on the inter scope.
    pub fn joined(&mut self, now: Instant) {
        if let Stage::Joining { there, .. } = &mut self.gateways.stage {
            there.get_or_insert(now);
        }
    }

    /// The inter scope does not work here, and has not for a while: others are to be on it for the
    /// group.
    pub fn lost(&mut self, now: Instant) {
        let is_one_of_many = self.config.replicas.is_some();
        if is_one_of_many && matches!(self.gateways.stage, Stage::Gateway | Stage::Joining { .. }) {
            self.gateways.cannot = true;
            let stage = Stage::Joining { since: now, there: None };
            self.enter(now, stage);
        }
    }

    /// The flow is not on the inter scope any more.
    pub fn left(&mut self, now: Instant) {
        if self.gateways.stage == Stage::Closing {
            self.enter(now, Stage::Member);
        }
        self.gateways.left = Some(now);
        let changed = self.registry.leave_link(now);
        self.touch(now, changed);
    }

    /// Where the flow is on its way to the inter scope and from there.
    #[must_use]
    pub fn stage(&self) -> Stage {
        self.gateways.stage
    }

    /// The gateways of the own group that live, this flow among them if it is one.
    pub fn gateways(&self) -> impl Iterator<Item = &FlowId> {
        gateway::gateways(self.registry.world())
    }

    /// Whether it has listened for as long as it takes to know who is there.
    pub(super) fn has_listened(&self, now: Instant) -> bool {
        match self.gateways.stage {
            // Without the inter scope it is still of use within its layer.
            Stage::Joining { .. } if self.gateways.cannot => self.gateways.heard_for(now) >= LISTEN,
            Stage::Listening | Stage::Joining { .. } if self.state == FlowState::Starting => false,
            Stage::Member if self.config.inter_scope => self.gateways.heard_for(now) >= LISTEN,
            _ => !self.config.inter_scope || now.saturating_duration_since(self.started) >= LISTEN,
        }
    }

    /// Does what the choice of gateways makes due.
    pub(super) fn follow_choice(&mut self, now: Instant) {
        let concerned = self.config.replicas.is_some() && self.config.inter_scope;
        if !concerned || self.state == FlowState::Draining {
            return;
        }
        self.gateways.cut_off =
            if self.registry.is_cut_off() { self.gateways.cut_off.or(Some(now)) } else { None };
        if self.gateways.entered.is_some_and(|at| now.saturating_duration_since(at) >= ENTER) {
            self.gateways.entered = None;
            self.enter(now, self.gateways.stage);
        }
        match self.gateways.stage {
            Stage::Joining { since, there } => self.join(now, since, there),
            Stage::Gateway if self.is_cut_off(now) => {
                self.gateways.cannot = true;
                let stage = Stage::Joining { since: now, there: Some(now) };
                self.enter(now, stage);
            }
            Stage::Leaving { since } => {
                self.show_on_link(now);
                if now.saturating_duration_since(since) >= LEAVE {
                    self.enter(now, Stage::Closing);
                    self.outputs.push_back(Output::Inter { join: false });
                }
            }
            Stage::Closing => {}
            Stage::Listening | Stage::Gateway | Stage::Member => self.choose(now),
        }
    }

    fn is_cut_off(&self, now: Instant) -> bool {
        let since = self.gateways.cut_off;
        since.is_some_and(|since| now.saturating_duration_since(since) >= CUT_OFF)
    }

    fn choose(&mut self, now: Instant) {
        let choice = gateway::choose(self.registry.world());
        let held = self.gateways.chosen_for(now, choice);
        let next = match (self.gateways.stage, choice) {
            (Stage::Listening, _) if self.gateways.heard_for(now) < LISTEN => return,
            (Stage::Listening, Choice::No) => Stage::Member,
            (Stage::Member, Choice::Needed) if held < NEEDED_FOR => return,
            (Stage::Member, Choice::Welcome) if held < WELCOME_FOR => return,
            (Stage::Listening | Stage::Member, Choice::Needed | Choice::Welcome) => {
                self.outputs.push_back(Output::Inter { join: true });
                Stage::Joining { since: now, there: None }
            }
            (Stage::Gateway, Choice::No) if held >= UNNEEDED_FOR => Stage::Leaving { since: now },
            _ => return,
        };
        self.enter(now, next);
    }

    /// On the inter scope it is a gateway when it has heard who is there and what they have.
    fn join(&mut self, now: Instant, since: Instant, there: Option<Instant>) {
        let Some(there) = there else {
            if !self.gateways.cannot && now.saturating_duration_since(since) >= CANNOT {
                self.gateways.cannot = true;
                self.enter(now, self.gateways.stage);
            }
            return;
        };
        // It is there, but of no use. Whoever has just come reaches nobody for a moment: a flow
        // that was ready meanwhile would send over the layer broker first, and its messages would
        // take two ways when it becomes a gateway.
        let listened = now.saturating_duration_since(there);
        let cut_off = self.gateways.cut_off.is_some();
        let cannot = cut_off && (self.gateways.cannot || listened >= CUT_OFF);
        if cannot != self.gateways.cannot {
            self.gateways.cannot = cannot;
            self.enter(now, self.gateways.stage);
        }
        if cut_off {
            return;
        }
        if listened >= LISTEN && (self.registry.knows_link() || listened >= LISTEN + KNOW_OTHERS) {
            // One that has just started has sent nothing another way.
            self.gateways.entered = (self.state == FlowState::Ready).then_some(now);
            self.enter(now, Stage::Gateway);
        }
    }

    fn enter(&mut self, now: Instant, stage: Stage) {
        if std::mem::discriminant(&self.gateways.stage) != std::mem::discriminant(&stage) {
            let (before, after) = (self.gateways.stage.as_str(), stage.as_str());
            tracing::info!(before, after, "its part between the layer and the inter scope");
        }
        self.gateways.stage = stage;
        self.gateways.choice = None;
        if stage != Stage::Gateway {
            self.gateways.entered = None;
        }
        let setting = self.gateways.setting(&self.config);
        let changed = self.registry.set_role(setting, self.gateways.role());
        self.touch(now, changed);
        self.show_on_link(now);
        self.hello_now();
    }

    /// Says on the inter scope what flows there are to know of this one's state.
    pub(super) fn show_on_link(&mut self, now: Instant) {
        let state = match self.gateways.stage {
            _ if self.state == FlowState::Draining => FlowState::Draining,
            Stage::Gateway => self.state,
            // Half way its peers are told to send elsewhere.
            Stage::Leaving { since } if now.saturating_duration_since(since) < LEAVE / 2 => {
                self.state
            }
            Stage::Leaving { .. } | Stage::Closing => FlowState::Draining,
            Stage::Listening | Stage::Joining { .. } | Stage::Member => FlowState::Starting,
        };
        if state != self.gateways.shown {
            self.gateways.shown = state;
            self.outputs.push_back(Output::State(state));
        }
    }
}
