//! When rates are worked out anew, and on which budgets.
//!
//! ```text
//! node file ─────────► limits ─┐
//! wire bytes, payload ─► ω ────┼─► budgets of s·α ─► rates of lanes ─► gates
//! Feedback ──► capacity ───────┘        ▲ topics, sizes, advertised rates
//! ```
//!
//! It is anew when a topic or lane comes or goes, a size grows, a measured rate or the wire factor moves, a capacity changes, or the node
//! file does. All of these together cost one run at most every [`BETWEEN`].

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::LayerName;
use blaze_domain::node_file::{BandwidthSection, WireOverhead};

use super::rates::{Budgets, Demand, Rates, rates, terms};
use super::wire_factor::{Totals, WireFactor};

/// Between two runs.
const BETWEEN: Duration = Duration::from_millis(20);
/// Between two looks at what is measured.
const LOOK: Duration = Duration::from_millis(500);
/// A budget is believed anew when it has moved by this share.
const MOVED: f64 = 0.01;

/// What the budgets come from, at one moment.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Measured {
    /// Wire bytes per second that the links to a layer can carry, where that is known to be less than their limit.
    pub capacity_bytes_per_s: BTreeMap<LayerName, f64>,
}

/// A limit and what it leaves for messages.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Budget {
    /// Wire bytes per second that are used: the smaller of configured and measured.
    pub wire_bytes_per_s: f64,
    /// Bytes per second of `s · α` that it leaves.
    pub message_bytes_per_s: f64,
}

impl Budget {
    /// The wire factor ω: what has to be allowed on the wire for a byte of `s · α`.
    #[must_use]
    pub fn wire_factor(&self) -> f64 {
        self.wire_bytes_per_s / self.message_bytes_per_s.max(f64::MIN_POSITIVE)
    }
}

/// The state of one flow's allocation.
#[derive(Debug)]
pub struct Limiter {
    bandwidth: BandwidthSection,
    measured: Measured,
    all: WireFactor,
    links: BTreeMap<LayerName, WireFactor>,
    /// Budgets that the last run was made with.
    used: Option<(Budget, BTreeMap<LayerName, Budget>)>,
    due: bool,
    ran: Option<Instant>,
    looked: Option<Instant>,
    last: Option<Rates>,
    runs: u64,
    reported: Option<bool>,
}

