//! An etcd of one test or measurement: a cluster of one member, which syncs every write to the
//! disk, as it does by default.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use anyhow::Context as _;

use super::endpoint::Endpoint;
use super::process::{ServerProcess, output_within};
use super::{installed, ports};
use crate::admin::Admin;

/// Measured: 0.9 s. The rest is for a machine that does much else.
const START: Duration = Duration::from_secs(60);
/// Another process may take a port between our choice and the server's start.
const PORT_ATTEMPTS: usize = 3;
/// What etcd says when it has its ports.
const LISTENS: &str = "this is strongly discouraged";

/// How a server of one test is set up.
#[derive(Debug, Clone, Default)]
pub struct EtcdOptions {
    /// Where its folder is made; absent = among temporary files.
    pub folder: Option<PathBuf>,
    /// Further arguments of `etcd`.
    pub extra: Vec<String>,
}

/// A running etcd; killed when dropped, and its data removed.
pub struct EtcdServer {
    process: ServerProcess,
    endpoint: Endpoint,
    peer_port: u16,
    options: EtcdOptions,
}

impl EtcdServer {
    /// Starts a server and waits until it answers.
    ///
    /// # Errors
    /// When it is not installed, refuses its arguments, or does not answer in time.
    #[expect(
        clippy::needless_pass_by_value,
        reason = "options are written in place: `start(EtcdOptions::default())`"
    )]
    pub fn start(options: EtcdOptions) -> anyhow::Result<Self> {
        let mut attempt = 1;
        loop {
            let server = Self {
                process: ServerProcess::new_in("etcd", options.folder.as_deref())?,
                endpoint: Endpoint::loopback(ports::free()?),
                peer_port: ports::free()?,
                options: options.clone(),
            };
            match server.spawn() {
                Ok(()) => return Ok(server),
                Err(error) => {
                    let taken = server.process.log_tail().contains("in use");
                    if !taken || attempt == PORT_ATTEMPTS {
                        return Err(error);
                    }
                    attempt += 1;
                }
            }
        }
    }

    fn spawn(&self) -> anyhow::Result<()> {
        let mut command = self.endpoint.program(program()?);
        let (clients, peers) = (
            format!("http://{}", self.address()),
            format!("http://{}:{}", Ipv4Addr::LOCALHOST, self.peer_port),
        );
        command
            .args(["--name", "alone", "--data-dir", "data", "--logger", "zap"])
            .args(["--listen-client-urls", &clients, "--advertise-client-urls", &clients])
            .args(["--listen-peer-urls", &peers, "--initial-advertise-peer-urls", &peers])
            .args(["--initial-cluster", &format!("alone={peers}")])
            .args(&self.options.extra);
        self.process.spawn(command)?;
        // The log tells that it has the port: another server there would answer as well.
        let admin = Admin { address: self.address(), namespace: None };
        let is_healthy = || admin.json("/health").is_ok_and(|answer| answer["health"] == "true");
        let ready = || self.process.has_logged(LISTENS) && is_healthy();
        self.process.wait_ready(START, ready)?;
        Ok(())
    }

    /// Where clients reach it, over gRPC without TLS.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        SocketAddr::from((self.endpoint.ip(), self.endpoint.port))
    }

    /// What it calls itself: `etcd Version: 3.4.23`.
    ///
    /// # Errors
    /// When it is not installed or does not start.
    pub fn version() -> anyhow::Result<String> {
        let mut command = Command::new(program()?);
        command.arg("--version");
        let output = output_within(command, START)?;
        let text = String::from_utf8_lossy(&output.stdout);
        Ok(text.lines().next().context("etcd says no version")?.to_owned())
    }

    /// Process id of the server while it runs, for measuring it.
    #[must_use]
    pub fn pid(&self) -> Option<u32> {
        self.process.pid()
    }

    /// Resident memory in KiB.
    ///
    /// # Errors
    /// When it does not run.
    pub fn rss_kib(&self) -> anyhow::Result<u64> {
        self.process.rss_kib()
    }
}

fn program() -> anyhow::Result<PathBuf> {
    installed::path("bin/etcd")
}
