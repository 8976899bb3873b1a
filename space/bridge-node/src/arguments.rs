//! The arguments all programs of the space take.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::FromArgMatches;
use service::LogArguments;

/// Flags take precedence over `UA_*` environment variables, which take precedence over the mapping.
#[derive(Debug, Clone, clap::Args)]
pub struct Arguments {
    /// The mapping YAML of the cell. Without a mapping, all topics with names of the space are
    /// bridged, with any type
    #[arg(value_name = "MAPPING", env = "UA_MAPPING")]
    pub mapping: Option<PathBuf>,
    /// Check the mapping, print every finding, and exit
    #[arg(long)]
    pub check: bool,
    /// All arguments except the mapping.
    #[command(flatten)]
    pub flags: Flags,
}

/// The arguments of programs with or without a mapping.
#[derive(Debug, Clone, clap::Args)]
// A program may have a struct of that name too, and groups have the names of their structs.
#[group(skip)]
pub struct Flags {
    /// Receive and decode, but publish nothing on either side
    #[arg(long)]
    pub dry_run: bool,
    /// The network interface of the PubSub group, by name or address
    #[arg(long, value_name = "NAME|ADDRESS", env = "UA_INTERFACE")]
    pub interface: Option<String>,
    /// The PubSub group, such as opc.udp://239.192.0.40:4840, or an MQTT broker, such as
    /// mqtt://broker.local:1883
    #[arg(long, value_name = "URL", env = "UA_ADDRESS")]
    pub address: Option<String>,
    /// Use the secured groups of this mapping YAML (its key `security`) instead of the groups of
    /// the program's configuration
    #[arg(long, value_name = "MAPPING", env = "UA_SECURITY")]
    pub security: Option<PathBuf>,
    /// The format of the log.
    #[command(flatten)]
    pub log: LogArguments,
    /// Serve counters and delays at this address: /metrics for Prometheus, /status as JSON, and
    /// /readyz for readiness
    #[arg(long, value_name = "ADDRESS:PORT", env = "UA_METRICS")]
    pub metrics: Option<SocketAddr>,
    /// Microseconds of busy waiting for the next sample before sleeping, such as 200, while samples
    /// follow each other closely. Uses up to one core: only for closed control loops on hosts with
    /// spare cores
    #[arg(
        long,
        value_name = "MICROSECONDS",
        env = "UA_BUSY_POLL",
        default_value = "0",
        hide_default_value = true,
        value_parser = clap::value_parser!(u32).range(..=10_000)
    )]
    pub busy_poll: u32,
}

/// The arguments of a program that has no mapping file but a configuration of its own.
#[derive(Debug, Clone)]
pub struct WithoutMapping(pub Arguments);

impl clap::Args for WithoutMapping {
    fn augment_args(command: clap::Command) -> clap::Command {
        Flags::augment_args(command)
    }

    fn augment_args_for_update(command: clap::Command) -> clap::Command {
        Flags::augment_args_for_update(command)
    }
}

impl FromArgMatches for WithoutMapping {
    fn from_arg_matches(matches: &clap::ArgMatches) -> Result<Self, clap::Error> {
        Ok(Self(Arguments {
            mapping: None,
            check: false,
            flags: Flags::from_arg_matches(matches)?,
        }))
    }

    fn update_from_arg_matches(&mut self, matches: &clap::ArgMatches) -> Result<(), clap::Error> {
        self.0.flags.update_from_arg_matches(matches)
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(clap::Parser)]
    struct Component {
        file: PathBuf,
        #[command(flatten)]
        arguments: WithoutMapping,
    }

    #[test]
    fn a_program_with_a_file_of_its_own_takes_the_same_flags_and_no_mapping() {
        let typed = [
            "component",
            "gripper.yaml",
            "--interface",
            "lo",
            "--dry-run",
        ];
        let Component { file, arguments } = Component::try_parse_from(typed).unwrap();
        let WithoutMapping(arguments) = arguments;
        assert_eq!(file, PathBuf::from("gripper.yaml"));
        assert_eq!(arguments.mapping, None);
        assert_eq!(arguments.flags.interface.as_deref(), Some("lo"));
        assert!(arguments.flags.dry_run && !arguments.check);
        let two = ["component", "gripper.yaml", "cell.yaml"];
        assert!(Component::try_parse_from(two).is_err());
    }
}
