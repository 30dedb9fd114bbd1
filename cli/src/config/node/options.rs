//! Options of `blaze node join`.

use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use blaze_domain::config::spec::NodeType;
use blaze_domain::{LayerName, NodeName};
use clap::Args;
use reqwest::Url;
use serde_json::{Value, json};

use crate::config::options::ServerOptions;
use crate::config::token::{SigningOptions, parse_life};

/// Where the programs of a node keep their state unless something else is said.
const STATE_DIR: &str = "/var/lib/blaze";

/// Options of `blaze node join`.
#[derive(Debug, Args)]
pub struct JoinOptions {
    /// Name of the node, unique in the whole system
    #[arg(value_name = "NAME")]
    pub name: NodeName,
    /// Layer that it stands in; the Layer document must be there
    #[arg(long, value_name = "LAYER")]
    pub layer: LayerName,
    /// What it is: static, gateway (it connects others) or mobile (it moves); a new node is static
    /// where nothing is said
    #[arg(long = "type", value_name = "TYPE")]
    pub node_type: Option<NodeType>,
    /// Its address, may be repeated; the first IPv4 address is that of its interface for other
    /// layers and its own
    #[arg(long = "address", value_name = "IP")]
    pub addresses: Vec<std::net::IpAddr>,
    /// A label of the document, may be repeated; others that it has stay
    #[arg(long = "label", value_name = "KEY=VALUE", value_parser = parse_label)]
    pub labels: Vec<(String, String)>,
    /// Only say what would be done, and print the node file
    #[arg(long)]
    pub dry_run: bool,

    /// Where the token goes (mode 0600), or - for standard output; else NAME.token. One that is
    /// there is kept
    #[arg(long, value_name = "FILE|-", help_heading = "Token")]
    pub token_out: Option<PathBuf>,
    /// Make a new token in place of the one in the file
    #[arg(long, help_heading = "Token", conflicts_with = "no_token")]
    pub renew: bool,
    /// How long the token lives, at most 365d
    #[arg(long, value_name = "DURATION", default_value = "90d", value_parser = parse_life,
        help_heading = "Token")]
    pub expires: Duration,
    /// No token: the main service runs with --dev
    #[arg(long, help_heading = "Token", conflicts_with_all = ["token_out", "key_file"])]
    pub no_token: bool,
    /// Who signs it.
    #[command(flatten)]
    pub signing: SigningOptions,

    /// Where the node file goes instead of standard output; one that is there and says something
    /// else is left alone
    #[arg(long, value_name = "FILE", help_heading = "Node file")]
    pub node_file: Option<PathBuf>,
    /// gRPC port of the main service as the node reaches it; else the host of --server with port
    /// 50051
    #[arg(long, value_name = "URL", help_heading = "Node file")]
    pub grpc: Option<Url>,
    /// Path of the token on the node; else that of --token-out on this machine
    #[arg(long, value_name = "PATH", help_heading = "Node file")]
    pub token_path: Option<PathBuf>,
    /// Path of the authorities (PEM) on the node; else that of --ca-file on this machine
    #[arg(long, value_name = "PATH", help_heading = "Node file")]
    pub ca_path: Option<PathBuf>,
    /// Path of the worker's own certificate (PEM) on the node, for a server with tls.client_ca_file
    #[arg(long, value_name = "PATH", requires = "key_path", help_heading = "Node file")]
    pub cert_path: Option<PathBuf>,
    /// Path of its key on the node
    #[arg(long, value_name = "PATH", requires = "cert_path", help_heading = "Node file")]
    pub key_path: Option<PathBuf>,
    /// Redis of the node (redis://…), memory or none; else on an edge node redis://127.0.0.1:6379
    #[arg(long, value_name = "BROKER", help_heading = "Node file")]
    pub node_broker: Option<NodeBrokerChoice>,
    /// kafka:HOST:PORT[,HOST:PORT…], dds:DOMAIN, memory or none; else dds:10 on an edge node with
    /// an address, kafka:127.0.0.1:9092 in fog and cloud
    #[arg(long, value_name = "BROKER", help_heading = "Node file")]
    pub layer_broker: Option<LayerBrokerChoice>,
    /// DDS domain of the way to other layers, the same for all nodes
    #[arg(long, value_name = "DOMAIN", default_value_t = 20, help_heading = "Node file")]
    pub inter_domain: u16,
    /// Address of a node of another layer, may be repeated; one on one side is enough
    #[arg(long = "peer", value_name = "IP", help_heading = "Node file")]
    pub peers: Vec<Ipv4Addr>,
    /// Where the programs of the node keep their state
    #[arg(long, value_name = "PATH", default_value = STATE_DIR, help_heading = "Node file")]
    pub state_dir: PathBuf,

    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// The broker of the node scope.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NodeBrokerChoice {
    /// There is none.
    None,
    /// As the node file has it.
    Section(Value),
}

