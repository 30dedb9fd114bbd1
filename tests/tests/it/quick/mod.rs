//! Tests that run in every tier: simulations of whole flows, the SDK, and what is written about the
//! code.

mod flow;
mod layers;
mod node_file;
mod sdk;
mod traps;
