//! Reads YAML that people write. All errors are reported together, with their locations.
//!
//! [`parse`] builds a tree of nodes with locations. [`YamlReader`] reads values from it and adds
//! errors to [`Findings`]. Anchors, aliases and tags are not supported.

mod findings;
mod read;
mod tree;

pub use documents::SourceSpan as Place;
pub(crate) use documents::nearest;
pub use findings::{Findings, YamlFinding, YamlFindingCode};
pub use read::{YamlReader, read_document, whole};
pub use tree::{DocumentKind, DocumentNode, parse};
