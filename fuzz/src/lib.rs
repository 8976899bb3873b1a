//! Each function takes bytes that may be anything and panics when the codec does not keep its word.
//!
//! `libfuzzer/` feeds them with inputs that reach new code; `corpus/` holds those found, and the tests run them all.

mod chunks;
mod decode;
mod discovery;
mod input;
mod reader_state;
mod secured;

pub use chunks::chunks;
pub use decode::decode;
pub use discovery::discovery;
pub use reader_state::reader_state;
pub use secured::secured;

/// Panics when the codec does not keep its word on the input.
pub type Target = fn(&[u8]);

/// The targets by their names, which are also those of their folders under `corpus/`.
pub const TARGETS: &[(&str, Target)] = &[
    ("chunks", chunks),
    ("decode", decode),
    ("discovery", discovery),
    ("reader_state", reader_state),
    ("secured", secured),
];
