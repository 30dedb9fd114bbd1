//! Values of the node: what the kernel and the hardware say of it.
//!
//! ```text
//! /proc, /sys, NVML, adjtimex ─► collectors, a thread each ─► Sampler::sample
//!                                                                  │ the newest of each
//!          series (/metrics), NodeStatus (/v1/node), Vitals (health) ◄─ Sample
//! ```
//!
//! Each value is probed by itself and checked for sense. What the machine lacks has no series; a
//! source that is there and cannot be read is a collector that is not up, with the remedy. The
//! collectors share nothing, so one that hangs in a file or a driver holds up no other.
//!
//! Left out on purpose, because it is no value of this node or counts something twice:
//!
//! - mounts: pseudo and network file systems, read-only images (squashfs, ISO 9660), loop devices,
//!   further mounts of the same device;
//! - disks: partitions, loop, RAM, zram, optical, device mapper and RAID devices;
//! - interfaces: one end of a container's or a virtual machine's pair, bridges of container
//!   engines, tunnels that the kernel makes by itself (`NO_INTERFACES` of `procfs`). `lo`, VLANs,
//!   bonds and VPNs stay;
//! - sensors: hwmon copies of a thermal zone, zones with a constant, batteries of mice and
//!   keyboards.

mod cgroup;
mod clock;
mod disk;
mod file;
mod gpu;
mod hwmon;
pub mod limits;
mod metrics;
mod nvml;
mod power;
mod procfs;
mod sample;
mod sampler;
mod sensors;
mod status;
#[cfg(test)]
mod tests;

pub use metrics::METRICS;
pub use sample::{Label, Sample};
pub use sampler::{Roots, Sampler};
pub use status::{
    ClockStatus, CollectorStatus, DiskStatus, GpuStatus, MemoryStatus, NetworkStatus, NodeStatus,
    PowerStatus, TemperatureStatus, Vitals,
};
