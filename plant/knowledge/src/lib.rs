//! The knowledge of the plant as RDF, and queries on it.
//!
//! [`Knowledge`] is a store in memory with a named graph per [`Source`]: a discovered component
//! ([`ComponentFacts`]), a manifest of an MTP, a NodeSet ([`nodeset`]), a file of Turtle, a run of
//! a process. Each graph is replaced as a whole when its source changes, and removed with its
//! source. Queries are SPARQL ([`QUESTIONS`] are named queries); [`Endpoint`] serves them over
//! HTTP, with limits of time, memory and size.
//!
//! This crate calls no server and discovers nothing: facts are plain data with the name of their
//! source.
//!
//! Reading order: `source` (the named graphs), `store` (replacement and derivation), `component`
//! and `nodeset` (facts to statements), `question` (named queries), `query` and `bounds` (any
//! SPARQL, within limits), `http`.

mod bounds;
mod component;
mod http;
pub mod nodeset;
mod query;
mod question;
mod source;
mod store;

pub use component::{
    ComponentFacts, NodeName, OPC_UA, ParameterFacts, SkillFacts, TypeFacts, is_iri,
};
pub use http::{Endpoint, Page};
pub use mtp::vocabulary;
pub use query::Limits;
pub use question::{Answer, QUESTIONS, Question, QuestionFault};
pub use source::{Source, SourceKind};
pub use store::{Knowledge, KnowledgeFault, SourceStatus};
