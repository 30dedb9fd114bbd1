//! Garbage on every door of a flow: brokers, control channel, DDS ports, admin port, node file.
//!
//! After each attack the flow must live, be ready, carry messages as before, hold no more memory than it may, and have
//! counted what it refused.

mod control;
mod demo;
mod frames;
mod http;
mod inside;
mod node_file;
mod random;
mod shapes;
mod signals;
mod udp;
