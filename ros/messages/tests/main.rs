//! The tests of definitions and values, in a single program so that they are linked once.
#![expect(
    clippy::cast_possible_truncation,
    clippy::indexing_slicing,
    clippy::panic,
    clippy::print_stderr,
    clippy::unwrap_used,
    clippy::wildcard_enum_match_arm,
    reason = "test code"
)]

#[path = "support/inventor.rs"]
mod inventor;
mod support;

mod definitions;
mod foreign;
mod judges;
mod properties;
mod shaped;
mod type_hashes;
mod values;
