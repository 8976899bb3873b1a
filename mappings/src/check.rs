//! Document -> mapping: what only shows when the parts of a document are seen together.

mod bindings;
mod cell;
mod names;
mod network;
mod patterns;
mod services;
mod shaping;
mod types;
mod variables;

use std::sync::Arc;

use crate::diagnostic::{Diagnostic, Severity};
use crate::document::Document;
use crate::findings::Findings;
use crate::include::Loader;
use crate::mapping::Mapping;
use crate::read::Field;
use crate::surroundings::{Alone, Surroundings};
use crate::tree::Place;

/// What a document comes to.
#[derive(Clone, Debug)]
pub struct Checked {
    /// `None` when one of the findings is an error.
    pub mapping: Option<Mapping>,
    /// All findings in the order of the text; at most some 200, the last one then tells how many more there are.
    pub findings: Vec<Diagnostic>,
    /// What was read.
    pub sources: Vec<Source>,
}

/// A text that was checked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Source {
    /// As findings name it.
    pub name: Arc<str>,
    /// As it is in the file.
    pub text: String,
}

impl Checked {
    /// Every finding with its source line, then how many there are; empty when there is none. `source` is the text that
    /// was checked, of a document that includes no other.
    #[must_use]
    pub fn render<'s>(&'s self, source: &'s str) -> String {
        self.render_with(|_| source)
    }

    /// As [`render`](Self::render), with the texts that were read.
    #[must_use]
    pub fn render_all(&self) -> String {
        self.render_with(|found| {
            let mut sources = self.sources.iter();
            let source = sources.find(|source| source.name == found.at.file);
            source.map_or("", |source| source.text.as_str())
        })
    }

    fn render_with<'s>(&'s self, source: impl Fn(&Diagnostic) -> &'s str) -> String {
        let mut out: Vec<String> = self
            .findings
            .iter()
            .map(|found| found.render(source(found)))
            .collect();
        let count = |severity| {
            self.findings
                .iter()
                .filter(|found| found.severity == severity)
                .count()
        };
        let counts = [
            (count(Severity::Error), "error"),
            (count(Severity::Warning), "warning"),
        ];
        let told = counts.iter().filter(|(count, _)| *count > 0);
        let told: Vec<String> = told
            .map(|(count, word)| format!("{count} {word}{}", if *count == 1 { "" } else { "s" }))
            .collect();
        if !told.is_empty() {
            out.push(format!("{}\n", told.join(", ")));
        }
        out.join("\n")
    }
}

impl Mapping {
    /// Checks the text of a document that stands alone: it includes no other, and no environment variable is set. `file`
    /// is how the findings name it. Never panics, and takes time and room in proportion to the text, of which at most
    /// 4 MiB are read.
    #[must_use]
    pub fn from_yaml(text: &str, file: &str) -> Checked {
        Self::from_text(text, file, &Alone)
    }

    /// Checks the text of a document and of what it includes. `file` is how the findings name it, and paths within it are
    /// taken from its folder.
    #[must_use]
    pub fn from_text(text: &str, file: &str, around: &dyn Surroundings) -> Checked {
        let mut findings = Findings::new(file);
        let (document, sources) = Loader::new(around, &mut findings).load(text, file);
        let mapping = document
            .map(|document| compile(document, &mut findings))
            .filter(|_| !findings.has_errors());
        Checked {
            mapping,
            findings: findings.into_sorted(),
            sources,
        }
    }
}

fn compile(document: Document, findings: &mut Findings) -> Mapping {
    let spaces = cell::spaces(document.spaces.as_ref(), findings);
    let namespaces = cell::namespaces(document.namespaces.as_ref(), findings);
    let pubsub = network::pubsub(document.pubsub.as_ref(), findings);
    let server = network::server(document.server.as_ref(), findings);
    let variables = match &document.variables {
        Some(entries) => {
            let entries = entries.value.as_deref().unwrap_or_default();
            variables::check(entries, &spaces, &namespaces, findings)
        }
        None => Vec::new(),
    };
    let patterns = match &document.patterns {
        Some(entries) => {
            let entries = entries.value.as_deref().unwrap_or_default();
            patterns::check(entries, &spaces, &namespaces, findings)
        }
        None => Vec::new(),
    };
    let mapping = Mapping::new(pubsub, spaces.known, namespaces.known, server, variables);
    mapping.with_patterns(patterns)
}

/// What a document declares.
struct Declared<T> {
    known: T,
    /// Some entry was faulty, so what is missing here may have been meant by it.
    partial: bool,
}

/// The value of a key that has no default; notes when it is not there. `owner` is where the map begins.
fn required<'d, T>(
    field: &'d Field<T>,
    key: &str,
    of: &str,
    owner: Place,
    findings: &mut Findings,
) -> Option<(&'d T, Place)> {
    match field {
        Some(at) => Some((at.value.as_ref()?, at.place)),
        None => {
            let message = format!("{of} has no `{key}`");
            findings.error(crate::Code::MissingKey, owner, message);
            None
        }
    }
}
