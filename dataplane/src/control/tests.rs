//! The control core as a flow with real brokers drives it.

mod balance;
mod calls;
mod gateways;
mod replicas;
mod ros2;

use blaze_domain::LayerKind;
use blaze_domain::node_file::{AccessRules, AutoBool};
use blaze_proto::link::LinkControl;
use blaze_proto::link::link_control::{Body, Channel, Entry, Hello, Kind, LayerScope, Request};
use prost::Message as _;
use serde_json::{Value, json};

use super::routes::route_states;
use super::*;
use crate::plan::Bridge;
use crate::registry::{LapseReason, LayerNames};
use crate::testing::{access, delta, hello_of};
use crate::world::{LayerScopeId, SETTLED_AFTER};

struct Bench {
    core: ControlCore,
    now: Instant,
    outputs: Vec<Output>,
}

impl Bench {
    /// `fog/fog-1` with Redis on its node and Kafka on its layer.
    fn new() -> Self {
        Self::with(|config| config)
    }

    fn with(change: impl FnOnce(ControlConfig) -> ControlConfig) -> Self {
        let now = Instant::now();
        let config = change(ControlConfig {
            me: "fog/fog-1".parse().unwrap(),
            kind: LayerKind::Fog,
            epoch: 1,
            node_scope: true,
            layer_scope: Some(LayerScopeId::kafka("")),
            replicas: Some(LayerScope::Kafka),
            gateway: AutoBool::Auto,
            inter_scope: false,
            layer_answers_need_id: true,
            layer_names: LayerNames::Kafka { prefix: String::new() },
            lease_stores: BTreeSet::from([Scope::Node, Scope::Layer]),
            rules: PlanRules::default(),
            access: AccessRules::default(),
        });
        Self { core: ControlCore::new(config, now), now, outputs: Vec::new() }
    }

    /// Nothing is kept by its brokers.
    fn read_leases(&mut self) {
        for scope in Scope::LOCAL {
            self.core.restore_leases(self.now, scope, &[]);
        }
    }

    fn ready() -> Self {
        let mut bench = Self::new();
        bench.read_leases();
        bench.step(0);
        assert_eq!(bench.core.state(), FlowState::Ready);
        bench
    }

    /// The same, on the inter scope as well.
    fn inside() -> Self {
        let mut bench = Self::with(|config| ControlConfig {
            inter_scope: true,
            gateway: AutoBool::Yes,
            ..config
        });
        bench.read_leases();
        // It listens for others, and nobody is there.
        for _ in 0..50 {
            bench.step(100);
        }
        assert_eq!(bench.core.state(), FlowState::Ready);
        bench
    }

    fn send(&mut self, scope: Scope, json: &Value) {
        self.core.control(self.now, 0, scope, json.to_string().as_bytes());
        self.collect();
    }

    fn step(&mut self, ms: u64) {
        self.now += Duration::from_millis(ms);
        self.core.tick(self.now, 0);
        self.collect();
    }

    fn collect(&mut self) {
        self.outputs.extend(std::iter::from_fn(|| self.core.poll()));
    }

    /// What was wanted of a kind since the last call.
    fn wanted<T>(&mut self, of: impl FnMut(Output) -> Option<T>) -> Vec<T> {
        self.outputs.drain(..).filter_map(of).collect()
    }

    /// What was asked of brokers' channels since the last call.
    fn channels(&mut self) -> Vec<String> {
        self.wanted(|output| match output {
            Output::Prepare { scope, channel, depth } => {
                Some(format!("+{scope} {channel} {depth}"))
            }
            Output::Release { scope, channel } => Some(format!("-{scope} {channel}")),
            _ => None,
        })
    }

    fn wants(&self, wanted: impl Fn(&Output) -> bool) -> bool {
        self.outputs.iter().any(wanted)
    }

    /// A flow elsewhere says Hello over the link, and announces a version of what it has.
    fn link_says(&mut self, hello: Hello, version: u64, entries: Vec<Entry>) {
        let from: FlowId = format!("{}/{}", hello.layer, hello.node).parse().unwrap();
        let body = Body::Delta(delta(version, entries));
        let hello = Box::new(hello);
        let told = from.clone();
        self.core.link_event(self.now, LinkEvent::Hello { from, hello });
        self.core.link_event(self.now, LinkEvent::Control { from: told, body });
    }

