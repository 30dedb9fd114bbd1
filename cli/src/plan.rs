//! `blaze plan`: the rate that each topic would get at each destination. It uses the allocator of a
//! running flow with the configured limits only: measured link capacity and wire overhead are not
//! known here (`--wire-factor` gives the latter).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use blaze_domain::node_file::{
    BandwidthSection, FlowSection, FlowSource, PlanFile, PlannedClass, PlannedFlow, PlannedTopic,
};
use blaze_domain::{FlowId, LayerName};
use blaze_flow::limit::allocate::Class;
use blaze_flow::limit::rates::{Budgets, Demand, LaneDemand, Rates, rates, terms};
use blaze_runtime::config::{Sources, load_typed, schema};
use clap::Args;
use serde_json::{Value, json};

use crate::exit::{CliError, Exit, lines};
use crate::node_file;
use crate::output::{self, Align, Format, number, terminal_width};

/// Options of `blaze plan`.
#[derive(Debug, Args)]
pub struct PlanOptions {
    /// Flows and their topics (YAML)
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Measured wire bytes per calculated byte (`wire_factor` in /v1/allocation of a running flow);
    /// 1: no correction
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = parse_factor)]
    pub wire_factor: f64,
}

fn parse_factor(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(factor) if (0.01..=500.0).contains(&factor) => Ok(factor),
        _ => Err("a number from 0.01 to 500".to_owned()),
    }
}

/// `blaze plan`.
///
/// # Errors
/// [`CliError::Invalid`] with every fault of the plan or of a node file that it names.
pub fn run(options: &PlanOptions, format: Format) -> Result<Exit, CliError> {
    let plan = read(&options.file)?;
    let beside = options.file.parent().unwrap_or(Path::new(""));
    let mut planned = Vec::with_capacity(plan.flows.len());
    let mut seen = BTreeMap::new();
    for (at, flow) in plan.flows.iter().enumerate() {
        let planned_flow = Planned::new(flow, beside, options.wire_factor).map_err(|detail| {
            CliError::Invalid(format!("{}: flows[{at}]: {detail}", options.file.display()))
        })?;
        if let Some(before) = seen.insert(planned_flow.flow.clone(), at) {
            return Err(CliError::Invalid(format!(
                "{}: flows[{at}]: is {}, as flows[{before}] is",
                options.file.display(),
                planned_flow.flow
            )));
        }
        planned.push(planned_flow);
    }
    let value = json!({
        "links": planned.iter().flat_map(Planned::links).collect::<Vec<_>>(),
        "flows": planned.iter().map(Planned::allocation).collect::<Vec<_>>(),
    });
    let text = output::format_object(&value, format, |_| Ok(table(&planned, terminal_width())))?;
    output::print(&text)?;
    Ok(Exit::Done)
}

fn read(file: &Path) -> Result<PlanFile, CliError> {
    let schema = schema(|tree| PlanFile::read(tree).map(|plan| (plan, Vec::new())));
    load_typed(&Sources::of_file(file), &schema)
        .map(|loaded| loaded.value)
        .map_err(|faults| CliError::Invalid(format!("the plan has faults:\n  {}", lines(&faults))))
}

/// One flow with its rates.
struct Planned {
    flow: FlowId,
    bandwidth: BandwidthSection,
    topics: Vec<PlannedTopic>,
    rates: Rates,
    wire_factor: f64,
}

impl Planned {
    fn new(planned: &PlannedFlow, beside: &Path, wire_factor: f64) -> Result<Self, String> {
        let (flow, section) = match &planned.source {
            FlowSource::Inline { flow, bandwidth } => {
                let section =
                    FlowSection { bandwidth: (**bandwidth).clone(), ..FlowSection::default() };
                (flow.clone(), section)
            }
            FlowSource::NodeFile(path) => {
                let path = beside.join(path);
                let file = node_file::read(&Sources::of_file(&path))?;
                let flow = file
                    .flow_id()
                    .ok_or_else(|| format!("{} has no layer or no node", path.display()))?;
                (flow, file.flow)
            }
        };
        let topics: Vec<PlannedTopic> =
            planned.topics.iter().map(|topic| with_rules(topic, &section)).collect();
        let bandwidth = section.bandwidth;
        let demands: Vec<Demand<'_>> = topics.iter().map(demand).collect();
        let budgets = Budgets {
            process: bandwidth.limit_bytes_per_s() / wire_factor,
            links: bandwidth
                .links
                .keys()
                .filter_map(|layer| {
                    Some((layer.clone(), bandwidth.link_limit_bytes_per_s(layer)? / wire_factor))
                })
                .collect(),
            ..Budgets::default()
        };
        let rates = rates(&budgets, &terms(&bandwidth), &demands);
        Ok(Self { flow, bandwidth, topics, rates, wire_factor })
    }

