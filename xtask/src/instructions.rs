//! `cargo xtask bench uadp` and `bench messages`: measure wall time, and instructions, which do not
//! depend on the load of the machine.

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context as _, bail, ensure};

use crate::{
    shell::{CommandOutcome, run as must, step, succeeds},
    workspace::{SHIPPED, Workspace},
};

/// Percentage above the listed instructions that counts as a regression. Compilers differ by less.
const TOLERANCE: u64 = 10;
/// The difference of two runs excludes the cost of the program start.
const FEW: u64 = 1_000;
const MANY: u64 = 3_000;

/// Measures the crate `of`, which has a package `of-bench` in its folder `bench`. `--instructions`
/// only compares the instructions with the list in this folder, `--update` rewrites the list.
/// `after` runs after the measurement of wall time.
pub(crate) fn run(
    workspace: &Workspace,
    of: &str,
    arguments: &[&str],
    after: impl FnOnce(&Path) -> anyhow::Result<()>,
) -> anyhow::Result<CommandOutcome> {
    let (wall, update) = match arguments {
        [] => (true, false),
        ["--instructions"] => (false, false),
        ["--update"] => (false, true),
        _ => {
            eprintln!("xtask: bench {of} takes --instructions or --update");
            return Ok(CommandOutcome::USAGE);
        }
    };
    let package = format!("{of}-bench");
    if wall {
        step("building the measurement as the programs are handed out");
        let bench = built(workspace, &package, SHIPPED)?;
        step("wall time, nanoseconds per message, the best of all rounds");
        must(&mut Command::new(&bench))?;
        after(&bench)?;
    }
    // The release profile compiles crate by crate, which builds in a third of the time; CI counts
    // instructions too.
    step("building the measurement with optimisation");
    let bench = built(workspace, &package, "release")?;
    ensure!(
        succeeds("valgrind", &["--version"]),
        "valgrind, which counts the instructions, is not installed: `cargo xtask peers` does that"
    );
    step("instructions per message");
    let counted = count_all(&bench)?;
    let list = List::of(workspace, of);
    if update {
        list.write(&counted)?;
        return Ok(CommandOutcome::WELL);
    }
    list.compare(&counted)
}

fn built(workspace: &Workspace, package: &str, profile: &str) -> anyhow::Result<PathBuf> {
    must(&mut workspace.cargo(&["build", "--profile", profile, "--locked", "-p", package]))?;
    Ok(workspace.target.join(profile).join(package))
}

fn count_all(bench: &PathBuf) -> anyhow::Result<BTreeMap<String, u64>> {
    let output = Command::new(bench).arg("list").output()?;
    let mut counted = BTreeMap::new();
    for name in String::from_utf8(output.stdout)?.lines() {
        let more = count(bench, name, MANY)? - count(bench, name, FEW)?;
        counted.insert(name.to_owned(), more / (MANY - FEW));
    }
    Ok(counted)
}

fn count(bench: &PathBuf, name: &str, messages: u64) -> anyhow::Result<u64> {
    let output = Command::new("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
        .arg(bench)
        .args(["count", name, &messages.to_string()])
        .output()?;
    let said = String::from_utf8_lossy(&output.stderr);
    let collected = said
        .lines()
        .find_map(|line| line.split_once("Collected :"))
        .and_then(|(_, count)| count.trim().parse().ok());
    match collected {
        Some(count) if output.status.success() => Ok(count),
        _ => bail!("valgrind counted nothing for `{name}`:\n{said}"),
    }
}

/// The instruction counts at the last update of the list.
struct List {
    path: PathBuf,
    /// The name of the crate.
    of: String,
}

impl List {
    fn of(workspace: &Workspace, of: &str) -> Self {
        Self {
            path: workspace.folder(of).join("bench/instructions.txt"),
            of: of.to_owned(),
        }
    }

    fn write(&self, counted: &BTreeMap<String, u64>) -> anyhow::Result<()> {
        let mut text = String::new();
        for (name, count) in counted {
            writeln!(text, "{count:6} {name}")?;
        }
        print!("{text}");
        fs::write(&self.path, text).with_context(|| format!("{}", self.path.display()))
    }

    fn read(&self) -> anyhow::Result<BTreeMap<String, u64>> {
        let text =
            fs::read_to_string(&self.path).with_context(|| format!("{}", self.path.display()))?;
        let entry = |line: &str| {
            let (count, name) = line.trim().split_once(' ')?;
            Some((name.to_owned(), count.parse().ok()?))
        };
        text.lines()
            .map(|line| entry(line).with_context(|| format!("not COUNT NAME: {line}")))
            .collect()
    }

    fn compare(&self, counted: &BTreeMap<String, u64>) -> anyhow::Result<CommandOutcome> {
        let listed = self.read()?;
        let mut ended = CommandOutcome::WELL;
        for (name, count) in counted {
            let verdict = match listed.get(name) {
                Some(before) if *count > limit(*before) => {
                    ended = CommandOutcome::BADLY;
                    format!("TOO MANY, {before} are listed")
                }
                Some(before) => format!("{before} listed"),
                None => {
                    ended = CommandOutcome::BADLY;
                    "not listed".to_owned()
                }
            };
            println!("{count:6} {name:<32} {verdict}");
        }
        if ended != CommandOutcome::WELL {
            println!(
                "the list is {}; `cargo xtask bench {} --update` writes it anew",
                self.path.display(),
                self.of
            );
        }
        Ok(ended)
    }
}

const fn limit(listed: u64) -> u64 {
    listed + listed * TOLERANCE / 100
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tenth_more_than_listed_is_let_pass_and_no_more() {
        assert_eq!(limit(100), 110);
        assert_eq!(limit(57), 62);
    }
}
