//! What is known of a ROS 2 network: its endpoints with their nodes, and which writers this flow
//! takes messages of.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_domain::WriterId;
use parking_lot::Mutex;
use tokio::sync::watch;

use super::endpoint::{RosEndpoint, Vendor};
use super::graph::ParticipantNodes;
use super::names::RosName;
use super::services;

use crate::dds::adapter::Admission;

use crate::dds::{EndpointId, Endpoints, FoundEndpoint, GuidPrefix, participant_of};

/// Endpoints of others that are looked at; further ones are counted.
pub const MAX_ENDPOINTS: usize = 10_000;
/// Participants whose nodes are known.
const MAX_PARTICIPANTS: usize = 1024;
/// An endpoint whose node has not been told counts after this time.
const NODE_WAIT: Duration = Duration::from_millis(300);

/// The endpoints of one network, those of flows left out.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Network {
    /// The own participant, in its present life.
    pub own: Option<GuidPrefix>,
    /// By identity.
    pub endpoints: Vec<Arc<RosEndpoint>>,
    /// Endpoints beyond the limit.
    pub refused: usize,
    /// Participants that have them.
    pub participants: usize,
    /// Full names of the nodes that flows have there.
    pub flows: BTreeSet<String>,
}

struct Entry {
    endpoint: Arc<RosEndpoint>,
    since: Instant,
}

#[derive(Default)]
struct State {
    own: Option<GuidPrefix>,
    endpoints: BTreeMap<EndpointId, Entry>,
    /// The same by name: readers and writers.
    by_name: HashMap<RosName, [Vec<Arc<RosEndpoint>>; 2]>,
    refused: usize,
    /// Endpoints of flows.
    marked: HashSet<EndpointId>,
    /// By participant: the node of each endpoint.
    nodes: HashMap<GuidPrefix, HashMap<EndpointId, String>>,
    /// Whether this flow takes messages of a writer, as far as that has been decided.
    owned: HashMap<EndpointId, bool>,
}

/// What the threads of the adapter and the flow share of it.
pub(super) struct Knowledge {
    state: Mutex<State>,
    network: watch::Sender<Arc<Network>>,
}

impl Knowledge {
    pub(super) fn new() -> Self {
        Self { state: Mutex::default(), network: watch::Sender::new(Arc::default()) }
    }

    pub(super) fn subscribe(&self) -> watch::Receiver<Arc<Network>> {
        self.network.subscribe()
    }

    /// Takes over what discovery has found.
    pub(super) fn note_endpoints(&self, now: Instant, found: &Endpoints) {
        let mut state = self.state.lock();
        let alive: HashSet<GuidPrefix> =
            found.writers.iter().chain(&found.readers).map(FoundEndpoint::participant).collect();
        state.nodes.retain(|participant, _| alive.contains(participant));
        state.marked.clear();
        state.refused = 0;
        let mut known = std::mem::take(&mut state.endpoints);
        for (all, is_writer) in [(&found.writers, true), (&found.readers, false)] {
            for one in all {
                if one.is_marked() {
                    state.marked.insert(one.id);
                } else if let Some(endpoint) = RosEndpoint::of(one, is_writer) {
                    state.put(known.remove(&one.id), endpoint, now);
                }
            }
        }
        let State { endpoints, by_name, owned, .. } = &mut *state;
        owned.retain(|id, _| endpoints.contains_key(id));
        by_name.clear();
        for Entry { endpoint, .. } in endpoints.values() {
            let of_name = by_name.entry(endpoint.name.clone()).or_default();
            of_name[usize::from(endpoint.is_writer)].push(Arc::clone(endpoint));
        }
        self.publish(&state, now);
    }

    /// Takes over which nodes a participant has.
    pub(super) fn note_nodes(&self, now: Instant, from: GuidPrefix, told: &ParticipantNodes) {
        let mut state = self.state.lock();
        if state.nodes.len() >= MAX_PARTICIPANTS && !state.nodes.contains_key(&from) {
            return;
        }
        let owners = told.owners();
        let State { endpoints, nodes, .. } = &mut *state;
        for (id, entry) in endpoints.iter_mut().filter(|(id, _)| id[..12] == from.0) {
            let node = owners.get(id);
            if entry.endpoint.node.as_ref() != node {
                Arc::make_mut(&mut entry.endpoint).node = node.cloned();
            }
        }
        nodes.insert(from, owners);
        self.publish(&state, now);
    }

