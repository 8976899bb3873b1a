//! Patched crates: the published sources with the patches of `patches/NAME-VERSION/`, combined
//! under `target/`.
//!
//! Cargo builds with these folders through its configuration key `paths`. A `[patch]` table, in the
//! manifest or in the configuration, would rewrite `Cargo.lock`, which `--locked` refuses. `paths`
//! does not change `Cargo.lock`, because a path override may change the source of a package but not
//! its dependencies.

use std::{
    env,
    ffi::OsString,
    fs,
    io::ErrorKind,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context as _, bail, ensure};
use serde_json::Value;

use crate::{
    shell::{CommandOutcome, line, step, succeeds},
    workspace::Workspace,
};

/// All patched sources, ready for builds.
pub(crate) struct Patched {
    sources: Vec<PatchedCrate>,
    features: [&'static str; 2],
}

impl Patched {
    /// Updates the patched sources. A file is written only if its contents change, because cargo
    /// checks modification times.
    ///
    /// # Errors
    /// Returns an error if the crate of a patch is not in Cargo.lock, a patch does not apply, or a
    /// folder cannot be written.
    pub(crate) fn prepare(workspace: &Workspace) -> anyhow::Result<Self> {
        let features = features();
        if !features.concat().contains("security") {
            step(
                "OpenSSL is not there (libssl-dev, pkg-config): bridge-ros2 is built without DDS Security",
            );
        }
        let published = Published::all(workspace)?;
        let sources = subfolders(&workspace.root.join("patches"))?
            .iter()
            .map(|folder| PatchedCrate::prepare(workspace, folder, &published))
            .collect::<anyhow::Result<_>>()?;
        Ok(Self { sources, features })
    }

    pub(crate) fn sources(&self) -> &[PatchedCrate] {
        &self.sources
    }

    /// Returns a command of cargo that compiles with the patched sources, in the root of the
    /// workspace. The verb, such as `build`, comes first in `arguments`, and `bridge-ros2` must be
    /// among the packages.
    ///
    /// All builds and tests use this command, because other flags would make cargo build everything
    /// again.
    pub(crate) fn cargo(&self, workspace: &Workspace, arguments: &[&str]) -> Command {
        let mut command = workspace.cargo(&[]);
        let (verb, rest) = arguments.split_at(1.min(arguments.len()));
        // The configuration follows the verb, because cargo does not pass earlier arguments to an
        // external verb such as clippy.
        command
            .args(verb)
            .args(self.configuration())
            .args(self.features)
            .args(rest);
        command
    }

    fn configuration(&self) -> [OsString; 2] {
        let folders = self.sources.iter().map(|source| &source.folder);
        let folders: Value = folders.map(|folder| folder.display().to_string()).collect();
        // A JSON array of strings is a TOML array of strings.
        ["--config".into(), format!("paths={folders}").into()]
    }
}

/// A patched crate.
pub(crate) struct PatchedCrate {
    /// `NAME-VERSION`.
    name: String,
    folder: PathBuf,
    /// Names of the tests that the patches add.
    tests: Vec<String>,
}

impl PatchedCrate {
    fn prepare(
        workspace: &Workspace,
        patches: &Path,
        published: &[Published],
    ) -> anyhow::Result<Self> {
        let name = patches.file_name().unwrap_or_default().to_string_lossy();
        let name = name.into_owned();
        let published = published.iter().find(|published| published.name == name);
        let published = published.with_context(|| {
            format!(
                "Cargo.lock does not have what {} is for. Bring the patches over to the version that it has, or take \
                 that version: cargo update -p NAME --precise VERSION",
                patches.display()
            )
        })?;
        let patches = Patches::read(patches)?;
        let patched = workspace.target.join("patched");
        let source = Self {
            folder: patched.join(&name),
            tests: patches.tests(),
            name,
        };
        let stamp = patched.join(format!("{}.made-of", source.name));
        let made_of = patches.text(&published.folder);
        let folder = &source.folder;
        if folder.is_dir() && fs::read_to_string(&stamp).is_ok_and(|text| text == made_of) {
            return Ok(source);
        }
        step(&format!(
            "patching {} into {}",
            source.name,
            folder.display()
        ));
        let new = patched.join(format!("{}.new", source.name));
        remove(&stamp)?;
        remove(&new)?;
        copy(&published.folder, &new)?;
        patches.apply(&new)?;
        renew(&new, folder)?;
        remove(&new)?;
        fs::write(&stamp, made_of).with_context(|| stamp.display().to_string())?;
        Ok(source)
    }

    /// Returns `NAME-VERSION`.
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// Returns a command of cargo that builds the unit tests of the patched source outside of the
    /// workspace, with the other patched sources on which it depends.
    pub(crate) fn build_of_own_tests(&self, workspace: &Workspace, patched: &Patched) -> Command {
        let mut command = workspace.cargo(&["test", "--no-run", "--lib", "--locked"]);
        // The tests of this crate use all its encodings, and do not compile without them.
        if self.name.starts_with("async-opcua-types-") {
            command.arg("--all-features");
        }
        command
            .args(patched.configuration())
            .arg("--manifest-path")
            .arg(self.folder.join("Cargo.toml"))
            .arg("--target-dir")
            .arg(workspace.target.join("patched/tests"))
            .env("CARGO_PROFILE_DEV_DEBUG", "0");
        command
    }

