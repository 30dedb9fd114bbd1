//! GPUs of NVIDIA through the driver's library, which is loaded where it is there.
//!
//! On Jetson the library starts and answers `NotSupported` to everything: then there is no value,
//! and the GPU is the one of sysfs.

use nvml_wrapper::enum_wrappers::device::TemperatureSensor;
use nvml_wrapper::error::NvmlError;
use nvml_wrapper::{Device, Nvml};

use super::file::Fault;
use super::limits;
use super::metrics::{ENERGY, GPU_MEMORY, GPU_UTILIZATION, POWER, TEMPERATURE};
use super::sample::{Batch, Label};
use super::sampler::Collector;
use super::sensors::sense;
use crate::metric::Metric;

/// The name that the driver installs; the one without number comes with development packages.
const LIBRARY: &str = "libnvidia-ml.so.1";

/// Collector `nvml`.
#[derive(Default)]
pub(super) struct Nvidia {
    library: Option<Nvml>,
    fault: Option<String>,
    labels: Vec<Label>,
}

impl Collector for Nvidia {
    fn name(&self) -> &'static str {
        "nvml"
    }

    fn discover(&mut self) {
        if self.library.is_some() {
            return;
        }
        (self.library, self.fault) = match Nvml::builder().lib_path(LIBRARY.as_ref()).init() {
            Ok(library) => (Some(library), None),
            Err(error) => (None, start_fault(&error)),
        };
    }

    fn collect(&mut self, batch: &mut Batch) {
        if let Some(fault) = &self.fault {
            batch.take::<()>(Err(Fault::Answer(fault.clone())));
        }
        let Some(library) = &self.library else { return };
        let count = library.device_count().unwrap_or(0).min(limits::GPUS as u32);
        let mut lost = false;
        for index in 0..count {
            let number = index as usize;
            if self.labels.len() <= number {
                self.labels.push(Label::new(&format!("nvidia{number}")));
            }
            match library.device_by_index(index) {
                Ok(device) => lost |= add(&self.labels[number], &answers(&device), batch),
                Err(error) => lost |= is_lost(&error),
            }
        }
        if lost {
            let text = "a GPU does not answer any more. Look at dmesg for Xid; it needs a reset";
            batch.take::<()>(Err(Fault::Answer(text.to_owned())));
        }
    }
}

/// Why the library cannot start where a driver is there; `None` where there is none.
fn start_fault(error: &NvmlError) -> Option<String> {
    match error {
        NvmlError::NoPermission => Some(
            "NVML refuses to start: no permission. Give the monitor access to /dev/nvidia*".into(),
        ),
        NvmlError::LibRmVersionMismatch => Some(
            "NVML refuses to start: library and kernel module have different versions. Restart the \
             machine after the update of the driver"
                .into(),
        ),
        _ => None,
    }
}

fn is_lost(error: &NvmlError) -> bool {
    matches!(error, NvmlError::GpuLost | NvmlError::ResetRequired)
}

/// What a GPU answers.
struct Answers {
    name: Result<String, NvmlError>,
    /// Percent.
    utilization: Result<u32, NvmlError>,
    /// Bytes: total, used.
    memory: Result<(u64, u64), NvmlError>,
    celsius: Result<u32, NvmlError>,
    milliwatts: Result<u32, NvmlError>,
    millijoules: Result<u64, NvmlError>,
}

fn answers(device: &Device<'_>) -> Answers {
    Answers {
        name: device.name(),
        utilization: device.utilization_rates().map(|rates| rates.gpu),
        memory: device.memory_info().map(|memory| (memory.total, memory.used)),
        celsius: device.temperature(TemperatureSensor::Gpu),
        milliwatts: device.power_usage(),
        millijoules: device.total_energy_consumption(),
    }
}

/// Adds what has a value; whether the GPU is lost.
fn add(label: &Label, answers: &Answers, batch: &mut Batch) -> bool {
    let before = batch.series.len();
    let mut lost = false;
    let mut value = |metric: &'static Metric, answer: Result<f64, &NvmlError>| match answer {
        Ok(value) if sense(metric, value) => batch.one(metric, label.clone(), value),
        Ok(_) => {}
        Err(error) => lost |= is_lost(error),
    };
    value(&GPU_UTILIZATION, answers.utilization.as_ref().map(|v| f64::from(*v) / 100.0));
    value(&TEMPERATURE, answers.celsius.as_ref().map(|v| f64::from(*v)));
    value(&POWER, answers.milliwatts.as_ref().map(|v| f64::from(*v) / 1e3));
    value(&ENERGY, answers.millijoules.as_ref().map(|v| *v as f64 / 1e3));
    if let Ok((total, used)) = &answers.memory
        && *total > 0
        && used <= total
    {
        batch.two(&GPU_MEMORY, label.clone(), "total", *total as f64);
        batch.two(&GPU_MEMORY, label.clone(), "used", *used as f64);
    }
    if let Ok(name) = &answers.name
        && batch.series.len() > before
    {
        let name: String = name.chars().take(limits::NAME_CHARS).collect();
        batch.names.push((label.clone(), Label::new(&name)));
    }
    lost
}

#[cfg(test)]
mod quick {
    use super::*;

    fn all<T>(error: fn() -> NvmlError) -> Result<T, NvmlError> {
        Err(error())
    }

    fn without(error: fn() -> NvmlError) -> Answers {
        Answers {
            name: Ok("Orin (nvgpu)".into()),
            utilization: all(error),
            memory: all(error),
            celsius: all(error),
            milliwatts: all(error),
            millijoules: all(error),
        }
    }

    fn text(batch: &Batch) -> Vec<String> {
        let line = |series: &super::super::sample::Series| {
            let labels: Vec<_> = series.labels().iter().map(Label::as_str).collect();
            format!("{} {} {}", series.metric.name, labels.join(","), series.value)
        };
        batch.series.iter().map(line).collect()
    }

    #[test]
    fn not_supported_is_no_value_and_no_gpu() {
        let mut batch = Batch::default();
        assert!(!add(&Label::Fixed("nvidia0"), &without(|| NvmlError::NotSupported), &mut batch));
        assert_eq!(text(&batch), Vec::<String>::new());
        assert!(batch.names.is_empty());
        assert!(add(&Label::Fixed("nvidia0"), &without(|| NvmlError::GpuLost), &mut batch));
    }

    #[test]
    fn each_value_is_probed_by_itself() {
        let answers = Answers {
            utilization: Ok(37),
            memory: Ok((25_757_220_864, 1_073_741_824)),
            // of a board that has no sensor
            celsius: Ok(4_294_967_040),
            milliwatts: Ok(61_250),
            ..without(|| NvmlError::NotSupported)
        };
        let mut batch = Batch::default();
        add(&Label::Fixed("nvidia0"), &answers, &mut batch);
        let expected = [
            "blaze_node_gpu_utilization_ratio nvidia0 0.37",
            "blaze_node_power_watts nvidia0 61.25",
            "blaze_node_gpu_memory_bytes nvidia0,total 25757220864",
            "blaze_node_gpu_memory_bytes nvidia0,used 1073741824",
        ];
        assert_eq!(text(&batch), expected);
        assert_eq!(batch.names.len(), 1);
    }
}
