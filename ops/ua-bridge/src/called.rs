//! Finds the program that a command line starts.

use std::ffi::{OsStr, OsString};
use std::path::Path;

use crate::{PROGRAMS, Program};

/// The meaning of a command line.
pub(crate) enum Called {
    /// A program with its arguments; the first argument is its name in usage messages.
    Program(&'static Program, Vec<OsString>),
    Help,
    Version,
    /// `ua-bridge` without arguments.
    Nothing,
    /// `ua-bridge` with a first argument that names no program.
    Unknown(OsString),
}

impl Called {
    /// Chooses by the name under which the program is called, else by its first argument.
    pub(crate) fn by(arguments: Vec<OsString>) -> Self {
        let path = arguments.first().map(Path::new);
        let name = path.and_then(Path::file_name);
        if let Some(program) = name.and_then(named) {
            return Self::Program(program, arguments);
        }
        let Some(first) = arguments.get(1) else {
            return Self::Nothing;
        };
        match first.to_str() {
            Some("help" | "--help" | "-h") => return Self::Help,
            Some("--version" | "-V") => return Self::Version,
            _ => {}
        }
        match PROGRAMS.iter().find(|program| first == word(program)) {
            Some(program) => {
                // clap takes the name for usage messages from the first argument.
                let name = OsString::from(format!("ua-bridge {}", word(program)));
                let rest = arguments.into_iter().skip(2);
                Self::Program(program, std::iter::once(name).chain(rest).collect())
            }
            None => Self::Unknown(first.clone()),
        }
    }
}

/// Returns the first argument that stands for a program.
pub(crate) fn word(program: &Program) -> &'static str {
    program.name.trim_start_matches("ua-")
}

fn named(name: &OsStr) -> Option<&'static Program> {
    PROGRAMS.iter().find(|program| name == program.name)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn called(words: &[&str]) -> String {
        match Called::by(words.iter().map(OsString::from).collect()) {
            Called::Program(program, arguments) => {
                let arguments: Vec<_> = arguments
                    .iter()
                    .map(|word| word.to_string_lossy())
                    .collect();
                format!("{}: {}", program.name, arguments.join(", "))
            }
            Called::Help => "help".to_owned(),
            Called::Version => "version".to_owned(),
            Called::Nothing => "nothing".to_owned(),
            Called::Unknown(word) => format!("unknown {}", word.to_string_lossy()),
        }
    }

    #[test]
    fn the_file_name_of_the_called_path_selects_the_program() {
        for program in PROGRAMS {
            let path = format!("/opt/ua/{}", program.name);
            assert_eq!(
                called(&[&path, "server", "--help"]),
                format!("{}: {path}, server, --help", program.name)
            );
        }
        assert_eq!(called(&["ua-lds"]), "ua-lds: ua-lds");
    }

    #[test]
    fn the_first_argument_selects_the_program_under_any_other_name() {
        assert_eq!(
            called(&["ua-bridge", "server", "a.yaml"]),
            "ua-server: ua-bridge server, a.yaml"
        );
        assert_eq!(called(&["./gateway", "space"]), "ua-space: ua-bridge space");
        assert_eq!(called(&["", "mes"]), "ua-mes: ua-bridge mes");
    }

    #[test]
    fn a_command_line_without_a_program_gets_help() {
        assert_eq!(called(&["ua-bridge"]), "nothing");
        assert_eq!(called(&[]), "nothing");
        for word in ["help", "--help", "-h"] {
            assert_eq!(called(&["ua-bridge", word]), "help");
        }
        assert_eq!(called(&["ua-bridge", "--version"]), "version");
        assert_eq!(called(&["ua-bridge", "sever"]), "unknown sever");
        assert_eq!(called(&["ua-bridge", "ua-server"]), "unknown ua-server");
    }
}
