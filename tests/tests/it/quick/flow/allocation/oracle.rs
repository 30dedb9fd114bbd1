//! The allocation of bandwidth worked out a second time, from the requirement alone and without
//! rounding.
//!
//! Every number that goes in is the exact fraction that its `f64` stands for. Such fractions have
//! powers of two as their denominators, so that one power of two is enough for all rates of a set
//! and another for all its bytes per second: the steps are done with whole numbers in these two
//! units. Only a rate that is cut by a bound needs a real division, and the water level of the fair
//! share; both are kept as fractions. Nothing is ever rounded, whatever the budget and the sizes.

use std::cmp::Ordering;

use blaze_flow::limit::allocate::{Sharing, Terms, Topic};
use num_bigint::BigInt;
use num_rational::BigRational;
use num_traits::float::FloatCore;
use num_traits::{Signed, ToPrimitive, Zero};

/// What one topic gets.
pub(crate) struct Share {
    /// Whether the topic is large.
    pub(crate) large: bool,
    /// `r_i` in Hz.
    pub(crate) rate: BigRational,
    /// The rate of each lane in Hz, in the order of the lanes.
    pub(crate) lanes: Vec<BigRational>,
    /// What all lanes together cost at these rates, in bytes per second.
    pub(crate) bytes: BigRational,
    /// What the bound is above the full demand (below it: negative), in bytes per second. At
    /// exactly 0 the rate jumps from that of the fastest lane to the advertised one, which no lane
    /// notices.
    pub(crate) spare: BigRational,
    /// Whether the requirement leaves `r_i` open between the floor and the advertised rate: the
    /// bound is below the full demand, but the floor is all of it. No lane is faster than the floor
    /// then, whatever `r_i` is.
    pub(crate) open: bool,
    /// Which of the limits decided.
    pub(crate) limit: Limit,
}

/// What holds the rate of a topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Limit {
    /// Nothing: it has its full demand.
    Full,
    /// The share `β` of the budget.
    Cap,
    /// What remains for it: with the fair share the water level.
    Rest,
    /// It has its floor and would have less without.
    Floor,
}

/// What all topics get.
pub(crate) struct Shares {
    /// One for each topic, in the order given.
    pub(crate) shares: Vec<Share>,
    /// Whether neither the standard demands nor the floors of large topics exceed the budget.
    pub(crate) feasible: bool,
    /// By how much the worse of the two exceeds the budget, in bytes per second: not above 0 where
    /// the set is feasible.
    pub(crate) excess: BigRational,
    /// What is allocated in all, in bytes per second.
    pub(crate) used: BigRational,
    /// By how much the full demands of the standard topics alone exceed the budget, in bytes per
    /// second.
    pub(crate) standard_excess: BigRational,
}

/// The nearest `f64`, for comparisons that allow for rounding anyway.
pub(crate) fn near(exact: &BigRational) -> f64 {
    exact.to_f64().unwrap_or(f64::NAN)
}

/// `mantissa · 2^exponent`.
struct Dyadic {
    mantissa: BigInt,
    exponent: i32,
}

impl Dyadic {
    /// The exact value; negative numbers and those that are none count as 0.
    fn of(value: f64) -> Self {
        if value.is_nan() || value <= 0.0 {
            return Self { mantissa: BigInt::ZERO, exponent: i32::MAX };
        }
        let (mantissa, exponent, _) = FloatCore::integer_decode(value);
        let zeros = mantissa.trailing_zeros();
        Self {
            mantissa: BigInt::from(mantissa >> zeros),
            exponent: i32::from(exponent) + zeros.cast_signed(),
        }
    }

    /// As a whole number of units of `2^unit`, where `unit` is not above the exponent.
    fn in_units(&self, unit: i32) -> BigInt {
        if self.mantissa.is_zero() {
            BigInt::ZERO
        } else {
            &self.mantissa << (self.exponent - unit)
        }
    }
}

/// `numerator / denominator · 2^unit`.
fn fraction(numerator: BigInt, denominator: BigInt, unit: i32) -> BigRational {
    if unit < 0 {
        BigRational::new_raw(numerator, denominator << unit.unsigned_abs())
    } else {
        BigRational::new_raw(numerator << unit.unsigned_abs(), denominator)
    }
}

