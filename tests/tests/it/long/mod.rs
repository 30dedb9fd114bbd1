//! Tests that run with `scripts/test --long` alone: many workers at once, generated clients, ROS 2
//! types beside other programs, the harness itself.

mod clients;
mod fleet;
mod ros2_types;
mod servers;
