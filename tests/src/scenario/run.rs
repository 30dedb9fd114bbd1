//! Plays a scenario with real processes.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use serde_json::Value;

use super::{Broker, BrokerKind, Fault, Flow, Report, Route, Scenario, Service, Stream};
use crate::flow::{FlowProcess, FlowSpec};
use crate::network::{Host, Topology};
use crate::process::{Process, Signal};
use crate::servers::{KafkaOptions, KafkaServer, RedisKind, RedisOptions, RedisServer};
use crate::wait;

/// DDS domain of the inter scope: nothing else is in these namespaces.
const DOMAIN: u16 = 20;
/// How long a service may take to start, and each topic to reach each consumer for the first time.
const START: Duration = Duration::from_secs(40);
/// A row comes each second.
const ROW: Duration = Duration::from_secs(10);
/// Beyond the time that it is published for, so that services end after the runner has asked them.
const SPARE: Duration = Duration::from_secs(600);

/// Plays a scenario and gives what was measured; whether that is as expected is for [`Report::check`].
///
/// # Errors
/// When the machine does not allow it, something does not start, or a route does not come up.
pub fn run(scenario: &Scenario) -> anyhow::Result<Report> {
    let mut running = Running::start(scenario)?;
    running
        .play(scenario)
        .map_err(|error| error.context(format!("{}\n{}", scenario.name, running.tails())))
}

enum Server {
    Redis(RedisServer),
    Kafka(KafkaServer),
}

/// Everything that runs; fields end in this order.
struct Running {
    publishers: Vec<Probe>,
    consumers: Vec<Probe>,
    flows: BTreeMap<&'static str, FlowProcess>,
    brokers: BTreeMap<&'static str, Server>,
    topology: Topology,
}

struct Probe {
    service: Service,
    process: Process,
}

impl Running {
    fn start(scenario: &Scenario) -> anyhow::Result<Self> {
        check(scenario)?;
        let topology = Topology::build(&scenario.network)?;
        let mut running = Self {
            publishers: Vec::new(),
            consumers: Vec::new(),
            flows: BTreeMap::new(),
            brokers: BTreeMap::new(),
            topology,
        };
        for broker in &scenario.brokers {
            let server = start_broker(broker, running.topology.host(broker.host)?)?;
            running.brokers.insert(broker.name, server);
        }
        for flow in &scenario.flows {
            let spec = running.flow_spec(flow)?;
            running.flows.insert(flow.node, FlowProcess::launch(spec)?);
        }
        for flow in running.flows.values_mut() {
            flow.wait_ready()?;
        }
        let time = scenario.duration + scenario.settle + START + SPARE;
        for service in &scenario.consumers {
            let probe = running.start_probe("listen", service, time)?;
            running.consumers.push(probe);
        }
        for service in &scenario.publishers {
            let probe = running.start_probe("publish", service, time)?;
            running.publishers.push(probe);
        }
        Ok(running)
    }

    fn flow_spec(&self, flow: &Flow) -> anyhow::Result<FlowSpec> {
        let peers = flow.peers.iter().map(|peer| Ok(self.topology.host(peer)?.address));
        let peers: Vec<_> = peers.collect::<anyhow::Result<_>>()?;
        let mut spec = FlowSpec::new(flow.layer, flow.node)
            .joined(DOMAIN)
            .inside(self.topology.host(flow.host)?, &peers);
        spec.kind = flow.kind.to_owned();
        spec.limit_mbps = flow.limit_mbps;
        spec.extra = flow.extra.to_owned();
        for name in &flow.brokers {
            spec = match self.broker(name)? {
                Server::Redis(redis) => spec.on_redis(&redis.url(), ""),
                Server::Kafka(kafka) => spec.on_kafka(&kafka.bootstrap(), ""),
            };
        }
        Ok(spec)
    }

