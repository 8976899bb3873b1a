//! NodeSets by their namespaces: the folder that the YAML names, and the NodeSets that complete
//! others from it.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use knowledge::nodeset::{self, ModelVersion, NodeSetModel};

/// The NodeSets of a folder and of its folders, by their namespaces.
#[derive(Debug, Default)]
pub(crate) struct NodeSetFolder {
    path: PathBuf,
    /// The files of a namespace, the newest first.
    by_namespace: BTreeMap<String, Vec<FolderNodeSet>>,
    /// Whether it has more files than are looked at.
    is_cut: bool,
}

/// A NodeSet of a folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct FolderNodeSet {
    pub(crate) path: PathBuf,
    pub(crate) model: NodeSetModel,
}

/// The NodeSets that complete a NodeSet.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct NodeSetCompletion {
    /// The files in the order in which they are required.
    pub(crate) files: Vec<FolderNodeSet>,
    /// The models that are missing, or are older than required.
    pub(crate) findings: Vec<String>,
}

impl NodeSetFolder {
    /// Reads the models of all NodeSets in a folder.
    ///
    /// # Errors
    /// The folder that cannot be read, and the reason.
    pub(crate) fn read(path: &Path) -> Result<Self, String> {
        let mut found = Vec::new();
        let is_cut = !xml_files(path, DEEPEST, &mut found)
            .map_err(|error| format!("cannot read the folder {}: {error}", path.display()))?;
        found.sort();
        let read = found.into_iter().filter_map(|path| {
            let text = beginning(&path).ok()?;
            // Other XML files have no model.
            let model = nodeset::read_model(&text).ok()?;
            Some(FolderNodeSet { path, model })
        });
        Ok(Self::of(path, read.collect(), is_cut))
    }

    fn of(path: &Path, all: Vec<FolderNodeSet>, is_cut: bool) -> Self {
        let mut by_namespace: BTreeMap<String, Vec<FolderNodeSet>> = BTreeMap::new();
        for one in all {
            let namespace = one.model.namespace.clone();
            let known = by_namespace.entry(namespace).or_default();
            let older =
                |known: &FolderNodeSet| known.model.version.is_older_than(&one.model.version);
            let at = known.iter().position(older).unwrap_or(known.len());
            known.insert(at, one);
        }
        Self {
            path: path.to_owned(),
            by_namespace,
            is_cut,
        }
    }

    /// Returns the finding about the folder itself.
    pub(crate) fn finding(&self) -> Option<String> {
        let shown = self.path.display();
        self.is_cut.then(|| {
            format!(
                "the folder {shown} has more than {MOST_FILES} XML files; the others are ignored"
            )
        })
    }

    /// Completes a NodeSet with all that it requires, directly and indirectly. `known` has the
    /// models that are there without the folder, by their namespaces.
    pub(crate) fn complete(
        &self,
        of: &NodeSetModel,
        known: &BTreeMap<String, ModelVersion>,
    ) -> NodeSetCompletion {
        let mut completion = NodeSetCompletion::default();
        let mut taken: BTreeSet<String> = BTreeSet::from([of.namespace.clone()]);
        let mut next = 0_usize;
        let mut current = of.clone();
        loop {
            for (namespace, version) in &current.required {
                let shown = self.path.display();
                let (by, requires) = (&current.namespace, version);
                if let Some(given) = known.get(namespace) {
                    if given.is_older_than(version) {
                        completion.findings.push(format!(
                            "{by} requires {namespace} in the {requires} or newer, and the given NodeSet \
                             has the {given}; give a newer file"
                        ));
                    }
                    continue;
                }
                let newest = self.by_namespace.get(namespace).and_then(|all| all.first());
                let Some(newest) = newest else {
                    if taken.insert(namespace.clone()) {
                        completion.findings.push(format!(
                            "{by} requires {namespace}, and {shown} has no NodeSet of it; add its file"
                        ));
                    }
                    continue;
                };
                let has = &newest.model.version;
                if has.is_older_than(version) {
                    let file = newest.path.display();
                    completion.findings.push(format!(
                        "{by} requires {namespace} in the {requires} or newer, and the newest in {shown} \
                         is the {has} ({file}); add a newer file"
                    ));
                }
                if taken.insert(namespace.clone()) {
                    completion.files.push(newest.clone());
                }
            }
            let Some(file) = completion.files.get(next) else {
                return completion;
            };
            current = file.model.clone();
            next = next.saturating_add(1);
        }
    }
}

