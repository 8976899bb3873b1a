//! `cargo xtask lint`: everything that can be said of the code without running it.

use std::{
    ffi::OsString,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use anyhow::Context as _;

use crate::{
    patches::Patched,
    shell::{Ended, line, run as must, status, step, succeeds},
    workspace::Workspace,
};

const DENY: &str = "0.20.2";
/// The advisory database is a few megabytes; a network that takes longer has it not.
const FETCH: Duration = Duration::from_secs(120);

/// Runs all checks, so that one run shows everything there is to mend.
pub(crate) fn run(workspace: &Workspace) -> anyhow::Result<Ended> {
    let patched = Patched::prepare(workspace)?;
    let mut failed = Vec::new();
    let mut check = |what: &str, command: &mut Command| -> anyhow::Result<()> {
        step(what);
        if !status(command)?.success() {
            failed.push(line(command));
        }
        Ok(())
    };
    check(
        "formatting",
        &mut workspace.cargo(&["fmt", "--all", "--check"]),
    )?;
    check(
        "clippy",
        &mut patched.cargo(
            workspace,
            &[
                "clippy",
                "--workspace",
                "--all-targets",
                "--locked",
                "--",
                "-D",
                "warnings",
            ],
        ),
    )?;
    check(
        "the workspace with all crates as published",
        // As clippy is run above, and with examples, which need what tests need: so nothing is checked twice that is the same.
        &mut workspace.cargo(&[
            "clippy",
            "--workspace",
            "--lib",
            "--bins",
            "--examples",
            "--locked",
            "--",
            "-D",
            "warnings",
        ]),
    )?;
    check(
        "documentation",
        patched
            .cargo(workspace, &["doc", "--workspace", "--no-deps", "--locked"])
            .env("RUSTDOCFLAGS", "-D warnings"),
    )?;
    let deny = Deny::find(workspace)?;
    check(
        "licences, sources and duplicates of dependencies",
        &mut deny.command(
            workspace,
            &[
                "check",
                "--hide-inclusion-graph",
                "bans",
                "licenses",
                "sources",
            ],
        ),
    )?;
    match deny.fetch(workspace)? {
        Ok(()) => check(
            "advisories",
            &mut deny.command(workspace, &["check", "--disable-fetch", "advisories"]),
        )?,
        Err(why) => step(&format!("advisories: skipped, {why}")),
    }

    if failed.is_empty() {
        step("nothing to mend");
        return Ok(Ended::WELL);
    }
    for command in failed {
        eprintln!("xtask: failed: {command}");
    }
    Ok(Ended::BADLY)
}

/// cargo-deny, wherever it is.
struct Deny(OsString);

impl Deny {
    /// The one in PATH, or else one of our own, built once.
    fn find(workspace: &Workspace) -> anyhow::Result<Self> {
        if succeeds("cargo-deny", &["--version"]) {
            return Ok(Self("cargo-deny".into()));
        }
        let folder = workspace.target.join("tools");
        let program = folder.join("bin/cargo-deny");
        if !program.is_file() {
            step(&format!(
                "building cargo-deny {DENY} into {} (some minutes, once)",
                folder.display()
            ));
            let build = folder.join("build");
            must(
                workspace
                    .cargo(&[
                        "install",
                        "--locked",
                        // It runs for seconds and is built in a third of the time.
                        "--debug",
                        &format!("cargo-deny@{DENY}"),
                        "--root",
                    ])
                    .arg(&folder)
                    .arg("--target-dir")
                    .arg(&build),
            )?;
            std::fs::remove_dir_all(&build)
                .with_context(|| format!("{} cannot be removed", build.display()))?;
        }
        Ok(Self(program.into()))
    }

    fn command(&self, workspace: &Workspace, arguments: &[&str]) -> Command {
        let mut command = Command::new(&self.0);
        command
            .current_dir(&workspace.root)
            .arg("--locked")
            .args(arguments);
        command
    }

    /// Brings the advisory database up to date, or says why that is not possible here.
    fn fetch(&self, workspace: &Workspace) -> anyhow::Result<Result<(), String>> {
        step("fetching the advisory database");
        let child = self
            .command(workspace, &["fetch", "db"])
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .context("cargo-deny does not start")?;
        wait(child)
    }
}

#[expect(
    clippy::disallowed_methods,
    reason = "a command line waits for another program in real time"
)]
fn wait(mut child: Child) -> anyhow::Result<Result<(), String>> {
    let start = Instant::now();
    while start.elapsed() < FETCH {
        match child.try_wait()? {
            Some(status) if status.success() => return Ok(Ok(())),
            Some(_) => return Ok(Err("the database cannot be fetched here".to_owned())),
            None => std::thread::sleep(Duration::from_millis(100)),
        }
    }
    child.kill()?;
    child.wait()?;
    Ok(Err(format!("the database did not come within {FETCH:?}")))
}
