//! Known nodes, and what the pings of those that are asked measured.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use blaze_domain::FlowId;

use super::choose::choose;
use super::estimate::{Clock, Now, Sample};
use super::ignored::Ignored;
use super::limits::{
    ALL_ASKED, KNOWN, LATENCIES, MEASURED, PERIOD_PER_NODE, PERIOD_WHEN_OFF, SILENT_PERIODS,
    START_PINGS, STEPS_ON_THE_WAY, SWEEP,
};

/// Why a node is known.
#[derive(Debug, Default)]
struct Known {
    /// Last message of it.
    received: Option<Duration>,
    requests: bool,
    measured: bool,
    /// Number of its clock's course in that message.
    clock: Option<i64>,
}

/// What a message says of its sender's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Course {
    /// It is on the course of the last message.
    Same,
    /// It stepped, or the sender restarted.
    New,
    /// The message was overtaken by one that was sent after a step.
    Overtaken,
}

/// What pings of one node measured.
#[derive(Debug, Default)]
pub(super) struct Series {
    pub(super) clock: Clock,
    /// The last latencies, in seconds, oldest first.
    pub(super) latencies: VecDeque<f64>,
    /// Last answer, by the monotonic clock.
    pub(super) answered: Option<Duration>,
    pub(super) sent: u64,
    pub(super) lost: u64,
    /// Pings that are still to follow a second apart.
    pub(super) start: u8,
}

impl Series {
    pub(super) fn add(&mut self, sample: Sample, now: Now) {
        self.clock.add(sample, now);
        if self.latencies.len() >= LATENCIES {
            self.latencies.pop_front();
        }
        self.latencies.push_back(sample.latency_s());
        self.answered = Some(now.monotonic);
    }

    /// The value below which a share of the latencies lies, in seconds.
    pub(super) fn quantile(&self, share: f64) -> Option<f64> {
        let mut sorted: Vec<f64> = self.latencies.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let rank = (share * sorted.len() as f64).ceil() as usize;
        sorted.get(rank.saturating_sub(1)).copied()
    }
}

/// All known nodes.
#[derive(Debug)]
pub(super) struct Nodes {
    own: FlowId,
    /// Configured period; zero: no pings.
    configured: Duration,
    known: BTreeMap<FlowId, Known>,
    series: BTreeMap<FlowId, Series>,
    changed: bool,
    sweep_at: Duration,
}

impl Nodes {
    pub(super) fn new(own: FlowId, configured: Duration) -> Self {
        Self {
            own,
            configured,
            known: BTreeMap::new(),
            series: BTreeMap::new(),
            changed: false,
            sweep_at: Duration::ZERO,
        }
    }

    pub(super) fn set_period(&mut self, configured: Duration) {
        self.configured = configured;
        self.changed = true;
    }

    /// Mean time between two pings of a node; meaningless while pings are off.
    pub(super) fn period(&self) -> Duration {
        let count = u32::try_from(self.known.len()).unwrap_or(u32::MAX);
        self.configured.max(PERIOD_PER_NODE.saturating_mul(count))
    }

    pub(super) fn is_off(&self) -> bool {
        self.configured.is_zero()
    }

    pub(super) fn is_known(&self, node: &FlowId) -> bool {
        self.known.contains_key(node)
    }

    /// Whether all known nodes are asked.
    pub(super) fn are_few(&self) -> bool {
        self.known.len() <= ALL_ASKED
    }

    /// Replaces the nodes that request a topic of pings. Returns how many were too many.
    pub(super) fn set_requesters(&mut self, nodes: impl IntoIterator<Item = FlowId>) -> u64 {
        self.set(nodes, KNOWN, |known| &mut known.requests)
    }

    /// Replaces the nodes whose topics are measured. Returns how many were too many.
    pub(super) fn set_measured(&mut self, nodes: impl IntoIterator<Item = FlowId>) -> u64 {
        self.changed = true;
        self.set(nodes, MEASURED, |known| &mut known.measured)
    }

