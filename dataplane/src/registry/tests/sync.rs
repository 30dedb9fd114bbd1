use std::collections::BTreeMap;

use blaze_proto::link::LinkControl;
use blaze_proto::link::link_control::{Delta, Entry, Snapshot, SnapshotRequest};
use prost::Message;

use super::*;
use crate::testing::{Random, delta};

/// Registries on a channel that loses, delays, reorders and repeats.
struct Net {
    now: Instant,
    start: Instant,
    random: Random,
    loss_percent: u64,
    delay_ms: u64,
    registries: Vec<Registry>,
    next_hello: Vec<Instant>,
    flying: BTreeMap<(Instant, u64), (usize, FlowId, Vec<u8>)>,
    serial: u64,
    sent: BTreeMap<&'static str, u64>,
}

impl Net {
    fn new(seed: u64, flows: &[&str], loss_percent: u64, delay_ms: u64) -> Self {
        let now = Instant::now();
        Self {
            now,
            start: now,
            random: Random(seed),
            loss_percent,
            delay_ms,
            registries: flows.iter().map(|flow| Registry::new(config(flow, 1, now))).collect(),
            next_hello: vec![now; flows.len()],
            flying: BTreeMap::new(),
            serial: 0,
            sent: BTreeMap::new(),
        }
    }

    fn send(&mut self, from: &FlowId, to: usize, body: Body) {
        let name = match &body {
            Body::Hello(_) => "hello",
            Body::Delta(_) => "delta",
            Body::SnapshotRequest(_) => "snapshot_request",
            Body::Snapshot(_) => "snapshot",
            Body::Feedback(_)
            | Body::Goodbye(_)
            | Body::WrittenRequest(_)
            | Body::Written(_)
            | Body::TypeRequest(_)
            | Body::TypeDefinition(_) => "other",
        };
        *self.sent.entry(name).or_default() += 1;
        let bytes = LinkControl::from(body).encode_to_vec();
        assert!(bytes.len() <= MAX_LINK_CONTROL_BYTES, "{name} has {} bytes", bytes.len());
        let copies = 1 + u64::from(self.random.percent(10));
        for _ in 0..copies {
            if !self.random.percent(self.loss_percent) {
                let at = self.now + Duration::from_millis(1 + self.random.below(self.delay_ms));
                self.serial += 1;
                self.flying.insert((at, self.serial), (to, from.clone(), bytes.clone()));
            }
        }
    }

    fn index(&self, flow: &FlowId) -> Option<usize> {
        self.registries.iter().position(|registry| registry.world().me == *flow)
    }

    fn pump(&mut self, index: usize) {
        let from = self.registries[index].world().me.clone();
        for (flow, body) in self.registries[index].poll(self.now) {
            if let Some(to) = self.index(&flow) {
                self.send(&from, to, body);
            }
        }
    }

    /// Lets 5 ms pass: Hellos, what the registries want to send, what arrives.
    fn step(&mut self) {
        self.now += Duration::from_millis(5);
        for index in 0..self.registries.len() {
            self.registries[index].expire(self.now);
            self.pump(index);
            if self.next_hello[index] <= self.now {
                self.next_hello[index] = self.now + Duration::from_millis(500);
                let (from, hello) =
                    (self.registries[index].world().me.clone(), hello(&self.registries[index]));
                for to in (0..self.registries.len()).filter(|to| *to != index) {
                    self.send(&from, to, Body::Hello(hello.clone()));
                }
            }
        }
        while let Some(entry) = self.flying.first_entry().filter(|entry| entry.key().0 <= self.now)
        {
            let (to, from, bytes) = entry.remove();
            let body = LinkControl::decode(bytes.as_slice()).unwrap().body.unwrap();
            match body {
                Body::Hello(hello) => self.registries[to].on_hello(self.now, &from, &hello),
                body => self.registries[to].on_control(self.now, &from, body),
            };
            // As its owner does: what an arrival makes possible goes out at once.
            self.pump(to);
        }
    }

    fn run(&mut self, ms: u64) {
        let until = self.now + Duration::from_millis(ms);
        while self.now < until {
            self.step();
        }
    }

    /// A service of the first flow's node says something.
    fn say(&mut self, message: &Value) {
        say(&mut self.registries[0], self.now, Scope::Node, message);
    }

