//! Tests of the codec, as a single program so that they are linked once.
#![expect(
    clippy::cast_possible_truncation,
    clippy::indexing_slicing,
    clippy::panic,
    clippy::unwrap_used,
    clippy::wildcard_enum_match_arm,
    reason = "test code"
)]

#[path = "common/everything.rs"]
mod everything;
#[path = "common/model.rs"]
mod model;
#[path = "common/rewrite.rs"]
mod rewrite;

mod action;
mod allocation;
mod chunks;
mod delta;
mod discovery;
mod hostile;
mod properties;
mod raw;
mod raw_properties;
mod reading;
mod security;
mod vectors;
mod writing;
