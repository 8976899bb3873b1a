//! A document and the files that it includes, as one document.

use std::sync::Arc;

use crate::code::Code;
use crate::document::{self, Document, PubSubForm};
use crate::findings::MappingFindings;
use crate::read::{Located, NodeReader, OptionalKey};
use crate::surroundings::{FileReaders, Surroundings, beside, fits};
use crate::tree::{self, MAX_BYTES, MAX_EXPANDED, TextSpan};

/// A text that was checked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckedText {
    /// Name of the text in findings.
    pub name: Arc<str>,
    /// Content of the file.
    pub text: String,
}

/// Reads files into one document.
pub(crate) struct Loader<'a> {
    pub(crate) around: &'a dyn Surroundings,
    pub(crate) findings: &'a mut MappingFindings,
    pub(crate) sources: Vec<CheckedText>,
    /// Files that are being read, the outermost first.
    open: Vec<String>,
    /// Files that have been read, each with the position that names it.
    read: Vec<(String, TextSpan)>,
    bytes: usize,
    /// Bytes of the values of variables in all files.
    expanded: usize,
    /// A file could not be read, so the document is incomplete.
    partial: bool,
    whole: Document,
}

impl<'a> Loader<'a> {
    pub(crate) fn new(around: &'a dyn Surroundings, findings: &'a mut MappingFindings) -> Self {
        Self {
            around,
            findings,
            sources: Vec::new(),
            open: Vec::new(),
            read: Vec::new(),
            bytes: 0,
            expanded: 0,
            partial: false,
            whole: Document::default(),
        }
    }

    /// Returns the document of the text with all files that it includes, and the texts that were
    /// read. The document is `None` if the text itself is faulty.
    pub(crate) fn load(mut self, text: &str, name: &str) -> (Option<Document>, Vec<CheckedText>) {
        // An included file may include this file in turn, by its path.
        let path = beside("", name);
        self.read.push((path.clone(), TextSpan::START));
        let read = self.add(text, name, (path, 0));
        if self.partial {
            // A declaration that is missing here may be in a file that could not be read.
            self.whole.spaces = Some(missing());
            self.whole.namespaces = Some(missing());
            self.whole.servers = Some(missing());
        }
        (read.map(|()| self.whole), self.sources)
    }

    fn add(&mut self, text: &str, name: &str, (path, file): (String, u16)) -> Option<()> {
        self.sources.push(CheckedText {
            name: name.into(),
            text: text.to_owned(),
        });
        let around = self.around;
        let tree = match tree::parse(text, file, &|name| around.variable(name)) {
            Ok(tree) => tree,
            Err(fault) => {
                self.note(fault);
                return None;
            }
        };
        for (value, written) in tree.values {
            self.findings.hide(value, written);
        }
        self.secrets(&tree.secrets, &path);
        self.expanded = self.expanded.saturating_add(tree.expanded);
        if self.expanded > MAX_EXPANDED {
            let place = TextSpan {
                file,
                ..TextSpan::START
            };
            self.note(tree::too_expanded(place));
            return None;
        }
        for fault in tree.faults {
            let place = fault.place;
            self.note(fault);
            self.findings.is_unknown(place);
        }
        let (mut document, _) = document::read(&tree.root, &mut NodeReader::new(self.findings))?;
        let includes = document.include.take();
        let type_paths = document.type_paths.as_mut();
        for Located { place, value } in type_paths
            .and_then(|at| at.value.as_mut())
            .into_iter()
            .flatten()
        {
            if value.as_ref().is_some_and(|named| named.contains("://")) {
                let note = self.findings.warning(Code::TypePath, *place, URL);
                note.help("give a folder with ROS packages, or a file, relative to the mapping; URLs are not supported");
                *value = None;
            }
            // An empty text stays empty, so that a finding reports it.
            if let Some(named) = value.as_mut().filter(|named| !named.is_empty()) {
                *named = beside(&path, named);
                if named.is_empty() {
                    named.push('.');
                }
            }
        }
        self.nodesets(&mut document, &path);
        for file in files(&mut document) {
            *file = beside(&path, file);
        }
        self.take(document);
        self.open.push(path);
        for Located { place, value } in includes.and_then(|at| at.value).map_or(Vec::new(), |i| i.0)
        {
            if let Some(named) = value {
                self.include(&named, place);
            }
        }
        self.open.pop();
        Some(())
    }

