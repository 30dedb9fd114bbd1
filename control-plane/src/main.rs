//! The BlazeConfig main service: parse, build, run.

use std::path::PathBuf;
use std::process::ExitCode;

use blaze_config::process::{Command, NAME, Setup, run};
use blaze_domain::node_file::NodeFile;
use blaze_runtime::config::{Sources, load_or_say, parse_override, schema};
use blaze_runtime::logs::{self, LogFormat};
use blaze_runtime::supervisor::{block_on, exit_code, failed};
use blaze_runtime::{forbid_core_dumps, say};
use clap::{Parser, Subcommand};

/// A commit makes and drops thousands of small texts and map nodes on other threads than it began
/// on: with the allocator of glibc that took more than a third of its time.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// BlazeConfig: the configuration of layers, nodes, services and instances, over REST and gRPC.
#[derive(Parser)]
#[command(name = "blaze-config", version)]
struct Arguments {
    /// The node file; else BLAZE_CONFIG, ./blaze.yaml, /etc/blaze/blaze.yaml (the last two not with
    /// --dev).
    #[arg(long, value_name = "FILE", global = true)]
    config: Option<PathBuf>,
    /// Only check the configuration, with the key and certificate files that it names: every fault
    /// on stderr, exit code 0 or 64. The store is not looked at.
    #[arg(long)]
    check: bool,
    /// text or json; else as the node file says.
    #[arg(long, value_name = "FORMAT", value_parser = ["text", "json"], global = true)]
    log_format: Option<String>,
    /// Overrides one key, as control_plane.rest.listen=127.0.0.1:0; may be repeated.
    #[arg(long, value_name = "KEY=VALUE", value_parser = parse_override, global = true)]
    set: Vec<(String, String)>,
    /// For trying things out: loopback alone, no token needed, in memory unless a store is named,
    /// no node file needed.
    #[arg(long)]
    dev: bool,
    /// What to do; serve if nothing is said.
    #[command(subcommand)]
    command: Option<Task>,
}

/// What to do.
#[derive(Subcommand)]
enum Task {
    /// Serve REST and gRPC (default).
    Serve,
    /// Bring the store to the schema of this program.
    Migrate {
        /// Only say what would be done.
        #[arg(long)]
        dry_run: bool,
    },
    /// Write everything that is true at one revision to a file; the service may go on meanwhile.
    Backup {
        /// The file; it must not exist.
        file: PathBuf,
    },
    /// Fill an empty store from a backup; every client lists again.
    Restore {
        /// The file.
        file: PathBuf,
    },
    /// Encrypt all secrets with the first key, also those of the history.
    Reencrypt,
}

fn main() -> ExitCode {
    let mut arguments = Arguments::parse();
    if let Err(error) = forbid_core_dumps() {
        say(format_args!("warning: a core dump could hold secrets: {error}"));
    }
    let mut overrides = std::mem::take(&mut arguments.set);
    if let Some(format) = &arguments.log_format {
        overrides.push(("log.format".to_owned(), format.clone()));
    }
    let names_store = overrides.iter().any(|(key, _)| key.starts_with("control_plane.store"));
    let mut sources = Sources::of_process(arguments.config, overrides);
    if arguments.dev {
        // Whatever lies in this folder must not be served without tokens by accident.
        sources.search.clear();
        sources.file_may_be_absent = true;
    }
    let loaded = match load_or_say(&sources, &schema(NodeFile::read), None) {
        Ok(loaded) => loaded,
        Err(code) => return code,
    };
    let file = loaded.value;
    let named = loaded.document.value().pointer("/control_plane/store").is_some();
    let setup = Setup {
        section: file.control_plane.clone(),
        dev: arguments.dev,
        in_memory: arguments.dev && !named && !names_store,
    };
    let checked = if arguments.check { setup.check_all() } else { setup.check() };
    if let Err(faults) = checked {
        for fault in faults {
            let (path, detail) = fault.split_once(": ").unwrap_or(("", &fault));
            say(format_args!("{}", loaded.document.fault(path, detail)));
        }
        return ExitCode::from(exit_code::CONFIGURATION);
    }
    if arguments.check {
        return ExitCode::SUCCESS;
    }
    let format = if file.log.format.as_str() == "json" { LogFormat::Json } else { LogFormat::Text };
    if let Err(error) = logs::init(file.log.level.as_str(), format) {
        return failed(NAME, error);
    }
    let command = match arguments.command {
        None | Some(Task::Serve) => Command::Serve,
        Some(Task::Migrate { dry_run }) => Command::Migrate { dry_run },
        Some(Task::Backup { file }) => Command::Backup(file),
        Some(Task::Restore { file }) => Command::Restore(file),
        Some(Task::Reencrypt) => Command::Reencrypt,
    };
    block_on(NAME, run(setup, command))
}
