//! What tests need as processes of their own: a link emulator, services, peers.

mod tools;

use std::process::ExitCode;

use clap::Parser;
use tools::{dds_peer, link_peer, probe, service, wan};

#[derive(Parser)]
#[command(name = "blaze-testbed", version)]
enum Tool {
    Wan(wan::Options),
    Probe(probe::Options),
    Service(service::Options),
    DdsPeer(dds_peer::Options),
    /// One end of a DDS link transport
    LinkPeer(link_peer::Arguments),
}

fn main() -> ExitCode {
    let ended = match Tool::parse() {
        Tool::Wan(options) => wan::run(options),
        Tool::Probe(options) => probe::run(&options),
        Tool::Service(options) => service::run(&options),
        Tool::DdsPeer(options) => dds_peer::run(&options),
        Tool::LinkPeer(arguments) => link_peer::run(&arguments),
    };
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            blaze_runtime::say(format_args!("blaze-testbed failed: {error:#}"));
            ExitCode::FAILURE
        }
    }
}
