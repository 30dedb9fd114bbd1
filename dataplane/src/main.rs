//! BlazeFlow.
fn main() {}
