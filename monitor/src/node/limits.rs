//! Times and limits of the node's values.

use std::time::Duration;

/// Values of one label of one metric. More CPUs are summed as `_other`, more of the rest left out.
pub const LABEL_VALUES: usize = 256;

/// Values of the hwmon and IIO chips. With zones and GPUs together [`LABEL_VALUES`] at most.
pub const HWMON_VALUES: usize = 128;

/// Thermal zones. Boards have up to 20.
pub const THERMAL_ZONES: usize = 64;

/// GPUs of a kind (sysfs, NVML). Servers have up to 16.
pub const GPUS: usize = 32;

/// Power domains of RAPL. Two sockets have 10.
pub const POWER_DOMAINS: usize = 64;

/// Entries of a directory that are looked at.
pub const DIRECTORY_ENTRIES: usize = 1024;

/// Bytes of an attribute in sysfs or of a cgroup: a page is the kernel's own limit.
pub const ATTRIBUTE_BYTES: usize = 4096;

/// Bytes of a table in /proc. The mounts of a Kubernetes node reach some 500 KiB.
pub const TABLE_BYTES: usize = 1 << 20;

/// Characters of a name that a sensor or a driver gives.
pub const NAME_CHARS: usize = 96;

/// The sources are looked for again after this time: what was plugged in appears.
pub const DISCOVERY: Duration = Duration::from_secs(60);

/// A value that is older than this many periods is left out.
pub const STALE_PERIODS: u32 = 3;

/// A value younger than this is never left out: with 0.2 s as the period, threads of a busy
/// machine are late by more than three periods.
pub const STALE_AT_LEAST: Duration = Duration::from_secs(2);

/// Bytes of the stack of a collector's thread: parsers keep their data on the heap.
pub const STACK_BYTES: usize = 256 << 10;

/// Temperatures that a sensor can mean, in °C, both exclusive. −256 and −273 stand for no sensor.
pub const CELSIUS: (f64, f64) = (-55.0, 150.0);

/// Power that a rail or a GPU can take, in W.
pub const WATTS_MAX: f64 = 10_000.0;

/// Signal levels in dBm that a radio can mean, both exclusive. −256 stands for none, and drivers
/// that report a percentage are above 0.
pub const SIGNAL_DBM: (f64, f64) = (-120.0, 0.0);
