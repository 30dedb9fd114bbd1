//! How a byte budget becomes rates (`docs/design/bandwidth.md`): a pure function.
//!
//! Symbols:
//!
//! | symbol | here | meaning |
//! |---|---|---|
//! | `B_avail` | `budget_bytes_per_s` | what may leave, in bytes per second |
//! | `r_adv` | [`Topic::advertised_hz`] | what the publishers of the topic say that they send, in Hz |
//! | `s` | [`Topic::size_bytes`] | largest payload as sent, in bytes |
//! | `α` | [`Terms::overhead`] | what a message grows by on the way |
//! | `β` | [`Terms::share`] | what one topic may take of the budget |
//! | `r_min` | [`Terms::min_rate_hz`] | below it no large topic is thinned |
//! | `r_lane` | [`Lane::max_rate_hz`] | what the requesters of one destination ask for at most |
//!
//! A topic of rate `r` costs `Σ over its lanes of min(r, r_lane) · s · α`, because each destination
//! gets a copy. Everything below follows from "the largest `r` whose cost stays within so many
//! bytes per second", `Demand::rate_for`.
//!
//! 1. Standard topics (`s ≤ large_bytes`), largest demand `D = r_adv · s · α` first:
//!    `min(B_remaining, β·B_avail)`. If they alone exceed the budget, smallest demand first: a
//!    large one does not starve a stop signal.
//! 2. Large topics, in the same order, each `max(floor, min(B_i, β·B_avail))`, where `B_i` is what
//!    remains less the floors of those after it. With [`Sharing::Fair`] they share what remains by
//!    max-min fairness in bytes per second instead.

/// What is the same for all topics. Values outside of their ranges are taken as the nearest one
/// inside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Terms {
    /// `α`, at least 1.
    pub overhead: f64,
    /// `β`, 0 to 1.
    pub share: f64,
    /// `r_min` in Hz.
    pub min_rate_hz: f64,
    /// A topic with larger payloads is large.
    pub large_bytes: u64,
    /// How large topics share.
    pub sharing: Sharing,
}

impl Default for Terms {
    /// The defaults of the node file.
    fn default() -> Self {
        Self {
            overhead: 1.02,
            share: 0.95,
            min_rate_hz: 2.0,
            large_bytes: 65_536,
            sharing: Sharing::Paper,
        }
    }
}

/// How large topics share what standard ones leave.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Sharing {
    /// Largest demand first: the original algorithm.
    #[default]
    Paper,
    /// Max-min fairness in bytes per second, per topic.
    Fair,
}

/// Whether a topic gives way to others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Class {
    /// It gets its rate first.
    Standard,
    /// It shares what remains.
    Large,
}

impl Class {
    /// As in the admin JSON.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Standard => "standard",
            Self::Large => "large",
        }
    }
}

/// One copy of a topic: to one destination layer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lane {
    /// Highest rate that anybody there asks for, in Hz; `None`: whatever is published.
    pub max_rate_hz: Option<f64>,
}

/// One topic with its copies.
#[derive(Debug, Clone, PartialEq)]
pub struct Topic<'a> {
    /// Its name: where demands are equal the smaller name is first.
    pub name: &'a str,
    /// `s`: the largest payload as sent, in bytes.
    pub size_bytes: u64,
    /// `r_adv` in Hz.
    pub advertised_hz: f64,
    /// Its class, where somebody has decided it; else the size does.
    pub class: Option<Class>,
    /// Its copies.
    pub lanes: Vec<Lane>,
}

/// What one topic gets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grant {
    /// Whether it is large.
    pub class: Class,
    /// `r_i` in Hz; a lane of it runs at `min(r_i, r_lane)`.
    pub rate_hz: f64,
    /// What all its lanes together cost at that rate, in bytes per second.
    pub bytes_per_s: f64,
}

/// What all topics get, in the order in which they were given.
#[derive(Debug, Clone, PartialEq)]
pub struct Allocation {
    /// One for each topic.
    pub grants: Vec<Grant>,
    /// Whether the budget is kept: `false` where standard topics alone exceed it, or the floors of
    /// large ones do.
    pub feasible: bool,
    /// What they cost together, in bytes per second.
    pub used_bytes_per_s: f64,
}

