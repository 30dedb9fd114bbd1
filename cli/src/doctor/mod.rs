//! `blaze doctor`: everything that can be wrong with a node, each with what to do.
//!
//! ```text
//! node file ─► file ─► Node ─┬► programs: admin ports of flow, worker, monitor, main service
//!                            ├► file, brokers, network, mtu, peers, flows, sync, machine,
//!                            │  credentials:
//!                            │    probe ─► facts ─► judgement ─► Finding
//!                            └► Check: the worst of the findings ─► output
//! ```
//!
//! Probes run at once, within one deadline, and change nothing. What asks a program that does not
//! run is skipped.

mod brokers;
mod check;
mod credentials;
mod file;
mod flows;
mod limits;
mod machine;
mod mtu;
mod network;
mod peers;
mod programs;
mod sync;

use std::path::PathBuf;

use blaze_domain::node_file::NodeFile;
use clap::Args;
use futures::future::BoxFuture;
use serde_json::json;
use tokio::sync::oneshot;
use tokio::time::{Instant, timeout_at};

use crate::exit::{CliError, Exit};
use crate::output::{self, Align, Format, terminal_width};
use check::{Check, Finding, Outcome};
use programs::{Kind, Program};

/// Options of `blaze doctor`.
#[derive(Debug, Args)]
pub struct DoctorOptions {
    /// Node file; else BLAZE_CONFIG, ./blaze.yaml, /etc/blaze/blaze.yaml
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
}

/// What the checks look at.
struct Node {
    /// Path of the node file, for people.
    name: String,
    file: NodeFile,
    flow: Program,
    worker: Program,
    monitor: Program,
    main: Program,
    /// Where the kernel tells of processes and of the network.
    proc: PathBuf,
}

impl Node {
    async fn of(name: String, file: NodeFile) -> Self {
        let admin = &file.admin;
        let main = file.control_plane.admin.listen;
        let (flow, worker, monitor, main) = tokio::join!(
            Program::ask(Kind::Flow, admin.flow),
            Program::ask(Kind::Worker, admin.worker),
            Program::ask(Kind::Monitor, admin.monitor),
            Program::ask(Kind::Main, main),
        );
        Self { name, file, flow, worker, monitor, main, proc: PathBuf::from("/proc") }
    }
}

type Probe = for<'n> fn(&'n Node) -> BoxFuture<'n, Vec<Finding>>;

/// The checks behind `node_file`, in the order of the answer.
const CHECKS: [(&str, Probe); 18] = [
    ("ports", |node| Box::pin(file::ports(node))),
    ("brokers", |node| Box::pin(brokers::brokers(node))),
    ("broker_limits", |node| Box::pin(brokers::broker_limits(node))),
    ("dds_interface", |node| Box::pin(network::dds_interface(node))),
    ("multicast", |node| Box::pin(network::multicast(node))),
    ("mtu", |node| Box::pin(mtu::mtu(node))),
    ("udp_buffers", |node| Box::pin(network::udp_buffers(node))),
    ("clock", |node| Box::pin(async { machine::clock(node) })),
    ("peers", |node| Box::pin(peers::peers(node))),
    ("versions", |node| Box::pin(async { flows::versions(node) })),
    ("leases", |node| Box::pin(async { flows::leases(node) })),
    ("budget", |node| Box::pin(flows::budget(node))),
    ("token", |node| Box::pin(credentials::token(node))),
    ("certificates", |node| Box::pin(credentials::certificates(node))),
    ("config_sync", |node| Box::pin(async { sync::config_sync(node) })),
    ("disk", |node| Box::pin(machine::disk(node))),
    ("descriptors", |node| Box::pin(machine::descriptors(node))),
    ("collectors", |node| Box::pin(async { sync::collectors(node) })),
];

/// Examines this node: done if no check fails, else failed.
///
/// # Errors
/// [`CliError::Failed`] and [`CliError::OutputClosed`] for standard output.
pub async fn run(options: DoctorOptions, format: Format) -> Result<Exit, CliError> {
    let checks = examine(options.config).await;
    let value = json!({ "checks": checks });
    let text = output::format_object(&value, format, |_| Ok(table(&checks, terminal_width())))?;
    output::print(&text)?;
    let fails = checks.iter().any(|check| check.result == Outcome::Fail);
    Ok(if fails { Exit::Failed } else { Exit::Done })
}

async fn examine(config: Option<PathBuf>) -> Vec<Check> {
    let until = Instant::now() + limits::TOTAL;
    let read = file::read(config);
    let mut checks = vec![Check::of("node_file", &read.findings)];
    let Some(file) = read.file else {
        let unknown = Finding::skipped("the node file cannot be read", "see the check node_file");
        checks.extend(CHECKS.map(|(name, _)| Check::of(name, std::slice::from_ref(&unknown))));
        return checks;
    };
    let node = Node::of(read.name, file).await;
    let found = CHECKS.map(|(name, probe)| {
        let node = &node;
        async move {
            match timeout_at(until, probe(node)).await {
                Ok(findings) => Check::of(name, &findings),
                Err(_) => Check::of(name, &[late(name, &node.name)]),
            }
        }
    });
    checks.extend(futures::future::join_all(found).await);
    checks
}

