//! SQLite as a store: the rules for all stores, and migrations of real files by processes that are killed.
//!
//! The same on MongoDB: `tests/tests/stores`.

#![allow(clippy::unwrap_used, reason = "the helpers of a test fail like the test")]

mod migrations;
mod rules;
