//! Findings in a document, rendered as rustc does: code, location, the line with a caret, help.

use std::fmt;
use std::sync::Arc;

use documents::{Excerpt, SourceSpan, printable};

use crate::code::Code;
use crate::key_text::without_keys;
use crate::secret::masked;
use crate::topic::SpaceId;

/// A finding. Its `Display` is a line without the source:
/// `error[M003]: <message> (cell.yaml:14:3)`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Diagnostic {
    /// Kind of the finding; stable from release to release.
    pub code: Code,
    /// Severity: error or warning.
    pub severity: Severity,
    /// Location in the document.
    pub at: Span,
    /// The fault, with the value in it.
    pub message: String,
    /// Label beside the caret.
    pub label: Option<String>,
    /// Remedy.
    pub help: Option<String>,
    /// Spaces whose programs need a type, all of them together, if the error lies in the definition
    /// of the type on this host. A program that does not serve all of them can run despite the
    /// error. Empty if the error stops every program.
    pub needed_by: Vec<SpaceId>,
}

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Severity {
    /// The document cannot run: there is no [`Mapping`](crate::Mapping).
    Error,
    /// The document can run.
    Warning,
}

impl fmt::Display for Severity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Error => "error",
            Self::Warning => "warning",
        })
    }
}

/// Part of one line of a document.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Span {
    /// Name of the document.
    pub file: Arc<str>,
    /// Line number, from 1.
    pub line: usize,
    /// Column in characters, from 1.
    pub column: usize,
    /// Length in characters, at least 1.
    pub len: usize,
}

impl Diagnostic {
    /// Renders the finding with its source line: several lines of text that end in a newline.
    /// `source` is the text that was checked; if it lacks the line, the finding is rendered without
    /// it. Control characters of the source are replaced, so that a document cannot control the
    /// terminal. Passwords in URLs are masked.
    #[must_use]
    pub fn render(&self, source: &str) -> String {
        let Span {
            file,
            line,
            column,
            len,
        } = &self.at;
        let excerpt = Excerpt {
            severity: &self.severity.to_string(),
            code: self.code.as_str(),
            message: &self.message,
            file,
            span: SourceSpan {
                line: *line,
                column: *column,
                len: *len,
            },
            label: self.label.as_deref(),
            help: self.help.as_deref(),
        };
        excerpt.render(source, |line| without_keys(masked(line)).into_owned())
    }
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            code,
            severity,
            at,
            message,
            ..
        } = self;
        let (message, file) = (printable(message), printable(&at.file));
        write!(
            f,
            "{severity}[{code}]: {message} ({file}:{}:{})",
            at.line, at.column
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn finding(line: usize, column: usize, len: usize) -> Diagnostic {
        Diagnostic {
            code: Code::TopicTwice,
            severity: Severity::Error,
            at: Span {
                file: "cell.yaml".into(),
                line,
                column,
                len,
            },
            message: "`ua_2_5_10` is mapped twice".to_owned(),
            label: Some("also mapped at line 6".to_owned()),
            help: Some("give one of them another identifier".to_owned()),
            needed_by: Vec::new(),
        }
    }

    #[test]
    fn a_finding_shows_its_line_with_carets_below_the_text() {
        let source = "\n\n\n\n\n\n\n\n\nspaces: []\n";
        assert_eq!(
            finding(10, 1, 6).render(source),
            "error[M054]: `ua_2_5_10` is mapped twice\n  --> cell.yaml:10:1\n   |\n10 | spaces: []\n   | ^^^^^^ \
             also mapped at line 6\n   = help: give one of them another identifier\n"
        );
        assert_eq!(
            finding(10, 1, 6).to_string(),
            "error[M054]: `ua_2_5_10` is mapped twice (cell.yaml:10:1)"
        );
    }

    #[test]
    fn a_long_line_is_cut_around_the_place() {
        let source = format!("{}bad{}", "x".repeat(500), "y".repeat(500));
        let text = finding(1, 501, 3).render(&source);
        let lines: Vec<&str> = text.lines().collect();
        let at = lines[4].find('^').unwrap();
        assert_eq!(&lines[3][at..at + 3], "bad");
        assert!(lines[3].len() < 140, "{text}");
    }

    #[test]
    fn a_document_cannot_steer_the_terminal() {
        let mut finding = finding(1, 1, 3);
        finding.message = "\u{1b}[2J".to_owned();
        let text = finding.render("a\u{1b}[31m\u{202e}b");
        assert!(
            !text.contains('\u{1b}') && !text.contains('\u{202e}'),
            "{text:?}"
        );
    }

    #[test]
    fn a_place_outside_the_source_is_told_without_a_line() {
        for (line, column, len) in [(0, 0, 0), (9, 9, 9), (1, 400, 900), (1, 0, 1)] {
            assert!(
                finding(line, column, len)
                    .render("x")
                    .starts_with("error[M054]")
            );
        }
    }
}
