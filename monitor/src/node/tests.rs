//! The collectors over trees of real machines, and the threads around them.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use serde_json::json;

use super::clock::{self, ClockState};
use super::disk::{self, SpaceStat};
use super::metrics::{CPU_SECONDS, ENERGY, METRICS, NETWORK, NETWORK_DROPPED};
use super::sample::{Batch, Reading, Sample, Slot, State};
use super::sampler::{Collector, Roots, Sampler, collectors};

const DEADLINE: Duration = Duration::from_secs(20);

const MACHINES: [&str; 7] =
    ["jetson-orin", "jetson-nano", "raspberry-pi-5", "x86-rapl", "amd-gpu", "laptop", "bare-vm"];

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures")
}

fn roots(tree: &Path) -> Roots {
    Roots { proc: tree.join("proc"), sys: tree.join("sys") }
}

/// 100 GB, 40 of them available, wherever something is mounted.
fn space() -> disk::SpaceOf {
    Arc::new(|_| {
        Some(SpaceStat { id: 1, total_bytes: 100_000_000_000, available_bytes: 40_000_000_000 })
    })
}

fn synchronized() -> clock::Probe {
    Arc::new(|| Ok(ClockState { synchronized: true, error_s: 0.0125 }))
}

fn of(tree: &Path) -> Vec<Box<dyn Collector>> {
    collectors(&roots(tree), space(), synchronized())
}

fn named(tree: &Path, name: &str) -> Box<dyn Collector> {
    of(tree).into_iter().find(|collector| collector.name() == name).unwrap()
}

fn run(collector: &mut dyn Collector) -> Slot {
    let mut batch = Batch::default();
    collector.collect(&mut batch);
    let reading = Arc::new(Reading::new(batch, Instant::now()));
    Slot::new(collector.name(), reading.state.clone(), Some(reading))
}

/// One run of all collectors, without threads.
fn sample_of(tree: &Path) -> Sample {
    let slot = |mut collector: Box<dyn Collector>| {
        collector.discover();
        run(collector.as_mut())
    };
    Sample { slots: of(tree).into_iter().map(slot).collect() }
}

fn text(sample: &Sample) -> String {
    let mut text = String::new();
    for (metric, labels, value) in sample.series() {
        let pairs = metric.labels.iter().zip(labels);
        let labels: Vec<_> = pairs.map(|(name, value)| format!("{name}=\"{value}\"")).collect();
        writeln!(text, "{}{{{}}} {value}", metric.name, labels.join(",")).unwrap();
    }
    text
}

fn lines(slot: Slot) -> Vec<String> {
    text(&Sample { slots: vec![slot] }).lines().map(str::to_owned).collect()
}

fn write(path: &Path, content: &str) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, content).unwrap();
}