    /// What the link to a layer may carry: its own limit, else that of the process.
    fn limit(&self, layer: &LayerName) -> f64 {
        let process = self.bandwidth.limit_bytes_per_s();
        self.bandwidth.link_limit_bytes_per_s(layer).map_or(process, |own| own.min(process))
    }

    fn load(&self, layer: &LayerName) -> f64 {
        self.rates.load_bytes_per_s.get(layer).copied().unwrap_or(0.0) * self.wire_factor
    }

    fn links(&self) -> Vec<Value> {
        let layers = self.rates.load_bytes_per_s.keys();
        layers
            .map(|layer| {
                let (load, limit) = (self.load(layer), self.limit(layer));
                json!({
                    "from": self.flow, "to": layer, "load_bytes_per_s": load,
                    "limit_bytes_per_s": limit,
                    "utilisation": load / limit,
                })
            })
            .collect()
    }

    /// As `/v1/allocation` of the running flow would say it; what only a running flow knows is
    /// null.
    fn allocation(&self) -> Value {
        let topic = |(topic, rates): (&PlannedTopic, &blaze_flow::limit::rates::TopicRates)| {
            let lane = |(lane, hz): (&blaze_domain::node_file::PlannedLane, &f64)| {
                json!({
                    "layer": lane.layer,
                    "allocated_hz": hz,
                    "actual_hz": null,
                    "skipped": null,
                })
            };
            json!({
                "topic": topic.topic, "class": rates.class.as_str(), "size_bytes": topic.bytes,
                "advertised_hz": advertised_hz(topic),
                "lanes": topic.lanes.iter().zip(&rates.lanes_hz).map(lane).collect::<Vec<_>>(),
            })
        };
        let link = |layer: &LayerName| {
            json!({
                "layer": layer, "limit_bytes_per_s": self.bandwidth.link_limit_bytes_per_s(layer),
                "wire_bytes_per_s": self.load(layer),
            })
        };
        json!({
            "flow": self.flow, "limit_mbps": self.bandwidth.limit_mbps,
            "budget_bytes_per_s": self.bandwidth.limit_bytes_per_s(), "measured_bytes_per_s": null,
            "wire_factor": self.wire_factor, "feasible": self.rates.feasible,
            "topics": self.topics.iter().zip(&self.rates.topics).map(topic).collect::<Vec<_>>(),
            "links": self.rates.load_bytes_per_s.keys().map(link).collect::<Vec<_>>(),
        })
    }
}

/// The operator's word: a rule may lower the rate of a topic.
fn with_rules(topic: &PlannedTopic, section: &FlowSection) -> PlannedTopic {
    let mut topic = topic.clone();
    if let Some(most) = section.topic(&topic.topic).max_rate_hz {
        for lane in &mut topic.lanes {
            lane.max_rate_hz = Some(lane.max_rate_hz.map_or(most, |asked| asked.min(most)));
        }
    }
    topic
}

fn advertised_hz(topic: &PlannedTopic) -> f64 {
    topic.rate_hz * f64::from(topic.writers)
}

fn demand(topic: &PlannedTopic) -> Demand<'_> {
    Demand {
        topic: topic.topic.as_str(),
        size_bytes: topic.bytes.into(),
        advertised_hz: advertised_hz(topic),
        class: match topic.class {
            PlannedClass::Auto => None,
            PlannedClass::Standard => Some(Class::Standard),
            PlannedClass::Large => Some(Class::Large),
        },
        lanes: topic
            .lanes
            .iter()
            .map(|lane| LaneDemand {
                layer: &lane.layer,
                receiver: None,
                max_rate_hz: lane.max_rate_hz,
            })
            .collect(),
    }
}

fn table(planned: &[Planned], width: Option<u16>) -> String {
    let mut text = String::new();
    for flow in planned {
        text.push_str(&format!(
            "flow {}: limit {} Mbit/s of 1024² bit, {}/s{}\n",
            flow.flow,
            flow.bandwidth.limit_mbps,
            output::bytes(flow.bandwidth.limit_bytes_per_s()),
            if flow.rates.feasible { "" } else { "; NOT feasible" },
        ));
        text.push_str(&lanes(flow, width));
        for layer in flow.rates.load_bytes_per_s.keys() {
            let (load, limit) = (flow.load(layer), flow.limit(layer));
            let own = if flow.rates.infeasible_links.contains(layer) {
                "; its own limit is not kept"
            } else {
                ""
            };
            text.push_str(&format!(
                "link to {layer}: {}/s of {}/s, {:.1} %{own}\n",
                output::bytes(load),
                output::bytes(limit),
                100.0 * load / limit,
            ));
        }
        text.push('\n');
    }
    text
}

