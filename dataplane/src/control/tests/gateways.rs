//! A flow that is to be on the inter scope and cannot, and what stays of services that are only not
//! named any more.

use blaze_proto::link::link_control::{Advertise, Gateway, Source};

use super::balance::said_by;
use super::*;
use crate::link::DownReason;
use crate::world::Role;

const TOPIC: &str = "map";

/// A flow that has read its leases and hears the channel of the layer broker.
fn alone() -> Bench {
    let mut bench = Bench::with(|config| ControlConfig { inter_scope: true, ..config });
    bench.read_leases();
    bench.core.hears_replicas(bench.now);
    bench
}

impl Bench {
    fn wait(&mut self, ms: u64) {
        for _ in 0..ms / 100 {
            self.step(100);
        }
    }

    /// What is asked of the inter scope, since the last call.
    fn wishes(&mut self) -> Vec<bool> {
        self.wanted(|output| match output {
            Output::Inter { join } => Some(join),
            _ => None,
        })
    }

    /// Whose kept messages are to be forgotten, and but for whom, since the last call.
    fn forgotten(&mut self) -> Vec<(OriginFilter, BTreeSet<OriginFilter>)> {
        self.wanted(|output| match output {
            Output::ForgetWriters { of, but, .. } => Some((of, but)),
            _ => None,
        })
    }

    fn own(&self) -> (AutoBool, Role) {
        let own = self.core.world().own().unwrap();
        (own.gateway, own.role)
    }

    /// A robot's flow announces these services on its node as those that advertise the topic.
    fn robot_announces(&mut self, version: u64, services: &[&str], more_sources: bool) {
        self.robot_announces_in(1, version, services, more_sources);
    }

    /// The same in a life of its flow.
    fn robot_announces_in(
        &mut self,
        epoch: u64,
        version: u64,
        services: &[&str],
        more_sources: bool,
    ) {
        let source = |service: &&str| Source { node: "robot-1".into(), service: (*service).into() };
        let advertise = Advertise {
            transient_local: true,
            sources: services.iter().map(source).collect(),
            more_sources,
            ..Advertise::default()
        };
        let entry =
            Entry { topic: TOPIC.into(), node_advertise: Some(advertise), ..Entry::default() };
        self.robot_says_in(epoch, version, entry);
    }

    /// The flow of a robot announces something.
    fn robot_says(&mut self, version: u64, entry: Entry) {
        self.robot_says_in(1, version, entry);
    }

    fn robot_says_in(&mut self, epoch: u64, version: u64, entry: Entry) {
        let hello = Hello { epoch, ..said_by(&"edge/robot-1".parse().unwrap(), Kind::Edge) };
        self.link_says(hello, version, vec![entry]);
    }

    /// The robot's flow says good-bye, or was silent for long.
    fn forget_robot(&mut self) {
        let flow = "edge/robot-1".parse().unwrap();
        let gone = LinkEvent::PeerForgotten(Endpoint { flow, epoch: 1 });
        self.core.link_event(self.now, gone);
    }
}

fn of(layer: Option<&str>, service: &str) -> OriginFilter {
    OriginFilter {
        layer: layer.map(str::to_owned),
        node: Some("robot-1".to_owned()),
        service: Some(service.to_owned()),
    }
}

#[test]
fn a_flow_that_cannot_join_is_of_use_in_its_layer_and_tries_on() {
    let mut bench = alone();
    bench.wait(2_000);
    assert_eq!(bench.wishes(), [true]);
    bench.wait(10_000);
    assert_eq!(bench.core.state(), FlowState::Starting);
    bench.wait(10_000);
    assert_eq!(bench.core.state(), FlowState::Ready);
    assert_eq!(bench.own(), (AutoBool::No, Role::Member));
    bench.core.joined(bench.now);
    bench.wait(5_000);
    assert_eq!(bench.core.stage(), Stage::Gateway);
    assert_eq!(bench.own(), (AutoBool::Auto, Role::Gateway));
}

#[test]
fn a_gateway_that_loses_the_inter_scope_is_none_until_it_works() {
    for setting in [AutoBool::Auto, AutoBool::Yes] {
        let mut bench = alone();
        bench.core.config.gateway = setting;
        bench.wait(2_000);
        bench.core.joined(bench.now);
        bench.wait(5_000);
        assert_eq!(bench.own().1, Role::Gateway);
        bench.core.lost(bench.now);
        assert_eq!(bench.own(), (AutoBool::No, Role::Member));
        bench.wait(60_000);
        assert_eq!(bench.core.state(), FlowState::Ready);
        assert_eq!(bench.own().1, Role::Member);
        bench.core.joined(bench.now);
        bench.wait(5_000);
        assert_eq!(bench.own(), (setting, Role::Gateway));
    }
}