impl Grant {
    /// What a lane of the topic runs at, in Hz.
    #[must_use]
    pub fn lane_hz(&self, lane: &Lane) -> f64 {
        lane.max_rate_hz.map_or(self.rate_hz, |most| self.rate_hz.min(most.max(0.0)))
    }
}

/// A topic's demand in numbers that can be reckoned with.
struct Demand {
    class: Class,
    /// Where it was given.
    at: usize,
    /// `s · α`.
    message_bytes: f64,
    advertised_hz: f64,
    /// `D`, which does not count lanes.
    demand: f64,
    /// What its lanes ask for, ascending, none above `r_adv`.
    lanes_hz: Vec<f64>,
}

impl Demand {
    fn new(at: usize, topic: &Topic<'_>, terms: &Terms) -> Self {
        let advertised_hz = sane(topic.advertised_hz);
        let message_bytes = topic.size_bytes as f64 * terms.overhead;
        let ask = |lane: &Lane| {
            lane.max_rate_hz.map_or(advertised_hz, |most| sane(most).min(advertised_hz))
        };
        let mut lanes_hz: Vec<f64> = topic.lanes.iter().map(ask).collect();
        lanes_hz.sort_by(f64::total_cmp);
        let by_size =
            if topic.size_bytes > terms.large_bytes { Class::Large } else { Class::Standard };
        Self {
            class: topic.class.unwrap_or(by_size),
            at,
            message_bytes,
            advertised_hz,
            demand: advertised_hz * message_bytes,
            lanes_hz,
        }
    }

    /// What its lanes cost at a rate.
    fn cost(&self, rate_hz: f64) -> f64 {
        // Begins at +0.0, which an empty sum does not.
        let hz = self.lanes_hz.iter().fold(0.0, |hz, lane| hz + lane.min(rate_hz));
        hz * self.message_bytes
    }

    /// The largest rate, `r_adv` at most, at which its lanes cost no more than so many bytes per
    /// second.
    fn rate_for(&self, bytes_per_s: f64) -> f64 {
        let mut hz_left = if self.message_bytes > 0.0 {
            bytes_per_s.max(0.0) / self.message_bytes
        } else {
            f64::INFINITY
        };
        // Lanes that ask for less are filled; those that are left share evenly.
        for (filled, lane) in self.lanes_hz.iter().enumerate() {
            let open = (self.lanes_hz.len() - filled) as f64;
            let each = hz_left / open;
            if each < *lane {
                return each;
            }
            hz_left -= lane;
        }
        self.advertised_hz
    }

    /// Below it a large topic is not thinned.
    fn floor_hz(&self, terms: &Terms) -> f64 {
        terms.min_rate_hz.min(self.advertised_hz)
    }
}

