//! What the tests of this binary share.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::plain::KafkaWriter;
use blaze_tests::servers::unique_name;

/// Where something must happen, on a busy machine.
pub(crate) const SOON: Duration = Duration::from_secs(20);

static TURN: Mutex<()> = Mutex::new(());

/// Held by the test that runs now: each of them has servers, flows and clients of its own, and two cores must do.
pub(crate) fn turn() -> MutexGuard<'static, ()> {
    TURN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A robot on Redis and a cloud on Kafka, joined over DDS on loopback.
pub(crate) struct RobotAndCloud {
    pub(crate) redis: String,
    pub(crate) kafka: String,
    pub(crate) redis_prefix: String,
    pub(crate) kafka_prefix: String,
    pub(crate) robot: FlowProcess,
    pub(crate) cloud: FlowProcess,
}

impl RobotAndCloud {
    /// Starts both flows on these servers and waits until they are ready.
    pub(crate) fn start(redis: &str, kafka: &str) -> anyhow::Result<Self> {
        let run = unique_name("real");
        let (redis_prefix, kafka_prefix) = (format!("{run}:"), format!("{run}."));
        let domain = free_domain()?;
        let robot = FlowSpec::new("edge", "robot-1")
            .on_redis(redis, &redis_prefix)
            .joined(domain);
        let cloud = FlowSpec::new("cloud", "cloud-1")
            .on_kafka(kafka, &kafka_prefix)
            .joined(domain);
        let (mut robot, mut cloud) = (FlowProcess::launch(robot)?, FlowProcess::launch(cloud)?);
        robot.wait_ready()?;
        cloud.wait_ready()?;
        Ok(Self {
            redis: redis.to_owned(),
            kafka: kafka.to_owned(),
            redis_prefix,
            kafka_prefix,
            robot,
            cloud,
        })
    }

    /// A channel of the robot's Redis.
    pub(crate) fn channel(&self, name: &str) -> String {
        format!("{}{name}", self.redis_prefix)
    }

    /// A topic of the cloud's Kafka.
    pub(crate) fn topic(&self, name: &str) -> String {
        format!("{}{}", self.kafka_prefix, name.replace('/', "."))
    }

    /// PUBLISH on the robot's Redis, as `redis-cli publish` does. Gives how many heard it.
    pub(crate) fn publish(&self, channel: &str, payload: &[u8]) -> anyhow::Result<i64> {
        let mut connection = connect(&self.redis)?;
        Ok(redis::cmd("PUBLISH")
            .arg(self.channel(channel))
            .arg(payload)
            .query(&mut connection)?)
    }

    /// A control message on the robot's Redis.
    pub(crate) fn tell_robot(&self, message: &serde_json::Value) -> anyhow::Result<()> {
        let heard = self.publish("blaze/flow/control", message.to_string().as_bytes())?;
        anyhow::ensure!(heard == 1, "{heard} heard a control message instead of the flow alone");
        Ok(())
    }

    /// A control message on the cloud's Kafka.
    pub(crate) fn tell_cloud(&self, message: &serde_json::Value) -> anyhow::Result<()> {
        KafkaWriter::new(&self.kafka)?.produce(&self.topic("blaze/flow/control"), message.to_string().as_bytes())
    }
}

/// A plain connection to Redis.
pub(crate) fn connect(url: &str) -> anyhow::Result<redis::Connection> {
    Ok(redis::Client::open(url)?.get_connection_with_timeout(Duration::from_secs(2))?)
}

/// A subscriber that knows nothing of frames.
pub(crate) struct RedisReader {
    connection: redis::Connection,
}

impl RedisReader {
    /// Subscribes to a channel, prefix included.
    pub(crate) fn new(url: &str, channel: &str) -> anyhow::Result<Self> {
        let mut connection = connect(url)?;
        connection.set_read_timeout(Some(Duration::from_millis(50)))?;
        connection.send_packed_command(&redis::cmd("SUBSCRIBE").arg(channel).get_packed_command())?;
        connection.recv_response()?;
        Ok(Self { connection })
    }

    /// The next payload within a time.
    pub(crate) fn next(&mut self, within: Duration) -> anyhow::Result<Option<Vec<u8>>> {
        let until = std::time::Instant::now() + within;
        while std::time::Instant::now() < until {
            match self.connection.recv_response() {
                Ok(redis::Value::Array(parts)) => {
                    if let Some(redis::Value::BulkString(payload)) = parts.into_iter().nth(2) {
                        return Ok(Some(payload));
                    }
                }
                Ok(_) => {}
                Err(error) if error.is_timeout() => {}
                Err(error) => return Err(error.into()),
            }
        }
        Ok(None)
    }

    /// The next payload as JSON.
    pub(crate) fn next_json(&mut self, within: Duration) -> anyhow::Result<serde_json::Value> {
        let payload = self
            .next(within)?
            .ok_or_else(|| anyhow::anyhow!("nothing came within {within:?}"))?;
        Ok(serde_json::from_slice(&payload)?)
    }
}