/// Alone in its scope nobody else could be on the inter scope for it.
#[test]
fn a_flow_without_a_group_stays_on_the_inter_scope() {
    let mut bench =
        Bench::with(|config| ControlConfig { inter_scope: true, replicas: None, ..config });
    bench.core.lost(bench.now);
    assert_eq!(bench.core.stage(), Stage::Gateway);
}

#[test]
fn rules_hold_for_requests_of_other_flows_and_change_while_the_flow_runs() {
    let mut bench = Bench::inside();
    bench.robot_says(1, asks_for(TOPIC));
    bench.send(Scope::Node, &lease("advertise", TOPIC));
    bench.step(300);
    assert_eq!(bench.bridges(TOPIC).len(), 1);
    let refuse_edge = access(&json!([{"match": TOPIC, "request": {"deny": ["edge"]}}]));
    bench.core.set_access(bench.now, 0, refuse_edge);
    bench.step(300);
    assert_eq!(bench.bridges(TOPIC), [""; 0]);
    let told = ("plan".to_owned(), "access_denied".to_owned());
    assert_eq!(bench.routes(TOPIC), [told], "the robot's flow hears why");
    assert_eq!(bench.core.registry().lease_count(), 1, "the publisher is none of theirs");
    bench.core.set_access(bench.now, 0, AccessRules::default());
    bench.step(300);
    assert_eq!(bench.bridges(TOPIC).len(), 1);
}

#[test]
fn what_is_kept_goes_with_the_service_that_wrote_it() {
    let mut bench = Bench::inside();
    bench.send(Scope::Node, &lease("request", TOPIC));
    bench.robot_announces(1, &["mapper", "planner"], false);
    bench.wait(400);
    assert_eq!(bench.forgotten(), []);
    bench.robot_announces(2, &["mapper"], false);
    bench.wait(400);
    let mapper = BTreeSet::from([of(Some("edge"), "mapper")]);
    assert_eq!(bench.forgotten(), [(of(Some("edge"), "planner"), mapper)]);
}

/// Of more services than are named, one may be missing from the list at any time.
#[test]
fn what_is_kept_stays_while_not_all_services_are_named() {
    let mut bench = Bench::inside();
    bench.send(Scope::Node, &lease("request", TOPIC));
    bench.robot_announces(1, &["mapper", "planner"], false);
    bench.wait(400);
    bench.robot_announces(2, &["mapper"], true);
    bench.wait(10_000);
    assert_eq!(bench.forgotten(), []);
    bench.robot_announces(3, &["mapper"], false);
    bench.wait(400);
    assert_eq!(bench.forgotten().len(), 1);
}

/// Whoever leaves the inter scope hears of the robots from the gateways then.
#[test]
fn what_is_kept_stays_when_its_flow_is_heard_another_way() {
    let mut bench = Bench::inside();
    bench.send(Scope::Node, &lease("request", TOPIC));
    bench.robot_announces(1, &["mapper"], false);
    bench.wait(400);
    bench.core.left(bench.now);
    bench.wait(20_000);
    assert_eq!(bench.forgotten(), []);
    // No gateway names it.
    bench.wait(20_000);
    assert_eq!(bench.forgotten(), [(of(Some("edge"), "mapper"), BTreeSet::new())]);
}

/// A service lives on while its flow is started again, and its last message is not published again.
#[test]
fn what_is_kept_stays_while_a_flow_begins_a_new_life() {
    let mut bench = Bench::inside();
    bench.send(Scope::Node, &lease("request", TOPIC));
    bench.robot_announces(1, &["mapper", "planner"], false);
    bench.wait(10_000);
    bench.forget_robot();
    bench.wait(20_000);
    assert_eq!(bench.forgotten(), [], "it said good-bye, and may come back");
    bench.robot_announces_in(2, 1, &["mapper"], false);
    bench.wait(2_000);
    assert_eq!(bench.forgotten(), [], "it has not told of all its services yet");
    bench.wait(10_000);
    let mapper = BTreeSet::from([of(Some("edge"), "mapper")]);
    assert_eq!(bench.forgotten(), [(of(Some("edge"), "planner"), mapper)]);
    // A life that begins without a word before.
    bench.robot_announces_in(3, 1, &[], false);
    bench.wait(2_000);
    assert_eq!(bench.forgotten(), []);
    bench.robot_announces_in(3, 2, &["mapper"], false);
    bench.wait(10_000);
    assert_eq!(bench.forgotten(), []);
}

