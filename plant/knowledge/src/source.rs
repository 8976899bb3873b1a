//! The sources of statements: each source has a named graph of its own.

use std::fmt;
use std::str::FromStr;

use mtp::escaped;
use serde::Serialize;

/// A source of statements, which names its graph.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct KnowledgeSource {
    /// Its kind.
    pub kind: SourceKind,
    /// Its name: an ApplicationUri, a namespace URI, or the name of a file.
    pub name: String,
}

/// The kind of a source.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SourceKind {
    /// A discovered component, by its ApplicationUri.
    Component,
    /// A manifest of an MTP, by the name given by the importer.
    Mtp,
    /// A NodeSet, by its namespace URI.
    NodeSet,
    /// A file of RDF.
    File,
    /// A process.
    Process,
    /// A STEP file of products.
    Product,
    /// A run of a process.
    Run,
    /// The current states of the skills of a component or a module, by its name.
    State,
    /// The address space of a running server, by its ApplicationUri.
    Server,
    /// A graph that users write; its name is its IRI.
    Graph,
    /// The results of the rules, which are read-only.
    Derived,
}

impl KnowledgeSource {
    /// Creates a source of a kind with a name.
    #[must_use]
    pub fn new(kind: SourceKind, name: &str) -> Self {
        Self {
            kind,
            name: name.to_owned(),
        }
    }

    /// Returns the IRI of its graph.
    #[must_use]
    pub fn graph(&self) -> String {
        if self.kind == SourceKind::Derived {
            return DERIVED.to_owned();
        }
        if self.kind == SourceKind::Graph {
            return self.name.clone();
        }
        format!("urn:ua-bridge:graph:{}:{}", self.kind, escaped(&self.name))
    }
}

impl fmt::Display for SourceKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Component => "component",
            Self::Mtp => "mtp",
            Self::NodeSet => "nodeset",
            Self::File => "file",
            Self::Process => "process",
            Self::Product => "product",
            Self::Run => "run",
            Self::State => "state",
            Self::Server => "server",
            Self::Graph => "graph",
            Self::Derived => "derived",
        })
    }
}

impl FromStr for SourceKind {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        let all = [
            Self::Component,
            Self::Mtp,
            Self::NodeSet,
            Self::File,
            Self::Process,
            Self::Product,
            Self::Run,
            Self::Graph,
        ];
        all.into_iter()
            .find(|kind| kind.to_string() == text)
            .ok_or(())
    }
}

/// The graph of statements that users write without naming a graph.
pub(crate) const UNNAMED: &str = "urn:ua-bridge:graph:unnamed";
/// The graph of derived statements.
pub(crate) const DERIVED: &str = "urn:ua-bridge:graph:derived";
