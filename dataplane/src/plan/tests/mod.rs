//! The planner against tables of its rules, and against a simulated system of random shape.

mod access;
mod balance;
pub(crate) mod generate;
mod property;
mod replicas;
mod ros2;
mod simulate;
mod table;
pub(crate) mod worlds;
