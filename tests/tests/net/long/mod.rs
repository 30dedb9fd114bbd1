//! Tests that run with `scripts/test --long` alone: what measures for minutes, and the harness
//! itself.

mod budget;
mod emulator;
mod joins;
mod soak;
mod topology;
