//! Document -> mapping: what only shows when the parts of a document are seen together.

mod bindings;
mod cell;
mod meaning;
mod names;
mod network;
mod patterns;
mod services;
mod several;
mod shaping;
mod types;
mod variables;

use crate::diagnostic::{Diagnostic, Severity};
use crate::document;
use crate::findings::Findings;
use crate::mapping::Mapping;
use crate::read::{Field, Reader};
use crate::tree::{self, Place};

/// What a document comes to.
#[derive(Clone, Debug)]
pub struct Checked {
    /// `None` when one of the findings is an error.
    pub mapping: Option<Mapping>,
    /// All findings in the order of the text; at most some 200, the last one then tells how many more there are.
    pub findings: Vec<Diagnostic>,
}

impl Checked {
    /// Every finding with its source line, then how many there are; empty when there is none. `source` is the text that
    /// was checked.
    #[must_use]
    pub fn render(&self, source: &str) -> String {
        let mut out: Vec<String> = self
            .findings
            .iter()
            .map(|found| found.render(source))
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
    /// Checks the text of a document. `file` is how the findings name it. Never panics, and takes time and room in
    /// proportion to the text, of which at most 4 MiB are read.
    #[must_use]
    pub fn from_yaml(text: &str, file: &str) -> Checked {
        let mut findings = Findings::new(file);
        let mapping = compile(text, &mut findings).filter(|_| !findings.has_errors());
        Checked {
            mapping,
            findings: findings.into_sorted(),
        }
    }
}

fn compile(text: &str, findings: &mut Findings) -> Option<Mapping> {
    let root = match tree::parse(text) {
        Ok(root) => root,
        Err(fault) => {
            let note = findings.error(fault.code, fault.place, fault.message);
            if let Some(help) = fault.help {
                note.help(help);
            }
            return None;
        }
    };
    let (document, _) = document::read(&root, &mut Reader::new(findings))?;
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
    Some(mapping.with_patterns(patterns))
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
