//! The paths of the workspace.

use std::{env, ffi::OsString, path::PathBuf, process::Command};

use anyhow::{Context as _, ensure};
use serde_json::Value;

/// The profile of shipped programs and whole-program measurements, and the name of its folder below
/// `target`.
pub(crate) const SHIPPED: &str = "shipped";

/// The paths of this workspace.
pub(crate) struct Workspace {
    pub(crate) root: PathBuf,
    /// The target directory of cargo, as configured by the user.
    pub(crate) target: PathBuf,
}

impl Workspace {
    /// Queries the paths from cargo.
    ///
    /// # Errors
    /// Returns an error if `cargo metadata` fails.
    pub(crate) fn find() -> anyhow::Result<Self> {
        let output = Command::new(cargo_program())
            .args(["metadata", "--no-deps", "--format-version", "1", "--locked"])
            .output()
            .context("cargo does not start")?;
        ensure!(
            output.status.success(),
            "cargo metadata: {}",
            String::from_utf8_lossy(&output.stderr)
        );
        let metadata: Value = serde_json::from_slice(&output.stdout)?;
        let path = |key: &str| {
            let text = metadata.get(key).and_then(Value::as_str);
            text.map(PathBuf::from)
                .with_context(|| format!("cargo metadata has no {key}"))
        };
        Ok(Self {
            root: path("workspace_root")?,
            target: path("target_directory")?,
        })
    }

    /// Returns the folder of a crate that has a benchmark of its own.
    pub(crate) fn folder(&self, of: &str) -> PathBuf {
        let below = ["ros", "space"].map(|folder| self.root.join(folder).join(of));
        let found = below.into_iter().find(|folder| folder.is_dir());
        found.unwrap_or_else(|| self.root.join(of))
    }

    /// Returns the folder into which the peers of the tests are installed.
    pub(crate) fn peers(&self) -> PathBuf {
        self.target.join("peers")
    }

    /// Returns a command of cargo in the root.
    ///
    /// `cargo run`, which starts this program, sets variables that describe this package. Build
    /// scripts, for example of `ring`, run again if these variables change, so a cargo started by
    /// hand would build half of the workspace again.
    pub(crate) fn cargo(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(cargo_program());
        for (name, _) in env::vars_os() {
            let text = name.to_string_lossy();
            if text.starts_with("CARGO_PKG_") || text.starts_with("CARGO_MANIFEST_") {
                command.env_remove(&name);
            }
        }
        command.current_dir(&self.root).args(arguments);
        command
    }
}

fn cargo_program() -> OsString {
    env::var_os("CARGO").unwrap_or_else(|| "cargo".into())
}
