//! What a token sees and may change: the one place that decides it, for reads and writes of every
//! interface.

use blaze_domain::LayerName;
use blaze_domain::config::{Code, Document, Key, Kind, Problem};

use crate::auth::{Claims, Right, Role, allowed, unbound};
use blaze_domain::config::effective::ConfigTarget;
use blaze_domain::config::placement::{Placement, placement, rollout_target};
use blaze_domain::config::state::State;

/// What one token sees.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct View {
    layer: Option<LayerName>,
}

/// The view of a token.
pub(crate) fn view(claims: &Claims) -> View {
    View { layer: claims.layer.clone() }
}

/// Refuses what a role does not allow.
pub(crate) fn authorize(claims: &Claims, right: Right) -> Result<(), Problem> {
    allowed(claims, right).map_err(|reason| {
        let needed = match right {
            Right::Read => "viewer, operator, admin or worker",
            Right::Write => "operator or admin",
            Right::Admin => "admin",
            Right::Sync => "worker",
        };
        let detail = format!("the token has no role for this; it needs {needed}");
        Problem::new(Code::PermissionDenied, detail).because(reason)
    })
}

/// Refuses what concerns the whole system to all but administrators who are bound to no layer: who
/// may make tokens could make one that is bound to nothing.
pub(crate) fn authorize_whole(claims: &Claims) -> Result<(), Problem> {
    authorize(claims, Right::Admin)?;
    unbound(claims).map_err(|reason| {
        let detail = "this concerns the whole system; the token is bound to a layer";
        Problem::new(Code::PermissionDenied, detail).because(reason)
    })
}

/// Whether a token may have secrets as text.
pub(crate) fn may_reveal(claims: &Claims) -> bool {
    claims.roles.iter().any(|role| role == Role::Admin.as_str())
}

impl View {
    /// What a layer sees.
    pub(crate) fn of_layer(layer: &LayerName) -> Self {
        Self { layer: Some(layer.clone()) }
    }

    /// The layer that it is bound to.
    pub(crate) fn layer(&self) -> Option<&LayerName> {
        self.layer.as_ref()
    }

    /// Whether it is not the whole system.
    pub(crate) fn is_bound(&self) -> bool {
        self.layer.is_some()
    }

    /// Whether a document that counts there is seen.
    pub(crate) fn sees(&self, placement: &Placement) -> bool {
        self.layer.as_ref().is_none_or(|layer| placement.visible.contains(layer))
    }

    /// Whether a document is seen.
    pub(crate) fn sees_document(&self, state: &State, document: &Document) -> bool {
        self.layer.is_none() || self.sees(&placement(state, document))
    }

    /// Whether the effective configuration at a place may be told of: that of a service or instance
    /// that is seen, in the layer itself or nowhere in particular.
    pub(crate) fn sees_place(&self, state: &State, at: &ConfigTarget) -> bool {
        let Some(layer) = &self.layer else { return true };
        let sees = |key: &Key| {
            state.get(key).is_some_and(|held| self.sees_document(state, &held.document))
        };
        let Some(service) = &at.service else {
            return at.layer.as_ref() == Some(layer);
        };
        match &at.instance {
            Some(instance) => sees(&Key::instance(service.clone(), instance.clone())),
            None => at.layer.as_ref().is_none_or(|at| at == layer) && sees(&Key::service(service)),
        }
    }

    /// Refuses a layer that is not the token's own.
    pub(crate) fn check_layer(&self, layer: &LayerName) -> Result<(), Problem> {
        match &self.layer {
            Some(own) if own != layer => Err(self.outside(&format!("layer {layer}"))),
            _ => Ok(()),
        }
    }

    /// Refuses a key that is outside the view, existing or not.
    pub(crate) fn check_key(&self, state: &State, key: &Key) -> Result<(), Problem> {
        if self.layer.is_none() {
            return Ok(());
        }
        match state.get(key) {
            Some(held) if self.sees_document(state, &held.document) => Ok(()),
            _ => Err(self.outside(&key.to_string())),
        }
    }

    /// Refuses a key that a write names, if it is outside the view, before anything of it is told.
    /// What does not exist is outside of every layer where it `must_exist`. Services belong to all
    /// layers.
    pub(crate) fn check_named(
        &self,
        state: &State,
        key: &Key,
        must_exist: bool,
    ) -> Result<(), Problem> {
        if self.layer.is_none() {
            return Ok(());
        }
        let inside = match state.get(key) {
            Some(held) => self.sees_document(state, &held.document),
            None => !must_exist,
        };
        if inside && key.kind() != Kind::Service {
            Ok(())
        } else {
            Err(self.outside(&key.to_string()))
        }
    }

    /// Refuses a change that reaches beyond the layer that the token is bound to: the document
    /// before and after must count in that layer alone. Services belong to all layers.
    pub(crate) fn check_write(
        &self,
        (before, was): (&State, Option<&Document>),
        (after, is): (&State, Option<&Document>),
    ) -> Result<(), Problem> {
        let Some(layer) = &self.layer else { return Ok(()) };
        for (state, document) in [(before, was), (after, is)] {
            let Some(document) = document else { continue };
            let own = match document.key.kind() {
                Kind::Service => false,
                // As if the target itself were changed: one that is placed nowhere counts in other
                // layers too.
                Kind::Rollout => {
                    let target = rollout_target(document).and_then(|key| state.get(&key));
                    target.is_some_and(|target| {
                        let place = placement(state, &target.document);
                        place.layer.as_ref() == Some(layer) && place.visible.contains(layer)
                    })
                }
                // An instance of a service that the layer does not see is outside too, as if there
                // were no such service.
                Kind::Layer | Kind::Node | Kind::Instance => {
                    let placement = placement(state, document);
                    placement.layer.as_ref() == Some(layer) && placement.visible.contains(layer)
                }
            };
            if !own {
                return Err(self.outside(&document.key.to_string()));
            }
        }
        Ok(())
    }

    /// The same answer whether it exists or not.
    pub(crate) fn outside(&self, what: &str) -> Problem {
        let layer = self.layer.as_ref().map_or("", LayerName::as_str);
        let detail = format!("the token is bound to layer {layer}; {what} is outside of it");
        Problem::new(Code::PermissionDenied, detail).because("outside the token's layer")
    }
}
