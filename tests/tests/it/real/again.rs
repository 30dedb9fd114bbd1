//! A service, a flow and a whole node go and come back under their names, again and again: nothing comes twice, and nothing of
//! those who live on grows.

use std::collections::BTreeSet;

use std::time::Duration;

use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::long;
use blaze_tests::process::{Process, Usage};
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer, shared_kafka, unique_name};
use blaze_tests::wait;
use serde_json::Value;

use crate::real::support::SOON;

const TOPIC: &str = "imu/data";
const STREAM: &str = "imu/data,reliable,50,320,2000";
/// After so many rounds everything that is made once has been made.
const WARM: u32 = 2;
/// After RustDDS has lost a participant without a good-bye.
const FORGOTTEN: Duration = Duration::from_secs(80);
/// RustDDS remembers a participant that was killed for 50 s, so that the first minute of restarts adds to what is held.
const MOST: Usage = Usage {
    resident_kib: 12 * 1024,
    threads: 2,
    descriptors: 4,
};

/// A robot on a Redis of its own, a cloud on Kafka, and a service on each.
struct System {
    redis: RedisServer,
    robot: FlowProcess,
    cloud: FlowProcess,
    driver: Process,
    recorder: Process,
}

fn driver(redis: &RedisServer) -> anyhow::Result<Process> {
    let url = redis.url();
    let arguments = [
        "publish",
        "--redis",
        &url,
        "--layer",
        "edge",
        "--node",
        "robot-1",
        "--service",
        "driver",
        "--duration",
        "36000",
        "--topic",
        STREAM,
    ];
    Process::tool("probe", &arguments, None)
}

impl System {
    fn start() -> anyhow::Result<Self> {
        let (redis, kafka) = (
            RedisServer::start(RedisKind::Redis, RedisOptions::default())?,
            shared_kafka()?,
        );
        let domain = free_domain()?;
        let prefix = format!("{}.", unique_name("again"));
        let mut robot = FlowProcess::launch(
            FlowSpec::new("edge", "robot-1")
                .on_redis(&redis.url(), "")
                .joined(domain),
        )?;
        let mut cloud = FlowProcess::launch(
            FlowSpec::new("cloud", "cloud-1")
                .on_kafka(&kafka, &prefix)
                .joined(domain),
        )?;
        robot.wait_ready()?;
        cloud.wait_ready()?;
        let arguments = [
            "listen",
            "--kafka",
            &kafka,
            "--prefix",
            &prefix,
            "--layer",
            "cloud",
            "--node",
            "cloud-1",
            "--service",
            "recorder",
            "--duration",
            "36000",
            "--topic",
            STREAM,
        ];
        let recorder = Process::tool("probe", &arguments, None)?;
        let driver = driver(&redis)?;
        let system = Self {
            redis,
            robot,
            cloud,
            driver,
            recorder,
        };
        system.wait_more(0)?;
        Ok(system)
    }

    fn count(&self, field: &str) -> u64 {
        let row: Option<Value> = self
            .recorder
            .stdout()
            .last()
            .and_then(|line| serde_json::from_str(line).ok());
        row.map_or(0, |row| row["topics"][0][field].as_u64().unwrap_or(0))
    }

    /// Waits until more than so many messages have come.
    fn wait_more(&self, than: u64) -> anyhow::Result<()> {
        wait::until(
            "messages come again",
            SOON,
            || self.count("received") > than,
            || format!("{}\n{}\n{}", self.robot.tail(), self.cloud.tail(), self.driver.tail()),
        )?;
        Ok(())
    }

    /// Waits until messages are bridged that come from now on.
    fn wait_flowing(&self) -> anyhow::Result<()> {
        let out = || -> u64 {
            let bridges = self.cloud.bridges();
            let out = bridges.iter().filter_map(|bridge| bridge["out"]["messages"].as_u64());
            out.sum()
        };
        let before = out();
        wait::until(
            "messages flow again",
            SOON,
            || out() > before + 5,
            || {
                format!(
                    "{:?}\n{}\n{}",
                    self.cloud.bridges(),
                    self.robot.tail(),
                    self.driver.tail()
                )
            },
        )?;
        Ok(())
    }

    fn bridges(&self) -> BTreeSet<String> {
        let all = [&self.robot, &self.cloud].map(FlowProcess::bridges_up);
        all.into_iter().flatten().collect()
    }

    fn endpoints(&self) -> anyhow::Result<u64> {
        let peers = self.cloud.admin().json("/v1/peers")?;
        Ok(peers["link"]["endpoints"].as_u64().unwrap_or_default())
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Victim {
    Service,
    Flow,
    Node,
}

fn round(system: &mut System, victim: Victim) -> anyhow::Result<()> {
    if victim != Victim::Flow {
        system.driver.kill()?;
    }
    if victim != Victim::Service {
        system.robot.kill()?;
    }
    if victim == Victim::Node {
        system.redis.restart()?;
    }
    if victim != Victim::Service {
        system.robot.relaunch()?;
        system.robot.wait_ready()?;
    }
    if victim != Victim::Flow {
        system.driver = driver(&system.redis)?;
    }
    system.wait_flowing()
}

#[test]
fn whatever_comes_back_under_its_name_leaves_nothing_behind() -> anyhow::Result<()> {
    let mut system = System::start()?;
    let rounds = if long() { 50 } else { 3 };
    let bridges = system.bridges();
    let mut warm = (Usage::default(), 0);
    for number in 1..=rounds {
        for victim in [Victim::Service, Victim::Flow, Victim::Node] {
            round(&mut system, victim)?;
        }
        wait::until(
            "the bridges are as before",
            SOON,
            || system.bridges() == bridges,
            || format!("before {bridges:?}, now {:?}", system.bridges()),
        )?;
        if number == WARM {
            warm = (system.cloud.usage()?, system.endpoints()?);
        }
    }
    let last = (system.cloud.usage()?, system.endpoints()?);
    println!(
        "{rounds} restarts of a service, a flow and a node each: the cloud's flow holds {}, {} endpoints; after {WARM} it held {}, {}",
        last.0, last.1, warm.0, warm.1
    );
    // Rows come each second; the last one tells of all that came.
    system.wait_more(system.count("received"))?;
    let told = ["received", "lost", "duplicated", "reordered"].map(|field| system.count(field));
    println!(
        "received {}, lost {}, twice {}, out of order {}",
        told[0], told[1], told[2], told[3]
    );
    anyhow::ensure!(told[2] == 0 && told[3] == 0, "{told:?} of {TOPIC}");
    // One of the robot's lives, and those that were killed within the time that RustDDS remembers them.
    anyhow::ensure!(last.1 <= 1 + 2 * u64::from(rounds), "endpoints: {last:?}");
    if long() {
        wait::until(
            "killed participants are forgotten",
            FORGOTTEN,
            || system.endpoints().is_ok_and(|now| now == 1),
            || format!("{:?}", system.endpoints()),
        )?;
    }
    let (last, warm) = (last.0, warm.0);
    anyhow::ensure!(
        last.threads <= warm.threads + MOST.threads
            && last.descriptors <= warm.descriptors + MOST.descriptors
            && last.resident_kib <= warm.resident_kib + MOST.resident_kib,
        "it grew from {warm} to {last}"
    );
    Ok(())
}
