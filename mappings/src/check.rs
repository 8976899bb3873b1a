//! Document -> mapping: checks that need several parts of a document together.

mod alarm;
mod bindings;
mod broker;
mod calls;
mod carriers;
mod cell;
mod confirm;
mod environment;
mod ethernet;
mod finding;
mod loss;
mod meaning;
mod names;
mod network;
mod nodes;
mod nodesets;
mod patterns;
mod permissions;
mod quality;
mod quantity;
mod remote;
mod security;
mod selection;
mod server;
mod servers;
mod services;
mod several;
mod shaping;
mod shared_memory;
mod site;
mod types;
mod variables;

use std::collections::BTreeSet;
use std::path::PathBuf;

use messages::{Dialect, TextKind, TypeName};

use crate::code::Code;
use crate::diagnostic::{Diagnostic, Severity};
use crate::document::Document;
use crate::findings::MappingFindings;
use crate::include::{CheckedText, Loader};
use crate::mapping::Mapping;
use crate::read::{Located, OptionalKey};
use crate::server::Server;
use crate::surroundings::{Alone, PathFault, PathFaultKind, Surroundings};
use crate::topic::SpaceId;
use crate::tree::TextSpan;

use self::types::MessageTypes;

/// Result of checking a document.
#[derive(Clone, Debug)]
pub struct Checked {
    /// The mapping; `None` if a finding is an error.
    pub mapping: Option<Mapping>,
    /// All findings in the order of the text. There are at most about 200; the last finding then
    /// gives the number of the others.
    pub findings: Vec<Diagnostic>,
    /// Message types that the document names, and the origin of each definition.
    pub types: Vec<TypeUse>,
    /// Texts that were read.
    pub sources: Vec<CheckedText>,
    /// Spaces that each error concerns. An empty entry concerns all programs.
    errors: BTreeSet<Vec<SpaceId>>,
    /// The mapping for programs that none of the errors concerns, if there are errors.
    in_parts: Option<Mapping>,
}

/// A message, service or action type that a mapping names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TypeUse {
    /// ROS version of the type.
    pub dialect: Dialect,
    /// Message, service or action.
    pub kind: TextKind,
    /// Name of the type.
    pub name: TypeName,
    /// Origin of its definition.
    pub source: TypeOrigin,
}

/// Origin of a definition.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TypeOrigin {
    /// Built in.
    BuiltIn,
    /// A file.
    File(String),
    /// The definition is not known yet.
    Unknown,
}

impl Checked {
    /// Returns the mapping if it can run for at least one program: enough to find the spaces that a
    /// program serves.
    #[must_use]
    pub fn outline(&self) -> Option<&Mapping> {
        self.mapping.as_ref().or(self.in_parts.as_ref())
    }

    /// Returns the result for a program that serves these spaces, and no other. If an error lies in
    /// the definition of a type that only other spaces need, it becomes a warning, because their
    /// hosts may have another definition.
    #[must_use]
    pub fn for_spaces(mut self, spaces: &[SpaceId]) -> Self {
        let minds = |needed_by: &[SpaceId]| needed_by.iter().all(|space| spaces.contains(space));
        for found in &mut self.findings {
            if found.severity == Severity::Error && !minds(&found.needed_by) {
                found.severity = Severity::Warning;
                let whom: Vec<String> = found.needed_by.iter().map(ToString::to_string).collect();
                let whom = match whom.as_slice() {
                    [one] => format!("this stops only the program that serves space {one}"),
                    all => format!(
                        "this stops only programs that serve the spaces {}",
                        all.join(" and ")
                    ),
                };
                found.help = Some(match found.help.take() {
                    Some(help) => format!("{help}; {whom}"),
                    None => whom,
                });
            }
        }
        if !self.errors.iter().any(|needed_by| minds(needed_by)) {
            self.mapping = self.mapping.take().or_else(|| self.in_parts.take());
            // The finding about findings that are not shown remains.
            for found in &mut self.findings {
                found.severity = Severity::Warning;
            }
        }
        self
    }

