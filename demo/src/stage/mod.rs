//! Shared parts of the scenarios: child processes, the timeline, status pages, and Ctrl-C.

mod beside;
mod browser;
mod failure;
mod hops;
mod interrupt;
mod pages;
mod programs;
mod stop;
mod timeline;

pub(crate) use beside::{find, free_port, must_be_free};
pub(crate) use browser::{address, open_when_served, status_of};
pub(crate) use failure::Failure;
pub(crate) use hops::{Hop, Hops, delays, micros};
pub(crate) use interrupt::Interrupt;
pub(crate) use pages::fetch;
pub(crate) use programs::{Program, Programs, Report, Stage, command};
pub(crate) use stop::{Stop, unexpected};
pub(crate) use timeline::{Timeline, Who};

/// The interface of the PubSub group, by address, because its name differs between systems.
pub(crate) const LOOPBACK: &str = "127.0.0.1";
