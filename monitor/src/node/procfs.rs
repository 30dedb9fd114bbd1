//! Collectors over tables of /proc: CPUs, pressure, memory, disk traffic, network, UDP, Wi-Fi.
//!
//! The parsers are those of `procfs-core`, with two exceptions: its parser of `net/snmp` demands
//! counters that not each kernel has (those of UDP-Lite among them), and it has none for
//! `net/wireless`.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use procfs_core::net::InterfaceDeviceStatus;
use procfs_core::{
    CpuPressure, CpuTime, DiskStat, ExplicitSystemInfo, FromBufRead, FromBufReadSI, IoPressure,
    KernelStats, Meminfo, MemoryPressure, ProcError,
};

use super::file::{Fault, Text};
use super::limits;
use super::metrics::{
    CPU_SECONDS, DISK_IO, MEMORY, NETWORK, NETWORK_DROPPED, PRESSURE, UDP_ERRORS, WIFI_SIGNAL,
};
use super::sample::{Batch, Label};
use super::sampler::{Collector, Roots};

/// Ticks per second in `/proc/stat`: the same on all architectures that Linux gives to users.
const USER_HZ: u64 = 100;

/// Idle and iowait may step back by rounding; a larger step is a CPU that was switched off and on.
const STEP_BACK_S: f64 = 5.0;

/// The kernel counts in sectors of this size, whatever the disk has.
const SECTOR_BYTES: f64 = 512.0;

/// Names of disks that are no disks, or whose bytes are counted by the disks below them.
const NO_DISKS: [&str; 8] = ["loop", "ram", "zram", "sr", "fd", "dm-", "md", "nbd"];

/// Names of interfaces that belong to containers and virtual machines, or that the kernel makes.
const NO_INTERFACES: [&str; 22] = [
    "veth",
    "cali",
    "lxc",
    "cilium_",
    "docker",
    "br-",
    "cni",
    "flannel",
    "nodelocaldns",
    "kube-ipvs",
    "virbr",
    "vnet",
    "ifb",
    "dummy",
    "sit",
    "ip6tnl",
    "tunl",
    "gre",
    "erspan",
    "ip_vti",
    "ip6_vti",
    "ip6gre",
];

/// A table and its parser.
struct Table {
    name: &'static str,
    files: Vec<Text>,
    parse: fn(&mut State, usize, &str, &mut Batch) -> Result<(), String>,
    state: State,
    buffer: Vec<u8>,
}

/// What the parsers keep from one run to the next.
struct State {
    /// `/sys/block`: the names of the disks.
    block: PathBuf,
    /// Labels by name; `None` for what is left out.
    labels: HashMap<String, Option<Label>>,
    /// Last values of counters that may step back.
    counters: Vec<[f64; 2]>,
}

/// The collectors of this module.
pub(super) fn collectors(roots: &Roots) -> Vec<Box<dyn Collector>> {
    let table = |name, files: &[&str], parse| -> Box<dyn Collector> {
        let files = files.iter().map(|file| Text::table(roots.proc.join(file))).collect();
        let state =
            State { block: roots.sys.join("block"), labels: HashMap::new(), counters: Vec::new() };
        Box::new(Table { name, files, parse, state, buffer: Vec::new() })
    };
    vec![
        table("cpu", &["stat"], cpu),
        table("pressure", &["pressure/cpu", "pressure/memory", "pressure/io"], pressure),
        table("memory", &["meminfo"], memory),
        table("disk_io", &["diskstats"], disk_io),
        table("network", &["net/dev"], network),
        table("udp", &["net/snmp", "net/snmp6"], udp),
        table("wifi", &["net/wireless"], wifi),
    ]
}

impl Collector for Table {
    fn name(&self) -> &'static str {
        self.name
    }

    fn discover(&mut self) {
        self.state.labels.clear();
    }

    fn collect(&mut self, batch: &mut Batch) {
        for (index, file) in self.files.iter_mut().enumerate() {
            let text = file.read(&mut self.buffer);
            let Some(text) = batch.take(text) else { continue };
            // without its content a table is there and has nothing to say, as without Wi-Fi
            let parsed = (self.parse)(&mut self.state, index, &text, batch);
            let named =
                |error| Fault::Form { source_name: file.path().display().to_string(), error };
            batch.take(parsed.map(Some).map_err(named));
        }
        if self.name == "udp" {
            sum_udp(batch);
        }
    }
}

fn reason(error: ProcError) -> String {
    match error {
        ProcError::InternalError(inner) => inner.msg,
        other => other.to_string(),
    }
}

