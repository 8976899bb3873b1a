//! `cargo xtask mtp2` and `cargo xtask rml`: judges by programs that need environments of their
//! own.

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

/// The folders of the published cases of RML with XML sources.
const RML_CASES: [&str; 2] = ["rml-test-cases", "rml-io"];

/// Installs morph-kgc, builds the programs, and counts the published cases of RML that
/// `ua-space rml` and morph-kgc pass.
///
/// # Errors
/// Returns an error if the cases are missing, morph-kgc cannot be installed, or the programs cannot
/// be built.
pub(crate) fn rml(workspace: &Workspace) -> anyhow::Result<CommandOutcome> {
    let data = std::env::var_os("UA_DATA").map_or_else(
        || workspace.root.join("../shared/data"),
        std::path::PathBuf::from,
    );
    let cases = data.join("rml");
    anyhow::ensure!(
        cases.is_dir(),
        "the cases of RML are missing in {}: UA_DATA names the folder of the data",
        cases.display()
    );
    let python = peers::morph_kgc(workspace)?;
    demo::build(workspace)?;
    let mut ended = CommandOutcome::WELL;
    for suite in RML_CASES {
        step(&format!("running {suite} with ua-space and morph-kgc"));
        let mut judge = Command::new(&python);
        judge
            .arg(workspace.root.join("tests/peers/rml_judge.py"))
            .arg(workspace.target.join("debug/ua-space"))
            .arg(cases.join(suite));
        let outcome = CommandOutcome::from(status(&mut judge)?);
        if outcome != CommandOutcome::WELL {
            ended = outcome;
        }
    }
    Ok(ended)
}
