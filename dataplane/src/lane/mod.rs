//! The path of a message through one flow.

mod bridge;
pub mod core;
pub mod measure;
pub mod path;
pub mod stats;
pub mod window;
pub mod writer;
