//! The endpoints of `bridge-ros2`, used as a library, against Cyclone DDS: more than a running bridge lets see.

mod data_plane;
mod peer;
mod port;
mod types;
