//! Options of `blaze demo`.

use std::net::IpAddr;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use blaze_domain::node_file::MAX_DDS_DOMAIN;
use clap::{Args, ValueEnum};

use super::camera::Pictures;
use crate::exit::CliError;

/// Shortest and longest run.
const DURATION_RANGE: std::ops::RangeInclusive<Duration> =
    Duration::from_secs(1)..=Duration::from_secs(86_400);

/// Options of `blaze demo`.
#[derive(Debug, Clone, Args)]
pub struct DemoOptions {
    /// How long to run, once all nodes are ready: 30s, 2m, 1500ms
    #[arg(long, value_name = "TIME", default_value = "30s", value_parser = parse_duration)]
    pub duration: Duration,
    /// What services talk to on each node
    #[arg(long, value_enum, default_value_t = Brokers::Memory)]
    pub brokers: Brokers,
    /// Play these ROS 2 recordings (MCAP, CDR) instead of the built-in ones; with --only, name them
    /// in each process
    #[arg(long, value_name = "FILE.mcap", num_args = 1..)]
    pub record: Vec<PathBuf>,
    /// Run these nodes only; they find the others over DDS
    #[arg(long, value_enum, value_name = "NODE", value_delimiter = ',', num_args = 1)]
    pub only: Vec<DemoNode>,
    /// Show the topics on a ROS 2 network of this host, in cloud-1: ROS_DOMAIN_ID, 0 to 100.
    /// With --only, give it to the processes of robot-1 and cloud-1
    #[arg(long, value_name = "DOMAIN")]
    #[arg(value_parser = clap::value_parser!(u16).range(..=i64::from(MAX_DDS_DOMAIN)))]
    pub ros2: Option<u16>,
    /// Address that the nodes of this process listen on
    #[arg(long, value_name = "IP")]
    pub listen: Option<IpAddr>,
    /// Address of a process with other nodes; one on one side is enough
    #[arg(long, value_name = "IP")]
    pub peer: Vec<IpAddr>,
    /// Set a value of the node file, for example flow.bandwidth.limit_mbps=40
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<Setting>,
}

/// What services talk to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Brokers {
    /// Brokers within this process: nothing to install
    Memory,
    /// Redis and Kafka
    Real,
}

/// A node of the demo.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, ValueEnum)]
pub enum DemoNode {
    /// The robot: plays the recordings
    #[value(name = "robot-1")]
    Robot1,
    /// A second machine of the edge layer
    #[value(name = "edge-2")]
    Edge2,
    /// A server on the premises
    #[value(name = "fog-1")]
    Fog1,
    /// A server elsewhere
    #[value(name = "cloud-1")]
    Cloud1,
}

impl DemoNode {
    /// All nodes, in the order in which they are shown.
    pub const ALL: [Self; 4] = [Self::Robot1, Self::Edge2, Self::Fog1, Self::Cloud1];

    /// The node's name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Robot1 => "robot-1",
            Self::Edge2 => "edge-2",
            Self::Fog1 => "fog-1",
            Self::Cloud1 => "cloud-1",
        }
    }

    /// The layer that it stands in; its kind has the same word.
    #[must_use]
    pub fn layer(self) -> &'static str {
        match self {
            Self::Robot1 | Self::Edge2 => "edge",
            Self::Fog1 => "fog",
            Self::Cloud1 => "cloud",
        }
    }

    /// `layer/node`.
    #[must_use]
    pub fn flow(self) -> String {
        format!("{}/{}", self.layer(), self.name())
    }
}

/// One `--set`: a dotted key of the node file and a YAML value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Setting {
    /// Dotted key, for example `flow.bandwidth.limit_mbps`.
    pub key: String,
    /// YAML.
    pub value: String,
}

impl FromStr for Setting {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let (key, value) = text
            .split_once('=')
            .ok_or("it is KEY=VALUE, for example flow.bandwidth.limit_mbps=40")?;
        let allowed = |part: &str| {
            !part.is_empty()
                && part.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | '-'))
        };
        if !key.split('.').all(allowed) {
            return Err(format!(
                "{key:?} is no key: words joined by dots, for example flow.bandwidth.limit_mbps"
            ));
        }
        if matches!(key.split('.').next(), Some("layer" | "node")) {
            return Err(format!(
                "{key}: nodes have their names otherwise; the demo chooses among its own with \
                 --only, `blaze dev` has --layer and --node"
            ));
        }
        yaml_serde::from_str::<serde_json::Value>(value)
            .map_err(|error| format!("the value is no YAML: {error}"))?;
        Ok(Self { key: key.to_owned(), value: value.to_owned() })
    }
}

