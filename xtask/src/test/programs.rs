//! The test programs that cargo builds, and their tests.

use std::{
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use anyhow::{Context as _, bail, ensure};
use serde_json::Value;

use crate::{namespace::NamespacePermission, shell::line};

/// An executable with tests.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct TestProgram {
    pub(super) package: String,
    /// The name of the target: `router` for `tests/router.rs`.
    pub(super) name: String,
    executable: PathBuf,
    /// The folder of the package, which is the working directory of its tests.
    folder: PathBuf,
}

/// Runs a build command of cargo and returns the built programs with tests.
///
/// # Errors
/// Returns an error if cargo does not start or fails; the reason is on stderr.
pub(super) fn build(mut cargo: Command) -> anyhow::Result<Vec<TestProgram>> {
    let output = cargo
        .arg("--message-format=json-render-diagnostics")
        .stderr(Stdio::inherit())
        .output()
        .context("cargo does not start")?;
    if !output.status.success() {
        bail!("{} ended with {}", line(&cargo), output.status);
    }
    String::from_utf8_lossy(&output.stdout)
        .lines()
        .filter_map(|message| TestProgram::of(message).transpose())
        .collect()
}

impl TestProgram {
    /// Parses a message of cargo; `None` for messages about other things than test programs.
    fn of(message: &str) -> anyhow::Result<Option<Self>> {
        let message: Value = serde_json::from_str(message)
            .with_context(|| format!("cargo said something that is not JSON: {message}"))?;
        let at = |place: &str| message.pointer(place);
        let text = |place: &str| at(place).and_then(Value::as_str);
        let is_test = at("/profile/test") == Some(&Value::Bool(true));
        let Some(executable) = text("/executable").filter(|_| is_test) else {
            return Ok(None);
        };
        let manifest = text("/manifest_path").context("a program without manifest")?;
        let folder = Path::new(manifest)
            .parent()
            .context("a manifest without folder")?;
        let id = text("/package_id").unwrap_or_default();
        let name = text("/target/name").context("a program without name")?;
        Ok(Some(Self {
            package: package(id, folder),
            name: name.to_owned(),
            executable: executable.into(),
            folder: folder.to_owned(),
        }))
    }

    /// Returns the package, and the target if it has another name.
    pub(super) fn label(&self) -> String {
        let stem = self.executable.file_stem().unwrap_or_default();
        let stem = stem.to_string_lossy();
        let name = stem.rsplit_once('-').map_or(&*stem, |(name, _hash)| name);
        match name.replace('_', "-") == self.package {
            true => self.package.clone(),
            false => format!("{} {name}", self.package),
        }
    }

    /// Returns a command that runs the program as `cargo test` does.
    pub(super) fn command(&self, namespaces: NamespacePermission) -> Command {
        self.at_home(namespaces.command(&self.executable))
    }

    /// Like `command`, in a network of its own.
    pub(super) fn alone(&self, namespaces: NamespacePermission) -> Command {
        self.at_home(namespaces.alone(&self.executable))
    }

    fn at_home(&self, mut command: Command) -> Command {
        command
            .current_dir(&self.folder)
            .env("CARGO_MANIFEST_DIR", &self.folder);
        command
    }

    /// Returns the names of its tests that contain one of the filters, or all names without
    /// filters.
    ///
    /// # Errors
    /// Returns an error if the program does not list its tests.
    pub(super) fn tests(&self, filters: &[&str]) -> anyhow::Result<Vec<String>> {
        let output = Command::new(&self.executable)
            .current_dir(&self.folder)
            .args(["--list", "--format", "terse"])
            .args(filters)
            .output()
            .with_context(|| format!("{} does not start", self.executable.display()))?;
        ensure!(
            output.status.success(),
            "{} --list ended with {}",
            self.executable.display(),
            output.status
        );
        Ok(String::from_utf8_lossy(&output.stdout)
            .lines()
            .filter_map(|line| line.strip_suffix(": test").map(str::to_owned))
            .collect())
    }
}

/// Returns the name in `path+file:///..#name@version`. Cargo omits the name if it equals the name
/// of the folder.
fn package(id: &str, folder: &Path) -> String {
    let fragment = id.rsplit_once('#').map(|(_, fragment)| fragment);
    match fragment.and_then(|fragment| fragment.split_once('@')) {
        Some((name, _version)) => name.to_owned(),
        None => {
            let name = folder.file_name().unwrap_or_default();
            name.to_string_lossy().into_owned()
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn message(id: &str, test: bool) -> String {
        json!({
            "reason": "compiler-artifact",
            "package_id": id,
            "manifest_path": "/w/tests/Cargo.toml",
            "target": {"name": "rate", "kind": ["test"]},
            "profile": {"test": test},
            "executable": "/w/target/debug/deps/rate-0123456789abcdef",
        })
        .to_string()
    }

    #[test]
    fn a_program_with_tests_is_known_by_cargos_message() {
        let named = message("path+file:///w/tests#system-tests@0.1.0", true);
        let program = TestProgram::of(&named).unwrap().unwrap();
        assert_eq!(
            (&*program.package, &*program.name),
            ("system-tests", "rate")
        );
        assert_eq!(program.label(), "system-tests rate");
        let unnamed = message("path+file:///w/tests#0.1.0", true);
        assert_eq!(TestProgram::of(&unnamed).unwrap().unwrap().package, "tests");
    }

    #[test]
    fn what_has_no_tests_is_no_test_program() {
        let program = message("path+file:///w/tests#system-tests@0.1.0", false);
        assert_eq!(TestProgram::of(&program).unwrap(), None);
        let other = json!({"reason": "build-finished", "success": true}).to_string();
        assert_eq!(TestProgram::of(&other).unwrap(), None);
    }
}
