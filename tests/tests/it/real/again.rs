//! A service, a flow, a whole node and the flow of one of two consumers are killed and come back
//! under their names, again and again: nothing comes twice, the other consumer misses nothing, and
//! nothing of those who live on grows.

use std::collections::BTreeSet;
use std::time::Duration;

use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::long;
use blaze_tests::process::{Process, Usage};
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer, shared_kafka, unique_name};
use blaze_tests::wait;
use serde_json::Value;

use crate::real::support::SOON;

const STREAM: &str = "imu/data,reliable,50,320,10000";
/// After so many rounds everything that is made once has been made.
const WARM: u32 = 2;
/// After RustDDS has lost a participant without a good-bye.
const FORGOTTEN: Duration = Duration::from_secs(80);
/// RustDDS remembers a participant that was killed for 50 s, so that the first minute of restarts
/// adds to what is held.
const MOST: Usage = Usage { resident_kib: 12 * 1024, threads: 2, descriptors: 4 };

/// A robot on a Redis of its own, a fog and a cloud on Kafka, and a service on each.
struct System {
    redis: RedisServer,
    robot: FlowProcess,
    fog: FlowProcess,
    cloud: FlowProcess,
    driver: Process,
    /// Services in fog and cloud.
    ears: [Process; 2],
}

/// A service on a node, on a broker named by its option, URL and prefix.
fn probe(
    role: &str,
    (option, url, prefix): (&str, &str, &str),
    layer: &str,
    node: &str,
) -> anyhow::Result<Process> {
    let mut arguments =
        vec![role, option, url, "--prefix", prefix, "--layer", layer, "--node", node];
    arguments.extend(["--duration", "36000", "--topic", STREAM]);
    Process::tool("probe", &arguments, None)
}

fn driver(redis: &RedisServer) -> anyhow::Result<Process> {
    probe("publish", ("--redis", &redis.url(), ""), "edge", "robot-1")
}

/// A number in the last row of a service that listens.
fn count(ear: &Process, field: &str) -> u64 {
    let lines = ear.stdout();
    let row = lines.last().and_then(|line| serde_json::from_str::<Value>(line).ok());
    row.and_then(|row| row["topics"][0][field].as_u64()).unwrap_or(0)
}

