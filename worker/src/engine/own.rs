//! What BlazeConfig says of the worker itself: it has the documents, so it asks nobody.

use std::sync::Arc;

use blaze_runtime::config::Overlay;
use serde_json::{Map, Value};
use tokio::sync::watch;

use super::Engine;
use crate::core::messages::Delivery;
use crate::core::{ServedTarget, Standing};

/// Sections that count for a worker. How it reaches the main service and where it keeps its copies
/// is for the node file alone: a slip there could not be taken back from afar.
const SECTIONS: [&str; 1] = ["log"];

/// The worker as a service among others.
pub struct Own {
    /// Under which name it has a configuration.
    pub place: ServedTarget,
    /// Where that is told.
    pub tell: watch::Sender<Option<Overlay>>,
}

impl Engine {
    /// Tells it, if it is another one.
    pub(super) fn tell_own(&self) {
        let Some(own) = &self.outputs.own else { return };
        let standing = self.served.look_up(&own.place);
        own.tell.send_if_modified(|before| {
            let hash = standing.as_ref().map(|standing| standing.hash.as_str());
            let is_other = before.as_ref().map(|overlay| &*overlay.hash) != hash;
            if is_other {
                *before = standing.as_ref().map(overlay);
            }
            is_other
        });
    }
}

fn overlay(standing: &Standing) -> Overlay {
    // It stays in this process.
    let config = Delivery::Text.form(standing.config.value());
    let sections =
        SECTIONS.iter().filter_map(|name| Some(((*name).to_owned(), config.get(name)?.clone())));
    let tree: Map<String, Value> = sections.collect();
    Overlay {
        origin: Arc::from("BlazeConfig"),
        revision: standing.revision,
        hash: Arc::from(standing.hash.as_str()),
        tree: Arc::new(Value::Object(tree)),
    }
}
