//! When rates are worked out anew, and on which budgets.
//!
//! ```text
//! node file ─────────► limits ─┐
//! wire bytes, Σ s ───► ω ──────┼─► budgets of s·α ─► rates of lanes ─► gates
//! Feedback ──► capacity ───────┘        ▲ topics, sizes, advertised rates
//! ```
//!
//! It is anew when a topic or lane comes or goes, a size grows, a measured rate or the wire factor
//! moves, a capacity changes, or the node file does. All of these together cost one run at most
//! every 20 ms; sizes that grow alone one every 100 ms.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use blaze_domain::node_file::{BandwidthSection, WireOverhead};
use blaze_domain::{FlowId, LayerName};

use super::rates::{Budgets, Demand, FlowBudget, Rates, rates, standard_load, terms};
use super::wire_factor::{FIRST, Totals, WireFactor, budget};

/// Between two runs.
const BETWEEN: Duration = Duration::from_millis(20);
/// Between two runs where nothing but sizes has grown: those of a topic that has just begun grow
/// with every few messages.
const BETWEEN_SIZES: Duration = Duration::from_millis(100);
/// Between two looks at what is measured.
const LOOK: Duration = Duration::from_millis(500);
/// A budget is believed anew when it has moved by this share.
const MOVED: f64 = 0.01;
/// Between two lines of the log about what does not fit.
const TOLD_EVERY: Duration = Duration::from_secs(10);

/// What the link to one flow carries, in wire bytes per second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LinkRate {
    /// Nothing is known to be less than its limit.
    Free,
    /// The estimate is still rising, and so much may be sent now: that thins large topics alone.
    Ramping(f64),
    /// So much, as was seen.
    Carries(f64),
}

/// The state of one flow's allocation.
#[derive(Debug, Default)]
pub struct Limiter {
    bandwidth: BandwidthSection,
    /// The links to all flows that there are.
    measured: BTreeMap<FlowId, LinkRate>,
    all: WireFactor,
    links: BTreeMap<LayerName, WireFactor>,
    /// Flows that lanes go to, by layer, and what standard topics take of the links to them; as of
    /// the last run.
    receivers: BTreeMap<LayerName, BTreeSet<FlowId>>,
    standard: BTreeMap<FlowId, f64>,
    /// Budgets that the last run was made with.
    used: Option<Budgets>,
    due: bool,
    grown: bool,
    ran: Option<Instant>,
    looked: Option<Instant>,
    last: Option<Rates>,
    runs: u64,
    /// When it was last told whether everything fits, and what.
    told: Option<(Instant, bool)>,
}

impl Limiter {
    /// A limiter that has not run.
    #[must_use]
    pub fn new(bandwidth: BandwidthSection) -> Self {
        Self { bandwidth, due: true, ..Self::default() }
    }

    /// Takes what the node file says now.
    pub fn set_bandwidth(&mut self, bandwidth: BandwidthSection) {
        self.bandwidth = bandwidth;
        self.due = true;
    }

    /// What the node file says.
    #[must_use]
    pub fn bandwidth(&self) -> &BandwidthSection {
        &self.bandwidth
    }

    /// Something has changed that the rates depend on.
    pub fn touch(&mut self) {
        self.due = true;
    }

    /// A size has grown.
    pub fn size_grown(&mut self) {
        self.grown = true;
    }

    /// Whether it is time to look at what is measured; then [`Limiter::look`] is to be called.
    pub fn is_time_to_look(&mut self, now: Instant) -> bool {
        let due = self.looked.is_none_or(|at| now.saturating_duration_since(at) >= LOOK);
        if due {
            self.looked = Some(now);
        }
        due
    }

    /// Takes what was measured: totals of all links together and of those to each layer, and what
    /// the links can carry.
    pub fn look(
        &mut self,
        now: Instant,
        all: Totals,
        links: &BTreeMap<LayerName, Totals>,
        measured: BTreeMap<FlowId, LinkRate>,
    ) {
        self.all.sample(now, all);
        self.links.retain(|layer, _| links.contains_key(layer));
        for (layer, totals) in links {
            self.links.entry(layer.clone()).or_default().sample(now, *totals);
        }
        self.measured = measured;
        let now_there = self.budgets();
        self.due |= self.used.as_ref().is_none_or(|before| has_moved(before, &now_there));
        if let Some(rates) = &self.last {
            tell(&mut self.told, self.bandwidth.limit_mbps, rates, now);
        }
    }