    fn start_probe(&self, role: &str, service: &Service, time: Duration) -> anyhow::Result<Probe> {
        let flow = self.flow(service.flow)?;
        let host = flow.spec.host.as_ref().context("a flow without a host")?;
        let mut arguments: Vec<String> = match self.broker(service.broker)? {
            Server::Redis(redis) => vec![role.to_owned(), "--redis".to_owned(), redis.url()],
            Server::Kafka(kafka) => vec![role.to_owned(), "--kafka".to_owned(), kafka.bootstrap()],
        };
        let mut option = |name: &str, value: String| arguments.extend([name.to_owned(), value]);
        option("--layer", flow.spec.layer.clone());
        option("--node", flow.spec.node.clone());
        option("--service", service.name.to_owned());
        option("--duration", time.as_secs().to_string());
        service
            .streams
            .iter()
            .for_each(|stream| option("--topic", words(stream)));
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let process = Process::start("blaze-probe", &arguments, Some(&host.namespace))?;
        let ready = format!("ready node={} ", service.flow);
        wait::until(
            &format!("{} is ready", service.name),
            START,
            || process.stderr().iter().any(|line| line.starts_with(&ready)),
            || process.tail(),
        )?;
        Ok(Probe {
            service: service.clone(),
            process,
        })
    }

    fn play(&mut self, scenario: &Scenario) -> anyhow::Result<Report> {
        let arrives = |probe: &Probe| {
            let mut streams = probe.service.streams.iter();
            streams.all(|stream| probe.last(stream.topic, "received") > 0)
        };
        wait::until(
            "every topic reaches every consumer",
            START,
            || self.consumers.iter().all(arrives),
            String::new,
        )?;
        let begin = Instant::now();
        let rows: Vec<usize> = self
            .consumers
            .iter()
            .map(|probe| probe.process.stdout().len())
            .collect();
        let mut faults = scenario.faults.clone();
        faults.sort_by_key(|(at, _)| *at);
        for (at, fault) in &faults {
            sleep_until(begin + *at);
            self.break_or_mend(fault)
                .with_context(|| format!("{fault:?} at {at:?}"))?;
        }
        sleep_until(begin + scenario.duration);
        let sent = self.stop_publishing()?;
        let all = |probe: &Probe| {
            let mut streams = probe.service.streams.iter();
            streams.all(|stream| sent.get(stream.topic) == Some(&probe.last(stream.topic, "last")))
        };
        // What has not come by then is lost, and the report says so.
        let _ = wait::until(
            "the last messages",
            scenario.settle,
            || self.consumers.iter().all(all),
            String::new,
        );
        let routes = self.consumers.iter().zip(rows).flat_map(|(probe, from)| {
            let sent = &sent;
            let streams = probe.service.streams.iter();
            streams.map(move |stream| probe.route(stream.topic, sent.get(stream.topic).copied().unwrap_or(0), from))
        });
        Ok(Report {
            name: scenario.name.to_owned(),
            routes: routes.collect(),
        })
    }

    /// Messages published of each topic.
    fn stop_publishing(&self) -> anyhow::Result<BTreeMap<&'static str, u64>> {
        let mut sent = BTreeMap::new();
        for probe in &self.publishers {
            probe.process.signal(Signal::USR1)?;
        }
        for probe in &self.publishers {
            wait::until(
                &format!("{} has stopped", probe.service.name),
                ROW,
                || probe.last_row().is_some_and(|row| row["ended"] == true),
                || probe.process.tail(),
            )?;
            for stream in &probe.service.streams {
                sent.insert(stream.topic, probe.last(stream.topic, "sent"));
            }
        }
        Ok(sent)
    }

    fn break_or_mend(&mut self, fault: &Fault) -> anyhow::Result<()> {
        match fault {
            Fault::Cut(a, b, ways) => self.topology.link(a, b)?.cut(*ways),
            Fault::Heal(a, b, ways) => self.topology.link(a, b)?.heal(*ways),
            Fault::Set(a, b, ways, changes) => self.topology.link(a, b)?.set(*ways, changes),
            Fault::KillFlow(node) => self.flow_mut(node)?.kill(),
            Fault::StartFlow(node) => self.flow_mut(node)?.relaunch(),
            Fault::RestartBroker(name) => match self.broker(name)? {
                Server::Redis(redis) => redis.restart(),
                Server::Kafka(kafka) => kafka.restart(),
            },
            Fault::FreezeBroker(name) => match self.broker(name)? {
                Server::Redis(redis) => redis.freeze(),
                Server::Kafka(kafka) => kafka.freeze(),
            },
            Fault::ThawBroker(name) => match self.broker(name)? {
                Server::Redis(redis) => redis.thaw(),
                Server::Kafka(kafka) => kafka.thaw(),
            },
        }
    }

    fn broker(&self, name: &str) -> anyhow::Result<&Server> {
        self.brokers.get(name).with_context(|| format!("{name} is no broker"))
    }

    fn flow(&self, node: &str) -> anyhow::Result<&FlowProcess> {
        self.flows.get(node).with_context(|| format!("{node} is no flow"))
    }

    fn flow_mut(&mut self, node: &str) -> anyhow::Result<&mut FlowProcess> {
        self.flows.get_mut(node).with_context(|| format!("{node} is no flow"))
    }

    fn tails(&self) -> String {
        let flows = self
            .flows
            .iter()
            .map(|(node, flow)| format!("--- {node}\n{}", flow.tail()));
        let probes = self.publishers.iter().chain(&self.consumers);
        let probes = probes.map(|probe| format!("--- {}\n{}", probe.service.name, probe.process.tail()));
        flows.chain(probes).collect::<Vec<_>>().join("\n")
    }
}

