//! Benchmarks of the product, each beside a peer or a plain client in the same run.
//!
//! `cargo build --release --workspace --bins && target/release/blaze-bench flow|link|config|worker`

mod config;
mod flow;
mod link;
mod worker;

use std::process::ExitCode;

use clap::Parser;

#[derive(Parser)]
#[command(name = "blaze-bench", version)]
enum Bench {
    Flow(flow::Arguments),
    Link(link::Arguments),
    Config(config::Arguments),
    Worker(worker::Arguments),
}

fn main() -> anyhow::Result<ExitCode> {
    match Bench::parse() {
        Bench::Flow(arguments) => flow::run(arguments).map(|()| ExitCode::SUCCESS),
        Bench::Link(arguments) => link::run(&arguments).map(|()| ExitCode::SUCCESS),
        Bench::Config(arguments) => config::run(&arguments),
        Bench::Worker(arguments) => worker::run(&arguments),
    }
}