impl System {
    fn start() -> anyhow::Result<Self> {
        let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default())?;
        let (kafka, run, domain) = (shared_kafka()?, unique_name("again"), free_domain()?);
        let prefixes = ["fog", "cloud"].map(|layer| format!("{run}.{layer}."));
        let of_layer = |at: usize, layer: &str, node: &str| {
            FlowProcess::launch(
                FlowSpec::new(layer, node).on_kafka(&kafka, &prefixes[at]).joined(domain),
            )
        };
        let robot = FlowSpec::new("edge", "robot-1").on_redis(&redis.url(), "").joined(domain);
        let mut flows = [
            FlowProcess::launch(robot)?,
            of_layer(0, "fog", "fog-1")?,
            of_layer(1, "cloud", "cloud-1")?,
        ];
        for flow in &mut flows {
            flow.wait_ready()?;
        }
        let [robot, fog, cloud] = flows;
        let system = Self {
            robot,
            fog,
            cloud,
            driver: driver(&redis)?,
            ears: [
                probe("listen", ("--kafka", &kafka, &prefixes[0]), "fog", "fog-1")?,
                probe("listen", ("--kafka", &kafka, &prefixes[1]), "cloud", "cloud-1")?,
            ],
            redis,
        };
        system.wait_heard()?;
        Ok(system)
    }

    fn tails(&self) -> String {
        let flows = [&self.robot, &self.fog, &self.cloud];
        let tails = flows.map(|flow| format!("{:?}\n{}", flow.bridges(), flow.tail()));
        format!("{}\n{}", tails.join("\n"), self.driver.tail())
    }

    /// Waits until both services have heard more than now; rows come each second.
    fn wait_heard(&self) -> anyhow::Result<()> {
        let heard = || self.ears.each_ref().map(|ear| count(ear, "received"));
        let before = heard();
        let more = || heard().iter().zip(before).all(|(now, before)| *now > before);
        wait::until("both services hear more", SOON, more, || self.tails())?;
        Ok(())
    }

    /// Waits until messages are bridged that come from now on.
    fn wait_flowing(&self) -> anyhow::Result<()> {
        let out = || [self.fog.delivered(), self.cloud.delivered()];
        let before = out();
        let more = || out().iter().zip(before).all(|(now, before)| *now > before + 5);
        wait::until("messages flow again", SOON, more, || self.tails())?;
        Ok(())
    }

    fn bridges(&self) -> BTreeSet<String> {
        let all = [&self.robot, &self.fog, &self.cloud].map(FlowProcess::bridges_up);
        all.into_iter().flatten().collect()
    }

    /// DDS participants of others that the fog's flow knows.
    fn endpoints(&self) -> anyhow::Result<u64> {
        let peers = self.fog.admin().json("/v1/peers")?;
        Ok(peers["link"]["endpoints"].as_u64().unwrap_or_default())
    }

    fn kill_the_service(&mut self) -> anyhow::Result<()> {
        self.driver.kill()?;
        self.driver = driver(&self.redis)?;
        Ok(())
    }

    fn kill_the_flow(&mut self) -> anyhow::Result<()> {
        self.robot.restart()
    }

    fn kill_the_node(&mut self) -> anyhow::Result<()> {
        self.driver.kill()?;
        self.robot.kill()?;
        self.redis.restart()?;
        self.robot.relaunch()?;
        self.robot.wait_ready()?;
        self.driver = driver(&self.redis)?;
        Ok(())
    }

    /// The service beside the other flow misses nothing.
    fn kill_a_consumers_flow(&mut self) -> anyhow::Result<()> {
        self.wait_heard()?;
        let lost = count(&self.ears[0], "lost");
        self.cloud.restart()?;
        self.wait_flowing()?;
        self.wait_heard()?;
        anyhow::ensure!(
            count(&self.ears[0], "lost") == lost,
            "lost at the other one: {}",
            self.tails()
        );
        Ok(())
    }
}

#[test]
fn whatever_comes_back_under_its_name_leaves_nothing_behind() -> anyhow::Result<()> {
    let mut system = System::start()?;
    let rounds = if long() { 50 } else { 3 };
    let kills: [fn(&mut System) -> anyhow::Result<()>; 4] = [
        System::kill_the_service,
        System::kill_the_flow,
        System::kill_the_node,
        System::kill_a_consumers_flow,
    ];
    let bridges = system.bridges();
    let (mut warm, mut known) = (Usage::default(), 0);
    for number in 1..=rounds {
        for kill in kills {
            kill(&mut system)?;
            system.wait_flowing()?;
        }
        wait::until(
            "the bridges are as before",
            SOON,
            || system.bridges() == bridges,
            || format!("before {bridges:?}, now {:?}", system.bridges()),
        )?;
        if number == WARM {
            (warm, known) = (system.fog.usage()?, system.endpoints()?);
        }
    }
    let (last, endpoints) = (system.fog.usage()?, system.endpoints()?);
    println!(
        "{rounds} rounds: the fog's flow holds {last}, {endpoints} endpoints; after {WARM} it held \
         {warm}, {known}"
    );
    system.wait_heard()?;
    for ear in &system.ears {
        let faults = ["duplicated", "reordered"].map(|field| count(ear, field));
        anyhow::ensure!(faults == [0, 0], "twice and out of order: {faults:?}");
    }
    // The lives of robot and cloud, and those that were killed within the time that RustDDS
    // remembers them.
    anyhow::ensure!(endpoints <= 2 + 3 * u64::from(rounds), "{endpoints} endpoints");
    if long() {
        wait::until(
            "killed participants are forgotten",
            FORGOTTEN,
            || system.endpoints().is_ok_and(|now| now == 2),
            || format!("{:?}", system.endpoints()),
        )?;
    }
    anyhow::ensure!(last.exceeds_by_at_most(&warm, &MOST), "it grew from {warm} to {last}");
    Ok(())
}
