//! The table of the metrics: names, kinds, units, labels, and what they mean.

/// Kind of a metric in the sense of Prometheus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Grows, or starts again at the restart of its source.
    Counter,
    /// Goes up and down.
    Gauge,
}

impl Kind {
    /// The word of the exposition format.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Counter => "counter",
            Self::Gauge => "gauge",
        }
    }
}

/// One metric. `/metrics` and the documentation are generated from [`METRICS`].
#[derive(Debug)]
pub struct Metric {
    /// Name, without labels.
    pub name: &'static str,
    /// Counter or gauge.
    pub kind: Kind,
    /// Unit of the value; `1` for ratios, states and counts.
    pub unit: &'static str,
    /// Meaning, one sentence.
    pub help: &'static str,
    /// Names of the labels, in the order of a series' values.
    pub labels: &'static [&'static str],
}

macro_rules! metrics {
    ($($id:ident $kind:ident $name:literal [$($label:literal),*] $unit:literal $help:literal)*) => {
        $(pub(super) static $id: Metric = Metric {
            name: $name, kind: Kind::$kind, unit: $unit, help: $help, labels: &[$($label),*],
        };)*
        /// All metrics of this module, in the order of the documentation.
        pub static METRICS: &[&Metric] = &[$(&$id),*];
    };
}

metrics! {
    CPU_SECONDS Counter "blaze_node_cpu_seconds_total" ["cpu", "mode"] "seconds"
        "Time of a CPU in a mode: user (with nice), system (with interrupts), iowait, steal, idle."
    PRESSURE Counter "blaze_node_pressure_seconds_total" ["resource"] "seconds"
        "Time in which at least one task waited for cpu, memory or io (PSI, some)."
    MEMORY Gauge "blaze_node_memory_bytes" ["kind"] "bytes"
        "Memory of the node: total, available (without swapping), swap_total, swap_free."
    CGROUP_MEMORY Gauge "blaze_node_cgroup_memory_bytes" ["kind"] "bytes"
        "Memory of the monitor's own control group (v2): limit, used."
    CGROUP_CPUS Gauge "blaze_node_cgroup_cpus" [] "1"
        "CPUs that the monitor's own control group (v2) may use; no series without a limit."
    CGROUP_THROTTLED Counter "blaze_node_cgroup_throttled_seconds_total" [] "seconds"
        "Time in which the monitor's own control group (v2) waited for its CPU quota."
    DISK Gauge "blaze_node_disk_bytes" ["mount", "kind"] "bytes"
        "Size of a file system: total, available (to users without privilege)."
    DISK_IO Counter "blaze_node_disk_io_bytes_total" ["device", "direction"] "bytes"
        "Bytes that a disk has read or written."
    NETWORK Counter "blaze_node_network_bytes_total" ["interface", "direction"] "bytes"
        "Bytes of a network interface: receive, transmit."
    NETWORK_DROPPED Counter "blaze_node_network_dropped_total" ["interface", "direction"] "1"
        "Packets that an interface dropped for lack of buffers: receive, transmit."
    UDP_ERRORS Counter "blaze_node_udp_buffer_errors_total" [] "1"
        "UDP datagrams lost because a socket buffer was full: RcvbufErrors and SndbufErrors of \
         IPv4 and IPv6."
    WIFI_SIGNAL Gauge "blaze_node_wifi_signal_dbm" ["interface"] "dBm"
        "Signal level of a Wi-Fi interface."
    TEMPERATURE Gauge "blaze_node_temperature_celsius" ["sensor"] "celsius"
        "Temperature of a thermal zone (its type), an hwmon chip (chip/label) or a GPU."
    POWER Gauge "blaze_node_power_watts" ["rail"] "watts"
        "Power of a rail (INA3221), a chip (chip/label) or a GPU."
    ENERGY Counter "blaze_node_energy_joules_total" ["domain"] "joules"
        "Energy that a domain has used (RAPL, NVIDIA GPUs). Wrap-arounds of the hardware are added."
    BATTERY Gauge "blaze_node_battery_ratio" ["battery"] "1"
        "Charge of a battery of the machine, 0 to 1."
    GPU_UTILIZATION Gauge "blaze_node_gpu_utilization_ratio" ["gpu"] "1"
        "Share of time in which the GPU was busy, 0 to 1."
    GPU_MEMORY Gauge "blaze_node_gpu_memory_bytes" ["gpu", "kind"] "bytes"
        "Memory of a GPU of its own: total, used."
    CLOCK_SYNCHRONIZED Gauge "blaze_node_clock_synchronized" [] "1"
        "1 where a program keeps the kernel's clock synchronised, else 0."
    CLOCK_ERROR Gauge "blaze_node_clock_error_seconds" [] "seconds"
        "Maximum error of the clock by the kernel's account; 16 s without synchronisation."
    COLLECTOR_UP Gauge "blaze_node_collector_up" ["collector"] "1"
        "1 where a source of values is there and read, 0 where it is there and cannot be read."
}
