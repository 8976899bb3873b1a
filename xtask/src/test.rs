//! `cargo xtask test`: the peers, then every test there is.

use std::{
    fs,
    io::{BufRead as _, BufReader, ErrorKind},
    path::Path,
    process::{Command, Stdio},
};

use anyhow::Context as _;

use crate::{
    dds::Rustdds,
    namespace::{Namespaces, REFUSED},
    peers,
    shell::{Ended, is_ci, run as must, step},
    workspace::Workspace,
};

/// Every target of a test run. Both commands build these for the same packages, so that nothing is built twice.
const TARGETS: &[&str] = &["--workspace", "--locked"];

pub(crate) fn run(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<Ended> {
    let (options, filters): (Vec<&str>, Vec<&str>) = arguments
        .iter()
        .copied()
        .partition(|argument| argument.starts_with('-'));
    if let Some(unknown) = options.iter().find(|option| **option != "--no-install") {
        eprintln!("xtask: test takes --no-install and names of tests, not {unknown}");
        return Ok(Ended::USAGE);
    }
    if options.is_empty() {
        // What is missing skips its own tests, or fails them with CI=true; the others run.
        peers::install(workspace);
    }
    step("building the programs and the tests (some minutes the first time)");
    let built = ["--bins", "--tests", "--examples"];
    let rustdds = Rustdds::prepare(workspace)?;
    must(&mut rustdds.cargo(workspace, &[&["build"][..], TARGETS, &built].concat()))?;

    let skipped = workspace.target.join("skipped-tests.txt");
    remove(&skipped)?;
    let mut tests = command(workspace, &rustdds, &filters, &skipped);
    step("testing; tests with peers run one at a time, each in a network of its own");
    let outcome = Outcome::of(&mut tests)?;
    let reasons = match fs::read_to_string(&skipped) {
        Ok(reasons) => reasons,
        Err(error) if error.kind() == ErrorKind::NotFound => String::new(),
        Err(error) => return Err(error).with_context(|| format!("{}", skipped.display())),
    };
    for reason in reasons.lines() {
        println!("skipped: {reason}");
    }
    outcome.print(reasons.lines().count());
    Ok(outcome.ended)
}

fn command(workspace: &Workspace, rustdds: &Rustdds, filters: &[&str], skipped: &Path) -> Command {
    let namespaces = Namespaces::try_out();
    let cargo = rustdds.cargo(workspace, &[&["test"][..], TARGETS].concat());
    let mut command = namespaces.command(cargo.get_program());
    command
        .current_dir(&workspace.root)
        .args(cargo.get_args())
        .arg("--no-fail-fast")
        .arg("--")
        .args(filters)
        .env("UA_BIN_DIR", workspace.target.join("debug"))
        .env("UA_PEERS_PYTHON", peers::python(workspace))
        .env("UA_PEERS", workspace.peers())
        .env("UA_SKIPPED", skipped);
    if namespaces == Namespaces::Refused {
        eprintln!("xtask: {REFUSED}");
        if is_ci() {
            eprintln!("xtask: with CI=true no test is skipped, so the system tests fail");
        }
        command.env("UA_NO_NETWORK", REFUSED);
    }
    command
}

fn remove(file: &Path) -> anyhow::Result<()> {
    match fs::remove_file(file) {
        Err(error) if error.kind() != ErrorKind::NotFound => {
            Err(error).with_context(|| format!("{} cannot be removed", file.display()))
        }
        _ => Ok(()),
    }
}

/// What the test programs said of themselves, summed.
struct Outcome {
    ended: Ended,
    programs: usize,
    passed: u64,
    failed: u64,
    ignored: u64,
}

impl Outcome {
    /// Runs the tests, shows what they print as it comes, and counts.
    fn of(tests: &mut Command) -> anyhow::Result<Self> {
        let mut child = tests
            .stdout(Stdio::piped())
            .spawn()
            .context("cargo does not start")?;
        let mut outcome = Self {
            ended: Ended::BADLY,
            programs: 0,
            passed: 0,
            failed: 0,
            ignored: 0,
        };
        if let Some(stdout) = child.stdout.take() {
            for line in BufReader::new(stdout).split(b'\n') {
                let line = line.context("what the tests print cannot be read")?;
                let line = String::from_utf8_lossy(&line);
                println!("{line}");
                outcome.add(&line);
            }
        }
        outcome.ended = child.wait()?.into();
        Ok(outcome)
    }

    fn add(&mut self, line: &str) {
        let Some(counts) = line.strip_prefix("test result: ") else {
            return;
        };
        self.programs += 1;
        for (count, what) in counts
            .split([';', '.'])
            .filter_map(|part| part.trim().split_once(' '))
        {
            let total = match what {
                "passed" => &mut self.passed,
                "failed" => &mut self.failed,
                "ignored" => &mut self.ignored,
                _ => continue,
            };
            *total += count.parse::<u64>().unwrap_or_default();
        }
    }

    fn print(&self, skipped: usize) {
        let word = if self.ended == Ended::WELL {
            "ok"
        } else {
            "FAILED"
        };
        // A skipped test returns early, which the runner counts as passed.
        let passed = self
            .passed
            .saturating_sub(skipped.try_into().unwrap_or(u64::MAX));
        println!(
            "\ntest result: {word}. {passed} passed; {} failed; {} ignored; {skipped} skipped, in {} test programs",
            self.failed, self.ignored, self.programs
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_closing_lines_of_all_test_programs_are_summed() {
        let mut outcome = Outcome {
            ended: Ended::WELL,
            programs: 0,
            passed: 0,
            failed: 0,
            ignored: 0,
        };
        for line in [
            "test a::b ... ok",
            "test result: ok. 7 passed; 0 failed; 1 ignored; 0 measured; 0 filtered out; finished in 0.00s",
            "test result: FAILED. 3 passed; 2 failed; 0 ignored; 0 measured; 9 filtered out; finished in 5.61s",
        ] {
            outcome.add(line);
        }
        assert_eq!(
            (
                outcome.programs,
                outcome.passed,
                outcome.failed,
                outcome.ignored
            ),
            (2, 10, 2, 1)
        );
    }
}
