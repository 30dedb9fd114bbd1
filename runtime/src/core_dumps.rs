//! What a process that holds secrets leaves behind when it crashes: nothing.

use std::io;

use rustix::process::{DumpableBehavior, set_dumpable_behavior};

use crate::environment;

/// Set to anything, it leaves core dumps as the system makes them, for those who look for a fault.
const VARIABLE: &str = "BLAZE_CORE_DUMPS";

/// From now on the system writes no core dump of this process, and only root can look into its
/// memory.
///
/// # Errors
/// When the system refuses. It does not for any known reason.
pub fn forbid_core_dumps() -> io::Result<()> {
    if environment::variable(VARIABLE).is_some() {
        return Ok(());
    }
    Ok(set_dumpable_behavior(DumpableBehavior::NotDumpable)?)
}