    /// Whether rates have to be worked out now. A change that comes right after a run waits a
    /// little.
    #[must_use]
    pub fn is_due(&self, now: Instant) -> bool {
        let waited = |pause| self.ran.is_none_or(|at| now.saturating_duration_since(at) >= pause);
        (self.due && waited(BETWEEN)) || (self.grown && waited(BETWEEN_SIZES))
    }

    /// The budget of the process, and those of links that have one of their own or can carry less.
    fn budgets(&self) -> Budgets {
        let of_layer = |layer: &LayerName| {
            let limit = self.bandwidth.link_limit_bytes_per_s(layer)?;
            Some((layer.clone(), self.budget(limit, Some(layer), 1.0)))
        };
        let of_flow = |(flow, rate): (&FlowId, &LinkRate)| {
            let (carries, is_ramping) = match *rate {
                LinkRate::Free => return None,
                LinkRate::Ramping(bytes_per_s) => (bytes_per_s, true),
                LinkRate::Carries(bytes_per_s) => (bytes_per_s, false),
            };
            let bytes_per_s =
                self.budget(carries, Some(&flow.layer), self.control_share(&flow.layer));
            let budget = FlowBudget { bytes_per_s, is_ramping };
            Some((flow.clone(), budget))
        };
        Budgets {
            process: self.budget(self.bandwidth.limit_bytes_per_s(), None, 1.0),
            links: self.bandwidth.links.keys().filter_map(of_layer).collect(),
            flows: self.measured.iter().filter_map(of_flow).collect(),
        }
    }

    /// What a limit of all links (`None`) or of those to a layer leaves, in bytes per second of `s
    /// · α`. `share` of the control messages there go that way.
    fn budget(&self, limit: f64, layer: Option<&LayerName>, share: f64) -> f64 {
        let link = layer.map_or(Some(&self.all), |layer| self.links.get(layer));
        let control = link.map_or(0.0, WireFactor::control_bytes_per_s) * share;
        match self.bandwidth.wire_overhead {
            WireOverhead::Measured => budget(limit, control, self.of_messages(layer)),
            WireOverhead::Off => limit,
        }
    }

    /// What messages to a layer cost; where that is not known, what all of them do.
    fn of_messages(&self, layer: Option<&LayerName>) -> f64 {
        let overhead = self.bandwidth.overhead;
        let own = layer.and_then(|layer| self.links.get(layer)?.of_messages(overhead));
        own.or_else(|| self.all.of_messages(overhead)).unwrap_or(FIRST)
    }

    /// How much of the control messages to a layer goes to one flow of it.
    fn control_share(&self, layer: &LayerName) -> f64 {
        let flows = self.measured.keys().filter(|flow| flow.layer == *layer).count();
        1.0 / flows.max(1) as f64
    }

