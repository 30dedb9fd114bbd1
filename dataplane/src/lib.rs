//! BlazeFlow: connects whoever publishes a topic with whoever asks for it.

pub mod lane;
pub mod limit;
pub mod link;
pub mod plan;
pub mod world;
