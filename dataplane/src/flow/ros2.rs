//! The ROS 2 network of a flow: what its adapter finds, as far as the node file lets it be bridged,
//! goes to the control core.

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_brokers::ros2::names::{RosName, is_system};
use blaze_brokers::ros2::{GidLength, MAX_SHOWN, Network, Ros2Broker, Ros2Config, RosEndpoint};
use blaze_brokers::{Broker as _, Health};
use blaze_domain::control::LeaseKind;
use blaze_domain::node_file::{Ros2Distro, Ros2Live, Ros2Plugin, TopicPattern};
use blaze_domain::{Durability, FlowId, Reliability, TopicName, WriterId};
use parking_lot::Mutex;
use serde::Serialize;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::Shared;
use crate::control::ControlCore;
use crate::plan::network::Shown;
use crate::registry::FoundEndpoint;
use crate::world::{Ros2Network, Ros2NetworkId};

/// Many endpoints that come at once are looked at together.
const BURST: Duration = Duration::from_millis(20);
/// A network whose adapter has not worked for this long is left to other flows: it is built anew in
/// less.
const LOST: Duration = Duration::from_secs(5);

/// The ROS 2 network of a flow.
pub(crate) struct Ros2Scope {
    pub(crate) broker: Arc<Ros2Broker>,
    pub(crate) domain: u16,
    pub(crate) interface: Ipv4Addr,
    pub(super) namespace: String,
    /// Where the flow is.
    network: Ros2Network,
    rules: watch::Sender<Ros2Live>,
    /// The endpoints that were found, as they were last looked at.
    seen: Mutex<Arc<[Seen]>>,
    shown: Mutex<AllShown>,
}

/// What other flows offer.
#[derive(Default)]
struct AllShown {
    topics: BTreeMap<TopicName, Shown>,
    /// Those for which there was no room.
    refused: usize,
}

/// An endpoint and whether it is bridged.
pub(crate) struct Seen {
    pub(crate) endpoint: Arc<RosEndpoint>,
    /// Its topic, or why it is not bridged.
    pub(crate) topic: Result<TopicName, Refusal>,
}

/// Why an endpoint is not bridged, as a word in admin JSON.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Refusal {
    /// `allow`, `deny` or `system` of the node file.
    AccessDenied,
    /// No topic may have its name.
    NameNotExpressible,
    /// Its samples have keys, or its type is none of ROS 2.
    Unsupported,
    /// It has no address for UDP.
    Unreachable,
    /// Its topic is offered in other types alone.
    TypeMismatch,
}

impl Ros2Scope {
    /// Starts the adapter in the background.
    ///
    /// # Errors
    /// The configuration can never work, or there is no thread.
    pub(super) fn open(me: &FlowId, plugin: &Ros2Plugin) -> anyhow::Result<Self> {
        let Ros2Plugin { domain, interface, .. } = *plugin;
        let namespace = plugin.namespace.as_ref().map(ToString::to_string).unwrap_or_default();
        let broker = Ros2Broker::open(Ros2Config {
            flow: me.clone(),
            domain,
            interface,
            namespace: namespace.clone(),
            peers: plugin.peers.clone(),
            gid: match plugin.distro {
                Ros2Distro::Humble => GidLength::Long,
                _ => GidLength::Short,
            },
        })
        .context("brokers.plugins: ros2")?;
        let id = if interface.is_loopback() {
            Ros2NetworkId::of_host(domain, &this_host())
        } else {
            Ros2NetworkId::of_layer(domain, &me.layer)
        };
        Ok(Self {
            broker: Arc::new(broker),
            domain,
            interface,
            namespace,
            network: Ros2Network { id, address: interface },
            rules: watch::Sender::new(plugin.live.clone()),
            seen: Mutex::new(Arc::new([])),
            shown: Mutex::default(),
        })
    }

    /// Takes other rules.
    pub(super) fn set_rules(&self, rules: &Ros2Live) {
        let is_new = self.rules.send_if_modified(|before| {
            let is_new = before != rules;
            before.clone_from(rules);
            is_new
        });
        if is_new {
            let all: Vec<TopicName> = self.shown.lock().topics.keys().cloned().collect();
            self.let_show(all);
        }
    }

