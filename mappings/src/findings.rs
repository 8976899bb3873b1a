//! Collection of findings.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::sync::Arc;

use crate::code::Code;
use crate::diagnostic::{Diagnostic, Severity, Span};
use crate::key_text::without_keys;
use crate::secret;
use crate::topic::SpaceId;
use crate::tree::TextSpan;

/// Maximum number of findings that are kept; further findings are counted.
const MAX: usize = 200;

pub(crate) struct MappingFindings {
    /// Names of the files, by the file numbers of positions.
    files: Vec<Arc<str>>,
    found: Vec<(u16, Diagnostic)>,
    /// Findings that exist already: an alias puts a node and its faults into several positions.
    seen: HashSet<(Code, TextSpan, String)>,
    /// Positions of values that are unknown, so that nothing is reported about them.
    unknown: HashSet<TextSpan>,
    /// Values from the environment, which are secret, and the texts that are shown instead.
    secrets: BTreeMap<String, String>,
    /// Spaces of the part of the document that is being checked.
    part: Vec<SpaceId>,
    /// Spaces that each error concerns.
    errors: BTreeSet<Vec<SpaceId>>,
    left_out: usize,
}

impl MappingFindings {
    pub(crate) fn new(file: &str) -> Self {
        Self {
            files: vec![file.into()],
            found: Vec::new(),
            seen: HashSet::new(),
            unknown: HashSet::new(),
            secrets: BTreeMap::new(),
            part: Vec::new(),
            errors: BTreeSet::new(),
            left_out: 0,
        }
    }

    /// Adds a file and returns its number; `None` if there are too many files.
    pub(crate) fn file(&mut self, name: &str) -> Option<u16> {
        let number = u16::try_from(self.files.len()).ok()?;
        self.files.push(name.into());
        Some(number)
    }

    pub(crate) fn name(&self, file: u16) -> Arc<str> {
        self.files
            .get(usize::from(file))
            .cloned()
            .unwrap_or_default()
    }

    /// Returns the line of a position, seen from another position: `line 6`, with the file name if
    /// the files differ.
    pub(crate) fn line(&self, of: TextSpan, at: TextSpan) -> String {
        if of.file == at.file {
            format!("line {}", of.line)
        } else {
            format!("line {} of {}", of.line, self.name(of.file))
        }
    }

    /// Suppresses other findings about the position.
    pub(crate) fn is_unknown(&mut self, place: TextSpan) {
        self.unknown.insert(place);
    }

    /// Hides `value` in all findings: they show `written` instead.
    pub(crate) fn hide(&mut self, value: String, written: String) {
        if value != written && !value.is_empty() {
            self.secrets.entry(value).or_insert(written);
        }
    }

    /// Returns `true` if a text is the value of an environment variable.
    pub(crate) fn is_hidden(&self, value: &str) -> bool {
        self.secrets.contains_key(value)
    }