    /// `fog/fog-2` says something on the channel of the layer broker. Whether that is a reason to
    /// work.
    fn fog_2_says(&mut self, body: Body, appended_ms: Option<i64>) -> bool {
        let channel = Channel { from: FOG_2.to_owned(), epoch: 1, began: 1, to: String::new() };
        let message = LinkControl { body: Some(body), channel: Some(channel) };
        let read = read_replica_message(&message.encode_to_vec());
        self.core.replica_message(self.now, read, appended_ms)
    }

    fn bridges(&self, topic: &str) -> Vec<String> {
        let plan = self.core.plans().get(&topic.parse::<TopicName>().unwrap());
        let text = |bridge: &Bridge| format!("{}>{}", bridge.from, bridge.to.scope());
        plan.iter().flat_map(|plan| &plan.bridges).map(text).collect()
    }

    fn routes(&self, topic: &str) -> Vec<(String, String)> {
        let plan = &self.core.plans()[&topic.parse::<TopicName>().unwrap()];
        let states =
            route_states(&self.core.config.me, plan, |scope| self.core.scopes.health(scope));
        states.into_iter().map(|state| (state.step, state.code)).collect()
    }
}

/// The other flow of the layer.
const FOG_2: &str = "fog/fog-2";

/// An announcement that services of a node ask for a topic.
fn asks_for(topic: &str) -> Entry {
    Entry { topic: topic.to_owned(), node_request: Some(Request::default()), ..Entry::default() }
}

fn lease(op: &str, topic: &str) -> Value {
    json!({"op": op, "topic": topic, "service": "a", "ttl_s": 0})
}

#[test]
fn a_flow_is_starting_until_all_kept_leases_are_read() {
    let mut bench = Bench::new();
    bench.step(5000);
    assert_eq!(bench.core.state(), FlowState::Starting);
    let value = Bytes::from(lease("advertise", "imu/data").to_string());
    let kept = [("advertise|imu/data|fog|fog-1|a|0".to_owned(), value)];
    assert_eq!(bench.core.restore_leases(bench.now, Scope::Node, &kept).restored, 1);
    assert!(
        !bench.core.is_reading_leases(Scope::Node) && bench.core.is_reading_leases(Scope::Layer)
    );
    bench.step(20);
    assert_eq!(bench.core.state(), FlowState::Starting);
    let value = Bytes::from(lease("request", "imu/data").to_string());
    let kept = [("request|imu/data|fog||a|0".to_owned(), value)];
    bench.core.restore_leases(bench.now, Scope::Layer, &kept);
    bench.step(20);
    assert_eq!(bench.core.state(), FlowState::Ready);
    bench.step(300);
    assert_eq!(bench.bridges("imu/data"), ["node>layer"]);
    let other = |output: &Output| {
        matches!(output, Output::Publish { .. }) && !format!("{output:?}").contains("route_up")
    };
    assert!(!bench.wants(other), "no refusal, no answer: {:?}", bench.outputs);
    assert_eq!(bench.channels(), ["+node imu/data 0", "+layer imu/data 0"]);
}

#[test]
fn others_are_told_of_a_layer_broker_that_does_not_answer_for_seconds() {
    let mut bench = Bench::new();
    let told = |bench: &mut Bench, health, ms| {
        bench.outputs.clear();
        bench.core.set_scope_health(bench.now, Scope::Layer, health);
        bench.step(ms);
        bench.step(0);
        bench.wanted(|output| match output {
            Output::LayerAway(away) => Some(away),
            _ => None,
        })
    };
    assert!(told(&mut bench, ScopeHealth::Away, 2000).is_empty());
    assert!(told(&mut bench, ScopeHealth::Up, 2000).is_empty());
    assert_eq!(told(&mut bench, ScopeHealth::Away, 2600), [true]);
    assert_eq!(told(&mut bench, ScopeHealth::Up, 0), [false]);
}

