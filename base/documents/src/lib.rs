//! Shared parts of the readers of YAML documents: positions in a text, findings rendered with their
//! source line, texts that cannot control a terminal, the search for misspelt names, and files of
//! bounded size.

mod codes;
mod excerpt;
mod file;
mod nearest;
mod span;
mod terminal;

pub use excerpt::{Excerpt, printable};
pub use file::{FileError, read_bounded};
pub use nearest::nearest;
pub use span::SourceSpan;
pub use terminal::{harmless_json, is_obeyed};
