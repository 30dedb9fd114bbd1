//! DDS as a broker: the rules for all adapters, and what is special to a network without a server.

mod alone;
mod crowd;
mod gone;
mod plain;
mod support;
mod worker;

/// The rules for all adapters, each in a domain of its own.
mod conformance {
    use super::support::Domain;

    blaze_conformance::broker_conformance_tests!(async { Domain::start() });
}