#[test]
fn a_scope_that_is_in_use_holds_nothing_up_and_has_no_bridges() {
    let mut bench = Bench::new();
    bench.core.restore_leases(bench.now, Scope::Node, &[]);
    bench.core.set_scope_health(bench.now, Scope::Layer, ScopeHealth::InUse);
    bench.step(0);
    assert_eq!(bench.core.state(), FlowState::Ready);
    assert!(bench.wants(|output| matches!(output, Output::LayerScope { shared: false })));
    bench.send(Scope::Node, &lease("advertise", "t"));
    bench.step(300);
    assert_eq!(bench.bridges("t"), [""; 0]);

    bench.outputs.clear();
    bench.core.set_scope_health(bench.now, Scope::Layer, ScopeHealth::Up);
    bench.step(300);
    assert!(bench.wants(|output| matches!(output, Output::LayerScope { shared: true })));
    assert!(bench.core.is_reading_leases(Scope::Layer), "now it is ours");
    assert_eq!(bench.core.state(), FlowState::Ready, "which holds nothing up any more");
    let value = Bytes::from(lease("request", "t").to_string());
    let kept = [("request|t|fog||a|0".to_owned(), value)];
    bench.core.restore_leases(bench.now, Scope::Layer, &kept);
    bench.step(300);
    assert_eq!(bench.bridges("t"), ["node>layer"]);
    bench.outputs.clear();
    bench.core.set_scope_health(bench.now, Scope::Node, ScopeHealth::InUse);
    bench.step(300);
    assert_eq!(bench.bridges("t"), [""; 0]);
    assert!(
        !bench.wants(|output| matches!(output, Output::SaveLease(_))),
        "what is kept there is the other's"
    );
    assert_eq!(bench.channels(), ["-node t"]);
}

#[test]
fn changes_without_end_hold_up_no_plan_for_longer_than_the_latest_time() {
    let mut bench = Bench::ready();
    bench.send(Scope::Node, &lease("advertise", "t"));
    let pause = QUIET / 2;
    for number in 0..=LATEST.as_millis() / pause.as_millis() {
        let mut request = lease("request", "t");
        request["max_rate_hz"] = json!(number + 1);
        bench.send(Scope::Layer, &request);
        bench.step(pause.as_millis() as u64);
    }
    assert_eq!(bench.bridges("t"), ["node>layer"]);
}

#[test]
fn a_channel_is_made_before_the_answer_and_kept_while_it_is_used() {
    let mut bench = Bench::ready();
    bench.outputs.clear();
    let mut advertise = lease("advertise", "map");
    advertise["durability"] = json!("transient_local");
    advertise["depth"] = json!(3);
    advertise["id"] = json!("7");
    advertise["reply_to"] = json!("blaze/reply/mapper-0");
    bench.send(Scope::Layer, &advertise);
    let order: Vec<&str> = bench
        .outputs
        .iter()
        .filter_map(|output| match output {
            Output::Prepare { depth: 3, .. } => Some("prepare"),
            Output::SaveLease(lease) if lease.scope == Scope::Layer => Some("save"),
            Output::Publish { scope: Scope::Layer, channel, .. }
                if *channel == ChannelName::shared_reply() =>
            {
                Some("answer")
            }
            _ => None,
        })
        .collect();
    assert_eq!(order, ["prepare", "save", "answer"], "{:?}", bench.outputs);
    bench.outputs.clear();

    bench.send(Scope::Node, &lease("request", "map"));
    bench.step(300);
    assert_eq!(bench.channels(), ["+node map 0"]);
    bench.send(Scope::Layer, &lease("withdraw", "map"));
    assert_eq!(bench.channels(), ["-layer map"]);
    // Written by a bridge alone it is in use, too.
    bench.send(Scope::Node, &lease("advertise", "odom"));
    bench.send(Scope::Layer, &lease("request", "odom"));
    bench.step(300);
    assert_eq!(bench.channels(), ["+node odom 0", "+layer odom 0"]);
    bench.send(Scope::Layer, &lease("withdraw", "odom"));
    assert_eq!(bench.channels(), [""; 0], "the bridge still writes it");
    bench.step(300);
    assert_eq!(bench.channels(), ["-layer odom"]);
}

#[test]
fn the_channel_of_json_copies_is_made_for_those_who_ask_for_them() {
    let mut bench = Bench::ready();
    let mut ask = lease("request", "odom");
    ask["json"] = true.into();
    bench.channels();
    bench.send(Scope::Layer, &ask);
    assert_eq!(bench.channels(), ["+layer odom 0", "+layer blaze/json/odom 0"]);
    bench.send(Scope::Layer, &lease("withdraw", "odom"));
    assert_eq!(bench.channels(), ["-layer odom", "-layer blaze/json/odom"]);
}

