//! The tests of mappings and their findings, one program so that they are linked once.
#![expect(
    clippy::panic,
    clippy::unwrap_used,
    clippy::wildcard_enum_match_arm,
    reason = "test code"
)]

mod calls;
mod files;
mod findings;
mod mapping;
mod parts;
mod shipped;
mod versions;
