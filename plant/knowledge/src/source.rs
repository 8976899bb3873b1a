//! Where statements come from: each source has a named graph of its own.

use std::fmt;

use mtp::escaped;
use serde::Serialize;

/// A source of statements, by which its graph is named.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Source {
    /// What it is.
    pub kind: SourceKind,
    /// Which one: an ApplicationUri, a namespace URI, the name of a file.
    pub name: String,
}

/// What a source is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SourceKind {
    /// A component that was found, by its ApplicationUri.
    Component,
    /// A manifest of an MTP, by the name that the importing side gives it.
    Mtp,
    /// A NodeSet, by its namespace URI.
    NodeSet,
    /// A file of RDF.
    File,
    /// A process.
    Process,
    /// A run of a process.
    Run,
    /// What rules made of all others; nobody can write it.
    Derived,
}

impl Source {
    /// Of a kind and a name.
    #[must_use]
    pub fn new(kind: SourceKind, name: &str) -> Self {
        Self {
            kind,
            name: name.to_owned(),
        }
    }

    /// The IRI of its graph.
    #[must_use]
    pub fn graph(&self) -> String {
        if self.kind == SourceKind::Derived {
            return DERIVED.to_owned();
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
            Self::Run => "run",
            Self::Derived => "derived",
        })
    }
}

/// The graph of what rules made.
pub(crate) const DERIVED: &str = "urn:ua-bridge:graph:derived";