/// Works out the rate of each topic within a budget in bytes per second. Numbers that are none
/// count as 0.
#[must_use]
pub fn allocate(budget_bytes_per_s: f64, terms: &Terms, topics: &[Topic<'_>]) -> Allocation {
    let terms = &Terms {
        overhead: terms.overhead.max(1.0),
        share: sane(terms.share).min(1.0),
        min_rate_hz: sane(terms.min_rate_hz),
        ..*terms
    };
    let budget = sane(budget_bytes_per_s);
    let mut demands: Vec<Demand> =
        topics.iter().enumerate().map(|(at, topic)| Demand::new(at, topic, terms)).collect();
    demands.sort_by(|one, other| {
        let by_demand = other.demand.total_cmp(&one.demand);
        by_demand.then_with(|| topics[one.at].name.cmp(topics[other.at].name))
    });
    let (standard, large): (Vec<Demand>, Vec<Demand>) =
        demands.into_iter().partition(|demand| demand.class == Class::Standard);
    let mut spending = Spending {
        budget,
        cap: terms.share * budget,
        remaining: budget,
        rates: vec![0.0; topics.len()],
    };
    let standard_fit = spending.give_standard(standard.iter().collect());
    match terms.sharing {
        Sharing::Paper => spending.give_in_order(terms, &large),
        Sharing::Fair => spending.give_fairly(terms, &large),
    }
    let mut grants =
        vec![Grant { class: Class::Standard, rate_hz: 0.0, bytes_per_s: 0.0 }; topics.len()];
    for demand in standard.iter().chain(&large) {
        let rate_hz = spending.rates[demand.at];
        grants[demand.at] =
            Grant { class: demand.class, rate_hz, bytes_per_s: demand.cost(rate_hz) };
    }
    let used_bytes_per_s = grants.iter().fold(0.0, |used, grant| used + grant.bytes_per_s);
    let within = is_within(used_bytes_per_s, budget);
    Allocation { grants, feasible: standard_fit && within, used_bytes_per_s }
}

/// What is being given out.
struct Spending {
    budget: f64,
    /// `β·B_avail`.
    cap: f64,
    /// `B_remaining`; below 0 where floors exceed it.
    remaining: f64,
    rates: Vec<f64>,
}

impl Spending {
    /// Returns whether all of them fit.
    fn give_standard(&mut self, mut standard: Vec<&Demand>) -> bool {
        let full: f64 = standard.iter().map(|demand| demand.cost(demand.advertised_hz)).sum();
        let fit = is_within(full, self.budget);
        if !fit {
            // Stable: equal demands stay in the order of their names.
            standard.sort_by(|one, other| one.demand.total_cmp(&other.demand));
        }
        for demand in standard {
            let rate = demand.rate_for(self.remaining.min(self.cap));
            self.give(demand, rate);
        }
        fit
    }

    fn give_in_order(&mut self, terms: &Terms, large: &[Demand]) {
        let floor = |demand: &Demand| demand.cost(demand.floor_hz(terms));
        let mut reserved: Vec<f64> = Vec::with_capacity(large.len());
        let mut after = 0.0;
        for demand in large.iter().rev() {
            reserved.push(after);
            after += floor(demand);
        }
        for (demand, reserved) in large.iter().zip(reserved.into_iter().rev()) {
            let own = (self.remaining - reserved).min(self.cap);
            self.give(demand, demand.rate_for(own).max(demand.floor_hz(terms)));
        }
    }

    /// The level `λ` at which `Σ clamp(λ, floor, most)` is what remains.
    fn give_fairly(&mut self, terms: &Terms, large: &[Demand]) {
        let bounds: Vec<(f64, f64)> = large
            .iter()
            .map(|demand| {
                let floor = demand.cost(demand.floor_hz(terms));
                let most = demand.cost(demand.advertised_hz).min(self.cap);
                (floor, most.max(floor))
            })
            .collect();
        let level = level(&bounds, self.remaining);
        for (demand, (floor, most)) in large.iter().zip(bounds) {
            let share = level.clamp(floor, most);
            // Rounding must not make a topic that is served in full seem thinned: the level is a
            // difference of amounts up to the budget.
            let rounding = 16.0 * f64::EPSILON * self.budget;
            let rate = if share + rounding >= demand.cost(demand.advertised_hz) {
                demand.advertised_hz
            } else {
                demand.rate_for(share)
            };
            self.give(demand, rate.max(demand.floor_hz(terms)));
        }
    }

    fn give(&mut self, demand: &Demand, rate_hz: f64) {
        self.rates[demand.at] = rate_hz;
        self.remaining -= demand.cost(rate_hz);
    }
}

/// The `λ` with `Σ clamp(λ, floor, most) = total`: infinite where all get their most, 0 where the
/// floors exceed it.
fn level(bounds: &[(f64, f64)], total: f64) -> f64 {
    let mut points: Vec<f64> = bounds.iter().flat_map(|(floor, most)| [*floor, *most]).collect();
    points.sort_by(f64::total_cmp);
    let sum_at =
        |level: f64| -> f64 { bounds.iter().map(|(floor, most)| level.clamp(*floor, *most)).sum() };
    let next = points.partition_point(|point| sum_at(*point) < total);
    if next == points.len() {
        return f64::INFINITY;
    }
    let above = points[next];
    let below = if next == 0 { 0.0 } else { points[next - 1] };
    // Between two points the sum grows by the number of topics that are between their bounds.
    let (at_below, at_above) = (sum_at(below), sum_at(above));
    if at_above <= at_below {
        return below;
    }
    below + (above - below) * ((total - at_below) / (at_above - at_below)).clamp(0.0, 1.0)
}

/// Whether a sum is within a budget, but for the rounding of its additions.
fn is_within(sum: f64, budget: f64) -> bool {
    sum <= budget * (1.0 + 1e-12)
}

fn sane(number: f64) -> f64 {
    // One that is too large is still large: as 0 it would silence whom it belongs to.
    if number.is_nan() { 0.0 } else { number.clamp(0.0, 1e15) }
}

#[cfg(test)]
mod tests;