    /// Makes the paths of NodeSets relative to the folder of the file that names them.
    fn nodesets(&mut self, document: &mut Document, path: &str) {
        let server = document.server.as_mut().and_then(|at| at.value.as_mut());
        let files = server.and_then(|server| server.nodesets.as_mut()?.value.as_mut());
        for Located { place, value } in files.into_iter().flatten() {
            if value.as_ref().is_some_and(|named| named.contains("://")) {
                let note = self.findings.error(Code::NodeSet, *place, URL);
                note.help(
                    "give a path relative to the folder of this file; only local files are read",
                );
                *value = None;
            }
            // An empty text stays empty, so that a finding reports it.
            if let Some(named) = value.as_mut().filter(|named| !named.is_empty()) {
                *named = beside(path, named);
            }
        }
    }

    /// Notes passwords in a file, at the first of them.
    fn secrets(&mut self, found: &[TextSpan], path: &str) {
        let Some((place, more)) = found.split_first() else {
            return;
        };
        let here = "a password stands here in plain text";
        let message = match more.len() {
            0 => here.to_owned(),
            more => format!("{here}, and {more} more in this file"),
        };
        let readers = self.around.readers(path);
        let note = self.findings.warning(Code::Secret, *place, message);
        let apart = "write ${NAME}, and set this environment variable for the program";
        let Some(readers) = readers else {
            note.help(apart);
            return;
        };
        let (who, mode) = match readers {
            FileReaders::Group => ("the group of the file", "g-r"),
            FileReaders::Everybody => ("every user of this host", "go-r"),
        };
        let help = format!("{apart}, or restrict the file to its owner: chmod {mode} {path}");
        note.label(format!("{who} can read it")).help(help);
    }

    fn note(&mut self, fault: tree::YamlFault) {
        let note = self.findings.error(fault.code, fault.place, fault.message);
        if let Some(help) = fault.help {
            note.help(help);
        }
    }

    fn include(&mut self, named: &str, place: TextSpan) {
        if named.contains("://") {
            let note = self.findings.error(Code::Include, place, URL);
            note.help("give a path relative to the folder of this file; only local files are read");
            self.partial = true;
            return;
        }
        let from = self.open.last().cloned().unwrap_or_default();
        let (folder, last) = named.rsplit_once('/').unwrap_or(("", named));
        if folder.contains('*') {
            let message = format!("the folder of `{named}` contains `*`");
            let note = self.findings.error(Code::Include, place, message);
            note.help("only the last part of a path has wildcards, as in robots/*.yaml");
            return;
        }
        if !last.contains('*') {
            self.file(beside(&from, named), place);
            return;
        }
        let is_wanted = |name: &String| fits(last, name) && !name.starts_with('.');
        let within = beside(
            &from,
            &format!("{folder}{}", if folder.is_empty() { "." } else { "" }),
        );
        let names = match self.around.list(&within) {
            Ok(names) => names,
            Err(why) => {
                let message = format!("cannot list the files of `{named}`: {why}");
                self.findings.error(Code::Include, place, message);
                return;
            }
        };
        let mut names: Vec<String> = names.into_iter().filter(is_wanted).collect();
        if names.is_empty() {
            let message = format!("no file matches `{named}`");
            self.findings.warning(Code::Include, place, message);
        }
        names.sort();
        for name in names {
            let path = match folder {
                "" => name,
                folder => format!("{folder}/{name}"),
            };
            self.file(beside(&from, &path), place);
        }
    }

    fn file(&mut self, path: String, place: TextSpan) {
        if self.open.contains(&path) {
            let mut way: Vec<&str> = self.open.iter().map(String::as_str).collect();
            way.push(&path);
            let message = format!("`{path}` includes itself: {}", way.join(" -> "));
            self.findings.error(Code::IncludeTwice, place, message);
            return;
        }
        if let Some((_, first)) = self.read.iter().find(|(read, _)| *read == path) {
            let label = format!("first at {}", self.findings.line(*first, place));
            let message = format!("`{path}` is included twice");
            let note = self.findings.error(Code::IncludeTwice, place, message);
            note.label(label);
            return;
        }
        if self.open.len() > MAX_NESTED || self.read.len() > MAX_FILES {
            let message = format!(
                "`{path}` exceeds the limit of includes: at most {MAX_NESTED} levels and {MAX_FILES} files"
            );
            self.findings.error(Code::IncludeTwice, place, message);
            return;
        }
        let text = match self.around.read(&path) {
            Ok(text) => text,
            Err(why) => {
                let message = format!("`{path}` cannot be read: {why}");
                let note = self.findings.error(Code::Include, place, message);
                note.help("the path is relative to the folder of the file that contains it");
                self.partial = true;
                return;
            }
        };
        self.bytes = self.bytes.saturating_add(text.len());
        if self.bytes > MAX_BYTES {
            let message =
                format!("with `{path}` the included files have more than {MAX_BYTES} bytes");
            self.findings.error(Code::TooLarge, place, message);
            return;
        }
        let Some(number) = self.findings.file(&path) else {
            return;
        };
        self.read.push((path.clone(), place));
        // The reason that the file cannot be read has been noted.
        let read = self.add(&text, &path.clone(), (path, number));
        self.partial |= read.is_none();
    }

