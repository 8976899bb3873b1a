//! The program `bridge-ros1`, from its command line to its exit code.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

use bridge_core::Local;
use bridge_node::{
    Arguments, Carried, Context, Failure, FailureKind, Program, RedundancyArguments,
    RedundancyRank, SharedProgram,
};
use clap::{ArgMatches, Command, CommandFactory, FromArgMatches, Parser};
use mappings::{Mapping, SpaceId};
use mdns::{Bridge, TellingArguments, tell_bridge};
#[cfg(feature = "sks")]
use plant_keys::KeyArguments;
use tcpros::{ArgumentError, NodeError, NodeOptions};
use tracing::warn;

use crate::{Ros1Port, Ros1PortOptions};

/// Runs `bridge-ros1` from its command line to its end. `arguments` begin with the name of the
/// program.
#[must_use]
pub fn run(arguments: Vec<OsString>) -> ExitCode {
    bridge_node::run::<BridgeRos1>(arguments)
}

/// Returns `bridge-ros1` for a process with several programs. `arguments` begin with the name of
/// the program.
///
/// # Errors
/// The exit code if the arguments are invalid or ask for help; the message was printed.
pub fn shared(arguments: Vec<OsString>) -> Result<SharedProgram, ExitCode> {
    SharedProgram::new::<BridgeRos1>(arguments)
}

/// The command line: the arguments of clap, and the ROS arguments.
#[derive(Debug)]
struct BridgeRos1 {
    flags: Flags,
    /// `from:=to` and `__name:=value`, which `roslaunch` adds at any position.
    words: Vec<String>,
}

/// Carries topics between a ROS 1 graph and the space of OPC UA PubSub.
///
/// The ROS master is found by ROS_MASTER_URI, and this node by ROS_HOSTNAME or ROS_IP. Like every
/// ROS node, the bridge accepts remappings such as `from:=to` and `__name:=bridge`, and private
/// parameters such as `_rate:=5`.
#[derive(Debug, Parser)]
#[command(name = "bridge-ros1", version = build_info::version())]
struct Flags {
    #[command(flatten)]
    arguments: Arguments,
    #[cfg(feature = "sks")]
    #[command(flatten)]
    keys: KeyArguments,
    #[command(flatten)]
    told: TellingArguments,
    #[command(flatten)]
    redundancy: RedundancyArguments,
}

impl Parser for BridgeRos1 {
    fn try_parse_from<I, T>(arguments: I) -> Result<Self, clap::Error>
    where
        I: IntoIterator<Item = T>,
        T: Into<OsString> + Clone,
    {
        Self::of(arguments.into_iter().map(Into::into))
    }
}

impl BridgeRos1 {
    fn of(arguments: impl Iterator<Item = OsString>) -> Result<Self, clap::Error> {
        let (mut words, mut rest) = (Vec::new(), Vec::new());
        for argument in arguments {
            match argument.to_str().filter(|text| text.contains(":=")) {
                Some(word) => words.push(word.to_owned()),
                None => rest.push(argument),
            }
        }
        Ok(Self {
            flags: Flags::try_parse_from(rest)?,
            words,
        })
    }

    fn node_options(&self) -> Result<NodeOptions, ArgumentError> {
        let mut options = NodeOptions::from_env(NODE_NAME);
        for word in options.apply_arguments(&self.words)? {
            warn!(word, "ignored an unknown ROS argument");
        }
        options.name = self.flags.redundancy.node_name(&options.name);
        Ok(options)
    }
}

impl CommandFactory for BridgeRos1 {
    fn command() -> Command {
        Flags::command()
    }

    fn command_for_update() -> Command {
        Flags::command_for_update()
    }
}

impl FromArgMatches for BridgeRos1 {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        Ok(Self {
            flags: Flags::from_arg_matches(matches)?,
            words: Vec::new(),
        })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        self.flags.update_from_arg_matches(matches)
    }
}

impl Program for BridgeRos1 {
    type Port = Ros1Port;

    const NAME: &'static str = "bridge-ros1";
    // Keys are fetched over OPC UA; the result is logged by this program.
    #[cfg(feature = "sks")]
    const QUIET: &'static str = plant_keys::QUIET;
    const LOCAL: Local = Local::Ros1;

    fn arguments(&self) -> &Arguments {
        &self.flags.arguments
    }

    fn spaces(&self, _mapping: &Mapping) -> Result<Vec<SpaceId>, Failure> {
        Ok(vec![SpaceId::ROS1])
    }

    fn part(&self) -> BTreeSet<u16> {
        self.flags.redundancy.part()
    }

    fn rank(&self) -> Option<RedundancyRank> {
        self.flags.redundancy.rank
    }

    #[cfg(feature = "sks")]
    fn key_service(
        &self,
        _mapping: &Mapping,
    ) -> Option<std::sync::Arc<dyn bridge_node::KeyService>> {
        Some(self.flags.keys.service(Self::NAME))
    }

    fn tell(&self, carried: &Carried<'_>) -> Option<Box<dyn Send + Sync>> {
        let bridge = Bridge {
            program: Self::NAME.to_owned(),
            uri: carried.application.uri.clone(),
            space: carried.own.into(),
            group: carried.group,
        };
        let told = tell_bridge(&bridge, &self.flags.told.telling, carried.interface)?;
        Some(Box::new(told))
    }

    async fn start(&self, context: Context) -> Result<Ros1Port, Failure> {
        let options = Ros1PortOptions {
            node: self
                .node_options()
                .map_err(|error| Failure::new(FailureKind::Usage, error.to_string()))?,
            own: context.own,
            mapping: context.mapping,
            types: context.types,
            packages: std::env::var_os("ROS_PACKAGE_PATH")
                .map(|list| std::env::split_paths(&list).collect::<Vec<PathBuf>>())
                .unwrap_or_default(),
        };
        Ros1Port::start(options).map_err(|error| {
            let kind = if matches!(error, NodeError::Name(_) | NodeError::MasterUri(_)) {
                FailureKind::Usage
            } else {
                FailureKind::Unavailable
            };
            Failure::new(kind, error.to_string())
        })
    }
}

/// The name of the bridge in `rosnode list`.
const NODE_NAME: &str = "ua_bridge_ros1";

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(arguments: &[&str]) -> BridgeRos1 {
        let all = std::iter::once(&"bridge-ros1").chain(arguments);
        BridgeRos1::of(all.map(OsString::from)).unwrap()
    }

    #[test]
    fn the_command_line_is_well_formed() {
        BridgeRos1::command().debug_assert();
    }

    #[test]
    fn words_of_roslaunch_may_stand_anywhere() {
        let program = parsed(&[
            "__name:=cell",
            "map.yaml",
            "/a:=/b",
            "_rate:=5",
            "__log:=/tmp/x.log",
        ]);
        assert_eq!(program.arguments().mapping, Some(PathBuf::from("map.yaml")));
        let options = program.node_options().unwrap();
        assert_eq!(options.name, "cell");
        assert_eq!(options.remappings, [("/a".to_owned(), "/b".to_owned())]);
        assert_eq!(options.parameters, [("rate".to_owned(), 5.into())]);
    }

    #[test]
    fn a_word_that_remaps_no_name_is_refused() {
        let refused = parsed(&["/a:=1b"]).node_options().unwrap_err();
        assert_eq!(refused.word(), "/a:=1b");
    }

    #[test]
    fn without_words_the_node_has_its_own_name() {
        let program = parsed(&[]);
        assert_eq!(program.node_options().unwrap().name, NODE_NAME);
        assert_eq!(program.spaces(&Mapping::default()), Ok(vec![SpaceId::ROS1]));
    }
}
