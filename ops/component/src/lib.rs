//! A component of the cell: skills, served by OPC UA, as values and calls of the space, and announced to who looks for
//! them.
//!
//! The program `ua-component` is [`ComponentPort`] with the YAML of a component; a program with drivers of its own is the
//! same with a [`skills::Component`] that it makes. For servers that have skills and know nothing of the space a program speaks
//! with [`ForeignSkills`].

mod asking;
pub mod definition;
#[cfg(feature = "devices")]
pub mod entry;
mod executor;
mod fields;
mod goals;
mod mirrors;
mod partners;
mod port;
#[cfg(feature = "devices")]
mod simulate;
mod space;
mod work;

pub use mirrors::{Foreign, ForeignFaults, ForeignSkills};
pub use port::{ComponentPort, Options, check, made, print};
