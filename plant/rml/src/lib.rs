//! RML: XML files as RDF, by a mapping that users write.
//!
//! A mapping is Turtle in one of two vocabularies: `http://semweb.mmlab.be/ns/rml#` with R2RML, or
//! `http://w3id.org/rml/`. [`RmlMapping`] reads it, and [`RmlMapping::run`] reads the files that it
//! names through [`Files`] and returns the statements. [`Folder`] gives files of one folder only.
//!
//! Sizes, depths, and the work of a run are limited. The crate opens no connection.
//!
//! Reading order: `mapping` (the model), `read` (Turtle to the model), `xpath` (expressions), `run`
//! (the statements), `files`.

mod files;
mod mapping;
mod read;
mod run;
mod write;
mod xpath;

pub use files::{Files, Folder, MappingFileFault};
pub use mapping::{MappingFault, RmlMapping};
pub use run::RunOutput;