    /// Returns the names of the tests that the patches add.
    pub(crate) fn tests(&self) -> &[String] {
        &self.tests
    }
}

/// Returns the features of `bridge-ros2` that need the patched sources. `security` links OpenSSL.
/// Without OpenSSL it is left out, so the demo runs anywhere. CI never leaves it out, because its
/// tests need it.
fn features() -> [&'static str; 2] {
    let is_there = env::var_os("OPENSSL_DIR").is_some()
        || succeeds("pkg-config", &["--exists", "openssl"])
        || env::var_os("CI").is_some_and(|ci| ci == "true");
    let features = if is_there {
        "bridge-ros2/patched-dds,bridge-ros2/security"
    } else {
        "bridge-ros2/patched-dds"
    };
    ["--features", features]
}

/// Prepares the sources and prints the command for manual builds.
pub(crate) fn run(workspace: &Workspace) -> anyhow::Result<CommandOutcome> {
    let patched = Patched::prepare(workspace)?;
    let [config, paths] = patched.configuration();
    println!(
        "cargo build {} '{}' {}",
        config.display(),
        paths.display(),
        patched.features.join(" ")
    );
    Ok(CommandOutcome::WELL)
}

/// A published crate.
struct Published {
    /// `NAME-VERSION`.
    name: String,
    folder: PathBuf,
}

impl Published {
    /// Returns all locked crates from cargo, which fetches missing crates.
    fn all(workspace: &Workspace) -> anyhow::Result<Vec<Self>> {
        let mut command = workspace.cargo(&[
            "metadata",
            "--format-version",
            "1",
            "--locked",
            // Without this flag cargo also fetches crates of other platforms.
            "--filter-platform",
        ]);
        let output = command
            .arg(host()?)
            .output()
            .context("cargo does not start")?;
        ensure!(
            output.status.success(),
            "cargo metadata: {}",
            String::from_utf8_lossy(&output.stderr)
        );
        let metadata: Value = serde_json::from_slice(&output.stdout)?;
        let packages = metadata.get("packages").and_then(Value::as_array);
        let text = |package: &Value, key: &str| Some(package.get(key)?.as_str()?.to_owned());
        let published = packages.into_iter().flatten().filter_map(|package| {
            let manifest = PathBuf::from(text(package, "manifest_path")?);
            Some(Self {
                name: format!("{}-{}", text(package, "name")?, text(package, "version")?),
                folder: manifest.parent()?.to_owned(),
            })
        });
        Ok(published.collect())
    }
}

/// Returns the host triple of rustc.
fn host() -> anyhow::Result<String> {
    let rustc = env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let output = Command::new(rustc)
        .arg("-vV")
        .output()
        .context("rustc does not start")?;
    let version = String::from_utf8(output.stdout)?;
    let host = version.lines().find_map(|line| line.strip_prefix("host: "));
    host.map(str::to_owned)
        .context("rustc -vV does not name the host")
}

/// The patches of a crate, in order.
struct Patches(Vec<(PathBuf, String)>);

impl Patches {
    fn read(folder: &Path) -> anyhow::Result<Self> {
        let mut patches = Vec::new();
        for entry in fs::read_dir(folder)? {
            let path = entry?.path();
            if path.extension().is_some_and(|ending| ending == "patch") {
                let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
                patches.push((path, text));
            }
        }
        patches.sort();
        ensure!(!patches.is_empty(), "{} holds no *.patch", folder.display());
        Ok(Self(patches))
    }

    /// Returns the text of all inputs of the patched source.
    fn text(&self, published: &Path) -> String {
        let texts: String = self.0.iter().map(|(_, text)| text.as_str()).collect();
        format!("{}\n{texts}", published.display())
    }

    /// Returns the functions after each added `#[test]`.
    fn tests(&self) -> Vec<String> {
        let mut tests = Vec::new();
        for (_, text) in &self.0 {
            let mut is_test = false;
            for line in text.lines() {
                let added = line.strip_prefix('+');
                // The attribute may belong to the next test of the published source, which a patch
                // shows as unchanged.
                let Some(source) = added.or_else(|| line.strip_prefix(' ')) else {
                    continue;
                };
                let source = source.trim();
                let name = source
                    .strip_prefix("fn ")
                    .and_then(|rest| rest.split('(').next());
                match name {
                    Some(name) if is_test && added.is_some() => tests.push(name.to_owned()),
                    _ => {}
                }
                is_test = source == "#[test]" || is_test && name.is_none();
            }
        }
        tests
    }

