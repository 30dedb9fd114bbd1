//! Late joiners over brokers and link: who asks for what is kept gets the last of every live
//! writer, who does not gets nothing of it. And the quality of service of the first who came does
//! not stick.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Duration;

use anyhow::Context as _;
use blaze_brokers::{Broker, Health, Role, open_layer, open_node};
use blaze_domain::node_file::{KafkaBroker, LayerBroker, NodeBroker, RedisBroker};
use blaze_domain::{Durability, Reliability, Scope, TopicName};
use blaze_sdk::{
    Advertise, Lease, PublishOptions, Publisher, Request, ServiceManager, ServiceOptions,
    SubscribeOptions, Subscription,
};
use blaze_tests::servers::{shared_kafka, shared_redis};
use blaze_tests::wait;
use bytes::Bytes;
use serde_json::json;

use crate::real::support::{RobotAndCloud, SOON, connect};

const TOPIC: &str = "fleet/map";
/// Messages that a listener may have waiting.
const WAITING: usize = 1_000;
/// After what had to come, nothing more does within this time.
const SILENCE: Duration = Duration::from_millis(700);

async fn service(
    broker: Arc<dyn Broker>,
    layer: &str,
    node: &str,
    name: &str,
    scope: Scope,
) -> anyhow::Result<ServiceManager> {
    let mut status = broker.status();
    tokio::time::timeout(SOON, status.wait_for(|status| status.health == Health::Up)).await??;
    let options =
        ServiceOptions::new(layer.parse()?, name.parse()?, broker, scope).on_node(node.parse()?);
    Ok(ServiceManager::start(options).await?)
}

async fn on_robot(system: &RobotAndCloud, name: &str) -> anyhow::Result<ServiceManager> {
    let section = RedisBroker {
        url: system.redis.clone().into(),
        prefix: system.redis_prefix.clone(),
        user: None,
        password_file: None,
        tls: None,
    };
    let broker = open_node(&NodeBroker::Redis(section), &Role::Service)?;
    service(broker, "edge", "robot-1", name, Scope::Node).await
}

async fn on_cloud(system: &RobotAndCloud, name: &str) -> anyhow::Result<ServiceManager> {
    let section = KafkaBroker {
        bootstrap: vec![system.kafka.clone()],
        prefix: system.kafka_prefix.clone(),
        password_file: None,
        properties: Default::default(),
    };
    let broker = open_layer(&LayerBroker::Kafka(section), &Role::Service)?;
    service(broker, "cloud", "cloud-1", name, Scope::Layer).await
}

/// A service that publishes and keeps the last message for late joiners.
struct Mapper {
    service: ServiceManager,
    publisher: Publisher,
    lease: Lease,
}

impl Mapper {
    async fn start(system: &RobotAndCloud, name: &str) -> anyhow::Result<Self> {
        let topic: TopicName = TOPIC.parse()?;
        let service = on_robot(system, name).await?;
        let options = PublishOptions {
            reliability: Reliability::Reliable,
            depth: 1,
            ..PublishOptions::default()
        };
        let advertise = Advertise {
            reliability: Reliability::Reliable,
            durability: Durability::TransientLocal,
            ..Advertise::new(topic.clone())
        };
        Ok(Self {
            lease: service.flow().advertise(advertise).await?,
            publisher: service.broker().publisher(&topic, &options)?,
            service,
        })
    }

    fn publish(&self, text: &str) {
        self.publisher.publish(Bytes::from(text.to_owned()));
    }

    async fn end(self) {
        drop(self.lease);
        self.service.shutdown().await;
    }
}

/// A service that listens.
struct Listener {
    heard: Receiver<String>,
    _service: ServiceManager,
    _lease: Lease,
    _subscription: Subscription,
}

impl Listener {
    async fn start(service: ServiceManager, durability: Durability) -> anyhow::Result<Self> {
        let topic: TopicName = TOPIC.parse()?;
        let request = Request {
            reliability: Reliability::Reliable,
            durability,
            ..Request::new(topic.clone())
        };
        let lease = service.flow().request(request).await?;
        let (tell, heard) = sync_channel(WAITING);
        let options = SubscribeOptions {
            with_kept: durability == Durability::TransientLocal,
            ..SubscribeOptions::default()
        };
        let hear = move |message: blaze_sdk::Message| {
            // Beyond what may wait the test has failed anyway.
            let _ = tell.try_send(String::from_utf8_lossy(message.payload()).into_owned());
        };
        let subscription = service.broker().subscribe(&topic, options, hear).await?;
        Ok(Self { heard, _service: service, _lease: lease, _subscription: subscription })
    }

