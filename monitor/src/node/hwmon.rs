//! Chips of hwmon (temperature, power, the INA3221 of Jetson boards), and the INA3221 of older ones
//! below IIO.

use std::path::{Path, PathBuf};

use super::file::{entries, word};
use super::limits;
use super::metrics::{POWER, TEMPERATURE};
use super::sample::Label;
use super::sensors::{Sensor, sleeps};

/// Channels of an INA3221: each is a rail with a voltage and a current.
const INA3221_CHANNELS: usize = 3;

struct Chip {
    /// Name, with the device where it is there twice.
    name: String,
    ina3221: bool,
    path: PathBuf,
}

/// The values of all chips.
pub(super) fn chips(sys: &Path) -> Vec<Sensor> {
    let mut sensors = iio(sys);
    for chip in named(sys) {
        sensors.extend(if chip.ina3221 { rails(&chip) } else { values(&chip) });
    }
    sensors.truncate(limits::HWMON_VALUES);
    sensors
}

fn named(sys: &Path) -> Vec<Chip> {
    let found: Vec<_> = entries(&sys.join("class/hwmon"), |name| name.starts_with("hwmon"))
        .into_iter()
        .filter_map(|(entry, path)| Some((word(&path.join("name"))?, device(&path), entry, path)))
        // the kernel mirrors thermal zones, and a sleeping GPU shall sleep on
        .filter(|(_, device, _, path)| {
            !device.starts_with("thermal_zone") && !sleeps(&path.join("device"))
        })
        .collect();
    let twice = |name: &str| found.iter().filter(|other| other.0 == name).count() > 1;
    let chip = |(name, device, entry, path): &(String, String, String, PathBuf)| Chip {
        name: match (twice(name), device.is_empty()) {
            (false, _) => name.clone(),
            (true, false) => format!("{name}@{device}"),
            (true, true) => format!("{name}@{entry}"),
        },
        ina3221: name == "ina3221",
        path: path.clone(),
    };
    found.iter().map(chip).collect()
}

/// Name of the device that a chip belongs to, such as `nvme0` or `0000:03:00.0`.
fn device(chip: &Path) -> String {
    let target = std::fs::read_link(chip.join("device"));
    let name = target.ok().and_then(|target| Some(target.file_name()?.to_str()?.to_owned()));
    name.unwrap_or_default()
}

/// Temperatures and powers of a chip.
fn values(chip: &Chip) -> Vec<Sensor> {
    let mut sensors = Vec::new();
    let mut labels: Vec<String> = Vec::new();
    for (file, path) in entries(&chip.path, |name| {
        let power = name.strip_suffix("_average").or_else(|| name.strip_suffix("_input"));
        let temperature = name.starts_with("temp") && name.ends_with("_input");
        temperature || (name.starts_with("power") && power.is_some())
    }) {
        let Some((channel, _)) = file.split_once('_') else { continue };
        let read = |item: &str| word(&chip.path.join(format!("{channel}_{item}")));
        let duplicate =
            file.ends_with("_input") && chip.path.join(format!("{channel}_average")).exists();
        if read("fault").as_deref() == Some("1") || (channel.starts_with('p') && duplicate) {
            continue;
        }
        let mut label = format!("{}/{}", chip.name, read("label").unwrap_or(channel.to_owned()));
        if labels.contains(&label) {
            label = format!("{}/{channel}", chip.name);
        }
        let name = Label::new(&label);
        labels.push(label);
        sensors.push(if channel.starts_with('t') {
            Sensor::new(&TEMPERATURE, name, path, 1e3)
        } else {
            Sensor::new(&POWER, name, path, 1e6)
        });
    }
    sensors
}

/// The rails of an INA3221: millivolts times milliamperes. A channel without a label is not wired.
fn rails(chip: &Chip) -> Vec<Sensor> {
    let rail = |channel| {
        let file = |kind: &str, item| chip.path.join(format!("{kind}{channel}_{item}"));
        let label = word(&file("in", "label")).filter(|label| label != "NC")?;
        let (volt, current) = (file("in", "input"), file("curr", "input"));
        Some(Sensor::new(&POWER, Label::new(&label), volt, 1e6).times(current))
    };
    (1..=INA3221_CHANNELS).filter_map(rail).collect()
}

/// The rails of an INA3221 below IIO, with milliwatts: Jetson Linux up to release 32.
fn iio(sys: &Path) -> Vec<Sensor> {
    let devices = entries(&sys.join("bus/iio/devices"), |name| name.starts_with("iio:device"));
    let mut sensors = Vec::new();
    for (_, path) in devices {
        if word(&path.join("name")).as_deref() != Some("ina3221x") {
            continue;
        }
        for channel in 0..INA3221_CHANNELS {
            let Some(rail) = word(&path.join(format!("rail_name_{channel}"))) else { continue };
            let file = path.join(format!("in_power{channel}_input"));
            sensors.push(Sensor::new(&POWER, Label::new(&rail), file, 1e3));
        }
    }
    sensors
}
