use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::config::ServiceState;
use blaze_domain::node_file::MonitorSection;
use blaze_domain::{Priority, WhyCode};
use proptest::prelude::*;
use serde_json::json;

use super::*;

const THRESHOLDS: Thresholds = Thresholds {
    disk_free_ratio: 0.05,
    memory_free_ratio: 0.05,
    celsius: 90.0,
    clock_error_ms: 50.0,
};

/// Health under a clock that the test moves.
struct Bench {
    start: Instant,
    ms: u64,
    health: Health,
}

impl Bench {
    fn new() -> Self {
        let start = Instant::now();
        let now = Moment { at: start, unix_ms: 0 };
        let health = Health::new("edge/robot-1".parse().unwrap(), THRESHOLDS, now);
        Self { start, ms: 0, health }
    }

    /// Evaluates once a second for so long; all changes with their time in s.
    fn run(&mut self, seconds: u64, inputs: &Inputs) -> Vec<(u64, Change)> {
        self.run_with(seconds, |_| inputs.clone())
    }

    fn run_with(&mut self, seconds: u64, inputs: impl Fn(u64) -> Inputs) -> Vec<(u64, Change)> {
        let mut changes = Vec::new();
        for _ in 0..seconds {
            let s = self.ms / 1_000;
            changes.extend(self.step(1_000, &inputs(s)).into_iter().map(|change| (s, change)));
        }
        changes
    }

    /// Evaluates now and moves the clock on.
    fn step(&mut self, ms: u64, inputs: &Inputs) -> Vec<Change> {
        let at = self.start + Duration::from_millis(self.ms);
        let changes = self.health.update(Moment { at, unix_ms: self.ms }, inputs);
        self.ms += ms;
        changes
    }

    fn codes(&self) -> Vec<&'static str> {
        self.health.problems().iter().map(|problem| problem.code).collect()
    }
}

fn flow() -> FlowInput {
    FlowInput {
        program: ProgramInput {
            name: "edge/robot-1".into(),
            is_reachable: true,
            is_ready: true,
            ..ProgramInput::default()
        },
        summary: Some(Summary::default()),
        topics: Vec::new(),
    }
}

fn topic(name: &str, code: WhyCode) -> TopicInput {
    TopicInput {
        topic: name.into(),
        is_advertised: true,
        is_requested: true,
        code,
        detail: String::new(),
        advertised_hz: None,
        rate_hz: None,
        priority: Priority::State,
        dropped: BTreeMap::new(),
    }
}

fn service(name: &str, state: ServiceState) -> ServiceInput {
    ServiceInput {
        service: name.into(),
        instance: "0".into(),
        state,
        expires_in: Duration::from_secs(12),
        config: ConfigState::Current,
    }
}

fn hot() -> Inputs {
    let hottest = Some(("tj-thermal".to_owned(), 95.5));
    Inputs { vitals: Vitals { hottest, ..Vitals::default() }, ..Inputs::default() }
}

fn link(flow: &str, state: &str) -> Link {
    serde_json::from_value(json!({ "flow": flow, "state": state })).unwrap()
}

fn of_flow(flow: FlowInput) -> Inputs {
    Inputs { flows: vec![flow], ..Inputs::default() }
}

#[test]
fn worse_after_5_s_and_better_after_15_s() {
    let mut bench = Bench::new();
    let first = bench.run(5, &hot());
    assert_eq!(first.len(), 1, "from unknown to ok: {first:?}");
    let raised = bench.run(3, &hot());
    let [(5, Change::Raised(problem)), (5, Change::State { from, to, .. })] = &raised[..] else {
        panic!("{raised:?}");
    };
    assert_eq!((*from, *to), (State::Ok, State::Degraded));
    assert_eq!((problem.code, &*problem.name), ("hot", "tj-thermal"));
    assert_eq!(problem.since, "1970-01-01T00:00:00.000Z", "since the condition is there");
    assert_eq!(problem.detail, "tj-thermal has 95.5 °C, above 90.0 °C");
    let mut warmer = hot();
    warmer.vitals.hottest = Some(("tj-thermal".to_owned(), 99.0));
    assert_eq!(bench.run(2, &warmer), [], "another detail is no change");
    assert!(bench.health.problems()[0].detail.contains("99.0"));
    assert_eq!(bench.run(15, &Inputs::default()), [], "absent since second 10");
    let over = bench.run(1, &Inputs::default());
    let [(25, Change::Cleared(_)), (25, Change::State { to: State::Ok, .. })] = &over[..] else {
        panic!("{over:?}");
    };
    assert_eq!(bench.health.state(), State::Ok);
}