fn lanes(flow: &Planned, width: Option<u16>) -> String {
    let topics = flow.topics.iter().zip(&flow.rates.topics);
    let lanes: Vec<_> = topics
        .flat_map(|(topic, rates)| {
            let lanes = topic.lanes.iter().zip(&rates.lanes_hz);
            lanes.map(move |(lane, hz)| (topic, rates.class, lane, *hz))
        })
        .collect();
    output::table(
        &lanes,
        width,
        &[
            ("TOPIC", Align::Left, &|(topic, ..)| topic.topic.to_string()),
            ("CLASS", Align::Left, &|(_, class, ..)| class.as_str().to_owned()),
            ("BYTES", Align::Right, &|(topic, ..)| topic.bytes.to_string()),
            ("ADVERTISED/Hz", Align::Right, &|(topic, ..)| number(Some(advertised_hz(topic)), 2)),
            ("TO", Align::Left, &|(_, _, lane, _)| lane.layer.to_string()),
            ("ASKED/Hz", Align::Right, &|(_, _, lane, _)| number(lane.max_rate_hz, 2)),
            ("ALLOCATED/Hz", Align::Right, &|(.., hz)| number(Some(*hz), 2)),
        ],
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan_of(yaml: &str) -> Result<Vec<Planned>, String> {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("plan.yaml");
        std::fs::write(&file, yaml).unwrap();
        let node_file = "layer: {name: edge, kind: edge}\nnode: {name: robot-1}\nflow: {bandwidth: {limit_mbps: 8}, topics: [{match: 'camera/**', max_rate_hz: 1}]}\n";
        std::fs::write(folder.path().join("robot-1.yaml"), node_file).unwrap();
        let plan = read(&file).map_err(|error| error.to_string())?;
        plan.flows.iter().map(|flow| Planned::new(flow, folder.path(), 1.0)).collect()
    }

    /// With compression a running flow shows less than 1; headers of small messages make it many.
    #[test]
    fn any_wire_factor_that_a_flow_shows_can_be_given() {
        for (text, holds) in [
            ("0.56", true),
            ("0.01", true),
            ("500", true),
            ("0", false),
            ("nan", false),
            ("501", false),
        ] {
            assert_eq!(parse_factor(text).is_ok(), holds, "{text}");
        }
    }

    /// 160 Mbit/s, a camera of 30 Hz with images of 0.7 MB after compression, and an IMU.
    #[test]
    fn the_example_of_the_documentation_comes_out_as_printed() {
        let planned = plan_of(
            "flows:\n- layer: edge\n  node: robot-1\n  bandwidth: {limit_mbps: 160}\n  topics:\n  - {topic: imu/data, rate_hz: 49.17, bytes: 400, lanes: [{layer: fog}, {layer: cloud}]}\n  - {topic: camera/image_raw, rate_hz: 30, bytes: 700000, lanes: [{layer: fog, max_rate_hz: 10}, {layer: cloud}]}\n",
        )
        .unwrap();
        let value = planned[0].allocation();
        assert_eq!(value["feasible"], true);
        assert_eq!(value["topics"][0]["lanes"][1]["allocated_hz"], 49.17);
        let lanes = &value["topics"][1]["lanes"];
        assert_eq!(lanes[0]["allocated_hz"], 10.0);
        // β · 20,971,520 B/s are 27.9 images of 714,000 B: ten of them go to the fog.
        let cloud = lanes[1]["allocated_hz"].as_f64().unwrap();
        assert!((cloud - (0.95 * 20_971_520.0 / 714_000.0 - 10.0)).abs() < 1e-9, "{cloud}");
        let links = planned[0].links();
        let load: f64 = links.iter().map(|link| link["load_bytes_per_s"].as_f64().unwrap()).sum();
        assert!(load <= 20_971_520.0, "{load}");
    }

    #[test]
    fn rules_of_a_node_file_hold_in_the_plan() {
        let planned =
            plan_of("flows:\n- node_file: robot-1.yaml\n  topics:\n  - {topic: camera/a, rate_hz: 30, bytes: 70000, lanes: [{layer: fog}]}\n")
                .unwrap();
        assert_eq!(planned[0].flow.to_string(), "edge/robot-1");
        assert_eq!(planned[0].rates.topics[0].lanes_hz, [1.0]);
        assert!(
            table(&planned, None).contains("link to fog: 69.7 KiB/s of 1.0 MiB/s, 6.8 %"),
            "{}",
            table(&planned, None)
        );
    }

    #[test]
    fn faults_come_with_file_and_line() {
        let error =
            plan_of("flows:\n- layer: edge\n  node: a\n  topics:\n  - {topic: imu, rate_hz: x, bytes: 1, lanes: []}\n")
                .err()
                .unwrap();
        assert!(
            error.contains("plan.yaml:5: flows[0].topics[0].rate_hz: expected a number"),
            "{error}"
        );
        let missing = plan_of("flows: [{node_file: none.yaml, topics: []}]").err().unwrap();
        assert!(missing.contains("none.yaml") && missing.contains("cannot be opened"), "{missing}");
    }
}
