//! What the adapter of a ROS 2 network has found.

use std::net::Ipv4Addr;

use blaze_domain::{Reliability, WriterId};

use super::*;
use crate::testing::access;
use crate::world::{Ros2Network, Ros2NetworkId};

const NETWORK: Ros2NetworkId = Ros2NetworkId(7);

fn at(address: u8) -> Ros2Network {
    Ros2Network { id: NETWORK, address: Ipv4Addr::new(10, 0, 0, address) }
}

fn endpoint(guid: u8, kind: LeaseKind, address: u8) -> FoundEndpoint {
    FoundEndpoint {
        guid: WriterId([guid; 16]),
        kind,
        type_name: "std_msgs/msg/String".to_owned(),
        type_hash: String::new(),
        reliability: Reliability::Reliable,
        durability: Durability::TransientLocal,
        lifespan_ms: 0,
        node: format!("/arm/Talker_{guid}"),
        locators: vec![Ipv4Addr::new(10, 0, 0, address)],
    }
}

/// Two flows on one network, `edge/a` at 10.0.0.1 and `edge/b` at 10.0.0.2, that know each other.
struct Pair {
    flows: [Registry; 2],
    found: BTreeMap<TopicName, Vec<FoundEndpoint>>,
    now: Instant,
}

impl Pair {
    fn new() -> Self {
        let now = Instant::now();
        let flow = |name: &str, address| {
            let mut registry = Registry::new(config(name, 1, now));
            registry.set_state(FlowState::Ready);
            registry.set_ros2_network(now, Some(at(address)));
            registry
        };
        let mut pair =
            Self { flows: [flow("edge/a", 1), flow("edge/b", 2)], found: BTreeMap::new(), now };
        pair.exchange();
        pair
    }

    /// Each tells the other what there is to tell.
    fn exchange(&mut self) {
        self.now += Duration::from_millis(20);
        for (from, to) in [(0, 1), (1, 0)] {
            let messages = self.flows[from].poll(self.now);
            let me = self.flows[from].world().me.clone();
            for (_, body) in messages {
                self.flows[to].on_control(self.now, &me, body);
            }
            let own = self.flows[from].world().own().unwrap().ros2.unwrap();
            let said = Hello {
                ros2_network: own.id.0,
                ros2_address: own.address.to_string(),
                ..hello(&self.flows[from])
            };
            self.flows[to].on_hello(self.now, &me, &said);
        }
        for flow in &mut self.flows {
            flow.update_found(self.now);
        }
    }

    /// Both adapters find the same.
    fn find(&mut self, name: &str, endpoints: &[FoundEndpoint]) {
        self.found.insert(topic(name), endpoints.to_vec());
        for flow in &mut self.flows {
            flow.set_found(self.now, self.found.clone());
        }
    }

    /// Whether each flow announces a writer and a reader of a topic.
    fn announced(&self, name: &str) -> [(bool, bool); 2] {
        [0, 1].map(|flow: usize| {
            let own = self.flows[flow].world().own().unwrap();
            let entry = own.topics.get(&topic(name)).map(|entry| &entry.ros2);
            entry.map_or((false, false), |ros2| (ros2.advertise.is_some(), ros2.request.is_some()))
        })
    }
}

#[test]
fn a_writer_is_announced_by_its_owner_and_a_reader_by_all() {
    let mut pair = Pair::new();
    let (writer, reader) = (LeaseKind::Advertise, LeaseKind::Request);
    pair.find("chatter", &[endpoint(1, writer, 2), endpoint(2, reader, 2)]);
    assert_eq!(pair.announced("chatter"), [(false, true), (true, true)]);
    pair.exchange();
    let of_b = &pair.flows[0].world().flows[&"edge/b".parse().unwrap()];
    assert_eq!(of_b.ros2, Some(at(2)));
    let told = of_b.topics[&topic("chatter")].ros2.advertise.clone().unwrap();
    assert_eq!((told.type_name.as_str(), told.depth), ("std_msgs/msg/String", 10));
    assert_eq!(told.sources[0].service, "arm-talker-1");
    assert_eq!(pair.flows[0].remote_leases(&topic("chatter")).count(), 1);

    // Requests to a service are for the flow of its server.
    pair.find("add/_request", &[endpoint(3, reader, 1)]);
    assert_eq!(pair.announced("add/_request"), [(false, true), (false, false)]);

    pair.find("chatter", &[]);
    assert_eq!(pair.announced("chatter"), [(false, false); 2]);
    pair.exchange();
    let of_b = &pair.flows[0].world().flows[&"edge/b".parse().unwrap()];
    assert!(!of_b.topics.contains_key(&topic("chatter")));
}

