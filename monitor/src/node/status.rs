//! The sample as the body of `/v1/node`, and as the few values that health judges.

use std::collections::HashMap;
use std::sync::Arc;

use serde::Serialize;

use super::metrics::{
    BATTERY, CGROUP_THROTTLED, CLOCK_ERROR, CLOCK_SYNCHRONIZED, CPU_SECONDS, DISK, ENERGY,
    GPU_MEMORY, GPU_UTILIZATION, MEMORY, NETWORK, NETWORK_DROPPED, POWER, TEMPERATURE, UDP_ERRORS,
};
use super::sample::{Label, Reading, Sample, Series, State};
use crate::metric::Metric;

/// Body of `/v1/node`. What the machine lacks is absent.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct NodeStatus {
    /// CPUs that are switched on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpus: Option<u64>,
    /// Share of the time in which the CPUs were busy between the two samples, 0 to 1. Waiting for
    /// I/O is no work; time stolen by the hypervisor is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpu_ratio: Option<f64>,
    /// Memory of the node.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<MemoryStatus>,
    /// File systems.
    pub disks: Vec<DiskStatus>,
    /// Network interfaces.
    pub network: Vec<NetworkStatus>,
    /// Temperatures.
    pub temperatures: Vec<TemperatureStatus>,
    /// Rails, and the power of energy counters between the two samples.
    pub power: Vec<PowerStatus>,
    /// Mean charge of the batteries, 0 to 1; null without one.
    pub battery_ratio: Option<f64>,
    /// GPUs.
    pub gpus: Vec<GpuStatus>,
    /// The kernel's clock.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub clock: Option<ClockStatus>,
    /// The sources that are there.
    pub collectors: Vec<CollectorStatus>,
}

/// Memory of the node.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MemoryStatus {
    /// Size in bytes.
    pub total_bytes: u64,
    /// Available without swapping, in bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub available_bytes: Option<u64>,
}

/// One file system.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DiskStatus {
    /// Path.
    pub mount: String,
    /// Size in bytes.
    pub total_bytes: u64,
    /// Available to users without privilege, in bytes.
    pub available_bytes: u64,
}

/// One network interface, between the two samples.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct NetworkStatus {
    /// Name.
    pub interface: String,
    /// Bytes received per second.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub receive_bytes_per_s: Option<f64>,
    /// Bytes transmitted per second.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub transmit_bytes_per_s: Option<f64>,
    /// Packets dropped per second in both directions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dropped_per_s: Option<f64>,
}

/// One temperature.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TemperatureStatus {
    /// Name of the sensor.
    pub sensor: String,
    /// Temperature in °C.
    pub celsius: f64,
}

/// One power.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PowerStatus {
    /// Name of the rail or domain.
    pub rail: String,
    /// Power in W.
    pub watts: f64,
}

/// One GPU.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct GpuStatus {
    /// Value of the label `gpu`.
    pub gpu: String,
    /// Name by the driver.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Share of time in which it was busy, 0 to 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub utilization_ratio: Option<f64>,
    /// Used memory of its own, in bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_used_bytes: Option<u64>,
    /// Memory of its own, in bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_total_bytes: Option<u64>,
}

/// The kernel's clock.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ClockStatus {
    /// A program keeps it synchronised.
    pub synchronized: bool,
    /// Its maximum error by the kernel's account, in ms.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error_ms: Option<f64>,
}

/// A source of values that is there.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CollectorStatus {
    /// Name.
    pub collector: String,
    /// It is read.
    pub up: bool,
    /// Why not, and the remedy; empty where it is up.
    pub detail: String,
}

/// The values that health judges.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Vitals {
    /// Share of time in which the CPUs were busy, 0 to 1.
    pub cpu_ratio: Option<f64>,
    /// Available of all memory, 0 to 1.
    pub memory_ratio: Option<f64>,
    /// Mount and available of all space, 0 to 1.
    pub disks: Vec<(String, f64)>,
    /// The hottest sensor, in °C.
    pub celsius_max: Option<(String, f64)>,
    /// A program keeps the clock synchronised.
    pub clock_synchronized: Option<bool>,
    /// Maximum error of the clock in seconds.
    pub clock_error_s: Option<f64>,
    /// Datagrams lost at full socket buffers since the start of the machine.
    pub udp_buffer_errors_total: Option<f64>,
    /// Seconds in which the own control group was throttled since it exists.
    pub cgroup_throttled_s_total: Option<f64>,
    /// Collectors that are not up: name, reason with remedy.
    pub collectors_down: Vec<(String, String)>,
}