/// A fraction whose denominator is above 0, in the unit of rates or of bytes per second.
#[derive(Clone)]
struct Ratio {
    numerator: BigInt,
    denominator: BigInt,
}

impl Ratio {
    fn whole(numerator: BigInt) -> Self {
        Self { numerator, denominator: BigInt::from(1) }
    }

    fn compare(&self, other: &BigInt) -> Ordering {
        self.numerator.cmp(&(other * &self.denominator))
    }

    /// As a whole number of parts, of which there are so many to one unit: for a value that is one.
    fn in_parts(&self, parts: &BigInt) -> BigInt {
        let scaled = &self.numerator * parts;
        debug_assert!(
            (&scaled % &self.denominator).is_zero(),
            "the value is no whole number of parts"
        );
        scaled / &self.denominator
    }

    fn minimum(self, other: &BigInt) -> Self {
        if self.compare(other).is_gt() { Self::whole(other.clone()) } else { self }
    }
}

/// One topic in whole numbers.
struct Demand<'a> {
    name: &'a [u8],
    large: bool,
    /// `r_adv`.
    advertised: BigInt,
    /// `min(r_adv, r_lane)` of each lane.
    lanes: Vec<BigInt>,
    /// `s·α`: what one unit of rate costs on one lane.
    price: BigInt,
    /// `D = r_adv·s·α`.
    demand: BigInt,
    /// `Σ` over the lanes of `min(r_adv, r_lane)·s·α`.
    full: BigInt,
    /// `min(r_min, r_adv)`.
    floor_rate: BigInt,
    /// `Σ` over the lanes of `min(r_min, r_adv, r_lane)·s·α`.
    floor: BigInt,
}

impl Demand<'_> {
    /// What all lanes together cost at a rate.
    fn cost(&self, rate: &Ratio) -> Ratio {
        let mut sum = BigInt::ZERO;
        for lane in &self.lanes {
            if rate.compare(lane).is_lt() {
                sum += &rate.numerator;
            } else {
                sum += lane * &rate.denominator;
            }
        }
        Ratio { numerator: sum * &self.price, denominator: rate.denominator.clone() }
    }

    /// The largest rate up to `r_adv` at which all lanes together stay within a bound: none where
    /// not even 0 does.
    fn rate_within(&self, bound: &Ratio) -> Option<Ratio> {
        if bound.numerator.is_negative() {
            return None;
        }
        if bound.compare(&self.full).is_ge() {
            return Some(Ratio::whole(self.advertised.clone()));
        }
        // The slowest lanes reach their own limit first; from there on only the others go on
        // growing.
        let mut lanes: Vec<&BigInt> = self.lanes.iter().collect();
        lanes.sort_unstable();
        let mut reached = BigInt::ZERO;
        let mut growing = lanes.len();
        for lane in lanes {
            if bound.compare(&((&reached + lane * growing) * &self.price)).is_le() {
                break;
            }
            reached += lane;
            growing -= 1;
        }
        let left = &bound.numerator - reached * &self.price * &bound.denominator;
        Some(Ratio { numerator: left, denominator: &self.price * growing * &bound.denominator })
    }

    /// The rate under a bound that gives way to the floor of a large topic.
    fn rate_with_floor(&self, bound: &Ratio) -> (Ratio, bool) {
        match self.rate_within(bound) {
            Some(rate) if rate.compare(&self.floor_rate).is_ge() => (rate, false),
            _ => (Ratio::whole(self.floor_rate.clone()), true),
        }
    }
}

/// The units, and what is the same for all topics in these units.
struct Scale {
    /// A rate is a whole number of `2^rate` Hz.
    rate: i32,
    /// An amount is a whole number of `2^amount` bytes per second.
    amount: i32,
    /// `B_avail`.
    budget: BigInt,
    /// `β·B_avail`.
    cap: BigInt,
}

/// Grants in the order of the topics, as they come to be known.
struct Ledger {
    scale: Scale,
    shares: Vec<Option<Share>>,
}

