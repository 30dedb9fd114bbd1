//! SQLite as a store: the rules for all stores, and migrations of real files by processes that are killed.
//!
//! The same on MongoDB: `tests/tests/stores`.

mod migrations;
mod rules;
