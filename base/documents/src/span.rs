//! Positions in a text.

use granit_parser::Span;

/// A range of columns in a line of a text.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct SourceSpan {
    /// The line, from 1.
    pub line: usize,
    /// The column in characters, from 1.
    pub column: usize,
    /// The length in characters, at least 1.
    pub len: usize,
}

impl SourceSpan {
    /// The start of the text.
    pub const START: Self = Self {
        line: 1,
        column: 1,
        len: 1,
    };

    /// Returns the first line of a range that the parser marked in `text`.
    #[must_use]
    pub fn of(text: &str, marks: Span) -> Self {
        let (start, end) = (marks.start, marks.end);
        let len = if end.line() == start.line() {
            end.col().saturating_sub(start.col())
        } else {
            let rest = start
                .byte_offset()
                .and_then(|at| text.get(at..))
                .unwrap_or_default();
            rest.lines()
                .next()
                .unwrap_or_default()
                .trim_end()
                .chars()
                .count()
        };
        Self {
            line: start.line().max(1),
            column: start.col() + 1,
            len: len.max(1),
        }
    }
}
