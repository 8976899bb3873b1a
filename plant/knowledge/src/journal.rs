//! The journal of the lasting sources: a file to which each change is appended before it is
//! acknowledged.
//!
//! An entry is a line with the length and the CRC-32 of its contents, and the contents: the records
//! of one change, each a line with its operation, followed by statements as N-Triples. A program
//! that is killed may leave an incomplete entry at the end, which was not acknowledged. The file is
//! written anew when most of its contents are outdated.

use std::collections::{BTreeMap, HashSet};
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead as _, BufReader, BufWriter, Read as _, Seek as _, SeekFrom, Write};
use std::path::{Path, PathBuf};

use mtp::escaped;
use oxigraph::io::{RdfFormat, RdfParser};
use oxigraph::model::{Literal, Term, Triple};

use crate::source::{KnowledgeSource, SourceKind};
use crate::vocabulary;
use crate::writing::GraphChange;

/// An entry of the journal.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Record<'a> {
    /// A source with all its statements.
    Put {
        source: &'a KnowledgeSource,
        at: u64,
        triples: &'a HashSet<Triple>,
    },
    /// A change of a source.
    Change {
        source: &'a KnowledgeSource,
        at: u64,
        change: &'a GraphChange,
    },
    /// The removal of a source.
    Remove { source: &'a KnowledgeSource },
}

/// A restored source.
#[derive(Debug, Default)]
pub(crate) struct Restored {
    pub(crate) triples: HashSet<Triple>,
    /// Time of its first addition.
    pub(crate) at: u64,
}

/// The contents of a journal.
#[derive(Debug, Default)]
pub(crate) struct Contents {
    pub(crate) graphs: BTreeMap<KnowledgeSource, Restored>,
    /// Number of bytes that could not be read.
    pub(crate) damaged: u64,
    /// Whether some records are outdated by later ones.
    is_outdated: bool,
}

/// An open journal.
#[derive(Debug)]
pub(crate) struct Journal {
    folder: PathBuf,
    file: File,
    /// Length of the file in bytes.
    length: u64,
    /// Length after the last rewriting of the file.
    compact: u64,
    /// Held while the program uses the folder.
    _lock: File,
}

impl Journal {
    /// Opens the journal of a folder, and reads it. Contents behind the first incomplete record are
    /// moved to a file of their own.
    ///
    /// # Errors
    /// Fails if the folder cannot be read or written, or is in use.
    pub(crate) fn open(folder: &Path) -> io::Result<(Self, Contents)> {
        fs::create_dir_all(folder)?;
        let lock = OpenOptions::new()
            .create(true)
            .truncate(false)
            .write(true)
            .open(folder.join("lock"))?;
        lock.try_lock().map_err(|error| {
            let why = format!("{} is in use by another program: {error}", folder.display());
            io::Error::new(io::ErrorKind::ResourceBusy, why)
        })?;
        let path = folder.join(NAME);
        let mut file = OpenOptions::new()
            .create(true)
            .truncate(false)
            .read(true)
            .write(true)
            .open(&path)?;
        let whole = file.metadata()?.len();
        let (mut contents, length) = read(&file)?;
        settle(&mut contents);
        contents.damaged = whole - length;
        if contents.damaged > 0 {
            file.seek(SeekFrom::Start(length))?;
            let mut rest = OpenOptions::new()
                .create(true)
                .append(true)
                .open(folder.join(DAMAGED))?;
            io::copy(&mut file, &mut rest)?;
            rest.sync_all()?;
            file.set_len(length)?;
            file.sync_all()?;
        }
        let mut journal = Self {
            folder: folder.to_owned(),
            file,
            length,
            compact: length,
            _lock: lock,
        };
        if contents.is_outdated {
            journal.write_anew(&contents.graphs)?;
        }
        Ok((journal, contents))
    }

