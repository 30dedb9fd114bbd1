//! Reads of the system as a whole.

use std::collections::{BTreeMap, BTreeSet};

use blaze_domain::config::{Key, Kind, Problem};
use blaze_domain::{InstanceName, LayerName, NodeName, ServiceName};
use serde_json::{Value, json};

use super::super::types::{Answer, Caller, ReadOptions};
use super::super::view::{View, view};
use super::super::workers::{Running, RunningState, Worker, WorkerName};
use super::read::answer;
use super::{ConfigService, not_found};
use crate::auth::Right;
use crate::status::fleet::Fleet as Reported;
use crate::status::picture::{self, Filter};
use blaze_domain::config::state::State;

impl ConfigService {
    /// Layers, nodes and services, with what is known of them.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn topology(
        &self,
        caller: &Caller,
        read: &ReadOptions,
    ) -> Result<Answer<Value>, Problem> {
        self.authorize(&caller.claims, Right::Read)?;
        let state = self.read_state(read).await?;
        let view = view(&caller.claims);
        let fleet = self.fleet(&state, &view);
        self.status().configure(&state);
        let value = self.status().read(|status| topology_json(&state, &view, &fleet, status));
        Ok(answer(&state, value))
    }

    /// Workers that are known.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn workers(
        &self,
        caller: &Caller,
        read: &ReadOptions,
    ) -> Result<Answer<Value>, Problem> {
        self.authorize(&caller.claims, Right::Read)?;
        let state = self.read_state(read).await?;
        let fleet = self.fleet(&state, &view(&caller.claims));
        let items: Vec<Value> = fleet.workers.iter().map(Known::to_json).collect();
        let value = json!({ "items": items, "revision": state.revision(), "next_page_token": "" });
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
        let value =
            json!({ "revision": state.revision(), "digest": self.inner.digests.of(&state, layer) });
        Ok(answer(&state, value))
    }
}

/// What is known of workers and of what runs at them.
struct Fleet {
    workers: Vec<Known>,
    running: BTreeMap<Running, RunningState>,
}

struct Known {
    name: WorkerName,
    worker: Worker,
    in_sync: bool,
}

impl Known {
    fn to_json(&self) -> Value {
        let Self { name, worker, in_sync } = self;
        json!({
            "layer": name.layer.as_str(), "node": name.node.as_ref().map(NodeName::as_str),
            "worker_id": name.id,
            "version": worker.version, "connected": worker.is_connected(),
            "revision": worker.has.revision,
            "digest": worker.has.digest, "in_sync": in_sync,
            "last_seen": worker.last_seen.to_string(),
        })
    }
}

impl ConfigService {
    fn fleet(&self, state: &State, view: &View) -> Fleet {
        let known = self.inner.workers.list(|name| view.check_layer(&name.layer).is_ok());
        let mut fleet =
            Fleet { workers: Vec::with_capacity(known.len()), running: BTreeMap::new() };
        for (name, worker) in known {
            let in_sync = worker.is_connected()
                && worker.has.digest == self.inner.digests.of(state, &name.layer);
            if worker.is_connected() {
                let services = worker.has.services.iter();
                fleet
                    .running
                    .extend(services.map(|(running, state)| (running.clone(), state.clone())));
            }
            fleet.workers.push(Known { name, worker, in_sync });
        }
        fleet
    }

    /// How far connected workers are behind, by layer and node; of several on one node the one that
    /// is furthest behind.
    #[must_use]
    pub fn worker_lags(&self) -> BTreeMap<(LayerName, Option<NodeName>), u64> {
        let (mut lags, newest) = (BTreeMap::new(), self.revision());
        for (name, worker) in self.inner.workers.list(|_| true) {
            if worker.is_connected() {
                let lag = lags.entry((name.layer, name.node)).or_insert(0);
                *lag = newest.saturating_sub(worker.has.revision).max(*lag);
            }
        }
        lags
    }
}

/// The worker of a node: one that is connected before one that has gone, then the one that was seen
/// last.
fn worker_json(fleet: &Fleet, node: &NodeName) -> Value {
    let of_node = fleet.workers.iter().filter(|known| known.name.node.as_ref() == Some(node));
    match of_node.max_by_key(|known| (known.worker.is_connected(), known.worker.last_seen)) {
        Some(known) => json!({
            "connected": known.worker.is_connected(), "revision": known.worker.has.revision,
            "in_sync": known.in_sync, "last_seen": known.worker.last_seen.to_string(),
        }),
        None => json!({ "connected": null, "revision": null, "in_sync": null, "last_seen": null }),
    }
}

fn topology_json(state: &State, view: &View, fleet: &Fleet, status: &Reported) -> Value {
    let layers = state
        .of_kind(Kind::Layer, None)
        .filter(|(_, held)| view.sees_document(state, &held.document))
        .map(|(key, held)| {
            let layer = LayerName::from(key.name());
            let nodes = state.in_layer(&layer).filter(|key| key.kind() == Kind::Node);
            let nodes = nodes.map(|key| node_json(state, view, (fleet, status), key));
            json!({
                "name": layer.as_str(),
                "kind": held.document.spec_member("kind"),
                "health": picture::layer_health(status, &layer),
                "nodes": nodes.collect::<Vec<_>>(),
            })
        });
    let layers: Vec<Value> = layers.collect();
    let filter = Filter { bound: view.layer().cloned(), ..Filter::default() };
    let links = picture::topology_links(status, &filter);
    json!({ "revision": state.revision(), "layers": layers, "links": links })
}

fn node_json(state: &State, view: &View, (fleet, status): (&Fleet, &Reported), key: &Key) -> Value {
    let node = NodeName::from(key.name());
    let kind = state.get(key).and_then(|held| held.document.spec_member("type").cloned());
    let seen = |key: &&Key| {
        let held = state.get(key);
        held.is_some_and(|held| view.sees_document(state, &held.document))
    };
    // What has a document and what runs: neither needs the other.
    let placed = state.on_node(&node).filter(seen).filter_map(|key| {
        let instance = InstanceName::from(key.name());
        Some((key.service_name()?.clone(), instance))
    });
    let runs = fleet.running.keys().filter(|running| running.node.as_ref() == Some(&node));
    let runs = runs.map(|running| (running.service.clone(), running.instance.clone()));
    let services: BTreeSet<(ServiceName, InstanceName)> = placed.chain(runs).collect();
    let services = services.into_iter().map(|(service, instance)| {
        let running = fleet.running.get(&Running {
            service: service.clone(),
            instance: instance.clone(),
            node: Some(node.clone()),
        });
        json!({
            "service": service.as_str(), "instance": instance.as_str(),
            "state": running.map(|running| running.state.as_str()),
            "config_revision": running.map(|running| running.config_revision),
            "health": picture::service_health(status, &node, service.as_str(), instance.as_str()),
        })
    });
    json!({
        "name": node.as_str(),
        "type": kind.unwrap_or_else(|| "static".into()),
        "worker": worker_json(fleet, &node),
        "health": picture::node_health(status, &node),
        "services": services.collect::<Vec<_>>(),
    })
}