impl FromStr for NodeBrokerChoice {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "none" => Ok(Self::None),
            "memory" => Ok(Self::Section(json!({ "memory": {} }))),
            // It would stand in the list of processes, and in the printed file.
            url if is_redis(url) && has_password(url) => {
                Err("a password does not belong here: write password_file into the node file"
                    .to_owned())
            }
            url if is_redis(url) => Ok(Self::Section(json!({ "redis": { "url": url } }))),
            _ => Err("it is redis://HOST:PORT, memory or none".to_owned()),
        }
    }
}

/// The broker of the layer scope.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LayerBrokerChoice {
    /// There is none.
    None,
    /// Within one process.
    Memory,
    /// DDS in this domain, on the interface of the node.
    Dds(u16),
    /// Kafka behind these `HOST:PORT`.
    Kafka(Vec<String>),
}

impl FromStr for LayerBrokerChoice {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let form = || "it is kafka:HOST:PORT[,HOST:PORT…], dds:DOMAIN, memory or none".to_owned();
        match text.split_once(':') {
            None if text == "none" => Ok(Self::None),
            None if text == "memory" => Ok(Self::Memory),
            Some(("dds", domain)) => domain.parse().map(Self::Dds).map_err(|_| form()),
            Some(("kafka", servers)) if !servers.is_empty() => {
                Ok(Self::Kafka(servers.split(',').map(str::to_owned).collect()))
            }
            _ => Err(form()),
        }
    }
}

/// Whether a text is the URL of a Redis.
pub(crate) fn is_redis(text: &str) -> bool {
    let mut schemes = ["redis://", "rediss://", "redis+unix://", "unix://"].into_iter();
    schemes.any(|scheme| text.starts_with(scheme))
}

/// Whether a URL of Redis names a user or a password.
pub(crate) fn has_password(url: &str) -> bool {
    let rest = url.split_once("://").map_or(url, |(_, rest)| rest);
    let authority = rest.split(['/', '?', '#']).next().unwrap_or_default();
    authority.contains('@')
}

fn parse_label(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((key, value)) if !key.is_empty() => Ok((key.to_owned(), value.to_owned())),
        _ => Err("it is KEY=VALUE, for example site=lab".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn brokers_are_read_and_others_refused() {
        let node = |text: &str| text.parse::<NodeBrokerChoice>();
        assert_eq!(node("none"), Ok(NodeBrokerChoice::None));
        assert_eq!(
            node("redis://10.0.0.1:6379"),
            Ok(NodeBrokerChoice::Section(json!({"redis": {"url": "redis://10.0.0.1:6379"}})))
        );
        assert!(node("redis://:secret@10.0.0.1").unwrap_err().contains("password_file"));
        assert!(node("kafka:a:1").is_err());
        let layer = |text: &str| text.parse::<LayerBrokerChoice>();
        assert_eq!(
            layer("kafka:a:9092,b:9092"),
            Ok(LayerBrokerChoice::Kafka(vec!["a:9092".to_owned(), "b:9092".to_owned()]))
        );
        assert_eq!(layer("dds:7"), Ok(LayerBrokerChoice::Dds(7)));
        for bad in ["kafka:", "kafka", "dds:x", "redis://a", ""] {
            assert!(layer(bad).unwrap_err().contains("dds:DOMAIN"), "{bad}");
        }
        assert_eq!(parse_label("a=b=c"), Ok(("a".to_owned(), "b=c".to_owned())));
        assert!(parse_label("=b").is_err() && parse_label("a").is_err());
    }
}
