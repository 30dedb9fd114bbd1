mod garbage;
mod simulator;

use crate::testing::Random;
use simulator::{Demand, Link, Simulator};

use super::*;

const LIMIT: f64 = 20e6;

/// What came of a link that became slower at 10 s and fast again at 70 s.
#[derive(Debug)]
#[expect(dead_code, reason = "shown when a test fails")]
struct Fall {
    queue: f64,
    samples: u32,
    /// Sent from 15 s on, as a share of what the link carries.
    sent: f64,
    /// Longest wait up to then and from then on, in milliseconds.
    peak: f64,
    longest: f64,
    /// Seconds until the rate is and stays at 0.95 of the limit.
    back_s: f64,
}

/// Seconds after `from` until the rate stays at or above this, up to `to`.
fn back_s(simulator: &Simulator, from: f64, to: f64, rate: f64) -> f64 {
    let entries = simulator.between(from, to);
    let low = entries.iter().rposition(|entry| entry.least_rate < rate);
    low.map_or(0.0, |low| (low + 1) as f64 / 10.0)
}

/// Falls from `before` to `after`, with short and long queues, and with few and many Feedback.
fn falls(limit: f64, before: f64, after: f64, delay: u64) {
    for (queue, samples) in [(250e3, u32::MAX), (250e3, 64), (8e6, u32::MAX), (8e6, 64)] {
        let link = Link { rate: before, queue, delay, ..Link::default() };
        let mut simulator = Simulator::new(limit, link, 1);
        simulator.samples = samples;
        simulator.run(10.0);
        assert!(simulator.least_rate(0.0, 10.0) >= limit);
        simulator.link.rate = after;
        simulator.run(60.0);
        let measured = simulator.capacity.measured().unwrap() / after;
        simulator.link.rate = before;
        simulator.run(40.0);
        let fall = Fall {
            queue,
            samples,
            sent: simulator.mean_sent(15.0, 70.0) / after,
            peak: simulator.longest_queue(10.0, 15.0),
            longest: simulator.longest_queue(15.0, 70.0),
            back_s: back_s(&simulator, 70.0, 110.0, 0.95 * limit),
        };
        assert!((0.85..=1.0).contains(&fall.sent), "{fall:?}");
        assert!(fall.longest <= 100.0, "{fall:?}");
        assert!((0.9..1.1).contains(&measured), "{measured} of {after}");
        assert!(fall.back_s <= 30.0, "{fall:?}");
        assert_eq!(simulator.capacity.measured(), None);
    }
}

#[test]
fn a_link_that_becomes_slower_is_used_without_a_queue_until_it_recovers() {
    falls(LIMIT, 20e6, 5e6, 25);
    falls(LIMIT, 40e6, 5e6, 25);
}

#[test]
fn so_is_a_radio_link() {
    falls(1e6, 1e6, 250e3, 25);
    falls(1e6, 1e6, 250e3, 120);
}

#[test]
fn a_link_that_slides_away_is_followed() {
    let link = Link::default();
    let mut simulator = Simulator::new(LIMIT, link, 3);
    simulator.run(10.0);
    for rate in [10e6, 5e6, 2e6, 1e6, 0.5e6] {
        simulator.link.rate = rate;
        simulator.run(0.6);
    }
    simulator.run(60.0);
    let (sent, peak) = (simulator.mean_sent(23.0, 73.0), simulator.longest_queue(10.0, 23.0));
    assert!((0.85..1.0).contains(&(sent / 0.5e6)), "{sent} B/s");
    assert!(peak < 3000.0, "{peak} ms");
    let longest = simulator.longest_queue(23.0, 73.0);
    assert!(longest <= 100.0, "{longest} ms");
}

/// Their queues last for 6, 2 and 17 ms, which is less than what counts as a delay.
#[test]
fn a_bottleneck_with_hardly_a_queue_shows_in_its_loss() {
    for (queue, rate) in [(30e3, 5e6), (30e3, 15e6), (250e3, 15e6)] {
        let link = Link { queue, ..Link::default() };
        let mut simulator = Simulator::new(LIMIT, link, 3);
        simulator.run(10.0);
        simulator.link.rate = rate;
        simulator.run(60.0);
        let sent = simulator.mean_sent(15.0, 70.0) / rate;
        assert!((0.85..1.02).contains(&sent), "{sent} of {rate} B/s");
    }
}

