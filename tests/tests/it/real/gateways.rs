//! Flows that are not on the inter scope and a robot outside: services on their nodes reach each
//! other over a gateway, on Kafka and on DDS as the broker of the layer.

use std::collections::BTreeSet;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use blaze_proto::Frame;
use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::plain;
use blaze_tests::servers::{shared_kafka, shared_redis, unique_name};
use blaze_tests::wait;
use bytes::Bytes;
use serde_json::{Value, json};

use crate::real::support::{RedisReader, SOON, connect};

/// From the robot to the member's node, and back.
const TO_MEMBER: &str = "imu/data";
const TO_ROBOT: &str = "cmd/vel";
const PERIOD: Duration = Duration::from_millis(20);
/// Messages that must all arrive.
const MESSAGES: u64 = 100;

/// A service on one Redis publishes and one on another listens.
struct Way {
    redis: String,
    from: String,
    to: String,
    next: u64,
}

impl Way {
    /// Leases on both sides.
    fn new(redis: &str, topic: &str, from: &str, to: &str) -> anyhow::Result<Self> {
        for (prefix, op) in [(from, "advertise"), (to, "request")] {
            let lease =
                json!({"op":op,"topic":topic,"service":"test","reliability":"reliable","ttl_s":0});
            plain::tell_redis(redis, prefix, &lease)?;
        }
        Ok(Self {
            redis: redis.to_owned(),
            from: format!("{from}{topic}"),
            to: format!("{to}{topic}"),
            next: 1,
        })
    }

    /// Publishes until a message comes through, then so many of which each must come once and in
    /// order.
    fn run(&mut self) -> anyhow::Result<()> {
        let mut reader = RedisReader::new(&self.redis, &self.to)?;
        let mut connection = connect(&self.redis)?;
        let until = Instant::now() + SOON;
        while reader.poll()?.is_none() {
            anyhow::ensure!(
                Instant::now() < until,
                "nothing comes from {} to {}",
                self.from,
                self.to
            );
            redis::cmd("PUBLISH").arg(&self.from).arg("0").exec(&mut connection)?;
        }
        let (first, channel) = (self.next, self.from.clone());
        self.next += MESSAGES;
        let publisher: JoinHandle<anyhow::Result<()>> = std::thread::spawn(move || {
            let begin = Instant::now();
            for count in 0..MESSAGES {
                let due = begin + PERIOD * u32::try_from(count)?;
                std::thread::sleep(due.saturating_duration_since(Instant::now()));
                redis::cmd("PUBLISH").arg(&channel).arg(first + count).exec(&mut connection)?;
            }
            Ok(())
        });
        let mut came = Vec::new();
        let until = Instant::now() + SOON;
        while came.len() < usize::try_from(MESSAGES)? && Instant::now() < until {
            if let Some(payload) = reader.poll()? {
                let frame = Frame::parse(Bytes::from(payload))?;
                let number: u64 = String::from_utf8_lossy(frame.payload()).parse()?;
                came.extend((number > 0).then_some(number));
            }
        }
        publisher.join().expect("it does not panic")?;
        let expected: Vec<u64> = (first..first + MESSAGES).collect();
        let lost: BTreeSet<&u64> =
            expected.iter().filter(|number| !came.contains(number)).collect();
        anyhow::ensure!(came == expected, "{}: lost {lost:?}, came {came:?}", self.from);
        Ok(())
    }
}

fn peers(flow: &FlowProcess) -> Value {
    flow.admin().json("/v1/peers").unwrap_or_default()
}

/// Flows that another one hears on the inter scope.
fn heard_by(flow: &FlowProcess) -> BTreeSet<String> {
    let rows = peers(flow)["peers"].as_array().cloned().unwrap_or_default();
    let up = rows.iter().filter(|row| row["state"] == "up");
    up.filter_map(|row| row["flow"].as_str().map(str::to_owned)).collect()
}

fn names(flows: &[&str]) -> BTreeSet<String> {
    flows.iter().map(|flow| (*flow).to_owned()).collect()
}