    /// The endpoints that were found.
    pub(crate) fn seen(&self) -> Arc<[Seen]> {
        Arc::clone(&self.seen.lock())
    }

    /// Which writers are read.
    pub(super) fn set_owned(&self, owned: BTreeMap<WriterId, bool>) {
        self.broker
            .set_owned(owned.into_iter().map(|(writer, is_own)| (writer.0, is_own)).collect());
    }

    /// Lets what other flows offer of a topic show on the network, or no longer.
    pub(super) fn show(&self, topic: TopicName, shown: Option<Shown>) {
        let mut all = self.shown.lock();
        match shown {
            Some(shown) => _ = all.topics.insert(topic.clone(), shown),
            None => _ = all.topics.remove(&topic),
        }
        drop(all);
        self.let_show([topic]);
    }

    fn let_show(&self, topics: impl IntoIterator<Item = TopicName>) {
        let rules = self.rules.borrow().clone();
        let mut all = self.shown.lock();
        let may_show = |topic: &TopicName| {
            let name = RosName::of_topic(topic, &self.namespace);
            rules.announce && name.is_ok_and(|name| may_pass(&rules, &name))
        };
        let wanted = topics.into_iter().map(|topic| {
            let shown = all.topics.get(&topic).filter(|_| may_show(&topic));
            let shown = shown.map(|shown| blaze_brokers::ros2::Shown {
                type_name: shown.type_name.clone(),
                reliable: shown.reliability == Reliability::Reliable,
                durable: shown.durability == Durability::TransientLocal,
            });
            (topic, shown)
        });
        let wanted: Vec<_> = wanted.collect();
        let refused = self.broker.show(wanted);
        if refused > 0 && all.refused == 0 {
            tracing::warn!(
                limit = MAX_SHOWN,
                "more topics are offered than may show on the ROS 2 network before they are asked \
                 for: the others show when they are",
            );
        }
        all.refused += refused;
    }

    /// How many topics did not show because there were too many.
    pub(crate) fn refused_shows(&self) -> usize {
        self.shown.lock().refused
    }

    /// That the network belongs to a flow of another layer, if so.
    pub(crate) fn in_use(&self, control: &ControlCore) -> Option<String> {
        let (holder, domain, interface) = (control.ros2_holder()?, self.domain, self.interface);
        Some(format!(
            "scope_in_use: {holder} of another layer has ROS 2 domain {domain} on {interface}; give \
             one of the layers another domain"
        ))
    }

    /// Looks at what was found. Returns what goes to the control core.
    fn look(&self, network: &Network) -> BTreeMap<TopicName, Vec<FoundEndpoint>> {
        let rules = self.rules.borrow().clone();
        let seen: Arc<[Seen]> = network
            .endpoints
            .iter()
            .map(|endpoint| Seen {
                topic: self.topic_of(&rules, endpoint),
                endpoint: Arc::clone(endpoint),
            })
            .collect();
        let mut found: BTreeMap<TopicName, Vec<FoundEndpoint>> = BTreeMap::new();
        for Seen { endpoint, topic } in seen.iter() {
            if let Ok(topic) = topic {
                found.entry(topic.clone()).or_default().push(found_endpoint(endpoint));
            }
        }
        *self.seen.lock() = seen;
        found
    }

    fn topic_of(&self, rules: &Ros2Live, endpoint: &RosEndpoint) -> Result<TopicName, Refusal> {
        let inexpressible = |_| Refusal::NameNotExpressible;
        let topic = endpoint.name.to_topic(&self.namespace).map_err(inexpressible)?;
        if !may_pass(rules, &endpoint.name) {
            return Err(Refusal::AccessDenied);
        }
        if endpoint.is_keyed || endpoint.type_name.is_none() {
            return Err(Refusal::Unsupported);
        }
        if endpoint.addresses.is_empty() {
            return Err(Refusal::Unreachable);
        }
        Ok(topic)
    }
}

/// Whether the node file lets a name pass between the network and others. A pattern that an action
/// fits counts for all of its parts.
fn may_pass(rules: &Ros2Live, name: &RosName) -> bool {
    let action = name.name.split_once("/_action/").map(|(action, _)| action);
    let names: Vec<TopicName> = [Some(&*name.name), action]
        .into_iter()
        .flatten()
        .filter_map(|it| it.parse().ok())
        .collect();
    let fit = |patterns: &[TopicPattern]| {
        patterns.iter().any(|pattern| names.iter().any(|name| pattern.matches(name)))
    };
    (rules.system || !is_system(name)) && fit(&rules.allow) && !fit(&rules.deny)
}

