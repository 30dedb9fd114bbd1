//! Round trips to other nodes through BlazeFlow, and the offsets of their clocks.
