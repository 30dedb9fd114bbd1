//! The flows on the way, as processes of their own.

use std::time::Duration;

use anyhow::Context;
use blaze_tests::admin::Admin;
use blaze_tests::process::Process;
use blaze_tests::wait;
use rdkafka::ClientConfig;
use rdkafka::producer::{BaseProducer, BaseRecord, Producer as _};

/// From where to where.
pub(crate) struct Route<'a> {
    pub(crate) two: bool,
    pub(crate) redis: &'a str,
    pub(crate) redis_prefix: &'a str,
    pub(crate) kafka: &'a str,
    pub(crate) kafka_prefix: &'a str,
    pub(crate) topic: &'a str,
    pub(crate) rate_hz: Option<f64>,
    pub(crate) bytes: usize,
}

/// Running flows; they end with this.
pub(crate) struct Flows {
    running: Vec<(Process, Admin)>,
    _files: tempfile::TempDir,
}

impl Flows {
    /// Starts the flows, advertises and requests as plain clients do, and waits until the bridges are up.
    pub(crate) fn start(route: &Route<'_>) -> anyhow::Result<Self> {
        let files = tempfile::tempdir()?;
        let domain = 40 + std::process::id() % 60;
        let node = format!("node: {{ redis: {{ url: \"{}\", prefix: \"{}\" }} }}", route.redis, route.redis_prefix);
        let layer = format!(
            "layer: {{ kafka: {{ bootstrap: [\"{}\"], prefix: \"{}\" }} }}",
            route.kafka, route.kafka_prefix
        );
        let inter = format!("inter: {{ dds: {{ domain: {domain}, listen: \"127.0.0.1\", peers: [\"127.0.0.1\"] }} }}");
        let nodes = if route.two {
            vec![
                ("edge", "bench-robot", vec![node, inter.clone()]),
                ("cloud", "bench-cloud", vec![layer, inter]),
            ]
        } else {
            vec![("cloud", "bench-cloud", vec![node, layer])]
        };
        let mut running = Vec::new();
        for (kind, name, brokers) in nodes {
            let text = format!(
                "layer: {{ name: {kind}, kind: {kind} }}\nnode: {{ name: {name} }}\nbrokers:\n  {}\nadmin: {{ flow: \"127.0.0.1:0\" }}\n\
                 flow: {{ bandwidth: {{ limit_mbps: 20000 }} }}\nlog: {{ level: warn }}\nstate_dir: {}\n",
                brokers.join("\n  "),
                files.path().display()
            );
            let path = files.path().join(format!("{name}.yaml"));
            std::fs::write(&path, text)?;
            let process = Process::start("blaze-flow", &["--config", &path.to_string_lossy()], None)?;
            let line = wait::until_some(
                "the flow is ready",
                Duration::from_secs(30),
                || process.stdout().into_iter().find(|line| line.starts_with("ready ")),
                || process.tail(),
            )?;
            let address = line.split("admin=").nth(1).context("no admin= in the ready line")?;
            let address = address.split_whitespace().next().unwrap_or_default().parse()?;
            running.push((
                process,
                Admin {
                    address,
                    namespace: None,
                },
            ));
        }
        let flows = Self {
            running,
            _files: files,
        };
        flows.connect(route)?;
        Ok(flows)
    }

    fn connect(&self, route: &Route<'_>) -> anyhow::Result<()> {
        let rate = route.rate_hz.map_or(String::new(), |rate| format!("\"rate_hz\":{rate},"));
        let advertise = format!(
            "{{\"op\":\"advertise\",\"topic\":\"{}\",\"service\":\"bench-source\",{rate}\"max_bytes\":{},\"reliability\":\"reliable\",\"ttl_s\":0}}",
            route.topic, route.bytes
        );
        let mut redis = redis::Client::open(route.redis)?.get_connection()?;
        redis::cmd("PUBLISH")
            .arg(format!("{}blaze/flow/control", route.redis_prefix))
            .arg(advertise)
            .exec(&mut redis)?;
        let request = format!(
            "{{\"op\":\"request\",\"topic\":\"{}\",\"service\":\"bench-sink\",\"reliability\":\"reliable\",\"ttl_s\":0}}",
            route.topic
        );
        let producer: BaseProducer = ClientConfig::new().set("bootstrap.servers", route.kafka).create()?;
        let control = format!("{}blaze.flow.control", route.kafka_prefix);
        producer
            .send(BaseRecord::<'_, (), str>::to(&control).payload(&request))
            .map_err(|(error, _)| error)?;
        producer.flush(Duration::from_secs(10))?;
        for (process, admin) in &self.running {
            let up = || {
                let answer = admin.json("/v1/bridges").unwrap_or_default();
                let bridges = answer["bridges"].as_array().cloned().unwrap_or_default();
                bridges.iter().any(|bridge| bridge["topic"] == route.topic && bridge["state"] == "up")
            };
            wait::until("the bridges are up", Duration::from_secs(20), up, || process.tail())?;
        }
        Ok(())
    }

    /// CPU time that the flows have used, all of them together.
    pub(crate) fn cpu(&self) -> anyhow::Result<Duration> {
        self.running.iter().map(|(process, _)| cpu_of(process.id())).sum()
    }
}

fn cpu_of(pid: u32) -> anyhow::Result<Duration> {
    // CLK_TCK is 100 on every Linux that Rust runs on.
    const TICKS_PER_S: f64 = 100.0;
    let text = std::fs::read_to_string(format!("/proc/{pid}/stat"))?;
    let after_name = text.rsplit_once(')').context("no name in /proc/PID/stat")?.1;
    let fields: Vec<&str> = after_name.split_whitespace().collect();
    let ticks = |index: usize| -> anyhow::Result<f64> { Ok(fields.get(index).context("a short line")?.parse::<u64>()? as f64) };
    Ok(Duration::from_secs_f64((ticks(11)? + ticks(12)?) / TICKS_PER_S))
}