impl Ledger {
    /// Notes what a topic gets; returns what it costs. `rest` says whether the bound is what
    /// remains rather than the cap.
    fn grant(
        &mut self,
        at: usize,
        topic: &Demand<'_>,
        bound: &Ratio,
        rate: Ratio,
        floored: bool,
        rest: bool,
    ) -> Ratio {
        let (rates, amounts) = (self.scale.rate, self.scale.amount);
        let cost = topic.cost(&rate);
        let limit = match (floored, bound.compare(&topic.full).is_ge(), rest) {
            (_, true, _) => Limit::Full,
            (true, ..) => Limit::Floor,
            (_, _, true) => Limit::Rest,
            _ => Limit::Cap,
        };
        let lanes = topic.lanes.iter().map(|lane| {
            let least = rate.clone().minimum(lane);
            fraction(least.numerator, least.denominator, rates)
        });
        let spare = &bound.numerator - &topic.full * &bound.denominator;
        self.shares[at] = Some(Share {
            large: topic.large,
            lanes: lanes.collect(),
            bytes: fraction(cost.numerator.clone(), cost.denominator.clone(), amounts),
            spare: fraction(spare, bound.denominator.clone(), amounts),
            open: floored && topic.floor == topic.full,
            limit,
            rate: fraction(rate.numerator, rate.denominator, rates),
        });
        cost
    }
}

