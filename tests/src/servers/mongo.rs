//! A MongoDB server of one test: a replica set of one member.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context as _;

use super::endpoint::Endpoint;
use super::process::ServerProcess;
use super::{installed, mongo_wire, ports};
use crate::network::Host;

/// Measured: 1.4 s, somewhat more after a kill. The rest is for a machine that does much else.
const START: Duration = Duration::from_secs(60);
/// Another process may take a port between our choice and the server's start.
const PORT_ATTEMPTS: usize = 3;

/// Removes a database that a test made on a shared server of this machine.
///
/// # Errors
/// When the server does not answer.
pub fn drop_mongo_database(uri: &str, database: &str) -> anyhow::Result<()> {
    if let Some(port) = loopback_port(uri) {
        mongo_wire::command(
            &Endpoint::loopback(port),
            &bson::doc! { "dropDatabase": 1, "$db": database },
        )?;
    }
    Ok(())
}

/// Runs a command, given in extended JSON, on a server of this machine; for what no client of the
/// product does.
///
/// # Errors
/// When the server does not answer or refuses.
pub fn mongo_command(
    uri: &str,
    database: &str,
    command: &serde_json::Value,
) -> anyhow::Result<bson::Document> {
    let (server, document) = for_wire(uri, database, command)?;
    let answer = mongo_wire::command(&server, &document)?;
    anyhow::ensure!(
        mongo_wire::is_ok(&answer) && !answer.contains_key("writeErrors"),
        "{command}: {answer}"
    );
    Ok(answer)
}

/// Leaves a transaction open as a process does that is killed within it: begins it as a client
/// called `app_name`, does one command, and goes.
///
/// # Errors
/// As [`mongo_command`].
pub fn abandon_mongo_transaction(
    uri: &str,
    database: &str,
    app_name: &str,
    command: &serde_json::Value,
) -> anyhow::Result<()> {
    let (server, document) = for_wire(uri, database, command)?;
    mongo_wire::abandon(&server, app_name, document)
}

fn for_wire(
    uri: &str,
    database: &str,
    command: &serde_json::Value,
) -> anyhow::Result<(Endpoint, bson::Document)> {
    let port = loopback_port(uri).with_context(|| format!("{uri} is no server of this machine"))?;
    let mut document = bson::Document::new();
    for (name, value) in command.as_object().context("a command is an object")? {
        document.insert(name, bson::Bson::try_from(value.clone())?);
    }
    document.insert("$db", database);
    Ok((Endpoint::loopback(port), document))
}

/// Inserts a document, given in extended JSON, on a server of this machine.
///
/// # Errors
/// As [`mongo_command`].
pub fn mongo_insert(
    uri: &str,
    database: &str,
    table: &str,
    document: &serde_json::Value,
) -> anyhow::Result<()> {
    mongo_command(uri, database, &serde_json::json!({ "insert": table, "documents": [document] }))?;
    Ok(())
}

/// The port of a server of this machine without password or TLS.
pub(super) fn loopback_port(uri: &str) -> Option<u16> {
    let rest = uri.strip_prefix("mongodb://127.0.0.1:")?;
    rest.split(['/', '?']).next()?.parse().ok()
}

/// How a server of one test is set up.
#[derive(Debug, Clone, Default)]
pub struct MongoOptions {
    /// 0 for any free port.
    pub port: u16,
    /// The host of a network that it runs and listens on; absent = this machine's loopback.
    pub host: Option<Host>,
    /// A server that is alone: it has neither transactions nor change streams.
    pub alone: bool,
    /// Where its folder is made; absent = among temporary files. For measurements, where the disk
    /// matters; it has room then like a server that is used, and not the least that tests can do
    /// with.
    pub folder: Option<PathBuf>,
    /// Further arguments of `mongod`.
    pub extra: Vec<String>,
}

/// A running MongoDB; killed when dropped, and its data removed.
pub struct MongoServer {
    process: ServerProcess,
    endpoint: Endpoint,
    options: MongoOptions,
}

