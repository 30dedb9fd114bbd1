//! A Redis or Valkey server of one test.

use std::fmt::Write as _;
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use super::certificates::Certificates;
use super::endpoint::Endpoint;
use super::process::{ServerProcess, output_within};
use super::{installed, ports};
use crate::network::Host;

/// Measured: 0.05 s. The rest is for a machine that does much else.
const START: Duration = Duration::from_secs(20);
/// One command of `redis-cli`.
const COMMAND: Duration = Duration::from_secs(10);
/// One `PING` while waiting.
const PING: Duration = Duration::from_millis(500);
/// Another process may take a port between our choice and the server's start.
const PORT_ATTEMPTS: usize = 3;

/// Which server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum RedisKind {
    /// Redis 7.0.
    Redis,
    /// Valkey 9.1, without TLS.
    Valkey,
}

impl RedisKind {
    fn name(self) -> &'static str {
        match self {
            Self::Redis => "redis",
            Self::Valkey => "valkey",
        }
    }

    fn program(self) -> anyhow::Result<PathBuf> {
        installed::path(match self {
            Self::Redis => "bin/redis-server",
            Self::Valkey => "bin/valkey-server",
        })
    }
}

/// How a server of one test is set up.
#[derive(Debug, Clone, Default)]
pub struct RedisOptions {
    /// 0 for any free port.
    pub port: u16,
    /// The host of a network that it runs and listens on; absent = this machine's loopback.
    pub host: Option<Host>,
    /// TLS only, no plain port. The client trusts [`RedisServer::authority`].
    pub tls: bool,
    /// Users as in `ACL SETUSER`: `edge on >pw ~b:* &b:* +@all -@dangerous`.
    pub acl: Vec<String>,
    /// Lines of `redis.conf`; they win over the harness's own. Nothing is kept on disk unless a
    /// line asks for it.
    pub extra: Vec<String>,
}

/// A running Redis or Valkey; killed when dropped.
pub struct RedisServer {
    kind: RedisKind,
    process: ServerProcess,
    endpoint: Endpoint,
    certificates: Option<Certificates>,
}

impl RedisServer {
    /// The folder with the program that this starts, for who starts one by itself.
    ///
    /// # Errors
    /// When it is not installed.
    pub fn program_folder(kind: RedisKind) -> anyhow::Result<PathBuf> {
        let program = kind.program()?;
        Ok(program.parent().map(Path::to_owned).unwrap_or_default())
    }