fn late(name: &str, file: &str) -> Finding {
    Finding::warn(
        format!("{name} has no result within {} s", limits::TOTAL.as_secs()),
        format!("blaze doctor --config {file}, when the machine does less"),
    )
}

/// Runs what may block on a thread of its own: one that hangs, as on a file system that is away,
/// does not keep the process from ending. `None` without a thread.
async fn on_thread<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Option<T> {
    let (done, result) = oneshot::channel();
    let run = move || {
        // Nobody waits any more after the deadline.
        let _ = done.send(work());
    };
    std::thread::Builder::new().name("doctor".to_owned()).spawn(run).ok()?;
    result.await.ok()
}

fn table(checks: &[Check], width: Option<u16>) -> String {
    let mut text = output::table(
        checks,
        width,
        &[
            ("CHECK", Align::Left, &|check| check.check.to_owned()),
            ("RESULT", Align::Left, &|check| word(check.result).to_owned()),
            ("DETAIL", Align::Left, &|check| check.detail.clone()),
        ],
    );
    let wrong = checks.iter().filter(|check| check.result >= Outcome::Warn);
    for check in wrong {
        text.push_str(&format!("{}: {}\n", check.check, check.remedy));
    }
    let count = |result| checks.iter().filter(|check| check.result == result).count();
    text.push_str(&format!(
        "{} ok, {} to look at, {} failed, {} skipped\n",
        count(Outcome::Ok),
        count(Outcome::Warn),
        count(Outcome::Fail),
        count(Outcome::Skipped),
    ));
    text
}

/// What fails stands out among small letters.
fn word(result: Outcome) -> &'static str {
    match result {
        Outcome::Fail => "FAIL",
        other => other.as_str(),
    }
}

/// The names of all checks in the order of the answer.
#[cfg(test)]
fn names() -> Vec<&'static str> {
    std::iter::once("node_file").chain(CHECKS.map(|(name, _)| name)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const ORDER: &str = "node_file ports brokers broker_limits dds_interface multicast mtu \
                         udp_buffers clock peers versions leases budget token certificates \
                         config_sync disk descriptors collectors";

    #[test]
    fn the_order_is_that_of_the_contract() {
        assert_eq!(names().join(" "), ORDER);
    }

    fn outcomes(checks: &[Check]) -> Vec<(&str, Outcome)> {
        checks.iter().map(|check| (check.check, check.result)).collect()
    }

    #[tokio::test]
    async fn a_node_where_nothing_runs_has_no_failing_check() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("blaze.yaml");
        // Ports that nobody has: bound once, then free.
        let free = || {
            let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
            listener.local_addr().unwrap()
        };
        let (flow, worker, monitor, main) = (free(), free(), free(), free());
        let text = json!({
            "layer": {"name": "edge", "kind": "edge"}, "node": {"name": "robot-1"},
            "brokers": {"node": {"memory": {}}},
            "admin": {"flow": flow, "worker": worker, "monitor": monitor},
            "control_plane": {"admin": {"listen": main}},
            "state_dir": folder.path(),
            "monitor": {"thresholds": {"disk_free_ratio": 0}},
        });
        std::fs::write(&path, text.to_string()).unwrap();
        let checks = examine(Some(path)).await;
        assert_eq!(checks.len(), 19);
        assert!(checks.iter().all(|check| check.result != Outcome::Fail), "{checks:?}");
        let skipped = ["leases", "budget", "collectors"];
        for check in checks.iter().filter(|check| skipped.contains(&check.check)) {
            assert_eq!(check.result, Outcome::Skipped);
            assert!(check.remedy.contains("--config"), "{check:?}");
        }
        let no_remedy = checks.iter().filter(|check| check.result != Outcome::Ok);
        assert!(no_remedy.clone().all(|check| !check.remedy.is_empty()), "{checks:?}");
        assert!(outcomes(&checks).contains(&("brokers", Outcome::Ok)));
    }

    #[tokio::test]
    async fn without_a_node_file_the_rest_is_skipped() {
        let checks = examine(Some(PathBuf::from("/nowhere/blaze.yaml"))).await;
        assert_eq!(checks[0].result, Outcome::Fail);
        assert!(checks[1..].iter().all(|check| check.result == Outcome::Skipped));
    }

    #[test]
    fn the_table_ends_with_what_to_do() {
        let checks = [
            Check::of("ports", &[Finding::ok("free")]),
            Check::of("disk", &[Finding::fail("state_dir is full", "du -xh /var")]),
        ];
        assert_eq!(
            table(&checks, None),
            "CHECK  RESULT  DETAIL\n\
             ports  ok      free\n\
             disk   FAIL    state_dir is full\n\
             disk: du -xh /var\n\
             1 ok, 0 to look at, 1 failed, 0 skipped\n"
        );
    }
}
