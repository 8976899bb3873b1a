//! The endpoints of `bridge-ros2` as a library, with Cyclone DDS: tests that a running bridge does
//! not allow.

mod data_plane;
mod peer;
mod port;
mod types;
