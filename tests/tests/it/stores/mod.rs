//! The stores of the configuration: the rules for all of them, outages, processes that are killed,
//! migrations.
//!
//! Needs `scripts/services install`.

mod alone;
mod killed;
mod migrations;
mod outages;
mod passwords;
mod refused;
mod rules;
mod support;
