//! What a request gets.

use std::sync::Arc;
use std::time::Instant;

use blaze_domain::config::effective::ConfigTarget;
use blaze_domain::config::state::State;
use blaze_domain::config::{Kind, Timestamp};
use blaze_domain::{DocumentName, NodeName, ServiceName};

use super::messages::{ErrorCode, GetRequest, RequestError};
use super::notice::Standing;
use super::served::Served;
use super::served_target::{ServedTarget, Source};

/// Names that are compared with one that does not exist, at most.
const MAX_COMPARED: usize = 1_000;
/// Letters that may be wrong in a name for another one to be proposed instead.
const MAX_DISTANCE: usize = 2;

/// How old what is served may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Freshness {
    /// When the worker last knew itself in sync with the main service; `None`: never.
    pub as_of: Option<Timestamp>,
    /// The time now, by the same clock.
    pub now: Timestamp,
}

/// What a request gets.
#[derive(Debug, Clone, PartialEq)]
pub enum Reply {
    /// The configuration.
    Standing(Box<Standing>),
    /// The caller has it already.
    Unchanged {
        /// Where the store stood when it became what it is.
        revision: u64,
        /// Over it.
        hash: String,
        /// Where it comes from.
        source: Source,
        /// Of which store.
        store: Option<Arc<str>>,
    },
    /// None.
    Error(RequestError),
}

/// Answers a request from what is served, and notes who asked.
///
/// A service must exist; an instance, a node or a layer without document is one that says nothing,
/// so that a service runs with what there is before anybody has written its node down.
pub fn answer(served: &mut Served, request: &GetRequest, now: Instant) -> Reply {
    match standing(served, request, now) {
        Ok(standing) if request.hash.as_ref() == Some(&standing.hash) => Reply::Unchanged {
            revision: standing.revision,
            hash: standing.hash,
            source: standing.source,
            store: standing.store,
        },
        Ok(standing) => Reply::Standing(Box::new(standing)),
        Err(error) => Reply::Error(error),
    }
}

fn standing(
    served: &mut Served,
    request: &GetRequest,
    now: Instant,
) -> Result<Standing, RequestError> {
    let node = node(served, request)?;
    if !served.is_ready() {
        let detail =
            "no configuration is there yet: neither the main service nor a copy or file gave any";
        return Err(RequestError::new(ErrorCode::NotReady, detail));
    }
    let Some(service) = &request.service else {
        return Ok(served.standing_at(ConfigTarget {
            service: None,
            instance: None,
            layer: Some(served.site().layer.clone()),
            node,
        }));
    };
    let place = ServedTarget { service: service.clone(), instance: request.instance.clone(), node };
    match served.ask(&place, now) {
        Some(standing) => Ok(standing),
        None => {
            let hint = near(served.state(), service);
            let hint = hint.map_or_else(String::new, |name| format!("; did you mean {name}?"));
            let detail = format!("no service {service}{hint}");
            Err(RequestError::new(ErrorCode::NotFound, detail))
        }
    }
}

/// Where the caller runs.
fn node(served: &Served, request: &GetRequest) -> Result<Option<NodeName>, RequestError> {
    match (&served.site().node, &request.node) {
        (Some(own), Some(asked)) if own != asked => {
            let detail = format!("node: this worker serves {own} alone, not {asked}");
            Err(RequestError::new(ErrorCode::InvalidRequest, detail))
        }
        (Some(own), _) => Ok(Some(own.clone())),
        (None, asked) => Ok(asked.clone()),
    }
}

/// A service whose name is nearly the same.
fn near<'s>(state: &'s State, service: &ServiceName) -> Option<&'s DocumentName> {
    let wanted = service.as_str();
    state
        .of_kind(Kind::Service, None)
        .take(MAX_COMPARED)
        .map(|(key, _)| key.name())
        .filter(|name| name.as_str().len().abs_diff(wanted.len()) <= MAX_DISTANCE)
        .map(|name| (strsim::damerau_levenshtein(name.as_str(), wanted), name))
        .filter(|(distance, _)| *distance <= MAX_DISTANCE)
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, name)| name)
}

#[cfg(test)]
#[path = "answer_tests.rs"]
mod tests;
