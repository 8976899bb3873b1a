//! A component of the cell: skills, served by OPC UA, as values and calls of the space, and
//! announced by discovery.
//!
//! The program `ua-component` runs [`ComponentPort`] with the YAML file of a component. A program
//! with own drivers runs it with its own [`skills::Component`]. [`ForeignSkills`] represents
//! servers with skills that are not participants of the space.

mod asking;
pub mod definition;
mod encoding;
#[cfg(feature = "devices")]
pub mod entry;
mod exec;
mod executor;
mod fields;
mod goals;
mod idle;
mod mirrors;
#[cfg(feature = "devices")]
mod modules;
mod partners;
mod port;
mod reload;
#[cfg(feature = "devices")]
mod simulate;
mod space;
mod topics;
#[cfg(feature = "devices")]
mod verb;
mod work;

pub use mirrors::{Foreign, ForeignFaults, ForeignSkills};
pub use port::{ComponentOptions, ComponentPort, check, made, print};
pub use reload::{ComponentFile, Overrides, ReadComponent, Version};