impl Probe {
    fn last_row(&self) -> Option<Value> {
        serde_json::from_str(self.process.stdout().last()?).ok()
    }

    /// A number of a topic in the last row; 0 where it is absent.
    fn last(&self, topic: &str, field: &str) -> u64 {
        self.last_row()
            .map_or(0, |row| of_topic(&row, topic)[field].as_u64().unwrap_or(0))
    }

    fn route(&self, topic: &str, sent: u64, from_row: usize) -> Route {
        let lines = self.process.stdout();
        let rows = lines.iter().skip(from_row);
        let rows: Vec<Value> = rows.filter_map(|line| serde_json::from_str(line).ok()).collect();
        let mut latencies_ms: Vec<f64> = rows
            .iter()
            .filter_map(|row| of_topic(row, topic)["latencies_us"].as_array())
            .flatten()
            .filter_map(|micros| Some(micros.as_f64()? / 1e3))
            .collect();
        latencies_ms.sort_by(f64::total_cmp);
        Route {
            consumer: self.service.name.to_owned(),
            topic: topic.to_owned(),
            sent,
            received: self.last(topic, "received"),
            // What never came after the last one is missing as well.
            lost: self.last(topic, "lost") + sent.saturating_sub(self.last(topic, "last")),
            duplicated: self.last(topic, "duplicated"),
            reordered: self.last(topic, "reordered"),
            latencies_ms,
        }
    }
}

/// Mistakes in the rows, before anything is started.
fn check(scenario: &Scenario) -> anyhow::Result<()> {
    let published = scenario.publishers.iter().flat_map(|service| &service.streams);
    let mut topics = BTreeSet::new();
    for stream in published {
        anyhow::ensure!(topics.insert(stream.topic), "{} is published twice", stream.topic);
    }
    for stream in scenario.consumers.iter().flat_map(|service| &service.streams) {
        anyhow::ensure!(topics.contains(stream.topic), "{} is published by nobody", stream.topic);
    }
    let late = scenario.faults.iter().find(|(at, _)| *at > scenario.duration);
    anyhow::ensure!(late.is_none(), "{late:?} is after the end");
    Ok(())
}

fn start_broker(broker: &Broker, host: &Host) -> anyhow::Result<Server> {
    let host = Some(host.clone());
    let redis = |kind| {
        let options = RedisOptions {
            host: host.clone(),
            ..RedisOptions::default()
        };
        RedisServer::start(kind, options).map(Server::Redis)
    };
    let server = match broker.kind {
        BrokerKind::Redis => redis(RedisKind::Redis),
        BrokerKind::Valkey => redis(RedisKind::Valkey),
        BrokerKind::Kafka => KafkaServer::start(KafkaOptions {
            host,
            ..KafkaOptions::default()
        })
        .map(Server::Kafka),
    };
    server.with_context(|| broker.name)
}

/// As `blaze-probe --topic` wants it.
fn words(stream: &Stream) -> String {
    let reliability = if stream.reliable { "reliable" } else { "best_effort" };
    let Stream {
        topic,
        hz,
        bytes,
        lifespan,
        ..
    } = stream;
    format!("{topic},{reliability},{hz},{bytes},{}", lifespan.as_millis())
}

fn of_topic<'a>(row: &'a Value, topic: &str) -> &'a Value {
    let topics = row["topics"].as_array().map(Vec::as_slice).unwrap_or_default();
    topics
        .iter()
        .find(|line| line["topic"] == topic)
        .unwrap_or(&Value::Null)
}

fn sleep_until(at: Instant) {
    std::thread::sleep(at.saturating_duration_since(Instant::now()));
}
