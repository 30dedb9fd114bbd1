//! What each lane of one flow runs at: the budget of the process, and the budgets of single links
//! besides. A link has a budget where the node file limits what goes to its layer, and where it was
//! seen to carry less. Symbols: see [`allocate`](super::allocate).
//!
//! `blaze plan` calls the allocator of a running flow, with the configured limits only: measured
//! link capacity and wire overhead are not known there.

use std::collections::{BTreeMap, BTreeSet};

use blaze_domain::node_file::{BandwidthSection, SharePolicy};
use blaze_domain::{FlowId, LayerName};

use super::allocate::{Class, Grant, Lane, Sharing, Terms, Topic, allocate};

/// One lane: one copy of a topic, to one receiver in `layer`.
#[derive(Debug, Clone, PartialEq)]
pub struct LaneDemand<'a> {
    /// Where it goes.
    pub layer: &'a LayerName,
    /// The flow that takes it in there, where that is known.
    pub receiver: Option<&'a FlowId>,
    /// Highest rate that anybody there asks for, in Hz; `None`: whatever is published.
    pub max_rate_hz: Option<f64>,
}

/// One topic that leaves on the inter scope.
#[derive(Debug, Clone, PartialEq)]
pub struct Demand<'a> {
    /// Its name.
    pub topic: &'a str,
    /// `s`: the largest payload as sent, in bytes.
    pub size_bytes: u64,
    /// `r_adv` in Hz.
    pub advertised_hz: f64,
    /// Its class, where somebody has decided it; else the size does.
    pub class: Option<Class>,
    /// Its copies.
    pub lanes: Vec<LaneDemand<'a>>,
}

/// What may leave, in bytes per second of `s · α`: the wire factor has been divided out.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Budgets {
    /// Of the process: all lanes together.
    pub process: f64,
    /// Of what goes to single layers.
    pub links: BTreeMap<LayerName, f64>,
    /// Of what goes to single flows.
    pub flows: BTreeMap<FlowId, FlowBudget>,
}

/// What the link to one flow can carry.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlowBudget {
    /// In bytes per second of `s · α`.
    pub bytes_per_s: f64,
    /// The estimate is still rising. Large topics are limited to it, standard ones are not, and the
    /// link is not reported as infeasible.
    pub is_ramping: bool,
}

/// What one topic gets.
#[derive(Debug, Clone, PartialEq)]
pub struct TopicRates {
    /// Whether it is large.
    pub class: Class,
    /// Rate that the flow's total budget allows, in Hz, before link budgets.
    pub rate_hz: f64,
    /// What each lane runs at, in the order in which they were given, in Hz.
    pub lanes_hz: Vec<f64>,
}

/// What all topics get.
#[derive(Debug, Clone, PartialEq)]
pub struct Rates {
    /// One for each topic, in the order in which they were given.
    pub topics: Vec<TopicRates>,
    /// Whether the budget of the process and those of all links are kept.
    pub feasible: bool,
    /// Whether that of the process is.
    pub process_feasible: bool,
    /// Layers to which a link's own budget is not kept.
    pub infeasible_links: BTreeSet<LayerName>,
    /// What all lanes to a destination cost together, in bytes per second of `s · α`.
    pub load_bytes_per_s: BTreeMap<LayerName, f64>,
}

/// The terms of a node file.
#[must_use]
pub fn terms(bandwidth: &BandwidthSection) -> Terms {
    Terms {
        overhead: bandwidth.overhead,
        share: bandwidth.per_message_share,
        min_rate_hz: bandwidth.min_rate_hz,
        large_bytes: bandwidth.large_bytes.into(),
        sharing: match bandwidth.share {
            SharePolicy::Paper => Sharing::Paper,
            SharePolicy::Fair => Sharing::Fair,
        },
    }
}

