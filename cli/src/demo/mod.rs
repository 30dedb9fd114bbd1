//! `blaze demo`.
pub mod camera;
pub mod options;
pub mod player;
pub mod recording;
pub mod schedule;
pub mod stats;

use crate::exit::{CliError, Exit};
use crate::output::Format;

/// Runs the demo.
///
/// # Errors
/// See [`CliError`].
pub async fn run(_options: options::DemoOptions, _format: Format) -> Result<Exit, CliError> {
    Err(CliError::Usage("the demo is not part of this build".to_owned()))
}