/// Ten minutes, in which nothing must be reduced.
fn stays_at_the_limit(link: Link, change: impl FnOnce(&mut Simulator)) {
    let mut simulator = Simulator::new(LIMIT, link, 7);
    change(&mut simulator);
    simulator.run(600.0);
    let least = simulator.least_rate(0.0, 600.0);
    assert!(least >= LIMIT, "{least}");
    assert_eq!(simulator.capacity.measured(), None);
    assert_eq!(simulator.capacity.state(), State::Unknown);
}

#[test]
fn a_link_that_carries_the_limit_is_never_throttled() {
    stays_at_the_limit(Link::default(), |_| {});
    stays_at_the_limit(Link::default(), |simulator| simulator.samples = 64);
    let unsteady = Link { delay: 50, jitter: 20, ..Link::default() };
    stays_at_the_limit(unsteady, |_| {});
}

/// Decision: loss that does not come with a delay says that the radio is bad, not that the link is
/// full, and what is lost is sent again at the expense of the budget. To send less would lose the
/// same share.
#[test]
fn nor_for_random_loss() {
    let lossy = Link { loss: 0.03, ..Link::default() };
    stays_at_the_limit(lossy, |_| {});
}

#[test]
fn nor_for_pauses_of_a_busy_processor() {
    stays_at_the_limit(Link::default(), |simulator| simulator.stall = 60);
    stays_at_the_limit(Link::default(), |simulator| {
        simulator.stall = 120;
        simulator.samples = 64;
    });
}

#[test]
fn nor_because_little_is_offered() {
    // A frame of 900 kB ten times a second, something small now and then, and a link slower than
    // the limit.
    stays_at_the_limit(Link::default(), |simulator| {
        simulator.demand = Demand::Bursts(900e3, 100);
    });
    stays_at_the_limit(Link::default(), |simulator| simulator.demand = Demand::Bursts(3e3, 700));
    let slower = Link { rate: 12e6, ..Link::default() };
    stays_at_the_limit(slower, |simulator| simulator.demand = Demand::Even(10e6));
}

#[test]
fn nor_after_idle_phases() {
    let mut simulator = Simulator::new(LIMIT, Link::default(), 7);
    for _ in 0..10 {
        simulator.demand = Demand::Even(0.0);
        simulator.run(20.0);
        simulator.demand = Demand::Endless;
        simulator.run(5.0);
    }
    assert!(simulator.least_rate(0.0, 250.0) >= LIMIT);
}

#[test]
fn loss_that_does_not_go_away_is_taken_for_ordinary() {
    let mut simulator = Simulator::new(LIMIT, Link::default(), 3);
    simulator.run(10.0);
    simulator.link.loss = 0.2;
    simulator.run(60.0);
    let entries = simulator.between(10.0, 70.0);
    let low = entries.iter().filter(|entry| entry.least_rate < 0.9 * LIMIT).count();
    assert!((1..=30).contains(&low), "{low} tenths of a second");
    assert!((0.15..0.25).contains(&simulator.capacity.loss.ordinary));
}

#[test]
fn after_an_outage_the_rate_begins_low_and_doubles_each_second() {
    for delay in [25, 120] {
        let link = Link { delay, ..Link::default() };
        let mut simulator = Simulator::new(LIMIT, link, 3);
        let now = simulator.instant();
        simulator.capacity.outage(now);
        assert!((simulator.capacity.bytes_per_s() - LIMIT / 32.0).abs() < 1.0);
        assert_eq!(simulator.capacity.state(), State::SlowStart);
        simulator.run(15.0);
        for second in 0..7u32 {
            let doubled = LIMIT / 32.0 * f64::from(1 << second);
            let rate = simulator.between(f64::from(second), f64::from(second) + 0.5)[0].most_rate;
            assert!(rate >= doubled.min(LIMIT), "{rate} after {second} s");
        }
        assert_eq!(simulator.capacity.state(), State::Unknown);
        assert!(simulator.log.iter().all(|entry| entry.sent <= LIMIT / 10.0 + 2800.0));
    }
}