    /// Returns every finding with its source line, then the number of findings; empty without
    /// findings. `source` is the text that was checked, of a document that includes no other file.
    #[must_use]
    pub fn render<'s>(&'s self, source: &'s str) -> String {
        self.render_with(|_| source)
    }

    /// Renders as [`render`](Self::render), with the texts that were read.
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
    /// Checks the text of a document that stands alone: it includes no other file, and no
    /// environment variable is set. `file` is its name in the findings. Never panics. Time and
    /// memory grow in proportion to the text, of which at most 32 MiB are read.
    #[must_use]
    pub fn from_yaml(text: &str, file: &str) -> Checked {
        Self::from_text(text, file, &Alone)
    }

    /// Checks the text of a document and of the files that it includes. `file` is its name in the
    /// findings, and paths in the text are relative to its folder.
    #[must_use]
    pub fn from_text(text: &str, file: &str, around: &dyn Surroundings) -> Checked {
        let mut findings = MappingFindings::new(file);
        let (document, sources) = Loader::new(around, &mut findings).load(text, file);
        let mut used = Vec::new();
        let mapping = document.map(|document| compile(document, around, &mut findings, &mut used));
        let errors = findings.errors().clone();
        let for_everybody = errors.is_empty();
        let (mapping, in_parts) = match mapping {
            Some(mapping) if for_everybody => (Some(mapping), None),
            other => (None, other.filter(|_| !errors.iter().any(Vec::is_empty))),
        };
        Checked {
            mapping,
            findings: findings.into_sorted(),
            types: used,
            sources,
            errors,
            in_parts,
        }
    }
}

/// Returns the sound entries and their positions; faulty entries are left out.
fn type_paths(
    entries: &OptionalKey<Vec<Located<String>>>,
    findings: &mut MappingFindings,
) -> (Vec<PathBuf>, Vec<TextSpan>) {
    let entries = entries.as_ref().and_then(|at| at.value.as_deref());
    let entries = entries.unwrap_or_default();
    if let Some(first) = entries.get(MAX_TYPE_PATHS) {
        let message = format!(
            "{} type paths; at most {MAX_TYPE_PATHS} are read",
            entries.len()
        );
        findings.error(Code::TooLarge, first.place, message);
    }
    let sound = entries
        .iter()
        .take(MAX_TYPE_PATHS)
        .filter_map(|at| Some((at.value.clone()?, at.place)));
    sound
        .filter(|(path, place)| {
            if path.is_empty() {
                findings
                    .error(Code::WrongValue, *place, "the path is empty")
                    .help("`.` is the folder of the mapping");
            }
            !path.is_empty()
        })
        .map(|(path, place)| (PathBuf::from(path), place))
        .unzip()
}

fn note_faults(faults: Vec<PathFault>, places: &[TextSpan], findings: &mut MappingFindings) {
    for PathFault { path, what } in faults {
        let Some(place) = places.get(path) else {
            continue;
        };
        match what {
            PathFaultKind::Empty(why) => findings
                .warning(Code::TypePath, *place, why)
                .help("a folder with ROS packages in it, or a file as my_msgs/msg/Name.msg, relative to the mapping"),
            PathFaultKind::File(why) => findings
                .warning(Code::DefinitionFile, *place, why)
                .help("this file is ignored; all other files are read"),
        };
    }
}

