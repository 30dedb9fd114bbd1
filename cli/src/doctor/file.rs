//! `node_file` and `ports`.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::net::{Ipv4Addr, SocketAddr, TcpListener, UdpSocket};
use std::path::PathBuf;

use blaze_brokers::dds::announcement_port;
use blaze_brokers::node_schema;
use blaze_domain::node_file::{Fault, NodeFile};
use blaze_runtime::config::{Sources, load_typed, schema};
use blaze_worker::settings::WorkerSettings;

use super::check::Finding;
use super::programs::{Answer, Program};
use super::{Node, on_thread};

/// What the node file says, and what is wrong with it. Without a file that can be read at all there
/// is nothing else to examine.
pub(super) struct FileRead {
    pub(super) name: String,
    pub(super) file: Option<NodeFile>,
    pub(super) findings: Vec<Finding>,
}

/// Reads the node file as the programs do.
pub(super) fn read(config: Option<PathBuf>) -> FileRead {
    let sources = Sources::of_process(config, Vec::new());
    let name = sources.resolve_file().map(|path| path.display().to_string());
    let strict = load_typed(&sources, &node_schema(faults_of_programs));
    let lenient = || load_typed(&sources, &schema(NodeFile::read)).ok().map(|found| found.value);
    let shown = name.clone().unwrap_or_else(|| "/etc/blaze/blaze.yaml".to_owned());
    let check = format!("blaze-flow --check --config {shown}");
    let (file, findings) = match strict {
        Ok(loaded) => {
            let remedy = format!("edit that line of {shown}, then {check}");
            let warnings = loaded.warnings.iter();
            let mut findings: Vec<Finding> = warnings
                .map(|warning| Finding::warn(warning.to_string(), remedy.clone()))
                .collect();
            findings.push(Finding::ok(shown.clone()));
            (Some(loaded.value), findings)
        }
        Err(faults) => {
            let remedy = match &name {
                Some(file) => format!("edit {file} where it says, then {check}"),
                None => "blaze node join NAME --layer LAYER --node-file ./blaze.yaml".to_owned(),
            };
            let all = faults.iter().map(|fault| Finding::fail(fault.to_string(), remedy.clone()));
            (lenient(), all.collect())
        }
    };
    FileRead { name: shown, file, findings }
}

/// What flow and worker have against a file that names a place in the system; one of a main service
/// alone names none.
fn faults_of_programs(file: &NodeFile) -> Vec<Fault> {
    let brokers = &file.brokers;
    let has_broker = brokers.node.is_some() || brokers.layer.is_some() || brokers.inter.is_some();
    if !has_broker && file.node.is_none() && file.layer.is_none() {
        return Vec::new();
    }
    let mut faults = file.check_for_flow();
    // A node without local services has no worker.
    if file.config.is_some()
        && let Err(more) = WorkerSettings::of(file)
    {
        let is_new = |fault: &Fault| faults.iter().all(|known| known.path != fault.path);
        let more: Vec<Fault> = more.into_iter().filter(is_new).collect();
        faults.extend(more);
    }
    faults
}

/// Whether an address can be listened on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Bind {
    Free,
    Taken,
    NoAddress,
    Denied,
}

impl Bind {
    fn of(bound: Result<(), ErrorKind>) -> Self {
        match bound {
            Ok(()) => Self::Free,
            Err(ErrorKind::AddrNotAvailable) => Self::NoAddress,
            Err(ErrorKind::PermissionDenied) => Self::Denied,
            Err(_) => Self::Taken,
        }
    }
}

