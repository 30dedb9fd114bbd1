//! Values of sysfs that are one file, or a product of two, each; and the thermal zones.

use std::path::{Path, PathBuf};

use super::file::{Fault, Text, entries, word};
use super::limits;
use super::metrics::{BATTERY, GPU_MEMORY, GPU_UTILIZATION, POWER, TEMPERATURE};
use super::sample::{Batch, Label};
use super::sampler::{Collector, Roots};
use crate::metric::Metric;

/// Zones with values of no use: a constant 100 °C on Jetson, and an estimate for the fan.
const NO_ZONES: [&str; 2] = ["PMIC-Die", "thermal-fan-est"];

/// Temperatures that stand for "no sensor" in drivers, and lie in the range of real ones.
const NO_CELSIUS: [f64; 3] = [127.0, 127.5, 128.0];

/// One value of sysfs.
pub(super) struct Sensor {
    metric: &'static Metric,
    labels: [Label; 2],
    file: Text,
    /// The second factor: the current beside the voltage.
    times: Option<Text>,
    /// What the number in the file is divided by.
    divisor: f64,
}

impl Sensor {
    pub(super) fn new(metric: &'static Metric, label: Label, file: PathBuf, divisor: f64) -> Self {
        let labels = [label, "".into()];
        Self { metric, labels, file: Text::attribute(file), times: None, divisor }
    }

    /// With the second label.
    pub(super) fn kind(mut self, kind: &'static str) -> Self {
        self.labels[1] = kind.into();
        self
    }

    /// With a second factor.
    pub(super) fn times(mut self, file: PathBuf) -> Self {
        self.times = Some(Text::attribute(file));
        self
    }

    fn read(&mut self, buffer: &mut Vec<u8>) -> Result<Option<f64>, Fault> {
        let Some(mut value) = self.file.number(buffer)? else { return Ok(None) };
        if let Some(times) = &mut self.times {
            let Some(factor) = times.number(buffer)? else { return Ok(None) };
            value *= factor;
        }
        Ok(Some(value / self.divisor).filter(|value| sense(self.metric, *value)))
    }
}

/// Whether a value can be meant. Drivers report the lack of a sensor as a number.
pub(super) fn sense(metric: &'static Metric, value: f64) -> bool {
    let is = |other: &'static Metric| std::ptr::eq(metric, other);
    let (low, high) = limits::CELSIUS;
    if is(&TEMPERATURE) {
        low < value && value < high && !NO_CELSIUS.contains(&value)
    } else if is(&POWER) {
        (0.0..limits::WATTS_MAX).contains(&value)
    } else if is(&BATTERY) || is(&GPU_UTILIZATION) {
        (0.0..=1.0).contains(&value)
    } else if is(&GPU_MEMORY) {
        value >= 0.0
    } else {
        value.is_finite()
    }
}

/// A collector of such values.
pub(super) struct Sensors {
    name: &'static str,
    sys: PathBuf,
    find: fn(&Path) -> Vec<Sensor>,
    sensors: Vec<Sensor>,
    buffer: Vec<u8>,
}

impl Sensors {
    pub(super) fn new(name: &'static str, roots: &Roots, find: fn(&Path) -> Vec<Sensor>) -> Self {
        Self { name, sys: roots.sys.clone(), find, sensors: Vec::new(), buffer: Vec::new() }
    }
}

impl Collector for Sensors {
    fn name(&self) -> &'static str {
        self.name
    }

    fn discover(&mut self) {
        self.sensors = (self.find)(&self.sys);
    }

    fn collect(&mut self, batch: &mut Batch) {
        read_all(&mut self.sensors, &mut self.buffer, batch);
    }
}

/// Reads all sensors.
pub(super) fn read_all(sensors: &mut [Sensor], buffer: &mut Vec<u8>, batch: &mut Batch) {
    batch.found |= !sensors.is_empty();
    for sensor in sensors {
        let value = sensor.read(buffer);
        if let Some(value) = batch.take(value) {
            let [first, second] = &sensor.labels;
            batch.two(sensor.metric, first.clone(), second.clone(), value);
        }
    }
}

/// The thermal zones: the type is the name, with the number of the zone where it is there twice.
pub(super) fn thermal_zones(sys: &Path) -> Vec<Sensor> {
    let all = entries(&sys.join("class/thermal"), |name| name.starts_with("thermal_zone"));
    let zones: Vec<_> = all
        .into_iter()
        .filter_map(|(zone, path)| Some((word(&path.join("type"))?, zone, path)))
        .filter(|(kind, ..)| !NO_ZONES.contains(&kind.as_str()))
        .take(limits::THERMAL_ZONES)
        .collect();
    let twice = |kind: &str| zones.iter().filter(|zone| zone.0 == kind).count() > 1;
    let sensor = |(kind, zone, path): &(String, String, PathBuf)| {
        let name = if twice(kind) { format!("{kind}@{zone}") } else { kind.clone() };
        Sensor::new(&TEMPERATURE, Label::new(&name), path.join("temp"), 1000.0)
    };
    zones.iter().map(sensor).collect()
}

/// Whether a device sleeps; reading its values would wake it.
pub(super) fn sleeps(device: &Path) -> bool {
    word(&device.join("power/runtime_status")).as_deref() == Some("suspended")
}
