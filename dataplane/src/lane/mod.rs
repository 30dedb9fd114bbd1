//! The path of a message through one flow.

mod admit;
pub mod allocation;
mod bridge;
pub mod calls;
pub mod compress_stage;
pub mod core;
mod early;
pub mod kept;
pub mod load;
pub mod measure;
pub mod path;
mod places;
pub mod reading;
pub mod stats;
mod succession;
pub mod window;
pub mod writer;