/// The water level `λ` at which all large topics together cost what remains, where one costs `λ`,
/// but at least its floor and at most its limit. A level at which all have their limit is the
/// highest of these; none where the floors exceed what remains.
fn water_level(
    topics: &[(usize, &Demand<'_>)],
    limits: &[BigInt],
    remaining: &BigInt,
) -> Option<Ratio> {
    let at_level = |level: &BigInt| {
        let mut sum = BigInt::ZERO;
        for ((_, topic), limit) in topics.iter().zip(limits) {
            sum += level.min(limit).max(&topic.floor);
        }
        sum
    };
    if at_level(&BigInt::ZERO) > *remaining {
        return None;
    }
    // Between two neighbours of these the sum is a straight line.
    let mut corners = vec![BigInt::ZERO];
    corners.extend(limits.iter().cloned());
    corners.extend(topics.iter().map(|(_, topic)| topic.floor.clone()));
    corners.sort_unstable();
    let kept = corners.partition_point(|corner| at_level(corner) <= *remaining);
    let corner = &corners[kept - 1];
    let growing = topics
        .iter()
        .zip(limits)
        .filter(|((_, topic), limit)| topic.floor <= *corner && corner < *limit)
        .count();
    if growing == 0 {
        return Some(Ratio::whole(corner.clone()));
    }
    let left = remaining - at_level(corner);
    Some(Ratio { numerator: corner * growing + left, denominator: BigInt::from(growing) })
}

/// Brings a set into whole numbers.
fn in_whole_numbers<'a>(
    budget: f64,
    terms: &Terms,
    topics: &[Topic<'a>],
) -> (Scale, Vec<Demand<'a>>) {
    let overhead = Dyadic::of(terms.overhead.max(1.0));
    let share = Dyadic::of(if terms.share > 1.0 { 1.0 } else { terms.share });
    let budget = Dyadic::of(budget);
    let floor = Dyadic::of(terms.min_rate_hz);
    let advertised: Vec<Dyadic> =
        topics.iter().map(|topic| Dyadic::of(topic.advertised_hz)).collect();
    let lanes: Vec<Vec<Option<Dyadic>>> = topics
        .iter()
        .map(|topic| topic.lanes.iter().map(|lane| lane.max_rate_hz.map(Dyadic::of)).collect())
        .collect();

    let all_rates = advertised.iter().chain(lanes.iter().flatten().flatten()).chain([&floor]);
    let rate = all_rates.map(|rate| rate.exponent).min().map_or(0, |least| least.min(0));
    let amounts =
        [rate + overhead.exponent, budget.exponent, budget.exponent.saturating_add(share.exponent)];
    let amount = amounts.into_iter().min().map_or(0, |least| least.min(0));

    let cap = Dyadic {
        mantissa: &budget.mantissa * &share.mantissa,
        exponent: budget.exponent.saturating_add(share.exponent),
    };
    let scale = Scale { rate, amount, budget: budget.in_units(amount), cap: cap.in_units(amount) };

    let unit_price = overhead.in_units(amount - rate);
    let floor = floor.in_units(rate);
    let demands = topics.iter().zip(advertised).zip(lanes).map(|((topic, advertised), lanes)| {
        let advertised = advertised.in_units(rate);
        let lanes: Vec<BigInt> = lanes
            .into_iter()
            .map(|lane| {
                lane.map_or_else(
                    || advertised.clone(),
                    |most| most.in_units(rate).min(advertised.clone()),
                )
            })
            .collect();
        let price = &unit_price * topic.size_bytes;
        let floor_rate = floor.clone().min(advertised.clone());
        Demand {
            name: topic.name.as_bytes(),
            large: topic.size_bytes > terms.large_bytes,
            demand: &advertised * &price,
            full: lanes.iter().sum::<BigInt>() * &price,
            floor: lanes.iter().map(|lane| lane.min(&floor_rate)).sum::<BigInt>() * &price,
            advertised,
            lanes,
            price,
            floor_rate,
        }
    });
    (scale, demands.collect())
}

/// Works out a whole set.
pub(crate) fn exact(budget: f64, terms: &Terms, topics: &[Topic<'_>]) -> Shares {
    let (scale, demands) = in_whole_numbers(budget, terms, topics);
    let (budget, cap, amount) = (scale.budget.clone(), scale.cap.clone(), scale.amount);
    let (mut large, mut standard): (Vec<_>, Vec<_>) =
        demands.iter().enumerate().partition(|(_, topic)| topic.large);
    let mut ledger = Ledger { scale, shares: topics.iter().map(|_| None).collect() };

    // Standard topics come first: largest demand first where all of them fit, smallest first where
    // they do not.
    let wanted: BigInt = standard.iter().map(|(_, topic)| &topic.full).sum();
    let standard_exceeds = wanted > budget;
    standard.sort_unstable_by(|(_, a), (_, b)| {
        let by_demand =
            if standard_exceeds { a.demand.cmp(&b.demand) } else { b.demand.cmp(&a.demand) };
        by_demand.then_with(|| a.name.cmp(b.name))
    });
    let one = BigInt::from(1);
    let mut remaining = budget.clone();
    let mut used = Ratio::whole(BigInt::ZERO);
    for (at, topic) in standard {
        let bound = Ratio::whole(remaining.clone().min(cap.clone()));
        // What remains is never below 0, so that a rate of 0 always fits.
        let rate = topic.rate_within(&bound).unwrap_or_else(|| Ratio::whole(BigInt::ZERO));
        let cost = ledger.grant(at, topic, &bound, rate, false, remaining <= cap);
        remaining -= cost.in_parts(&one);
        used.numerator += cost.in_parts(&one);
    }

    // Large topics share what remains and keep their floors.
    large.sort_unstable_by(|(_, a), (_, b)| {
        b.demand.cmp(&a.demand).then_with(|| a.name.cmp(b.name))
    });
    let floors: BigInt = large.iter().map(|(_, topic)| &topic.floor).sum();
    let standard_excess = wanted - &budget;
    let excess = standard_excess.clone().max(&used.numerator + &floors - &budget);
    match terms.sharing {
        Sharing::Paper => {
            let mut floors_after = floors;
            for (at, topic) in large {
                floors_after -= &topic.floor;
                let rest = &remaining - &floors_after;
                let is_rest = rest <= cap;
                let bound = Ratio::whole(rest.min(cap.clone()));
                let (rate, floored) = topic.rate_with_floor(&bound);
                let cost = ledger.grant(at, topic, &bound, rate, floored, is_rest);
                remaining -= cost.in_parts(&one);
                used.numerator += cost.in_parts(&one);
            }
        }
        Sharing::Fair => {
            let limits: Vec<BigInt> =
                large.iter().map(|(_, topic)| topic.full.clone().min(cap.clone())).collect();
            let level = water_level(&large, &limits, &remaining)
                .unwrap_or_else(|| Ratio::whole(BigInt::from(-1)));
            used = Ratio {
                numerator: used.numerator * &level.denominator,
                denominator: level.denominator.clone(),
            };
            for (at, topic) in large {
                let is_rest = level.compare(&cap).is_lt();
                let bound = level.clone().minimum(&cap);
                let (rate, floored) = topic.rate_with_floor(&bound);
                let cost = ledger.grant(at, topic, &bound, rate, floored, is_rest);
                used.numerator += cost.in_parts(&level.denominator);
            }
        }
    }
    Shares {
        shares: ledger.shares.into_iter().flatten().collect(),
        feasible: !excess.is_positive(),
        excess: fraction(excess, BigInt::from(1), amount),
        used: fraction(used.numerator, used.denominator, amount),
        standard_excess: fraction(standard_excess, BigInt::from(1), amount),
    }
}
