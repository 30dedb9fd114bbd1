//! BlazeFlow: connects whoever publishes a topic with whoever asks for it.

pub mod link;
pub mod plan;
pub mod why;
pub mod world;
