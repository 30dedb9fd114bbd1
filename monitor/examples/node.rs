//! Prints the series of this machine once a second, and what a sample costs.
//!
//! `cargo run -p blaze-monitor --example node -- [SECONDS] [--quiet]`

use std::time::{Duration, Instant};

use blaze_monitor::node::{Roots, Sample, Sampler};
use rustix::time::{ClockId, clock_gettime};

/// CPU time of this process, all threads.
fn cpu_time() -> Duration {
    clock_gettime(ClockId::ProcessCPUTime).try_into().unwrap_or_default()
}

fn print(sample: &Sample) {
    for (metric, labels, value) in sample.series() {
        let pairs = metric.labels.iter().zip(labels);
        let labels: Vec<_> = pairs.map(|(name, value)| format!("{name}=\"{value}\"")).collect();
        println!("{}{{{}}} {value}", metric.name, labels.join(","));
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let quiet = arguments.iter().any(|argument| argument == "--quiet");
    let seconds = arguments.iter().find_map(|argument| argument.parse().ok()).unwrap_or(10);
    let period = Duration::from_secs(1);
    let sampler = Sampler::new(&Roots::default(), period);
    // the first run looks for the sources; it is not what a sample costs
    std::thread::sleep(period);
    let mut before = sampler.sample(Instant::now());
    let (start, cpu) = (Instant::now(), cpu_time());
    for _ in 0..seconds {
        std::thread::sleep(period);
        let sample = sampler.sample(Instant::now());
        if !quiet {
            print(&sample);
            let status = serde_json::to_string(&sample.status(Some(&before)));
            println!("{}\n", status.unwrap_or_default());
        }
        before = sample;
    }
    let used = cpu_time().saturating_sub(cpu);
    let share = 100.0 * used.as_secs_f64() / start.elapsed().as_secs_f64();
    let each = used.as_micros() / u128::from(seconds.max(1_u32));
    println!(
        "{} series; CPU time per sample: {each} µs, {share:.3} % of a core",
        before.series().count()
    );
}