    /// Takes over the own participant, before it has readers.
    pub(super) fn set_own(&self, own: GuidPrefix) {
        self.state.lock().own = Some(own);
    }

    /// Lets those count whose time has come.
    pub(super) fn tick(&self, now: Instant) {
        self.publish(&self.state.lock(), now);
    }

    /// Which writers this flow takes messages of; those of others wait until they are named.
    pub(super) fn set_owned(&self, owned: HashMap<EndpointId, bool>) {
        self.state.lock().owned = owned;
    }

    /// Whether a sample of a writer is to be taken.
    pub(super) fn admission(&self, writer: &EndpointId) -> Admission {
        let state = self.state.lock();
        let is_own = state.own == Some(participant_of(writer));
        // RustDDS gives what this flow writes to its readers, too.
        match state.owned.get(writer) {
            _ if is_own || state.marked.contains(writer) || state.is_unreadable(writer) => {
                Admission::No
            }
            Some(true) => Admission::Yes,
            Some(false) => Admission::No,
            None => Admission::Later,
        }
    }

    /// What is known of a writer.
    pub(super) fn writer(&self, id: &EndpointId) -> Option<Arc<RosEndpoint>> {
        self.state.lock().endpoints.get(id).map(|entry| Arc::clone(&entry.endpoint))
    }

    /// The writers or readers of a topic, whether or not they count yet. Their nodes may not be
    /// told.
    pub(super) fn endpoints(&self, name: &RosName, writers: bool) -> Vec<Arc<RosEndpoint>> {
        let state = self.state.lock();
        let found = state.by_name.get(name).map(|of_name| &of_name[usize::from(writers)]);
        found.cloned().unwrap_or_default()
    }

    /// Whether the first server that reads these requests is of Cyclone.
    pub(super) fn is_served_by_cyclone(&self, dds_topic: &str) -> bool {
        let servers = RosName::of_dds(dds_topic).map(|name| self.endpoints(&name, false));
        let first = servers.as_ref().and_then(|servers| servers.iter().min_by_key(|it| it.id));
        first.is_some_and(|server| server.vendor == Vendor::CycloneDds)
    }

    /// Requests are forgotten whose clients or servers have gone.
    pub(super) fn forget_requests(&self, requests: &mut services::State) {
        let state = self.state.lock();
        let is_client = |client: &WriterId| state.endpoints.contains_key(&client.0);
        let is_served = |topic: &str| {
            let name = RosName::of_dds(topic);
            name.and_then(|name| state.by_name.get(&name)).is_some_and(|it| !it[0].is_empty())
        };
        requests.retain(is_client, is_served);
    }

    fn publish(&self, state: &State, now: Instant) {
        let counts = |entry: &&Entry| {
            entry.endpoint.node.is_some() || now.saturating_duration_since(entry.since) >= NODE_WAIT
        };
        let endpoints: Vec<Arc<RosEndpoint>> = state
            .endpoints
            .values()
            .filter(counts)
            .map(|entry| Arc::clone(&entry.endpoint))
            .collect();
        let participants: HashSet<_> = endpoints.iter().map(|it| participant_of(&it.id)).collect();
        let participants = participants.len();
        let of_flow = |id: &EndpointId| state.nodes.get(&participant_of(id))?.get(id).cloned();
        let flows = state.marked.iter().filter_map(of_flow).collect();
        let (own, refused) = (state.own, state.refused);
        let network = Network { own, endpoints, refused, participants, flows };
        self.network.send_if_modified(|known| {
            let is_new = **known != network;
            if is_new {
                *known = Arc::new(network);
            }
            is_new
        });
    }
}

impl State {
    /// Whether a writer has no type of ROS 2, so that nobody decides about it.
    fn is_unreadable(&self, writer: &EndpointId) -> bool {
        self.endpoints.get(writer).is_some_and(|entry| !entry.endpoint.is_readable())
    }

    /// Puts in what was found, with its node and when it was found first.
    fn put(&mut self, known: Option<Entry>, mut endpoint: RosEndpoint, now: Instant) {
        if self.endpoints.len() >= MAX_ENDPOINTS {
            self.refused += 1;
            return;
        }
        let nodes = self.nodes.get(&participant_of(&endpoint.id));
        endpoint.node = nodes.and_then(|nodes| nodes.get(&endpoint.id)).cloned();
        let since = known.as_ref().map_or(now, |entry| entry.since);
        // What has not changed stays the same, which is quick to compare.
        let endpoint = match known {
            Some(entry) if *entry.endpoint == endpoint => entry.endpoint,
            _ => Arc::new(endpoint),
        };
        self.endpoints.insert(endpoint.id, Entry { endpoint, since });
    }
}

