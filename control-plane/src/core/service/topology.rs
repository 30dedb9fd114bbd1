//! Reads of the system as a whole.

use blaze_domain::config::{Key, Kind, Problem, canonical};
use blaze_domain::{LayerName, NodeName, ServiceName};
use serde_json::{Value, json};

use blaze_domain::config::placement::placement;
use blaze_domain::config::state::State;
use super::super::types::{Answer, Caller, ReadOptions};
use super::super::view::{View, view};
use super::read::answer;
use super::{ConfigService, not_found};
use crate::auth::Right;

impl ConfigService {
    /// Layers, nodes and services, with what is known of them.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn topology(&self, caller: &Caller, read: &ReadOptions) -> Result<Answer<Value>, Problem> {
        self.authorize(&caller.claims, Right::Read)?;
        let state = self.read_state(read).await?;
        let view = view(&caller.claims);
        let layers = state
            .of_kind(Kind::Layer, None)
            .filter(|(_, held)| view.sees_document(&state, &held.document))
            .map(|(key, held)| {
                let layer = LayerName::from(key.name());
                let nodes = state.in_layer(&layer).filter(|key| key.kind() == Kind::Node);
                json!({
                    "name": layer.as_str(),
                    "kind": held.document.spec_member("kind"),
                    "nodes": nodes.map(|key| node_json(&state, &view, key)).collect::<Vec<_>>(),
                })
            });
        let layers: Vec<Value> = layers.collect();
        let value = json!({ "revision": state.revision(), "layers": layers, "links": [] });
        Ok(answer(&state, value))
    }

    /// Workers that are known.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn workers(&self, caller: &Caller, read: &ReadOptions) -> Result<Answer<Value>, Problem> {
        self.authorize(&caller.claims, Right::Read)?;
        let state = self.read_state(read).await?;
        let value = json!({ "items": [], "revision": state.revision(), "next_page_token": "" });
        Ok(answer(&state, value))
    }

    /// What a layer's worker should hold.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn digest(
        &self,
        caller: &Caller,
        layer: &LayerName,
        read: &ReadOptions,
    ) -> Result<Answer<Value>, Problem> {
        self.authorize(&caller.claims, Right::Read)?;
        let state = self.read_state(read).await?;
        view(&caller.claims).check_layer(layer)?;
        let key = Key::layer(layer);
        state.get(&key).ok_or_else(|| not_found(&key, &state))?;
        let value = json!({ "revision": state.revision(), "digest": digest(&state, layer) });
        Ok(answer(&state, value))
    }
}

/// Digest of a layer's view.
pub(crate) fn digest(state: &State, layer: &LayerName) -> String {
    let seen = state
        .all()
        .filter(|(_, held)| placement(state, &held.document).visible.contains(layer));
    canonical::digest(seen.map(|(key, held)| {
        let service = key.service_name().map(ServiceName::as_str);
        (key.kind(), service, key.name().as_str(), held.document.revision)
    }))
}

fn node_json(state: &State, view: &View, key: &Key) -> Value {
    let node = NodeName::from(key.name());
    let kind = state
        .get(key)
        .and_then(|held| held.document.spec_member("type").cloned());
    let seen = |key: &&Key| {
        let held = state.get(key);
        held.is_some_and(|held| view.sees_document(state, &held.document))
    };
    let services = state.on_node(&node).filter(seen).map(|key| {
        json!({
            "service": key.service_name().map(ServiceName::as_str), "instance": key.name().as_str(),
            "state": null, "config_revision": null,
        })
    });
    json!({
        "name": node.as_str(),
        "type": kind.unwrap_or_else(|| "static".into()),
        "worker": { "connected": null, "revision": null, "in_sync": null, "last_seen": null },
        "services": services.collect::<Vec<_>>(),
    })
}
