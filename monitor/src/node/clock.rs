//! State of the kernel's clock, as the program that disciplines it (chrony, ntpd, ptp4l) left it.

use std::io;
use std::sync::Arc;

use rtime_clock::adjtime::{Timex, adjtimex};

use super::file::Fault;
use super::metrics::{CLOCK_ERROR, CLOCK_SYNCHRONIZED};
use super::sample::Batch;
use super::sampler::Collector;

/// `TIME_ERROR` of adjtimex(2): the clock is not synchronised.
const TIME_ERROR: i32 = 5;

/// `STA_UNSYNC` of adjtimex(2).
const UNSYNC: i32 = 0x40;

/// What the kernel says.
#[derive(Clone, Copy, Debug)]
pub(super) struct ClockState {
    pub(super) synchronized: bool,
    /// Maximum error in seconds.
    pub(super) error_s: f64,
}

/// Asks for the state.
pub(super) type Probe = Arc<dyn Fn() -> io::Result<ClockState> + Send + Sync>;

/// The kernel's answer. The zeroed request changes nothing and needs no right.
pub(super) fn probe() -> Probe {
    Arc::new(|| {
        let mut timex = Timex::new();
        let state = adjtimex(&mut timex)?;
        Ok(ClockState {
            synchronized: state != TIME_ERROR && timex.0.status & UNSYNC == 0,
            error_s: timex.0.maxerror as f64 / 1e6,
        })
    })
}

/// Collector `clock`.
pub(super) struct Clock(pub(super) Probe);

impl Collector for Clock {
    fn name(&self) -> &'static str {
        "clock"
    }

    fn collect(&mut self, batch: &mut Batch) {
        let state = (self.0)().map(Some).map_err(|error| {
            Fault::Answer(format!(
                "adjtimex, which reads the state of the clock, fails: {error}. In a container the \
                 seccomp profile must allow it"
            ))
        });
        let Some(state) = batch.take(state) else { return };
        batch.plain(&CLOCK_SYNCHRONIZED, f64::from(u8::from(state.synchronized)));
        if state.error_s >= 0.0 {
            batch.plain(&CLOCK_ERROR, state.error_s);
        }
    }
}