    /// Works out the rates.
    pub fn run(&mut self, now: Instant, demands: &[Demand<'_>]) -> &Rates {
        let budgets = self.budgets();
        let terms = terms(&self.bandwidth);
        let rates = rates(&budgets, &terms, demands);
        let on_the_wire = |(flow, bytes_per_s): (FlowId, f64)| {
            let control = self.links.get(&flow.layer).map_or(0.0, WireFactor::control_bytes_per_s);
            let wire = bytes_per_s * self.of_messages(Some(&flow.layer))
                + control * self.control_share(&flow.layer);
            (flow, wire)
        };
        let standard =
            standard_load(&rates, &terms, demands).into_iter().map(on_the_wire).collect();
        self.standard = standard;
        self.note_receivers(demands);
        tell(&mut self.told, self.bandwidth.limit_mbps, &rates, now);
        self.used = Some(budgets);
        (self.due, self.grown) = (false, false);
        self.ran = Some(now);
        self.runs += 1;
        self.last.insert(rates)
    }

    fn note_receivers(&mut self, demands: &[Demand<'_>]) {
        self.receivers.clear();
        for lane in demands.iter().flat_map(|demand| &demand.lanes) {
            if let Some(receiver) = lane.receiver {
                let of_layer = self.receivers.entry(lane.layer.clone()).or_default();
                if !of_layer.contains(receiver) {
                    of_layer.insert(receiver.clone());
                }
            }
        }
    }

    /// What was worked out last; `None` before the first run.
    #[must_use]
    pub fn last(&self) -> Option<&Rates> {
        self.last.as_ref()
    }

    /// Layers that lanes go to, or whose links have a limit of their own.
    #[must_use]
    pub fn layers(&self) -> BTreeSet<LayerName> {
        self.receivers.keys().chain(self.bandwidth.links.keys()).cloned().collect()
    }

    /// ω of all links (`None`) or of those to a layer; `None` while too little was sent there to
    /// tell, and 1 where it is left out.
    #[must_use]
    pub fn wire_factor(&self, layer: Option<&LayerName>) -> Option<f64> {
        let process = self.bandwidth.limit_bytes_per_s();
        let limit =
            layer.and_then(|layer| self.bandwidth.link_limit_bytes_per_s(layer)).unwrap_or(process);
        let factor = layer.map_or(Some(&self.all), |layer| self.links.get(layer));
        if self.bandwidth.wire_overhead == WireOverhead::Measured {
            factor?.of_messages(self.bandwidth.overhead)?;
        }
        // What has to be allowed on the wire for a byte of `s · α`.
        Some(limit / self.budget(limit, layer, 1.0).max(f64::MIN_POSITIVE))
    }

    /// Wire bytes per second that the links to all flows (`None`) or to those of a layer carry that
    /// lanes go to; `None` while one of them was not seen to carry less than its limit.
    #[must_use]
    pub fn measured_bytes_per_s(&self, layer: Option<&LayerName>) -> Option<f64> {
        let mut sum: Option<f64> = None;
        for (of, flows) in &self.receivers {
            if layer.is_some_and(|layer| layer != of) {
                continue;
            }
            for flow in flows {
                match self.measured.get(flow) {
                    Some(LinkRate::Carries(bytes_per_s)) => *sum.get_or_insert(0.0) += *bytes_per_s,
                    Some(LinkRate::Free | LinkRate::Ramping(_)) | None => return None,
                }
            }
        }
        sum
    }

    /// Wire bytes per second that the standard topics to each flow need, control messages included.
    #[must_use]
    pub fn standard_wire_bytes_per_s(&self) -> &BTreeMap<FlowId, f64> {
        &self.standard
    }

    /// How often rates were worked out.
    #[must_use]
    pub fn runs(&self) -> u64 {
        self.runs
    }
}

/// Says in the log whether everything fits, when that has changed, and not more often than every
/// few seconds.
fn tell(told: &mut Option<(Instant, bool)>, limit_mbps: f64, rates: &Rates, now: Instant) {
    let (before, at) = told.map_or((true, None), |(at, feasible)| (feasible, Some(at)));
    if rates.feasible == before
        || at.is_some_and(|at| now.saturating_duration_since(at) < TOLD_EVERY)
    {
        return;
    }
    *told = Some((now, rates.feasible));
    if rates.feasible {
        tracing::info!("what is published fits the budget again");
    } else {
        let links: Vec<&str> = rates.infeasible_links.iter().map(LayerName::as_str).collect();
        tracing::warn!(
            limit_mbps,
            ?links,
            "what is published does not fit the budget even at its lowest rates; see /v1/allocation"
        );
    }
}

/// Whether a budget has come, gone or moved.
fn has_moved(before: &Budgets, after: &Budgets) -> bool {
    let moved = |before: f64, after: f64| (after - before).abs() > MOVED * before;
    let of_links = before.links.len() != after.links.len()
        || after.links.iter().any(|(layer, after)| {
            before.links.get(layer).is_none_or(|before| moved(*before, *after))
        });
    let of_flows = before.flows.len() != after.flows.len()
        || after.flows.iter().any(|(flow, after)| {
            let differs = |before: &FlowBudget| {
                before.is_ramping != after.is_ramping
                    || moved(before.bytes_per_s, after.bytes_per_s)
            };
            before.flows.get(flow).is_none_or(differs)
        });
    moved(before.process, after.process) || of_links || of_flows
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::limit::pacer::allocated;
    use crate::limit::rates::LaneDemand;

    const SECOND: Duration = Duration::from_secs(1);

    fn cloud() -> LayerName {
        "cloud".parse().unwrap()
    }

    fn flow(name: &str) -> FlowId {
        name.parse().unwrap()
    }

    fn topic<'a>(topic: &'a str, size_bytes: u64, receivers: &'a [FlowId]) -> Demand<'a> {
        let lane = |receiver: &'a FlowId| LaneDemand {
            layer: &receiver.layer,
            receiver: Some(receiver),
            max_rate_hz: None,
        };
        Demand {
            topic,
            size_bytes,
            advertised_hz: 100.0,
            class: None,
            lanes: receivers.iter().map(lane).collect(),
        }
    }

    fn camera(receivers: &[FlowId]) -> Demand<'_> {
        topic("camera", 100_000, receivers)
    }

