//! `blaze demo`: robot, fog and cloud in one process, with recorded data.
//!
//! ```text
//! recording ─► player ─► publishers on robot-1 ─► flows ─► consumers ─► board ─► report, verdict
//!                                                   └─► admin ports ─► routes and drops ─► board
//! ```

pub mod board;
pub mod camera;
pub mod domain_id;
pub mod flows;
pub mod options;
pub mod player;
pub mod recording;
pub mod report;
pub mod roles;
pub mod schedule;
pub mod session;
pub mod stats;
pub mod verdict;

use crate::exit::{CliError, Exit};
use crate::output::Format;

/// Runs the demo.
///
/// # Errors
/// See [`CliError`].
pub async fn run(options: options::DemoOptions, format: Format) -> Result<Exit, CliError> {
    options.check()?;
    report::Style::choose(format)?;
    Err(CliError::Failed("the demo is not part of this build".to_owned()))
}