    /// One random change of a random registry.
    fn change(&mut self) {
        let index = usize::try_from(self.random.below(self.registries.len() as u64)).unwrap();
        let scope = if self.random.percent(50) { Scope::Node } else { Scope::Layer };
        let mut objects = Vec::new();
        for _ in 0..=self.random.below(5) {
            let mut object = json!({
                "topic": format!("t{}", self.random.below(30)),
                "service": format!("s{}", self.random.below(5)),
            });
            match self.random.below(5) {
                0 => object["op"] = json!("withdraw"),
                1 | 2 => {
                    object["op"] = json!("request");
                    object["max_rate_hz"] = json!(1 + self.random.below(50));
                    object["from"] =
                        json!({"node": format!("{}{}", "n".repeat(50), self.random.below(40))});
                }
                _ => {
                    object["op"] = json!("advertise");
                    object["rate_hz"] = json!(1 + self.random.below(50));
                    object["encoding"] = json!("e".repeat(100));
                }
            }
            object["ttl_s"] = json!([0, 2, 86_400][usize::try_from(self.random.below(3)).unwrap()]);
            objects.push(object);
        }
        say(&mut self.registries[index], self.now, scope, &Value::from(objects));
        if self.random.percent(30) {
            let routes = (0..self.random.below(3))
                .map(|_| RouteState {
                    to_layer: "cloud".into(),
                    next_offset: self.random.next(),
                    ..RouteState::default()
                })
                .collect();
            let name = topic(&format!("t{}", self.random.below(40)));
            self.registries[index].set_route_state(self.now, &name, routes);
        }
    }

    /// What is wrong with the views of all registries; empty = each knows all that each has.
    fn differences(&self) -> Vec<String> {
        let mut found = Vec::new();
        for truth in &self.registries {
            let me = &truth.world().me;
            let own = truth.world().own().unwrap();
            let expected: BTreeMap<_, _> = own
                .topics
                .iter()
                .map(|(topic, entry)| wire::from_wire(&wire::to_wire(topic, entry, &[])).unwrap())
                .collect();
            for viewer in self.registries.iter().filter(|viewer| viewer.world().me != *me) {
                let here = format!("{me} seen by {}", viewer.world().me);
                let Some(view) = viewer.world().flows.get(me) else {
                    found.push(format!("{here}: unknown"));
                    continue;
                };
                if view.topics != expected {
                    found.push(format!(
                        "{here}: {} topics, not {}",
                        view.topics.len(),
                        expected.len()
                    ));
                }
                if (view.epoch, view.kind) != (own.epoch, own.kind) {
                    found.push(format!("{here}: epoch {} not {}", view.epoch, own.epoch));
                }
                for (topic, routes) in &truth.routes {
                    if viewer.remote_routes(me, topic) != routes {
                        found.push(format!("{here}: routes of {topic}"));
                    }
                }
                if !viewer.is_in_step_with(me) {
                    found.push(format!("{here}: not in step"));
                }
            }
        }
        found
    }
}

const FLOWS: [&str; 3] = ["edge/robot-1", "fog/fog-1", "cloud/cloud-1"];

fn seeds() -> u64 {
    300
}

#[test]
fn all_views_agree_after_random_changes_on_a_bad_channel() {
    let mut worst = Duration::ZERO;
    for seed in 0..seeds() {
        let loss = [0, 5, 30][usize::try_from(seed % 3).unwrap()];
        let mut net = Net::new(seed, &FLOWS, loss, 80);
        for _ in 0..60 {
            net.change();
            let pause = net.random.below(100);
            net.run(pause);
            if net.random.percent(3) {
                // A restart: nothing is left but the name, and the epoch is newer.
                let index = usize::try_from(net.random.below(3)).unwrap();
                let epoch = net.registries[index].world().own().unwrap().epoch + 1;
                net.registries[index] = Registry::new(config(FLOWS[index], epoch, net.now));
            }
        }
        // The last leases lapse; then it is quiet.
        net.run(2_100);
        let quiet = net.now;
        while !net.differences().is_empty() {
            assert!(
                net.now - quiet < Duration::from_secs(15),
                "seed {seed}: {:?}",
                net.differences()
            );
            net.run(20);
        }
        worst = worst.max(net.now - quiet);
        net.run(1_000);
        assert_eq!(net.differences(), Vec::<String>::new(), "seed {seed}");
    }
    println!("longest until all agree: {worst:?}");
}

