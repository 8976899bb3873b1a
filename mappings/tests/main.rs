//! The tests of mappings and their findings, one program so that they are linked once.

mod calls;
mod files;
mod findings;
mod mapping;
mod parts;
mod shipped;
mod versions;
