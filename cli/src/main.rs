//! The program `blaze`.

use std::process::ExitCode;

use blaze_cli::Arguments;
use clap::Parser as _;

fn main() -> ExitCode {
    blaze_cli::run(Arguments::parse())
}
