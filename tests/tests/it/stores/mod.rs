//! MongoDB as a store of the configuration: the rules for all stores, outages, processes that are killed, migrations.
//!
//! Needs `scripts/services install`.

mod alone;
mod killed;
mod migrations;
mod outages;
mod rates;
mod refused;
mod rules;
mod sqlite;
mod support;
