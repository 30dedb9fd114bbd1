//! Topics of ROS 2 on other brokers, and JSON of theirs for ROS 2 nodes.

use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use blaze_flow::types::{Encoding, MessageType, Types};
use blaze_tests::flow::{FlowProcess, FlowSpec};
use blaze_tests::plain::{KafkaReader, KafkaWriter, RedisReader, publish, tell_kafka, tell_redis};
use blaze_tests::ros2::{Message, Peer, Quality, Release};
use blaze_tests::servers::{KafkaOptions, KafkaServer, RedisServer};
use blaze_tests::wait;
use blaze_tests::wan::Ways;
use bytes::Bytes;
use serde_json::{Value, json};
use sha2::Digest as _;

use super::support::{ARRIVE, DEEP, DOMAIN, LINK_DOMAIN, MEET, NODE, Pair, redis, state};

const ODOMETRY: &str = "nav_msgs/msg/Odometry";
const TWIST: &str = "geometry_msgs/msg/Twist";
/// How long a command is of use.
const LIFESPAN: Duration = Duration::from_millis(500);

/// A message of a type as CDR.
fn cdr(kind: &str, json: &Value) -> anyhow::Result<Bytes> {
    let now = std::time::Instant::now();
    let found = Types::default().get(now, MessageType { name: kind, hash: "" });
    let found = found.map_err(|failure| anyhow::anyhow!("{failure:?}"))?;
    let made = found.convert(Encoding::Cdr, json.to_string().as_bytes());
    Ok(made.map_err(|failure| anyhow::anyhow!("{failure:?}"))?.payload)
}

/// As peers log it.
fn logged(cdr: &[u8]) -> Message {
    let mut canonical = cdr.to_vec();
    canonical[2..4].fill(0);
    canonical.resize(cdr.len().next_multiple_of(4), 0);
    let sum = sha2::Sha256::digest(&canonical);
    Message(canonical.len(), sum.iter().map(|byte| format!("{byte:02x}")).collect())
}

fn odometry(x: f64) -> Value {
    json!({ "header": { "frame_id": "odom" }, "pose": { "pose": { "position": { "x": x } } } })
}

struct Brokers {
    robot: RedisServer,
    fog: RedisServer,
    kafka: KafkaServer,
}

/// A robot with ROS 2 and Redis, a cloud with Kafka, and in the same building a fog with Redis;
/// dropped in this order.
struct World {
    fog: FlowProcess,
    pair: Pair<Brokers>,
}

impl World {
    fn start() -> anyhow::Result<Self> {
        let pair = Pair::on(
            |robot, cloud| {
                let options = KafkaOptions { host: Some(cloud.clone()), ..KafkaOptions::default() };
                let kafka = KafkaServer::start(options)?;
                Ok(Brokers { robot: redis(robot)?, fog: redis(cloud)?, kafka })
            },
            |brokers, edge, cloud| {
                let edge = edge.on_ros2(DOMAIN).on_redis(&brokers.robot.url(), "");
                [edge, cloud.on_kafka(&brokers.kafka.bootstrap(), "")]
            },
        )?;
        let fog = FlowSpec::new("fog", "fog-1").joined(LINK_DOMAIN);
        let fog = fog.on_redis(&pair.brokers.fog.url(), "");
        let fog = FlowProcess::start(fog.inside(pair.network.host("cloud")?, &[]))?;
        Ok(Self { fog, pair })
    }

    /// A control message to a flow on Redis.
    fn tell(&self, host: &str, redis: &RedisServer, message: &Value) -> anyhow::Result<()> {
        self.pair.inside(host, || tell_redis(&redis.url(), "", message))
    }

    /// What a plain client of a Redis reads on a channel.
    fn reader(
        &self,
        host: &str,
        redis: &RedisServer,
        channel: &str,
    ) -> anyhow::Result<RedisReader> {
        self.pair.inside(host, || RedisReader::new(&redis.url(), channel))
    }

    fn state(&self, topic: &str) -> String {
        format!("{}\n{}", self.pair.state(topic), state(&self.fog, topic))
    }
}

fn send(publisher: &Peer, end: &str, cdr: &[u8]) -> anyhow::Result<()> {
    let data = BASE64.encode(cdr);
    publisher.ask(&json!({ "op": "publish", "name": end, "data": data })).map(drop)
}