impl Limiter {
    /// A limiter that has not run.
    #[must_use]
    pub fn new(bandwidth: BandwidthSection) -> Self {
        Self {
            bandwidth,
            measured: Measured::default(),
            all: WireFactor::default(),
            links: BTreeMap::new(),
            used: None,
            due: true,
            ran: None,
            looked: None,
            last: None,
            runs: 0,
            reported: None,
        }
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

    /// Whether it is time to look at what is measured; then [`Limiter::look`] is to be called.
    pub fn is_time_to_look(&mut self, now: Instant) -> bool {
        let due = self.looked.is_none_or(|at| now.saturating_duration_since(at) >= LOOK);
        if due {
            self.looked = Some(now);
        }
        due
    }

    /// Takes what was measured: totals of all links together and of each one, and what the links can carry.
    pub fn look(&mut self, now: Instant, all: Totals, links: &BTreeMap<LayerName, Totals>, measured: Measured) {
        self.all.sample(now, all);
        self.links.retain(|layer, _| links.contains_key(layer));
        for (layer, totals) in links {
            self.links.entry(layer.clone()).or_default().sample(now, *totals);
        }
        self.measured = measured;
        let moved = |(before, after): (&Budget, &Budget)| {
            let share = (after.message_bytes_per_s - before.message_bytes_per_s).abs();
            share > MOVED * before.message_bytes_per_s
        };
        let (process, of_links) = self.budgets();
        self.due |= match &self.used {
            None => true,
            Some((before, links_before)) => {
                moved((before, &process))
                    || of_links.len() != links_before.len()
                    || of_links
                        .iter()
                        .any(|(layer, after)| links_before.get(layer).is_none_or(|before| moved((before, after))))
            }
        };
    }

    /// Whether rates have to be worked out now. A change that comes right after a run waits for [`BETWEEN`].
    #[must_use]
    pub fn is_due(&self, now: Instant) -> bool {
        self.due && self.ran.is_none_or(|at| now.saturating_duration_since(at) >= BETWEEN)
    }

    /// The budget of the process, and those of links that have one of their own or can carry less.
    #[must_use]
    pub fn budgets(&self) -> (Budget, BTreeMap<LayerName, Budget>) {
        let measures = self.bandwidth.wire_overhead == WireOverhead::Measured;
        let budget = |limit: f64, factor: Option<&WireFactor>| Budget {
            wire_bytes_per_s: limit,
            message_bytes_per_s: match factor {
                Some(factor) if measures => factor.budget(limit, self.bandwidth.overhead),
                None if measures => self.all.budget(limit, self.bandwidth.overhead),
                _ => limit,
            },
        };
        let process = budget(self.bandwidth.limit_bytes_per_s(), Some(&self.all));
        let layers = self.bandwidth.links.keys().chain(self.measured.capacity_bytes_per_s.keys());
        let of_link = |layer: &LayerName| {
            let said = self.bandwidth.link_limit_bytes_per_s(layer).unwrap_or(f64::INFINITY);
            let can = self.measured.capacity_bytes_per_s.get(layer).copied().unwrap_or(f64::INFINITY);
            budget(said.min(can), self.links.get(layer))
        };
        (process, layers.map(|layer| (layer.clone(), of_link(layer))).collect())
    }

    /// Works out the rates.
    pub fn run(&mut self, now: Instant, demands: &[Demand<'_>]) -> &Rates {
        let (process, links) = self.budgets();
        let budgets = Budgets {
            process: process.message_bytes_per_s,
            links: links
                .iter()
                .map(|(layer, budget)| (layer.clone(), budget.message_bytes_per_s))
                .collect(),
        };
        let rates = rates(&budgets, &terms(&self.bandwidth), demands);
        if self.reported.replace(rates.feasible) != Some(rates.feasible) {
            if !rates.feasible {
                let links: Vec<&str> = rates.infeasible_links.iter().map(LayerName::as_str).collect();
                tracing::warn!(
                    limit_mbps = self.bandwidth.limit_mbps,
                    ?links,
                    "what is published does not fit the budget even at its lowest rates; see /v1/allocation"
                );
            } else if self.runs > 0 {
                tracing::info!("what is published fits the budget again");
            }
        }
        self.used = Some((process, links));
        self.due = false;
        self.ran = Some(now);
        self.runs += 1;
        self.last.insert(rates)
    }

    /// What was worked out last; `None` before the first run.
    #[must_use]
    pub fn last(&self) -> Option<&Rates> {
        self.last.as_ref()
    }

    /// What is measured of the links.
    #[must_use]
    pub fn measured(&self) -> &Measured {
        &self.measured
    }

    /// How often rates were worked out.
    #[must_use]
    pub fn runs(&self) -> u64 {
        self.runs
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::limit::rates::LaneDemand;

    const SECOND: Duration = Duration::from_secs(1);

    fn cloud() -> LayerName {
        "cloud".parse().unwrap()
    }

    fn camera(layer: &LayerName) -> Demand<'_> {
        Demand {
            topic: "camera",
            size_bytes: 100_000,
            advertised_hz: 100.0,
            class: None,
            lanes: vec![LaneDemand {
                layer,
                max_rate_hz: None,
            }],
        }
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

    #[test]
    fn without_the_wire_factor_the_whole_limit_is_given_out() {
        let cloud = cloud();
        let mut limiter = limiter(8.0, WireOverhead::Off);
        let hz = limiter.run(Instant::now(), &[camera(&cloud)]).topics[0].lanes_hz[0];
        assert!((hz - 1_048_576.0 / 100_000.0).abs() < 1e-9);
    }

    #[test]
    fn a_limit_that_changes_makes_it_due_and_a_second_change_waits() {
        let start = Instant::now();
        let mut limiter = limiter(8.0, WireOverhead::Off);
        assert!(limiter.is_due(start));
        limiter.run(start, &[]);
        assert!(!limiter.is_due(start + SECOND));
        limiter.set_bandwidth(BandwidthSection {
            limit_mbps: 4.0,
            ..limiter.bandwidth().clone()
        });
        assert!(!limiter.is_due(start + Duration::from_millis(5)) && limiter.is_due(start + BETWEEN));
    }

    #[test]
    fn the_factor_is_followed_when_it_has_moved_and_not_before() {
        let start = Instant::now();
        let cloud = cloud();
        let mut limiter = limiter(80.0, WireOverhead::Measured);
        let mut runs = Vec::new();
        for second in 0..120u32 {
            let now = start + SECOND * second;
            let seconds = u64::from(second);
            // From the 60th second on the wire carries a fifth more for the same payload.
            let extra = seconds.saturating_sub(60) * 220_000;
            let totals = Totals {
                user_wire: seconds * 1_100_000 + extra,
                control_wire: seconds * 1_000,
                payload: seconds * 1_000_000,
            };
            limiter.look(now, totals, &BTreeMap::from([(cloud.clone(), totals)]), Measured::default());
            if limiter.is_due(now) {
                limiter.run(now, &[camera(&cloud)]);
                runs.push(second);
            }
        }
        let quiet = runs.iter().filter(|second| (30..60).contains(*second)).count();
        assert_eq!(quiet, 0, "{runs:?}");
        assert!(runs.iter().any(|second| (61..70).contains(second)) && runs.len() < 60, "{runs:?}");
        let (process, _) = limiter.budgets();
        let factor = process.wire_factor();
        assert!((factor - 1.32 / (1.0 - crate::limit::pacer::RESERVE)).abs() < 0.01, "{factor}");
    }

    #[test]
    fn a_link_that_carries_less_than_its_limit_bounds_its_lanes() {
        let cloud = cloud();
        let mut limiter = limiter(80.0, WireOverhead::Off);
        limiter.set_bandwidth(BandwidthSection {
            links: BTreeMap::from([(cloud.clone(), blaze_domain::node_file::LinkLimit { limit_mbps: 40.0 })]),
            ..limiter.bandwidth().clone()
        });
        let hz = |limiter: &mut Limiter| limiter.run(Instant::now(), &[camera(&cloud)]).topics[0].lanes_hz[0];
        assert!((hz(&mut limiter) - 5.0 * 1_048_576.0 / 100_000.0).abs() < 1e-9);
        let measured = Measured {
            capacity_bytes_per_s: BTreeMap::from([(cloud.clone(), 1_000_000.0)]),
        };
        limiter.look(Instant::now(), Totals::default(), &BTreeMap::new(), measured);
        assert!(limiter.due);
        assert!((hz(&mut limiter) - 10.0).abs() < 1e-9);
    }
}