    /// Appends records, and returns when they are on the disk.
    ///
    /// # Errors
    /// Fails if the disk is full or broken; then the journal is as before.
    pub(crate) fn append(&mut self, records: &[Record<'_>]) -> io::Result<()> {
        if records.is_empty() {
            return Ok(());
        }
        let mut bytes = Vec::new();
        encode(records, &mut bytes)?;
        self.file.seek(SeekFrom::Start(self.length))?;
        let written = self
            .file
            .write_all(&bytes)
            .and_then(|()| self.file.sync_data());
        if let Err(error) = written {
            // An incomplete record would hide all later ones.
            self.file.set_len(self.length)?;
            return Err(error);
        }
        self.length += u64::try_from(bytes.len()).unwrap_or(u64::MAX);
        if self.length > self.compact.saturating_mul(2).saturating_add(SLACK)
            && let Err(error) = self.shrink()
        {
            // The records are on the disk.
            tracing::warn!(%error, "cannot rewrite the journal");
            self.compact = self.length;
        }
        Ok(())
    }

    /// Rewrites the file from its own contents.
    fn shrink(&mut self) -> io::Result<()> {
        self.file.seek(SeekFrom::Start(0))?;
        let (contents, length) = read(&self.file)?;
        if length != self.length {
            let why = "the journal cannot be read to its end";
            return Err(io::Error::new(io::ErrorKind::InvalidData, why));
        }
        self.write_anew(&contents.graphs)
    }

    /// Writes a new file without outdated records, and replaces the old one.
    fn write_anew(&mut self, graphs: &BTreeMap<KnowledgeSource, Restored>) -> io::Result<()> {
        let new = self.folder.join(NEW);
        let mut file = OpenOptions::new()
            .create(true)
            .truncate(true)
            .read(true)
            .write(true)
            .open(&new)?;
        let mut writer = BufWriter::new(&file);
        for (source, graph) in graphs {
            let record = Record::Put {
                source,
                at: graph.at,
                triples: &graph.triples,
            };
            encode(&[record], &mut writer)?;
        }
        writer.flush()?;
        drop(writer);
        file.sync_all()?;
        let length = file.stream_position()?;
        fs::rename(&new, self.folder.join(NAME))?;
        // The old file has no name any longer.
        self.length = length;
        self.compact = length;
        self.file = file;
        File::open(&self.folder)?.sync_all()
    }
}

/// Writes an entry.
fn encode(records: &[Record<'_>], to: &mut impl Write) -> io::Result<()> {
    let mut contents = String::new();
    for record in records {
        let statements = record.statements();
        let (operation, source, at, removed) = match record {
            Record::Put { source, at, .. } => ("put", source, *at, 0),
            Record::Change { source, at, change } => ("change", source, *at, change.removed.len()),
            Record::Remove { source } => ("remove", source, 0, 0),
        };
        let (kind, name, size) = (source.kind, escaped(&source.name), statements.len());
        contents.push_str(&format!(
            "{operation} {kind} {at} {removed} {size} {name}\n"
        ));
        contents.push_str(&statements);
    }
    let bytes = contents.as_bytes();
    writeln!(to, "{MARK} {} {:08x}", bytes.len(), crc32fast::hash(bytes))?;
    to.write_all(bytes)
}

impl Record<'_> {
    /// Returns the statements as N-Triples.
    fn statements(&self) -> String {
        let mut text = String::new();
        let line = |triple: &Triple| {
            text.push_str(&triple.to_string());
            text.push_str(" .\n");
        };
        match self {
            Self::Put { triples, .. } => triples.iter().for_each(line),
            Self::Change { change, .. } => {
                change.removed.iter().chain(&change.added).for_each(line);
            }
            Self::Remove { .. } => {}
        }
        text
    }
}

/// Ends the runs that were interrupted by the end of the program, and removes the oldest runs.
fn settle(contents: &mut Contents) {
    let graphs = &mut contents.graphs;
    let mut runs: Vec<(u64, KnowledgeSource)> = Vec::new();
    for (source, graph) in graphs.iter_mut() {
        if source.kind != SourceKind::Run {
            continue;
        }
        runs.push((graph.at, source.clone()));
        let is_running = |triple: &Triple| {
            triple.predicate.as_str() == vocabulary::OUTCOME
                && matches!(&triple.object, Term::Literal(outcome) if outcome.value() == "running")
        };
        let running: Vec<Triple> = graph
            .triples
            .iter()
            .filter(|triple| is_running(triple))
            .cloned()
            .collect();
        for triple in running {
            contents.is_outdated = true;
            graph.triples.remove(&triple);
            let outcome = Literal::new_simple_literal("unknown");
            graph.triples.insert(Triple {
                object: outcome.into(),
                ..triple
            });
        }
    }
    runs.sort_unstable();
    let old = runs.len().saturating_sub(MOST_RUNS);
    for (_, source) in runs.into_iter().take(old) {
        contents.is_outdated = true;
        graphs.remove(&source);
    }
}

/// Reads all complete records. Returns the contents, and the length of the records.
fn read(file: &File) -> io::Result<(Contents, u64)> {
    let mut reader = BufReader::new(file);
    let mut contents = Contents::default();
    let mut length = 0;
    let mut head = String::new();
    loop {
        head.clear();
        let begin = (&mut reader).take(LONGEST_HEAD).read_line(&mut head);
        let size = match begin {
            Ok(0) => return Ok((contents, length)),
            Ok(_) => measured(&head),
            // A damaged file may not be UTF-8.
            Err(error) if error.kind() == io::ErrorKind::InvalidData => None,
            Err(error) => return Err(error),
        };
        let Some((size, sum)) = size else {
            return Ok((contents, length));
        };
        let mut bytes = Vec::new();
        (&mut reader).take(size).read_to_end(&mut bytes)?;
        let is_whole = u64::try_from(bytes.len()) == Ok(size) && crc32fast::hash(&bytes) == sum;
        if !is_whole || take(&mut contents, &bytes).is_none() {
            return Ok((contents, length));
        }
        length += size + u64::try_from(head.len()).unwrap_or(u64::MAX);
    }
}

/// Returns the length and the checksum of a record.
fn measured(head: &str) -> Option<(u64, u32)> {
    let (length, sum) = head
        .strip_suffix('\n')?
        .strip_prefix(MARK)?
        .trim_start()
        .split_once(' ')?;
    Some((length.parse().ok()?, u32::from_str_radix(sum, 16).ok()?))
}

/// Applies the records of an entry; `None` if they have another format.
fn take(contents: &mut Contents, mut entry: &[u8]) -> Option<()> {
    let graphs = &mut contents.graphs;
    while !entry.is_empty() {
        let end = entry.iter().position(|byte| *byte == b'\n')?;
        let (head, rest) = entry.split_at_checked(end + 1)?;
        let head = std::str::from_utf8(head).ok()?.trim_end_matches('\n');
        let [operation, kind, at, removed, size, name] =
            head.splitn(6, ' ').collect::<Vec<_>>().try_into().ok()?;
        let (statements, rest) = rest.split_at_checked(size.parse().ok()?)?;
        entry = rest;
        let kind: SourceKind = kind.parse().ok()?;
        let source = KnowledgeSource::new(kind, &uri_text::unescaped(name)?);
        let (at, removed): (u64, usize) = (at.parse().ok()?, removed.parse().ok()?);
        let triples = RdfParser::from_format(RdfFormat::NTriples).for_slice(statements);
        let mut triples = triples.map(|quad| quad.map(Triple::from).ok());
        contents.is_outdated |= operation != "put" || graphs.contains_key(&source);
        match operation {
            "put" => {
                let at = graphs.get(&source).map_or(at, |known| known.at);
                let triples = triples.collect::<Option<_>>()?;
                graphs.insert(source, Restored { triples, at });
            }
            "change" => {
                let first = Restored {
                    at,
                    ..Restored::default()
                };
                let graph = graphs.entry(source).or_insert(first);
                for triple in triples.by_ref().take(removed) {
                    graph.triples.remove(&triple?);
                }
                for triple in triples {
                    graph.triples.insert(triple?);
                }
            }
            "remove" => drop(graphs.remove(&source)),
            _ => return None,
        }
    }
    Some(())
}

const NAME: &str = "knowledge.journal";
const NEW: &str = "knowledge.journal.new";
const DAMAGED: &str = "knowledge.journal.damaged";
const MARK: &str = "UA1";
const LONGEST_HEAD: u64 = 64;
const MOST_RUNS: usize = 100;
/// Outdated bytes that are kept until the file is written anew.
const SLACK: u64 = 64 << 20;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::UNNAMED;
    use crate::store::{Knowledge, SourceLifetime};
    use crate::test_folder;