    fn limiter(limit_mbps: f64, wire_overhead: WireOverhead) -> Limiter {
        Limiter::new(BandwidthSection {
            limit_mbps,
            wire_overhead,
            per_message_share: 1.0,
            overhead: 1.0,
            ..BandwidthSection::default()
        })
    }

    /// The links to these flows are measured.
    fn look(limiter: &mut Limiter, now: Instant, links: &[(&str, LinkRate)]) {
        let links = links.iter().map(|(name, rate)| (flow(name), *rate)).collect();
        limiter.look(now, Totals::default(), &BTreeMap::new(), links);
    }

    /// What a camera to one flow may send.
    fn camera_hz(limiter: &mut Limiter) -> f64 {
        limiter.run(Instant::now(), &[camera(&[flow("cloud/a")])]).topics[0].lanes_hz[0]
    }

    #[test]
    fn without_the_wire_factor_the_whole_limit_is_given_out() {
        let mut limiter = limiter(8.0, WireOverhead::Off);
        assert!((camera_hz(&mut limiter) - 1_048_576.0 / 100_000.0).abs() < 1e-9);
        assert_eq!(limiter.wire_factor(None), Some(1.0));
    }

    #[test]
    fn a_limit_that_changes_makes_it_due_and_a_second_change_waits() {
        let start = Instant::now();
        let mut limiter = limiter(8.0, WireOverhead::Off);
        assert!(limiter.is_due(start));
        limiter.run(start, &[]);
        assert!(!limiter.is_due(start + SECOND));
        limiter.set_bandwidth(BandwidthSection { limit_mbps: 4.0, ..limiter.bandwidth().clone() });
        assert!(
            !limiter.is_due(start + Duration::from_millis(5)) && limiter.is_due(start + BETWEEN)
        );
    }

    #[test]
    fn sizes_that_grow_wait_longer_than_what_else_changes() {
        let start = Instant::now();
        let mut limiter = limiter(8.0, WireOverhead::Off);
        limiter.run(start, &[]);
        limiter.size_grown();
        assert!(!limiter.is_due(start + BETWEEN) && limiter.is_due(start + BETWEEN_SIZES));
        limiter.touch();
        assert!(limiter.is_due(start + BETWEEN));
        limiter.run(start + BETWEEN, &[]);
        assert!(!limiter.is_due(start + SECOND), "both are settled by one run");
    }

    #[test]
    fn the_factor_is_followed_when_it_has_moved_and_not_before() {
        let start = Instant::now();
        let (cloud, receivers) = (cloud(), [flow("cloud/a")]);
        let mut limiter = limiter(80.0, WireOverhead::Measured);
        assert_eq!(limiter.wire_factor(None), None, "nothing was measured");
        let mut runs = Vec::new();
        for second in 0..120u32 {
            let now = start + SECOND * second;
            let seconds = u64::from(second);
            // From the 60th second on the wire carries a fifth more for the same payload.
            let extra = seconds.saturating_sub(60) * 220_000;
            let totals = Totals {
                user_wire: seconds * 1_100_000 + extra,
                control_wire: seconds * 1_000,
                reckoned: seconds * 1_000_000,
            };
            limiter.look(now, totals, &BTreeMap::from([(cloud.clone(), totals)]), BTreeMap::new());
            if limiter.is_due(now) {
                limiter.run(now, &[camera(&receivers)]);
                runs.push(second);
            }
        }
        let quiet = runs.iter().filter(|second| (30..60).contains(*second)).count();
        assert_eq!(quiet, 0, "{runs:?}");
        assert!(runs.iter().any(|second| (61..70).contains(second)) && runs.len() < 60, "{runs:?}");
        for factor in
            [limiter.wire_factor(None).unwrap(), limiter.wire_factor(Some(&cloud)).unwrap()]
        {
            assert!((factor - 1.32 / allocated(1.0)).abs() < 0.01, "{factor}");
        }
        let fog: LayerName = "fog".parse().unwrap();
        assert_eq!(limiter.wire_factor(Some(&fog)), None);
    }

