//! The flows on the way, as processes of their own.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::Context;
use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::plain::{self, KafkaWriter};
use serde_json::json;

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
    /// `limit_mbps` of the flows.
    pub(crate) limit_mbps: f64,
}

/// Running flows; they end with this.
pub(crate) struct Flows {
    running: Vec<FlowProcess>,
}

impl Flows {
    /// Starts the flows, advertises and requests as plain clients do, and waits until the bridges
    /// are up.
    pub(crate) fn start(route: &Route<'_>) -> anyhow::Result<Self> {
        let specs = if route.two {
            let domain = free_domain()?;
            vec![
                FlowSpec::new("edge", "bench-robot")
                    .on_redis(route.redis, route.redis_prefix)
                    .joined(domain),
                FlowSpec::new("cloud", "bench-cloud")
                    .on_kafka(route.kafka, route.kafka_prefix)
                    .joined(domain),
            ]
        } else {
            vec![
                FlowSpec::new("cloud", "bench-cloud")
                    .on_redis(route.redis, route.redis_prefix)
                    .on_kafka(route.kafka, route.kafka_prefix),
            ]
        };
        let limited = |spec| FlowSpec {
            limit_mbps: route.limit_mbps,
            extra: "log: { level: warn }\n".to_owned(),
            ..spec
        };
        let mut running = Vec::new();
        for spec in specs {
            running.push(FlowProcess::launch(limited(spec))?);
        }
        for flow in &mut running {
            flow.wait_ready()?;
        }
        let flows = Self { running };
        flows.connect(route)?;
        Ok(flows)
    }

    fn connect(&self, route: &Route<'_>) -> anyhow::Result<()> {
        let terms = json!({
            "topic": route.topic,
            "service": "bench",
            "reliability": "reliable",
            "ttl_s": 0,
        });
        let lease = |op: &str| {
            let mut lease = terms.clone();
            lease["op"] = json!(op);
            lease
        };
        let mut advertise = lease("advertise");
        advertise["max_bytes"] = json!(route.bytes);
        if let Some(rate) = route.rate_hz {
            advertise["rate_hz"] = json!(rate);
        }
        plain::tell_redis(route.redis, route.redis_prefix, &advertise)?;
        plain::tell_kafka(&KafkaWriter::new(route.kafka)?, route.kafka_prefix, &lease("request"))?;
        for flow in &self.running {
            flow.wait_bridge(route.topic, Duration::from_secs(20))?;
        }
        Ok(())
    }

    /// What the flows dropped, by reason; empty if nothing.
    pub(crate) fn dropped(&self) -> anyhow::Result<String> {
        let mut reasons: BTreeMap<String, f64> = BTreeMap::new();
        for flow in &self.running {
            let (_, metrics) = flow.admin().get("/metrics")?;
            for line in metrics.lines().filter(|line| line.starts_with("blaze_flow_dropped_total{"))
            {
                let (labels, value) = line.rsplit_once(' ').context("a metric without a value")?;
                let (_, reason) =
                    labels.split_once("reason=\"").context("a metric without a reason")?;
                *reasons.entry(reason.trim_end_matches(['"', '}']).to_owned()).or_default() +=
                    value.parse::<f64>()?;
            }
        }
        reasons.retain(|_, count| *count > 0.0);
        let texts: Vec<String> =
            reasons.iter().map(|(reason, count)| format!("{reason} {count}")).collect();
        Ok(texts.join(", "))
    }

    /// CPU time that the flows have used, all of them together.
    pub(crate) fn cpu(&self) -> anyhow::Result<Duration> {
        self.running.iter().map(FlowProcess::cpu).sum()
    }
}
