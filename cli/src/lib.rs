//! The command line of BlazeAIoT.
//!
//! ```text
//! args ──► admin: topics, bridges, peers, top, why ──► http ──► admin port of a flow ──► output
//!      ├─► monitor: ping, latency, problems ──► http ──► admin port of a monitor ──► output
//!      ├─► plan: plan file ──► allocator of the data plane ──► output
//!      ├─► config: get, apply, watch, … ──► REST of the main service of BlazeConfig ──► output
//!      ├─► local: pub, echo, hz, call ──► local broker of the node file
//!      ├─► doctor: node file, programs, brokers, network, machine ──► checks ──► output
//!      ├─► demo: recordings ──► player ──► flows and services of one process ──► board ──► report
//!      └─► dev: main service, worker and flow of one node in one process
//! ```

pub mod admin;
pub mod args;
pub mod config;
pub mod demo;
pub mod dev;
pub mod doctor;
mod embedded;
mod ends;
pub mod exit;
pub mod http;
pub mod local;
pub mod monitor;
mod node_file;
pub mod output;
pub mod plan;

use std::process::ExitCode;

use clap::CommandFactory as _;

pub use args::Arguments;
use args::Command;
use exit::{CliError, Exit};
use output::Output;

/// Runs one command and returns what the process exits with. A failure is told on stderr: in one
/// sentence, with what to do below it, or, with `-o json` in a command of the configuration, as a
/// problem object on one line.
#[must_use]
pub fn run(arguments: Arguments) -> ExitCode {
    let as_problem =
        arguments.output == Output::Json && matches!(arguments.command, Command::Config(_));
    let outcome = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|error| {
            CliError::Failed(format!("the asynchronous runtime does not start: {error}"))
        })
        .and_then(|runtime| runtime.block_on(dispatch(arguments)));
    match outcome {
        Ok(exit) => exit.into(),
        Err(CliError::OutputClosed) => Exit::Done.into(),
        Err(error) => {
            if as_problem {
                eprintln!("{}", error.to_json());
            } else {
                eprintln!("blaze: {error}");
            }
            error.exit().into()
        }
    }
}

async fn dispatch(arguments: Arguments) -> Result<Exit, CliError> {
    let output = arguments.output;
    let format = output.format();
    match arguments.command {
        Command::Topics(target) => admin::topics(&target.flow, format?).await,
        Command::Ros2(target) => admin::ros2(&target.flow, format?).await,
        Command::Bridges(target) => admin::bridges(&target.flow, format?).await,
        Command::Peers(target) => admin::peers(&target.flow, format?).await,
        Command::Top(options) => admin::top(&options, format?).await,
        Command::Why(why) => admin::why(&why, format?).await,
        Command::Ping(options) => monitor::ping(&options, format?).await,
        Command::Latency(options) => monitor::latency(&options, format?).await,
        Command::Problems(options) => monitor::problems(&options, format?).await,
        Command::Plan(options) => plan::run(&options, format?),
        Command::Doctor(options) => doctor::run(options, format?).await,
        Command::Pub(options) => local::publish(options, format?).await,
        Command::Echo(options) => local::echo(options, format?).await,
        Command::Hz(options) => local::hz(options, format?).await,
        Command::Call(options) => local::call(options, format?).await,
        Command::Demo(options) => demo::run(options, format?).await,
        Command::Dev(options) => dev::run(*options, format?).await,
        Command::Config(command) => config::run(*command, output).await,
        Command::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Arguments::command(), "blaze", &mut script);
            output::print(&String::from_utf8_lossy(&script))?;
            Ok(Exit::Done)
        }
    }
}
