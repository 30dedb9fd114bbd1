//! Memory broker.