    /// Starts a server and waits until it answers.
    ///
    /// # Errors
    /// When it is not installed, refuses its configuration, or does not answer in time.
    #[expect(
        clippy::needless_pass_by_value,
        reason = "options are written in place: `start(RedisOptions::default())`"
    )]
    pub fn start(kind: RedisKind, options: RedisOptions) -> anyhow::Result<Self> {
        anyhow::ensure!(
            !(options.tls && kind == RedisKind::Valkey),
            "the installed Valkey is built without TLS"
        );
        let mut attempt = 1;
        loop {
            let port = if options.port == 0 { ports::free()? } else { options.port };
            let server = Self::prepare(kind, port, &options)?;
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

    fn prepare(kind: RedisKind, port: u16, options: &RedisOptions) -> anyhow::Result<Self> {
        let process = ServerProcess::new(kind.name())?;
        let certificates = match options.tls {
            true => Some(Certificates::write(process.folder())?),
            false => None,
        };
        let endpoint = Endpoint::new(options.host.as_ref(), port);
        let text = configuration(process.folder(), &endpoint, certificates.as_ref(), options)?;
        std::fs::write(process.folder().join("redis.conf"), text)?;
        Ok(Self { kind, process, endpoint, certificates })
    }

    fn spawn(&self) -> anyhow::Result<()> {
        let mut command = self.endpoint.program(self.kind.program()?);
        command.arg("redis.conf");
        self.process.spawn(command)?;
        // The log tells that it has the port: another server there would answer as well.
        let ready = || self.process.has_logged("Ready to accept connections") && self.ping();
        self.process.wait_ready(START, ready)?;
        Ok(())
    }

    /// `redis://127.0.0.1:PORT`, or with its host's address; `rediss://…` with TLS.
    #[must_use]
    pub fn url(&self) -> String {
        let scheme = if self.certificates.is_some() { "rediss" } else { "redis" };
        format!("{scheme}://{}:{}", self.endpoint.ip(), self.endpoint.port)
    }

    /// The port it listens on.
    #[must_use]
    pub fn port(&self) -> u16 {
        self.endpoint.port
    }

    /// File with the certificate of the authority that signed the server's, in PEM form; `None`
    /// without TLS.
    #[must_use]
    pub fn authority(&self) -> Option<&Path> {
        self.certificates.as_ref().map(|files| files.authority.as_path())
    }

    /// SIGKILL; its end has been waited for.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn kill(&self) -> anyhow::Result<()> {
        self.process.kill()
    }

    /// Kills it if it runs, starts it on the same port and folder, and waits until it answers. Data
    /// is there again only if [`RedisOptions::extra`] asked for it.
    ///
    /// # Errors
    /// As [`RedisServer::start`].
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

    /// SIGCONT after [`RedisServer::freeze`].
    ///
    /// # Errors
    /// When it does not run.
    pub fn thaw(&self) -> anyhow::Result<()> {
        self.process.thaw()
    }

    /// Whether it answers `PING` within half a second. A refusal for want of rights is an answer,
    /// too.
    #[must_use]
    pub fn ping(&self) -> bool {
        match &self.certificates {
            None => ping(&self.endpoint).is_some_and(|answer| is_ready(&answer)),
            Some(_) => {
                let output = output_within(self.client(&["PING"]), PING);
                output.is_ok_and(|output| is_ready(&printed(&output)))
            }
        }
    }

    /// What `redis-cli` prints for a command, as the default user; name another with `--user` and
    /// `--pass` in front.
    ///
    /// # Errors
    /// When the server refuses the command, or does not answer within ten seconds.
    pub fn cli(&self, arguments: &[&str]) -> anyhow::Result<String> {
        installed::path("bin/redis-cli")?;
        let output = output_within(self.client(arguments), COMMAND)?;
        let text = printed(&output);
        anyhow::ensure!(output.status.success(), "redis-cli {arguments:?}: {text}");
        Ok(text)
    }

    fn client(&self, arguments: &[&str]) -> Command {
        let mut command = self.endpoint.program(installed::folder().join("bin/redis-cli"));
        let (ip, port) = (self.endpoint.ip().to_string(), self.endpoint.port.to_string());
        command.args(["-e", "-h", &ip, "-p", &port]);
        if let Some(files) = &self.certificates {
            command.arg("--tls").arg("--cacert").arg(&files.authority);
        }
        command.args(arguments);
        command
    }
}

fn configuration(
    folder: &Path,
    endpoint: &Endpoint,
    tls: Option<&Certificates>,
    options: &RedisOptions,
) -> anyhow::Result<String> {
    let (ip, port) = (endpoint.ip(), endpoint.port);
    let mut text = String::new();
    match tls {
        None => writeln!(text, "port {port}")?,
        Some(files) => {
            writeln!(text, "port 0\ntls-port {port}\ntls-auth-clients no")?;
            writeln!(text, "tls-ca-cert-file {}", files.authority.display())?;
            writeln!(text, "tls-cert-file {}", files.certificate.display())?;
            writeln!(text, "tls-key-file {}", files.key.display())?;
        }
    }
    writeln!(text, "bind {ip}\nprotected-mode no\ndir {}\nloglevel notice", folder.display())?;
    writeln!(text, "save \"\"\nappendonly no\nappendfsync always")?;
    // Large messages to a slow reader: the default of 32 MiB cuts it off.
    writeln!(text, "client-output-buffer-limit pubsub 256mb 128mb 60")?;
    for user in &options.acl {
        writeln!(text, "user {user}")?;
    }
    for line in &options.extra {
        writeln!(text, "{line}")?;
    }
    Ok(text)
}

/// The first line of the answer to `PING`.
pub(super) fn ping(server: &Endpoint) -> Option<String> {
    let mut stream = server.connect(PING).ok()?;
    stream.set_read_timeout(Some(PING)).ok()?;
    stream.write_all(b"PING\r\n").ok()?;
    let mut buffer = [0; 256];
    let length = stream.read(&mut buffer).ok()?;
    Some(String::from_utf8_lossy(&buffer[..length]).into_owned())
}

/// Not ready is `-LOADING`: it still reads its data.
pub(super) fn is_ready(answer: &str) -> bool {
    ["PONG", "NOAUTH", "NOPERM"].iter().any(|word| answer.contains(word))
}

fn printed(output: &std::process::Output) -> String {
    let text = format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    text.trim_end().to_owned()
}
