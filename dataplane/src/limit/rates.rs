//! What each lane of one flow runs at: the budget of the process, and the budgets of single links besides (F9).
//!
//! The same function serves the running flow and `blaze plan`, so that what was planned is what happens.

use std::collections::BTreeMap;

use blaze_domain::LayerName;
use blaze_domain::node_file::{BandwidthSection, SharePolicy};

use super::allocate::{Allocation, Class, Lane, Sharing, Terms, Topic, allocate};

/// One copy of a topic: to one destination layer.
#[derive(Debug, Clone, PartialEq)]
pub struct LaneDemand<'a> {
    /// Where it goes.
    pub layer: &'a LayerName,
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
    /// Of single destinations.
    pub links: BTreeMap<LayerName, f64>,
}

/// What one topic gets.
#[derive(Debug, Clone, PartialEq)]
pub struct TopicRates {
    /// Whether it is large.
    pub class: Class,
    /// `r_i` by the budget of the process, in Hz.
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
    /// Links whose own budget is not kept.
    pub infeasible_links: Vec<LayerName>,
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

/// Works out what each lane runs at: the smaller of what the budget of the process and that of its link give it.
#[must_use]
pub fn rates(budgets: &Budgets, terms: &Terms, demands: &[Demand<'_>]) -> Rates {
    let of_process = within(budgets.process, terms, demands, |_| true);
    let mut topics: Vec<TopicRates> = demands
        .iter()
        .zip(&of_process.grants)
        .map(|(demand, grant)| TopicRates {
            class: grant.class,
            rate_hz: grant.rate_hz,
            lanes_hz: demand.lanes.iter().map(|lane| grant.lane_hz(&as_lane(lane))).collect(),
        })
        .collect();
    let mut infeasible_links = Vec::new();
    for (layer, budget) in &budgets.links {
        let of_link = within(*budget, terms, demands, |lane| lane.layer == layer);
        if !of_link.feasible {
            infeasible_links.push(layer.clone());
        }
        for ((demand, topic), grant) in demands.iter().zip(&mut topics).zip(&of_link.grants) {
            for (lane, hz) in demand.lanes.iter().zip(&mut topic.lanes_hz) {
                if lane.layer == layer {
                    *hz = hz.min(grant.lane_hz(&as_lane(lane)));
                }
            }
        }
    }
    let mut load_bytes_per_s: BTreeMap<LayerName, f64> = BTreeMap::new();
    for (demand, topic) in demands.iter().zip(&topics) {
        let message_bytes = demand.size_bytes as f64 * terms.overhead.max(1.0);
        for (lane, hz) in demand.lanes.iter().zip(&topic.lanes_hz) {
            *load_bytes_per_s.entry(lane.layer.clone()).or_default() += hz * message_bytes;
        }
    }
    Rates {
        topics,
        feasible: of_process.feasible && infeasible_links.is_empty(),
        infeasible_links,
        load_bytes_per_s,
    }
}

/// The allocation of one budget among the lanes that are in it.
fn within(budget: f64, terms: &Terms, demands: &[Demand<'_>], is_in: impl Fn(&LaneDemand<'_>) -> bool) -> Allocation {
    let topic = |demand: &Demand<'_>| demand.lanes.iter().filter(|lane| is_in(lane)).map(as_lane).collect();
    let topics: Vec<Topic<'_>> = demands
        .iter()
        .map(|demand| Topic {
            name: demand.topic,
            size_bytes: demand.size_bytes,
            advertised_hz: demand.advertised_hz,
            class: demand.class,
            lanes: topic(demand),
        })
        .collect();
    allocate(budget, terms, &topics)
}

fn as_lane(lane: &LaneDemand<'_>) -> Lane {
    Lane {
        max_rate_hz: lane.max_rate_hz,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layer(name: &str) -> LayerName {
        name.parse().unwrap()
    }

    fn lane(layer: &LayerName) -> LaneDemand<'_> {
        LaneDemand {
            layer,
            max_rate_hz: None,
        }
    }

    /// Two cameras and an IMU to fog and cloud; the cloud's link is narrow.
    #[test]
    fn a_lane_runs_at_the_smaller_of_both_rates() {
        let (fog, cloud) = (layer("fog"), layer("cloud"));
        let demand = |topic, size_bytes, advertised_hz| Demand {
            topic,
            size_bytes,
            advertised_hz,
            class: None,
            lanes: vec![lane(&fog), lane(&cloud)],
        };
        let demands = [demand("camera", 1_000_000, 30.0), demand("imu", 1_000, 50.0)];
        let budgets = Budgets {
            process: 100e6,
            links: BTreeMap::from([(cloud.clone(), 5_151_000.0)]),
        };
        let got = rates(&budgets, &Terms::default(), &demands);
        // The camera to the fog is whole; to the cloud 5,151,000 B/s less the IMU's 50 · 1,020 leave five images of 1,020,000 B, and
        // β allows 0.95 · 5,151,000 / 1,020,000 = 4.797.
        assert_eq!(got.topics[0].lanes_hz[0], 30.0);
        assert!((got.topics[0].lanes_hz[1] - 0.95 * 5_151_000.0 / 1_020_000.0).abs() < 1e-9);
        assert_eq!(got.topics[1].lanes_hz, [50.0, 50.0]);
        assert!(got.feasible);
        assert!((got.load_bytes_per_s[&fog] - (30.0 * 1_020_000.0 + 51_000.0)).abs() < 1e-6);
    }

    #[test]
    fn a_link_that_cannot_hold_its_floors_is_named() {
        let cloud = layer("cloud");
        let demands = [Demand {
            topic: "camera",
            size_bytes: 1_000_000,
            advertised_hz: 30.0,
            class: None,
            lanes: vec![lane(&cloud)],
        }];
        let budgets = Budgets {
            process: 100e6,
            links: BTreeMap::from([(cloud.clone(), 1e6)]),
        };
        let got = rates(&budgets, &Terms::default(), &demands);
        assert_eq!((got.feasible, got.infeasible_links), (false, vec![cloud]));
        assert_eq!(got.topics[0].lanes_hz, [2.0], "never below r_min");
    }
}