#[test]
fn quiet_registries_say_nothing_but_hello() {
    let mut net = Net::new(1, &FLOWS, 0, 20);
    for _ in 0..20 {
        net.change();
        net.run(50);
    }
    net.run(3_000);
    assert_eq!(net.differences(), Vec::<String>::new());
    let before = net.sent.clone();
    net.run(5_000);
    for (name, count) in &net.sent {
        assert!(
            *name == "hello" || before.get(name) == Some(count),
            "{name}: {count}, before {before:?}"
        );
    }
    for registry in &net.registries {
        assert_eq!(registry.next_poll(), None);
        assert_eq!(registry.faults().bad_entries + registry.faults().bad_parts, 0);
    }
}

#[test]
fn on_a_good_channel_deltas_are_enough() {
    let mut net = Net::new(2, &FLOWS, 0, 2);
    net.run(600);
    net.say(&lease("advertise", "imu", "a"));
    net.run(30);
    assert_eq!(net.differences(), Vec::<String>::new());
    assert_eq!(net.registries[0].announced().0, 1);
    assert_eq!(net.sent.get("snapshot"), None);
    let remote = net.registries[1]
        .remote_leases(&topic("imu"))
        .map(|lease| (lease.flow.to_string(), lease.scope))
        .collect::<Vec<_>>();
    assert_eq!(remote, [("edge/robot-1".to_owned(), Scope::Node)]);
}

#[test]
fn one_lost_delta_is_repaired_by_the_next() {
    let mut net = Net::new(3, &FLOWS[..2], 0, 2);
    net.run(600);
    for (name, loss) in [("a", 100), ("b", 0)] {
        net.loss_percent = loss;
        net.say(&lease("advertise", name, "a"));
        net.run(30);
    }
    assert_eq!(net.differences(), Vec::<String>::new());
    assert_eq!(net.sent.get("snapshot_request"), None);
}

#[test]
fn a_large_registry_is_pulled_at_the_pace_of_the_receiver() {
    let mut net = Net::new(4, &FLOWS, 2, 20);
    net.run(600);
    let messages: Vec<_> = (0..5_000)
        .map(|index| {
            let mut message = AdvertiseMessage::new(
                topic(&format!("area/{index}/camera/image")),
                "driver".parse().unwrap(),
            );
            message.ttl_s = 0;
            message.rate_hz = Some(30.0);
            ControlMessage::Advertise(message)
        })
        .collect();
    let clock = Instant::now();
    for payload in ControlMessage::to_payloads(&messages) {
        assert_eq!(net.registries[0].control(net.now, Scope::Node, &payload).faults, 0);
    }
    let begun = net.now;
    while !net.differences().is_empty() {
        assert!(net.now - begun < Duration::from_secs(30), "{:?}", net.differences());
        net.run(100);
    }
    println!(
        "5,000 topics: {:?} until two others know them, {:?} of work, sent {:?}",
        net.now - begun,
        clock.elapsed(),
        net.sent
    );
    assert_eq!(net.sent.get("delta"), None);
    // Then a change is a single small Delta again.
    let before = net.sent["snapshot"];
    net.loss_percent = 0;
    net.say(&json!({"op": "withdraw", "topic": "area/7/camera/image", "service": "driver"}));
    net.run(60);
    assert_eq!(net.differences(), Vec::<String>::new());
    assert!(net.sent["snapshot"] <= before + 1);
    // A newcomer pulls all of it, also while the announced state keeps changing.
    let late = Registry::new(config("cloud/late", 1, net.start));
    net.registries.push(late);
    net.next_hello.push(net.now);
    for index in 0..40 {
        net.say(&lease("advertise", &format!("new/{index}"), "a"));
        net.run(100);
    }
    net.run(2_000);
    assert_eq!(net.differences(), Vec::<String>::new());
}

fn pair() -> (Registry, Registry, Instant) {
    let now = Instant::now();
    (Registry::new(config(FLOWS[0], 5, now)), Registry::new(config(FLOWS[1], 5, now)), now)
}