    /// Merges a file into the whole document: lists are appended, all other keys may occur once.
    fn take(&mut self, other: Document) {
        let Document {
            include: _,
            spaces,
            type_paths,
            pubsub,
            security,
            server,
            servers,
            namespaces,
            variables,
            patterns,
            calls,
        } = other;
        append(&mut self.whole.spaces, spaces);
        append(&mut self.whole.servers, servers);
        append(&mut self.whole.type_paths, type_paths);
        append(&mut self.whole.variables, variables);
        append(&mut self.whole.patterns, patterns);
        append(&mut self.whole.calls, calls);
        append(&mut self.whole.security, security);
        append(&mut self.whole.namespaces, namespaces);
        once("pubsub", &mut self.whole.pubsub, pubsub, self.findings);
        once("server", &mut self.whole.server, server, self.findings);
    }
}

/// Returns the key files and the history file that a document names. An empty path is left out, so
/// that a finding reports it.
fn files(document: &mut Document) -> impl Iterator<Item = &mut String> {
    let server = document.server.as_mut().and_then(|at| at.value.as_mut());
    let history = server.and_then(|server| server.history.as_mut()?.value.as_mut());
    let history = history.and_then(|history| history.file.as_mut()?.value.as_mut());
    let pubsub = document.pubsub.as_mut().and_then(|at| at.value.as_mut());
    let brokers = pubsub.into_iter().flat_map(PubSubForm::brokers);
    let of_broker = brokers.flat_map(|mqtt| {
        let files = [
            &mut mqtt.ca,
            &mut mqtt.certificate,
            &mut mqtt.key,
            &mut mqtt.credentials,
        ];
        files
            .into_iter()
            .filter_map(|file| file.as_mut()?.value.as_mut())
    });
    let groups = document.security.as_mut().and_then(|at| at.value.as_mut());
    let groups = groups.into_iter().flatten();
    let keys = groups.filter_map(|at| at.value.as_mut()?.keys.as_mut()?.value.as_mut());
    let keys = keys.filter_map(|keys| keys.file.as_mut()?.value.as_mut());
    let files = keys.chain(of_broker).chain(history);
    files.filter(|file| !file.is_empty())
}

/// Returns the value of a faulty entry.
const fn missing<T>() -> Located<T> {
    Located {
        place: TextSpan::START,
        value: None,
    }
}

fn append<T>(whole: &mut OptionalKey<Vec<T>>, part: OptionalKey<Vec<T>>) {
    match (whole, part) {
        (_, None) => {}
        (whole @ None, part) => *whole = part,
        (Some(whole), Some(part)) => match (&mut whole.value, part.value) {
            (Some(all), Some(more)) => all.extend(more),
            // One of the lists is faulty, so the whole list is incomplete.
            (value, _) => *value = None,
        },
    }
}

fn once<T>(
    key: &str,
    whole: &mut OptionalKey<T>,
    part: OptionalKey<T>,
    findings: &mut MappingFindings,
) {
    match (&whole, part) {
        (None, part) => *whole = part,
        (Some(_), None) => {}
        (Some(first), Some(part)) => {
            let line = findings.line(first.place, part.place);
            let message = format!("the key `{key}` is repeated");
            let note = findings.error(Code::DuplicateKey, part.place, message);
            note.label(format!("first at {line}"))
                .help("all included files are one document, in which the key occurs once");
        }
    }
}

/// Message without the URL, which may contain a password.
const URL: &str = "expected the path of a file, found a URL";
const MAX_NESTED: usize = 8;
const MAX_FILES: usize = 256;
