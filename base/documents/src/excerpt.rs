//! Findings rendered as rustc does: code, location, the line with a caret, help.

use std::fmt::Write as _;

use crate::{SourceSpan, is_obeyed};

/// A finding with its location.
#[derive(Debug, Clone, Copy)]
pub struct Excerpt<'a> {
    /// The severity, such as `error`.
    pub severity: &'a str,
    /// The code.
    pub code: &'a str,
    /// The fault, with the value in it.
    pub message: &'a str,
    /// The name of the document.
    pub file: &'a str,
    /// The location in the document.
    pub span: SourceSpan,
    /// Label beside the caret.
    pub label: Option<&'a str>,
    /// Remedy.
    pub help: Option<&'a str>,
}

impl Excerpt<'_> {
    /// Renders the finding with its source line: several lines of text that end in a newline. A
    /// finding with a line that `source` lacks is rendered without it. `masked` replaces secrets of
    /// the line. Control characters are replaced, so that a document cannot control the terminal.
    #[must_use]
    pub fn render(&self, source: &str, masked: impl FnOnce(&str) -> String) -> String {
        let SourceSpan { line, column, len } = self.span;
        let width = line.to_string().len();
        let message = printable(self.message);
        let mut out = format!("{}[{}]: {message}\n", self.severity, self.code);
        let file = printable(self.file);
        let place = format!("{:width$}--> {file}:{line}:{column}\n", "");
        out.push_str(&place);
        if let Some(text) = line.checked_sub(1).and_then(|n| source.lines().nth(n)) {
            let (shown, caret, carets) = window(&masked(text), column.saturating_sub(1), len);
            let label = self.label.map(printable).unwrap_or_default();
            let pointer = format!("{:caret$}{:^<carets$} {label}", "", "");
            // A write to a String cannot fail.
            _ = write!(out, "{:width$} |\n{line} | {shown}\n", "");
            _ = writeln!(out, "{:width$} | {}", "", pointer.trim_end());
        }
        if let Some(help) = self.help {
            _ = writeln!(out, "{:width$} = help: {}", "", printable(help));
        }
        out
    }
}

/// Longest part of a line that is shown.
const WIDTH: usize = 120;

/// Returns the shown part of a line, the position of the first caret in it, and the number of
/// carets.
fn window(text: &str, column: usize, len: usize) -> (String, usize, usize) {
    let text = text.trim_end();
    let total = text.chars().count();
    let start = if column + len <= WIDTH {
        0
    } else {
        column.saturating_sub(WIDTH / 2)
    };
    let piece: String = text.chars().skip(start).take(WIDTH).map(visible).collect();
    let before = if start > 0 { "..." } else { "" };
    let after = if start + WIDTH < total { "..." } else { "" };
    let room = WIDTH.saturating_sub(column - start).max(1);
    let carets = len.min(total.saturating_sub(column)).clamp(1, room);
    (
        format!("{before}{piece}{after}"),
        column - start + before.len(),
        carets,
    )
}

/// Returns the text without characters that a terminal obeys.
#[must_use]
pub fn printable(text: &str) -> String {
    text.chars().map(visible).collect()
}

fn visible(c: char) -> char {
    match c {
        '\t' => '\u{2192}',
        c if is_obeyed(c) => '\u{fffd}',
        c => c,
    }
}