#[test]
fn slow_start_ends_at_what_the_link_carries() {
    for rate in [5e6, 250e3] {
        let link = Link { rate, ..Link::default() };
        let mut simulator = Simulator::new(LIMIT, link, 3);
        let now = simulator.instant();
        simulator.capacity.outage(now);
        simulator.run(60.0);
        let sent = simulator.mean_sent(10.0, 60.0) / rate;
        assert!((0.85..=1.0).contains(&sent), "{sent}");
        let longest = simulator.longest_queue(10.0, 60.0);
        assert!(longest <= 100.0, "{longest} ms");
    }
}

#[test]
fn what_is_small_passes_after_an_outage_as_before() {
    let mut simulator = Simulator::new(LIMIT, Link::default(), 3);
    simulator.demand = Demand::Even(400e3);
    let now = simulator.instant();
    simulator.capacity.outage(now);
    simulator.run(10.0);
    let sent = simulator.mean_sent(0.0, 10.0);
    assert!(sent > 395e3, "{sent}");
}

/// On a small limit a thirty-second part of it is less than an IMU and odometry need.
#[test]
fn slow_start_does_not_begin_below_what_is_small() {
    const SMALL: f64 = 150e3;
    let mut simulator = Simulator::new(1e6, Link::default(), 3);
    simulator.demand = Demand::Even(SMALL);
    let now = simulator.instant();
    simulator.capacity.set_needed(SMALL, now);
    simulator.capacity.outage(now);
    assert!((simulator.capacity.bytes_per_s() - START_MARGIN * SMALL).abs() < 1.0);
    assert_eq!(simulator.capacity.state(), State::SlowStart);
    simulator.run(1.0);
    let sent = simulator.mean_sent(0.0, 1.0);
    assert!(sent > 0.95 * SMALL, "{sent} in the first second");
    // Where it is known only after the peer is back it rises at once.
    let now = simulator.instant();
    simulator.capacity.set_needed(0.0, now);
    simulator.capacity.outage(now);
    assert!((simulator.capacity.bytes_per_s() - 1e6 / 32.0).abs() < 1.0);
    simulator.capacity.set_needed(SMALL, now);
    assert!((simulator.capacity.bytes_per_s() - START_MARGIN * SMALL).abs() < 1.0);
    // Never above the limit.
    simulator.capacity.set_needed(2e6, now);
    assert!((simulator.capacity.bytes_per_s() - 1e6).abs() < 1.0);
}

#[test]
fn what_small_needs_does_not_raise_a_rate_that_is_known() {
    let link = Link { rate: 250e3, ..Link::default() };
    let mut simulator = Simulator::new(1e6, link, 3);
    for _ in 0..600 {
        simulator.run(0.1);
        if simulator.capacity.state() == State::Steady {
            break;
        }
    }
    assert_eq!(simulator.capacity.state(), State::Steady);
    let (before, now) = (simulator.capacity.bytes_per_s(), simulator.instant());
    simulator.capacity.set_needed(500e3, now);
    assert!((simulator.capacity.bytes_per_s() - before).abs() < 1e-6, "{before}");
}

#[test]
fn a_longer_route_costs_two_trials_and_no_more() {
    let mut simulator = Simulator::new(LIMIT, Link::default(), 3);
    simulator.run(30.0);
    simulator.link.delay = 60;
    simulator.run(60.0);
    let sent = simulator.mean_sent(30.0, 33.0) / LIMIT;
    assert!(sent > 0.7, "{sent} in three seconds");
    assert!(simulator.least_rate(33.0, 90.0) >= LIMIT);
    assert_eq!(simulator.capacity.state(), State::Unknown);
}

#[test]
fn a_worse_path_with_a_longer_delay_and_loss_is_used_in_the_end() {
    let mut simulator = Simulator::new(LIMIT, Link::default(), 3);
    simulator.run(30.0);
    (simulator.link.delay, simulator.link.loss) = (60, 0.3);
    simulator.run(30.0);
    assert!(simulator.least_rate(45.0, 60.0) >= LIMIT);
}

