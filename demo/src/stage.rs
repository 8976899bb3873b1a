//! Shared parts of the scenarios: child processes, the timeline, status pages, and Ctrl-C.

mod beside;
mod browser;
mod failure;
mod hops;
mod interrupt;
mod mes;
mod mes_cell;
mod pages;
mod programs;
mod show;
mod stop;
mod timeline;
mod tool_docks;

pub(crate) use beside::{find, free_port, must_be_free};
pub(crate) use browser::{address, open_when_served, status_of};
pub(crate) use failure::{DemoFailure, exit_code};
pub(crate) use hops::{BridgeHop, RobotHops, delays, micros};
pub(crate) use interrupt::Interrupt;
pub(crate) use mes::{JobRun, MES_WHO, StepRun};
pub(crate) use mes_cell::{MesStory, perform};
pub(crate) use pages::fetch;
pub(crate) use programs::{ChildReport, ProgramStart, RunningPrograms, Stage, command};
pub(crate) use show::Show;
pub(crate) use stop::{StopReason, watched};
pub(crate) use timeline::{EventPrinter, EventSource};
pub(crate) use tool_docks::swapped_tools;

/// The interface of the PubSub group, by address, because its name differs between systems.
pub(crate) const LOOPBACK: &str = "127.0.0.1";
