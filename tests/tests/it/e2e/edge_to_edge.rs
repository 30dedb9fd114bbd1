//! Two robots of one layer meet over its DDS domain: node > layer > node, without the inter scope,
//! though they have one.

use std::cell::RefCell;
use std::time::Duration;

use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::plain::{RedisReader, connect, tell_redis};
use blaze_tests::process::Process;
use blaze_tests::servers::{shared_redis, unique_name};
use blaze_tests::wait;
use serde_json::{Value, json};

const TOPIC: &str = "imu/data";
const SOON: Duration = Duration::from_secs(20);
/// How long one look for a message takes.
const MOMENT: Duration = Duration::from_millis(50);
const MESSAGES: u64 = 1_000;

struct Robots {
    redis: String,
    run: String,
    robots: [FlowProcess; 2],
    layer_domain: u16,
}

impl Robots {
    fn start() -> anyhow::Result<Self> {
        let (redis, run) = (shared_redis()?, unique_name("edge"));
        let (layer_domain, inter) = (free_domain()?, free_domain()?);
        let launch = |node: &str| {
            let prefix = format!("{run}-{node}:");
            FlowProcess::launch(
                FlowSpec::new("edge", node)
                    .on_redis(&redis, &prefix)
                    .on_dds(layer_domain)
                    .joined(inter),
            )
        };
        let mut robots = [launch("robot-1")?, launch("robot-2")?];
        for robot in &mut robots {
            robot.wait_ready()?;
        }
        Ok(Self { redis, run, robots, layer_domain })
    }

    fn channel(&self, robot: usize, name: &str) -> String {
        format!("{}-robot-{}:{name}", self.run, robot + 1)
    }

    /// Published on the first robot, asked for on the second, and bridged.
    fn bridge(&self, terms: &Value) -> anyhow::Result<()> {
        let mut advertise =
            json!({"op":"advertise","topic":TOPIC,"service":"imu-driver","ttl_s":0});
        let mut request =
            json!({"op":"request","topic":TOPIC,"service":"logger","bare":true,"ttl_s":0});
        for message in [&mut advertise, &mut request] {
            let more = terms.as_object().into_iter().flatten();
            more.for_each(|(key, value)| message[key] = value.clone());
        }
        tell_redis(&self.redis, &self.channel(0, ""), &advertise)?;
        tell_redis(&self.redis, &self.channel(1, ""), &request)?;
        for robot in &self.robots {
            robot.wait_bridge(TOPIC, SOON)?;
        }
        Ok(())
    }

    fn last_words(&self) -> String {
        let words = |robot: &FlowProcess| format!("{:?}\n{}", robot.bridges(), robot.tail());
        self.robots.iter().map(words).collect::<Vec<_>>().join("\n")
    }
}

fn publish(
    connection: &mut redis::Connection,
    channel: &str,
    payload: &[u8],
) -> anyhow::Result<()> {
    redis::cmd("PUBLISH").arg(channel).arg(payload).exec(connection)?;
    Ok(())
}

#[test]
fn a_plain_dds_program_reads_what_a_robot_publishes() -> anyhow::Result<()> {
    let robots = Robots::start()?;
    robots.bridge(&json!({}))?;
    let domain = robots.layer_domain.to_string();
    let plain = Process::tool("dds-peer", &["plain", "--domain", &domain, "--topic", TOPIC], None)?;
    let mut connection = connect(&robots.redis)?;
    let channel = robots.channel(0, TOPIC);
    wait::until(
        "the plain program reads frames",
        SOON,
        || {
            let _ = publish(&mut connection, &channel, b"{}");
            let lines = plain.stdout();
            let newest: Option<Value> =
                lines.last().and_then(|line| serde_json::from_str(line).ok());
            newest.is_some_and(|report| report["received"].as_u64() >= Some(20))
        },
        || format!("{}\n{}", plain.tail(), robots.last_words()),
    )?;
    let lines = plain.stdout();
    let report: Value = serde_json::from_str(lines.last().map_or("{}", String::as_str))?;
    assert_eq!((&report["malformed"], &report["reordered"]), (&json!(0), &json!(0)), "{report}");
    Ok(())
}