/// Works out what each lane runs at: the smallest of what the budget of the process and those of
/// its link give it.
#[must_use]
pub fn rates(budgets: &Budgets, terms: &Terms, demands: &[Demand<'_>]) -> Rates {
    let (of_process, process_feasible) = within(budgets.process, terms, demands, |_| true);
    let mut topics: Vec<TopicRates> = of_process
        .into_iter()
        .map(|(at, grant)| TopicRates {
            class: grant.class,
            rate_hz: grant.rate_hz,
            lanes_hz: demands[at].lanes.iter().map(|lane| grant.lane_hz(&as_lane(lane))).collect(),
        })
        .collect();
    let mut cap_lanes =
        |budget: f64, spares_standard: bool, is_in: &dyn Fn(&LaneDemand<'_>) -> bool| -> bool {
            let (of_link, feasible) = within(budget, terms, demands, is_in);
            for (at, grant) in of_link {
                if spares_standard && grant.class == Class::Standard {
                    continue;
                }
                for (lane, hz) in demands[at].lanes.iter().zip(&mut topics[at].lanes_hz) {
                    if is_in(lane) {
                        *hz = hz.min(grant.lane_hz(&as_lane(lane)));
                    }
                }
            }
            feasible
        };
    let mut infeasible_links = BTreeSet::new();
    for (layer, budget) in &budgets.links {
        if !cap_lanes(*budget, false, &|lane: &LaneDemand<'_>| lane.layer == layer) {
            infeasible_links.insert(layer.clone());
        }
    }
    for (flow, budget) in &budgets.flows {
        let goes_there = |lane: &LaneDemand<'_>| lane.receiver == Some(flow);
        let feasible = cap_lanes(budget.bytes_per_s, budget.is_ramping, &goes_there);
        if !feasible && !budget.is_ramping {
            infeasible_links.insert(flow.layer.clone());
        }
    }
    let mut load_bytes_per_s: BTreeMap<LayerName, f64> = BTreeMap::new();
    for (demand, topic) in demands.iter().zip(&topics) {
        for (lane, hz) in demand.lanes.iter().zip(&topic.lanes_hz) {
            *load_bytes_per_s.entry(lane.layer.clone()).or_default() +=
                hz * demand.message_bytes(terms);
        }
    }
    Rates {
        topics,
        feasible: process_feasible && infeasible_links.is_empty(),
        process_feasible,
        infeasible_links,
        load_bytes_per_s,
    }
}

/// What the standard topics take of the link to each flow at the rates that the budget of the
/// process gives them, whatever the link carries; in bytes per second of `s · α`.
#[must_use]
pub fn standard_load(
    rates: &Rates,
    terms: &Terms,
    demands: &[Demand<'_>],
) -> BTreeMap<FlowId, f64> {
    let mut load: BTreeMap<FlowId, f64> = BTreeMap::new();
    let standard =
        demands.iter().zip(&rates.topics).filter(|(_, topic)| topic.class == Class::Standard);
    for (demand, topic) in standard {
        for lane in &demand.lanes {
            let Some(receiver) = lane.receiver else { continue };
            let hz = lane.max_rate_hz.map_or(topic.rate_hz, |most| topic.rate_hz.min(most));
            *load.entry(receiver.clone()).or_default() += hz * demand.message_bytes(terms);
        }
    }
    load
}

impl Demand<'_> {
    /// `s · α`.
    fn message_bytes(&self, terms: &Terms) -> f64 {
        self.size_bytes as f64 * terms.overhead.max(1.0)
    }
}

/// The allocation of one budget among the lanes that are in it: what each topic is granted that has
/// any, by its place, and whether the budget is kept.
fn within(
    budget: f64,
    terms: &Terms,
    demands: &[Demand<'_>],
    is_in: impl Fn(&LaneDemand<'_>) -> bool,
) -> (Vec<(usize, Grant)>, bool) {
    let (mut places, mut topics) = (Vec::new(), Vec::new());
    for (at, demand) in demands.iter().enumerate() {
        let lanes: Vec<Lane> =
            demand.lanes.iter().filter(|lane| is_in(lane)).map(as_lane).collect();
        // A topic without lanes is kept so that its row exists; it costs nothing.
        if lanes.is_empty() && !demand.lanes.is_empty() {
            continue;
        }
        places.push(at);
        topics.push(Topic {
            name: demand.topic,
            size_bytes: demand.size_bytes,
            advertised_hz: demand.advertised_hz,
            class: demand.class,
            lanes,
        });
    }
    let allocation = allocate(budget, terms, &topics);
    (places.into_iter().zip(allocation.grants).collect(), allocation.feasible)
}

fn as_lane(lane: &LaneDemand<'_>) -> Lane {
    Lane { max_rate_hz: lane.max_rate_hz }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layer(name: &str) -> LayerName {
        name.parse().unwrap()
    }

    fn lane(layer: &LayerName) -> LaneDemand<'_> {
        LaneDemand { layer, receiver: None, max_rate_hz: None }
    }

    fn to(receiver: &FlowId) -> LaneDemand<'_> {
        LaneDemand { layer: &receiver.layer, receiver: Some(receiver), max_rate_hz: None }
    }

    fn demand<'a>(
        topic: &'a str,
        size_bytes: u64,
        advertised_hz: f64,
        lanes: Vec<LaneDemand<'a>>,
    ) -> Demand<'a> {
        Demand { topic, size_bytes, advertised_hz, class: None, lanes }
    }

    /// Two cameras and an IMU to fog and cloud; the cloud's link is narrow.
    #[test]
    fn a_lane_runs_at_the_smaller_of_both_rates() {
        let (fog, cloud) = (layer("fog"), layer("cloud"));
        let both = || vec![lane(&fog), lane(&cloud)];
        let demands =
            [demand("camera", 1_000_000, 30.0, both()), demand("imu", 1_000, 50.0, both())];
        let budgets = Budgets {
            process: 100e6,
            links: BTreeMap::from([(cloud.clone(), 5_151_000.0)]),
            ..Budgets::default()
        };
        let got = rates(&budgets, &Terms::default(), &demands);
        // The camera to the fog is whole; to the cloud 5,151,000 B/s less the IMU's 50 · 1,020
        // leave five images of 1,020,000 B, and β allows 0.95 · 5,151,000 / 1,020,000 = 4.797.
        assert_eq!(got.topics[0].lanes_hz[0], 30.0);
        assert!((got.topics[0].lanes_hz[1] - 0.95 * 5_151_000.0 / 1_020_000.0).abs() < 1e-9);
        assert_eq!(got.topics[1].lanes_hz, [50.0, 50.0]);
        assert!(got.feasible);
        assert!((got.load_bytes_per_s[&fog] - (30.0 * 1_020_000.0 + 51_000.0)).abs() < 1e-6);
    }

    #[test]
    fn a_link_that_cannot_hold_its_floors_is_named() {
        let cloud = layer("cloud");
        let demands = [demand("camera", 1_000_000, 30.0, vec![lane(&cloud)])];
        let budgets = Budgets {
            process: 100e6,
            links: BTreeMap::from([(cloud.clone(), 1e6)]),
            ..Budgets::default()
        };
        let got = rates(&budgets, &Terms::default(), &demands);
        assert_eq!((got.feasible, got.infeasible_links), (false, BTreeSet::from([cloud])));
        assert!(got.process_feasible);
        assert_eq!(got.topics[0].lanes_hz, [2.0], "never below r_min");
    }

    /// Two robots of one layer; the radio of one of them is bad.
    #[test]
    fn a_slow_link_to_one_flow_thins_what_goes_there_alone() {
        let (one, other): (FlowId, FlowId) =
            ("edge/robot-1".parse().unwrap(), "edge/robot-2".parse().unwrap());
        let both = || vec![to(&one), to(&other)];
        let demands = [
            demand("map", 1_000_000, 10.0, both()),
            demand("stop", 1_000, 10.0, both()),
            demand("unasked", 1_000_000, 10.0, Vec::new()),
        ];
        let slow = |bytes_per_s, is_ramping| {
            let budgets = Budgets {
                process: 100e6,
                flows: BTreeMap::from([(other.clone(), FlowBudget { bytes_per_s, is_ramping })]),
                ..Budgets::default()
            };
            rates(&budgets, &Terms::default(), &demands)
        };
        let got = slow(5_110_200.0, false);
        assert_eq!(got.topics[0].lanes_hz[0], 10.0);
        // β · 5,110,200 B/s are 4.76 maps of 1,020,000 B.
        assert!((got.topics[0].lanes_hz[1] - 0.95 * 5_110_200.0 / 1_020_000.0).abs() < 1e-9);
        assert_eq!(got.topics[1].lanes_hz, [10.0, 10.0]);
        assert_eq!((got.topics[2].rate_hz, got.topics[2].lanes_hz.len()), (10.0, 0));
        assert!(got.feasible);
        // Two maps a second do not fit: that is told, unless the link is about to carry more.
        assert_eq!(slow(1e6, false).infeasible_links, BTreeSet::from([layer("edge")]));
        let got = slow(1e6, true);
        assert!(got.feasible && (got.topics[0].lanes_hz[1] - 2.0).abs() < 1e-9);
        // What is small is thinned by what a link carries, not by what it is asked to carry for a
        // moment.
        assert!(slow(5_000.0, false).topics[1].lanes_hz[1] < 5.0);
        assert_eq!(slow(5_000.0, true).topics[1].lanes_hz, [10.0, 10.0]);
    }

    #[test]
    fn what_standard_topics_take_of_a_link_does_not_depend_on_it() {
        let robot: FlowId = "edge/robot-1".parse().unwrap();
        let slower = LaneDemand { max_rate_hz: Some(5.0), ..to(&robot) };
        let demands = [
            demand("map", 1_000_000, 10.0, vec![to(&robot)]),
            demand("stop", 1_000, 10.0, vec![to(&robot)]),
            demand("odom", 2_000, 50.0, vec![slower]),
        ];
        let budgets = Budgets {
            process: 100e6,
            flows: BTreeMap::from([(
                robot.clone(),
                FlowBudget { bytes_per_s: 100.0, is_ramping: true },
            )]),
            ..Budgets::default()
        };
        let terms = Terms::default();
        let got = standard_load(&rates(&budgets, &terms, &demands), &terms, &demands);
        assert!((got[&robot] - (10.0 * 1_020.0 + 5.0 * 2_040.0)).abs() < 1e-6, "{got:?}");
    }
}