    /// Adds an error. Label and help may be added to it until the next finding.
    pub(crate) fn error(
        &mut self,
        code: Code,
        place: TextSpan,
        message: impl Into<String>,
    ) -> Note<'_> {
        self.push(code, Severity::Error, place, message.into())
    }

    pub(crate) fn warning(
        &mut self,
        code: Code,
        place: TextSpan,
        message: impl Into<String>,
    ) -> Note<'_> {
        self.push(code, Severity::Warning, place, message.into())
    }

    fn push(
        &mut self,
        code: Code,
        severity: Severity,
        place: TextSpan,
        message: String,
    ) -> Note<'_> {
        let needed_by = if severity == Severity::Error && code.lies_in_definitions() {
            self.part.clone()
        } else {
            Vec::new()
        };
        if severity == Severity::Error && !self.errors.contains(&needed_by) {
            self.errors.insert(needed_by.clone());
        }
        if self.unknown.contains(&place) {
            return Note(None);
        }
        if self.found.len() >= MAX {
            self.left_out += 1;
            return Note(None);
        }
        if !self.seen.insert((code, place, message.clone())) {
            return Note(None);
        }
        let TextSpan {
            file,
            line,
            column,
            len,
        } = place;
        let at = Span {
            file: self.name(file),
            line,
            column,
            len,
        };
        let found = Diagnostic {
            code,
            severity,
            at,
            message,
            label: None,
            help: None,
            needed_by,
        };
        self.found.push((file, found));
        Note(self.found.last_mut().map(|(_, found)| found))
    }

    /// Sets the spaces that the next findings about types concern, all of them together: the spaces
    /// of one host's part of the cell. Without spaces, the findings concern every program.
    pub(crate) fn of_part(&mut self, spaces: impl IntoIterator<Item = SpaceId>) {
        self.part = spaces.into_iter().collect();
        self.part.sort_unstable();
        self.part.dedup();
    }

    /// Returns the spaces that each error concerns; an entry without spaces is an error for every
    /// program.
    pub(crate) const fn errors(&self) -> &BTreeSet<Vec<SpaceId>> {
        &self.errors
    }

    /// Returns the findings in the order of the files and their texts.
    pub(crate) fn into_sorted(mut self) -> Vec<Diagnostic> {
        self.found
            .sort_by_key(|(file, found)| (*file, found.at.line, found.at.column, found.code));
        let mut all: Vec<Diagnostic> = self.found.into_iter().map(|(_, found)| found).collect();
        // The longest value comes first, because it may contain another.
        let mut secrets: Vec<(String, String)> = self.secrets.into_iter().collect();
        secrets.sort_by_key(|(value, _)| std::cmp::Reverse(value.len()));
        for found in &mut all {
            let texts = [&mut found.label, &mut found.help];
            let texts = texts.into_iter().flatten().chain([&mut found.message]);
            for text in texts {
                let shown = hidden(text, &secrets);
                *text = without_keys(secret::masked_where_cut(&shown)).into_owned();
            }
        }
        if self.left_out > 0 {
            let message = format!("{} more findings are not shown", self.left_out);
            let TextSpan {
                line, column, len, ..
            } = TextSpan::START;
            let at = Span {
                file: self.files.into_iter().next().unwrap_or_default(),
                line,
                column,
                len,
            };
            let severity = if !self.errors.is_empty() {
                Severity::Error
            } else {
                Severity::Warning
            };
            let (label, help) = (
                None,
                Some("correct the first findings and check again".to_owned()),
            );
            all.push(Diagnostic {
                code: Code::TooLarge,
                severity,
                at,
                message,
                label,
                help,
                needed_by: Vec::new(),
            });
        }
        all
    }
}

/// Replaces the values in a text. A short value is replaced only if it stands alone: inside of
/// other text it may be an ordinary word.
fn hidden(text: &str, secrets: &[(String, String)]) -> String {
    let mut text = text.to_owned();
    for (value, written) in secrets {
        if value.len() >= TELLING {
            let cut = short(value);
            text = text.replace(value.as_str(), written).replace(&cut, written);
            text = without_beginnings(&text, value, written);
        } else {
            text = text.replace(&format!("`{value}`"), &format!("`{written}`"));
        }
    }
    text
}

/// Replaces beginnings of a value at which the text was cut.
fn without_beginnings(text: &str, value: &str, written: &str) -> String {
    let beginnings = || {
        let ends = value.char_indices().map(|(at, _)| at);
        ends.skip_while(|at| *at < TELLING)
            .take(MOST_CUT)
            .filter_map(move |at| value.get(..at))
    };
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some((before, behind)) = rest.split_once(CUT) {
        let kept = beginnings().filter_map(|beginning| before.strip_suffix(beginning));
        match kept.last() {
            Some(kept) => {
                out.push_str(kept);
                out.push_str(written);
            }
            None => out.push_str(before),
        }
        out.push_str(CUT);
        rest = behind;
    }
    out.push_str(rest);
    out
}

/// Mark at the end of a text that was cut.
const CUT: &str = "...";
/// Upper bound of the characters that are left of a text that was cut.
const MOST_CUT: usize = 256;
/// Shortest value, in bytes, that does not occur in a finding by chance.
const TELLING: usize = 8;

/// The finding that was just added; `None` if it exceeds the maximum or exists already.
pub(crate) struct Note<'f>(Option<&'f mut Diagnostic>);

impl Note<'_> {
    pub(crate) fn label(mut self, label: impl Into<String>) -> Self {
        if let Some(found) = &mut self.0 {
            found.label = Some(label.into());
        }
        self
    }

    /// Sets a help as [`Note::help`] does; the help is created only if it is needed.
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

/// Returns at most 64 characters of a text from a document.
pub(crate) fn short(text: &str) -> String {
    let mut short: String = text.chars().take(64).collect();
    if short.len() < text.len() {
        short.push_str("...");
    }
    short
}
