//! `ua-space` as its users run it.

#![expect(clippy::unwrap_used, clippy::indexing_slicing, reason = "test code")]

mod actions;
mod captures;
mod check;
mod init;
mod live;
mod malformed;
mod normal;
mod program;
mod secured;
mod usage;
mod vectors;
