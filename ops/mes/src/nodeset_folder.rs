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
    /// The limit that it exceeds.
    exceeded: Option<FolderLimit>,
    /// The files and folders that cannot be read.
    unread: BTreeMap<PathBuf, String>,
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
    /// Reads the models of all NodeSets in a folder. Files that cannot be read remain as in
    /// `earlier`, if it is the same folder.
    ///
    /// # Errors
    /// The folder that cannot be read, and the reason.
    pub(crate) fn read(path: &Path, earlier: Option<&Self>) -> Result<Self, String> {
        let mut scan = FolderScan::of(MOST_FILES, MOST_ENTRIES);
        scan.folder(path, DEEPEST)
            .map_err(|error| format!("cannot read the folder {}: {error}", path.display()))?;
        let mut all = Vec::new();
        for path in scan.files {
            match beginning(&path) {
                // Other XML files have no model.
                Ok(text) => all.extend(
                    nodeset::read_model(&text)
                        .ok()
                        .map(|model| FolderNodeSet { path, model }),
                ),
                Err(error) => drop(scan.unread.insert(path, error.to_string())),
            }
        }
        let earlier = earlier.filter(|earlier| earlier.path == path);
        let earlier = earlier
            .into_iter()
            .flat_map(|one| one.by_namespace.values());
        let is_unread = |file: &&FolderNodeSet| {
            let mut folders = file.path.ancestors();
            folders.any(|folder| scan.unread.contains_key(folder))
        };
        all.extend(earlier.flatten().filter(is_unread).cloned());
        Ok(Self {
            exceeded: scan.exceeded,
            unread: scan.unread,
            ..Self::of(path, all)
        })
    }

    /// Returns its path.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    fn of(path: &Path, all: Vec<FolderNodeSet>) -> Self {
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
            ..Self::default()
        }
    }

    /// Returns the findings about the folder itself.
    pub(crate) fn findings(&self) -> Vec<String> {
        let shown = self.path.display();
        let exceeded = self.exceeded.map(|limit| {
            let limit = match limit {
                FolderLimit::Files(most) => format!("{most} XML files"),
                FolderLimit::Entries(most) => format!("{most} entries"),
            };
            format!(
                "the folder {shown} has more than {limit}, with those of its folders; the others \
                 are ignored"
            )
        });
        let unread = self.unread.first_key_value().map(|(path, error)| {
            let (number, path) = (self.unread.len(), path.display());
            format!(
                "{number} files or folders of {shown} cannot be read, {path} among them: {error}"
            )
        });
        exceeded.into_iter().chain(unread).collect()
    }

    /// Completes a NodeSet with all that it requires, directly and indirectly. `known` has the
    /// models that are there without the folder, by their namespaces. `take` reads a file and
    /// returns whether it could be read; otherwise the next older file of the namespace is tried.
    /// If no file of a namespace can be read, its newest file is in the result.
    pub(crate) fn complete(
        &self,
        of: &NodeSetModel,
        known: &BTreeMap<String, ModelVersion>,
        take: &mut dyn FnMut(&FolderNodeSet) -> bool,
    ) -> NodeSetCompletion {
        let mut completion = NodeSetCompletion::default();
        let mut taken: BTreeMap<&str, Option<&FolderNodeSet>> = BTreeMap::new();
        let mut missing: BTreeSet<String> = BTreeSet::new();
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
                if *namespace == of.namespace {
                    continue;
                }
                let Some((namespace, all)) = self.by_namespace.get_key_value(namespace) else {
                    if missing.insert(namespace.clone()) {
                        completion.findings.push(format!(
                            "{by} requires {namespace}, and {shown} has no NodeSet of it; add its file"
                        ));
                    }
                    continue;
                };
                let file = *taken.entry(namespace.as_str()).or_insert_with(|| {
                    let file = all.iter().find(|file| take(file)).or_else(|| all.first());
                    completion.files.extend(file.cloned());
                    file
                });
                let Some(file) = file.filter(|file| file.model.version.is_older_than(version))
                else {
                    continue;
                };
                let (has, file) = (&file.model.version, file.path.display());
                completion.findings.push(format!(
                    "{by} requires {namespace} in the {requires} or newer, and the newest in {shown} \
                     is the {has} ({file}); add a newer file"
                ));
            }
            let Some(file) = completion.files.get(next) else {
                return completion;
            };
            current = file.model.clone();
            next = next.saturating_add(1);
        }
    }
}

/// A limit of a folder and of its folders.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FolderLimit {
    /// The number of XML files.
    Files(usize),
    /// The number of files and folders.
    Entries(usize),
}

/// Finds the XML files of a folder and of its folders.
#[derive(Debug)]
struct FolderScan {
    most_files: usize,
    most_entries: usize,
    entries: usize,
    files: BTreeSet<PathBuf>,
    /// The files without links.
    resolved: BTreeSet<PathBuf>,
    unread: BTreeMap<PathBuf, String>,
    exceeded: Option<FolderLimit>,
}

impl FolderScan {
    fn of(most_files: usize, most_entries: usize) -> Self {
        Self {
            most_files,
            most_entries,
            entries: 0,
            files: BTreeSet::new(),
            resolved: BTreeSet::new(),
            unread: BTreeMap::new(),
            exceeded: None,
        }
    }

