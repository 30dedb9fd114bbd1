//! Plays a scenario with real processes.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use serde_json::Value;

use super::{
    Broker, BrokerKind, Fault, Flow, FlowReport, Report, Route, Scenario, Service, Stream,
};
use crate::flow::{FlowProcess, FlowSpec};
use crate::network::{Host, Link, Topology};
use crate::process::{Process, Signal, Usage};
use crate::servers::{KafkaOptions, KafkaServer, RedisKind, RedisOptions, RedisServer};
use crate::wait;

/// DDS domain of the inter scope: nothing else is in these namespaces.
const DOMAIN: u16 = 20;
/// How long a service may take to start, and each topic to reach each consumer for the first time.
const START: Duration = Duration::from_secs(40);
/// A row comes each second.
const ROW: Duration = Duration::from_secs(10);
/// The share of the time after which flows are warm: what they hold from then on is compared.
const WARM: u32 = 5;
/// Beyond the time that it is published for, so that services end after the runner has asked them.
const SPARE: Duration = Duration::from_secs(600);

/// Plays a scenario and gives what was measured; whether that is as expected is for
/// [`Report::check`].
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

/// The processes of a scenario, for tests that break and measure things themselves. They end when
/// it is dropped.
pub struct Running {
    // Fields are dropped in this order.
    publishers: Vec<Probe>,
    consumers: Vec<Probe>,
    flows: BTreeMap<&'static str, FlowProcess>,
    brokers: BTreeMap<&'static str, Server>,
    topology: Topology,
}

