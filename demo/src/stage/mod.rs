//! What every scenario of the demo stands on: child processes, the timeline, the pages of programs, and Ctrl-C.

mod beside;
mod failure;
mod hops;
mod interrupt;
mod pages;
mod programs;
mod timeline;

pub(crate) use beside::{find, free_port, must_be_free};
pub(crate) use failure::Failure;
pub(crate) use hops::{Hop, Hops, delays, micros};
pub(crate) use interrupt::Interrupt;
pub(crate) use pages::fetch;
pub(crate) use programs::{Program, Programs, Report, Stage, command};
pub(crate) use timeline::{Timeline, Who};

/// The interface of the PubSub group, by address, because its name is not the same everywhere.
pub(crate) const LOOPBACK: &str = "127.0.0.1";