fn found_endpoint(endpoint: &RosEndpoint) -> FoundEndpoint {
    FoundEndpoint {
        guid: WriterId(endpoint.id),
        kind: if endpoint.is_writer { LeaseKind::Advertise } else { LeaseKind::Request },
        type_name: endpoint.type_name.clone().unwrap_or_default(),
        type_hash: endpoint.type_hash.clone().unwrap_or_default(),
        reliability: if endpoint.reliable {
            Reliability::Reliable
        } else {
            Reliability::BestEffort
        },
        durability: if endpoint.durable {
            Durability::TransientLocal
        } else {
            Durability::Volatile
        },
        lifespan_ms: endpoint.lifespan_ms(),
        node: endpoint.node.clone().unwrap_or_default(),
        locators: endpoint.addresses.clone(),
    }
}

/// What is the same for all processes that share a loopback interface: the boot of the host and the
/// network namespace.
#[must_use]
pub fn this_host() -> String {
    let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    let namespace = std::fs::read_link("/proc/self/ns/net").unwrap_or_default();
    format!("{}|{}", boot.trim(), namespace.display())
}

/// Tells the control core of the network, until the process ends.
pub(super) async fn follow_network(shared: Arc<Shared>, stop: CancellationToken) {
    let Some(ros2) = &shared.ros2 else { return };
    let mut network = ros2.broker.network();
    let mut rules = ros2.rules.subscribe();
    let mut status = ros2.broker.status();
    loop {
        let found = network.borrow_and_update().clone();
        rules.borrow_and_update();
        let (is_lost, waits) = {
            let status = status.borrow_and_update();
            let away = (status.health != Health::Up).then(|| status.since.elapsed());
            let is_lost = away.is_some_and(|away| away >= LOST);
            (is_lost, away.filter(|_| !is_lost).map(|away| LOST - away))
        };
        let endpoints = ros2.look(&found);
        {
            let now = Instant::now();
            let mut control = shared.control.lock();
            control.set_ros2_network(now, Some(ros2.network).filter(|_| !is_lost));
            control.set_found(now, endpoints);
            control.set_ros2_nodes(now, found.flows.clone());
        }
        let lost = async {
            match waits {
                Some(waits) => tokio::time::sleep(waits).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = stop.cancelled() => return,
            changed = network.changed() => if changed.is_err() { return },
            _ = rules.changed() => {}
            _ = status.changed() => {}
            () = lost => {}
        }
        tokio::time::sleep(BURST).await;
    }
}

#[cfg(test)]
mod tests {
    use blaze_domain::node_file::NodeFile;
    use serde_json::{Value, json};

    use super::*;

    /// Which of these DDS topics pass.
    fn passing(rules: &Value, topics: &[&'static str]) -> Vec<&'static str> {
        let tree = json!({"brokers": {"plugins": [{"ros2": rules}]}});
        let rules = NodeFile::read(&tree).unwrap().0.brokers.ros2.unwrap().live;
        let passes = |dds: &&&str| may_pass(&rules, &RosName::of_dds(dds).unwrap());
        topics.iter().filter(passes).copied().collect()
    }

    #[test]
    fn the_node_file_says_what_passes() {
        let all = [
            "rt/scan",
            "rt/fib/_action/status",
            "rq/fib/_action/send_goalRequest",
            "rq/addRequest",
            "rt/rosout",
            "rr/talker/get_parametersReply",
        ];
        assert_eq!(passing(&json!({}), &all), all[..4]);
        assert_eq!(passing(&json!({"system": true}), &all), all);
        assert_eq!(
            passing(&json!({"allow": ["fib"]}), &all),
            all[1..3],
            "an action with its parts"
        );
        assert_eq!(passing(&json!({"deny": ["fib", "add"]}), &all), all[..1]);
        assert_eq!(passing(&json!({"allow": ["scan"], "deny": ["**"]}), &all), [""; 0]);
    }
}