fn compile(
    document: Document,
    around: &dyn Surroundings,
    findings: &mut MappingFindings,
    used: &mut Vec<TypeUse>,
) -> Mapping {
    let (paths, places) = type_paths(&document.type_paths, findings);
    let mut files = around.types(&paths);
    note_faults(files.faults(), &places, findings);
    let mut types = MessageTypes::new(files);
    let spaces = cell::spaces(document.spaces.as_ref(), findings);
    let namespaces = cell::namespaces(document.namespaces.as_ref(), findings);
    let pubsub = carriers::check(document.pubsub.as_ref(), findings);
    let (files, named) = nodesets::files(document.server.as_ref(), findings);
    let server = Server {
        find_skills: finding::check(document.server.as_ref(), findings),
        nodesets: files,
        ..server::check(document.server.as_ref(), findings)
    };
    let near = (&server, &namespaces);
    let servers = servers::check(document.servers.as_ref(), near, findings);
    let variables = match &document.variables {
        Some(entries) => {
            let entries = entries.value.as_deref().unwrap_or_default();
            let known = (&spaces, &namespaces, &servers);
            variables::check(entries, known, &mut types, findings)
        }
        None => Vec::new(),
    };
    let patterns = match &document.patterns {
        Some(entries) => {
            let entries = entries.value.as_deref().unwrap_or_default();
            patterns::check(entries, (&spaces, &namespaces), &mut types, findings)
        }
        None => Vec::new(),
    };
    let calls = match &document.calls {
        Some(entries) => {
            let entries = entries.value.as_deref().unwrap_or_default();
            let known = calls::CallContext {
                spaces: &spaces,
                namespaces: &namespaces,
                variables: &variables,
                server: &server,
                servers: &servers,
            };
            calls::check(entries, known, &mut types, findings)
        }
        None => Vec::new(),
    };
    let entries = document.servers.as_ref();
    servers::alone(&servers, &variables, &calls, entries, findings);
    let found = (document.server.as_ref(), server.find_skills.as_ref());
    finding::alone(found, &servers, (&variables, &calls), findings);
    let groups = document.security.as_ref();
    let groups = groups
        .and_then(|at| at.value.as_deref())
        .unwrap_or_default();
    let security = security::check(groups, &server, findings);
    let mapping = Mapping::new(pubsub, spaces.known, namespaces.known, server, variables);
    *used = types.used();
    let mapping = mapping
        .with_servers(servers.known)
        .with_calls(calls)
        .with_security(security)
        .with_patterns(patterns)
        .with_type_paths(paths);
    security::left_open(&mapping, &document, findings);
    nodesets::check(&document, &mapping, &named, around, findings);
    let minded_by_all = findings.errors().iter().any(Vec::is_empty);
    if let Some(environment) = around.environment()
        && !minded_by_all
        && document.has_all_of(&mapping)
    {
        environment::check(&document, &mapping, environment, findings);
    }
    mapping
}

impl Document {
    /// Returns `true` if the mapping contains each entry of the document.
    fn has_all_of(&self, mapping: &Mapping) -> bool {
        fn count<T>(entries: &OptionalKey<Vec<T>>) -> usize {
            let entries = entries.as_ref().and_then(|at| at.value.as_ref());
            entries.map_or(0, Vec::len)
        }
        count(&self.variables) == mapping.variables().len()
            && count(&self.patterns) == mapping.patterns().len()
            && count(&self.calls) == mapping.calls().len()
    }
}

/// Maximum number of entries of `type_paths`.
const MAX_TYPE_PATHS: usize = 256;

/// Declarations of a document.
struct Declared<T> {
    known: T,
    /// Some entry was faulty, so a name that is missing here may be the name of that entry.
    partial: bool,
}

/// Returns the value of a key that has no default; notes a missing key. `owner` is the position of
/// the map's beginning.
fn required<'d, T>(
    field: &'d OptionalKey<T>,
    key: &str,
    of: &str,
    owner: TextSpan,
    findings: &mut MappingFindings,
) -> Option<(&'d T, TextSpan)> {
    match field {
        Some(at) => Some((at.value.as_ref()?, at.place)),
        None => {
            let message = format!("{of} has no `{key}`");
            findings.error(Code::MissingKey, owner, message);
            None
        }
    }
}
