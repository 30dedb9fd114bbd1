//! A flow that is killed and started again: messages flow again soon, nothing comes twice, bridges are as before, and
//! those that live on do not grow.

use std::time::{Duration, Instant};

use blaze_tests::{long, wait, within};

use super::support::{Launch, Node, count, free_domain, text};

/// From `/readyz` of the new process to the next message.
const FLOWING: Duration = Duration::from_secs(2);
const IMU: &str = "imu/data";
/// Where messages of the robot leave the link, at cloud-1 and fog-1.
const TO_CLOUD: &str = "imu/data|inter>layer|cloud";
const TO_FOG: &str = "imu/data|inter>layer|fog";

/// How often, how long after a restart memory is looked at, and how much it may have grown from the first to the last.
struct Plan {
    restarts: u32,
    settle: Duration,
    growth_bytes: u64,
}

fn plan() -> Plan {
    if long() {
        Plan {
            restarts: 10,
            settle: Duration::from_secs(60),
            growth_bytes: 10 << 20,
        }
    } else {
        // Two restarts may leak twice what a restart costs; what outlives 4 s (RustDDS frees on a 6 s timer) adds to it.
        Plan {
            restarts: 3,
            settle: Duration::from_secs(4),
            growth_bytes: 10 << 20,
        }
    }
}

struct Trio {
    domain: u16,
    robot: Node,
    fog: Node,
    cloud: Node,
}

impl Trio {
    fn start() -> anyhow::Result<Self> {
        let domain = free_domain()?;
        let start = |node| Launch::local(node, domain).start();
        let mut trio = Self {
            domain,
            robot: start("robot-1")?,
            fog: start("fog-1")?,
            cloud: start("cloud-1")?,
        };
        for node in [&mut trio.robot, &mut trio.fog, &mut trio.cloud] {
            node.ready()?;
        }
        let flows = || trio.fog.bridged(TO_FOG) > 0 && trio.cloud.bridged(TO_CLOUD) > 0;
        wait::until("messages in fog and cloud", Duration::from_secs(10), flows, || {
            trio.tails()
        })?;
        Ok(trio)
    }

    fn tails(&self) -> String {
        let nodes = [&self.robot, &self.fog, &self.cloud];
        let tails = nodes.map(|node| {
            format!(
                "--- {}: bridges {:?}\n{}",
                node.name,
                node.bridges(),
                node.process.tail()
            )
        });
        tails.join("\n")
    }
}

/// The time that a condition takes to hold after the restarted process was ready.
fn flowing_again(trio: &Trio, ready: Instant, flows: impl FnMut() -> bool) -> anyhow::Result<Duration> {
    let left = within(FLOWING).saturating_sub(ready.elapsed());
    wait::until("messages flow again", left, flows, || trio.tails())?;
    Ok(ready.elapsed())
}

fn same_bridges(node: &Node, before: &[String]) -> anyhow::Result<()> {
    let same = || node.bridges() == before;
    wait::until(
        "the bridges are as before",
        within(Duration::from_secs(3)),
        same,
        || format!("{} has {:?}, before {before:?}", node.name, node.bridges()),
    )?;
    Ok(())
}

/// Memory of the survivors, once they have settled.
fn memory(nodes: &[&Node], settle: Duration) -> Vec<u64> {
    // Nothing to wait for: this is the time after which memory is compared.
    std::thread::sleep(settle);
    nodes
        .iter()
        .map(|node| node.process.resident_bytes().expect("a survivor runs"))
        .collect()
}

fn compare_memory(what: &str, nodes: &[&Node], first: &[u64], last: &[u64], plan: &Plan) {
    for ((node, first), last) in nodes.iter().zip(first).zip(last) {
        let mb = |bytes: u64| bytes as f64 / f64::from(1 << 20);
        println!(
            "{what}: {} has {:.1} MB {:?} after the first restart, {:.1} MB after restart {}",
            node.name,
            mb(*first),
            plan.settle,
            mb(*last),
            plan.restarts
        );
        assert!(
            *last <= first + plan.growth_bytes,
            "{what}: {} grew by {:.1} MB",
            node.name,
            mb(last - first)
        );
    }
}

