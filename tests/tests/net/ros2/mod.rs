//! ROS 2: rclpy and Cyclone DDS beside flows.

mod brokers;
mod call;
mod churn;
mod definitions;
mod direct;
mod graph;
mod long;
mod quality;
mod routes;
mod services;
mod shared;
mod support;
mod tools;