#[test]
fn what_is_kept_of_a_flow_that_does_not_come_back_is_forgotten() {
    let mut bench = Bench::inside();
    bench.send(Scope::Node, &lease("request", TOPIC));
    bench.robot_announces(1, &["mapper"], false);
    bench.wait(400);
    bench.forget_robot();
    bench.wait(50_000);
    assert_eq!(bench.forgotten(), []);
    bench.wait(20_000);
    assert_eq!(bench.forgotten().len(), 1);
}

/// Another gateway of the group says on the channel of the layer broker whom it reaches.
fn fog_2_reaches(bench: &mut Bench, link_peers: u32) {
    let hello = Hello {
        gateway: Gateway::Auto.into(),
        is_gateway: true,
        link_peers,
        ..said_by(&FOG_2.parse().unwrap(), Kind::Fog)
    };
    bench.fog_2_says(Body::Hello(hello), Some(0));
}

/// Its way to all others is broken, and that of another gateway is not.
#[test]
fn a_gateway_that_alone_reaches_nobody_leaves_the_work_to_others() {
    let mut bench = Bench::inside();
    bench.robot_announces(1, &["mapper"], false);
    let robot: FlowId = "edge/robot-1".parse().unwrap();
    let pass = |bench: &mut Bench, seconds: u64, link_peers: u32| {
        for _ in 0..seconds * 2 {
            fog_2_reaches(bench, link_peers);
            bench.wait(500);
        }
    };
    pass(&mut bench, 10, 1);
    assert_eq!(bench.own().1, Role::Gateway);
    let down = LinkEvent::PeerDown {
        endpoint: Endpoint { flow: robot.clone(), epoch: 1 },
        reason: DownReason::Silent,
    };
    bench.core.link_event(bench.now, down);
    pass(&mut bench, 20, 0);
    assert_eq!(bench.own().1, Role::Gateway, "nobody reaches anybody");
    pass(&mut bench, 4, 1);
    assert_eq!(bench.own().1, Role::Gateway, "a moment says nothing");
    pass(&mut bench, 20, 1);
    assert_eq!(bench.own(), (AutoBool::No, Role::Member));
    assert!(bench.wishes().is_empty(), "it stays on the inter scope, to notice when it works");
    bench.core.link_event(bench.now, LinkEvent::PeerRecovered { flow: robot });
    pass(&mut bench, 10, 1);
    assert_eq!(bench.own(), (AutoBool::Yes, Role::Gateway));
}

/// It comes to the inter scope, where others that were there before it reach flows that it has not
/// heard yet.
#[test]
fn whoever_comes_is_ready_when_it_is_a_gateway_and_not_before() {
    let robot: FlowId = "edge/robot-1".parse().unwrap();
    for heard in [true, false] {
        let mut bench = alone();
        for _ in 0..4 {
            fog_2_reaches(&mut bench, 1);
            bench.wait(500);
        }
        assert_eq!(bench.wishes(), [true]);
        bench.core.joined(bench.now);
        for _ in 0..8 {
            assert_eq!(
                (bench.core.state(), bench.own().1),
                (FlowState::Starting, Role::Member),
                "what it sends would take two ways"
            );
            fog_2_reaches(&mut bench, 1);
            bench.wait(500);
        }
        if heard {
            bench.robot_announces(1, &["mapper"], false);
            bench.core.link_event(bench.now, LinkEvent::PeerRecovered { flow: robot.clone() });
        }
        for _ in 0..6 {
            fog_2_reaches(&mut bench, 1);
            bench.wait(500);
        }
        let expected =
            if heard { (AutoBool::Auto, Role::Gateway) } else { (AutoBool::No, Role::Member) };
        assert_eq!((bench.core.state(), bench.own()), (FlowState::Ready, expected));
    }
}

/// Images come over the link for a service here. That they are large decides of the connection on
/// which they are written, and its own services say nothing of it.
#[test]
fn how_large_a_topic_is_that_only_others_publish_is_known_before_it_comes() {
    let mut bench = alone();
    bench.wait(2_000);
    bench.send(Scope::Layer, &lease("request", TOPIC));
    bench.robot_says(
        1,
        Entry {
            topic: TOPIC.into(),
            node_advertise: Some(Advertise { max_bytes: 921_600, ..Advertise::default() }),
            ..Entry::default()
        },
    );
    bench.wait(2_000);
    let told = bench.outputs.iter().rev().find_map(|output| match output {
        Output::Plan { topic, info, .. } if topic.as_str() == TOPIC => Some(info.max_bytes),
        _ => None,
    });
    assert_eq!(told, Some(Some(921_600)));
}