fn wait_for<T>(what: &str, mut condition: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(value) = condition() {
            return value;
        }
        assert!(start.elapsed() < DEADLINE, "no {what} within {DEADLINE:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn each_machine_has_exactly_its_series() {
    let mut wrong = String::new();
    for machine in MACHINES {
        let tree = fixtures().join(machine);
        let found = text(&sample_of(&tree));
        let expected = std::fs::read_to_string(tree.join("series.txt")).unwrap_or_default();
        if found != expected {
            write!(wrong, "--- {machine}\n{found}").unwrap();
        }
    }
    assert!(wrong.is_empty(), "series differ from series.txt:\n{wrong}");
}

#[test]
fn series_are_unique_and_fit_the_table() {
    for machine in MACHINES {
        let sample = sample_of(&fixtures().join(machine));
        let mut seen = std::collections::HashSet::new();
        for (metric, labels, value) in sample.series() {
            assert!(METRICS.iter().any(|known| std::ptr::eq(*known, metric)), "{}", metric.name);
            assert_eq!(labels.len(), metric.labels.len(), "{}", metric.name);
            assert!(value.is_finite());
            assert!(seen.insert((metric.name, labels)), "{machine}: {} {labels:?}", metric.name);
        }
    }
}

#[test]
fn the_status_has_the_form_of_the_contract() {
    let sample = sample_of(&fixtures().join("jetson-orin"));
    let status = serde_json::to_value(sample.status(None)).unwrap();
    let expected = json!({
        "cpus": 3,
        "memory": {"total_bytes": 32_106_065_920_u64, "available_bytes": 26_624_000_000_u64},
        "disks": [
            {"mount": "/", "total_bytes": 100_000_000_000_u64,
             "available_bytes": 40_000_000_000_u64},
            {"mount": "/boot/efi", "total_bytes": 100_000_000_000_u64,
             "available_bytes": 40_000_000_000_u64},
        ],
        "network": [{"interface": "eth0"}, {"interface": "l4tbr0"}, {"interface": "lo"},
            {"interface": "wlan0"}],
        "temperatures": [
            {"sensor": "cpu-thermal", "celsius": 48.312},
            {"sensor": "gpu-thermal", "celsius": 45.0},
            {"sensor": "soc0-thermal", "celsius": 46.093},
            {"sensor": "tj-thermal", "celsius": 48.312},
            {"sensor": "tmp451/temp1", "celsius": 38.0},
            {"sensor": "tmp451/temp2", "celsius": 44.125},
        ],
        "power": [{"rail": "VDD_GPU_SOC", "watts": 2.548_736}, {"rail": "VDD_CPU_CV",
            "watts": 1.273_856}, {"rail": "VIN_SYS_5V0", "watts": 3.075_072}],
        "battery_ratio": null,
        "gpus": [{"gpu": "gpu0", "name": "NVIDIA Jetson", "utilization_ratio": 0.375}],
        "clock": {"synchronized": true, "error_ms": 12.5},
    });
    for (key, value) in expected.as_object().unwrap() {
        assert_eq!(&status[key], value, "{key}");
    }
    assert!(status.get("cpu_ratio").is_none(), "a rate needs two samples");
    assert!(status["collectors"].as_array().unwrap().iter().all(|c| c["up"] == true));
    let vitals = sample.vitals(None);
    assert_eq!(vitals.celsius_max, Some(("tj-thermal".into(), 48.312)));
    assert_eq!(vitals.disks[0], ("/".into(), 0.4));
    assert_eq!(vitals.udp_buffer_errors_total, Some(48.0));
    assert_eq!(vitals.cgroup_throttled_s_total, Some(1.25));
    assert_eq!((vitals.clock_synchronized, vitals.clock_error_s), (Some(true), Some(0.0125)));
    let bare = serde_json::to_value(sample_of(&fixtures().join("bare-vm")).status(None)).unwrap();
    assert_eq!(bare["temperatures"], json!([]));
    assert_eq!(bare["gpus"], json!([]));
}

/// A sample of one collector with counters of a given state.
fn counters(at: Instant, idle: f64, busy: f64, received: f64, joules: f64) -> Sample {
    let mut batch = Batch::default();
    batch.two(&CPU_SECONDS, "0", "idle", idle);
    batch.two(&CPU_SECONDS, "0", "user", busy);
    for direction in ["receive", "transmit"] {
        batch.two(&NETWORK, "eth0", direction, received);
        batch.two(&NETWORK_DROPPED, "eth0", direction, 7.0);
    }
    batch.one(&ENERGY, "package-0", joules);
    let reading = Arc::new(Reading::new(batch, at));
    Sample { slots: vec![Slot::new("all", State::Up, Some(reading))] }
}

#[test]
fn rates_are_the_difference_of_two_samples() {
    let start = Instant::now();
    let before = counters(start, 10.0, 5.0, 1000.0, 50.0);
    let after = counters(start + Duration::from_secs(2), 11.5, 5.5, 500.0, 110.0);
    let status = after.status(Some(&before));
    assert_eq!(status.cpu_ratio, Some(0.25));
    assert_eq!(status.network[0].receive_bytes_per_s, None, "the counter started again");
    assert_eq!(status.network[0].dropped_per_s, Some(0.0));
    assert_eq!((status.power[0].rail.as_str(), status.power[0].watts), ("package-0", 30.0));
    assert_eq!(after.vitals(Some(&before)).cpu_ratio, Some(0.25));
    assert_eq!(before.status(Some(&before)).cpu_ratio, None, "no time has passed");
}

#[test]
fn a_source_that_blocks_holds_up_no_other_and_returns() {
    let tree = tempfile::tempdir().unwrap();
    write(&tree.path().join("proc/net/snmp"), "Udp: RcvbufErrors SndbufErrors\nUdp: 4 5\n");
    let zone = tree.path().join("sys/class/thermal/thermal_zone0");
    write(&zone.join("type"), "soc\n");
    let fifo = zone.join("temp");
    let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
    rustix::fs::mknodat(rustix::fs::CWD, &fifo, rustix::fs::FileType::Fifo, mode, 0).unwrap();
    let sampler = Sampler::with(of(tree.path()), Duration::from_millis(20));
    let down = |sample: &Sample| {
        let thermal = sample.vitals(None).collectors_down.into_iter().find(|c| c.0 == "thermal")?;
        Some(thermal.1)
    };
    let (sample, detail) = wait_for("collector that is down", || {
        let sample = sampler.sample(Instant::now());
        down(&sample).map(|detail| (sample, detail))
    });
    assert!(detail.contains("blocks"), "{detail}");
    let series = text(&sample);
    assert!(series.contains("blaze_node_udp_buffer_errors_total{} 9\n"), "{series}");
    assert!(series.contains("blaze_node_collector_up{collector=\"thermal\"} 0\n"), "{series}");
    assert!(series.contains("blaze_node_collector_up{collector=\"udp\"} 1\n"), "{series}");
    // a writer releases the reader; then there is an ordinary file
    let writer = std::fs::File::options().read(true).write(true).open(&fifo).unwrap();
    write(&zone.join("next"), "41500\n");
    std::fs::rename(zone.join("next"), &fifo).unwrap();
    wait_for("value of the zone", || {
        text(&sampler.sample(Instant::now())).contains("sensor=\"soc\"} 41.5").then_some(())
    });
    drop(writer);
}

/// Counts its runs.
struct Counting(Arc<AtomicU64>);

impl Collector for Counting {
    fn name(&self) -> &'static str {
        "counting"
    }

    fn collect(&mut self, batch: &mut Batch) {
        batch.one(&ENERGY, "x", self.0.fetch_add(1, Ordering::Relaxed) as f64);
    }
}