/// A moment in the lives of the consumers.
#[derive(Debug, Clone, Default)]
pub struct Since(BTreeMap<&'static str, usize>);

struct Probe {
    service: Service,
    process: Process,
}

impl Running {
    /// Starts everything and waits until it is ready; faults are not played.
    ///
    /// # Errors
    /// As [`run`].
    pub fn start(scenario: &Scenario) -> anyhow::Result<Self> {
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
        spec.limit_mbps = flow.limit_mbps;
        spec.bandwidth = flow.bandwidth.to_owned();
        spec.flow = flow.keys.to_owned();
        spec.layer_domain = flow.layer_domain;
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
        service.streams.iter().for_each(|stream| option("--topic", words(stream)));
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let process = Process::tool("probe", &arguments, Some(&host.namespace))?;
        let ready = format!("ready node={} ", service.flow);
        wait::until(
            &format!("{} is ready", service.name),
            START,
            || process.stderr().iter().any(|line| line.starts_with(&ready)),
            || process.tail(),
        )?;
        Ok(Probe { service: service.clone(), process })
    }

    /// Waits until every topic has reached every consumer that wants it.
    ///
    /// # Errors
    /// When one has not in time.
    pub fn wait_flowing(&self) -> anyhow::Result<()> {
        let arrives = |probe: &Probe| {
            let mut streams = probe.service.streams.iter();
            streams.all(|stream| probe.last(stream.topic, "received") > 0)
        };
        let missing = || {
            let silent = self.consumers.iter().filter(|probe| !arrives(probe));
            silent.map(|probe| probe.service.name).collect::<Vec<_>>().join(", ")
        };
        wait::until(
            "every topic reaches every consumer",
            START,
            || self.consumers.iter().all(arrives),
            || format!("not so for {}", missing()),
        )?;
        Ok(())
    }

    /// A link, as [`Topology::link`].
    ///
    /// # Errors
    /// When there is none.
    pub fn link(&self, a: &str, b: &str) -> anyhow::Result<Link<'_>> {
        self.topology.link(a, b)
    }

    /// What a consumer measured of a topic from a moment on.
    ///
    /// # Errors
    /// When there is no such consumer.
    pub fn route(&self, consumer: &str, topic: &str, since: &Since) -> anyhow::Result<Route> {
        let mut consumers = self.consumers.iter();
        let probe = consumers.find(|probe| probe.service.name == consumer);
        let probe = probe.with_context(|| format!("{consumer} is no consumer"))?;
        let row = since.0.get(consumer).copied().unwrap_or(0);
        let sent = self.publishers.iter().map(|probe| probe.last(topic, "sent")).max();
        Ok(probe.route(topic, sent.unwrap_or(0), row))
    }

    /// The present, for [`Running::route`].
    #[must_use]
    pub fn now(&self) -> Since {
        let row = |probe: &Probe| (probe.service.name, probe.process.stdout().len());
        Since(self.consumers.iter().map(row).collect())
    }

    fn play(&mut self, scenario: &Scenario) -> anyhow::Result<Report> {
        self.wait_flowing()?;
        let begin = Instant::now();
        let rows = self.now();
        let mut usage = None;
        let mut faults = scenario.faults.clone();
        faults.sort_by_key(|(at, _)| *at);
        for (at, fault) in &faults {
            if usage.is_none() && *at > scenario.duration / WARM {
                usage = Some(self.warm_usage(begin + scenario.duration / WARM)?);
            }
            sleep_until(begin + *at);
            self.break_or_mend(fault).with_context(|| format!("{fault:?} at {at:?}"))?;
        }
        let usage = match usage {
            Some(usage) => usage,
            None => self.warm_usage(begin + scenario.duration / WARM)?,
        };
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
        let routes = self.consumers.iter().flat_map(|probe| {
            let sent = &sent;
            let from = rows.0.get(probe.service.name).copied().unwrap_or(0);
            let streams = probe.service.streams.iter();
            streams.map(move |stream| {
                probe.route(stream.topic, sent.get(stream.topic).copied().unwrap_or(0), from)
            })
        });
        Ok(Report {
            name: scenario.name.to_owned(),
            routes: routes.collect(),
            flows: self.flow_reports(&usage)?,
            tails: self.tails(),
        })
    }

    /// What the flows hold once they are warm; one that was killed just then is compared with what
    /// it begins with.
    fn warm_usage(&self, at: Instant) -> anyhow::Result<BTreeMap<&'static str, Usage>> {
        sleep_until(at);
        let usage =
            self.flows.iter().map(|(node, flow)| Ok((*node, flow.usage().unwrap_or_default())));
        usage.collect()
    }

    fn flow_reports(
        &mut self,
        warm: &BTreeMap<&'static str, Usage>,
    ) -> anyhow::Result<Vec<FlowReport>> {
        let mut reports = Vec::new();
        for (node, flow) in &mut self.flows {
            flow.wait_ready()?;
            // Messages may be on their way from one bridge to the next until the last has settled.
            let _ = wait::until(
                "bridges have settled",
                ROW,
                || unbalanced(flow).is_empty(),
                String::new,
            );
            reports.push(FlowReport {
                node: (*node).to_owned(),
                warm: warm.get(node).copied().unwrap_or_default(),
                last: flow.usage()?,
                unbalanced: unbalanced(flow),
                dropped: dropped(flow),
            });
        }
        Ok(reports)
    }

    /// Ends publishing and gives the number of messages published of each topic.
    ///
    /// # Errors
    /// When a publisher does not end.
    pub fn stop_publishing(&self) -> anyhow::Result<BTreeMap<&'static str, u64>> {
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

    /// A flow, by its node.
    ///
    /// # Errors
    /// When there is none.
    pub fn flow(&self, node: &str) -> anyhow::Result<&FlowProcess> {
        self.flows.get(node).with_context(|| format!("{node} is no flow"))
    }

    /// Changes what the node file of a flow says while it runs.
    ///
    /// # Errors
    /// When there is no such flow, or its node file cannot be written.
    pub fn edit(&mut self, node: &str, change: impl FnOnce(&mut FlowSpec)) -> anyhow::Result<()> {
        self.flow_mut(node)?.edit(change)
    }

    fn flow_mut(&mut self, node: &str) -> anyhow::Result<&mut FlowProcess> {
        self.flows.get_mut(node).with_context(|| format!("{node} is no flow"))
    }

    /// The last lines of all processes.
    #[must_use]
    pub fn tails(&self) -> String {
        let flows = self.flows.iter().map(|(node, flow)| format!("--- {node}\n{}", flow.tail()));
        let probes = self.publishers.iter().chain(&self.consumers);
        let probes =
            probes.map(|probe| format!("--- {}\n{}", probe.service.name, probe.process.tail()));
        flows.chain(probes).collect::<Vec<_>>().join("\n")
    }
}

