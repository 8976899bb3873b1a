//! `cargo xtask mtp2`: judges MTP 2.0 by MTPPy2.0.

use std::process::Command;

use crate::{
    demo, peers,
    shell::{CommandOutcome, status, step},
    workspace::Workspace,
};

/// Installs MTPPy2.0, builds the programs, and runs the judge of modules of MTP 2.0.
///
/// # Errors
/// Returns an error if Python 3.13 is missing, or the programs cannot be built.
pub(crate) fn run(workspace: &Workspace) -> anyhow::Result<CommandOutcome> {
    let python = peers::mtppy2(workspace)?;
    demo::build(workspace)?;
    step("reading and running a module of MTP 2.0 with MTPPy2.0");
    let mut judge = Command::new(python);
    judge
        .arg(workspace.root.join("tests/peers/mtppy2_judge.py"))
        .arg("--binaries")
        .arg(workspace.target.join("debug"))
        .arg("--manifest")
        .arg(workspace.root.join("tests/data/mtp/column.aml"));
    Ok(status(&mut judge)?.into())
}
