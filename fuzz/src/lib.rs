//! Fuzz targets: each function takes arbitrary bytes and panics if the tested code violates a
//! guarantee.
//!
//! `libfuzzer/` runs the targets with inputs that reach new code. `corpus/` stores the inputs
//! found, and the tests run them all.

mod action;
mod calls;
mod chunks;
mod decode;
mod definition;
mod discovery;
mod input;
mod lds;
mod manifest;
mod mapping;
mod mdns;
mod message;
mod model;
mod nodeset;
mod recipe;
mod registry;
mod rml;
mod secured;
mod step;
#[path = "../../ros/messages/tests/support/mod.rs"]
mod tape;

pub use self::registry::registry;
pub use self::rml::rml;
pub use action::action;
pub use calls::calls;
pub use chunks::chunks;
pub use decode::decode;
pub use definition::definition;
pub use discovery::discovery;
pub use lds::lds;
pub use manifest::manifest;
pub use mapping::mapping;
pub use mdns::mdns;
pub use message::message;
pub use model::model;
pub use nodeset::nodeset;
pub use recipe::recipe;
pub use secured::secured;
pub use step::step;

/// A function that panics if the tested code violates a guarantee on the input.
pub type Target = fn(&[u8]);

/// The targets by name, which is also the name of their folder in `corpus/`.
pub const TARGETS: &[(&str, Target)] = &[
    ("action", action),
    ("calls", calls),
    ("chunks", chunks),
    ("decode", decode),
    ("definition", definition),
    ("discovery", discovery),
    ("lds", lds),
    ("manifest", manifest),
    ("mapping", mapping),
    ("mdns", mdns),
    ("message", message),
    ("model", model),
    ("nodeset", nodeset),
    ("recipe", recipe),
    ("registry", registry),
    ("rml", rml),
    ("secured", secured),
    ("step", step),
];