impl Sample {
    /// The body of `/v1/node`. `before` is an earlier sample, for the rates; without it, and where
    /// a counter was not read twice, there is no rate.
    #[must_use]
    pub fn status(&self, before: Option<&Self>) -> NodeStatus {
        let rates = self.rates(before);
        NodeStatus {
            cpus: self.cpus(),
            cpu_ratio: cpu_ratio(&rates),
            memory: self.memory(),
            disks: self.disks(),
            network: self.network(&rates),
            temperatures: self.temperatures().collect(),
            power: self.power(&rates),
            battery_ratio: mean(self.of(&BATTERY).map(|series| series.value)),
            gpus: self.gpus(),
            clock: self.clock(),
            collectors: self.collectors(),
        }
    }

    /// The values that health judges; `before` as in [`Sample::status`].
    #[must_use]
    pub fn vitals(&self, before: Option<&Self>) -> Vitals {
        let share = |part: u64, whole: u64| part as f64 / (whole as f64).max(1.0);
        let memory = self.memory();
        let disk = |disk: DiskStatus| (disk.mount, share(disk.available_bytes, disk.total_bytes));
        let hottest = self.temperatures().max_by(|a, b| a.celsius.total_cmp(&b.celsius));
        let down = self.collectors().into_iter().filter(|collector| !collector.up);
        Vitals {
            cpu_ratio: cpu_ratio(&self.rates(before)),
            memory_ratio: memory.and_then(|m| Some(share(m.available_bytes?, m.total_bytes))),
            disks: self.disks().into_iter().map(disk).collect(),
            celsius_max: hottest.map(|sensor| (sensor.sensor, sensor.celsius)),
            clock_synchronized: self.clock().map(|clock| clock.synchronized),
            clock_error_s: self.only(&CLOCK_ERROR),
            udp_buffer_errors_total: self.only(&UDP_ERRORS),
            cgroup_throttled_s_total: self.only(&CGROUP_THROTTLED),
            collectors_down: down.map(|c| (c.collector, c.detail)).collect(),
        }
    }

    fn of(&self, metric: &'static Metric) -> impl Iterator<Item = &Series> {
        self.values().filter(move |series| series.is(metric))
    }

    /// The value of a metric without labels.
    fn only(&self, metric: &'static Metric) -> Option<f64> {
        self.of(metric).next().map(|series| series.value)
    }

    fn cpus(&self) -> Option<u64> {
        let count = self.of(&CPU_SECONDS).filter(|s| word(s, 1) == "idle").count() as u64;
        (count > 0).then_some(count)
    }

    fn memory(&self) -> Option<MemoryStatus> {
        let kind = |kind| self.of(&MEMORY).find(|s| word(s, 0) == kind).map(|s| s.value as u64);
        Some(MemoryStatus { total_bytes: kind("total")?, available_bytes: kind("available") })
    }

    fn disks(&self) -> Vec<DiskStatus> {
        let available: HashMap<_, _> = self
            .of(&DISK)
            .filter(|series| word(series, 1) == "available")
            .map(|series| (word(series, 0), series.value))
            .collect();
        let total = self.of(&DISK).filter(|series| word(series, 1) == "total");
        let status = |series: &Series| {
            Some(DiskStatus {
                mount: word(series, 0).to_owned(),
                total_bytes: series.value as u64,
                available_bytes: *available.get(word(series, 0))? as u64,
            })
        };
        total.filter_map(status).collect()
    }

    fn network(&self, rates: &Rates<'_>) -> Vec<NetworkStatus> {
        let received = self.of(&NETWORK).filter(|series| word(series, 1) == "receive");
        let status = |series: &Series| {
            let name = word(series, 0);
            let rate = |metric, direction| rates.of(metric, name, direction);
            let dropped = [rate(&NETWORK_DROPPED, "receive"), rate(&NETWORK_DROPPED, "transmit")];
            NetworkStatus {
                interface: name.to_owned(),
                receive_bytes_per_s: rate(&NETWORK, "receive"),
                transmit_bytes_per_s: rate(&NETWORK, "transmit"),
                dropped_per_s: dropped[0].and_then(|receive| Some(receive + dropped[1]?)),
            }
        };
        received.map(status).collect()
    }

    fn temperatures(&self) -> impl Iterator<Item = TemperatureStatus> {
        self.of(&TEMPERATURE).map(|series| TemperatureStatus {
            sensor: word(series, 0).to_owned(),
            celsius: series.value,
        })
    }

    /// Measured power first; of an energy counter only where there is no measured one of its name.
    fn power(&self, rates: &Rates<'_>) -> Vec<PowerStatus> {
        let status = |rail: &str, watts| PowerStatus { rail: rail.to_owned(), watts };
        let measured = self.of(&POWER).map(|series| status(word(series, 0), series.value));
        let mut all: Vec<_> = measured.collect();
        for series in self.of(&ENERGY) {
            let name = word(series, 0);
            if let Some(watts) = rates.of(&ENERGY, name, "")
                && all.iter().all(|known| known.rail != name)
            {
                all.push(status(name, watts));
            }
        }
        all
    }