#[cfg(test)]
mod tests {
    use super::super::endpoint::tests::found;
    use super::super::graph::Node;
    use super::*;

    const TYPE: &str = "std_msgs::msg::dds_::String_";

    fn writers(writers: Vec<FoundEndpoint>) -> Endpoints {
        Endpoints { writers, readers: Vec::new() }
    }

    fn names(knowledge: &Knowledge) -> Vec<(String, Option<String>)> {
        let network = Arc::clone(&knowledge.subscribe().borrow());
        network.endpoints.iter().map(|it| (it.name.to_string(), it.node.clone())).collect()
    }

    #[test]
    fn an_endpoint_counts_with_its_node_or_after_a_moment() {
        let now = Instant::now();
        let knowledge = Knowledge::new();
        let (told, silent) = (found(1, "rt/a", TYPE), found(2, "rt/b", TYPE));
        knowledge.note_endpoints(now, &writers(vec![told.clone(), silent.clone()]));
        assert!(names(&knowledge).is_empty());
        let node = Node {
            namespace: "/arm".to_owned(),
            name: "talker".to_owned(),
            readers: Vec::new(),
            writers: vec![told.id],
        };
        let nodes = ParticipantNodes { participant: [0; 16], nodes: vec![node] };
        knowledge.note_nodes(now, told.participant(), &nodes);
        let a = ("/a".to_owned(), Some("/arm/talker".to_owned()));
        assert_eq!(names(&knowledge), std::slice::from_ref(&a));
        knowledge.tick(now + NODE_WAIT);
        assert_eq!(names(&knowledge), [a, ("/b".to_owned(), None)]);
        // It was found before, so it need not wait again.
        knowledge.note_endpoints(now + NODE_WAIT, &writers(vec![silent]));
        assert_eq!(names(&knowledge), [("/b".to_owned(), None)]);
    }

    #[test]
    fn messages_are_taken_of_own_writers_alone() {
        let now = Instant::now();
        let knowledge = Knowledge::new();
        let all = [1, 2, 3].map(|number| found(number, "rt/a", TYPE));
        knowledge.note_endpoints(now, &writers(all.to_vec()));
        knowledge.set_owned([(all[0].id, true), (all[1].id, false)].into());
        let admissions = all.each_ref().map(|it| knowledge.admission(&it.id));
        assert_eq!(admissions, [Admission::Yes, Admission::No, Admission::Later]);
        assert_eq!(knowledge.admission(&[9; 16]), Admission::Later, "it may be found any moment");
        knowledge.set_own(GuidPrefix([9; 12]));
        assert_eq!(knowledge.admission(&[9; 16]), Admission::No, "its own");
        knowledge.note_endpoints(now, &writers(vec![all[2].clone()]));
        assert_eq!(knowledge.admission(&all[0].id), Admission::Later, "it is not known any more");
    }

    #[test]
    fn nobody_waits_for_a_writer_that_cannot_be_read() {
        let knowledge = Knowledge::new();
        let mut keyed = found(1, "rt/a", TYPE);
        keyed.id[15] = 0x02;
        let other = found(2, "rt/a", "blaze::v1::Frame");
        knowledge.note_endpoints(Instant::now(), &writers(vec![keyed.clone(), other.clone()]));
        assert_eq!(knowledge.admission(&keyed.id), Admission::No);
        assert_eq!(knowledge.admission(&other.id), Admission::No);
    }

    #[test]
    fn a_crowd_is_bounded_and_counted() {
        let now = Instant::now();
        let knowledge = Knowledge::new();
        let crowd = (0..MAX_ENDPOINTS + 7).map(|number| {
            let mut one = found(1, "rt/a", TYPE);
            one.id[4..12].copy_from_slice(&(number as u64).to_be_bytes());
            one
        });
        knowledge.note_endpoints(now, &writers(crowd.collect()));
        knowledge.tick(now + NODE_WAIT);
        let network = Arc::clone(&knowledge.subscribe().borrow());
        assert_eq!((network.endpoints.len(), network.refused), (MAX_ENDPOINTS, 7));
    }
}