    fn apply(&self, folder: &Path) -> anyhow::Result<()> {
        for (path, _) in &self.0 {
            let mut git = Command::new("git");
            git.current_dir(folder)
                .args(["apply", "--whitespace=nowarn"])
                .arg(path)
                // In a repository git would resolve the paths from its root and skip them as
                // foreign.
                .env_remove("GIT_DIR")
                .env("GIT_CEILING_DIRECTORIES", folder.parent().unwrap_or(folder));
            let output = git
                .output()
                .context("git, which applies the patches, does not start")?;
            if !output.status.success() {
                bail!(
                    "{} does not apply to the published source: {}({})",
                    path.display(),
                    String::from_utf8_lossy(&output.stderr),
                    line(&git)
                );
            }
        }
        Ok(())
    }
}

/// Returns the subfolders in the order of their names.
fn subfolders(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut folders = Vec::new();
    for entry in fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let path = entry?.path();
        if path.is_dir() {
            folders.push(path);
        }
    }
    folders.sort();
    Ok(folders)
}

fn remove(path: &Path) -> anyhow::Result<()> {
    let removed = if path.is_dir() {
        fs::remove_dir_all(path)
    } else {
        fs::remove_file(path)
    };
    match removed {
        Err(error) if error.kind() != ErrorKind::NotFound => {
            Err(error).with_context(|| format!("{} cannot be removed", path.display()))
        }
        _ => Ok(()),
    }
}

fn copy(from: &Path, to: &Path) -> anyhow::Result<()> {
    fs::create_dir_all(to).with_context(|| to.display().to_string())?;
    for entry in fs::read_dir(from).with_context(|| from.display().to_string())? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            copy(&entry.path(), &target)?;
        } else {
            // Only the contents are copied, because a registry may keep its files read-only.
            let contents =
                fs::read(entry.path()).with_context(|| entry.path().display().to_string())?;
            fs::write(&target, contents).with_context(|| target.display().to_string())?;
        }
    }
    Ok(())
}

/// Gives `old` the contents of `new`. Unchanged files keep their modification times.
fn renew(new: &Path, old: &Path) -> anyhow::Result<()> {
    fs::create_dir_all(old).with_context(|| old.display().to_string())?;
    for entry in fs::read_dir(old).with_context(|| old.display().to_string())? {
        let entry = entry?;
        let same = fs::symlink_metadata(new.join(entry.file_name()));
        if !same.is_ok_and(|same| same.is_dir() == entry.path().is_dir()) {
            remove(&entry.path())?;
        }
    }
    for entry in fs::read_dir(new).with_context(|| new.display().to_string())? {
        let (new, old) = {
            let entry = entry?;
            (entry.path(), old.join(entry.file_name()))
        };
        if new.is_dir() {
            renew(&new, &old)?;
            continue;
        }
        let contents = fs::read(&new).with_context(|| new.display().to_string())?;
        if !fs::read(&old).is_ok_and(|known| known == contents) {
            fs::write(&old, contents).with_context(|| old.display().to_string())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_with_the_same_contents_keep_their_times() {
        let folder = env::temp_dir().join(format!("xtask-patches-{}", std::process::id()));
        let (new, old) = (folder.join("new"), folder.join("old"));
        for (file, text) in [
            ("new/src/same.rs", "same"),
            ("new/src/other.rs", "new"),
            ("new/src/added.rs", "added"),
            ("old/src/same.rs", "same"),
            ("old/src/other.rs", "old"),
            ("old/src/gone.rs", "gone"),
            ("old/gone/file.rs", "gone"),
        ] {
            let file = folder.join(file);
            fs::create_dir_all(file.parent().unwrap()).unwrap();
            fs::write(file, text).unwrap();
        }
        let same = old.join("src/same.rs");
        let before = std::time::SystemTime::UNIX_EPOCH;
        let file = fs::File::options().write(true).open(&same).unwrap();
        file.set_modified(before).unwrap();
        renew(&new, &old).unwrap();
        let modified = fs::metadata(&same).unwrap().modified().unwrap();
        assert_eq!(modified, before);
        let text = |name: &str| fs::read_to_string(old.join("src").join(name)).unwrap();
        assert_eq!(
            (text("other.rs"), text("added.rs")),
            ("new".to_owned(), "added".to_owned())
        );
        assert!(!old.join("src/gone.rs").exists() && !old.join("gone").exists());
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn the_tests_that_patches_add_are_found() {
        let text = "\
 fn before() {}
+  fn helper() {}
+  #[test]
+  #[allow(dead_code)]
+  fn a_first_one() {
+    let inner = 1;
+  }
+  #[test]
+  fn a_second_one() -> io::Result<()> {
-  #[test]
-  fn gone() {
   #[test]
+  fn a_third_one() {
+  }
+
+  #[test]
   fn as_published() {
";
        let patches = Patches(vec![("0001.patch".into(), text.to_owned())]);
        assert_eq!(
            patches.tests(),
            ["a_first_one", "a_second_one", "a_third_one"]
        );
    }
}
