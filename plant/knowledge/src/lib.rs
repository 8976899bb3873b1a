//! What is known of the plant, as RDF, and questions about it.
//!
//! [`Knowledge`] is a store in memory with one named graph per [`Source`]: a component that was found ([`ComponentFacts`]), a
//! manifest of an MTP, a NodeSet ([`nodeset`]), a file of Turtle, a run of a process. Each is replaced as a whole when its source
//! changes, and goes when the source goes. Questions are SPARQL ([`QUESTIONS`] have names); [`Endpoint`] answers them over HTTP, with
//! limits in time, memory and size.
//!
//! No server is asked here and nothing is discovered: facts come as plain data with the name of their source.
//!
//! Reading order: `source` (whose graph), `store` (replaced and derived), `component` and `nodeset` (facts to statements), `question` (by name),
//! `query` and `bounds` (any SPARQL, within limits), `http`.

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
