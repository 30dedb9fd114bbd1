//! What leaves a flow that is stopped, and robots that meet over the DDS domain of their layer.

mod drain;
mod edge_to_edge;