    fn triple(subject: usize) -> Triple {
        let node = |text: String| oxigraph::model::NamedNode::new(text).unwrap();
        let object = Literal::from(i64::try_from(subject).unwrap());
        Triple::new(
            node(format!("urn:s{subject}")),
            node("urn:p".into()),
            object,
        )
    }

    fn graph() -> KnowledgeSource {
        KnowledgeSource::new(SourceKind::Graph, UNNAMED)
    }

    fn add(knowledge: &Knowledge, subject: usize) {
        let mut writer = knowledge.writer();
        let mut writing = writer.begin().unwrap();
        let change = GraphChange {
            added: vec![triple(subject)],
            removed: Vec::new(),
        };
        assert_eq!(writing.change(&graph(), change).unwrap(), 1);
        writing.commit(7).unwrap();
    }

    #[test]
    fn a_statement_that_is_added_and_removed_in_one_change_leaves_the_others() {
        let folder = test_folder("journal-undone");
        {
            let (knowledge, _) = Knowledge::open(&folder).unwrap();
            add(&knowledge, 0);
            let mut writer = knowledge.writer();
            let mut writing = writer.begin().unwrap();
            for (added, removed) in [(vec![triple(1)], vec![]), (vec![], vec![triple(1)])] {
                writing
                    .change(&graph(), GraphChange { added, removed })
                    .unwrap();
            }
            writing.commit(8).unwrap();
        }
        let (knowledge, damaged) = Knowledge::open(&folder).unwrap();
        assert_eq!(damaged, 0);
        let mut sources = knowledge.sources().into_iter();
        let kept = sources.find(|status| status.graph == UNNAMED).unwrap();
        assert_eq!(kept.statements, 1);
    }

