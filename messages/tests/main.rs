//! The tests of definitions and values, one program so that they are linked once.

#[path = "support/inventor.rs"]
mod inventor;
mod support;

mod definitions;
mod foreign;
mod judges;
mod properties;
mod shaped;
mod type_hashes;
mod values;