    /// Adds the files of a folder. Links to files are followed, links to folders are not: they may
    /// lead anywhere, or back.
    fn folder(&mut self, folder: &Path, depth: usize) -> io::Result<()> {
        let mut entries = Vec::new();
        for entry in fs::read_dir(folder)? {
            if self.entries >= self.most_entries {
                self.exceeded = Some(FolderLimit::Entries(self.most_entries));
                break;
            }
            self.entries = self.entries.saturating_add(1);
            entries.push(entry?.path());
        }
        entries.sort();
        for path in entries {
            // A file that was removed in between, or a broken link.
            let (Ok(own), Ok(about)) = (fs::symlink_metadata(&path), fs::metadata(&path)) else {
                continue;
            };
            let is_xml = path
                .extension()
                .is_some_and(|end| end.eq_ignore_ascii_case("xml"));
            if own.is_dir() && depth > 0 {
                if let Err(error) = self.folder(&path, depth - 1) {
                    self.unread.insert(path, error.to_string());
                }
            } else if about.is_file() && is_xml {
                let resolved = fs::canonicalize(&path).unwrap_or_else(|_| path.clone());
                if self.resolved.contains(&resolved) {
                    continue;
                }
                if self.files.len() >= self.most_files {
                    self.exceeded = Some(FolderLimit::Files(self.most_files));
                    return Ok(());
                }
                self.resolved.insert(resolved);
                self.files.insert(path);
            }
        }
        Ok(())
    }
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
/// Maximum number of XML files of a folder and of its folders.
const MOST_FILES: usize = 2_000;
/// Maximum number of files and folders in a folder and in its folders.
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
        NodeSetFolder::of(Path::new("sets"), files.collect())
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
        let completion = folder.complete(&robotics, &BTreeMap::new(), &mut |_| true);
        assert_eq!(paths(&completion), ["3.xml", "1.xml"], "the newest of each");
        assert!(completion.findings.is_empty(), "{completion:?}");
        let known = BTreeMap::from([("di".to_owned(), version("2022-01-01"))]);
        let completion = folder.complete(&robotics, &known, &mut |_| true);
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
        let completion = folder.complete(&robotics, &BTreeMap::new(), &mut |_| true);
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
        let completion = folder.complete(&robotics, &known, &mut |_| true);
        assert!(completion.findings[0].contains("the given NodeSet has the version of 2020"));
    }

    #[test]
    fn an_older_file_replaces_a_file_that_cannot_be_read() {
        let robotics = model("robotics", "", &[("di", "2021-01-01"), ("core", "")]);
        let folder = folder(&[
            model("di", "2022-01-01", &[("ia", "")]),
            model("di", "2020-01-01", &[("core", "")]),
            model("core", "2023-01-01", &[]),
        ]);
        let mut tried = Vec::new();
        let completion = folder.complete(&robotics, &BTreeMap::new(), &mut |file| {
            tried.push(file.path.clone());
            file.path != Path::new("1.xml")
        });
        assert_eq!(paths(&completion), ["2.xml", "3.xml"]);
        assert_eq!(tried, ["1.xml", "2.xml", "3.xml"].map(PathBuf::from));
        let [older] = completion.findings.as_slice() else {
            panic!("{completion:?}")
        };
        assert!(older.contains("is the version of 2020-01-01"), "{older}");
        let completion = folder.complete(&robotics, &BTreeMap::new(), &mut |_| false);
        assert_eq!(
            paths(&completion),
            ["1.xml", "3.xml"],
            "the newest, whose earlier contents remain"
        );
    }

    /// Creates an empty folder that is named for a test.
    fn empty(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("{name}-{}", std::process::id()));
        drop(fs::remove_dir_all(&folder));
        fs::create_dir_all(&folder).unwrap();
        folder
    }

    #[test]
    fn the_limits_of_a_folder_hold_for_all_its_folders() {
        let folder = empty("nodeset-limits");
        for file in ["1.xml", "a/2.xml", "b/3.XML", "b/note.txt"] {
            let path = folder.join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        }
        // Three files, a text and two folders.
        for (most_files, most_entries, exceeded) in [
            (3, 6, None),
            (2, 6, Some(FolderLimit::Files(2))),
            (3, 5, Some(FolderLimit::Entries(5))),
        ] {
            let mut scan = FolderScan::of(most_files, most_entries);
            scan.folder(&folder, DEEPEST).unwrap();
            assert_eq!(scan.exceeded, exceeded);
        }
        let exceeded = NodeSetFolder {
            exceeded: Some(FolderLimit::Entries(5)),
            ..NodeSetFolder::default()
        };
        assert!(exceeded.findings()[0].contains("more than 5 entries"));
        drop(fs::remove_dir_all(&folder));
    }

    #[cfg(unix)]
    #[test]
    fn a_linked_file_is_one_file_and_a_linked_folder_is_not_read() {
        use std::os::unix::fs::symlink;
        let folder = empty("nodeset-links");
        let outside = empty("nodeset-outside");
        for path in [
            folder.join("a.xml"),
            outside.join("b.xml"),
            outside.join("c.xml"),
        ] {
            fs::write(path, "").unwrap();
        }
        symlink(folder.join("a.xml"), folder.join("again.xml")).unwrap();
        symlink(outside.join("b.xml"), folder.join("other.xml")).unwrap();
        symlink(&outside, folder.join("outside")).unwrap();
        symlink(&folder, folder.join("loop")).unwrap();
        let mut scan = FolderScan::of(2, 5);
        scan.folder(&folder, DEEPEST).unwrap();
        let files = ["a.xml", "other.xml"].map(|name| folder.join(name));
        assert_eq!(scan.files, BTreeSet::from(files));
        assert_eq!(scan.exceeded, None);
        for folder in [folder, outside] {
            drop(fs::remove_dir_all(&folder));
        }
    }
}
