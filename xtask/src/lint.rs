//! `cargo xtask lint`: runs the checks that do not execute the code.

use std::{
    ffi::OsString,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use anyhow::Context as _;

use crate::{
    counts,
    patches::Patched,
    shell::{CommandOutcome, line, run as must, status, step, succeeds},
    workspace::Workspace,
};

const DENY: &str = "0.20.2";
/// Time limit of the download of the advisory database, which has a few megabytes.
const FETCH: Duration = Duration::from_secs(120);

/// Checks formatting, the width of comments, the names of types, lints and documentation. All
/// checks run, so that one run shows every finding.
///
/// # Errors
/// Returns an error if cargo cannot be started or the patched sources cannot be prepared.
pub(crate) fn run(workspace: &Workspace) -> anyhow::Result<CommandOutcome> {
    let patched = Patched::prepare(workspace)?;
    let mut checks = Checks::default();
    checks.run(
        "formatting",
        &mut workspace.cargo(&["fmt", "--all", "--check"]),
    )?;
    if !counts::have_not_risen(workspace)? {
        checks
            .failed
            .push("width of comments, names of types".to_owned());
    }
    let clippy = ["clippy", "--workspace", "--all-targets", "--locked"];
    checks.run(
        "clippy",
        patched
            .cargo(workspace, &clippy)
            .args(["--", "-D", "warnings"]),
    )?;
    // The codec must compile without the standard library. It needs no patched crate.
    let bare = ["clippy", "--package", "uadp", "--no-default-features"];
    let bare = [bare.as_slice(), &["--locked", "--", "-D", "warnings"]].concat();
    checks.run("uadp without std", &mut workspace.cargo(&bare))?;
    checks.run(
        "documentation",
        patched
            .cargo(workspace, &["doc", "--workspace", "--no-deps", "--locked"])
            .env("RUSTDOCFLAGS", "-D warnings"),
    )?;
    Ok(checks.ended())
}

/// Checks licences, sources, duplicates and advisories of the dependencies, and that the workspace
/// compiles with all crates as published, without the patches.
///
/// # Errors
/// Returns an error if cargo cannot be started or cargo-deny cannot be built.
pub(crate) fn dependencies(workspace: &Workspace) -> anyhow::Result<CommandOutcome> {
    let mut checks = Checks::default();
    let published = ["clippy", "--workspace", "--lib", "--bins", "--examples"];
    checks.run(
        "the workspace with all crates as published",
        workspace
            .cargo(&published)
            .args(["--locked", "--", "-D", "warnings"]),
    )?;
    let deny = Deny::find(workspace)?;
    let kinds = ["bans", "licenses", "sources"];
    checks.run(
        "licences, sources and duplicates of dependencies",
        deny.command(workspace, &["check", "--hide-inclusion-graph"])
            .args(kinds),
    )?;
    match deny.fetch(workspace)? {
        Ok(()) => checks.run(
            "advisories",
            &mut deny.command(workspace, &["check", "--disable-fetch", "advisories"]),
        )?,
        Err(why) => step(&format!("advisories: skipped, {why}")),
    }
    Ok(checks.ended())
}

/// The commands that failed.
#[derive(Default)]
struct Checks {
    failed: Vec<String>,
}

impl Checks {
    fn run(&mut self, title: &str, command: &mut Command) -> anyhow::Result<()> {
        step(title);
        if !status(command)?.success() {
            self.failed.push(line(command));
        }
        Ok(())
    }

    fn ended(self) -> CommandOutcome {
        for command in &self.failed {
            eprintln!("xtask: failed: {command}");
        }
        if self.failed.is_empty() {
            step("no findings");
            return CommandOutcome::WELL;
        }
        CommandOutcome::BADLY
    }
}

/// The path of cargo-deny.
struct Deny(OsString);

impl Deny {
    /// Returns cargo-deny from PATH, or builds it once.
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
                        // The program runs for seconds only, and a debug build takes a third of the
                        // time.
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

    /// Updates the advisory database, or returns the reason why it cannot be updated.
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
