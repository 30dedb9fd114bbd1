//! The workers that are known: which are connected here, and what they said they have. It lives
//! outside of the revision and is gone with the process; a worker says it anew when it comes back.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;

use blaze_domain::config::Timestamp;
use blaze_domain::{InstanceName, LayerName, NodeName, ServiceName};
use parking_lot::Mutex;

/// Workers that are remembered, at most; of those that have gone the ones seen longest ago give
/// way.
const MAX_WORKERS: usize = 10_000;
/// Running instances that one worker may tell of; what is beyond is not kept.
const MAX_SERVICES: usize = 10_000;
/// Roll-outs that one worker may tell of; what is beyond is not kept.
const MAX_ROLLOUTS: usize = 1000;
/// What is kept of the reason of a failure, in characters.
const MAX_REASON: usize = 500;
/// Longest uid of a roll-out and word for its phase that are kept, in bytes.
const MAX_WORD_BYTES: usize = 64;

/// Which worker: of one layer and node there may be several, of which one answers.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct WorkerName {
    /// Layer that it is of.
    pub layer: LayerName,
    /// Node that it runs on.
    pub node: Option<NodeName>,
    /// Its own name, in the words of its start.
    pub id: String,
}

/// What runs where, as its worker says.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Running {
    /// Service.
    pub service: ServiceName,
    /// Which of several.
    pub instance: InstanceName,
    /// Where it runs.
    pub node: Option<NodeName>,
}

/// How it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunningState {
    /// `starting`, `ready`, `unhealthy` or `stopping`.
    pub state: String,
    /// Revision of the configuration that it runs with.
    pub config_revision: u64,
    /// Its hash.
    pub config_hash: String,
}

/// How a roll-out goes on one canary node, as its worker says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RolloutReport {
    /// Of the roll-out.
    pub uid: String,
    /// Where.
    pub node: Option<NodeName>,
    /// `pending`, `applied` or `failed`.
    pub phase: String,
    /// Why it failed.
    pub reason: String,
}

impl RolloutReport {
    /// The same as long as it may be; `None`: it makes no sense.
    fn bounded(self) -> Option<Self> {
        if self.uid.is_empty() || self.uid.len().max(self.phase.len()) > MAX_WORD_BYTES {
            return None;
        }
        let reason = self.reason.chars().filter(|letter| !letter.is_control());
        Some(Self { reason: reason.take(MAX_REASON).collect(), ..self })
    }
}

/// What is known of a roll-out on one node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Told {
    /// `pending`, `applied` or `failed`.
    pub(crate) phase: String,
    /// Revision of what its worker has.
    pub(crate) revision: u64,
    /// Why it failed.
    pub(crate) reason: String,
}

/// What a worker says it has.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Acknowledged {
    /// Revision up to which it knows its view.
    pub revision: u64,
    /// Digest of what it holds.
    pub digest: String,
    /// What runs at it.
    pub services: BTreeMap<Running, RunningState>,
    /// How roll-outs go.
    pub rollouts: Vec<RolloutReport>,
}

impl Acknowledged {
    /// What was said, as far as there is room for it.
    #[must_use]
    pub fn new(
        revision: u64,
        digest: String,
        services: impl IntoIterator<Item = (Running, RunningState)>,
        rollouts: impl IntoIterator<Item = RolloutReport>,
    ) -> Self {
        Self {
            revision,
            digest,
            services: services.into_iter().take(MAX_SERVICES).collect(),
            rollouts: rollouts
                .into_iter()
                .take(MAX_ROLLOUTS)
                .filter_map(RolloutReport::bounded)
                .collect(),
        }
    }
}

/// One worker.
#[derive(Debug, Clone)]
pub(crate) struct Worker {
    pub(crate) version: String,
    /// Its connection, if it has one: the newest counts.
    connection: Option<u64>,
    /// When it last said something.
    pub(crate) last_seen: Timestamp,
    /// Where it is, as far as is known.
    address: Option<IpAddr>,
    pub(crate) has: Acknowledged,
}

impl Worker {
    pub(crate) fn is_connected(&self) -> bool {
        self.connection.is_some()
    }
}

#[derive(Debug, Default)]
struct Known {
    workers: BTreeMap<WorkerName, Worker>,
    connections: u64,
}

/// All of them.
#[derive(Debug, Default)]
pub(crate) struct Workers {
    known: Mutex<Known>,
}