impl DemoOptions {
    /// The nodes that run in this process, in the order of [`DemoNode::ALL`].
    #[must_use]
    pub fn nodes(&self) -> Vec<DemoNode> {
        let wanted = |node: &DemoNode| self.only.is_empty() || self.only.contains(node);
        DemoNode::ALL.into_iter().filter(wanted).collect()
    }

    /// Whether all nodes run here.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.nodes().len() == DemoNode::ALL.len()
    }

    /// The form of pictures: ROS 2 nodes read messages alone.
    #[must_use]
    pub fn pictures(&self) -> Pictures {
        if self.ros2.is_some() { Pictures::Image } else { Pictures::Rgb }
    }

    /// Checks what the options mean together.
    ///
    /// # Errors
    /// [`CliError::Usage`] with a sentence for people.
    pub fn check(&self) -> Result<(), CliError> {
        let usage = |text: &str| Err(CliError::Usage(text.to_owned()));
        if let Some(address) =
            self.listen.iter().chain(&self.peer).find(|address| address.is_ipv6())
        {
            return Err(CliError::Usage(format!("{address}: DDS is carried over IPv4 only.")));
        }
        if self.listen.is_some_and(|address| address.is_unspecified()) {
            return usage("--listen: name the address of one interface, for example 10.0.1.1.");
        }
        let has_ros2 = |node: &DemoNode| matches!(node, DemoNode::Robot1 | DemoNode::Cloud1);
        if self.ros2.is_some() && !self.nodes().iter().any(has_ros2) {
            return usage(
                "--ros2: cloud-1 is on the ROS 2 network, and robot-1 plays for it; neither runs \
                 in this process.",
            );
        }
        Ok(())
    }
}

fn parse_duration(text: &str) -> Result<Duration, String> {
    let duration = crate::config::parse_duration(text)?;
    if DURATION_RANGE.contains(&duration) {
        Ok(duration)
    } else {
        Err("1 s to 24 h are allowed".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::{Command, tests};

    fn parse(line: &str) -> Result<DemoOptions, clap::Error> {
        match tests::parse(&format!("demo {line}"))?.command {
            Command::Demo(options) => Ok(options),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn defaults_are_those_of_the_contract() {
        let options = parse("").unwrap();
        assert_eq!(options.duration, Duration::from_secs(30));
        assert_eq!(options.brokers, Brokers::Memory);
        assert!(options.is_complete());
        options.check().unwrap();
    }

    #[test]
    fn all_options_are_read() {
        let options = parse(
            "--duration 1.5m --only robot-1,edge-2 --listen 10.0.1.1 --peer 10.0.3.1 --peer \
             10.0.4.1 \
             --set flow.bandwidth.limit_mbps=40 --ros2 7 --record a.mcap b.mcap",
        )
        .unwrap();
        assert_eq!(options.duration, Duration::from_secs(90));
        assert_eq!(options.nodes(), [DemoNode::Robot1, DemoNode::Edge2]);
        assert_eq!(options.peer.len(), 2);
        assert_eq!(options.record.len(), 2);
        assert_eq!((options.ros2, options.pictures()), (Some(7), Pictures::Image));
        assert_eq!(options.set[0].key, "flow.bandwidth.limit_mbps");
        options.check().unwrap();
    }

    #[test]
    fn bad_values_are_refused_with_a_reason() {
        for (line, why) in [
            ("--duration 0s", "1 s to 24 h"),
            ("--duration 3weeks", "not one of ms, s, m, h"),
            ("--duration 1e9", "not one of"),
            ("--only robot-9", "robot-1"),
            ("--set flow", "KEY=VALUE"),
            ("--set node.name=x", "--only"),
            ("--set flow..x=1", "is no key"),
            ("--set a.b=[1", "no YAML"),
            ("--listen here", "invalid IP"),
            ("--ros2 101", "0..=100"),
        ] {
            let error = parse(line).unwrap_err();
            assert!(error.to_string().contains(why), "{line:?}: {error}");
            assert_eq!(error.exit_code(), 2);
        }
    }

    #[test]
    fn bad_combinations_are_refused_with_a_reason() {
        for (line, why) in [
            ("--listen 0.0.0.0", "one interface"),
            ("--peer ::1", "IPv4 only"),
            ("--only fog-1 --ros2 3", "cloud-1"),
        ] {
            let error = parse(line).unwrap().check().unwrap_err();
            assert!(error.to_string().contains(why), "{line:?}: {error}");
            assert_eq!(error.exit() as u8, 2);
        }
    }
}
