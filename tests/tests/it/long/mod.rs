//! Tests that run with `scripts/test --long` alone: many workers at once, generated clients, the
//! harness itself.

mod clients;
mod fleet;
mod servers;
