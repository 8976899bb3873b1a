//! Real ROS 1.
