//! ROS 2: rclpy and Cyclone DDS beside flows.

mod brokers;
mod churn;
mod direct;
mod graph;
mod long;
mod quality;
mod routes;
mod shared;
mod support;
mod tools;
