//! What leaves a flow that is stopped, and robots that meet over the DDS domain of their layer,
//! and JSON made of what another layer publishes.

mod drain;
mod edge_to_edge;
mod json;
mod monitor;
