//! What every adapter of the broker port must do, as tests that each adapter runs.
//!
//! ```text
//! Fixture (one per adapter: clients, server away and back) ──► rules ──► Ok, or what is wrong
//! ```
//!
//! An adapter writes a [`Fixture`] and one line,
//! [`broker_conformance_tests!`](crate::broker_conformance_tests), which makes a test of each rule;
//! or it calls [`run_all`] where starting a server for every rule takes too long. All waits are on
//! conditions with a deadline, never on time alone.

mod closing;
mod delivery;
mod outage;
mod subscriptions;
mod tools;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use blaze_domain::MAX_PAYLOAD_BYTES;
use blaze_domain::names::ChannelName;

use blaze_brokers::port::Broker;

pub use closing::{close_delivers_and_ends, close_leaves_nothing_behind};
pub use delivery::{
    bare_payloads_arrive_as_they_are, framed_payloads_arrive_as_they_are,
    malformed_frames_are_reported, many_channels_stay_apart, order_per_writer,
    own_publications_are_seen, reserved_channels_carry_json_as_it_is, too_large_is_refused,
};
pub use outage::{publishing_never_waits, server_away_and_back};
pub use subscriptions::{
    dropping_a_subscription_unsubscribes, late_joiners_get_what_is_kept,
    slow_readers_are_bounded_in_bytes, slow_readers_are_bounded_in_messages,
};

/// What an adapter and its server can do; the rules ask for no more.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Capabilities {
    /// Payloads without a header can be published on user channels.
    pub bare: bool,
    /// Frames lie on the server as bytes, so there can be malformed ones.
    pub malformed: bool,
    /// It keeps the last `depth` frames of a writer for late joiners.
    pub keeps_last: bool,
    /// The server can be stopped and started by the fixture.
    pub outage: bool,
    /// What was taken while the server or a reader was away is delivered later (Kafka).
    pub keeps_while_away: bool,
    /// A publisher finds its readers only some time after it was made (DDS).
    pub finds_readers_late: bool,
    /// What was published so short a time before a subscription may count as published after it,
    /// because clocks of several hosts are compared (DDS).
    pub clocks_apart: Duration,
    /// Most bytes of messages that one publisher's queue holds while the server is away.
    pub queue_bytes: usize,
    /// How many channels at once to try.
    pub channels: usize,
    /// Largest payload to try, in bytes.
    pub largest_payload: usize,
}

impl Default for Capabilities {
    /// Everything but what is special to Kafka and DDS, 500 channels, payloads up to the largest,
    /// queues of 64 MiB.
    fn default() -> Self {
        Self {
            bare: true,
            malformed: true,
            keeps_last: true,
            outage: true,
            keeps_while_away: false,
            finds_readers_late: false,
            clocks_apart: Duration::ZERO,
            queue_bytes: 64 * 1024 * 1024,
            channels: 500,
            largest_payload: MAX_PAYLOAD_BYTES,
        }
    }
}

/// A server for the tests of one adapter, and the way to get clients of it.
#[async_trait]
pub trait Fixture: Send + Sync {
    /// What the adapter and its server can do.
    fn capabilities(&self) -> Capabilities;

    /// A new client of the server; it need not be connected yet.
    ///
    /// # Errors
    /// Why there is none.
    async fn broker(&self) -> Result<Arc<dyn Broker>, String>;

    /// Takes the server away. Asked only with [`Capabilities::outage`].
    ///
    /// # Errors
    /// Why it could not be stopped.
    async fn stop_server(&self) -> Result<(), String>;

    /// Brings the same server back, at the same address.
    ///
    /// # Errors
    /// Why it could not be started.
    async fn start_server(&self) -> Result<(), String>;

    /// How many clients the server believes to read a channel, where it can tell.
    async fn readers_of(&self, _channel: &ChannelName) -> Option<usize> {
        None
    }

    /// What closed and dropped clients have left behind beside tasks of the current runtime
    /// (threads, sockets), for people; empty = nothing.
    async fn leftovers(&self) -> Vec<String> {
        Vec::new()
    }
}

/// One list of rules for [`run_all`] and the tests of
/// [`broker_conformance_tests!`](crate::broker_conformance_tests).
macro_rules! rules {
    ($d:tt $($rule:ident),+ $(,)?) => {
        /// Tries all rules, one after the other, on one fixture. Returns those that are broken.
        pub async fn run_all(fixture: &dyn Fixture) -> Vec<String> {
            let mut failures = Vec::new();
            $(
                if let Err(detail) = $rule(fixture).await {
                    failures.push(format!("rule `{}` is broken: {detail}", stringify!($rule)));
                }
            )+
            failures
        }

        /// Makes a test of each rule. The argument is an expression whose `await` gives a
        /// [`Fixture`]; it is evaluated once for each test.
        #[macro_export]
        macro_rules! broker_conformance_tests {
            ($d fixture:expr) => {
                $(
                    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
                    async fn $rule() {
                        let fixture = $d fixture.await;
                        if let Err(detail) = $d crate::broker::$rule(&fixture).await {
                            panic!("rule `{}` is broken: {detail}", stringify!($rule));
                        }
                    }
                )+
            };
        }
    };
}

rules!(
    $
    order_per_writer,
    own_publications_are_seen,
    framed_payloads_arrive_as_they_are,
    bare_payloads_arrive_as_they_are,
    reserved_channels_carry_json_as_it_is,
    malformed_frames_are_reported,
    too_large_is_refused,
    many_channels_stay_apart,
    slow_readers_are_bounded_in_messages,
    slow_readers_are_bounded_in_bytes,
    dropping_a_subscription_unsubscribes,
    late_joiners_get_what_is_kept,
    server_away_and_back,
    publishing_never_waits,
    close_delivers_and_ends,
    close_leaves_nothing_behind,
);
