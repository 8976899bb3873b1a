//! Reads YAML that people write. All errors are reported together, with their locations.
//!
//! [`parse`] builds a tree of nodes with locations. [`Reader`] reads values from it and adds errors
//! to [`Findings`]. Anchors, aliases and tags are not supported.

mod findings;
mod read;
mod tree;

pub use documents::SourceSpan as Place;
pub(crate) use documents::nearest;
pub use findings::{Code, Finding, Findings};
pub use read::Reader;
pub use tree::{Kind, Node, parse};