/// A gateway, a member and a robot outside; `layer` gives each flow of the layer its broker.
fn over_a_gateway(layer: impl Fn(FlowSpec) -> FlowSpec) -> anyhow::Result<()> {
    let redis = shared_redis()?;
    let run = unique_name("gateways");
    let prefix = |node: &str| format!("{run}:{node}:");
    let domain = free_domain()?;
    let spec = |layer: &str, node: &str| {
        FlowSpec::new(layer, node).on_redis(&redis, &prefix(node)).joined(domain)
    };
    let setting = |spec: FlowSpec, gateway: bool| FlowSpec {
        kind: "edge".to_owned(),
        flow: format!("gateway: {gateway}"),
        ..spec
    };
    let mut member = FlowProcess::launch(setting(layer(spec("site", "member")), false))?;
    member.listening()?;
    let no_gateway = || {
        let (_, answer) = member.admin().get("/readyz").unwrap_or_default();
        answer.contains("no gateway of this group lives")
    };
    wait::until("without a gateway it is not ready", SOON, no_gateway, || member.tail())?;
    let mut gateway = FlowProcess::launch(setting(layer(spec("site", "gateway")), true))?;
    let mut robot = FlowProcess::launch(spec("edge", "robot"))?;
    for flow in [&mut member, &mut gateway, &mut robot] {
        flow.wait_ready()?;
    }
    let mut ways = [
        Way::new(&redis, TO_MEMBER, &prefix("robot"), &prefix("member"))?,
        Way::new(&redis, TO_ROBOT, &prefix("member"), &prefix("robot"))?,
    ];
    for way in &mut ways {
        way.run()?;
    }
    assert_eq!((heard_by(&robot), heard_by(&member)), (names(&["site/gateway"]), names(&[])));
    assert_eq!(peers(&member)["gateway"]["stage"], "member");
    assert_eq!(peers(&gateway)["gateway"]["gateways"], json!(["site/gateway"]));
    for (flow, topic, to) in
        [(&member, TO_ROBOT, "edge"), (&member, TO_MEMBER, "site"), (&robot, TO_MEMBER, "site")]
    {
        let why = flow.why(topic, Some(to))?;
        let steps = why["steps"].as_array().cloned().unwrap_or_default();
        assert_eq!(why["verdict"], "flowing", "{topic} to {to}: {why}");
        assert!(steps.iter().any(|step| step["flow"] == "site/gateway"), "{topic} to {to}: {why}");
    }
    Ok(())
}

#[test]
fn a_member_on_kafka_reaches_a_robot_over_a_gateway_and_is_reached() -> anyhow::Result<()> {
    let (kafka, prefix) = (shared_kafka()?, format!("{}.", unique_name("gateways")));
    over_a_gateway(|spec| spec.on_kafka(&kafka, &prefix))
}

#[test]
fn a_member_on_dds_reaches_a_robot_over_a_gateway_and_is_reached() -> anyhow::Result<()> {
    let domain = free_domain()?;
    over_a_gateway(|spec| spec.on_dds(domain))
}

mod long {
    use super::*;

    #[test]
    fn of_seventeen_flows_four_are_gateways_and_one_that_is_killed_is_replaced()
    -> anyhow::Result<()> {
        let (redis, kafka) = (shared_redis()?, shared_kafka()?);
        let run = unique_name("gateways");
        let domain = free_domain()?;
        let prefix = |node: &str| format!("{run}:{node}:");
        let cloud = |number: usize| {
            let node = format!("cloud-{number}");
            let spec = FlowSpec::new("cloud", &node).on_kafka(&kafka, &format!("{run}."));
            spec.on_redis(&redis, &prefix(&node)).joined(domain)
        };
        let robot =
            FlowSpec::new("edge", "robot").on_redis(&redis, &prefix("robot")).joined(domain);
        let mut robot = FlowProcess::launch(robot)?;
        let mut clouds: Vec<FlowProcess> =
            (1..=17).map(|number| FlowProcess::launch(cloud(number))).collect::<Result<_, _>>()?;
        robot.wait_ready()?;
        for flow in &mut clouds {
            flow.wait_ready()?;
        }
        let four = |without: &BTreeSet<String>| {
            let now = heard_by(&robot);
            now.len() == 4 && now.is_disjoint(without)
        };
        // Those that began while others had not been heard yet may have joined, and leave.
        wait::until(
            "four gateways",
            SOON,
            || four(&names(&[])),
            || format!("{:?}", heard_by(&robot)),
        )?;
        let gateways = heard_by(&robot);
        let is_member =
            |flow: &&FlowProcess| !gateways.contains(&format!("cloud/{}", flow.spec.node));
        let member = clouds.iter().find(is_member).expect("13 of 17").spec.node.clone();
        let mut ways = [
            Way::new(&redis, TO_MEMBER, &prefix("robot"), &prefix(&member))?,
            Way::new(&redis, TO_ROBOT, &prefix(&member), &prefix("robot"))?,
        ];
        for way in &mut ways {
            way.run()?;
        }
        let killed: BTreeSet<String> = gateways.iter().take(1).cloned().collect();
        let victim =
            clouds.iter_mut().find(|flow| killed.contains(&format!("cloud/{}", flow.spec.node)));
        victim.expect("it is one of them").kill()?;
        let since = Instant::now();
        wait::until(
            "another takes its place",
            SOON,
            || four(&killed),
            || format!("{:?}", heard_by(&robot)),
        )?;
        println!("replaced after {:?}: {gateways:?}, then {:?}", since.elapsed(), heard_by(&robot));
        for way in &mut ways {
            way.run()?;
        }
        Ok(())
    }
}
