//! Garbage on the doors of a flow that only processes have: DDS ports, node file, admin JSON. What
//! brokers, control channel and HTTP take is tested where it is read, and once over real servers in
//! `real/garbage.rs`.

mod node_file;
mod shapes;
mod udp;