    fn set(
        &mut self,
        nodes: impl IntoIterator<Item = FlowId>,
        most: usize,
        reason: impl Fn(&mut Known) -> &mut bool,
    ) -> u64 {
        let nodes: BTreeSet<FlowId> = nodes.into_iter().filter(|node| *node != self.own).collect();
        let mut too_many = nodes.len().saturating_sub(most) as u64;
        let nodes: BTreeSet<FlowId> = nodes.into_iter().take(most).collect();
        for (node, known) in &mut self.known {
            *reason(known) = nodes.contains(node);
        }
        for node in nodes {
            match self.entry(&node) {
                Some(known) => *reason(known) = true,
                None => too_many += 1,
            }
        }
        let before = self.known.len();
        self.known.retain(|_, known| known.stays(None));
        self.changed |= self.known.len() != before;
        too_many
    }

    /// Notes a message of a node.
    pub(super) fn received(
        &mut self,
        now: Now,
        node: &FlowId,
        clock: Option<i64>,
    ) -> Result<Course, Ignored> {
        let known = self.entry(node).ok_or(Ignored::TooMany)?;
        known.received = Some(now.monotonic);
        Ok(known.course(clock))
    }

    fn entry(&mut self, node: &FlowId) -> Option<&mut Known> {
        if !self.known.contains_key(node) {
            if self.known.len() >= KNOWN {
                return None;
            }
            self.changed = true;
            self.known.insert(node.clone(), Known::default());
        }
        self.known.get_mut(node)
    }

    /// Forgets silent nodes, and follows changes of the known ones. True if other nodes are asked.
    pub(super) fn update(&mut self, now: Duration) -> bool {
        if self.sweep_at <= now {
            self.sweep(now);
        }
        if !std::mem::take(&mut self.changed) {
            return false;
        }
        let asked = self.chosen();
        let few = self.are_few();
        self.series.retain(|node, _| asked.contains(node));
        for node in asked {
            let series = self.series.entry(node);
            series.or_insert_with(|| Series { start: START_PINGS, ..Series::default() });
        }
        if !few {
            // With many nodes, a start of all at once would flood each layer.
            self.series.values_mut().for_each(|series| series.start = 0);
        }
        true
    }

    fn chosen(&self) -> BTreeSet<FlowId> {
        if self.is_off() {
            return BTreeSet::new();
        }
        let mut asked = choose(&self.own, self.known.keys());
        let measured = self.known.iter().filter(|(_, known)| known.measured);
        asked.extend(measured.map(|(node, _)| node.clone()));
        asked
    }

    fn sweep(&mut self, now: Duration) {
        let period = if self.is_off() { PERIOD_WHEN_OFF.max(self.period()) } else { self.period() };
        let since = now.checked_sub(period.saturating_mul(SILENT_PERIODS));
        let before = self.known.len();
        self.known.retain(|_, known| known.stays(since));
        self.changed |= self.known.len() != before;
        self.sweep_at = now.saturating_add(SWEEP);
    }

    /// When `update` has something to do.
    pub(super) fn deadline(&self) -> Duration {
        if self.changed { Duration::ZERO } else { self.sweep_at }
    }

    /// Drops the samples of a node after a step of its clock, and starts it anew.
    pub(super) fn restart(&mut self, node: &FlowId) {
        let few = self.are_few();
        if let Some(series) = self.series.get_mut(node) {
            series.clock.clear();
            series.start = if few { START_PINGS } else { 0 };
        }
    }

    /// The same for all nodes, after a step of the clock here.
    pub(super) fn restart_all(&mut self) {
        let nodes: Vec<FlowId> = self.series.keys().cloned().collect();
        nodes.iter().for_each(|node| self.restart(node));
    }

    pub(super) fn asked(&self) -> impl Iterator<Item = (&FlowId, &Series)> {
        self.series.iter()
    }

    pub(super) fn series(&self, node: &FlowId) -> Option<&Series> {
        self.series.get(node)
    }

    pub(super) fn series_mut(&mut self, node: &FlowId) -> Option<&mut Series> {
        self.series.get_mut(node)
    }
}

impl Known {
    fn course(&mut self, clock: Option<i64>) -> Course {
        let (Some(number), before) = (clock, self.clock) else { return Course::Same };
        let Some(before) = before.filter(|before| *before != number) else {
            self.clock = clock;
            return Course::Same;
        };
        if (1..=STEPS_ON_THE_WAY).contains(&before.saturating_sub(number)) {
            return Course::Overtaken;
        }
        self.clock = clock;
        Course::New
    }

    /// Whether there is a reason left to know it: a message after a moment, or at any time.
    fn stays(&self, since: Option<Duration>) -> bool {
        let received = self.received.is_some_and(|at| since.is_none_or(|since| at >= since));
        self.requests || self.measured || received
    }
}
