//! `ua-space` as its users run it.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "test code"
)]

mod normal;
mod program;
mod vectors;
