//! `ua-bridge cell`: several programs of a cell in one process.

use std::env;
use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

use bridge_node::{Arguments, ProgramSet, SharedProgram};
use clap::error::ErrorKind;
use clap::{Parser, ValueEnum};

use crate::USAGE;

/// Runs the bridges and the server of a small cell in one process.
///
/// A value passes from one program to another without the network, and the other participants of
/// the group receive it as before. A crash ends all programs of the process: run separate programs
/// in a large cell.
#[derive(Debug, Parser)]
#[command(name = "ua-cell", version = build_info::version())]
struct CellArguments {
    #[command(flatten)]
    arguments: Arguments,
    /// The programs to run
    #[arg(
        long,
        value_name = "PROGRAM,..",
        value_enum,
        value_delimiter = ',',
        default_values = ["bridge-ros1", "bridge-ros2", "ua-server"]
    )]
    only: Vec<CellProgram>,
    /// Further options of bridge-ros1 in one word, such as "--announce"
    #[arg(long, value_name = "OPTIONS", allow_hyphen_values = true)]
    bridge_ros1: Option<String>,
    /// Further options of bridge-ros2 in one word, such as "--domain 3 --ros-interface eth1"
    #[arg(long, value_name = "OPTIONS", allow_hyphen_values = true)]
    bridge_ros2: Option<String>,
    /// Further options of ua-server in one word, such as "--endpoint opc.tcp://10.0.0.5:4840"
    #[arg(long, value_name = "OPTIONS", allow_hyphen_values = true)]
    ua_server: Option<String>,
}

/// A program that shares its process with others.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum CellProgram {
    BridgeRos1,
    BridgeRos2,
    UaServer,
}

/// Runs several programs from the command line to their end. `arguments` begin with the name of the
/// program.
pub(crate) fn run(arguments: Vec<OsString>) -> ExitCode {
    let cell = match CellArguments::try_parse_from(arguments) {
        Ok(cell) => cell,
        Err(usage) => {
            // Printing fails if stdout or stderr is closed.
            let _printed = usage.print();
            let is_help = matches!(
                usage.kind(),
                ErrorKind::DisplayHelp | ErrorKind::DisplayVersion
            );
            return if is_help {
                ExitCode::SUCCESS
            } else {
                ExitCode::from(USAGE)
            };
        }
    };
    let Arguments {
        mapping,
        check,
        flags,
    } = &cell.arguments;
    if *check {
        let nodesets = Some(ua_server::NODESETS);
        return bridge_node::check_mapping(mapping.as_deref(), nodesets, flags.log.format);
    }
    let programs = match cell.threads() {
        Ok(threads) => ProgramSet {
            log: flags.log.format,
            metrics: flags.metrics,
            mapping: mapping.clone(),
            threads,
        },
        Err(code) => return code,
    };
    bridge_node::run_together(programs)
}

impl CellArguments {
    /// Returns the programs of each thread: the bridges share a thread, so a value passes between
    /// them without a change of threads. The server has its own, because a request of a client may
    /// take longer than a value should wait.
    fn threads(&self) -> Result<Vec<Vec<SharedProgram>>, ExitCode> {
        let threads = [
            &[CellProgram::BridgeRos1, CellProgram::BridgeRos2][..],
            &[CellProgram::UaServer],
        ];
        let chosen = threads.map(|parts| {
            let chosen = parts.iter().filter(|part| self.only.contains(part));
            let programs = chosen.map(|part| part.shared(self.arguments_of(*part)));
            programs.collect::<Result<Vec<_>, _>>()
        });
        let threads: Vec<_> = chosen.into_iter().collect::<Result<_, _>>()?;
        Ok(threads
            .into_iter()
            .filter(|thread| !thread.is_empty())
            .collect())
    }