/// A worker's open connection; it counts as gone when this is dropped.
#[derive(Debug)]
pub struct WorkerSession {
    workers: Arc<Workers>,
    name: WorkerName,
    connection: u64,
    /// For the audit.
    address: IpAddr,
}

/// There are more workers than one process keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{MAX_WORKERS} workers are connected, more cannot be")]
pub(crate) struct TooMany;

impl Workers {
    /// A worker has come. One of the same name that is still connected has been replaced by it.
    pub(crate) fn enter(
        self: &Arc<Self>,
        name: WorkerName,
        version: String,
        has: Acknowledged,
        now: Timestamp,
    ) -> Result<WorkerSession, TooMany> {
        let mut known = self.known.lock();
        if known.workers.len() >= MAX_WORKERS && !known.workers.contains_key(&name) {
            known.forget_one()?;
        }
        // Each life of a worker has another name: of those that have gone on this node, this is the
        // next life.
        known.workers.retain(|other, worker| {
            worker.is_connected() || (&other.layer, &other.node) != (&name.layer, &name.node)
        });
        known.connections += 1;
        let connection = known.connections;
        let worker =
            Worker { version, connection: Some(connection), last_seen: now, address: None, has };
        known.workers.insert(name.clone(), worker);
        Ok(WorkerSession {
            workers: Arc::clone(self),
            name,
            connection,
            address: IpAddr::V4(Ipv4Addr::UNSPECIFIED),
        })
    }

    /// All that a filter lets through, in the order of their names.
    pub(crate) fn list(&self, wanted: impl Fn(&WorkerName) -> bool) -> Vec<(WorkerName, Worker)> {
        let known = self.known.lock();
        let workers = known.workers.iter().filter(|(name, _)| wanted(name));
        workers.map(|(name, worker)| (name.clone(), worker.clone())).collect()
    }

    /// Of each node the worker that is connected, else the one that was seen last: layer, revision,
    /// digest, whether it is connected.
    pub(crate) fn of_nodes<T>(
        &self,
        mut read: impl FnMut(&WorkerName, &Worker) -> T,
    ) -> BTreeMap<NodeName, T> {
        let known = self.known.lock();
        let mut best: BTreeMap<&NodeName, (&WorkerName, &Worker)> = BTreeMap::new();
        for (name, worker) in &known.workers {
            let Some(node) = &name.node else { continue };
            let weight = |worker: &Worker| (worker.is_connected(), worker.last_seen);
            if best.get(node).is_none_or(|(_, held)| weight(held) <= weight(worker)) {
                best.insert(node, (name, worker));
            }
        }
        best.into_iter().map(|(node, (name, worker))| (node.clone(), read(name, worker))).collect()
    }

    /// Other workers of the same layer and node that are connected: name and address, for people.
    pub(crate) fn beside(&self, worker: &WorkerName) -> Vec<String> {
        let first = WorkerName { id: String::new(), ..worker.clone() };
        let known = self.known.lock();
        let of_node = known
            .workers
            .range(first..)
            .take_while(|(other, _)| (&other.layer, &other.node) == (&worker.layer, &worker.node));
        let others = of_node.filter(|(name, other)| *name != worker && other.is_connected());
        let place = |(name, other): (&WorkerName, &Worker)| match other.address {
            Some(address) => format!("{} at {address}", name.id),
            None => name.id.clone(),
        };
        others.map(place).collect()
    }

    /// What is said of a roll-out, by node, with the layer of the worker that says it. The node's
    /// own worker knows best, then one that is connected, then one for which it failed, then the
    /// one that was heard last.
    pub(crate) fn of_rollout(&self, uid: &str) -> BTreeMap<NodeName, (LayerName, Told)> {
        let known = self.known.lock();
        let mut best: BTreeMap<NodeName, (_, LayerName, Told)> = BTreeMap::new();
        for (name, worker) in &known.workers {
            for report in worker.has.rollouts.iter().filter(|report| report.uid == uid) {
                let Some(node) = &report.node else { continue };
                let is_own = name.node.as_ref() == Some(node);
                let has_failed = report.phase == "failed";
                let weight = (is_own, worker.is_connected(), has_failed, worker.last_seen);
                if best.get(node).is_none_or(|(held, ..)| *held <= weight) {
                    let told = Told {
                        phase: report.phase.clone(),
                        revision: worker.has.revision,
                        reason: report.reason.clone(),
                    };
                    best.insert(node.clone(), (weight, name.layer.clone(), told));
                }
            }
        }
        best.into_iter().map(|(node, (_, layer, told))| (node, (layer, told))).collect()
    }
}

