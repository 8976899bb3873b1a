//! What has been found so far.

use std::collections::HashSet;
use std::sync::Arc;

use crate::code::Code;
use crate::diagnostic::{Diagnostic, Severity, Span};
use crate::tree::Place;

/// Most findings that are kept; the rest is counted.
const MAX: usize = 200;

pub(crate) struct Findings {
    file: Arc<str>,
    found: Vec<Diagnostic>,
    /// An alias brings a node, and what is wrong with it, to several places.
    seen: HashSet<(Code, Place, String)>,
    errors: usize,
    left_out: usize,
}

impl Findings {
    pub(crate) fn new(file: &str) -> Self {
        Self {
            file: file.into(),
            found: Vec::new(),
            seen: HashSet::new(),
            errors: 0,
            left_out: 0,
        }
    }

    /// The finding may be given a label and help until the next one comes.
    pub(crate) fn error(
        &mut self,
        code: Code,
        place: Place,
        message: impl Into<String>,
    ) -> Note<'_> {
        self.push(code, Severity::Error, place, message.into())
    }

    pub(crate) fn warning(
        &mut self,
        code: Code,
        place: Place,
        message: impl Into<String>,
    ) -> Note<'_> {
        self.push(code, Severity::Warning, place, message.into())
    }

    fn push(&mut self, code: Code, severity: Severity, place: Place, message: String) -> Note<'_> {
        if severity == Severity::Error {
            self.errors += 1;
        }
        if self.found.len() >= MAX {
            self.left_out += 1;
            return Note(None);
        }
        if !self.seen.insert((code, place, message.clone())) {
            return Note(None);
        }
        let Place { line, column, len } = place;
        let at = Span {
            file: Arc::clone(&self.file),
            line,
            column,
            len,
        };
        self.found.push(Diagnostic {
            code,
            severity,
            at,
            message,
            label: None,
            help: None,
        });
        Note(self.found.last_mut())
    }

    pub(crate) const fn has_errors(&self) -> bool {
        self.errors > 0
    }

    /// In the order of the text.
    pub(crate) fn into_sorted(mut self) -> Vec<Diagnostic> {
        self.found
            .sort_by_key(|found| (found.at.line, found.at.column, found.code));
        if self.left_out > 0 {
            let message = format!("{} more findings are not shown", self.left_out);
            let Place { line, column, len } = Place::START;
            let at = Span {
                file: self.file,
                line,
                column,
                len,
            };
            let severity = if self.errors > 0 {
                Severity::Error
            } else {
                Severity::Warning
            };
            let (label, help) = (None, Some("mend the first ones and check again".to_owned()));
            self.found.push(Diagnostic {
                code: Code::TooLarge,
                severity,
                at,
                message,
                label,
                help,
            });
        }
        self.found
    }
}

/// The finding just made; nothing when it was one too many or known already.
pub(crate) struct Note<'f>(Option<&'f mut Diagnostic>);

impl Note<'_> {
    pub(crate) fn label(mut self, label: impl Into<String>) -> Self {
        if let Some(found) = &mut self.0 {
            found.label = Some(label.into());
        }
        self
    }

    /// As [`Note::help`], for what takes long to make.
    pub(crate) fn help_with(self, help: impl FnOnce() -> String) {
        if self.0.is_some() {
            self.help(help());
        }
    }

    pub(crate) fn help(mut self, help: impl Into<String>) -> Self {
        if let Some(found) = &mut self.0 {
            found.help = Some(help.into());
        }
        self
    }
}
