//! The library against Cyclone DDS, the peer being `tests/peers/ros2_peer.py` of this repository.
//!
//! Ignored unless asked for: run them in a network namespace of their own, one at a time, with `CYCLONE_PYTHON` naming
//! a Python that has `cyclonedds`.
#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::disallowed_methods,
    clippy::wildcard_enum_match_arm,
    reason = "test code"
)]

mod data_plane;
mod peer;
mod port;
