//! Commands and options.

use std::fmt;
use std::str::FromStr;

use blaze_domain::{LayerName, NodeName, ServiceName, TopicName};
use clap::{Args, Parser, Subcommand};

use crate::admin::TopOptions;
use crate::config::{ConfigCommand, ServerOptions};
use crate::demo::options::DemoOptions;
use crate::dev::options::DevOptions;
use crate::doctor::DoctorOptions;
use crate::local::{CallOptions, EchoOptions, HzOptions, PublishOptions};
use crate::monitor::{LatencyOptions, PingOptions, ProblemsOptions};
use crate::output::Output;
use crate::plan::PlanOptions;

/// Joins robots, fog and cloud: see what flows, and why something does not.
#[derive(Debug, Parser)]
#[command(
    name = "blaze",
    version,
    propagate_version = true,
    arg_required_else_help = true,
    max_term_width = 110
)]
pub struct Arguments {
    /// How results are printed
    #[arg(short, long, global = true, value_enum, default_value_t = Output::Table)]
    pub output: Output,
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// One command.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Topics that a flow knows: who publishes, who asks, whether it flows
    Topics(FlowTarget),
    /// Bridges of a flow: what it carries from where to where
    Bridges(FlowTarget),
    /// Other flows that a flow sees
    Peers(FlowTarget),
    /// Endpoints of a flow's ROS 2 network, and why one is not bridged
    Ros2(FlowTarget),
    /// What each lane carries beside what it was allocated, once a second; or the nodes of the
    /// system, or the topics or bridges of a flow
    Top(TopOptions),
    /// Why a topic does or does not arrive; exits with 0 if it flows
    Why(WhyOptions),
    /// Latency and clock of other nodes, as the monitor of this node sees them
    Ping(PingOptions),
    /// Latency of a topic's messages, as the monitor of this node measures it
    Latency(LatencyOptions),
    /// What is wrong on this node, or with --server in the whole system, and what to do
    Problems(ProblemsOptions),
    /// The rate that each topic would get at each destination, from a file of flows and topics
    Plan(PlanOptions),
    /// What is wrong with this node, and what to do: node file, ports, brokers, network, clock, peers,
    /// tokens, disk, …; exits with 1 if a check fails
    Doctor(DoctorOptions),
    /// Publish on a topic, as a service on the local broker
    Pub(PublishOptions),
    /// Print the messages of a topic, as a service on the local broker
    Echo(EchoOptions),
    /// The rate at which a topic arrives, once a second
    Hz(HzOptions),
    /// Call a ROS 2 service, through the flow on the local broker
    Call(CallOptions),
    /// Robot, fog and cloud in one process, with recorded data
    Demo(DemoOptions),
    /// Main service, worker, flow and broker of one node in one process, for developing services:
    /// loopback, no tokens
    Dev(Box<DevOptions>),
    /// Commands of the configuration.
    #[command(flatten)]
    Config(Box<ConfigCommand>),
    /// Completions for a shell, on standard output
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

/// Which flow to ask.
#[derive(Debug, Args)]
pub struct FlowTarget {
    /// Admin port of the flow
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:9101")]
    pub flow: FlowAddress,
}

/// Options of `blaze why`.
#[derive(Debug, Args)]
pub struct WhyOptions {
    /// The topic, for example imu/data
    #[arg(value_parser = parse_topic)]
    pub topic: TopicName,
    /// Where it should arrive
    #[arg(long, value_name = "LAYER[/NODE[/SERVICE]]")]
    pub to: Option<Destination>,
    /// Where it is published; with --server alone
    #[arg(long, value_name = "LAYER[/NODE[/SERVICE]]")]
    pub from: Option<Destination>,
    /// Which flow to ask.
    #[command(flatten)]
    pub target: FlowTarget,
    /// Ask the main service instead, which asks the flows of both ends.
    #[command(flatten)]
    pub server: ServerOptions,
}

pub(crate) fn parse_topic(text: &str) -> Result<TopicName, String> {
    text.parse().map_err(|error| {
        let trimmed = text.trim_matches('/');
        match trimmed.parse::<TopicName>() {
            Ok(meant) if trimmed != text => format!("{error}; did you mean {meant}?"),
            _ => format!("{error}"),
        }
    })
}

pub(crate) fn parse_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.1..=3600.0).contains(&seconds) => Ok(seconds),
        _ => Err("it is 0.1 to 3600 seconds".to_owned()),
    }
}

/// Host and port of an admin port.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FlowAddress {
    /// Name or address; IPv6 without brackets.
    pub host: String,
    /// TCP port, 1 to 65535.
    pub port: u16,
}

impl fmt::Display for FlowAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.host.contains(':') {
            write!(f, "[{}]:{}", self.host, self.port)
        } else {
            write!(f, "{}:{}", self.host, self.port)
        }
    }
}

impl From<std::net::SocketAddr> for FlowAddress {
    fn from(address: std::net::SocketAddr) -> Self {
        Self { host: address.ip().to_string(), port: address.port() }
    }
}

