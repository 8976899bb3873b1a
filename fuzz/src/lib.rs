//! Each function takes bytes that may be anything and panics when the codec does not keep its word.
//!
//! `libfuzzer/` feeds them with inputs that reach new code; `corpus/` holds those found, and the tests run them all.

mod decode;
mod input;
mod secured;

pub use decode::decode;
pub use secured::secured;

/// The targets by their names, which are also those of their folders under `corpus/`.
pub const TARGETS: &[(&str, fn(&[u8]))] = &[("decode", decode), ("secured", secured)];
