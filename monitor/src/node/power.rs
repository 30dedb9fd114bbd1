//! Batteries, and the energy counters of RAPL.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::file::{Text, entries, word};
use super::limits;
use super::metrics::{BATTERY, ENERGY};
use super::sample::{Batch, Label};
use super::sampler::{Collector, Roots};
use super::sensors::Sensor;

/// The batteries of the machine. Those with the scope `Device` are in mice and keyboards.
pub(super) fn batteries(sys: &Path) -> Vec<Sensor> {
    let is =
        |path: &Path, file: &str, value: &str| word(&path.join(file)).as_deref() == Some(value);
    entries(&sys.join("class/power_supply"), |_| true)
        .into_iter()
        .filter(|(_, path)| is(path, "type", "Battery") || is(path, "type", "UPS"))
        .filter(|(_, path)| !is(path, "scope", "Device") && !is(path, "present", "0"))
        .take(limits::LABEL_VALUES)
        .map(|(name, path)| Sensor::new(&BATTERY, Label::new(&name), path.join("capacity"), 100.0))
        .collect()
}

struct Domain {
    path: PathBuf,
    label: Label,
    counter: Text,
    /// The counter starts again above this value, in µJ.
    range: f64,
}

/// Value of a counter that wraps around.
#[derive(Clone, Copy, Default)]
struct Wrapping {
    last: f64,
    /// Sum of the ranges that have passed.
    passed: f64,
}

impl Wrapping {
    fn add(&mut self, value: f64, range: f64) -> f64 {
        if value < self.last {
            self.passed += range;
        }
        self.last = value;
        self.passed + value
    }
}

/// Collector `powercap`.
pub(super) struct Powercap {
    folder: PathBuf,
    domains: Vec<Domain>,
    /// By path; kept when the domains are found again.
    counters: HashMap<PathBuf, Wrapping>,
    buffer: Vec<u8>,
}

impl Powercap {
    pub(super) fn new(roots: &Roots) -> Self {
        Self {
            folder: roots.sys.join("class/powercap"),
            domains: Vec::new(),
            counters: HashMap::new(),
            buffer: Vec::new(),
        }
    }
}

impl Collector for Powercap {
    fn name(&self) -> &'static str {
        "powercap"
    }

    fn discover(&mut self) {
        // intel-rapl-mmio has the same counters again
        let zone = |name: &str| name.starts_with("intel-rapl:");
        let all = entries(&self.folder, zone).into_iter().take(limits::POWER_DOMAINS);
        self.domains = all.filter_map(|(zone, path)| domain(&self.folder, &zone, path)).collect();
        self.counters.retain(|path, _| self.domains.iter().any(|domain| domain.path == *path));
    }

    fn collect(&mut self, batch: &mut Batch) {
        for domain in &mut self.domains {
            let value = domain.counter.number(&mut self.buffer);
            let Some(value) = batch.take(value).filter(|value| *value >= 0.0) else { continue };
            let counter = self.counters.entry(domain.path.clone()).or_default();
            let joules = counter.add(value, domain.range) / 1e6;
            batch.one(&ENERGY, domain.label.clone(), joules);
        }
    }
}

/// A domain is named by its package: `package-0`, `package-0/core`.
fn domain(folder: &Path, zone: &str, path: PathBuf) -> Option<Domain> {
    let mut name = word(&path.join("name"))?;
    let parent = zone.rsplit_once(':').map(|(parent, _)| parent).filter(|p| p.contains(':'));
    if let Some(parent) = parent.and_then(|parent| word(&folder.join(parent).join("name"))) {
        name = format!("{parent}/{name}");
    }
    let range = word(&path.join("max_energy_range_uj"))?.parse::<u64>().ok()? as f64;
    let counter = Text::attribute(path.join("energy_uj"));
    Some(Domain { path, label: Label::new(&name), counter, range })
}
