//! MongoDB as a store of the configuration: the rules for all stores, outages, processes that are killed, migrations.
//!
//! Needs `scripts/services install`. The same rules on SQLite: `control-plane/tests/stores`.

#![allow(clippy::unwrap_used, reason = "the helpers of a test fail like the test")]

mod alone;
mod killed;
mod migrations;
mod outages;
mod rates;
mod refused;
mod rules;
mod support;
