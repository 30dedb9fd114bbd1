//! Options of `blaze dev`, and the node file that they make.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use blaze_domain::node_file::NodeFile;
use blaze_domain::{LayerName, NodeName};
use blaze_runtime::config::Sources;
use clap::Args;
use serde_json::{Value, json};

use crate::config::node::options::{has_password, is_redis};
use crate::demo::options::Setting;
use crate::exit::CliError;
use crate::node_file;

/// Options of `blaze dev`.
#[derive(Debug, Clone, Args)]
pub struct DevOptions {
    /// Layer of the node; edge, fog and cloud are of that kind, others are edge layers
    #[arg(long, value_name = "LAYER", default_value = "edge")]
    pub layer: LayerName,
    /// Name of the node
    #[arg(long, value_name = "NAME", default_value = "dev-1")]
    pub node: NodeName,
    /// What services talk to: redis (one of its own, which redis-server from PATH is started for),
    /// redis://HOST:PORT, or memory (within this process alone); else redis if there is a
    /// redis-server
    #[arg(long, value_name = "BROKER")]
    pub broker: Option<DevBroker>,
    /// Where REST listens, on loopback; port 0: any free one
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8080")]
    pub rest: std::net::SocketAddr,
    /// Where gRPC listens, on loopback; port 0: any free one
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:50051")]
    pub grpc: std::net::SocketAddr,
    /// Keep the configuration in this folder; else it is gone with the process
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Documents to apply at the start: file, directory or -; may be repeated
    #[arg(short = 'f', long = "file", value_name = "FILE|DIR|-")]
    pub files: Vec<PathBuf>,
    /// Set a value of the node file, for example admin.flow=127.0.0.1:0
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<Setting>,
}

/// What services talk to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DevBroker {
    /// Within this process.
    Memory,
    /// A Redis that is started.
    OwnRedis,
    /// A Redis that runs.
    Redis(String),
}

impl FromStr for DevBroker {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "memory" => Ok(Self::Memory),
            "redis" => Ok(Self::OwnRedis),
            // It would stand in the list of processes and in what is printed.
            url if has_password(url) => {
                Err("a password does not belong here: --set brokers.node.redis.password_file=FILE"
                    .to_owned())
            }
            url if is_redis(url) => Ok(Self::Redis(url.to_owned())),
            _ => Err("it is memory, redis or redis://HOST:PORT".to_owned()),
        }
    }
}

impl DevOptions {
    /// Kind of the layer.
    #[must_use]
    pub fn kind(&self) -> &'static str {
        match self.layer.as_str() {
            "fog" => "fog",
            "cloud" => "cloud",
            _ => "edge",
        }
    }

    /// The node file: what the options say, and over it `--set`. The worker asks `grpc` once that
    /// is known.
    ///
    /// # Errors
    /// [`CliError::Usage`] with every fault.
    pub fn node_file(
        &self,
        redis: Option<&str>,
        grpc: Option<std::net::SocketAddr>,
    ) -> Result<(NodeFile, Value), CliError> {
        let node_broker = match redis {
            Some(url) => json!({ "redis": { "url": url } }),
            None => json!({ "memory": {} }),
        };
        let mut own = vec![
            ("layer", json!({ "name": self.layer, "kind": self.kind() })),
            ("node", json!({ "name": self.node })),
            ("brokers.node", node_broker),
            ("control_plane.rest.listen", json!(self.rest)),
            ("control_plane.grpc.listen", json!(self.grpc)),
            ("log.level", json!("warn")),
        ];
        if let Some(folder) = &self.data {
            own.push(("state_dir", json!(folder)));
            own.push(("control_plane.store.sqlite.path", json!(self.store(folder))));
        }
        if let Some(grpc) = grpc {
            own.push(("config.server", json!(format!("http://{grpc}"))));
        }
        let of_options = own.into_iter().map(|(key, value)| (key.to_owned(), value.to_string()));
        let set = self.set.iter().map(|setting| (setting.key.clone(), setting.value.clone()));
        let sources = Sources {
            overrides: of_options.chain(set).collect(),
            file_may_be_absent: true,
            ..Sources::default()
        };
        node_file::read_with_tree(&sources)
            .map_err(|faults| CliError::Usage(format!("--set: {faults}")))
    }

    fn store(&self, folder: &Path) -> PathBuf {
        folder.join("blaze-config.db")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::{Command, tests};

    fn parse(line: &str) -> Result<DevOptions, clap::Error> {
        match tests::parse(&format!("dev {line}"))?.command {
            Command::Dev(options) => Ok(*options),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_broker_is_named_without_its_password() {
        let refused = parse("--broker redis://me:secret@127.0.0.1:6379").unwrap_err();
        assert!(refused.to_string().contains("password_file"), "{refused}");
        assert!(parse("--broker redis://127.0.0.1:6379").is_ok());
    }

    #[test]
    fn the_node_file_says_what_the_options_say() {
        let options = parse("--layer fog --node pc --set flow.bandwidth.limit_mbps=7").unwrap();
        let (file, tree) = options.node_file(None, Some("127.0.0.1:7".parse().unwrap())).unwrap();
        assert_eq!(tree["layer"], json!({ "name": "fog", "kind": "fog" }));
        assert_eq!(tree["config"]["server"], "http://127.0.0.1:7");
        assert_eq!((file.flow.bandwidth.limit_mbps, options.kind()), (7.0, "fog"));
        assert!(file.state_dir.is_none());
        let kept = parse("--data kept").unwrap();
        let (_, tree) = kept.node_file(Some("redis://127.0.0.1:1"), None).unwrap();
        assert_eq!(tree["control_plane"]["store"]["sqlite"]["path"], "kept/blaze-config.db");
        assert_eq!(tree["brokers"]["node"]["redis"]["url"], "redis://127.0.0.1:1");
        let faulty = parse("--set flow.bandwith.limit_mbps=7").unwrap();
        assert_eq!(faulty.node_file(None, None).unwrap_err().exit() as u8, 2);
    }

    #[test]
    fn brokers_are_read() {
        for (text, broker) in [
            ("memory", DevBroker::Memory),
            ("redis", DevBroker::OwnRedis),
            ("redis://a:1", DevBroker::Redis("redis://a:1".to_owned())),
        ] {
            assert_eq!(text.parse(), Ok(broker));
        }
        let refused = parse("--broker kafka").unwrap_err();
        assert!(refused.to_string().contains("redis://HOST:PORT"), "{refused}");
    }
}
