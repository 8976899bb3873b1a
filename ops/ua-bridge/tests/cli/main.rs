//! `ua-bridge` as its users run it: the names of the program, and `ua-space`.

#![expect(clippy::unwrap_used, clippy::indexing_slicing, reason = "test code")]

mod actions;
mod captures;
mod check;
mod init;
mod live;
mod malformed;
mod names;
mod normal;
mod program;
mod secured;
mod usage;
mod vectors;