impl MongoServer {
    /// Starts a server and waits until it takes writes.
    ///
    /// # Errors
    /// When it is not installed, refuses its arguments, or does not answer in time.
    #[expect(
        clippy::needless_pass_by_value,
        reason = "options are written in place: `start(MongoOptions::default())`"
    )]
    pub fn start(options: MongoOptions) -> anyhow::Result<Self> {
        let mut attempt = 1;
        loop {
            let port = if options.port == 0 { ports::free()? } else { options.port };
            let process = ServerProcess::new_in("mongo", options.folder.as_deref())?;
            std::fs::create_dir(process.folder().join("data"))?;
            let server = Self {
                process,
                endpoint: Endpoint::new(options.host.as_ref(), port),
                options: options.clone(),
            };
            match server.spawn() {
                Ok(()) => return Ok(server),
                Err(error) => {
                    let taken = options.port == 0 && server.process.log_tail().contains("in use");
                    if !taken || attempt == PORT_ATTEMPTS {
                        return Err(error);
                    }
                    attempt += 1;
                }
            }
        }
    }

    fn spawn(&self) -> anyhow::Result<()> {
        let mut command = self.endpoint.program(Self::program()?);
        let (ip, port) = (self.endpoint.ip().to_string(), self.endpoint.port.to_string());
        let (oplog_mib, cache_gib) = match self.options.folder {
            Some(_) => ("1024", "2"),
            None => ("64", "0.25"),
        };
        command
            .args(["--dbpath", "data", "--port", &port, "--bind_ip", &ip, "--nounixsocket"])
            .args(["--oplogSize", oplog_mib, "--wiredTigerCacheSizeGB", cache_gib])
            .args(["--setParameter", "diagnosticDataCollectionEnabled=false"]);
        if !self.options.alone {
            command.args(["--replSet", "rs0"]);
        }
        command.args(&self.options.extra);
        self.process.spawn(command)?;
        self.wait_ready()
    }

    fn program() -> anyhow::Result<PathBuf> {
        installed::path("bin/mongod")
    }

    /// Waits until it takes writes.
    ///
    /// # Errors
    /// When it ends, or is not ready within a minute; with the last lines of its log.
    pub fn wait_ready(&self) -> anyhow::Result<()> {
        // The process tells that it has the port: another server there would answer as well.
        let ours = || {
            let answers = mongo_wire::pid(&self.endpoint).ok();
            answers.is_some() && answers == self.process.pid().map(i64::from)
        };
        let in_set = || self.options.alone || mongo_wire::initiate(&self.endpoint).is_ok();
        let ready = || ours() && in_set() && mongo_wire::is_writable(&self.endpoint);
        self.process.wait_ready(START, ready)?;
        Ok(())
    }

    /// `mongodb://127.0.0.1:PORT/?replicaSet=rs0`, or with its host's address.
    #[must_use]
    pub fn uri(&self) -> String {
        let set = if self.options.alone { "" } else { "?replicaSet=rs0" };
        format!("mongodb://{}:{}/{set}", self.endpoint.ip(), self.endpoint.port)
    }

    /// The port it listens on.
    #[must_use]
    pub fn port(&self) -> u16 {
        self.endpoint.port
    }

    /// Whether it takes writes now.
    #[must_use]
    pub fn is_writable(&self) -> bool {
        mongo_wire::is_writable(&self.endpoint)
    }

    /// SIGKILL; its end has been waited for. What was acknowledged stays for
    /// [`MongoServer::restart`].
    ///
    /// # Errors
    /// When the system refuses.
    pub fn kill(&self) -> anyhow::Result<()> {
        self.process.kill()
    }

    /// Kills it if it runs, starts it with the same port and data, and waits until it takes writes.
    ///
    /// # Errors
    /// As [`MongoServer::start`].
    pub fn restart(&self) -> anyhow::Result<()> {
        self.kill()?;
        self.spawn()
    }

    /// SIGSTOP: connections stay, answers do not come.
    ///
    /// # Errors
    /// When it does not run.
    pub fn freeze(&self) -> anyhow::Result<()> {
        self.process.freeze()
    }

    /// SIGCONT after [`MongoServer::freeze`].
    ///
    /// # Errors
    /// When it does not run.
    pub fn thaw(&self) -> anyhow::Result<()> {
        self.process.thaw()
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
