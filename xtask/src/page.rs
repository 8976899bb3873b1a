//! `cargo xtask page`: drives the page of the cell in a browser.

use std::process::Command;

use crate::{
    demo, peers,
    shell::{CommandOutcome, status, step},
    workspace::Workspace,
};

/// Installs Chromium, builds the programs, and runs the judge of the page. The screenshots are in
/// `target/page`.
///
/// # Errors
/// Returns an error if Chromium cannot be installed or the programs cannot be built.
pub(crate) fn run(workspace: &Workspace) -> anyhow::Result<CommandOutcome> {
    let browser = peers::browser(workspace)?;
    demo::build(workspace)?;
    step("driving the page in Chromium");
    let mut judge = Command::new(browser.python);
    judge
        .arg(workspace.root.join("tests/peers/page_judge.py"))
        .arg("--binaries")
        .arg(workspace.target.join("debug"))
        .arg("--examples")
        .arg(workspace.root.join("examples/plant"))
        .arg("--axe")
        .arg(browser.axe)
        .arg("--validator")
        .arg(browser.validator)
        .arg("--out")
        .arg(workspace.target.join("page"));
    Ok(status(&mut judge)?.into())
}