#[test]
fn a_writer_that_nobody_claims_goes_to_one_flow_after_two_seconds() {
    let mut pair = Pair::new();
    let writers: Vec<_> = (1..=8).map(|guid| endpoint(guid, LeaseKind::Advertise, 99)).collect();
    for writer in &writers {
        pair.find(&format!("t{}", writer.guid), std::slice::from_ref(writer));
    }
    let owners = |pair: &Pair| -> Vec<usize> {
        let of = |writer: &FoundEndpoint| pair.announced(&format!("t{}", writer.guid));
        writers.iter().map(|w| of(w).iter().filter(|(offers, _)| *offers).count()).collect()
    };
    assert_eq!(owners(&pair), [0; 8]);
    pair.now += Duration::from_millis(1_900);
    pair.exchange();
    assert_eq!(owners(&pair), [0; 8]);
    pair.now += Duration::from_millis(200);
    pair.exchange();
    assert_eq!(owners(&pair), [1; 8], "one each");
    let a = |pair: &Pair| {
        writers.iter().filter(|w| pair.announced(&format!("t{}", w.guid))[0].0).count()
    };
    assert!((1..8).contains(&a(&pair)), "both have some");
    // One goes: the other has them all.
    let b = "edge/b".parse().unwrap();
    pair.flows[0].set_reach(pair.now, &b, Reach::Down);
    pair.flows[0].update_found(pair.now);
    assert_eq!(a(&pair), 8);
}

#[test]
fn what_the_rules_do_not_allow_is_not_announced() {
    let mut pair = Pair::new();
    pair.find(
        "chatter",
        &[endpoint(1, LeaseKind::Advertise, 1), endpoint(2, LeaseKind::Request, 1)],
    );
    let rule = json!([{"match": "chatter", "advertise": {"deny": ["edge/a/arm-talker-1"]}}]);
    pair.flows[0].set_access(pair.now, access(&rule));
    assert_eq!(pair.announced("chatter")[0], (false, true));
    pair.flows[0].set_access(pair.now, AccessRules::default());
    assert_eq!(pair.announced("chatter")[0], (true, true));
}

#[test]
fn a_network_that_is_in_use_is_as_if_it_was_not_there() {
    let mut pair = Pair::new();
    pair.find("chatter", &[endpoint(1, LeaseKind::Advertise, 1)]);
    pair.flows[0].set_in_use(pair.now, Scope::Ros2, true);
    assert_eq!(pair.flows[0].world().own().unwrap().ros2, None);
    assert_eq!(pair.announced("chatter")[0], (false, false));
    pair.flows[0].set_in_use(pair.now, Scope::Ros2, false);
    pair.flows[0].update_found(pair.now);
    assert_eq!(pair.announced("chatter")[0], (true, false));
    pair.flows[0].set_ros2_network(pair.now, None);
    assert_eq!(pair.announced("chatter")[0], (false, false));
}

#[test]
fn the_adapter_is_told_which_writers_to_read() {
    let mut pair = Pair::new();
    assert_eq!(pair.flows[0].take_owned(), None);
    let (writer, reader) = (LeaseKind::Advertise, LeaseKind::Request);
    let of_b = endpoint(2, writer, 2);
    let all =
        [endpoint(1, writer, 1), of_b.clone(), endpoint(3, writer, 9), endpoint(4, reader, 1)];
    pair.find("chatter", &all);
    let owned = BTreeMap::from([(WriterId([1; 16]), true), (WriterId([2; 16]), false)]);
    assert_eq!(pair.flows[0].take_owned(), Some(owned), "the third is not decided yet");
    pair.find("chatter", &all);
    assert_eq!(pair.flows[0].take_owned(), None, "nothing is new");
    pair.flows[0].set_reach(pair.now, &"edge/b".parse().unwrap(), Reach::Down);
    pair.now += Duration::from_secs(3);
    pair.flows[0].update_found(pair.now);
    pair.now += Duration::from_secs(3);
    pair.flows[0].update_found(pair.now);
    let owned = pair.flows[0].take_owned().unwrap();
    assert!(owned.len() == 3 && owned.values().all(|is_own| *is_own), "{owned:?}");
    pair.find("chatter", &[of_b]);
    assert_eq!(pair.flows[0].take_owned().unwrap().len(), 1);
}

#[test]
fn two_types_on_one_topic_are_told_as_none() {
    let mut pair = Pair::new();
    let other = FoundEndpoint {
        type_name: "std_msgs/msg/Int32".to_owned(),
        ..endpoint(2, LeaseKind::Advertise, 1)
    };
    pair.find("chatter", &[endpoint(1, LeaseKind::Advertise, 1), other]);
    let own = pair.flows[0].world().own().unwrap();
    let offer = own.topics[&topic("chatter")].ros2.advertise.as_ref().unwrap();
    assert_eq!((offer.type_name.as_str(), offer.sources.len()), ("", 2));
}
