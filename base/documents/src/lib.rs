//! Shared parts of the readers of YAML documents: positions in a text, findings rendered with their
//! source line, texts that cannot control a terminal, and the search for misspelt names.

mod excerpt;
mod nearest;
mod span;
mod terminal;

pub use excerpt::{Excerpt, printable};
pub use nearest::nearest;
pub use span::SourceSpan;
pub use terminal::{harmless_json, is_obeyed};