    #[test]
    fn a_link_that_carries_less_than_its_limit_bounds_its_lanes() {
        let cloud = cloud();
        let mut limiter = limiter(80.0, WireOverhead::Off);
        limiter.set_bandwidth(BandwidthSection {
            links: BTreeMap::from([(
                cloud.clone(),
                blaze_domain::node_file::LinkLimit { limit_mbps: 40.0 },
            )]),
            ..limiter.bandwidth().clone()
        });
        assert!((camera_hz(&mut limiter) - 5.0 * 1_048_576.0 / 100_000.0).abs() < 1e-9);
        look(&mut limiter, Instant::now(), &[("cloud/a", LinkRate::Carries(1e6))]);
        assert!(limiter.due);
        assert!((camera_hz(&mut limiter) - 10.0).abs() < 1e-9);
        assert_eq!(limiter.measured_bytes_per_s(Some(&cloud)), Some(1e6));
    }

    /// A replica that gets nothing says nothing of the link to the one that gets all.
    #[test]
    fn an_idle_replica_does_not_hide_a_slow_link() {
        let mut limiter = limiter(80.0, WireOverhead::Off);
        let links = [
            ("cloud/a", LinkRate::Carries(1e6)),
            ("cloud/b", LinkRate::Free),
            ("fog/c", LinkRate::Free),
        ];
        look(&mut limiter, Instant::now(), &links);
        assert!((camera_hz(&mut limiter) - 10.0).abs() < 1e-9);
        let measured = limiter.measured_bytes_per_s(None);
        assert_eq!(measured, Some(1e6), "lanes go to one flow alone");
    }

    #[test]
    fn what_is_measured_is_shown_where_all_links_are_limited() {
        let receivers = [flow("cloud/a"), flow("cloud/b"), flow("fog/c")];
        let mut limiter = limiter(80.0, WireOverhead::Off);
        limiter.run(Instant::now(), &[camera(&receivers)]);
        let mut shown = |c: LinkRate| {
            let links = [
                ("cloud/a", LinkRate::Carries(1e6)),
                ("cloud/b", LinkRate::Carries(2e6)),
                ("fog/c", c),
            ];
            look(&mut limiter, Instant::now(), &links);
            let layer = |name: &str| limiter.measured_bytes_per_s(Some(&name.parse().unwrap()));
            (limiter.measured_bytes_per_s(None), layer("cloud"), layer("fog"), layer("edge"))
        };
        assert_eq!(shown(LinkRate::Free), (None, Some(3e6), None, None));
        // A slow start has a rate, and has measured nothing.
        assert_eq!(shown(LinkRate::Ramping(1e5)), (None, Some(3e6), None, None));
        assert_eq!(shown(LinkRate::Carries(1e5)), (Some(3.1e6), Some(3e6), Some(1e5), None));
    }

    #[test]
    fn a_link_that_rises_thins_what_is_large_and_is_no_fault() {
        let receivers = [flow("cloud/a")];
        let mut limiter = limiter(80.0, WireOverhead::Off);
        look(&mut limiter, Instant::now(), &[("cloud/a", LinkRate::Ramping(150_000.0))]);
        let demands = [camera(&receivers), topic("odom", 1_000, &receivers)];
        let rates = limiter.run(Instant::now(), &demands);
        assert_eq!(rates.topics[1].lanes_hz, [100.0]);
        assert_eq!(rates.topics[0].lanes_hz, [2.0], "r_min");
        assert!(rates.feasible);
        let standard = limiter.standard_wire_bytes_per_s()[&receivers[0]];
        assert!((standard - 100.0 * 1_000.0 * FIRST).abs() < 1e-6, "{standard}");
        // The same rate as that of the link does not suffice, and is told.
        look(&mut limiter, Instant::now(), &[("cloud/a", LinkRate::Carries(150_000.0))]);
        assert!(limiter.due && !limiter.run(Instant::now(), &demands).feasible);
    }

    #[test]
    fn what_does_not_fit_is_told_once_in_a_while() {
        let start = Instant::now();
        let receivers = [flow("cloud/a")];
        let mut limiter = limiter(80.0, WireOverhead::Off);
        let (fits, does_not) =
            (topic("odom", 1_000, &receivers), topic("points", 60_000_000, &receivers));
        let mut told = BTreeSet::new();
        for tenth in 0..300u32 {
            let demand = if tenth % 2 == 0 { &does_not } else { &fits };
            limiter.run(start + SECOND * tenth / 10, std::slice::from_ref(demand));
            told.extend(limiter.told.map(|(at, _)| at));
        }
        assert_eq!(told.len(), 3, "{told:?}");
        // What could not be told then is told when its time has come.
        look(&mut limiter, start + SECOND * 60, &[]);
        assert_eq!(
            limiter.told.map(|(_, feasible)| feasible),
            limiter.last().map(|rates| rates.feasible)
        );
    }
}