    /// Returns the command line of a program.
    fn arguments_of(&self, part: CellProgram) -> Vec<OsString> {
        let Arguments {
            mapping,
            check: _,
            flags,
        } = &self.arguments;
        let mut line = vec![OsString::from(part.name())];
        line.extend(mapping.iter().map(OsString::from));
        let mut option = |name: &str, value: Option<OsString>| {
            if let Some(value) = value {
                line.extend([OsString::from(name), value]);
            }
        };
        option("--interface", flags.interface.clone().map(Into::into));
        option("--address", flags.address.clone().map(Into::into));
        option("--security", flags.security.clone().map(Into::into));
        let metrics = flags.metrics.map(|address| address.to_string());
        option("--metrics", metrics.map(Into::into));
        let busy_poll = (flags.busy_poll > 0).then(|| flags.busy_poll.to_string());
        option("--busy-poll", busy_poll.map(Into::into));
        let further = self.further(part).unwrap_or_default();
        if !further.contains("--pki") {
            option("--pki", part.pki(env::var_os("UA_PKI")).map(Into::into));
        }
        if flags.dry_run {
            line.push("--dry-run".into());
        }
        line.extend(further.split_whitespace().map(OsString::from));
        line
    }

    fn further(&self, part: CellProgram) -> Option<&str> {
        match part {
            CellProgram::BridgeRos1 => self.bridge_ros1.as_deref(),
            CellProgram::BridgeRos2 => self.bridge_ros2.as_deref(),
            CellProgram::UaServer => self.ua_server.as_deref(),
        }
    }
}

impl CellProgram {
    const fn name(self) -> &'static str {
        match self {
            Self::BridgeRos1 => "bridge-ros1",
            Self::BridgeRos2 => "bridge-ros2",
            Self::UaServer => "ua-server",
        }
    }

    fn shared(self, arguments: Vec<OsString>) -> Result<SharedProgram, ExitCode> {
        match self {
            Self::BridgeRos1 => bridge_ros1::entry::shared(arguments),
            Self::BridgeRos2 => bridge_ros2::entry::shared(arguments),
            Self::UaServer => ua_server::shared(arguments),
        }
    }

    /// Returns the certificate store of a bridge if the environment sets the store of the server:
    /// each program has a certificate of its own.
    fn pki(self, of_server: Option<OsString>) -> Option<PathBuf> {
        let of_server = of_server.filter(|_| self != Self::UaServer)?;
        let mut of_bridge = of_server;
        of_bridge.push("-");
        of_bridge.push(self.name());
        Some(of_bridge.into())
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    fn line(words: &[&str], part: CellProgram) -> String {
        let cell = CellArguments::try_parse_from(words).unwrap();
        let words = cell.arguments_of(part);
        let words: Vec<_> = words.iter().map(|word| word.to_string_lossy()).collect();
        words.join(" ")
    }

    #[test]
    fn the_command_line_is_well_formed() {
        CellArguments::command().debug_assert();
    }

    #[test]
    fn shared_options_reach_each_program_and_others_one() {
        let words = [
            "cell",
            "cell.yaml",
            "--interface",
            "lo",
            "--dry-run",
            "--bridge-ros2",
            "--domain 3 --space 40",
        ];
        let shared = "cell.yaml --interface lo --dry-run";
        assert_eq!(
            line(&words, CellProgram::BridgeRos1),
            format!("bridge-ros1 {shared}")
        );
        assert_eq!(
            line(&words, CellProgram::BridgeRos2),
            format!("bridge-ros2 {shared} --domain 3 --space 40")
        );
    }

    #[test]
    fn the_chosen_programs_run_with_both_bridges_in_one_thread() {
        let threads = |words: &[&str]| {
            let cell = CellArguments::try_parse_from(words).unwrap();
            let threads = cell.threads().unwrap();
            threads.iter().map(Vec::len).collect::<Vec<_>>()
        };
        assert_eq!(threads(&["cell", "a.yaml"]), [2, 1]);
        assert_eq!(threads(&["cell", "a.yaml", "--only", "ua-server"]), [1]);
        let bridges = ["cell", "a.yaml", "--only", "bridge-ros2,bridge-ros1"];
        assert_eq!(threads(&bridges), [2]);
        assert!(CellArguments::try_parse_from(["cell", "--only", "ua-mes"]).is_err());
    }

    #[test]
    fn each_program_has_a_certificate_store_of_its_own() {
        let store = Some(OsString::from("/var/pki"));
        assert_eq!(CellProgram::UaServer.pki(store.clone()), None);
        let of_bridge = CellProgram::BridgeRos1.pki(store);
        assert_eq!(of_bridge, Some(PathBuf::from("/var/pki-bridge-ros1")));
        assert_eq!(CellProgram::BridgeRos1.pki(None), None);
    }
}
