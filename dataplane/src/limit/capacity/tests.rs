mod simulator;

use std::time::{Duration, Instant};

use super::*;
use simulator::{Demand, Link, Simulator};


#[test]
fn property() {
    let mut all = Vec::new();
    for seed in 0..std::env::var("SEEDS").map_or(100, |s| s.parse().unwrap()) {
        let mut r = simulator::Random(seed);
        let limit = 0.3e6 * 60f64.powf(r.share());
        let share = 0.1 + 0.85 * r.share();
        let delay = 5 + r.below(115);
        let jitter = r.below(delay.min(20) / 2 + 1);
        let slow = (share * limit).max(60e3);
        let least_queue: f64 = (slow * 0.04).max(30e3);
        let queue = least_queue * (8e6 / least_queue).max(1.0).powf(r.share());
        let loss = [0.0, 1e-4, 0.01, 0.03][r.below(4) as usize];
        let fast = limit * (1.1 + r.share());
        let link = Link { rate: fast, queue, delay, jitter, loss };
        let mut s = Simulator::new(limit, link, seed);
        s.samples = if r.chance(0.5) { 64 } else { u32::MAX };
        s.stall = if r.chance(0.5) { 60 } else { 0 };
        s.run(20.0);
        let least = s.least_rate(0.0, 20.0) / limit;
        s.link.rate = slow;
        s.run(40.0);
        let sent = s.mean_sent(28.0, 60.0) / slow;
        let q = s.longest_queue(28.0, 60.0);
        let mut qs: Vec<f64> = s.between(28.0, 60.0).iter().map(|e| e.queue).collect();
        qs.sort_by(f64::total_cmp);
        let peak = s.longest_queue(20.0, 28.0);
        let settle = (0..400).find(|t| s.longest_queue(20.0 + f64::from(*t) / 10.0, 60.0) <= 100.0);
        s.link.rate = fast;
        s.run(40.0);
        let back = (0..400).find(|t| s.least_rate(60.0 + f64::from(*t) / 10.0, 100.0) >= 0.95 * limit);
        println!("{seed:3} limit {:.1}M slow {share:.2} delay {delay} jitter {jitter} loss {loss} queue {:.0}ms samples {} stall {}: before {least:.3} sent {sent:.3} q100 {q:.0} q99 {:.0} q90 {:.0} peak {peak:.0} settled {settle:?} back {back:?}",
            limit / 1e6, queue / slow * 1e3, s.samples.min(99), s.stall, qs[qs.len() * 99 / 100], qs[qs.len() * 9 / 10]);
        all.push((least, sent, q));
    }
}