#[test]
fn values_follow_the_samples_and_age() {
    let runs = Arc::new(AtomicU64::new(0));
    let sampler =
        Sampler::with(vec![Box::new(Counting(Arc::clone(&runs)))], Duration::from_secs(3600));
    let value = || {
        let sample = sampler.sample(Instant::now());
        sample.values().next().map(|series| series.value)
    };
    assert_eq!(wait_for("first value", value), 0.0);
    let late = sampler.sample(Instant::now() + Duration::from_secs(4 * 3600));
    assert_eq!(late.values().count(), 0, "older than three periods");
    assert_eq!(late.vitals(None).collectors_down.len(), 1);
    assert_eq!(runs.load(Ordering::Relaxed), 1, "not more often than the period wants");
    sampler.set_period(Duration::from_millis(1));
    wait_for("next values", || value().filter(|value| *value >= 3.0));
    drop(sampler);
    wait_for("end of the thread", || (Arc::strong_count(&runs) == 1).then_some(()));
}

#[test]
fn a_file_without_permission_is_a_collector_that_is_not_up() {
    let tree = tempfile::tempdir().unwrap();
    let zone = tree.path().join("sys/class/powercap/intel-rapl:0");
    for (file, content) in
        [("name", "package-0"), ("max_energy_range_uj", "100"), ("energy_uj", "5")]
    {
        write(&zone.join(file), content);
    }
    let mode = |path: &Path, mode| {
        use std::os::unix::fs::PermissionsExt;
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).unwrap();
    };
    mode(tree.path(), 0o755);
    mode(&zone.join("energy_uj"), 0o000);
    let path = tree.path().to_owned();
    // permissions do not bind root: a thread that is nobody
    let slot = std::thread::spawn(move || {
        let _ = rustix::thread::set_thread_uid(rustix::thread::Uid::from_raw(65534));
        let mut collector = named(&path, "powercap");
        collector.discover();
        run(collector.as_mut())
    });
    let slot = slot.join().unwrap();
    let State::Down(detail) = &slot.state else { panic!("{:?}", slot.state) };
    assert!(detail.contains("permission denied") && detail.contains("chmod a+r"), "{detail}");
    assert_eq!(lines(slot), ["blaze_node_collector_up{collector=\"powercap\"} 0"]);
}

#[test]
fn energy_counters_wrap_and_go_on() {
    let tree = tempfile::tempdir().unwrap();
    let zone = tree.path().join("sys/class/powercap/intel-rapl:0");
    write(&zone.join("name"), "package-0");
    write(&zone.join("max_energy_range_uj"), "10000000");
    write(&zone.join("energy_uj"), "9000000");
    let mut collector = named(tree.path(), "powercap");
    let mut joules = |content: &str| {
        std::fs::write(zone.join("energy_uj"), content).unwrap();
        collector.discover();
        lines(run(collector.as_mut()))[0].rsplit(' ').next().unwrap().to_owned()
    };
    assert_eq!([joules("9000000"), joules("1000000"), joules("500000")], ["9", "11", "20.5"]);
}

#[test]
fn sources_come_and_go() {
    let tree = tempfile::tempdir().unwrap();
    let mut collector = named(tree.path(), "battery");
    collector.discover();
    assert_eq!(run(collector.as_mut()).state, State::Absent);
    let battery = tree.path().join("sys/class/power_supply/BAT0");
    write(&battery.join("type"), "Battery\n");
    write(&battery.join("capacity"), "50\n");
    collector.discover();
    let found = lines(run(collector.as_mut()));
    assert_eq!(found[0], "blaze_node_battery_ratio{battery=\"BAT0\"} 0.5");
    std::fs::remove_dir_all(&battery).unwrap();
    collector.discover();
    assert_eq!(run(collector.as_mut()).state, State::Absent);
}