#[test]
fn odometry_reaches_redis_and_kafka_and_commands_come_back_as_json() -> anyhow::Result<()> {
    let world = World::start()?;
    let peer = world.pair.on_robot(Release::Jazzy)?;
    peer.ask(&json!({
        "op": "publisher", "name": "odom", "node": NODE, "topic": "/odom", "type": ODOMETRY,
        "qos": Quality::default(),
    }))?;
    let request = |service: &str, form: &str| {
        json!({ "op": "request", "topic": "odom", "service": service, form: true,
            "reliability": "reliable", "ttl_s": 0 })
    };
    // The robot's own Redis: CDR without a header.
    world.tell("robot", &world.pair.brokers.robot, &request("logger", "bare"))?;
    let mut on_robot = world.reader("robot", &world.pair.brokers.robot, "blaze/bare/odom")?;
    // The fog's Redis: JSON.
    world.tell("cloud", &world.pair.brokers.fog, &request("map", "json"))?;
    let mut in_fog = world.reader("cloud", &world.pair.brokers.fog, "blaze/json/odom")?;
    // The cloud's Kafka: CDR.
    let kafka = world.pair.brokers.kafka.bootstrap();
    let in_cloud = world.pair.inside("cloud", || {
        tell_kafka(&KafkaWriter::new(&kafka)?, "", &request("recorder", "bare"))?;
        KafkaReader::from_end(&kafka, "odom")
    })?;
    let expected = ["odom|ros2>inter|cloud", "odom|ros2>inter|fog", "odom|ros2>node|edge|bare"];
    let bridges = || world.pair.edge.bridges_up() == expected;
    wait::until("one bridge to each broker", MEET, bridges, || world.state("odom"))?;
    // Until all have met: messages before are gone.
    let mut last = 0.0;
    let (mut robot, mut fog, mut cloud) = (false, false, false);
    let arrives = || {
        last += 1.0;
        let message = cdr(ODOMETRY, &odometry(last)).unwrap();
        send(&peer, "odom", &message).unwrap();
        let moment = Duration::from_millis(50);
        robot |= on_robot.next(moment).is_ok_and(|found| found.is_some());
        fog |= in_fog.next(moment).is_ok_and(|found| found.is_some());
        cloud |= in_cloud.next(moment).is_some();
        robot && fog && cloud
    };
    wait::until("odometry arrives everywhere", MEET, arrives, || world.state("odom"))?;
    let wanted = cdr(ODOMETRY, &odometry(-1.5))?;
    send(&peer, "odom", &wanted)?;
    let found = wait::until_some(
        "the message on the robot's Redis",
        ARRIVE,
        || on_robot.next(Duration::from_secs(1)).ok()?.filter(|found| *found == wanted),
        || world.state("odom"),
    )?;
    assert_eq!(found, wanted);
    let record = wait::until_some(
        "the message on Kafka",
        ARRIVE,
        || in_cloud.next(Duration::from_secs(1)).filter(|record| record.payload == wanted),
        || world.state("odom"),
    )?;
    assert_eq!(record.header("blaze-encoding"), format!("application/cdr; type={ODOMETRY}"));
    let message = wait::until_some(
        "the message as JSON in the fog",
        ARRIVE,
        || {
            let json = in_fog.next_json(Duration::from_secs(1)).ok()?;
            (json["pose"]["pose"]["position"]["x"] == -1.5).then_some(json)
        },
        || world.state("odom"),
    )?;
    assert_eq!(message["header"]["frame_id"], "odom");
    assert_eq!(message["pose"]["covariance"].as_array().map(Vec::len), Some(36));
    commands(&world, &peer)
}

/// Commands as JSON from the fog; those that are too old after a cut are not delivered.
fn commands(world: &World, peer: &Peer) -> anyhow::Result<()> {
    let obeys = peer.subscription(NODE, "/cmd_vel", TWIST, DEEP)?;
    let advertise = json!({
        "op": "advertise", "topic": "cmd_vel", "service": "pilot", "ttl_s": 0,
        "encoding": "application/json", "type": TWIST, "reliability": "reliable",
        "lifespan_ms": LIFESPAN.as_millis(),
    });
    world.tell("cloud", &world.pair.brokers.fog, &advertise)?;
    let say = |command: &Value| {
        let text = command.to_string();
        world
            .pair
            .inside("cloud", || publish(&world.pair.brokers.fog.url(), "cmd_vel", text.as_bytes()))
    };
    let command = |x: f64| json!({ "linear": { "x": x } });
    let came = |x: f64| -> anyhow::Result<bool> {
        Ok(obeys.log()?.contains(&logged(&cdr(TWIST, &command(x))?)))
    };
    let mut x = 0.0;
    let meets = || {
        x += 1.0;
        say(&command(x)).is_ok() && (1..=x as u32).any(|x| came(x.into()).unwrap_or_default())
    };
    wait::until("a command arrives", MEET, meets, || world.state("cmd_vel"))?;
    let link = world.pair.network.link("robot", "cloud")?;
    link.cut(Ways::Both)?;
    say(&command(-1.0))?;
    // The time during which it becomes too old is what is tested. The flows have not given each
    // other up by then: without a lifespan they would send it again.
    std::thread::sleep(2 * LIFESPAN);
    link.heal(Ways::Both)?;
    say(&command(-2.0))?;
    let arrives = || came(-2.0).unwrap_or_default();
    wait::until("commands arrive again", ARRIVE, arrives, || world.state("cmd_vel"))?;
    anyhow::ensure!(!came(-1.0)?, "a command of {LIFESPAN:?} came after a cut of twice that");
    let dropped = || {
        let bridges = world.fog.bridges();
        let lanes = bridges.iter().filter(|bridge| bridge["topic"] == "cmd_vel");
        lanes.filter_map(|lane| lane["dropped"]["lifespan"].as_u64()).sum::<u64>()
    };
    wait::until("it is counted", MEET, || dropped() >= 1, || world.state("cmd_vel"))?;
    Ok(())
}
