//! Network namespaces, and doing things inside them.

use std::fs::File;
use std::io::Write as _;
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::Context as _;
use nix::sched::{CloneFlags, setns};

/// Where `ip netns` keeps them.
const FOLDER: &str = "/var/run/netns";

/// Runs a command.
///
/// # Errors
/// When it fails; the message holds what it printed.
pub fn run(command: &str) -> anyhow::Result<String> {
    let output =
        Command::new("bash").args(["-c", command]).output().with_context(|| command.to_owned())?;
    let text = format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    anyhow::ensure!(output.status.success(), "{command}: {text}");
    Ok(text)
}

/// Does something on a thread of its own inside a namespace. Sockets that are made there stay
/// there, and so do threads that are started there, such as those of a client library.
///
/// # Errors
/// When there is no such namespace or this is not root, and what `act` says.
pub fn inside<T: Send>(
    namespace: &str,
    act: impl FnOnce() -> anyhow::Result<T> + Send,
) -> anyhow::Result<T> {
    let path = Path::new(FOLDER).join(namespace);
    let handle = File::open(&path).with_context(|| format!("the namespace {namespace}"))?;
    std::thread::scope(|scope| {
        let thread = scope.spawn(move || {
            setns(handle, CloneFlags::CLONE_NEWNET)
                .with_context(|| format!("entering {namespace}"))?;
            act()
        });
        match thread.join() {
            Ok(result) => result,
            Err(panic) => std::panic::resume_unwind(panic),
        }
    })
}

/// A TCP connection, made inside a namespace if one is named.
///
/// # Errors
/// When nobody accepts it in time.
pub fn connect(
    namespace: Option<&str>,
    address: SocketAddr,
    timeout: Duration,
) -> anyhow::Result<TcpStream> {
    let connect = || Ok(TcpStream::connect_timeout(&address, timeout)?);
    match namespace {
        None => connect(),
        Some(namespace) => inside(namespace, connect),
    }
}

/// A program to be run inside a namespace if one is named. `ip netns exec` replaces itself, so the
/// process id is that of the program.
#[must_use]
pub fn program(namespace: Option<&str>, program: impl AsRef<std::ffi::OsStr>) -> Command {
    match namespace {
        None => Command::new(program),
        Some(namespace) => {
            let mut command = Command::new("ip");
            command.args(["netns", "exec", namespace]).arg(program);
            command
        }
    }
}

/// Runs lines of `ip` commands inside a namespace, in one process.
///
/// # Errors
/// With what `ip` says of the first line that fails.
pub(super) fn batch(namespace: &str, lines: &[String]) -> anyhow::Result<()> {
    let mut child = Command::new("ip")
        .args(["-n", namespace, "-batch", "-"])
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .context("starting ip")?;
    // It reads all before it says much, and what it says is short: neither side waits for the
    // other.
    child.stdin.take().context("no pipe to ip")?.write_all(lines.join("\n").as_bytes())?;
    let output = child.wait_with_output()?;
    anyhow::ensure!(
        output.status.success(),
        "ip in {namespace}: {} in:\n{}",
        String::from_utf8_lossy(&output.stderr).trim(),
        lines.join("\n")
    );
    Ok(())
}

/// A namespace; it is deleted when dropped, with what still runs in it.
#[derive(Debug)]
pub(super) struct Namespace {
    name: String,
}

impl Namespace {
    /// Makes one that forwards packets, knows no IPv6 and has its loopback up.
    ///
    /// # Errors
    /// When the machine does not allow it: namespaces need root and iproute2.
    pub(super) fn new(name: String) -> anyhow::Result<Self> {
        run(&format!("ip netns add {name}"))?;
        let namespace = Self { name };
        crate::guard::add_namespace(&namespace.name)?;
        batch(&namespace.name, &["link set lo up".to_owned()])?;
        inside(&namespace.name, || {
            std::fs::write("/proc/sys/net/ipv4/ip_forward", "1")?;
            // Its neighbour discovery would show in the counters. A kernel without IPv6 has none.
            for scope in ["all", "default"] {
                let setting = format!("/proc/sys/net/ipv6/conf/{scope}/disable_ipv6");
                if Path::new(&setting).exists() {
                    std::fs::write(setting, "1")?;
                }
            }
            Ok(())
        })?;
        Ok(namespace)
    }

    pub(super) fn name(&self) -> &str {
        &self.name
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        // A destructor has nobody to tell; the guard tries once more when this process ends.
        if run(&format!("ip netns del {}", self.name)).is_ok() {
            crate::guard::remove_namespace(&self.name);
        }
    }
}

/// Refuses with a sentence for people where namespaces cannot be made.
///
/// # Errors
/// When this is not root, or iproute2 or nftables is missing.
pub(super) fn check_rights() -> anyhow::Result<()> {
    let user = run("id -u")?;
    anyhow::ensure!(
        user.trim() == "0",
        "this test makes network namespaces and must be run by root: `sudo -E env PATH=\"$PATH\" \
         cargo nextest run -E 'binary(net)'`"
    );
    for tool in ["ip", "nft"] {
        anyhow::ensure!(
            run(&format!("command -v {tool}")).is_ok(),
            "`{tool}` is missing: run `apt-get install -y iproute2 nftables`"
        );
    }
    Ok(())
}