impl State {
    /// The label of a name, or `None` for a name that is left out. At most 256 labels.
    fn label(&mut self, name: &str, keep: impl Fn(&Path, &str) -> bool) -> Option<Label> {
        if let Some(known) = self.labels.get(name) {
            return known.clone();
        }
        let kept = self.labels.values().flatten().count() < limits::LABEL_VALUES;
        let label = (kept && keep(&self.block, name)).then(|| Label::new(name));
        if self.labels.len() < limits::DIRECTORY_ENTRIES {
            self.labels.insert(name.to_owned(), label.clone());
        }
        label
    }

    /// A counter of a CPU that does not step back by rounding.
    fn steady(&mut self, cpu: usize, counter: usize, value: f64) -> f64 {
        if self.counters.len() <= cpu {
            self.counters.resize(cpu + 1, [0.0; 2]);
        }
        let last = &mut self.counters[cpu][counter];
        if value > *last || *last - value > STEP_BACK_S {
            *last = value;
        }
        *last
    }
}

/// Values of a CPU, in the order of [`MODES`], in seconds.
type Modes = [f64; 5];

const MODES: [&str; 5] = ["user", "system", "iowait", "steal", "idle"];

fn cpu(state: &mut State, _: usize, text: &str, batch: &mut Batch) -> Result<(), String> {
    let system = ExplicitSystemInfo {
        boot_time_secs: 0,
        ticks_per_second: USER_HZ,
        page_size: 4096,
        is_little_endian: true,
    };
    let stats = KernelStats::from_buf_read(text.as_bytes(), &system).map_err(reason)?;
    // the parser keeps the order of the lines, not the numbers: CPUs that are off have no line
    let numbers = text.lines().filter_map(|line| {
        let number = line.strip_prefix("cpu")?.split(' ').next()?;
        number.parse::<usize>().ok().map(|value| (value, number))
    });
    let mut rest: Option<Modes> = None;
    for (index, ((cpu, number), time)) in numbers.zip(&stats.cpu_time).enumerate() {
        let times = modes(state, cpu.min(limits::DIRECTORY_ENTRIES), time);
        if stats.cpu_time.len() > limits::LABEL_VALUES && index >= limits::LABEL_VALUES - 1 {
            let sum = rest.get_or_insert([0.0; 5]);
            sum.iter_mut().zip(times).for_each(|(sum, time)| *sum += time);
        } else if let Some(label) = state.label(number, |_, _| true) {
            add_modes(&label, times, batch);
        }
    }
    if let Some(sum) = rest {
        add_modes(&Label::Fixed("_other"), sum, batch);
    }
    Ok(())
}

fn modes(state: &mut State, cpu: usize, time: &CpuTime) -> Modes {
    let seconds = |ticks: u64| ticks as f64 / USER_HZ as f64;
    let interrupts = time.irq.unwrap_or(0).saturating_add(time.softirq.unwrap_or(0));
    let system = time.system.saturating_add(interrupts);
    [
        seconds(time.user.saturating_add(time.nice)),
        seconds(system),
        state.steady(cpu, 0, seconds(time.iowait.unwrap_or(0))),
        seconds(time.steal.unwrap_or(0)),
        state.steady(cpu, 1, seconds(time.idle)),
    ]
}

fn add_modes(label: &Label, times: Modes, batch: &mut Batch) {
    for (mode, seconds) in MODES.into_iter().zip(times) {
        batch.two(&CPU_SECONDS, label.clone(), mode, seconds);
    }
}

fn pressure(_: &mut State, index: usize, text: &str, batch: &mut Batch) -> Result<(), String> {
    if !text.starts_with("some ") {
        // without a line: the kernel has PSI, and it is switched off
        return Ok(());
    }
    let (resource, some) = match index {
        0 => ("cpu", CpuPressure::from_buf_read(text.as_bytes()).map(|p| p.some)),
        1 => ("memory", MemoryPressure::from_buf_read(text.as_bytes()).map(|p| p.some)),
        _ => ("io", IoPressure::from_buf_read(text.as_bytes()).map(|p| p.some)),
    };
    batch.one(&PRESSURE, resource, some.map_err(reason)?.total as f64 / 1e6);
    Ok(())
}

/// More memory than this in KiB is none; the parser computes bytes without a check.
const MEMORY_KIB_MAX: u64 = 1 << 50;