/// What one has to say reaches the other. Returns how much that was.
fn exchange(from: &mut Registry, to: &mut Registry, at: Instant) -> usize {
    let (me, said) = (from.world().me.clone(), from.poll(at));
    let count = said.len();
    for (_, body) in said {
        to.on_control(at, &me, body);
    }
    count
}

#[test]
fn a_new_life_replaces_what_the_old_one_announced() {
    let (mut robot, mut fog, now) = pair();
    let me = robot.world().me.clone();
    say(&mut robot, now, Scope::Node, &lease("advertise", "imu", "a"));
    fog.on_hello(now, &me, &hello(&robot));
    // The first Hello was said before anything was announced; the Delta follows from there.
    let from = fog.world().me.clone();
    robot.on_hello(now, &from, &hello(&fog));
    let mut changed = BTreeSet::new();
    for (_, body) in robot.poll(now + Duration::from_millis(20)) {
        changed.extend(fog.on_control(now, &me, body));
    }
    assert_eq!(changed, BTreeSet::from([topic("imu")]));
    assert!(fog.world().flows[&me].node_scope);
    assert_eq!(fog.all_topics().len(), 1);
    let old = hello(&robot);
    let reborn = Registry::new(config(FLOWS[0], 6, now));
    assert_eq!(fog.on_hello(now, &me, &hello(&reborn)), BTreeSet::from([topic("imu")]));
    assert_eq!((fog.world().flows[&me].epoch, fog.all_topics().len()), (6, 0));
    assert!(fog.on_hello(now, &me, &old).is_empty());
    assert_eq!((fog.world().flows[&me].epoch, fog.faults().old_epochs), (6, 1));
}

#[test]
fn a_view_that_ran_ahead_of_its_flow_is_corrected() {
    let (mut robot, mut fog, now) = pair();
    let (me, fog_id) = (robot.world().me.clone(), fog.world().me.clone());
    robot.on_hello(now, &fog_id, &hello(&fog));
    say(&mut robot, now, Scope::Node, &lease("advertise", "imu", "a"));
    robot.poll(now + Duration::from_millis(20));
    fog.on_hello(now, &me, &hello(&robot));
    // A Delta of an earlier life comes late.
    let stale = Delta { from_version: 0, ..delta(70, Vec::new()) };
    fog.on_control(now, &me, Body::Delta(stale));
    assert!(fog.all_topics().is_empty());
    let mut at = now;
    for _ in 0..200 {
        at += Duration::from_millis(10);
        if at.duration_since(now).as_millis() % 500 == 0 {
            fog.on_hello(at, &me, &hello(&robot));
        }
        exchange(&mut fog, &mut robot, at);
        exchange(&mut robot, &mut fog, at);
    }
    assert!(fog.is_in_step_with(&me));
    assert_eq!(fog.all_topics(), BTreeSet::from([topic("imu")]));
}

#[test]
fn many_flows_are_pulled_a_few_at_a_time() {
    let (robot, mut fog, now) = pair();
    let mut hello = hello(&robot);
    hello.registry_version = 1;
    for index in 0..20 {
        hello.node = format!("robot-{index}");
        fog.on_hello(now, &format!("edge/robot-{index}").parse().unwrap(), &hello);
    }
    let mut at = now + Duration::from_millis(50);
    assert_eq!(fog.next_poll(), Some(at));
    assert_eq!(fog.poll(at).len(), 8);
    // Nobody answers: the first give way to the others, and it never asks to be polled for nothing.
    let mut asked = BTreeSet::new();
    while at < now + Duration::from_secs(10) {
        asked.extend(fog.poll(at).into_iter().map(|(flow, _)| flow));
        let next = fog.next_poll().unwrap();
        assert!(next > at, "{:?}", next - now);
        at = next;
    }
    assert_eq!(asked.len(), 20);
}

