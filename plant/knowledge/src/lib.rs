//! The knowledge of the plant as RDF, and queries on it.
//!
//! [`Knowledge`] is a store in memory with a named graph per [`KnowledgeSource`]: a discovered
//! component ([`ComponentFacts`]), a manifest of an MTP, a NodeSet ([`nodeset`]), a file of Turtle,
//! a run of a process. Each graph is replaced as a whole when its source changes, and removed with
//! its source. Queries are SPARQL ([`QUESTIONS`] are named queries); [`HttpEndpoint`] serves them
//! over HTTP, with limits of time, memory and size.
//!
//! Users write graphs of their own by SPARQL 1.1 Update and the Graph Store Protocol. Lasting
//! sources are stored in a journal.
//!
//! This crate calls no server and discovers nothing: facts are plain data with the name of their
//! source.
//!
//! Reading order: `source` (the named graphs), `store`, `writing` (replacement), `rules` (derived
//! statements), `journal` (lasting sources), `component`, `nodeset`, `node_set_models`, `owl` and
//! `served` (facts to statements), `question` (named queries), `query` and `bounds` (any SPARQL,
//! within limits), `lanes` (the queries that run at a time), `http`, `remote` and `sign_ins`
//! (clients of other hosts), `dump` (graphs as documents), `update` and `writes` (changes by
//! users), `shapes` and `checking` (the SHACL report), `units` (conversion of numbers), `requests`
//! (queries and changes for other protocols than HTTP), `value_query` (queries with one value),
//! `operations` (a taxonomy of capabilities), `products` (STEP files).

mod bounds;
mod checking;
mod component;
mod dump;
mod http;
mod journal;
mod lanes;
mod node_set_limits;
mod node_set_models;
pub mod nodeset;
pub mod operations;
pub mod owl;
mod pictures;
pub mod products;
mod query;
mod question;
mod remote;
mod requests;
mod rules;
mod served;
mod shapes;
mod sign_ins;
mod source;
mod store;
pub mod units;
mod update;
mod value_query;
mod writes;
mod writing;
mod written;

pub use component::{
    ComponentFacts, NodeName, OPC_UA, ParameterFacts, SkillFacts, TypeFacts, is_iri,
};
pub use http::{ExtraPages, HttpEndpoint};
pub use mtp::vocabulary;
pub use pictures::{ListedPicture, PictureFault};
pub use query::{Queries, QueryLimits};
pub use question::{NamedQuestion, QUESTIONS, QuestionAnswer, QuestionFault};
pub use remote::{ConnectionSecurity, PasswordRefusal, SecuredStream, SecuringConnection};
pub use requests::{KnowledgeRefusal, KnowledgeRequests, LoadedSource, QueryRequest, line_of};
pub use served::{ServedNode, ServedSpace};
pub use source::{KnowledgeSource, SourceKind};
pub use store::{Knowledge, KnowledgeFault, SourceLifetime, SourceStatus};
pub use value_query::{ValueQuery, ValueQueryFault};
pub use writes::{Configuring, JobRunner, May, SourceCheck, SourceFiles, SourceFinding, Writes};
pub use written::WrittenResult;

/// Returns an empty folder for a test.
#[cfg(test)]
fn test_folder(name: &str) -> std::path::PathBuf {
    let folder = std::env::temp_dir().join(format!("knowledge-{name}-{}", std::process::id()));
    drop(std::fs::remove_dir_all(&folder));
    drop(std::fs::create_dir_all(&folder));
    folder
}
