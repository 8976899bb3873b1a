//! The programs that `ua-bridge` acts as.

use std::process::Command;

use crate::program::{ProgramEnd, named};

/// The name of each program, and the first argument of `ua-bridge` for the program.
const NAMES: [(&str, &str); 10] = [
    ("bridge-ros1", "bridge-ros1"),
    ("bridge-ros2", "bridge-ros2"),
    ("ua-server", "server"),
    ("ua-cell", "cell"),
    ("ua-component", "component"),
    ("ua-lds", "lds"),
    ("ua-gds", "gds"),
    ("ua-station", "station"),
    ("ua-mes", "mes"),
    ("ua-space", "space"),
];

fn ended(mut command: Command, words: &[&str]) -> ProgramEnd {
    let output = command.args(words).output().unwrap();
    ProgramEnd {
        code: output.status.code().unwrap(),
        stdout: String::from_utf8(output.stdout).unwrap(),
        stderr: String::from_utf8(output.stderr).unwrap(),
    }
}

#[test]
fn each_program_reports_its_own_name_and_version() {
    for (name, word) in NAMES {
        let version = format!("{name} {}", env!("CARGO_PKG_VERSION"));
        for shown in [
            ended(named(name), &["--version"]).quiet(),
            ended(named(&format!("/opt/{name}")), &["--version"]).quiet(),
            ended(named("ua-bridge"), &[word, "--version"]).quiet(),
        ] {
            assert!(shown.starts_with(&version), "{shown}");
        }
    }
}

#[test]
fn usage_shows_what_was_typed() {
    for (name, word) in NAMES {
        let usage = |typed: &str| format!("Usage: {typed} ");
        let by_name = ended(named(name), &["--help"]).quiet();
        assert!(by_name.contains(&usage(name)), "{by_name}");
        let by_word = ended(named("ua-bridge"), &[word, "--help"]).quiet();
        let typed = usage(&format!("ua-bridge {word}"));
        assert!(by_word.contains(&typed), "{by_word}");
    }
}

#[test]
fn a_link_with_the_name_of_a_program_is_that_program() {
    let folder = std::env::temp_dir().join(format!("ua-bridge-names-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    for (name, _) in NAMES {
        let link = folder.join(name);
        std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_ua-bridge"), &link).unwrap();
        let version = ended(Command::new(&link), &["--version"]).quiet();
        assert!(version.starts_with(&format!("{name} ")), "{version}");
    }
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn without_a_program_the_programs_are_listed() {
    let help = ended(named("ua-bridge"), &["--help"]).quiet();
    for (_, word) in NAMES {
        assert!(help.contains(&format!("\n  {word} ")), "{help}");
    }
    let alone = ended(named("ua-bridge"), &[]);
    assert_eq!((alone.code, alone.stdout.as_str()), (64, ""));
    assert_eq!(alone.stderr, help);
    let unknown = ended(named("ua-bridge"), &["sever"]);
    assert_eq!((unknown.code, unknown.stdout.as_str()), (64, ""));
    let message = "error: unknown program `sever`\n";
    assert!(unknown.stderr.starts_with(message), "{}", unknown.stderr);
}