fn memory(_: &mut State, _: usize, text: &str, batch: &mut Batch) -> Result<(), String> {
    let small = |word: &str| word.parse::<u64>().map_or(true, |kib| kib <= MEMORY_KIB_MAX);
    // the parser cuts the last byte of a name, and multiplies without a check
    if !text.is_ascii() || !text.split_ascii_whitespace().all(small) {
        return Err("a name is not ASCII, or a number is too large".to_owned());
    }
    let info = Meminfo::from_buf_read(text.as_bytes()).map_err(reason)?;
    if info.mem_total == 0 {
        return Ok(());
    }
    batch.one(&MEMORY, "total", info.mem_total as f64);
    if let Some(available) = info.mem_available.filter(|bytes| *bytes <= info.mem_total) {
        batch.one(&MEMORY, "available", available as f64);
    }
    if info.swap_total > 0 && info.swap_free <= info.swap_total {
        batch.one(&MEMORY, "swap_total", info.swap_total as f64);
        batch.one(&MEMORY, "swap_free", info.swap_free as f64);
    }
    Ok(())
}

fn disk_io(state: &mut State, _: usize, text: &str, batch: &mut Batch) -> Result<(), String> {
    let disk = |block: &Path, name: &str| {
        let virtual_disk = NO_DISKS.iter().any(|prefix| name.starts_with(prefix));
        // partitions are no entries there; `/` of a name is `!`
        !virtual_disk && block.join(name.replace('/', "!")).exists()
    };
    for line in text.lines() {
        let Some(name) = line.split_whitespace().nth(2) else { continue };
        let Some(label) = state.label(name, disk) else { continue };
        let stat = DiskStat::from_line(line).map_err(reason)?;
        batch.two(&DISK_IO, label.clone(), "read", stat.sectors_read as f64 * SECTOR_BYTES);
        batch.two(&DISK_IO, label, "write", stat.sectors_written as f64 * SECTOR_BYTES);
    }
    Ok(())
}

fn network(state: &mut State, _: usize, text: &str, batch: &mut Batch) -> Result<(), String> {
    // old kernels put no space between the name and the first number
    let text = text.replace(':', ": ");
    let table = InterfaceDeviceStatus::from_buf_read(text.as_bytes()).map_err(reason)?;
    let mut interfaces: Vec<_> = table.0.into_values().collect();
    interfaces.sort_by(|a, b| a.name.cmp(&b.name));
    for interface in interfaces {
        let ours = |name: &str| !NO_INTERFACES.iter().any(|prefix| name.starts_with(prefix));
        let Some(label) = state.label(&interface.name, |_, name| ours(name)) else { continue };
        let bytes = [interface.recv_bytes, interface.sent_bytes];
        let dropped = [interface.recv_drop, interface.sent_drop];
        for (index, direction) in ["receive", "transmit"].into_iter().enumerate() {
            batch.two(&NETWORK, label.clone(), direction, bytes[index] as f64);
            batch.two(&NETWORK_DROPPED, label.clone(), direction, dropped[index] as f64);
        }
    }
    Ok(())
}

/// Adds a value per counter; [`sum_udp`] makes one of them.
fn udp(_: &mut State, index: usize, text: &str, batch: &mut Batch) -> Result<(), String> {
    let mut add = |name: &str, value: Option<&str>| {
        if matches!(name, "RcvbufErrors" | "SndbufErrors")
            && let Some(count) = value.and_then(|value| value.parse::<u64>().ok())
        {
            batch.plain(&UDP_ERRORS, count as f64);
        }
    };
    if index == 0 {
        let mut lines = text.lines().filter_map(|line| line.strip_prefix("Udp: "));
        let (Some(names), Some(values)) = (lines.next(), lines.next()) else { return Ok(()) };
        names.split(' ').zip(values.split(' ')).for_each(|(name, value)| add(name, Some(value)));
    } else {
        for line in text.lines() {
            let mut words = line.split_whitespace();
            let name = words.next().and_then(|name| name.strip_prefix("Udp6"));
            add(name.unwrap_or_default(), words.next());
        }
    }
    Ok(())
}

fn sum_udp(batch: &mut Batch) {
    let sum = batch.series.iter().map(|series| series.value).sum();
    if !batch.series.is_empty() {
        batch.series.clear();
        batch.plain(&UDP_ERRORS, sum);
    }
}

fn wifi(state: &mut State, _: usize, text: &str, batch: &mut Batch) -> Result<(), String> {
    for line in text.lines().skip(2) {
        let Some((name, values)) = line.trim().split_once(':') else { continue };
        let level = values.split_whitespace().nth(2).and_then(|level| {
            let dbm: f64 = level.trim_end_matches('.').parse().ok()?;
            (dbm > limits::SIGNAL_DBM.0 && dbm < limits::SIGNAL_DBM.1).then_some(dbm)
        });
        if let (Some(dbm), Some(label)) = (level, state.label(name, |_, _| true)) {
            batch.one(&WIFI_SIGNAL, label, dbm);
        }
    }
    Ok(())
}
