//! What has been found so far.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::sync::Arc;

use crate::code::Code;
use crate::diagnostic::{Diagnostic, Severity, Span};
use crate::key_text::without_keys;
use crate::read::short;
use crate::secret;
use crate::topic::SpaceId;
use crate::tree::Place;

/// Most findings that are kept; the rest is counted.
const MAX: usize = 200;

pub(crate) struct Findings {
    /// By the numbers their places have.
    files: Vec<Arc<str>>,
    found: Vec<(u16, Diagnostic)>,
    /// An alias brings a node, and what is wrong with it, to several places.
    seen: HashSet<(Code, Place, String)>,
    /// Values that are not there, so that nothing can be said of them.
    unknown: HashSet<Place>,
    /// Values out of the environment, which are nobody's to read, and what stands for them.
    secrets: BTreeMap<String, String>,
    /// The spaces whose part of the document is looked at.
    part: Vec<SpaceId>,
    /// By whom the errors are minded.
    errors: BTreeSet<Vec<SpaceId>>,
    left_out: usize,
}

impl Findings {
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

    /// Takes in another file and gives its number; `None` when there are too many.
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

    /// Where something is, told at another place: `line 6`, and of which file if that is another.
    pub(crate) fn line(&self, of: Place, at: Place) -> String {
        if of.file == at.file {
            format!("line {}", of.line)
        } else {
            format!("line {} of {}", of.line, self.name(of.file))
        }
    }

    /// Nothing else is said of what stands there.
    pub(crate) fn is_unknown(&mut self, place: Place) {
        self.unknown.insert(place);
    }

    /// Does not let `value` be read in what is told: `written` stands for it.
    pub(crate) fn hide(&mut self, value: String, written: String) {
        if value != written && !value.is_empty() {
            self.secrets.entry(value).or_insert(written);
        }
    }

    /// Whether a text is the value of an environment variable.
    pub(crate) fn is_hidden(&self, value: &str) -> bool {
        self.secrets.contains_key(value)
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
        let Place {
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

    /// What is found from now on about types is about those of these spaces, all together: of one host's part of the
    /// cell. Without any, everybody minds.
    pub(crate) fn of_part(&mut self, spaces: impl IntoIterator<Item = SpaceId>) {
        self.part = spaces.into_iter().collect();
        self.part.sort_unstable();
        self.part.dedup();
    }

    /// The spaces that mind the errors; of those that everybody minds there are none.
    pub(crate) const fn errors(&self) -> &BTreeSet<Vec<SpaceId>> {
        &self.errors
    }

    /// In the order of the files and their texts.
    pub(crate) fn into_sorted(mut self) -> Vec<Diagnostic> {
        self.found
            .sort_by_key(|(file, found)| (*file, found.at.line, found.at.column, found.code));
        let mut all: Vec<Diagnostic> = self.found.into_iter().map(|(_, found)| found).collect();
        // The longest first, of which another may be a part.
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
            let Place {
                line, column, len, ..
            } = Place::START;
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
            let (label, help) = (None, Some("mend the first ones and check again".to_owned()));
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

/// A text without the values in it. A short one is only taken out where it stands by itself: elsewhere it is a word like
/// another.
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

/// A text without beginnings of a value that end where the text around them was cut.
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

/// What stands where a text was cut.
const CUT: &str = "...";
/// More characters than are left of a text that was cut.
const MOST_CUT: usize = 256;
/// From so many bytes on a value does not occur in a finding by chance.
const TELLING: usize = 8;

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