impl Known {
    fn forget_one(&mut self) -> Result<(), TooMany> {
        let gone = self.workers.iter().filter(|(_, worker)| !worker.is_connected());
        let oldest = gone.min_by_key(|(_, worker)| worker.last_seen).map(|(name, _)| name.clone());
        self.workers.remove(&oldest.ok_or(TooMany)?);
        Ok(())
    }
}

impl WorkerSession {
    /// The same with the address of the worker.
    pub(crate) fn with_address(mut self, address: IpAddr) -> Self {
        self.address = address;
        if let Some(worker) = self.workers.known.lock().workers.get_mut(&self.name) {
            worker.address = Some(address);
        }
        self
    }

    /// Where the worker is.
    pub(crate) fn address(&self) -> IpAddr {
        self.address
    }

    /// Which worker.
    #[must_use]
    pub fn name(&self) -> &WorkerName {
        &self.name
    }

    /// What it has said now. A connection that was replaced changes nothing.
    pub(crate) fn said(&self, has: Acknowledged, now: Timestamp) {
        let mut known = self.workers.known.lock();
        if let Some(worker) = known.workers.get_mut(&self.name)
            && worker.connection == Some(self.connection)
        {
            worker.last_seen = now;
            worker.has = has;
        }
    }
}

impl Drop for WorkerSession {
    fn drop(&mut self) {
        let mut known = self.workers.known.lock();
        if let Some(worker) = known.workers.get_mut(&self.name)
            && worker.connection == Some(self.connection)
        {
            worker.connection = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(id: &str) -> WorkerName {
        WorkerName {
            layer: "edge".parse().unwrap(),
            node: Some("robot-1".parse().unwrap()),
            id: id.to_owned(),
        }
    }

    fn at(seconds: i64) -> Timestamp {
        Timestamp::from_millis(seconds * 1000)
    }

    #[test]
    fn the_newest_connection_of_a_worker_counts() {
        let workers = Arc::new(Workers::default());
        let enter = |second| {
            workers.enter(name("w"), "1".into(), Acknowledged::default(), at(second)).unwrap()
        };
        let (old, new) = (enter(1), enter(2));
        old.said(Acknowledged::new(7, "old".into(), [], []), at(3));
        new.said(Acknowledged::new(9, "new".into(), [], []), at(4));
        old.said(Acknowledged::new(8, "old".into(), [], []), at(5));
        drop(old);
        let [(_, worker)] = &workers.list(|_| true)[..] else {
            panic!("one worker");
        };
        assert!(worker.is_connected());
        assert_eq!((worker.has.revision, worker.last_seen), (9, at(4)));
        drop(new);
        assert!(!workers.list(|_| true)[0].1.is_connected());
    }

    #[test]
    fn the_next_life_of_a_worker_takes_the_place_of_the_last() {
        let workers = Arc::new(Workers::default());
        let enter =
            |id| workers.enter(name(id), String::new(), Acknowledged::default(), at(1)).unwrap();
        let first = enter("a").with_address(Ipv4Addr::LOCALHOST.into());
        let beside = enter("b");
        assert_eq!(workers.beside(beside.name()), ["a at 127.0.0.1"]);
        drop(first);
        let _next = enter("c");
        let ids: Vec<_> = workers.list(|_| true).into_iter().map(|(name, _)| name.id).collect();
        assert_eq!(ids, ["b", "c"], "who is connected stays");
        drop(beside);
    }

    #[test]
    fn who_has_gone_gives_way_and_who_is_here_stays() {
        let workers = Arc::new(Workers::default());
        let enter = |index: usize| {
            let second = i64::try_from(index).unwrap();
            let name = WorkerName {
                node: Some(format!("robot-{index}").parse().unwrap()),
                ..name(&format!("w{index}"))
            };
            workers.enter(name, String::new(), Acknowledged::default(), at(second))
        };
        let mut sessions: Vec<_> = (0..MAX_WORKERS).map(|index| enter(index).unwrap()).collect();
        assert_eq!(enter(MAX_WORKERS).unwrap_err(), TooMany);
        sessions.drain(5..7);
        let last = enter(MAX_WORKERS).unwrap();
        let names = workers.list(|name| ["w5", "w6", "w10000"].contains(&name.id.as_str()));
        let ids: Vec<_> = names.iter().map(|(name, _)| name.id.as_str()).collect();
        assert_eq!(ids, ["w10000", "w6"]);
        drop(last);
    }
}