#[test]
fn what_a_robot_kills_comes_back_over_the_layer() -> anyhow::Result<()> {
    let mut robots = Robots::start()?;
    robots.bridge(&json!({"reliability":"reliable"}))?;
    let channel = robots.channel(0, TOPIC);
    let arrives = |robots: &Robots| -> anyhow::Result<Duration> {
        let mut reader =
            RedisReader::new(&robots.redis, &robots.channel(1, "blaze/bare/imu/data"))?;
        let mut connection = connect(&robots.redis)?;
        wait::until(
            "messages arrive",
            SOON,
            || {
                let _ = publish(&mut connection, &channel, b"x");
                matches!(reader.next(MOMENT), Ok(Some(_)))
            },
            || robots.last_words(),
        )
    };
    arrives(&robots)?;
    for robot in [1, 0] {
        robots.robots[robot].kill()?;
        robots.robots[robot].relaunch()?;
        robots.robots[robot].wait_ready()?;
        println!("after a restart of robot-{}: {:?}", robot + 1, arrives(&robots)?);
    }
    Ok(())
}

#[test]
fn the_command_line_publishes_and_echoes_on_the_layer() -> anyhow::Result<()> {
    const COUNT: usize = 5;
    let domain = free_domain()?;
    let flow = FlowProcess::start(FlowSpec::new("edge", "robot-1").on_dds(domain))?;
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("blaze.yaml");
    let spec = FlowSpec::new("edge", "robot-1").on_dds(domain);
    std::fs::write(&file, spec.to_yaml(folder.path()))?;
    let file = file.to_string_lossy();
    let echo = Process::start(
        "blaze",
        &["echo", TOPIC, "--config", &file, "--count", &COUNT.to_string()],
        None,
    )?;
    let mut publisher = Process::start(
        "blaze",
        &["pub", TOPIC, "{\"x\":1}", "--config", &file, "--rate", "10"],
        None,
    )?;
    wait::until(
        "the echo prints what is published",
        SOON,
        || echo.stdout().iter().filter(|line| line.contains("\"x\"")).count() >= COUNT,
        || format!("{}\n{}\n{}", echo.tail(), publisher.tail(), flow.tail()),
    )?;
    let code = publisher.terminate(SOON)?;
    assert_eq!(code, Some(0), "{}", publisher.tail());
    Ok(())
}

mod quick {
    use super::*;

    #[test]
    fn a_topic_goes_from_node_to_node_over_the_layer() -> anyhow::Result<()> {
        let robots = Robots::start()?;
        let mut reader =
            RedisReader::new(&robots.redis, &robots.channel(1, "blaze/bare/imu/data"))?;
        robots.bridge(&json!({"reliability":"reliable"}))?;
        let mut connection = connect(&robots.redis)?;
        let channel = robots.channel(0, TOPIC);
        // Until both ends have met: what is published before is gone.
        let met = RefCell::new(Vec::new());
        wait::until(
            "a first message arrives",
            SOON,
            || {
                let _ = publish(&mut connection, &channel, b"first");
                met.borrow_mut().extend(reader.next(MOMENT).ok().flatten());
                !met.borrow().is_empty()
            },
            || robots.last_words(),
        )?;
        let mut found = Vec::new();
        for number in 1..=MESSAGES {
            publish(&mut connection, &channel, number.to_string().as_bytes())?;
            std::thread::sleep(Duration::from_millis(2));
        }
        wait::until(
            "the last message arrives",
            SOON,
            || {
                while let Ok(Some(payload)) = reader.next(MOMENT) {
                    found.push(String::from_utf8_lossy(&payload).into_owned());
                }
                found.last() == Some(&MESSAGES.to_string())
            },
            || robots.last_words(),
        )?;
        found.retain(|payload| payload != "first");
        let expected: Vec<String> = (1..=MESSAGES).map(|number| number.to_string()).collect();
        assert_eq!(found, expected, "in order, each once");

        let ids = |robot: &FlowProcess| robot.bridges_up();
        assert_eq!(ids(&robots.robots[0]), [format!("{TOPIC}|node>layer|edge")]);
        assert_eq!(ids(&robots.robots[1]), [format!("{TOPIC}|layer>node|edge|bare")]);
        let bridge = &robots.robots[1].bridges()[0];
        let brokers = (&bridge["from"]["broker"], &bridge["to"]["broker"]);
        assert_eq!(brokers, (&json!("dds"), &json!("redis")), "{bridge}");
        assert!(bridge["out"]["messages"].as_u64() >= Some(MESSAGES), "{bridge}");
        for (robot, to) in
            [(&robots.robots[0], "edge/robot-2"), (&robots.robots[1], "edge/robot-2")]
        {
            let why = robot.why(TOPIC, Some(to))?;
            assert!(
                ["flowing", "degraded"].contains(&why["verdict"].as_str().unwrap_or_default()),
                "{why}"
            );
        }
        let nobody = robots.robots[0].why("nobody/knows", Some("edge/robot-2"))?;
        assert_eq!(nobody["verdict"], "not_flowing", "{nobody}");
        Ok(())
    }
}