#[test]
fn state_and_reach_of_others_replan_everything() {
    let (robot, mut fog, now) = pair();
    let me = robot.world().me.clone();
    say(&mut fog, now, Scope::Node, &lease("advertise", "imu", "a"));
    let all = BTreeSet::from([topic("imu")]);
    let mut hello = hello(&robot);
    assert_eq!(fog.on_hello(now, &me, &hello), all);
    assert!(fog.on_hello(now, &me, &hello).is_empty());
    hello.state = State::Draining.into();
    assert_eq!(fog.on_hello(now, &me, &hello), all);
    assert_eq!(fog.world().flows[&me].state, FlowState::Draining);
    hello.layer_scope_id = 0;
    assert_eq!(fog.on_hello(now, &me, &hello), all);
    assert_eq!(fog.world().flows[&me].layer_scope, None);
    assert_eq!(fog.set_reach(now, &me, Reach::Down), all);
    assert!(fog.set_reach(now, &me, Reach::Down).is_empty());
    assert_eq!(fog.set_state(FlowState::Ready), all);
    assert_eq!(fog.forget(now, &me), all);
    assert!(fog.forget(now, &me).is_empty());
    assert_eq!(fog.world().flows.len(), 1);
}

#[test]
fn nothing_is_sent_to_a_flow_that_is_down() {
    let (robot, mut fog, now) = pair();
    let me = robot.world().me.clone();
    let mut hello = hello(&robot);
    hello.registry_version = 3;
    fog.on_hello(now, &me, &hello);
    say(&mut fog, now, Scope::Node, &lease("advertise", "imu", "a"));
    fog.set_reach(now, &me, Reach::Down);
    assert!(fog.poll(now + Duration::from_secs(1)).is_empty());
    assert_eq!(fog.next_poll(), None);
    // It is back with the next Hello.
    fog.set_reach(now, &me, Reach::Up);
    fog.on_hello(now, &me, &hello);
    let sent = fog.poll(now + Duration::from_secs(1));
    assert!(
        matches!(sent.as_slice(), [(_, Body::SnapshotRequest(request))] if request.version == 0),
        "{sent:?}"
    );
}

#[test]
fn a_wrong_digest_is_repaired_without_a_storm() {
    let (mut robot, mut fog, now) = pair();
    let me = robot.world().me.clone();
    let fog_id = fog.world().me.clone();
    robot.on_hello(now, &fog_id, &hello(&fog));
    let mut lie = hello(&robot);
    lie.registry_digest = 77;
    let (mut at, mut asked) = (now, 0);
    for _ in 0..6_000 {
        at += Duration::from_millis(10);
        if at.duration_since(now).as_millis() % 500 == 0 {
            fog.on_hello(at, &me, &lie);
        }
        asked += exchange(&mut fog, &mut robot, at);
        exchange(&mut robot, &mut fog, at);
    }
    assert!((5..30).contains(&asked), "{asked} requests in a minute");
    assert!(!fog.is_in_step_with(&me));
    // The truth ends it.
    fog.on_hello(at, &me, &hello(&robot));
    assert!(fog.is_in_step_with(&me));
}