    #[test]
    fn a_journal_that_is_cut_at_any_byte_loses_nothing_that_was_acknowledged() {
        let folder = test_folder("journal-cut");
        let path = folder.join(NAME);
        let mut lengths = Vec::new();
        {
            let (knowledge, _) = Knowledge::open(&folder).unwrap();
            for subject in 0..5 {
                add(&knowledge, subject);
                lengths.push(fs::metadata(&path).unwrap().len());
            }
        }
        let bytes = fs::read(&path).unwrap();
        let is_near = |cut: usize| {
            let at = u64::try_from(cut).unwrap();
            lengths.iter().any(|length| length.abs_diff(at) <= 1)
        };
        for cut in (0..=bytes.len()).filter(|cut| cut % 17 == 0 || is_near(*cut)) {
            let other = test_folder("journal-cut-copy");
            fs::write(other.join(NAME), &bytes[..cut]).unwrap();
            let (knowledge, damaged) = Knowledge::open(&other).unwrap();
            let at = u64::try_from(cut).unwrap();
            let acknowledged = lengths.iter().filter(|length| **length <= at).count();
            let status = knowledge.sources();
            let known = status.iter().find(|status| status.graph == UNNAMED);
            assert_eq!(known.map_or(0, |known| known.statements), acknowledged);
            let complete = lengths.iter().rev().find(|length| **length <= at);
            assert_eq!(damaged, at - complete.copied().unwrap_or(0));
            // What is written after a cut is there the next time.
            add(&knowledge, 100);
            drop(knowledge);
            let (knowledge, damaged) = Knowledge::open(&other).unwrap();
            assert_eq!(damaged, 0);
            let status = knowledge.sources();
            let known = status.iter().find(|status| status.graph == UNNAMED);
            assert_eq!(known.unwrap().statements, acknowledged + 1);
        }
    }