#[test]
fn a_bottleneck_on_a_longer_or_shorter_route_keeps_its_rate() {
    for delay in [10, 60, 120] {
        let link = Link { rate: 5e6, ..Link::default() };
        let mut simulator = Simulator::new(LIMIT, link, 3);
        simulator.run(30.0);
        simulator.link.delay = delay;
        simulator.run(60.0);
        let sent = simulator.mean_sent(35.0, 90.0) / 5e6;
        assert!((0.85..=1.0).contains(&sent), "{sent} at {delay} ms");
        let longest = simulator.longest_queue(35.0, 90.0);
        assert!(longest <= 100.0, "{longest} ms");
    }
}

#[test]
fn the_rate_follows_the_limit() {
    let mut simulator = Simulator::new(LIMIT, Link::default(), 3);
    simulator.run(5.0);
    for limit in [1e6, 15e6] {
        let now = simulator.instant();
        simulator.capacity.set_limit(limit, now);
        simulator.capacity.set_limit(limit, now);
        assert!((simulator.capacity.bytes_per_s() - limit).abs() < 1e-6);
        simulator.run(5.0);
    }
    simulator.link.rate = 5e6;
    simulator.run(20.0);
    let now = simulator.instant();
    simulator.capacity.set_limit(2e6, now);
    assert_eq!(simulator.capacity.measured(), None);
    assert!((simulator.capacity.bytes_per_s() - 2e6).abs() < 1e-6);
}

/// A world from a seed.
fn world(seed: u64) -> (f64, Link, f64, Random) {
    let mut random = Random(seed);
    let limit = 0.3e6 * 60f64.powf(random.share());
    let slow = (limit * (0.1 + 0.85 * random.share())).max(60e3);
    let delay = 5 + random.below(115);
    let jitter = random.below(delay.min(20) / 2 + 1);
    // From 40 ms of the slow link to 8 MB.
    let least = (slow * 0.04).max(30e3);
    let link = Link {
        rate: limit * (1.1 + random.share()),
        queue: least * (8e6 / least).max(1.0).powf(random.share()),
        delay,
        jitter,
        loss: [0.0, 1e-4, 0.01, 0.03][random.below(4) as usize],
    };
    (limit, link, slow, random)
}

/// 20 worlds, or 500 with `BLAZE_LONG=1`.
#[test]
fn it_holds_on_any_link() {
    let long = std::env::var_os("BLAZE_LONG").is_some_and(|long| long == "1");
    for seed in 0..if long { 500 } else { 20 } {
        let (limit, link, slow, mut random) = world(seed);
        let mut simulator = Simulator::new(limit, link, seed);
        simulator.samples = if random.chance(0.5) { 64 } else { u32::MAX };
        simulator.stall = if random.chance(0.5) { 60 } else { 0 };
        let demands = [
            Demand::Endless,
            Demand::Even(limit * random.share()),
            Demand::Bursts(limit * random.share() / 2.0, 500),
        ];
        for demand in demands {
            simulator.demand = demand;
            simulator.run(10.0);
        }
        let least = simulator.least_rate(0.0, 30.0);
        assert!(least >= limit, "seed {seed}: {least} of {limit} on a fast link");

        simulator.demand = Demand::Endless;
        simulator.link.rate = slow;
        simulator.run(40.0);
        let (sent, longest) =
            (simulator.mean_sent(38.0, 70.0) / slow, simulator.longest_queue(38.0, 70.0));
        assert!((0.83..=1.01).contains(&sent), "seed {seed}: {sent} of a slow link");
        assert!(longest <= 200.0, "seed {seed}: {longest} ms");

        simulator.link.rate = link.rate;
        simulator.run(40.0);
        let back = back_s(&simulator, 70.0, 110.0, 0.95 * limit);
        assert!(back <= 30.0, "seed {seed}: {back} s");
        assert!(simulator.log.iter().all(|entry| entry.most_rate <= limit), "seed {seed}");
    }
}
