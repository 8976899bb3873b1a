//! The built program, run as users run it.

use std::fs;
use std::io::Write as _;
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use serde_json::Value;

/// The exit code and output of the program.
#[derive(Debug)]
pub(crate) struct ProgramEnd {
    pub(crate) code: i32,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

/// A command of the program under one of its names, as a link with that name starts it.
pub(crate) fn named(name: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ua-bridge"));
    command.arg0(name);
    command
}

/// Runs `ua-space` with empty stdin.
pub(crate) fn run(words: &[&str]) -> ProgramEnd {
    run_on(words, b"")
}

/// Runs `ua-space` with `stdin`.
pub(crate) fn run_on(words: &[&str], stdin: &[u8]) -> ProgramEnd {
    let mut child = named("ua-space")
        .args(words)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // The program may end before it has read all input.
    let _written = child.stdin.take().unwrap().write_all(stdin);
    let output = child.wait_with_output().unwrap();
    ProgramEnd {
        code: output.status.code().unwrap(),
        stdout: String::from_utf8(output.stdout).unwrap(),
        stderr: String::from_utf8(output.stderr).unwrap(),
    }
}

impl ProgramEnd {
    /// Returns the output of a successful run with empty stderr.
    #[track_caller]
    pub(crate) fn quiet(self) -> String {
        assert_eq!(
            (self.code, self.stderr.as_str()),
            (0, ""),
            "{}",
            self.stdout
        );
        self.stdout
    }

    /// Returns the JSON objects of the output, one per line.
    #[track_caller]
    pub(crate) fn lines(&self) -> Vec<Value> {
        let lines = self.stdout.lines();
        lines
            .map(|line| serde_json::from_str(line).unwrap())
            .collect()
    }
}

/// Writes a file of this test run that only its owner can read. Returns its path.
pub(crate) fn file(name: &str, content: impl AsRef<[u8]>) -> String {
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(name);
    fs::write(&path, content).unwrap();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
    }
    path.to_str().unwrap().to_owned()
}
