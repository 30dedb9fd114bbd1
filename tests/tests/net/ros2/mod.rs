//! ROS 2: rclpy and Cyclone DDS beside flows.

mod direct;
