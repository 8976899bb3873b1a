//! YAML that people write, read so that every fault is told with its place, all of them at once.
//!
//! [`parse`] makes a tree of nodes that know where they stand; [`Reader`] takes values from it and notes what is wrong in
//! [`Findings`]. Anchors, aliases and tags are not read: the documents are short.

mod findings;
mod read;
mod tree;

pub use findings::{Code, Finding, Findings};
pub use read::Reader;
pub(crate) use read::nearest;
pub use tree::{Kind, Node, Place, parse};
