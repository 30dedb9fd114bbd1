//! `blaze node`: what brings a node into the system.
//!
//! ```text
//! options ─► node file (checked as the programs of the node check it)
//!        └─► Layer there? ─► Node made or brought up to date ─► token, if there is none ─► node file printed
//! ```

mod join;
pub(crate) mod options;
mod plan;
mod token_file;

use clap::Subcommand;

pub use options::JoinOptions;

use crate::exit::{CliError, Exit};
use crate::output::Format;

/// Commands of `blaze node`.
#[derive(Debug, Subcommand)]
pub enum NodeCommand {
    /// Make the document of a node and the token of its worker, and print the node file for its
    /// programs
    Join(Box<JoinOptions>),
}

/// Runs one of them.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(command: &NodeCommand, format: Format) -> Result<Exit, CliError> {
    match command {
        NodeCommand::Join(options) => join::run(options, format).await,
    }
}
