//! GPUs that sysfs knows: those of Jetson boards, and of AMD.

use std::path::{Path, PathBuf};

use super::file::{entries, word};
use super::limits;
use super::metrics::{GPU_MEMORY, GPU_UTILIZATION};
use super::sample::{Batch, Label};
use super::sampler::{Collector, Roots};
use super::sensors::{Sensor, read_all, sleeps};

/// Folders below `devices/` that hold a Jetson's GPU, from the oldest release to the newest.
const JETSON_FOLDERS: [&str; 3] = ["", "platform", "platform/bus@0"];

/// Ends of the names of a Jetson's GPU: by release, or by the chip.
const JETSON_NAMES: [&str; 4] = [".gpu", ".ga10b", ".gv11b", ".gp10b"];

/// Identity of AMD on PCI.
const AMD: &str = "0x1002";

struct Card {
    label: Label,
    name: Option<Label>,
    device: PathBuf,
    sensors: Vec<Sensor>,
}

/// Collector `gpu`.
pub(super) struct Gpus {
    sys: PathBuf,
    cards: Vec<Card>,
    buffer: Vec<u8>,
}

impl Gpus {
    pub(super) fn new(roots: &Roots) -> Self {
        Self { sys: roots.sys.clone(), cards: Vec::new(), buffer: Vec::new() }
    }
}

impl Collector for Gpus {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn discover(&mut self) {
        self.cards = jetson(&self.sys).into_iter().chain(amd(&self.sys)).collect();
    }

    fn collect(&mut self, batch: &mut Batch) {
        batch.found |= !self.cards.is_empty();
        for card in &mut self.cards {
            if let Some(name) = &card.name {
                batch.names.push((card.label.clone(), name.clone()));
            }
            if !sleeps(&card.device) {
                read_all(&mut card.sensors, &mut self.buffer, batch);
            }
        }
    }
}

/// The GPU of a Jetson: `load` in per mille. It has no memory of its own.
fn jetson(sys: &Path) -> Option<Card> {
    let devices = sys.join("devices");
    let named = |name: &str| name == "gpu.0" || JETSON_NAMES.iter().any(|end| name.ends_with(end));
    let device = JETSON_FOLDERS.iter().find_map(|folder| {
        let mut found = entries(&devices.join(folder), named).into_iter();
        found.find(|(_, path)| path.join("load").exists())
    });
    let (_, device) = device?;
    let label = Label::Fixed("gpu0");
    let load = Sensor::new(&GPU_UTILIZATION, label.clone(), device.join("load"), 1000.0);
    let name = Some(Label::Fixed("NVIDIA Jetson"));
    Some(Card { label, name, device, sensors: vec![load] })
}

/// The cards of AMD, named as below `/dev/dri`.
fn amd(sys: &Path) -> Vec<Card> {
    let cards = entries(&sys.join("class/drm"), |name| {
        let number = name.strip_prefix("card").unwrap_or_default();
        !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit())
    });
    let is_amd = |path: &Path| word(&path.join("device/vendor")).as_deref() == Some(AMD);
    let amd = cards.into_iter().filter(|(_, path)| is_amd(path)).take(limits::GPUS);
    amd.map(|(card, path)| amd_card(&card, path.join("device"))).collect()
}

fn amd_card(card: &str, device: PathBuf) -> Card {
    let label = Label::new(card);
    let product = word(&device.join("product_name"));
    let number = || word(&device.join("device")).map(|number| format!("AMD {number}"));
    let name = product.or_else(number).map(|name| Label::new(&name));
    let memory =
        |kind, file| Sensor::new(&GPU_MEMORY, label.clone(), device.join(file), 1.0).kind(kind);
    let busy = device.join("gpu_busy_percent");
    let sensors = vec![
        Sensor::new(&GPU_UTILIZATION, label.clone(), busy, 100.0),
        memory("total", "mem_info_vram_total"),
        memory("used", "mem_info_vram_used"),
    ];
    Card { label, name, device, sensors }
}
