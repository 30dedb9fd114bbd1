//! What rosbags and rclpy make of the same values of all ROS 2 types.

use blaze_tests::process::binary;

use super::clients::script;

#[test]
fn conversions_and_hashes_are_those_of_ros_2() {
    let folder = binary("blaze-config").unwrap();
    let oracle = folder.with_file_name("examples").join("oracle");
    script("ros-oracle", &["--program", oracle.to_str().expect("UTF-8")]);
}