#[test]
fn a_mount_that_is_replaced_is_read_again() {
    let tree = tempfile::tempdir().unwrap();
    let mounts = tree.path().join("proc/self/mounts");
    write(&mounts, "/dev/sda1 / ext4 rw 0 0\n/dev/sdb1 /usb ext4 rw 0 0\n");
    let id = Arc::new(AtomicU64::new(1));
    let now = Arc::clone(&id);
    let space: disk::SpaceOf = Arc::new(move |path| {
        let id = if path == Path::new("/usb") { now.load(Ordering::Relaxed) } else { 7 };
        Some(SpaceStat { id, total_bytes: 10, available_bytes: 5 })
    });
    let mut disk = disk::Space::new(&roots(tree.path()), space);
    disk.discover();
    assert_eq!(lines(run(&mut disk)).len(), 5);
    // unmounted: the path is now of the root
    id.store(7, Ordering::Relaxed);
    write(&mounts, "/dev/sda1 / ext4 rw 0 0\n");
    let found = lines(run(&mut disk));
    assert_eq!(found.len(), 3, "{found:?}");
    write(&mounts, "no such form");
    disk.discover();
    let State::Down(detail) = run(&mut disk).state else { panic!("{found:?}") };
    assert!(detail.contains("mounts has an unknown form"), "{detail}");
}

#[test]
fn labels_are_bounded() {
    let tree = tempfile::tempdir().unwrap();
    let mut stat = String::from("cpu  0 0 0 0\n");
    let mut net = String::from("head\nhead\n");
    for number in 0..300 {
        writeln!(stat, "cpu{number} 100 0 0 0 0 0 0 0 0 0").unwrap();
        writeln!(net, "eth{number}: {number} 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0").unwrap();
    }
    write(&tree.path().join("proc/stat"), &format!("{stat}ctxt 1\nbtime 1\nprocesses 1\n"));
    write(&tree.path().join("proc/net/dev"), &net);
    let cpus = lines(run(named(tree.path(), "cpu").as_mut()));
    assert_eq!(cpus.len(), 256 * 5 + 1);
    let other = "blaze_node_cpu_seconds_total{cpu=\"_other\",mode=\"user\"} 45".to_owned();
    assert!(cpus.contains(&other), "{:?}", cpus.iter().rev().take(6).collect::<Vec<_>>());
    assert_eq!(lines(run(named(tree.path(), "network").as_mut())).len(), 256 * 4 + 1);
}

#[test]
fn the_kernel_answers_for_clock_and_space() {
    let state = (clock::probe())().unwrap();
    assert!(state.error_s >= 0.0);
    let stat = (disk::space_of())(Path::new("/")).unwrap();
    assert!(stat.total_bytes > 0 && stat.available_bytes <= stat.total_bytes);
    assert!((disk::space_of())(Path::new("/no/such/path")).is_none());
}

#[test]
fn a_clock_that_cannot_be_asked_names_the_remedy() {
    let denied: clock::Probe = Arc::new(|| Err(std::io::ErrorKind::PermissionDenied.into()));
    let slot = run(&mut clock::Clock(denied));
    let State::Down(detail) = slot.state else { panic!("{:?}", slot.state) };
    assert!(detail.contains("seccomp"), "{detail}");
}

mod properties {
    use super::*;
    use proptest::prelude::*;

    const WORDS: [&str; 24] = [
        "some",
        "some ",
        "full",
        "avg10=1",
        "total=",
        "cpu",
        "cpu0",
        "cpu 1",
        "MemTotal:",
        "kB",
        "Udp:",
        "Udp: ",
        "é",
        "\u{0}",
        ":",
        "-1",
        "18446744073709551615",
        "1e400",
        "\n",
        "\n",
        " ",
        "eth0:",
        "sda",
        "RcvbufErrors",
    ];

    proptest! {
        #[test]
        fn no_content_panics(parts in prop::collection::vec(0..WORDS.len(), 0..60)) {
            let content: Vec<_> = parts.into_iter().map(|part| WORDS[part]).collect();
            let content = content.join(" ").replace(" \n ", "\n");
            let tree = tempfile::tempdir().unwrap();
            let files = ["stat", "pressure/io", "meminfo", "diskstats", "net/dev", "net/snmp",
                "net/snmp6", "net/wireless", "self/mounts", "self/cgroup", "pressure/cpu"];
            for file in files {
                write(&tree.path().join("proc").join(file), &content);
            }
            let sample = sample_of(tree.path());
            prop_assert!(sample.series().all(|(_, _, value)| value.is_finite()));
        }
    }
}