impl FromStr for FlowAddress {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        Self::parse(text, 9101)
    }
}

impl FlowAddress {
    /// Reads an address; the port is the one that is suggested where there is none.
    ///
    /// # Errors
    /// In words.
    pub(crate) fn parse(text: &str, usual: u16) -> Result<Self, String> {
        let bare = text.strip_prefix("http://").unwrap_or(text).trim_end_matches('/');
        let (host, port) = bare
            .rsplit_once(':')
            .ok_or_else(|| format!("it needs a port; did you mean {bare}:{usual}?"))?;
        let host = match host.strip_prefix('[') {
            Some(rest) => rest.strip_suffix(']').ok_or("the bracket is not closed")?,
            None if host.contains(':') => {
                return Err(format!("an IPv6 address stands in brackets: [{bare}]:{usual}"));
            }
            None => host,
        };
        let allowed =
            |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | ':' | '_' | '%');
        if host.is_empty() || !host.chars().all(allowed) {
            return Err(format!("{host:?} is no host"));
        }
        match port.parse() {
            Ok(port) if port > 0 => Ok(Self { host: host.to_owned(), port }),
            _ => Err(format!("{port:?} is no port: 1 to 65535")),
        }
    }
}

/// A layer, a node of it, or a service of that node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Destination(String);

impl FromStr for Destination {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let mut parts = text.split('/');
        let layer = parts.next().unwrap_or_default();
        layer.parse::<LayerName>().map_err(|error| format!("layer {layer:?} {error}"))?;
        if let Some(node) = parts.next() {
            node.parse::<NodeName>().map_err(|error| format!("node {node:?} {error}"))?;
        }
        if let Some(service) = parts.next() {
            service
                .parse::<ServiceName>()
                .map_err(|error| format!("service {service:?} {error}"))?;
        }
        if parts.next().is_some() {
            return Err("more than layer, node and service".to_owned());
        }
        Ok(Self(text.to_owned()))
    }
}

impl fmt::Display for Destination {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::admin::View;
    use clap::CommandFactory as _;

    pub(crate) fn parse(line: &str) -> Result<Arguments, clap::Error> {
        Arguments::try_parse_from(["blaze"].into_iter().chain(line.split_whitespace()))
    }

    pub(crate) fn config(line: &str) -> Result<ConfigCommand, clap::Error> {
        match parse(line)?.command {
            Command::Config(command) => Ok(*command),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_definition_is_sound() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn slips_get_a_suggestion() {
        for (line, meant) in [
            ("topcis", "'topics'"),
            ("why /imu/data", "did you mean imu/data?"),
            ("aply -f a", "'apply'"),
            ("get servces", "did you mean services?"),
            ("watch instnace", "did you mean instance?"),
            ("token create --subject s --role operater", "operator"),
            ("effective SLAM", "did you mean slam?"),
        ] {
            let error = parse(line).unwrap_err();
            assert!(error.to_string().contains(meant), "{line}: {error}");
            assert_eq!(error.exit_code(), 2, "{line}");
        }
    }

    #[test]
    fn the_output_format_may_stand_anywhere() {
        for line in ["-o json why imu/data", "why imu/data -o json"] {
            assert_eq!(parse(line).unwrap().output, Output::Json);
        }
    }

    #[test]
    fn top_shows_lanes_unless_a_word_says_otherwise() {
        for (line, view) in [
            ("top --interval 2 --count 1", None),
            ("top nodes --server http://127.0.0.1:1", Some(View::Nodes)),
            ("top topics --flow a:1", Some(View::Topics)),
            ("top bridges", Some(View::Bridges)),
        ] {
            let Command::Top(options) = parse(line).unwrap().command else { panic!("{line}") };
            assert_eq!(options.view, view, "{line}");
        }
        assert!(parse("top lanes").unwrap_err().to_string().contains("[possible values: nodes"));
    }

    #[test]
    fn addresses_are_checked() {
        for (good, host, port) in [
            ("localhost:1", "localhost", 1),
            ("[::1]:9101", "::1", 9101),
            ("http://10.0.0.1:80/", "10.0.0.1", 80),
        ] {
            let address: FlowAddress = good.parse().unwrap();
            assert_eq!((address.host.as_str(), address.port), (host, port));
        }
        for (bad, why) in [
            ("localhost", "did you mean localhost:9101?"),
            ("a:0", "is no port"),
            (":1", "is no host"),
            ("a b:1", "is no host"),
            ("::1:9101", "in brackets"),
            ("[::1:9101", "not closed"),
        ] {
            let error = bad.parse::<FlowAddress>().unwrap_err();
            assert!(error.contains(why), "{bad}: {error}");
        }
    }

    #[test]
    fn destinations_are_checked() {
        for good in ["cloud", "cloud/cloud-1", "cloud/cloud-1/recorder"] {
            assert_eq!(good.parse::<Destination>().unwrap().to_string(), good);
        }
        for bad in ["", "cloud/", "cloud/a/b/c", "Cloud", "cloud/a b"] {
            assert!(bad.parse::<Destination>().is_err(), "{bad}");
        }
    }
}