/// Adds the XML files of a folder and of its folders. Returns whether all were added.
fn xml_files(folder: &Path, depth: usize, found: &mut Vec<PathBuf>) -> io::Result<bool> {
    let mut entries: Vec<PathBuf> = Vec::new();
    for entry in fs::read_dir(folder)?.take(MOST_ENTRIES) {
        entries.push(entry?.path());
    }
    entries.sort();
    let mut is_whole = entries.len() < MOST_ENTRIES;
    for path in entries {
        // A file that was removed in between, or a broken link.
        let Ok(about) = fs::metadata(&path) else {
            continue;
        };
        let is_xml = path
            .extension()
            .is_some_and(|end| end.eq_ignore_ascii_case("xml"));
        if about.is_dir() && depth > 0 {
            // A folder that cannot be read has no NodeSets for this user.
            is_whole &= xml_files(&path, depth - 1, found).unwrap_or(true);
        } else if about.is_file() && is_xml {
            if found.len() >= MOST_FILES {
                return Ok(false);
            }
            found.push(path);
        }
    }
    Ok(is_whole)
}

/// Reads the beginning of a file, which has the models of a NodeSet.
fn beginning(path: &Path) -> io::Result<String> {
    let mut bytes = Vec::new();
    fs::File::open(path)?
        .take(BEGINNING)
        .read_to_end(&mut bytes)?;
    Ok(match xml_text::decode(&bytes) {
        Ok(text) => text.into_owned(),
        // The end may be in the middle of a character.
        Err(_) => String::from_utf8_lossy(&bytes).into_owned(),
    })
}

/// Number of folders within folders that are looked at.
const DEEPEST: usize = 3;
const MOST_FILES: usize = 2_000;
const MOST_ENTRIES: usize = 10_000;
/// Number of bytes in which a NodeSet has its models.
const BEGINNING: u64 = 256 << 10;

#[cfg(test)]
mod tests {
    use super::*;

    fn version(date: &str) -> ModelVersion {
        ModelVersion {
            version: String::new(),
            publication_date: date.to_owned(),
        }
    }

    /// Returns a model of a date, with the models that it requires and their dates.
    fn model(namespace: &str, date: &str, required: &[(&str, &str)]) -> NodeSetModel {
        let required = required.iter();
        NodeSetModel {
            namespace: namespace.to_owned(),
            version: version(date),
            required: required
                .map(|(namespace, date)| ((*namespace).to_owned(), version(date)))
                .collect(),
        }
    }

    fn folder(all: &[NodeSetModel]) -> NodeSetFolder {
        let files = all.iter().zip(1..).map(|(model, number)| FolderNodeSet {
            path: PathBuf::from(format!("{number}.xml")),
            model: model.clone(),
        });
        NodeSetFolder::of(Path::new("sets"), files.collect(), false)
    }

    fn paths(completion: &NodeSetCompletion) -> Vec<&str> {
        let files = completion.files.iter();
        files.filter_map(|file| file.path.to_str()).collect()
    }

    #[test]
    fn a_nodeset_is_completed_with_all_that_it_requires_in_turn() {
        let robotics = model(
            "robotics",
            "2021-01-01",
            &[("di", "2019-01-01"), ("core", "")],
        );
        let folder = folder(&[
            model("core", "2023-01-01", &[]),
            model("di", "2018-01-01", &[]),
            model("di", "2022-01-01", &[("core", "2022-01-01"), ("di", "")]),
            model("other", "2022-01-01", &[("core", "")]),
        ]);
        let completion = folder.complete(&robotics, &BTreeMap::new());
        assert_eq!(paths(&completion), ["3.xml", "1.xml"], "the newest of each");
        assert!(completion.findings.is_empty(), "{completion:?}");
        let known = BTreeMap::from([("di".to_owned(), version("2022-01-01"))]);
        let completion = folder.complete(&robotics, &known);
        assert_eq!(
            paths(&completion),
            ["1.xml"],
            "a given NodeSet is not replaced"
        );
    }

    #[test]
    fn a_missing_model_and_an_older_version_are_findings() {
        let robotics = model(
            "robotics",
            "2021-01-01",
            &[("di", "2022-06-01"), ("ia", "")],
        );
        let folder = folder(&[model("di", "2019-01-01", &[("core", "")])]);
        let completion = folder.complete(&robotics, &BTreeMap::new());
        assert_eq!(
            paths(&completion),
            ["1.xml"],
            "an older version is better than none"
        );
        let [older, missing, missing_in_turn] = completion.findings.as_slice() else {
            panic!("{completion:?}")
        };
        assert!(older.contains("version of 2022-06-01 or newer"), "{older}");
        assert!(
            older.contains("is the version of 2019-01-01 (1.xml)"),
            "{older}"
        );
        assert!(missing.starts_with("robotics requires ia,"), "{missing}");
        assert!(
            missing_in_turn.starts_with("di requires core,"),
            "{missing_in_turn}"
        );
        let known = BTreeMap::from([("di".to_owned(), version("2020-01-01"))]);
        let completion = folder.complete(&robotics, &known);
        assert!(completion.findings[0].contains("the given NodeSet has the version of 2020"));
    }
}