/// `ports`: the admin ports and the port between flows.
pub(super) async fn ports(node: &Node) -> Vec<Finding> {
    let own = node.file.flow_id().map(|id| id.to_string());
    let programs = [&node.flow, &node.worker, &node.monitor];
    let mut findings = same_ports(programs.map(|program| (program.kind.key(), program.address)));
    for program in programs {
        let bind = match &program.answer {
            Answer::Object(_) | Answer::Starting(_) => Bind::Taken,
            Answer::Nobody(_) | Answer::Foreign(_) => {
                let bound = TcpListener::bind(program.address).map(|_| ());
                Bind::of(bound.map_err(|error| error.kind()))
            }
        };
        findings.push(admin_port(program, bind, own.as_deref(), &node.name));
    }
    if let Some(inter) = &node.file.brokers.inter {
        let (listen, slots) = (inter.listen, inter.peer_slots);
        let ports: Vec<u16> =
            (0..slots).map(|slot| announcement_port(inter.domain, slot)).collect();
        let asked = ports.clone();
        let binds = on_thread(move || asked.iter().map(|port| udp(listen, *port)).collect()).await;
        let is_running = !matches!(node.flow.answer, Answer::Nobody(_) | Answer::Foreign(_));
        let binds: Vec<Bind> = binds.unwrap_or_default();
        findings.push(inter_ports(listen, &ports, &binds, is_running, &node.name));
    }
    findings
}

fn udp(listen: Ipv4Addr, port: u16) -> Bind {
    Bind::of(UdpSocket::bind((listen, port)).map(|_| ()).map_err(|error| error.kind()))
}

/// Keys that name one port.
fn same_ports<const N: usize>(ports: [(&str, SocketAddr); N]) -> Vec<Finding> {
    let mut keys: BTreeMap<SocketAddr, Vec<&str>> = BTreeMap::new();
    // With port 0 the system gives each another one.
    for (key, address) in ports.into_iter().filter(|(_, address)| address.port() > 0) {
        keys.entry(address).or_default().push(key);
    }
    let double = keys.into_iter().filter(|(_, keys)| keys.len() > 1);
    double
        .map(|(address, keys)| {
            let (keys, last) = (keys.join(" and "), keys.last().copied().unwrap_or_default());
            let free = SocketAddr::new(address.ip(), address.port().wrapping_add(10).max(1024));
            Finding::fail(format!("{keys} are both {address}"), format!("set {last}: \"{free}\""))
        })
        .collect()
}

fn admin_port(program: &Program, bind: Bind, own: Option<&str>, file: &str) -> Finding {
    let Program { kind, address, .. } = program;
    let (key, name, port) = (kind.key(), kind.program(), address.port());
    let show = format!("ss -ltnp 'sport = :{port}'");
    let other = SocketAddr::new(address.ip(), port.wrapping_add(10).max(1024));
    let move_it = format!("stop it ({show} names it), or set {key}: \"{other}\" in {file}");
    if let Some(identity) = program.identity() {
        return match own {
            Some(own) if own != identity => {
                Finding::fail(format!("{key} {address} is taken by {name} of {identity}"), move_it)
            }
            _ => Finding::ok(format!("{name} at {address}")),
        };
    }
    match (&program.answer, bind) {
        (Answer::Starting(_), _) => Finding::ok(format!("{name} at {address} is starting")),
        (_, Bind::Free) => Finding::ok(format!("{address} is free for {name}")),
        (_, Bind::Denied) => Finding::fail(
            format!("{key} {address}: this user may not listen there"),
            format!("set {key}: \"{}\" in {file}", SocketAddr::new(address.ip(), port | 8192)),
        ),
        (_, Bind::NoAddress) => Finding::fail(
            format!("{key} {address}: no interface has this address"),
            format!("set {key}: \"127.0.0.1:{port}\" in {file}"),
        ),
        (_, Bind::Taken) => {
            Finding::fail(format!("{key} {address} is taken by another program"), move_it)
        }
    }
}