#[test]
fn a_condition_that_comes_and_goes_is_no_problem_and_one_that_returns_is_not_over() {
    let mut bench = Bench::new();
    let blinks = |s: u64| if s % 5 == 4 { Inputs::default() } else { hot() };
    bench.run_with(100, blinks);
    assert_eq!(bench.codes(), [""; 0]);
    bench.run(6, &hot());
    let changes = bench.run_with(200, |s| if s % 15 == 0 { hot() } else { Inputs::default() });
    assert_eq!(changes, []);
    assert_eq!(bench.codes(), ["hot"]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    /// Whatever is there and however seldom it is looked at, nothing changes twice in a window.
    #[test]
    fn nothing_flaps(
        steps in prop::collection::vec((100u64..4_000, any::<[bool; 4]>()), 1..120),
    ) {
        let mut bench = Bench::new();
        let mut last: BTreeMap<String, (u64, bool)> = BTreeMap::new();
        let mut last_state: BTreeMap<String, u64> = BTreeMap::new();
        for (ms, [is_hot, is_down, is_linked, is_unhealthy]) in steps {
            let mut inputs = if is_hot { hot() } else { Inputs::default() };
            let mut flow = flow();
            flow.program.is_ready = !is_down;
            let state = if is_linked { "up" } else { "suspect" };
            flow.summary = Some(Summary { links: vec![link("a/b", state)], feasible: true });
            inputs.flows.push(flow);
            let state =
                if is_unhealthy { ServiceState::Unhealthy } else { ServiceState::Ready };
            inputs.services = Some(vec![service("slam", state)]);
            let now = bench.ms;
            for change in bench.step(ms, &inputs) {
                match change {
                    Change::Raised(problem) => {
                        let before = last.insert(problem.code.to_owned(), (now, true));
                        prop_assert!(before.is_none_or(|(at, on)| !on && now - at >= 5_000));
                    }
                    Change::Cleared(problem) => {
                        let before = last.insert(problem.code.to_owned(), (now, false));
                        prop_assert!(before.is_some_and(|(at, on)| on && now - at >= 15_000));
                    }
                    Change::State { name, from, to, .. } => {
                        prop_assert_ne!(from, to);
                        let before = last_state.insert(name, now);
                        prop_assert!(before.is_none_or(|at| now - at >= 5_000));
                    }
                }
            }
            let shown = bench.health.problems().len();
            prop_assert_eq!(shown, last.values().filter(|(_, on)| *on).count());
        }
        // Nothing stays behind.
        bench.run(30, &Inputs { services: Some(Vec::new()), ..Inputs::default() });
        prop_assert_eq!(bench.health.state(), State::Ok);
        prop_assert_eq!(bench.codes(), [""; 0]);
    }
}

#[test]
fn a_healthy_system_and_a_node_without_programs_have_no_problem() {
    let mut healthy = of_flow(flow());
    // The example of docs/admin-api.md.
    healthy.flows[0].summary = serde_json::from_value(json!({
        "flow": "edge/robot-1", "epoch": 1, "time": "", "state": "ready",
        "topics": {"flowing": 12}, "bridges": {"up": 14}, "dropped": {"max_rate": 20},
        "feasible": true, "registry_version": 31,
        "links": [{"flow": "cloud/cloud-1", "state": "up", "rtt_ms": 50.2, "loss": 0,
            "wire_bytes_per_s": 52100, "limit_bytes_per_s": 20_971_520, "queued_bytes": 0,
            "dropped": 0}],
    }))
    .ok();
    assert_eq!(healthy.flows[0].summary.as_ref().unwrap().links.len(), 1);
    let no_requester = TopicInput { is_requested: false, ..topic("alone", WhyCode::NoRequest) };
    let thinned = TopicInput { priority: Priority::Bulk, ..topic("camera", WhyCode::RateLimited) };
    let busy = TopicInput {
        advertised_hz: Some(50.0),
        rate_hz: Some(49.0),
        ..topic("imu/data", WhyCode::Ok)
    };
    healthy.flows[0].topics = vec![no_requester, thinned, busy];
    healthy.services = Some(vec![service("slam", ServiceState::Ready)]);
    healthy.worker = Some(flow().program);
    healthy.vitals = Vitals {
        disks: vec![("/".into(), 0.5)],
        memory_available: Some(0.4),
        hottest: Some(("cpu".into(), 60.0)),
        clock_error_s: Some(0.001),
        udp_buffer_errors: Some(1_000_000),
        throttled_s: Some(5_000.0),
        ..Vitals::default()
    };
    for inputs in [healthy, Inputs::default()] {
        let mut bench = Bench::new();
        bench.run(60, &inputs);
        assert_eq!((bench.codes(), bench.health.state()), (vec![], State::Ok));
    }
}

/// Inputs that raise every code of the table that is not of `why`, some in conflict.
fn all_wrong(s: u64) -> Vec<Inputs> {
    let counters = Inputs {
        vitals: Vitals {
            disks: vec![("/data".into(), 0.01)],
            memory_available: Some(0.02),
            hottest: Some(("cpu".into(), 100.0)),
            clock_error_s: Some(16.0),
            udp_buffer_errors: Some(s * 5),
            throttled_s: Some(s as f64 / 2.0),
            ..Vitals::default()
        },
        worker: Some(ProgramInput { name: "edge/robot-1".into(), ..ProgramInput::default() }),
        services: Some(vec![
            service("a", ServiceState::Unhealthy),
            service("b", ServiceState::Starting),
            ServiceInput {
                config: ConfigState::Rejected("/rate: is no number".into()),
                ..service("c", ServiceState::Ready)
            },
            ServiceInput {
                config: ConfigState::Stale { has: 4, delivered: 5 },
                ..service("d", ServiceState::Ready)
            },
        ]),
        ..of_flow(FlowInput { program: ProgramInput::default(), ..flow() })
    };
    let mut links = flow();
    let lossy = Link { loss: 0.1, rtt_ms: Some(20.0), ..link("c/lossy", "up") };
    let full = Link { wire_bytes_per_s: 96.0, limit_bytes_per_s: 100.0, ..link("c/full", "up") };
    let links_of = vec![link("c/down", "down"), link("c/suspect", "suspect"), lossy, full];
    links.summary = Some(Summary { links: links_of, feasible: false });
    let silent =
        TopicInput { advertised_hz: Some(1.0), rate_hz: Some(0.0), ..topic("silent", WhyCode::Ok) };
    let dropping = TopicInput {
        dropped: [("queue_full".to_owned(), s), ("max_rate".to_owned(), 7 * s)].into(),
        ..topic("dropping", WhyCode::Ok)
    };
    links.topics = vec![silent, dropping];
    let mut topics = flow();
    topics.topics = WhyCode::ALL.iter().map(|code| topic(&format!("why/{code}"), *code)).collect();
    vec![counters, of_flow(links), of_flow(topics)]
}

#[test]
fn every_code_of_the_table_is_raised_in_time_and_no_other_one() {
    let mut raised: BTreeMap<(Scope, &str), u64> = BTreeMap::new();
    for set in 0..all_wrong(0).len() {
        let changes = Bench::new().run_with(70, |s| all_wrong(s)[set].clone());
        for (s, change) in changes {
            if let Change::Raised(problem) = change {
                assert!(!problem.detail.is_empty() && !problem.remedy.contains("{name}"));
                raised.insert((problem.scope, problem.code), s);
            }
        }
    }
    let elsewhere = [(Scope::Node, "more_problems"), (Scope::Service, "service_gone")];
    for code in CODES {
        let key = (code.scope, code.code);
        let Some(s) = raised.remove(&key) else {
            assert!(elsewhere.contains(&key), "{key:?} was never raised");
            continue;
        };
        // Drops are seen with the second reading.
        assert!(s <= code.after.as_secs() + 2, "{key:?} after {s} s");
    }
    assert_eq!(raised, BTreeMap::new());
}

#[test]
fn the_table_is_fit_for_pages_and_alerts() {
    for (index, code) in CODES.iter().enumerate() {
        let same = |other: &&Code| (other.scope, other.code) == (code.scope, code.code);
        assert_eq!(CODES.iter().filter(same).count(), 1, "{}", code.code);
        assert!(code.after >= limits::WORSE_AFTER && code.state > State::Unknown);
        for text in [code.meaning, code.remedy] {
            assert!(text.ends_with('.') && !text.contains("  "), "{index}: {text}");
        }
    }
    assert_eq!(MonitorSection::default().thresholds, THRESHOLDS);
}

#[test]
fn a_service_that_is_lost_is_gone_and_one_that_ends_is_not() {
    let with =
        |services: Vec<ServiceInput>| Inputs { services: Some(services), ..Inputs::default() };
    let both = with(vec![
        service("lost", ServiceState::Ready),
        service("stopped", ServiceState::Stopping),
    ]);
    let mut bench = Bench::new();
    bench.run(20, &both);
    // `deleted` ends cleanly: its record vanishes at once, the others' when they expire.
    let mut three = both.clone();
    three.services.iter_mut().flatten().for_each(|sign| sign.expires_in = Duration::ZERO);
    three.services.as_mut().unwrap().push(service("deleted", ServiceState::Ready));
    bench.run(1, &three);
    bench.run(10, &with(Vec::new()));
    assert_eq!(bench.codes(), ["service_gone"]);
    let body = bench.health.body();
    assert_eq!(body.state, State::Degraded, "the node works without it");
    let [lost] = &body.services[..] else { panic!("{body:?}") };
    assert_eq!((&*lost.service, lost.state, lost.problems.len()), ("lost", State::Down, 1));
    bench.run(16, &with(vec![service("lost", ServiceState::Ready)]));
    assert_eq!(bench.codes(), [""; 0], "it is back");
    assert_eq!(bench.health.body().services[0].state, State::Ok);
}

#[test]
fn an_outage_of_the_signs_of_life_is_no_fault_of_services() {
    let readable =
        Inputs { services: Some(vec![service("slam", ServiceState::Ready)]), ..Inputs::default() };
    let mut bench = Bench::new();
    bench.run(10, &readable);
    bench.run(60, &Inputs::default());
    assert_eq!(bench.codes(), [""; 0]);
    assert_eq!(bench.health.body().services[0].state, State::Unknown);
    let empty = Inputs { services: Some(Vec::new()), ..Inputs::default() };
    bench.run(9, &empty);
    assert_eq!(bench.codes(), [""; 0], "it has some time to renew its record");
    bench.run(10, &readable);
    assert_eq!(bench.codes(), [""; 0]);
    assert_eq!(bench.health.body().services[0].state, State::Ok);
}

#[test]
fn one_cause_is_one_problem() {
    let blocked = |code| (0..50).map(|n| topic(&format!("t/{n}"), code)).collect();
    let mut broker = flow();
    broker.program.is_ready = false;
    broker.program.detail = "layer_broker: connection refused".into();
    broker.topics = blocked(WhyCode::BrokerDown);
    let mut bench = Bench::new();
    bench.run(7, &of_flow(broker));
    assert_eq!(bench.codes(), ["flow_not_ready"]);
    assert_eq!(bench.health.state(), State::Down);
    assert!(bench.health.problems()[0].detail.contains("layer_broker"));

    let mut peer = flow();
    peer.summary = Some(Summary { links: vec![link("c/c", "down")], feasible: true });
    peer.topics = blocked(WhyCode::PeerDown);
    let mut bench = Bench::new();
    bench.run(7, &of_flow(peer));
    assert_eq!(bench.codes(), ["peer_down"]);
    assert_eq!(bench.health.problems()[0].name, "edge/robot-1>c/c");
    assert_eq!(bench.health.state(), State::Degraded);
}

#[test]
fn a_topic_is_silent_after_three_of_its_periods() {
    let silent = |hz: f64| {
        let topic =
            TopicInput { advertised_hz: Some(hz), rate_hz: Some(0.0), ..topic("t", WhyCode::Ok) };
        of_flow(FlowInput { topics: vec![topic], ..flow() })
    };
    for (hz, after) in [(50.0, Some(5)), (0.1, Some(30)), (0.0, None), (1e-9, None)] {
        let changes = Bench::new().run(100, &silent(hz));
        let raised = changes.iter().find(|(_, change)| matches!(change, Change::Raised(_)));
        assert_eq!(raised.map(|(s, _)| *s), after, "{hz} Hz");
    }
}

#[test]
fn a_clock_is_skewed_if_it_differs_from_most_others() {
    let offsets = |far: usize, near: usize| {
        let offset = |n, offset_s| OffsetInput {
            node: format!("fog/n{n}").parse().unwrap(),
            offset_s,
            error_s: 0.0005,
        };
        let far = (0..far).map(|n| offset(n, -3.0));
        let offsets = far.chain((0..near).map(|n| offset(100 + n, 0.01))).collect();
        Inputs { vitals: Vitals { offsets, ..Vitals::default() }, ..Inputs::default() }
    };
    for (far, near, want) in [(3, 1, true), (1, 0, true), (1, 3, false), (1, 1, false)] {
        let mut bench = Bench::new();
        bench.run(7, &offsets(far, near));
        assert_eq!(!bench.codes().is_empty(), want, "{far} far, {near} near");
    }
    let mut bench = Bench::new();
    bench.run(7, &offsets(2, 0));
    let detail = &bench.health.problems()[0].detail;
    assert!(detail.contains("by -3000.0 ms ± 0.5 ms"), "{detail}");
}

#[test]
fn problems_are_bounded_and_the_rest_is_counted_in_one() {
    let topics = (0..3_000).map(|n| topic(&format!("t/{n}"), WhyCode::TypeMismatch)).collect();
    let mut inputs = of_flow(FlowInput { topics, ..flow() });
    inputs.vitals = hot().vitals;
    let mut bench = Bench::new();
    bench.run(7, &inputs);
    let problems = bench.health.problems();
    assert_eq!(problems.len(), limits::MAX_PROBLEMS + 1);
    let of = |code: &str| problems.iter().find(|problem| problem.code == code).unwrap();
    assert_eq!(of("hot").scope, Scope::Node, "the node's own are among them");
    assert!(of("more_problems").detail.starts_with("2001 more"));
    let states: Vec<State> = problems.iter().map(|problem| problem.state).collect();
    assert!(states.is_sorted_by(|a, b| a >= b), "the worst come first");
}

#[test]
fn the_body_has_the_members_of_the_contract() {
    let mut inputs = hot();
    inputs.services = Some(vec![service("slam", ServiceState::Unhealthy)]);
    let mut bench = Bench::new();
    bench.run(7, &inputs);
    let problem = |code: &str, scope: &str, name: &str, detail: &str| {
        let remedy = CODES.iter().find(|row| row.code == code).unwrap().remedy;
        json!({ "code": code, "scope": scope, "name": name, "state": "degraded",
            "since": "1970-01-01T00:00:00.000Z", "detail": detail, "remedy": remedy })
    };
    assert_eq!(
        serde_json::to_value(bench.health.body()).unwrap(),
        json!({
            "state": "degraded", "since": "1970-01-01T00:00:05.000Z",
            "problems": [problem(
                "hot", "node", "tj-thermal", "tj-thermal has 95.5 °C, above 90.0 °C")],
            "services": [{ "service": "slam", "instance": "0", "state": "degraded",
                "since": "1970-01-01T00:00:05.000Z", "problems": [problem(
                    "service_unhealthy", "service", "slam/0", "it reports `unhealthy`")] }],
        })
    );
}

#[test]
fn the_metric_is_1_for_one_state_of_each_and_its_names_are_bounded() {
    let mut services: Vec<ServiceInput> =
        (0..400).map(|n| service(&format!("s{n:03}"), ServiceState::Ready)).collect();
    services[399].state = ServiceState::Unhealthy;
    let inputs = Inputs { services: Some(services), ..Inputs::default() };
    let mut bench = Bench::new();
    bench.run(7, &inputs);
    let families = bench.health.metrics();
    let [family, problems] = &families[..] else { panic!("two families") };
    let [problem] = problems.get_metric() else { panic!("one problem") };
    let labels: Vec<&str> =
        problem.get_label().iter().map(prometheus::proto::LabelPair::value).collect();
    assert_eq!(labels, ["service_unhealthy", "s399/0", "service"]);
    let mut sums: BTreeMap<(String, String), f64> = BTreeMap::new();
    let mut present = BTreeMap::new();
    for metric in family.get_metric() {
        let label = |name: &str| {
            let found = metric.get_label().iter().find(|label| label.name() == name);
            found.unwrap().value().to_owned()
        };
        let value = metric.get_gauge().get_value();
        *sums.entry((label("scope"), label("name"))).or_default() += value;
        if value > 0.5 {
            present.insert(label("name"), label("state"));
        }
    }
    assert!(sums.values().all(|sum| (sum - 1.0).abs() < 1e-9));
    assert_eq!(sums.keys().filter(|(scope, _)| scope == "service").count(), MAX_LABELS);
    assert_eq!(present["robot-1"], "degraded");
    assert_eq!((&*present["s000/0"], &*present["_other"]), ("ok", "degraded"));
}