#[test]
fn hostile_announcements_are_counted_and_ignored() {
    let (robot, mut fog, now) = pair();
    let me = robot.world().me.clone();
    let entry = |topic: &str| Entry {
        topic: topic.into(),
        node_advertise: Some(blaze_proto::link::link_control::Advertise::default()),
        ..Entry::default()
    };
    let delta = |from_version, to_version, part, parts, entries| {
        let rest = delta(to_version, entries);
        Body::Delta(Delta { from_version, part, parts, ..rest })
    };
    fog.on_control(now, &me, delta(0, 1, 0, 1, vec![entry("a")]));
    assert_eq!((fog.faults().unknown_flows, fog.world().flows.len()), (1, 1));
    fog.on_hello(now, &me, &hello(&robot));
    for bad in [
        delta(1, 1, 0, 1, vec![]),
        delta(2, 1, 0, 1, vec![]),
        delta(0, 1, 0, 0, vec![]),
        delta(0, 1, 1, 1, vec![]),
        delta(0, 1, 0, u32::MAX, vec![]),
        delta(0, 1, 0, 1, vec![entry("a"); 1_001]),
    ] {
        assert!(fog.on_control(now, &me, bad).is_empty());
    }
    assert_eq!(fog.faults().bad_parts, 6);
    let snapshot =
        |version, part, parts, entries| Body::Snapshot(Snapshot { version, part, parts, entries });
    fog.on_control(now, &me, snapshot(9, 0, 1, vec![entry("a")]));
    assert_eq!(fog.faults().unasked_parts, 1);
    // Good entries beside garbage are taken.
    let mixed =
        vec![entry("/bad"), entry("good"), entry("blaze/flow/control"), entry(&"x".repeat(300))];
    assert_eq!(fog.on_control(now, &me, delta(0, 1, 0, 1, mixed)), BTreeSet::from([topic("good")]));
    assert_eq!(fog.faults().bad_entries, 3);
    // Deltas that can never be applied push out one another.
    for version in 0..1_000 {
        fog.on_control(now, &me, delta(version + 10, version + 11, 0, 2, vec![entry("a")]));
    }
    assert_eq!(fog.faults().evicted_deltas, 1_000 - 32);
    let before = fog.world().clone();
    let later = now + Duration::from_secs(1);
    assert_eq!(fog.poll(later).len(), 1);
    for bad in
        [snapshot(1, 0, u32::MAX, vec![]), snapshot(1, 5, 5, vec![]), snapshot(1, 0, 0, vec![])]
    {
        fog.on_control(later, &me, bad);
    }
    assert_eq!(fog.faults().bad_parts, 9);
    fog.on_control(later, &me, snapshot(7, 100, 200, vec![entry("a")]));
    assert_eq!((fog.faults().unasked_parts, fog.world()), (2, &before));
    let mut stranger = hello(&robot);
    stranger.node = "robot-2".into();
    assert!(fog.on_hello(now, &me, &stranger).is_empty());
    let own = fog.world().me.clone();
    let mirrored = hello(&fog);
    fog.on_hello(now, &own, &mirrored);
    assert_eq!(fog.faults().bad_hellos, 2);
    for _ in 0..10_000 {
        let request =
            SnapshotRequest { version: fog.faults().dropped_replies, parts: (0..1000).collect() };
        fog.on_control(now, &me, Body::SnapshotRequest(request));
    }
    assert!(fog.faults().dropped_replies > 0 && fog.poll(later).len() <= 2_100);
}

#[test]
fn flows_and_their_entries_are_bounded() {
    let (robot, mut fog, now) = pair();
    let mut hello = hello(&robot);
    for index in 0..MAX_FLOWS + 44 {
        hello.node = format!("robot-{index}");
        let from = format!("edge/robot-{index}").parse().unwrap();
        fog.on_hello(now, &from, &hello);
    }
    assert_eq!((fog.world().flows.len(), fog.faults().too_many_flows), (MAX_FLOWS + 1, 44));
    // One that is down makes room.
    let gone: FlowId = "edge/robot-9".parse().unwrap();
    fog.set_reach(now, &gone, Reach::Down);
    hello.node = "new".into();
    let new: FlowId = "edge/new".parse().unwrap();
    fog.on_hello(now, &new, &hello);
    assert!(fog.world().flows.contains_key(&new) && !fog.world().flows.contains_key(&gone));
    let limit = u64::try_from(announce::MAX_ENTRIES).unwrap();
    for version in 0..20 {
        let entries = (0..1_000)
            .map(|index| Entry {
                topic: format!("t{version}/{index}"),
                layer_request: Some(blaze_proto::link::link_control::Request::default()),
                ..Entry::default()
            })
            .collect();
        fog.on_control(now, &new, Body::Delta(delta(version + 1, entries)));
    }
    assert_eq!(fog.world().flows[&new].topics.len() as u64, limit);
    assert_eq!(fog.faults().too_many_entries, 20_000 - limit);
}

#[test]
fn route_states_alone_are_announced_within_a_limit() {
    let (mut robot, _, now) = pair();
    let routes = || vec![RouteState { to_layer: "fog".into(), ..RouteState::default() }];
    for index in 0..2_500 {
        robot.set_route_state(now, &topic(&format!("t{index}")), routes());
    }
    robot.poll(now + Duration::from_secs(1));
    assert_eq!(robot.faults().left_out_routes, 500);
    // Taken back, nothing is left, and the digest is that of an empty flow.
    for index in 0..2_500 {
        robot.set_route_state(now, &topic(&format!("t{index}")), Vec::new());
    }
    robot.poll(now + Duration::from_secs(2));
    assert_eq!(robot.announced(), (2, 0));
}