impl Probe {
    fn last_row(&self) -> Option<Value> {
        serde_json::from_str(self.process.stdout().last()?).ok()
    }

    /// A number of a topic in the last row; 0 where it is absent.
    fn last(&self, topic: &str, field: &str) -> u64 {
        self.last_row().map_or(0, |row| of_topic(&row, topic)[field].as_u64().unwrap_or(0))
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
            seconds: rows.len(),
            last: self.last(topic, "last"),
            // What never came after the last one is missing as well.
            lost: self.last(topic, "lost") + sent.saturating_sub(self.last(topic, "last")),
            duplicated: self.last(topic, "duplicated"),
            reordered: self.last(topic, "reordered"),
            latencies_ms,
        }
    }
}

/// Bridges that do not say where every message went.
fn unbalanced(flow: &FlowProcess) -> Vec<String> {
    let of = |bridge: &Value| {
        let dropped: u64 = bridge["dropped"]
            .as_object()
            .map_or(0, |reasons| reasons.values().filter_map(Value::as_u64).sum());
        let number = |value: &Value| value.as_u64().unwrap_or(0);
        let (came, went, waits) = (
            number(&bridge["in"]["messages"]),
            number(&bridge["out"]["messages"]),
            number(&bridge["queued"]),
        );
        (came != went + dropped + waits).then(|| {
            format!("{}: in {came}, out {went}, dropped {dropped}, queued {waits}", bridge["id"])
        })
    };
    flow.bridges().iter().filter_map(of).collect()
}

/// What all bridges of a flow dropped, by reason.
fn dropped(flow: &FlowProcess) -> BTreeMap<String, u64> {
    let mut all = BTreeMap::new();
    for bridge in flow.bridges() {
        for (reason, count) in bridge["dropped"].as_object().into_iter().flatten() {
            *all.entry(reason.clone()).or_default() += count.as_u64().unwrap_or(0);
        }
    }
    all
}

fn start_broker(broker: &Broker, host: &Host) -> anyhow::Result<Server> {
    let host = Some(host.clone());
    let server = match broker.kind {
        BrokerKind::Redis => {
            RedisServer::start(RedisKind::Redis, RedisOptions { host, ..RedisOptions::default() })
                .map(Server::Redis)
        }
        BrokerKind::Kafka => {
            KafkaServer::start(KafkaOptions { host, ..KafkaOptions::default() }).map(Server::Kafka)
        }
    };
    server.with_context(|| broker.name)
}

/// As `blaze-probe --topic` wants it.
fn words(stream: &Stream) -> String {
    let reliability = if stream.reliable { "reliable" } else { "best_effort" };
    let Stream { topic, hz, bytes, lifespan, payloads, reliable: _ } = stream;
    let file = payloads.map(|file| format!(",@{file}")).unwrap_or_default();
    format!("{topic},{reliability},{hz},{bytes},{}{file}", lifespan.as_millis())
}

fn of_topic<'a>(row: &'a Value, topic: &str) -> &'a Value {
    let topics = row["topics"].as_array().map(Vec::as_slice).unwrap_or_default();
    topics.iter().find(|line| line["topic"] == topic).unwrap_or(&Value::Null)
}

fn sleep_until(at: Instant) {
    std::thread::sleep(at.saturating_duration_since(Instant::now()));
}
