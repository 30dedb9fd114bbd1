mod simulator;

use std::time::{Duration, Instant};

use super::*;
use simulator::{Demand, Link, Simulator};

fn dips(s: &Simulator, from: f64, to: f64, limit: f64) -> (f64, usize, f64) {
    let e = s.between(from, to);
    (s.least_rate(from, to) / limit, e.iter().filter(|e| e.least_rate < 0.9 * limit).count(), s.mean_sent(from, to))
}

#[test]
fn explore() {
    println!();
    for jitter in [5, 10, 20, 30, 40] {
        for samples in [u32::MAX, 64] {
            for stall in [0, 60, 120, 200] {
                let mut s = Simulator::new(2e6, Link { rate: 4e6, jitter, delay: 50, ..Link::default() }, 3);
                s.samples = samples;
                s.stall = stall;
                s.run(200.0);
                println!("jitter {jitter} {samples} stall {stall}: {:?}", dips(&s, 0.0, 200.0, 2e6));
            }
        }
    }
    for loss in [0.03, 0.05, 0.08, 0.2, 0.4] {
        let mut s = Simulator::new(2e6, Link { rate: 4e6, loss, ..Link::default() }, 3);
        s.run(200.0);
        println!("loss {loss}: {:?}", dips(&s, 0.0, 200.0, 2e6));
        s.link.rate = 0.5e6;
        s.run(60.0);
        println!("   sent {:.3} {:?}", s.mean_sent(210.0, 260.0) / 0.5e6, s.capacity.measured());
    }
    for (name, demand) in [("even", Demand::Even(1e6)), ("bursts", Demand::Bursts(900e3, 100)), ("bursts2", Demand::Bursts(2e6, 1000)), ("tiny", Demand::Bursts(3000.0, 300))] {
        for rate in [40e6, 12e6, 5e6] {
            let mut s = Simulator::new(20e6, Link { rate, ..Link::default() }, 3);
            s.demand = demand;
            s.run(100.0);
            println!("{name} {rate}: {:?} queue {:.0} state {:?} {:?}", dips(&s, 0.0, 100.0, 20e6), s.longest_queue(10.0, 100.0), s.capacity.state(), s.capacity.measured());
        }
    }
    // route change
    for (limit, rate) in [(20e6, 40e6), (20e6, 5e6)] {
        for delay in [35, 60, 120, 10] {
            let mut s = Simulator::new(limit, Link { rate, ..Link::default() }, 3);
            s.run(30.0);
            s.link.delay = delay;
            s.run(60.0);
            println!("route {rate} {delay}: {:?} 30-33 {:?} later {:?} q {:.0}", dips(&s, 0.0, 30.0, limit), dips(&s, 30.0, 33.0, limit), dips(&s, 33.0, 90.0, limit), s.longest_queue(33.0, 90.0));
        }
    }
    // outage
    for rate in [40e6, 5e6, 0.25e6] {
        for delay in [25, 120] {
            let mut s = Simulator::new(20e6, Link { rate, delay, ..Link::default() }, 3);
            let now = s.instant();
            s.capacity.outage(now);
            s.run(60.0);
            let rates: Vec<String> = s.between(0.0, 4.0).iter().step_by(5).map(|e| format!("{:.2}", e.most_rate / 1e6)).collect();
            println!("outage {rate} {delay}: {rates:?} peak {:.0} q5 {:.0} sent {:.3}", s.longest_queue(0.0, 5.0), s.longest_queue(5.0, 60.0), s.mean_sent(10.0, 60.0) / rate.min(20e6));
        }
    }
    // steps down
    let mut s = Simulator::new(20e6, Link { rate: 40e6, ..Link::default() }, 3);
    s.run(10.0);
    for rate in [10e6, 5e6, 2e6, 1e6, 8e6, 0.5e6] {
        s.link.rate = rate;
        let t = s.log.len() as f64 / 10.0;
        s.run(2.0);
        let early = s.longest_queue(t, t + 2.0);
        s.run(18.0);
        println!("step {rate}: peak {early:.0} q {:.0} sent {:.3}", s.longest_queue(t + 8.0, t + 20.0), s.mean_sent(t + 8.0, t + 20.0) / rate);
    }
    let mut s = Simulator::new(20e6, Link { rate: 40e6, ..Link::default() }, 3);
    s.run(10.0);
    for rate in [10e6, 5e6, 2e6, 1e6, 0.5e6] {
        s.link.rate = rate;
        s.run(0.6);
    }
    s.run(60.0);
    println!("slide: {:?} q {:.0} sent {:.3}", (0..9).map(|t| s.longest_queue(10.0 + t as f64, 11.0 + t as f64) as i64).collect::<Vec<_>>(), s.longest_queue(30.0, 70.0), s.mean_sent(30.0, 70.0) / 0.5e6);
}
