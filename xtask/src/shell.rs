//! Runs other programs and passes on their exit codes.

use std::process::{Command, ExitCode, ExitStatus};

use anyhow::{Context as _, bail};

/// The outcome of a command, which gives the exit code of this program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct CommandOutcome(u8);

impl CommandOutcome {
    pub(crate) const WELL: Self = Self(0);
    pub(crate) const BADLY: Self = Self(1);
    pub(crate) const USAGE: Self = Self(64);
}

impl From<ExitStatus> for CommandOutcome {
    fn from(status: ExitStatus) -> Self {
        let code = status.code().and_then(|code| u8::try_from(code).ok());
        code.map_or(Self::BADLY, Self)
    }
}

impl From<CommandOutcome> for ExitCode {
    fn from(ended: CommandOutcome) -> Self {
        Self::from(ended.0)
    }
}

/// Prints the next step.
pub(crate) fn step(what: &str) {
    println!("==> {what}");
}

/// Runs a command with the terminal of the user and returns its status.
///
/// # Errors
/// Returns an error if the command does not start.
pub(crate) fn status(command: &mut Command) -> anyhow::Result<ExitStatus> {
    command
        .status()
        .with_context(|| format!("{} does not start", command.get_program().display()))
}

/// Runs a command that must succeed.
///
/// # Errors
/// Returns an error if the command does not start or fails.
pub(crate) fn run(command: &mut Command) -> anyhow::Result<()> {
    let status = status(command)?;
    if !status.success() {
        bail!("{} ended with {status}", line(command));
    }
    Ok(())
}

/// Returns true if a command runs and succeeds; its output is discarded.
pub(crate) fn succeeds(program: &str, arguments: &[&str]) -> bool {
    let output = Command::new(program).args(arguments).output();
    output.is_ok_and(|output| output.status.success())
}

/// Returns the command line.
pub(crate) fn line(command: &Command) -> String {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    let words: Vec<String> = words.map(|word| word.display().to_string()).collect();
    words.join(" ")
}

/// Returns true in CI, where no test may be skipped.
pub(crate) fn is_ci() -> bool {
    std::env::var_os("CI").is_some_and(|ci| ci == "true")
}
