//! The commands of the configuration: what `blaze` does with the main service of BlazeConfig.
//!
//! ```text
//! options ─┐
//! environment ─┼─► endpoint (server, token, authority) ─► client ─► api: pages, documents, apply ─► command ─► output
//! contexts ─┘                                            └─► sse ─► stream: reconnects, lists again ─► watch
//! files (YAML, JSON) ─► documents with FILE:LINE ─► apply, diff -f, delete -f, rollout start
//! ```
//!
//! Data goes to standard output, everything else to stderr. A read is tried again once when a
//! connection breaks; a write never is, because nobody knows whether it took effect.

mod api;
mod apply;
mod ask;
mod call;
mod cascade;
pub(crate) mod client;
mod context_command;
mod contexts;
mod delete;
mod describe;
mod diff;
mod edit;
mod effective;
mod endpoint;
mod export;
pub(crate) mod files;
mod fleet;
mod get;
mod history;
mod kinds;
mod monitoring;
pub(crate) mod node;
mod options;
mod patch;
mod refusal;
mod rollout;
pub(crate) mod seed;
mod sse;
mod stream;
#[cfg(test)]
pub(crate) mod stub;
mod tables;
pub(crate) mod text;
mod tls;
mod token;
mod token_local;
mod topology;
mod trim;
mod watch;
mod yaml;

use clap::Subcommand;

pub use apply::ApplyOptions;
pub use context_command::ContextCommand;
pub use delete::DeleteOptions;
pub use describe::DescribeOptions;
pub use diff::DiffOptions;
pub use edit::EditOptions;
pub use effective::EffectiveOptions;
pub use export::ExportOptions;
pub use fleet::AuditOptions;
pub use get::GetOptions;
pub use history::{HistoryOptions, RevertOptions, RollbackOptions};
pub use kinds::Target;
pub use node::{JoinOptions, NodeCommand};
pub use options::{DocumentOptions, ServerOptions};
pub use patch::PatchOptions;
pub use refusal::Refusal;
pub use rollout::RolloutCommand;
pub use token::TokenCommand;
pub use topology::DigestOptions;
pub use trim::TrimOptions;
pub use watch::WatchOptions;

pub(crate) use text::parse_duration;

use crate::exit::{CliError, Exit};
use crate::output::Output;

/// Commands of the configuration. KIND is layer, node, service, instance or rollout (ly no svc inst
/// ro); an instance is called SERVICE/NAME.
#[derive(Debug, Subcommand)]
pub enum ConfigCommand {
    /// Documents of the configuration: one by its name, or all of a kind
    Get(GetOptions),
    /// A document with its effective configuration, who has it, and its last changes
    Describe(DescribeOptions),
    /// Create, replace and delete documents from files, all or nothing
    Apply(ApplyOptions),
    /// What `apply` would change, or what changed between two revisions; exits with 1 if anything
    /// differs
    Diff(DiffOptions),
    /// Change a part of a document
    Patch(PatchOptions),
    /// Change a document in your editor ($VISUAL, else $EDITOR, else vi)
    Edit(EditOptions),
    /// Delete a document, or those of files
    Delete(DeleteOptions),
    /// Changes of a document, newest first
    History(HistoryOptions),
    /// Give a document the content that it had at a revision
    Rollback(RollbackOptions),
    /// Undo one revision as a whole
    Revert(RevertOptions),
    /// The configuration that a service gets, or a node, or a layer
    Effective(EffectiveOptions),
    /// Changes as they happen
    Watch(WatchOptions),
    /// Try a change on some nodes first
    #[command(subcommand)]
    Rollout(RolloutCommand),
    /// All documents as YAML that `apply` takes, or with -o json as an array
    Export(ExportOptions),
    /// Layers, their nodes, and what runs there
    Topology(ServerOptions),
    /// A digest of what the worker of a layer should hold
    Digest(DigestOptions),
    /// Workers of all layers, and which revision they have
    Workers(ServerOptions),
    /// Who changed what, and who was refused
    Audit(AuditOptions),
    /// Remove old history
    Trim(TrimOptions),
    /// Tokens: create, list, revoke, look into
    #[command(subcommand)]
    Token(TokenCommand),
    /// Nodes: bring one into the system
    #[command(subcommand)]
    Node(NodeCommand),
    /// Servers that you work with
    #[command(subcommand)]
    Context(ContextCommand),
}

/// Runs one of them.
///
/// # Errors
/// [`CliError`]: nobody answers, the server refuses, bad files, bad usage.
pub async fn run(command: ConfigCommand, output: Output) -> Result<Exit, CliError> {
    match command {
        ConfigCommand::Get(options) => get::run(&options, output).await,
        ConfigCommand::Describe(options) => describe::run(&options, output.format()?).await,
        ConfigCommand::Apply(options) => apply::run(&options, output.format()?).await,
        ConfigCommand::Diff(options) => diff::run(&options, output.format()?).await,
        ConfigCommand::Patch(options) => patch::run(&options, output.format()?).await,
        ConfigCommand::Edit(options) => edit::run(&options, output.format()?).await,
        ConfigCommand::Delete(options) => delete::run(&options, output.format()?).await,
        ConfigCommand::History(options) => history::run(&options, output.format()?).await,
        ConfigCommand::Rollback(options) => history::rollback(&options, output.format()?).await,
        ConfigCommand::Revert(options) => history::revert(&options, output.format()?).await,
        ConfigCommand::Effective(options) => effective::run(&options, output.format()?).await,
        ConfigCommand::Watch(options) => watch::run(&options, output.format()?).await,
        ConfigCommand::Rollout(command) => rollout::run(&command, output.format()?).await,
        ConfigCommand::Export(options) => export::run(&options, output.format()?).await,
        ConfigCommand::Topology(server) => topology::run(&server, output.format()?).await,
        ConfigCommand::Digest(options) => topology::digest(&options, output.format()?).await,
        ConfigCommand::Workers(server) => fleet::workers(&server, output.format()?).await,
        ConfigCommand::Audit(options) => fleet::audit(&options, output.format()?).await,
        ConfigCommand::Trim(options) => trim::run(&options, output.format()?).await,
        ConfigCommand::Token(command) => token::run(&command, output.format()?).await,
        ConfigCommand::Node(command) => node::run(&command, output.format()?).await,
        ConfigCommand::Context(command) => context_command::run(&command, output.format()?),
    }
}

#[cfg(test)]
mod arguments_tests;
