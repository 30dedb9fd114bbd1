//! Measures one link topic: best effort against RTPS reliability, paced, between two processes.
//!
//! ```text
//! link_qos sub address=127.0.0.1 domain=40 seconds=12 [reliable] [depth=4096]
//! link_qos pub address=127.0.0.1 domain=40 size=1296 megabytes=20 seconds=8 [reliable] [depth=4096] [interface=lo]
//! ```
//! Between hosts or network namespaces one side also takes `peer=<address>`. Latency needs one machine: the sender's
//! time of day travels in each sample. docs/design/link-measurements.md holds the results.

use std::fs;
use std::net::Ipv4Addr;
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use blaze_brokers::dds::{Participant, ParticipantConfig, Profile, Relay, RelayConfig};
use bytes::{BufMut, Bytes, BytesMut};
use parking_lot::Mutex;

const TOPIC: &str = "blaze/measure/link";
/// Sequence number and time of day.
const HEADER: usize = 16;

struct Arguments(Vec<String>);

impl Arguments {
    fn get<T: FromStr>(&self, name: &str, default: T) -> T {
        let value = self
            .0
            .iter()
            .find_map(|argument| argument.strip_prefix(name)?.strip_prefix('='));
        value.and_then(|value| value.parse().ok()).unwrap_or(default)
    }

    fn has(&self, word: &str) -> bool {
        self.0.iter().any(|argument| argument == word)
    }

    fn profile(&self) -> Profile {
        Profile {
            reliable: self.has("reliable"),
            depth: self.get("depth", 4096),
            transient_local: false,
            window: 0,
        }
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments = Arguments(std::env::args().skip(1).collect());
    let address = arguments.get("address", Ipv4Addr::LOCALHOST);
    let domain = arguments.get("domain", 40);
    let relay = Relay::start(RelayConfig {
        domain,
        address,
        peers: vec![arguments.get("peer", address).to_string()],
        slots: 2,
    })?;
    let config = ParticipantConfig::new(domain, address);
    let participant = Participant::start(ParticipantConfig {
        receive_buffer_bytes: arguments.get("receive_buffer", config.receive_buffer_bytes),
        ..config
    })?;
    relay.set_participant(participant.prefix());
    if arguments.has("pub") {
        publish(&arguments, &participant)
    } else {
        subscribe(&arguments, &participant)
    }
}

fn time_of_day_ns() -> u64 {
    let passed = SystemTime::now()
        .duration_since(SystemTime::UNIX_EPOCH)
        .unwrap_or_default();
    u64::try_from(passed.as_nanos()).unwrap_or(u64::MAX)
}

/// Processor time of this process so far, in seconds.
fn cpu_seconds() -> f64 {
    let stat = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks = |place: usize| {
        fields
            .get(place)
            .and_then(|field| field.parse::<f64>().ok())
            .unwrap_or(0.0)
    };
    (ticks(11) + ticks(12)) / 100.0
}

fn resident_mb() -> f64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))
        .unwrap_or_default();
    line.split_whitespace()
        .next()
        .and_then(|kib| kib.parse::<f64>().ok())
        .unwrap_or(0.0)
        / 1024.0
}

/// Bytes and packets that an interface sent and received.
fn counters(interface: &str) -> [f64; 4] {
    ["tx_bytes", "tx_packets", "rx_bytes", "rx_packets"].map(|name| {
        let text = fs::read_to_string(format!("/sys/class/net/{interface}/statistics/{name}")).unwrap_or_default();
        text.trim().parse().unwrap_or(0.0)
    })
}

