//! The files of a package.

use std::{
    collections::BTreeMap,
    fs,
    io::Write as _,
    os::unix::fs::{PermissionsExt as _, symlink},
    path::Path,
    process::{Command, Stdio},
};

use anyhow::{Context as _, ensure};

/// A file, link or folder of a package.
enum Entry {
    File { contents: Vec<u8>, mode: u32 },
    Link { target: String },
    Folder { mode: u32 },
}

/// The files of a package by their paths below the root, such as `usr/bin/ua-bridge`.
#[derive(Default)]
pub(crate) struct PackageFiles {
    entries: BTreeMap<String, Entry>,
}

impl PackageFiles {
    /// Adds a file that all users can read.
    pub(crate) fn file(&mut self, path: impl Into<String>, contents: impl Into<Vec<u8>>) {
        self.with_mode(path, contents, 0o644);
    }

    /// Adds a program.
    pub(crate) fn program(&mut self, path: impl Into<String>, contents: Vec<u8>) {
        self.with_mode(path, contents, 0o755);
    }

    fn with_mode(&mut self, path: impl Into<String>, contents: impl Into<Vec<u8>>, mode: u32) {
        let contents = contents.into();
        self.entries
            .insert(path.into(), Entry::File { contents, mode });
    }

    /// Adds a compressed file; `.gz` is appended to the path.
    ///
    /// # Errors
    /// Returns an error if gzip fails.
    pub(crate) fn compressed(&mut self, path: &str, contents: &[u8]) -> anyhow::Result<()> {
        self.file(format!("{path}.gz"), gzip(contents)?);
        Ok(())
    }

    pub(crate) fn link(&mut self, path: impl Into<String>, target: impl Into<String>) {
        let target = target.into();
        self.entries.insert(path.into(), Entry::Link { target });
    }

    pub(crate) fn folder(&mut self, path: &str, mode: u32) {
        self.entries.insert(path.to_owned(), Entry::Folder { mode });
    }

    /// Returns the paths of files and links.
    pub(crate) fn files(&self) -> impl Iterator<Item = &str> {
        let entries = self.entries.iter();
        let files = entries.filter(|(_, entry)| !matches!(entry, Entry::Folder { .. }));
        files.map(|(path, _)| path.as_str())
    }

    /// Returns the paths of folders that the package owns, with their modes.
    pub(crate) fn folders(&self) -> impl Iterator<Item = (&str, u32)> {
        self.entries.iter().filter_map(|(path, entry)| match entry {
            Entry::Folder { mode } => Some((path.as_str(), *mode)),
            Entry::File { .. } | Entry::Link { .. } => None,
        })
    }

    /// Returns the files that users change, and that an upgrade keeps.
    pub(crate) fn configuration(&self) -> impl Iterator<Item = &str> {
        self.files().filter(|path| path.starts_with("etc/"))
    }

    /// Returns the size of all files in bytes.
    pub(crate) fn size(&self) -> u64 {
        let sizes = self.entries.values().map(|entry| match entry {
            Entry::File { contents, .. } => contents.len() as u64,
            Entry::Link { .. } | Entry::Folder { .. } => 0,
        });
        sizes.sum()
    }

    /// Writes the files below a folder, which is emptied first.
    ///
    /// # Errors
    /// Returns an error if a file cannot be written.
    pub(crate) fn write(&self, root: &Path) -> anyhow::Result<()> {
        if root.exists() {
            fs::remove_dir_all(root).with_context(|| root.display().to_string())?;
        }
        for (path, entry) in &self.entries {
            let path = root.join(path);
            let write = || -> std::io::Result<()> {
                fs::create_dir_all(path.parent().unwrap_or(root))?;
                match entry {
                    Entry::File { contents, mode } => {
                        fs::write(&path, contents)?;
                        fs::set_permissions(&path, fs::Permissions::from_mode(*mode))
                    }
                    Entry::Link { target } => symlink(target, &path),
                    Entry::Folder { mode } => {
                        fs::create_dir_all(&path)?;
                        fs::set_permissions(&path, fs::Permissions::from_mode(*mode))
                    }
                }
            };
            write().with_context(|| path.display().to_string())?;
        }
        Ok(())
    }
}

/// Compresses bytes. Equal bytes give equal results.
fn gzip(contents: &[u8]) -> anyhow::Result<Vec<u8>> {
    let mut gzip = Command::new("gzip")
        .args(["-9", "--no-name", "--stdout"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .context("gzip does not start")?;
    let mut input = gzip.stdin.take().context("gzip has no input")?;
    let contents = contents.to_vec();
    // A thread, because gzip writes before it has read all.
    let writing = std::thread::spawn(move || input.write_all(&contents));
    let output = gzip.wait_with_output()?;
    let written = writing
        .join()
        .map_err(|_| anyhow::anyhow!("gzip: the writer ended"))?;
    written.context("gzip")?;
    ensure!(output.status.success(), "gzip ended with {}", output.status);
    Ok(output.stdout)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_have_their_modes_and_links_their_targets() {
        let root = std::env::temp_dir().join(format!("xtask-tree-{}", std::process::id()));
        let mut tree = PackageFiles::default();
        tree.program("usr/bin/a", b"program".to_vec());
        tree.link("usr/bin/b", "a");
        tree.file("etc/a/a.conf", "x");
        tree.folder("etc/a/keys", 0o750);
        tree.compressed("usr/share/a", &vec![b'a'; 200_000])
            .unwrap();
        tree.write(&root).unwrap();
        tree.write(&root).unwrap();
        let mode =
            |path: &str| fs::metadata(root.join(path)).unwrap().permissions().mode() & 0o7777;
        assert_eq!(mode("usr/bin/a"), 0o755);
        assert_eq!(mode("etc/a/a.conf"), 0o644);
        assert_eq!(mode("etc/a/keys"), 0o750);
        assert_eq!(
            fs::read_to_string(root.join("usr/bin/b")).unwrap(),
            "program"
        );
        assert!(fs::metadata(root.join("usr/share/a.gz")).unwrap().len() < 2000);
        assert_eq!(tree.configuration().collect::<Vec<_>>(), ["etc/a/a.conf"]);
        assert_eq!(tree.folders().collect::<Vec<_>>(), [("etc/a/keys", 0o750)]);
        fs::remove_dir_all(&root).unwrap();
    }
}