#[test]
fn a_topic_that_is_only_delivered_and_collides_is_blocked() {
    let mut bench = Bench::ready();
    // Another node of the layer asks for `imu_data` of this node: only the way over Kafka is
    // between them.
    let hello = Hello {
        layer_scope_id: LayerScopeId::kafka("").0,
        registry_version: 1,
        ..hello_of(&FOG_2.parse().unwrap(), Kind::Fog)
    };
    bench.link_says(hello, 1, vec![asks_for("imu_data")]);
    bench.send(Scope::Node, &lease("advertise", "imu_data"));
    bench.step(300);
    assert_eq!(bench.bridges("imu_data"), ["node>layer"]);
    bench.send(Scope::Node, &lease("withdraw", "imu_data"));
    bench.step(300);
    bench.send(Scope::Layer, &lease("advertise", "imu/data"));
    bench.send(Scope::Node, &lease("advertise", "imu_data"));
    bench.step(300);
    assert_eq!(bench.bridges("imu_data"), [""; 0]);
    assert_eq!(bench.routes("imu_data"), [("plan".to_owned(), "name_collision".to_owned())]);
    let blocked = &bench.core.plans()[&"imu_data".parse::<TopicName>().unwrap()].blocked;
    assert!(blocked[0].detail.contains("imu/data"), "{blocked:?}");
    bench.send(Scope::Layer, &lease("withdraw", "imu/data"));
    bench.step(6000);
    bench.step(300);
    assert_eq!(bench.bridges("imu_data"), ["node>layer"], "the name is free");
}

#[test]
fn other_flows_are_told_of_brokers_that_are_away() {
    let mut bench = Bench::ready();
    bench.send(Scope::Node, &lease("advertise", "t"));
    bench.send(Scope::Layer, &lease("request", "t"));
    bench.step(300);
    let state = |step: &str, code: &str| vec![(step.to_owned(), code.to_owned())];
    assert_eq!(bench.routes("t"), state("deliver", "ok"));
    bench.core.set_scope_health(bench.now, Scope::Layer, ScopeHealth::Away);
    assert_eq!(bench.routes("t"), state("deliver", "broker_down"));
    bench.core.set_scope_health(bench.now, Scope::Node, ScopeHealth::Away);
    assert_eq!(bench.routes("t"), state("bridge", "broker_down"));
}

#[test]
fn who_may_not_advertise_is_told_and_leaves_no_lease() {
    let mut bench = Bench::ready();
    let rules = access(&json!([{"match": "cmd/**", "advertise": {"allow": ["*/*/joystick"]}}]));
    bench.core.set_access(bench.now, 0, rules);
    let mut denied = lease("advertise", "cmd/vel");
    denied["service"] = "planner".into();
    denied["reply_to"] = "blaze/reply/planner".into();
    bench.send(Scope::Node, &denied);
    let answers: Vec<Value> = bench.wanted(|output| match output {
        Output::Publish { channel, body, .. } if channel.as_str().starts_with("blaze/reply") => {
            Some(serde_json::from_slice(&body).unwrap())
        }
        _ => None,
    });
    let [answer] = answers.as_slice() else { panic!("{answers:?}") };
    assert_eq!(answer["error"]["code"], "access_denied", "{answer}");
    assert_eq!(answer["error"]["pointer"], "/service");
    assert_eq!(bench.core.registry().lease_count(), 0);
    assert_eq!(bench.core.refused, 1);
    let topic = "cmd/vel".parse().unwrap();
    let reasons: Vec<LapseReason> =
        bench.core.registry().lapsed(&topic).map(|lease| lease.reason).collect();
    assert_eq!(reasons, [LapseReason::Denied]);
    let mut allowed = lease("advertise", "cmd/vel");
    allowed["service"] = "joystick".into();
    bench.send(Scope::Node, &allowed);
    bench.send(Scope::Node, &lease("request", "cmd/vel"));
    assert_eq!(bench.core.registry().lease_count(), 2, "requests have no rule");
}

#[test]
fn leases_that_new_rules_do_not_allow_end() {
    let mut bench = Bench::ready();
    bench.send(Scope::Node, &lease("advertise", "cmd/vel"));
    bench.send(Scope::Layer, &lease("request", "cmd/vel"));
    bench.step(300);
    assert_eq!(bench.bridges("cmd/vel"), ["node>layer"]);
    let nobody = access(&json!([{"match": "cmd/*", "request": {"allow": []}}]));
    bench.core.set_access(bench.now, 0, nobody);
    bench.step(300);
    assert_eq!(bench.bridges("cmd/vel"), [""; 0]);
    assert_eq!(bench.core.registry().lease_count(), 1);
    let refused = |bench: &Bench| bench.core.registry().lapsed(&"cmd/vel".parse().unwrap()).count();
    assert_eq!(refused(&bench), 1);
    bench.core.set_access(bench.now, 0, AccessRules::default());
    assert_eq!(refused(&bench), 0, "it is allowed now and only has to ask");
    bench.send(Scope::Layer, &lease("request", "cmd/vel"));
    bench.step(300);
    assert_eq!(bench.bridges("cmd/vel"), ["node>layer"]);
}