fn publish(arguments: &Arguments, participant: &Participant) -> Result<(), Box<dyn std::error::Error>> {
    let size = arguments.get("size", 1296_usize).max(HEADER);
    let rate = arguments.get("megabytes", 20.0_f64) * 1e6 / size as f64;
    let seconds = arguments.get("seconds", 8.0_f64);
    let interface = arguments.get("interface", String::from("lo"));
    let writer = participant.writer(TOPIC, arguments.profile())?;
    let begin = Instant::now();
    while !writer.is_matched() {
        if begin.elapsed() > Duration::from_secs(20) {
            return Err("no reader".into());
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    println!("matched after {:?}", begin.elapsed());
    // The reader must know this writer, too.
    std::thread::sleep(Duration::from_millis(700));
    let (cpu, before, begin) = (cpu_seconds(), counters(&interface), Instant::now());
    let (mut sent, mut refused) = (0_u64, 0_u64);
    while begin.elapsed().as_secs_f64() < seconds {
        let due = (begin.elapsed().as_secs_f64() * rate) as u64;
        while sent < due {
            let mut sample = BytesMut::with_capacity(size);
            sample.put_u64_le(sent);
            sample.put_u64_le(time_of_day_ns());
            sample.resize(size, 0xab);
            refused += u64::from(!writer.write(sample.freeze()));
            sent += 1;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    let took = begin.elapsed().as_secs_f64();
    let cpu = (cpu_seconds() - cpu) / took;
    std::thread::sleep(Duration::from_millis(500));
    let after = counters(&interface);
    let delta: Vec<f64> = after.iter().zip(before).map(|(after, before)| after - before).collect();
    println!(
        "pub sent={sent} refused={refused} rate={:.0}/s MB/s={:.1} cpu={cpu:.2} rss_peak_mb={:.0} tx_bytes/sample={:.1} \
         tx_packets/sample={:.3} rx_bytes/sample={:.1} rx_packets/sample={:.3}",
        sent as f64 / took,
        (sent as f64 * size as f64) / took / 1e6,
        resident_mb(),
        delta[0] / sent as f64,
        delta[1] / sent as f64,
        delta[2] / sent as f64,
        delta[3] / sent as f64,
    );
    Ok(())
}

#[derive(Default)]
struct Tally {
    received: u64,
    highest: u64,
    disordered: u64,
    latencies_us: Vec<u64>,
}

fn subscribe(arguments: &Arguments, participant: &Participant) -> Result<(), Box<dyn std::error::Error>> {
    let tally = Arc::<Mutex<Tally>>::default();
    let first = Arc::<AtomicBool>::default();
    let (shared, started) = (Arc::clone(&tally), Arc::clone(&first));
    let sink = move |_, sample: Bytes| {
        let Some((header, _)) = sample.split_first_chunk::<HEADER>() else {
            return;
        };
        let field = |at: usize| header[at..at + 8].try_into().map_or(0, u64::from_le_bytes);
        let mut tally = shared.lock();
        tally.received += 1;
        tally.disordered += u64::from(field(0) < tally.highest);
        tally.highest = tally.highest.max(field(0) + 1);
        tally
            .latencies_us
            .push(time_of_day_ns().saturating_sub(field(8)) / 1000);
        started.store(true, Ordering::Relaxed);
    };
    let _reader = participant.reader(TOPIC, arguments.profile(), Box::new(sink))?;
    let deadline = Instant::now() + Duration::from_secs_f64(arguments.get("seconds", 12.0));
    while !first.load(Ordering::Relaxed) && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(1));
    }
    let (cpu, begin) = (cpu_seconds(), Instant::now());
    let mut last = (0, Instant::now(), cpu);
    while Instant::now() < deadline && last.1.elapsed() < Duration::from_secs(2) {
        std::thread::sleep(Duration::from_millis(50));
        let received = tally.lock().received;
        if received != last.0 {
            last = (received, Instant::now(), cpu_seconds());
        }
    }
    let took = last.1.duration_since(begin).as_secs_f64().max(0.001);
    let mut tally = tally.lock();
    tally.latencies_us.sort_unstable();
    let count = tally.latencies_us.len();
    let percentile = |share: f64| {
        tally
            .latencies_us
            .get((count as f64 * share) as usize)
            .copied()
            .unwrap_or(0)
    };
    println!(
        "sub received={} lost={} disordered={} cpu={:.2} rss_peak_mb={:.0} latency_us p50={} p99={} max={}",
        tally.received,
        tally.highest - tally.received,
        tally.disordered,
        (last.2 - cpu) / took,
        resident_mb(),
        percentile(0.5),
        percentile(0.99),
        tally.latencies_us.last().copied().unwrap_or(0),
    );
    Ok(())
}