    fn gpus(&self) -> Vec<GpuStatus> {
        let mut gpus: Vec<GpuStatus> = Vec::new();
        for series in self.values() {
            if !series.is(&GPU_UTILIZATION) && !series.is(&GPU_MEMORY) {
                continue;
            }
            let label = &series.labels()[0];
            let index =
                gpus.iter().position(|gpu| gpu.gpu == label.as_str()).unwrap_or_else(|| {
                    let (gpu, name) = (label.to_string(), self.gpu_name(label));
                    gpus.push(GpuStatus { gpu, name, ..GpuStatus::default() });
                    gpus.len() - 1
                });
            let gpu = &mut gpus[index];
            match series.labels().get(1).map(Label::as_str) {
                None => gpu.utilization_ratio = Some(series.value),
                Some("total") => gpu.memory_total_bytes = Some(series.value as u64),
                Some(_) => gpu.memory_used_bytes = Some(series.value as u64),
            }
        }
        gpus
    }

    fn gpu_name(&self, label: &Label) -> Option<String> {
        let readings = self.slots.iter().filter_map(|slot| slot.reading.as_ref());
        let mut names = readings.flat_map(|reading| &reading.names);
        names.find(|(gpu, _)| gpu == label).map(|(_, name)| name.to_string())
    }

    fn clock(&self) -> Option<ClockStatus> {
        let synchronized = self.only(&CLOCK_SYNCHRONIZED)? > 0.0;
        let error_ms = self.only(&CLOCK_ERROR).map(|seconds| seconds * 1e3);
        Some(ClockStatus { synchronized, error_ms })
    }

    fn collectors(&self) -> Vec<CollectorStatus> {
        let status = |collector: &str, up, detail: &str| CollectorStatus {
            collector: collector.to_owned(),
            up,
            detail: detail.to_owned(),
        };
        let there = self.slots.iter().filter_map(|slot| match &slot.state {
            State::Absent => None,
            State::Up => Some(status(slot.collector, true, "")),
            State::Down(detail) => Some(status(slot.collector, false, detail)),
        });
        there.collect()
    }

    /// Change per second of the counters, where both samples have a reading.
    fn rates<'a>(&'a self, before: Option<&'a Self>) -> Rates<'a> {
        let mut rates = Rates::default();
        let older = |slot: &str| {
            let slots = before.map_or(&[][..], |before| &before.slots);
            slots.iter().find(|other| other.collector == slot)?.reading.as_ref()
        };
        for slot in &self.slots {
            if let (Some(new), Some(old)) = (&slot.reading, older(slot.collector)) {
                rates.add(old, new);
            }
        }
        rates
    }
}

/// Name of the metric and values of its labels.
type Key<'a> = (&'static str, &'a str, &'a str);

/// Changes per second.
#[derive(Default)]
struct Rates<'a>(HashMap<Key<'a>, f64>);

impl<'a> Rates<'a> {
    fn add(&mut self, old: &'a Arc<Reading>, new: &'a Arc<Reading>) {
        let seconds = new.at.saturating_duration_since(old.at).as_secs_f64();
        if seconds <= 0.0 {
            return;
        }
        let old: HashMap<_, _> =
            old.series.iter().map(|series| (key(series), series.value)).collect();
        for series in &new.series {
            // a counter that is smaller than before has started again
            if let Some(rise) = old.get(&key(series)).map(|old| series.value - old)
                && rise >= 0.0
            {
                self.0.insert(key(series), rise / seconds);
            }
        }
    }

    fn of(&self, metric: &'static Metric, first: &str, second: &str) -> Option<f64> {
        self.0.get(&(metric.name, first, second)).copied()
    }
}

fn key(series: &Series) -> Key<'_> {
    (series.metric.name, word(series, 0), word(series, 1))
}

/// Value of a label; empty where the metric has none.
fn word(series: &Series, index: usize) -> &str {
    series.labels().get(index).map_or("", Label::as_str)
}

/// Busy of all time, over all CPUs.
fn cpu_ratio(rates: &Rates<'_>) -> Option<f64> {
    let cpu = rates.0.iter().filter(|((metric, ..), _)| *metric == CPU_SECONDS.name);
    let (mut busy, mut all) = (0.0, 0.0);
    for ((_, _, mode), rate) in cpu {
        all += rate;
        busy += if matches!(*mode, "idle" | "iowait") { 0.0 } else { *rate };
    }
    (all > 0.0).then(|| busy / all)
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (count, sum) = values.fold((0.0, 0.0), |(count, sum), value| (count + 1.0, sum + value));
    (count > 0.0).then(|| sum / count)
}
