//! What is known of a ROS 2 network: its endpoints with their nodes, and which writers this flow
//! takes messages of.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_domain::WriterId;
use parking_lot::Mutex;
use tokio::sync::watch;

use super::endpoint::{RosEndpoint, Vendor};
use super::names::{Carries, RosName};
use super::services;
use crate::dds::adapter::{Admission, LONGEST_DOUBT};
use crate::dds::{EndpointId, Endpoints, FoundEndpoint, GuidPrefix, participant_of};

/// Endpoints of others that are looked at; further ones are counted.
pub const MAX_ENDPOINTS: usize = 10_000;
/// Participants whose nodes are known.
const MAX_PARTICIPANTS: usize = 1024;
/// RustDDS serves an endpoint so soon after it is found.
const SERVED_AFTER: Duration = Duration::from_millis(20);
/// An endpoint whose node has not been told counts after this time.
const NODE_WAIT: Duration = Duration::from_millis(300);
/// How long a writer of messages stays listed after it has left, so that a node that restarts
/// finds what is bridged for it. Its reader stands for [`LONGEST_DOUBT`] and the second until that is
/// noticed: as it goes first, no writer meets a reader whose messages go nowhere.
const LINGERS: Duration = Duration::from_secs(5);

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
    /// As discovery found it last.
    found: FoundEndpoint,
    endpoint: Arc<RosEndpoint>,
    since: Instant,
    /// A writer that has left stays for as long as its samples may wait, and those of a writer that
    /// takes its place.
    gone: Option<Instant>,
}

#[derive(Default)]
struct State {
    own: Option<GuidPrefix>,
    endpoints: BTreeMap<EndpointId, Entry>,
    /// Those that are there, by name: readers and writers.
    by_name: HashMap<RosName, [Vec<Arc<RosEndpoint>>; 2]>,
    refused: usize,
    /// Endpoints of flows.
    marked: HashSet<EndpointId>,
    /// Participants with endpoints.
    alive: HashSet<GuidPrefix>,
    /// By participant: the node of each endpoint.
    nodes: HashMap<GuidPrefix, HashMap<EndpointId, Arc<str>>>,
    /// Whether this flow takes messages of a writer, as far as that has been decided.
    owned: HashMap<EndpointId, bool>,
    /// When one will count, or no longer, though nothing changes.
    due: Option<Instant>,
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

    /// Takes over what discovery has found. Returns the names whose endpoints are others now.
    pub(super) fn note_endpoints(&self, now: Instant, found: &Endpoints) -> BTreeSet<RosName> {
        let state = &mut *self.state.lock();
        let all = found.writers.iter().chain(&found.readers);
        let before = std::mem::replace(
            &mut state.alive,
            all.clone().map(FoundEndpoint::participant).collect(),
        );
        // Those that were not found yet may have told their nodes before.
        let alive = &state.alive;
        state.nodes.retain(|from, _| alive.contains(from) || !before.contains(from));
        let marked = all.filter(|one| one.is_marked()).map(|one| one.id).collect();
        let marks_changed = std::mem::replace(&mut state.marked, marked) != state.marked;
        let refused = std::mem::take(&mut state.refused);
        let changed = state.take_over(now, found);
        if marks_changed || refused != state.refused || !changed.is_empty() {
            self.publish(state, now);
        }
        changed
    }

    /// Takes over which nodes a participant has.
    pub(super) fn note_nodes(
        &self,
        now: Instant,
        from: GuidPrefix,
        nodes: HashMap<EndpointId, Arc<str>>,
    ) {
        let state = &mut *self.state.lock();
        if state.nodes.len() >= MAX_PARTICIPANTS && !state.nodes.contains_key(&from) {
            let alive = &state.alive;
            state.nodes.retain(|from, _| alive.contains(from));
            if state.nodes.len() >= MAX_PARTICIPANTS {
                return;
            }
        }
        for (id, entry) in state.endpoints.range_mut(ids_of(from)) {
            let node = nodes.get(id).map(|node| &**node);
            if entry.endpoint.node.as_deref() != node {
                Arc::make_mut(&mut entry.endpoint).node = node.map(ToOwned::to_owned);
            }
        }
        if state.nodes.get(&from) != Some(&nodes) {
            state.nodes.insert(from, nodes);
            self.publish(state, now);
        }
    }