    #[test]
    fn a_literal_that_is_not_canonical_is_removed_for_good() {
        let folder = test_folder("journal-canonical");
        {
            let (knowledge, _) = Knowledge::open(&folder).unwrap();
            let source = KnowledgeSource::new(SourceKind::Graph, "urn:g");
            let put = |turtle| knowledge.take_turtle(&source, turtle, 1).unwrap();
            put("<urn:a> <urn:p> 02 , 2 , 3 .");
            let token = oxigraph::sparql::CancellationToken::new();
            let run = |text| {
                let update = crate::update::read(text).unwrap();
                knowledge.update(&update, &token, 2).unwrap().changed
            };
            assert_eq!(
                run("INSERT DATA { GRAPH <urn:g> { <urn:a> <urn:p> 002 , 04 } }"),
                1
            );
            assert_eq!(
                run("DELETE DATA { GRAPH <urn:g> { <urn:a> <urn:p> 2 , 4 } }"),
                2
            );
        }
        let (knowledge, _) = Knowledge::open(&folder).unwrap();
        let sources = knowledge.sources();
        assert_eq!(
            sources
                .iter()
                .map(|source| source.statements)
                .sum::<usize>(),
            1
        );
    }

    #[test]
    fn a_byte_that_changed_sets_the_rest_of_the_journal_aside() {
        let folder = test_folder("journal-byte");
        {
            let (knowledge, _) = Knowledge::open(&folder).unwrap();
            (0..3).for_each(|subject| add(&knowledge, subject));
        }
        let path = folder.join(NAME);
        let mut bytes = fs::read(&path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0xff;
        fs::write(&path, &bytes).unwrap();
        let (knowledge, damaged) = Knowledge::open(&folder).unwrap();
        assert!(damaged > 0);
        assert_eq!(
            fs::metadata(folder.join(DAMAGED)).unwrap().len(),
            damaged,
            "the rest is kept in a file"
        );
        let status = knowledge.sources();
        assert_eq!(
            status
                .iter()
                .find(|status| status.graph == UNNAMED)
                .unwrap()
                .statements,
            1
        );
    }

    #[test]
    fn lasting_sources_come_back_and_others_do_not() {
        let folder = test_folder("journal-lasting");
        let statement = |object: &str| {
            vec![mtp::Triple {
                subject: "urn:run".into(),
                predicate: vocabulary::OUTCOME.into(),
                object: mtp::Object::Text(object.into()),
            }]
        };
        let run = KnowledgeSource::new(SourceKind::Run, "a run: 100 % \u{fc}");
        let gone = KnowledgeSource::new(SourceKind::Graph, "urn:gone");
        {
            let (knowledge, _) = Knowledge::open(&folder).unwrap();
            let lasting = |source, object| {
                let statements = statement(object);
                let replaced =
                    knowledge.replace_with(source, &statements, (5, SourceLifetime::Yes));
                replaced.unwrap();
            };
            lasting(&run, "done");
            lasting(&run, "running");
            lasting(&gone, "x");
            assert!(knowledge.remove(&gone).unwrap());
            let component = KnowledgeSource::new(SourceKind::Component, "urn:component");
            knowledge.replace(&component, &statement("y"), 6).unwrap();
            assert!(Knowledge::open(&folder).is_err(), "the folder is in use");
        }
        let (knowledge, _) = Knowledge::open(&folder).unwrap();
        let all = knowledge.sources();
        let all: Vec<_> = all
            .iter()
            .filter(|status| status.kind != SourceKind::Derived)
            .map(|status| (status.name.as_str(), status.statements, status.since_ms))
            .collect();
        assert_eq!(all, [(run.name.as_str(), 1, 5)]);
        let mut quads = Vec::new();
        knowledge.write_quads(None, &mut quads).unwrap();
        // A run whose program ended has an unknown outcome.
        assert!(String::from_utf8(quads).unwrap().contains("\"unknown\""));
    }
}
