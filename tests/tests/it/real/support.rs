//! A robot on Redis and a cloud on Kafka.

use std::time::Duration;

use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::plain::{self, KafkaWriter};
pub(crate) use blaze_tests::plain::{RedisReader, connect};
use blaze_tests::servers::unique_name;
use serde_json::{Value, json};

/// Where something must happen, on a busy machine.
pub(crate) const SOON: Duration = Duration::from_secs(40);

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
        let robot = FlowSpec::new("edge", "robot-1").on_redis(redis, &redis_prefix).joined(domain);
        // A topic counts by its largest message, so a burst with a large one would be thinned out.
        let robot = FlowSpec { limit_mbps: 100_000.0, ..robot };
        let cloud = FlowSpec::new("cloud", "cloud-1").on_kafka(kafka, &kafka_prefix).joined(domain);
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
        plain::publish(&self.redis, &self.channel(channel), payload)
    }

    /// A control message on the robot's Redis.
    pub(crate) fn tell_robot(&self, message: &Value) -> anyhow::Result<()> {
        plain::tell_redis(&self.redis, &self.redis_prefix, message)
    }

    /// A control message on the cloud's Kafka.
    pub(crate) fn tell_cloud(&self, message: &Value) -> anyhow::Result<()> {
        plain::tell_kafka(&KafkaWriter::new(&self.kafka)?, &self.kafka_prefix, message)
    }

    /// Advertised on the robot and requested in the cloud on these terms, and bridged.
    pub(crate) fn route(&self, topic: &str, terms: &Value) -> anyhow::Result<()> {
        let lease = |op: &str| {
            let mut message = json!({"op": op, "topic": topic, "service": "test", "ttl_s": 0});
            for (key, value) in terms.as_object().into_iter().flatten() {
                message[key] = value.clone();
            }
            message
        };
        self.tell_robot(&lease("advertise"))?;
        self.tell_cloud(&lease("request"))?;
        self.robot.wait_bridge(topic, SOON)?;
        self.cloud.wait_bridge(topic, SOON)
    }
}