    /// Takes over the own participant, before it has readers.
    pub(super) fn set_own(&self, own: GuidPrefix) {
        let state = &mut *self.state.lock();
        state.own = Some(own);
        self.publish(state, Instant::now());
    }

    /// Lets those count whose time has come.
    pub(super) fn tick(&self, now: Instant) {
        let state = &mut *self.state.lock();
        if state.due.is_some_and(|due| due <= now) {
            self.publish(state, now);
        }
    }

    /// Which writers this flow takes messages of; those of others wait until they are named.
    pub(super) fn set_owned(&self, mut owned: HashMap<EndpointId, bool>) {
        let state = &mut *self.state.lock();
        // Those that have left are named once.
        for (id, is_own) in std::mem::take(&mut state.owned) {
            if state.endpoints.get(&id).is_some_and(|entry| entry.gone.is_some()) {
                owned.entry(id).or_insert(is_own);
            }
        }
        state.owned = owned;
        if state.endpoints.values().any(|entry| entry.gone.is_some()) {
            self.publish(state, Instant::now());
        }
    }

    /// Whether a sample of a writer is to be taken by those who read a type. RustDDS looks at names
    /// of topics alone, and gives them what this flow writes, too.
    pub(super) fn admission(&self, writer: &EndpointId, dds_type: &str) -> Admission {
        let state = self.state.lock();
        let is_own = state.own == Some(participant_of(writer));
        let is_other = |it: &Entry| it.endpoint.dds_type != dds_type || !it.endpoint.is_readable();
        let known = state.endpoints.get(writer);
        // Replies are for whom the request was of, and told apart by that.
        let replies = known.is_some_and(|it| it.endpoint.name.carries == Carries::Replies);
        match state.owned.get(writer) {
            _ if is_own || known.is_some_and(is_other) || state.marked.contains(writer) => {
                Admission::No
            }
            _ if replies => Admission::Yes,
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

    /// Whether an endpoint has been known for as long as RustDDS takes to serve it.
    pub(super) fn has_met(&self, now: Instant, id: &EndpointId) -> bool {
        self.known_for(now, id).is_some_and(|known_for| known_for >= SERVED_AFTER)
    }

    /// How long an endpoint has been known.
    fn known_for(&self, now: Instant, id: &EndpointId) -> Option<Duration> {
        let state = self.state.lock();
        state.endpoints.get(id).map(|entry| now.saturating_duration_since(entry.since))
    }

    /// How long a server of a service has been known by its writer of replies.
    pub(super) fn replies_for(&self, now: Instant, replies: &RosName) -> Option<Duration> {
        let writers = self.endpoints(replies, true);
        writers.iter().filter_map(|writer| self.known_for(now, &writer.id)).max()
    }

    /// Whose implementation the first server is that reads these requests.
    pub(super) fn server(&self, requests: &RosName) -> Option<Vendor> {
        let servers = self.endpoints(requests, false);
        servers.iter().min_by_key(|server| server.id).map(|server| server.vendor)
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

    /// Whether a topic has a writer of a type, or had one whose samples may still wait.
    pub(super) fn is_written(&self, now: Instant, name: &RosName, dds_type: &str) -> bool {
        let of = |it: &RosEndpoint| it.is_writer && it.name == *name && it.dds_type == dds_type;
        let waits = |gone: Instant| now.saturating_duration_since(gone) < LONGEST_DOUBT;
        let state = self.state.lock();
        state.endpoints.values().any(|it| of(&it.endpoint) && it.gone.is_none_or(waits))
    }

    fn publish(&self, state: &mut State, now: Instant) {
        let mut due: Option<Instant> = None;
        // Whether a time has come, which is looked at again then.
        let mut is_over = |at: Instant| {
            let is_over = at <= now;
            if !is_over {
                due = due.into_iter().chain([at]).min();
            }
            is_over
        };
        let mut endpoints = Vec::new();
        for Entry { endpoint, since, gone, .. } in state.endpoints.values() {
            let counts = endpoint.node.is_some() || is_over(*since + NODE_WAIT);
            let is_listed = gone.is_none_or(|gone| {
                let until = state.listed_until(endpoint, gone);
                until.is_some_and(|until| !is_over(until))
            });
            if counts && is_listed {
                endpoints.push(Arc::clone(endpoint));
            }
        }
        state.due = due;
        let participants: HashSet<_> = endpoints.iter().map(|it| participant_of(&it.id)).collect();
        let participants = participants.len();
        let of_flow = |id: &EndpointId| state.nodes.get(&participant_of(id))?.get(id);
        let flows = state.marked.iter().filter_map(of_flow).map(ToString::to_string).collect();
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

/// All endpoints that a participant may have.
fn ids_of(participant: GuidPrefix) -> RangeInclusive<EndpointId> {
    let [mut first, mut last] = [[0; 16], [0xff; 16]];
    first[..12].copy_from_slice(&participant.0);
    last[..12].copy_from_slice(&participant.0);
    first..=last
}

impl State {
    /// Until when a writer that has left stays in [`Network::endpoints`], if it still does.
    fn listed_until(&self, writer: &RosEndpoint, gone: Instant) -> Option<Instant> {
        let lingers = gone + LINGERS;
        match self.owned.get(&writer.id) {
            // It is to be named once: its samples wait for that.
            None => Some(gone + LONGEST_DOUBT),
            Some(true) if writer.name.carries == Carries::Messages => {
                let others = self.by_name.get(&writer.name).map_or(&[][..], |it| &it[1]);
                if others.iter().any(|other| self.owned.get(&other.id) == Some(&true)) {
                    return None;
                }
                // One that nobody has decided about yet may take its place.
                let undecided = others.iter().filter(|it| !self.owned.contains_key(&it.id));
                let found = undecided.filter_map(|it| Some(self.endpoints.get(&it.id)?.since));
                let in_time = found.filter(|since| *since < lingers);
                in_time.map(|since| since + LONGEST_DOUBT).chain([lingers]).max()
            }
            Some(_) => None,
        }
    }

    /// Takes over what was found: first what is known, so that a crowd displaces nobody. Returns
    /// the names of what came, left or changed.
    fn take_over(&mut self, now: Instant, found: &Endpoints) -> BTreeSet<RosName> {
        let mut changed = BTreeSet::new();
        let all: HashMap<EndpointId, (&FoundEndpoint, bool)> =
            [(&found.writers, true), (&found.readers, false)]
                .into_iter()
                .flat_map(|(all, is_writer)| all.iter().map(move |one| (one.id, (one, is_writer))))
                .filter(|(_, (one, _))| !one.is_marked())
                .collect();
        let is_few = self.endpoints.len() <= 2 * MAX_ENDPOINTS;
        self.endpoints.retain(|id, entry| {
            let is_there = all.contains_key(id);
            if is_there != entry.gone.is_none() {
                entry.gone = (!is_there).then_some(now);
                changed.insert(entry.endpoint.name.clone());
            }
            let Some(gone) = entry.gone else { return true };
            let age = now.saturating_duration_since(gone);
            let of_messages = entry.endpoint.name.carries == Carries::Messages;
            let remembered = if of_messages { LINGERS + LONGEST_DOUBT } else { LONGEST_DOUBT };
            let stays = entry.endpoint.is_writer && age < remembered && is_few;
            // Nobody reads it any more.
            if !stays || age >= LONGEST_DOUBT {
                changed.insert(entry.endpoint.name.clone());
            }
            stays
        });
        let mut room = MAX_ENDPOINTS
            .saturating_sub(self.endpoints.values().filter(|entry| entry.gone.is_none()).count());
        for (id, (one, is_writer)) in all {
            let known = self.endpoints.get(&id);
            if known.is_some_and(|entry| entry.found == *one) {
                continue;
            }
            let Some(mut endpoint) = RosEndpoint::of(one, is_writer) else { continue };
            if known.is_none() && room == 0 {
                self.refused += 1;
                continue;
            }
            room -= usize::from(known.is_none());
            let nodes = self.nodes.get(&participant_of(&id));
            endpoint.node = nodes.and_then(|nodes| nodes.get(&id)).map(ToString::to_string);
            changed.insert(endpoint.name.clone());
            changed.extend(known.map(|entry| entry.endpoint.name.clone()));
            let since = known.map_or(now, |entry| entry.since);
            let (found, endpoint) = (one.clone(), Arc::new(endpoint));
            self.endpoints.insert(id, Entry { found, endpoint, since, gone: None });
        }
        let Self { endpoints, by_name, owned, .. } = self;
        owned.retain(|id, _| endpoints.contains_key(id));
        by_name.retain(|name, _| !changed.contains(name));
        for Entry { endpoint, .. } in endpoints.values().filter(|entry| entry.gone.is_none()) {
            if changed.contains(&endpoint.name) {
                let of_name = by_name.entry(endpoint.name.clone()).or_default();
                of_name[usize::from(endpoint.is_writer)].push(Arc::clone(endpoint));
            }
        }
        changed
    }
}

#[cfg(test)]
mod tests {
    use super::super::endpoint::tests::found;
    use super::super::graph::{Node, ParticipantNodes};
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
        knowledge.note_nodes(now, told.participant(), nodes.owners(told.participant()));
        let a = ("/a".to_owned(), Some("/arm/talker".to_owned()));
        assert_eq!(names(&knowledge), std::slice::from_ref(&a));
        knowledge.tick(now + NODE_WAIT);
        assert_eq!(names(&knowledge), [a, ("/b".to_owned(), None)]);
        // It was found before, so it need not wait again.
        knowledge.set_owned([(told.id, false)].into());
        knowledge.note_endpoints(now + NODE_WAIT, &writers(vec![silent]));
        assert_eq!(names(&knowledge), [("/b".to_owned(), None)]);
    }

    #[test]
    fn an_endpoint_is_served_a_moment_after_it_was_found() {
        let now = Instant::now();
        let knowledge = Knowledge::new();
        let one = found(1, "rr/addReply", TYPE);
        assert!(!knowledge.has_met(now, &one.id));
        knowledge.note_endpoints(now, &writers(vec![one.clone()]));
        assert!(!knowledge.has_met(now, &one.id));
        assert!(knowledge.has_met(now + SERVED_AFTER, &one.id));
    }

    #[test]
    fn messages_are_taken_of_own_writers_alone() {
        let now = Instant::now();
        let knowledge = Knowledge::new();
        let all = [1, 2, 3].map(|number| found(number, "rt/a", TYPE));
        knowledge.note_endpoints(now, &writers(all.to_vec()));
        knowledge.set_owned([(all[0].id, true), (all[1].id, false)].into());
        let admissions = all.each_ref().map(|it| knowledge.admission(&it.id, TYPE));
        assert_eq!(admissions, [Admission::Yes, Admission::No, Admission::Later]);
        assert_eq!(
            knowledge.admission(&[9; 16], TYPE),
            Admission::Later,
            "it may be found any moment"
        );
        knowledge.set_own(GuidPrefix([9; 12]));
        assert_eq!(knowledge.admission(&[9; 16], TYPE), Admission::No, "its own");
        knowledge.note_endpoints(now, &writers(vec![all[2].clone()]));
        assert_eq!(
            knowledge.admission(&all[0].id, TYPE),
            Admission::Yes,
            "its samples may still come"
        );
        let later = now + LINGERS + LONGEST_DOUBT;
        knowledge.note_endpoints(later, &writers(vec![all[2].clone()]));
        assert_eq!(
            knowledge.admission(&all[0].id, TYPE),
            Admission::Later,
            "it is not known any more"
        );
    }

    #[test]
    fn replies_are_taken_whoever_owns_their_server() {
        let knowledge = Knowledge::new();
        let server = found(1, "rr/addReply", TYPE);
        assert_eq!(knowledge.admission(&server.id, TYPE), Admission::Later, "not found yet");
        knowledge.note_endpoints(Instant::now(), &writers(vec![server.clone()]));
        assert_eq!(knowledge.admission(&server.id, TYPE), Admission::Yes);
        knowledge.set_owned([(server.id, false)].into());
        assert_eq!(knowledge.admission(&server.id, TYPE), Admission::Yes);
    }

    #[test]
    fn a_writer_that_leaves_at_once_is_named_and_read() {
        let now = Instant::now();
        let knowledge = Knowledge::new();
        let brief = found(1, "rt/a", TYPE);
        knowledge.note_endpoints(now, &writers(vec![brief.clone()]));
        knowledge.note_endpoints(now, &writers(Vec::new()));
        assert!(knowledge.endpoints(&RosName::of_dds("rt/a").unwrap(), true).is_empty());
        knowledge.tick(now + NODE_WAIT);
        assert_eq!(names(&knowledge).len(), 1, "the flow is to decide");
        assert_eq!(knowledge.admission(&brief.id, TYPE), Admission::Later);
        knowledge.set_owned([(brief.id, true)].into());
        knowledge.tick(now + LINGERS);
        assert!(names(&knowledge).is_empty());
        knowledge.set_owned(HashMap::new());
        assert_eq!(knowledge.admission(&brief.id, TYPE), Admission::Yes);
        assert!(knowledge.writer(&brief.id).is_some());
        knowledge.note_endpoints(now + LINGERS + LONGEST_DOUBT, &writers(Vec::new()));
        assert!(knowledge.writer(&brief.id).is_none());
    }

    #[test]
    fn a_topic_stays_as_it_is_while_its_node_restarts() {
        let now = Instant::now();
        let knowledge = Knowledge::new();
        let listed = |knowledge: &Knowledge| -> Vec<EndpointId> {
            knowledge.subscribe().borrow().endpoints.iter().map(|it| it.id).collect()
        };
        let name = RosName::of_dds("rt/a").unwrap();
        let [before, after, last] = [1, 2, 3].map(|number| found(number, "rt/a", TYPE));
        knowledge.note_endpoints(now, &writers(vec![before.clone()]));
        knowledge.tick(now + NODE_WAIT);
        knowledge.set_owned([(before.id, true)].into());
        knowledge.note_endpoints(now, &writers(Vec::new()));
        let noticed = now + LONGEST_DOUBT;
        assert!(knowledge.is_written(now, &name, TYPE));
        assert!(!knowledge.is_written(noticed, &name, TYPE), "its reader goes");
        let changed = knowledge.note_endpoints(noticed, &writers(Vec::new()));
        assert_eq!((changed, listed(&knowledge)), ([name].into(), vec![before.id]));
        // The next one is found at the last moment, and decided about later.
        let back = now + LINGERS.saturating_sub(Duration::from_millis(10));
        knowledge.note_endpoints(back, &writers(vec![after.clone()]));
        knowledge.note_endpoints(now + LINGERS, &writers(vec![after.clone()]));
        assert_eq!(listed(&knowledge), [before.id]);
        knowledge.tick(back + NODE_WAIT);
        assert_eq!(listed(&knowledge), [before.id, after.id]);
        knowledge.set_owned([(before.id, true), (after.id, true)].into());
        knowledge.tick(back + NODE_WAIT);
        assert_eq!(listed(&knowledge), [after.id], "it has taken its place");
        // One that comes too late changes nothing.
        knowledge.note_endpoints(back, &writers(Vec::new()));
        knowledge.tick(back + LINGERS);
        knowledge.note_endpoints(back + LINGERS, &writers(vec![last]));
        assert!(listed(&knowledge).is_empty());
    }

    #[test]
    fn a_server_that_ends_is_listed_no_longer() {
        let now = Instant::now();
        let knowledge = Knowledge::new();
        let server = found(1, "rr/addReply", TYPE);
        knowledge.note_endpoints(now, &writers(vec![server.clone()]));
        knowledge.tick(now + NODE_WAIT);
        knowledge.set_owned([(server.id, true)].into());
        assert_eq!(names(&knowledge).len(), 1);
        knowledge.note_endpoints(now, &writers(Vec::new()));
        assert!(names(&knowledge).is_empty());
    }

    #[test]
    fn one_that_is_never_named_goes_in_a_while() {
        let now = Instant::now();
        let knowledge = Knowledge::new();
        knowledge.note_endpoints(now, &writers(vec![found(1, "rt/a", TYPE)]));
        knowledge.note_endpoints(now, &writers(Vec::new()));
        knowledge.tick(now + NODE_WAIT);
        assert_eq!(names(&knowledge).len(), 1);
        knowledge.tick(now + LONGEST_DOUBT);
        assert!(names(&knowledge).is_empty());
    }

    #[test]
    fn only_changes_are_told() {
        let now = Instant::now();
        let knowledge = Knowledge::new();
        let name = |dds: &str| RosName::of_dds(dds).unwrap();
        let (a, b) = (found(1, "rt/a", TYPE), found(2, "rt/b", TYPE));
        let both = writers(vec![a.clone(), b.clone()]);
        let changed = knowledge.note_endpoints(now, &both);
        assert_eq!(changed, [name("rt/a"), name("rt/b")].into());
        assert!(knowledge.note_endpoints(now, &both).is_empty());
        knowledge.tick(now + NODE_WAIT);
        let mut network = knowledge.subscribe();
        network.mark_unchanged();
        let before = knowledge.writer(&a.id).unwrap();
        let other = FoundEndpoint { user_data: vec![1], ..b };
        let found = writers(vec![a.clone(), other]);
        assert_eq!(knowledge.note_endpoints(now, &found), [name("rt/b")].into());
        assert!(Arc::ptr_eq(&before, &knowledge.writer(&a.id).unwrap()));
        assert_eq!(knowledge.note_endpoints(now, &writers(vec![a])), [name("rt/b")].into());
        assert_eq!(knowledge.endpoints(&name("rt/b"), true), []);
    }

    #[test]
    fn nodes_may_be_told_before_their_endpoints_are_found() {
        let now = Instant::now();
        let knowledge = Knowledge::new();
        let early = found(1, "rt/a", TYPE);
        let nodes = HashMap::from([(early.id, Arc::from("/talker"))]);
        knowledge.note_nodes(now, early.participant(), nodes);
        knowledge.note_endpoints(now, &writers(Vec::new()));
        knowledge.note_endpoints(now, &writers(vec![early.clone()]));
        assert_eq!(names(&knowledge), [("/a".to_owned(), Some("/talker".to_owned()))]);
        knowledge.note_endpoints(now, &writers(Vec::new()));
        assert!(knowledge.state.lock().nodes.is_empty(), "its participant has left");
        let crowd = (0..2 * MAX_PARTICIPANTS).map(|number| {
            let mut prefix = [0; 12];
            prefix[..8].copy_from_slice(&number.to_be_bytes());
            GuidPrefix(prefix)
        });
        crowd.for_each(|from| knowledge.note_nodes(now, from, HashMap::new()));
        assert!(knowledge.state.lock().nodes.len() <= MAX_PARTICIPANTS);
    }

    #[test]
    fn nobody_waits_for_a_writer_that_cannot_be_read() {
        let knowledge = Knowledge::new();
        let mut keyed = found(1, "rt/a", TYPE);
        keyed.id[15] = 0x02;
        let odd = found(2, "rt/a", "blaze::v1::Frame");
        let other = found(3, "rt/a", "std_msgs::msg::dds_::UInt8_");
        knowledge.note_endpoints(
            Instant::now(),
            &writers(vec![keyed.clone(), odd.clone(), other.clone()]),
        );
        assert_eq!(knowledge.admission(&keyed.id, TYPE), Admission::No);
        assert_eq!(knowledge.admission(&odd.id, &odd.type_name), Admission::No);
        assert_eq!(knowledge.admission(&other.id, TYPE), Admission::No);
        assert_eq!(knowledge.admission(&other.id, &other.type_name), Admission::Later);
    }

    #[test]
    fn a_crowd_is_bounded_and_counted() {
        let now = Instant::now();
        let knowledge = Knowledge::new();
        let first = found(2, "rt/first", TYPE);
        knowledge.note_endpoints(now, &writers(vec![first.clone()]));
        let crowd = (0..MAX_ENDPOINTS + 6).map(|number| {
            let mut one = found(1, "rt/a", TYPE);
            one.id[4..12].copy_from_slice(&(number as u64).to_be_bytes());
            one
        });
        knowledge.note_endpoints(now, &writers(crowd.chain([first.clone()]).collect()));
        knowledge.tick(now + NODE_WAIT);
        let network = Arc::clone(&knowledge.subscribe().borrow());
        assert_eq!((network.endpoints.len(), network.refused), (MAX_ENDPOINTS, 7));
        assert!(knowledge.writer(&first.id).is_some(), "it was there first");
    }
}