fn no_duplicates(what: &str, node: &mut Node, service: &str) -> anyhow::Result<()> {
    let rows = node.rows(IMU, service);
    anyhow::ensure!(!rows.is_empty(), "{what}: {} printed no row of {service}", node.name);
    let summary = node.end()?;
    let total = summary.topic(IMU, service)?;
    let by_rows: u64 = rows.iter().map(|row| count(row, "duplicated")).sum();
    println!(
        "{what}: {} {service}: received {}, lost {}, duplicated {} (rows {by_rows}), reordered {}",
        text(&total["to"]),
        count(total, "received"),
        count(total, "lost"),
        count(total, "duplicated"),
        count(total, "reordered")
    );
    anyhow::ensure!(count(total, "received") > 0, "nothing received: {total}");
    anyhow::ensure!(count(total, "duplicated") + by_rows == 0, "duplicates: {total}");
    anyhow::ensure!(count(total, "lost") == 0, "lost within a writer's life: {total}");
    Ok(())
}

fn kill_the_publisher() -> anyhow::Result<()> {
    let what = "publisher killed";
    let plan = plan();
    let mut trio = Trio::start()?;
    let (at_fog, at_cloud) = (trio.fog.bridges(), trio.cloud.bridges());
    let mut first = Vec::new();
    for round in 1..=plan.restarts {
        trio.robot.process.kill()?;
        trio.robot = Launch::local("robot-1", trio.domain).start()?;
        // Messages of the old life may still come: only what comes after the new one is ready counts.
        trio.robot.ready()?;
        let ready = Instant::now();
        let before = (trio.fog.bridged(TO_FOG), trio.cloud.bridged(TO_CLOUD));
        let flows = || trio.fog.bridged(TO_FOG) > before.0 && trio.cloud.bridged(TO_CLOUD) > before.1;
        let took = flowing_again(&trio, ready, flows)?;
        println!("{what}: restart {round}: flowing {took:.0?} after ready");
        same_bridges(&trio.fog, &at_fog)?;
        same_bridges(&trio.cloud, &at_cloud)?;
        if round == 1 {
            first = memory(&[&trio.fog, &trio.cloud], plan.settle);
        }
    }
    let survivors = [&trio.fog, &trio.cloud];
    let last = memory(&survivors, plan.settle);
    compare_memory(what, &survivors, &first, &last, &plan);
    no_duplicates(what, &mut trio.fog, "dashboard")?;
    no_duplicates(what, &mut trio.cloud, "recorder")
}

fn kill_a_consumer() -> anyhow::Result<()> {
    let what = "consumer killed";
    let plan = plan();
    let mut trio = Trio::start()?;
    let (at_robot, at_fog, at_cloud) = (trio.robot.bridges(), trio.fog.bridges(), trio.cloud.bridges());
    let mut first = Vec::new();
    for round in 1..=plan.restarts {
        let fog_before = trio.fog.bridged(TO_FOG);
        trio.cloud.process.kill()?;
        trio.cloud = Launch::local("cloud-1", trio.domain).start()?;
        trio.cloud.ready()?;
        let ready = Instant::now();
        let took = flowing_again(&trio, ready, || trio.cloud.bridged(TO_CLOUD) > 0)?;
        println!("{what}: restart {round}: flowing {took:.0?} after ready");
        anyhow::ensure!(
            trio.fog.bridged(TO_FOG) > fog_before,
            "the fog got nothing meanwhile: {}",
            trio.tails()
        );
        same_bridges(&trio.robot, &at_robot)?;
        same_bridges(&trio.fog, &at_fog)?;
        same_bridges(&trio.cloud, &at_cloud)?;
        if round == 1 {
            first = memory(&[&trio.robot, &trio.fog], plan.settle);
        }
    }
    let survivors = [&trio.robot, &trio.fog];
    let last = memory(&survivors, plan.settle);
    compare_memory(what, &survivors, &first, &last, &plan);
    no_duplicates(what, &mut trio.cloud, "recorder")?;
    // The other consumer never noticed: nothing lost, nothing twice.
    no_duplicates(what, &mut trio.fog, "dashboard")
}

#[test]
fn a_killed_publisher_comes_back() {
    kill_the_publisher().unwrap_or_else(|error| panic!("{error:#}"));
}

#[test]
fn a_killed_consumer_comes_back() {
    kill_a_consumer().unwrap_or_else(|error| panic!("{error:#}"));
}