    /// What it hears within the time that is enough, sorted; then nothing more comes.
    fn hears(&self, count: usize) -> anyhow::Result<Vec<String>> {
        let mut all = Vec::new();
        while all.len() < count {
            let next = self.heard.recv_timeout(SOON);
            all.push(next.with_context(|| format!("only {all:?} of {count}"))?);
        }
        all.extend(self.heard.recv_timeout(SILENCE));
        all.sort();
        Ok(all)
    }
}

#[test]
fn late_joiners_get_the_last_of_every_live_writer() -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(late_joiners())
}

async fn late_joiners() -> anyhow::Result<()> {
    let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
    let (lidar, camera) =
        (Mapper::start(&system, "lidar").await?, Mapper::start(&system, "camera").await?);
    // Before anybody asks for it anywhere.
    for number in 1..=3 {
        lidar.publish(&format!("lidar {number}"));
        camera.publish(&format!("camera {number}"));
    }
    let first =
        Listener::start(on_cloud(&system, "first").await?, Durability::TransientLocal).await?;
    assert_eq!(first.hears(2)?, ["camera 3", "lidar 3"], "the first who joins late, over the link");
    let second =
        Listener::start(on_cloud(&system, "second").await?, Durability::TransientLocal).await?;
    assert_eq!(second.hears(2)?, ["camera 3", "lidar 3"], "the second one gets both writers, too");
    let beside =
        Listener::start(on_robot(&system, "beside").await?, Durability::TransientLocal).await?;
    assert_eq!(beside.hears(2)?, ["camera 3", "lidar 3"], "on the publishers' own broker");
    let volatile =
        Listener::start(on_cloud(&system, "volatile").await?, Durability::Volatile).await?;
    assert!(volatile.heard.recv_timeout(SILENCE).is_err(), "volatile is volatile");
    lidar.publish("lidar 4");
    for (listener, name) in
        [(&first, "first"), (&second, "second"), (&beside, "beside"), (&volatile, "volatile")]
    {
        assert_eq!(listener.hears(1)?, ["lidar 4"], "{name}");
    }
    // What a writer that has gone had kept is of no use any more.
    camera.end().await;
    let kept = || -> anyhow::Result<u64> {
        let mut command = redis::cmd("HLEN");
        Ok(command
            .arg(system.channel("blaze:last:fleet/map"))
            .query(&mut connect(&system.redis)?)?)
    };
    wait::until(
        "what the camera published is forgotten",
        SOON,
        || kept().is_ok_and(|writers| writers == 1),
        || format!("{:?} writers, {}", kept(), system.robot.tail()),
    )?;
    let third =
        Listener::start(on_robot(&system, "third").await?, Durability::TransientLocal).await?;
    assert_eq!(third.hears(1)?, ["lidar 4"], "of live writers only");
    lidar.end().await;
    Ok(())
}

#[test]
fn the_quality_of_the_first_does_not_stick() -> anyhow::Result<()> {
    const TOPIC: &str = "robot/state";
    let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
    let advertise = |service: &str, reliability: &str| {
        system
            .tell_robot(&json!({"op":"advertise","topic":TOPIC,"service":service,"reliability":reliability,"ttl_s":0}))
    };
    let request = |reliability: &str, lifespan_ms: u32| {
        system.tell_cloud(
            &json!({"op":"request","topic":TOPIC,"service":"sink","reliability":reliability,
            "lifespan_ms":lifespan_ms,"ttl_s":0}),
        )
    };
    let lane_is = |what: &str, reliable: bool, lifespan_ms: u32| -> anyhow::Result<()> {
        let found = || system.robot.bridges().into_iter().find(|bridge| bridge["topic"] == TOPIC);
        wait::until(
            what,
            SOON,
            || {
                found().is_some_and(|bridge| {
                    bridge["reliable"] == reliable && bridge["lifespan_ms"] == lifespan_ms
                })
            },
            || format!("{:?}", found()),
        )?;
        Ok(())
    };
    advertise("first", "best_effort")?;
    request("reliable", 0)?;
    lane_is("more asked than offered flows as offered", false, 0)?;
    let verdict = || system.robot.why(TOPIC, Some("cloud")).map(|why| why["verdict"].clone());
    wait::until(
        "why says that less is offered",
        SOON,
        || verdict().is_ok_and(|verdict| verdict == "degraded"),
        || format!("{:?}", verdict()),
    )?;
    advertise("second", "reliable")?;
    lane_is("a second publisher offers more", true, 0)?;
    request("reliable", 300)?;
    lane_is("the request changes", true, 300)?;
    request("best_effort", 500)?;
    lane_is("and changes again", false, 500)?;
    request("reliable", 0)?;
    system.tell_robot(&json!({"op":"withdraw","topic":TOPIC,"service":"second"}))?;
    lane_is("the better publisher has gone", false, 0)?;
    advertise("first", "reliable")?;
    lane_is("the first offers more now", true, 0)
}