/// Other flows look for this one at the ports of the first slots.
fn inter_ports(
    listen: Ipv4Addr,
    ports: &[u16],
    binds: &[Bind],
    is_running: bool,
    file: &str,
) -> Finding {
    let (Some(first), Some(last)) = (ports.first(), ports.last()) else {
        return Finding::ok("no ports between flows");
    };
    let key = "brokers.inter.dds.domain";
    if is_running || binds.contains(&Bind::Free) {
        return Finding::ok(format!("UDP {listen}:{first} to {last}"));
    }
    if binds.contains(&Bind::NoAddress) {
        let detail = format!("no interface has {listen} (brokers.inter.dds.listen)");
        return Finding::skipped(detail, "see the check dds_interface");
    }
    Finding::fail(
        format!("all of UDP {listen}:{first} to {last} are taken, those of {key}"),
        format!(
            "stop what has them (ss -lunp 'sport >= :{first} and sport <= :{last}' names it), or \
             set {key} to another number in {file} and in those of all other flows"
        ),
    )
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::check::Outcome;
    use super::super::programs::Kind;
    use super::super::programs::tests::{absent, running};
    use super::*;

    #[test]
    fn a_port_is_free_ours_or_taken() {
        let own = Some("edge/a");
        let judge = |program: &Program, bind| admin_port(program, bind, own, "blaze.yaml");
        let ours = running(Kind::Flow, json!({"flow": "edge/a"}), "");
        assert_eq!(judge(&ours, Bind::Taken).result, Outcome::Ok);
        assert_eq!(judge(&absent(Kind::Flow), Bind::Free).result, Outcome::Ok);
        let others = running(Kind::Flow, json!({"flow": "edge/b"}), "");
        for (found, words) in [
            (judge(&others, Bind::Taken), "taken by blaze-flow of edge/b"),
            (judge(&absent(Kind::Flow), Bind::Taken), "taken by another program"),
            (judge(&absent(Kind::Flow), Bind::NoAddress), "no interface has this address"),
        ] {
            assert_eq!(found.result, Outcome::Fail);
            assert!(found.detail.contains(words) && found.detail.contains("admin.flow"));
            assert!(found.remedy.contains("set admin.flow: "), "{found:?}");
        }
    }

    #[test]
    fn two_keys_with_one_port_are_named() {
        let at = |text: &str| text.parse::<SocketAddr>().unwrap();
        let found = same_ports([
            ("admin.flow", at("127.0.0.1:9101")),
            ("admin.worker", at("127.0.0.1:9101")),
            ("admin.monitor", at("127.0.0.1:9103")),
        ]);
        assert_eq!(found.len(), 1);
        assert!(found[0].detail.starts_with("admin.flow and admin.worker"), "{found:?}");
        assert_eq!(found[0].remedy, "set admin.worker: \"127.0.0.1:9111\"");
    }

    #[test]
    fn one_free_slot_is_enough_for_a_flow() {
        let listen = Ipv4Addr::new(10, 0, 0, 1);
        let judge = |binds: &[Bind], runs| inter_ports(listen, &[7410, 7412], binds, runs, "f");
        assert_eq!(judge(&[Bind::Taken, Bind::Free], false).result, Outcome::Ok);
        assert_eq!(judge(&[Bind::Taken, Bind::Taken], true).result, Outcome::Ok);
        let taken = judge(&[Bind::Taken, Bind::Taken], false);
        assert_eq!(taken.result, Outcome::Fail);
        assert!(taken.detail.contains("7410") && taken.detail.contains("inter.dds.domain"));
    }

    #[test]
    fn all_faults_of_a_file_are_told_with_their_places() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("blaze.yaml");
        std::fs::write(&path, "layer: { name: edge, kind: edge }\nnode: { nam: a }\nflo: {}\n")
            .unwrap();
        let read = super::read(Some(path.clone()));
        assert!(read.file.is_none());
        assert!(read.findings.len() >= 2, "{:?}", read.findings);
        assert!(read.findings.iter().all(|found| found.result == Outcome::Fail));
        let all: Vec<&str> = read.findings.iter().map(|found| found.detail.as_str()).collect();
        assert!(all.iter().any(|text| text.contains("blaze.yaml:3: flo")), "{all:?}");
        let missing = super::read(Some(folder.path().join("none.yaml")));
        assert_eq!(missing.findings[0].result, Outcome::Fail);
    }

    #[test]
    fn a_file_that_only_a_program_refuses_is_examined_all_the_same() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("blaze.yaml");
        let text = "layer: { name: edge, kind: edge }\nnode: { name: a }\n\
                    brokers: { node: { redis: { url: redis://h/3 } } }\n";
        std::fs::write(&path, text).unwrap();
        let read = super::read(Some(path));
        assert!(read.file.is_some());
        assert_eq!(read.findings[0].result, Outcome::Fail);
        assert!(read.findings[0].detail.contains("brokers.node.redis.url"));
    }
}
