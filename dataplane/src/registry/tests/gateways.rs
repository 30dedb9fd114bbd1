//! What a gateway tells of the flows that it speaks for, where it is more than it may tell.

use blaze_proto::link::link_control::{Entry, Gateway, Request};

use super::*;
use crate::registry::announce::MAX_ENTRIES;
use crate::registry::remote::Remote;
use crate::testing::delta;

const MS: Duration = Duration::from_millis(1);
/// Topics of each of the two members.
const TOPICS: usize = 7_000;

/// `cloud/g`, which speaks for two members, and `edge/r` outside.
struct Group {
    now: Instant,
    gateway: Registry,
    outside: Registry,
    /// Versions that the members have announced.
    versions: BTreeMap<FlowId, u64>,
}

fn id(text: &str) -> FlowId {
    text.parse().unwrap()
}

fn name(member: usize, topic: usize) -> String {
    format!("m{member}/t{topic:05}")
}

impl Group {
    fn new() -> Self {
        let now = Instant::now();
        let mut group = Self {
            now,
            gateway: Registry::new(config("cloud/g", 1, now)),
            outside: Registry::new(config("edge/r", 1, now)),
            versions: BTreeMap::new(),
        };
        group.gateway.set_state(FlowState::Ready);
        group.outside.set_state(FlowState::Ready);
        for member in 0..2 {
            group.say_hello(member);
            for first in (0..TOPICS).step_by(1_000) {
                group.announce(member, first..first + 1_000, 1);
            }
        }
        group
    }

    fn say_hello(&mut self, member: usize) {
        let said = Hello {
            node: format!("m{member}"),
            gateway: Gateway::Auto.into(),
            is_gateway: false,
            ..hello(&self.gateway)
        };
        let from = id(&format!("cloud/m{member}"));
        let version = *self.versions.entry(from.clone()).or_default();
        // What the channel says of its digest is not looked at here: its Deltas all arrive.
        let said = Hello { registry_version: version, registry_digest: 0, ..said };
        self.gateway.on_layer_hello(self.now, &from, &said, 1, None);
    }

    /// A member asks for topics at so many messages per second, or for none of them any more.
    fn announce(&mut self, member: usize, topics: std::ops::Range<usize>, rate_hz: u32) {
        let from = id(&format!("cloud/m{member}"));
        let version = self.versions.entry(from.clone()).or_default();
        *version += 1;
        let entry = |topic| Entry {
            topic: name(member, topic),
            removed: rate_hz == 0,
            node_request: (rate_hz > 0)
                .then(|| Request { max_rate_hz: f64::from(rate_hz), ..Request::default() }),
            ..Entry::default()
        };
        let delta = delta(*version, topics.map(entry).collect());
        self.gateway.on_layer_control(self.now, &from, 1, Body::Delta(delta));
    }

    /// Gateway and outside talk until nothing is left to say.
    fn talk(&mut self) {
        let (inside, out) = (self.gateway.world().me.clone(), self.outside.world().me.clone());
        for step in 0..600 {
            self.now += 10 * MS;
            if step % 10 == 0 {
                self.outside.on_hello(self.now, &inside, &hello(&self.gateway));
                self.gateway.on_hello(self.now, &out, &hello(&self.outside));
            }
            for (to, body) in self.gateway.poll(self.now) {
                assert_eq!(to, out);
                self.outside.on_control(self.now, &inside, body);
            }
            self.gateway.poll_layer();
            for (_, body) in self.outside.poll(self.now) {
                self.gateway.on_control(self.now, &out, body);
            }
        }
    }

    /// What outside knows of the gateway's topics.
    fn known(&self) -> BTreeSet<TopicName> {
        self.outside.world().flows[&id("cloud/g")].topics.keys().cloned().collect()
    }

    /// Outside knows all that the gateway tells, and no more is told than a flow follows.
    fn check(&self, what: &str) {
        assert_eq!(self.outside.faults().too_many_entries, 0, "{what}");
        assert!(self.outside.is_in_step_with(&id("cloud/g")), "{what}");
        assert_eq!(self.known().len(), MAX_ENTRIES, "{what}");
    }
}

#[test]
fn a_gateway_tells_no_more_topics_than_others_follow_and_always_the_same() {
    let mut group = Group::new();
    group.talk();
    group.check("at the start");
    let left_out = 2 * TOPICS - MAX_ENTRIES;
    assert_eq!(group.gateway.faults().left_out_topics, u64::try_from(left_out).unwrap());
    let (told, said) = (group.known(), group.gateway.announced());
    assert!(told.contains(&topic(&name(0, 0))) && !told.contains(&topic(&name(1, TOPICS - 1))));

    // One that is not told changes, and nobody hears of it.
    group.announce(1, TOPICS - 1..TOPICS, 2);
    group.talk();
    assert_eq!((group.known(), group.gateway.announced()), (told.clone(), said));

    // One that is told changes, and stays.
    group.announce(0, 0..1, 2);
    group.talk();
    group.check("after a change");
    assert_eq!(group.known(), told);
    assert_ne!(group.gateway.announced(), said);

    // Those that go make room for as many.
    group.announce(0, 0..10, 0);
    group.talk();
    group.check("after some went");
    assert_eq!(group.known().difference(&told).count(), 10);
}

#[test]
fn what_services_of_the_gateway_lease_is_told_before_what_others_do() {
    let mut group = Group::new();
    group.talk();
    let told = group.known();
    let lease =
        |op: &str| json!({"op": op, "topic": "own", "service": "s", "ttl_s": 0}).to_string();
    group.gateway.control(group.now, Scope::Node, lease("advertise").as_bytes());
    group.talk();
    group.check("with a lease of its own");
    assert!(group.known().contains(&topic("own")));
    assert_eq!(told.difference(&group.known()).count(), 1, "one gave way");

    group.gateway.control(group.now, Scope::Node, lease("withdraw").as_bytes());
    group.talk();
    group.check("without it");
    assert!(!group.known().contains(&topic("own")));
}

#[test]
fn what_goes_makes_room_for_what_comes_in_the_same_delta() {
    let mut remote = Remote::default();
    let (now, mut topics, mut faults) = (Instant::now(), BTreeMap::new(), SyncFaults::default());
    let entry = |topic: String, removed| Entry {
        topic,
        removed,
        node_request: (!removed).then(Request::default),
        ..Entry::default()
    };
    let mut version = 0;
    let mut tell = |entries: Vec<Entry>| {
        version += 1;
        remote.on_delta(now, delta(version, entries), &mut topics, &mut faults)
    };
    for first in (0..MAX_ENTRIES).step_by(1_000) {
        tell((first..first + 1_000).map(|n| entry(format!("t{n}"), false)).collect());
    }
    let changed = tell(vec![entry("a".to_owned(), false), entry("t0".to_owned(), true)]);
    assert_eq!((changed.len(), faults.too_many_entries), (2, 0));
    assert!(topics.contains_key(&topic("a")) && topics.len() == MAX_ENTRIES);
}
