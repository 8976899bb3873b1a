//! The words of the command line.

mod discover;
mod live;

pub(crate) use discover::{Discover, Look};
pub(crate) use live::{
    Ask, Call, Echo, Group, Hz, Info, InfoSkill, List, ListSkills, Skills, SkillsVerb, Target,
    Trace, WatchSkills,
};

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use mappings::{Code, SpaceId};

/// Looks into the space: topics, values, skills and calls of one that runs, mappings and what is wrong with them,
/// datagrams of OPC UA PubSub as JSON and back.
#[derive(Debug, Parser)]
#[command(name = "ua-space", version)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) verb: Verb,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Verb {
    /// Tell everything that is wrong with a mapping
    ///
    /// Each finding has a code, its place with the line it is about, and what to do; `ua-space explain CODE` says more of
    /// a code. Definitions of messages are those of its type_paths, of ROS_PACKAGE_PATH and AMENT_PREFIX_PATH, and those
    /// built in. Nothing is asked of the network without --environment.
    ///
    /// Exit codes: 0 all can run (with --for: there), with or without warnings, 64 usage, 69 somebody of the environment is not there, 74 a
    /// file that cannot be read or an output that cannot be written, 78 one of them cannot run.
    Check(Check),
    /// Write a mapping of what is there
    ///
    /// Looks at live ROS graphs, running OPC UA servers and NodeSets, or at whoever is found, and writes a commented mapping that runs. Topics and
    /// nodes of several are tied where name and type are the same, and marked as guesses. What runs ROS itself (logs,
    /// actions, transforms) is left out, with a comment.
    ///
    /// A file that is there keeps every byte: with --merge what is new is put behind it, and topics or nodes that its
    /// comments name are not proposed again, unless this command made them a comment because a definition was missing.
    ///
    /// Exit codes: 0 done, 64 usage, 65 a NodeSet is malformed, 69 a master, domain or server is not there, 74 a file that
    /// cannot be read or written, or is there and --merge was not said, 78 the file that is there cannot run.
    Init(Init),
    /// Say what the code of a finding means, with an example
    ///
    /// Without a code: all of them, a line each.
    ///
    /// Exit codes: 0 done, 64 a code that there is not, 74 an output that cannot be written.
    Explain(Explain),
    /// Print the JSON Schema of mappings, for editors
    ///
    /// With `# yaml-language-server: $schema=PATH` as a mapping's first line, editors that know YAML schemas complete its
    /// keys and show what they mean.
    Schema,
    /// Make a file with keys for a secured group, or change the one there is
    ///
    /// Only its owner can read it. Bring it to each host of the cell; `keys: {file: FILE}` under `security` in the mapping
    /// names it. To change keys while everything runs: --next, bring it to all, --drop, bring it to all.
    ///
    /// Exit codes: 0 done, 64 usage, 65 a file that holds no keys, 74 a file that cannot be read or written, or is there.
    Keys(MakeKeys),
    /// Show what a datagram, or each datagram of a capture, holds
    ///
    /// Reads a datagram as hexadecimal text or as its bytes, or the UDP datagrams of a pcap or pcapng file. One datagram
    /// is shown as a JSON object, those of a capture as one object a line. What is wrong with a datagram is told on
    /// stderr, with the offset of the byte.
    ///
    /// Exit codes: 0 done, 64 usage, 65 something is malformed or not to be opened, 74 a file that cannot be read or
    /// an output that cannot be written.
    Decode(Decode),
    /// Make datagrams of what `decode` shows
    ///
    /// Writes the datagrams of a JSON object, of several one after the other or of an array, as hexadecimal text, a line
    /// each. Flags and sizes follow from what is there.
    ///
    /// Exit codes: 0 done, 64 usage, 65 JSON that is no datagram, 74 a file that cannot be read or an output that cannot
    /// be written.
    Encode(Encode),
    /// Tell who is there: discovery servers, servers, components, bridges
    ///
    /// Hears announcements (mDNS) on the interface, or on all of this host, asks the discovery servers and listens in the group;
    /// needs no mapping. Each server is asked who it is. Nothing is tried that was not announced, but for the addresses of --scan.
    ///
    /// Exit codes: 0 done, 64 usage, 74 an output that cannot be written, 130 interrupted.
    Discover(Discover),
    /// List the topics and calls of a running space
    ///
    /// What was heard in the group or announced there: name, origin, rate and what it consists of. Needs no mapping.
    ///
    /// Exit codes: 0 done, 64 usage, 69 an interface or group that cannot be had, 74 an output that cannot be written.
    List(List),
    /// Tell all that is known of a topic or call
    ///
    /// Exit codes: 0 done, 64 usage, 69 nothing came of it, or an interface or group cannot be had, 74 an output that
    /// cannot be written.
    Info(Info),
    /// Show the values of a topic
    ///
    /// Field by field, by the names its writer announces; as YAML, or with --json a JSON object a value.
    ///
    /// Exit codes: 0 done, 64 usage, 65 nothing that came can be read, 69 nothing came, or an interface or group cannot be
    /// had, 74 an output that cannot be written.
    Echo(Echo),
    /// Tell how often the values of a topic come
    ///
    /// Exit codes: 0 done, 64 usage, 69 nothing came, or an interface or group cannot be had, 74 an output that cannot be
    /// written.
    Hz(Hz),
    /// List the skills of all components, with their states and how to start them; tell of one, run one, watch them
    ///
    /// Exit codes: 0 done, and the run succeeded, 1 refused, or the run did not succeed, 64 usage, or a parameter that is
    /// missing or wrong, 69 no such skill, or an interface or group that cannot be had, 74 an output that cannot be written,
    /// 130 interrupted.
    Skills(Skills),
    /// Ask for a call: a skill of a component, a service of a robot, a method
    ///
    /// Values are typed by what the call is announced to take. A skill that is started is followed to the end of its run,
    /// with its states, progress and result; Ctrl-C halts it, and once more leaves at once.
    ///
    /// Exit codes: 0 answered, and the run succeeded, 1 refused, or the run did not succeed, 64 usage, or a parameter that is
    /// missing or wrong, 69 nobody offers the call, or how it ended is not known, 74 an output that cannot be written, 130
    /// interrupted.
    Call(Call),
    /// Tell how long values take, hop by hop
    ///
    /// The delays that programs measured (--metrics, as they were started with), and those of each topic on its way to
    /// here, read off the times in its messages.
    ///
    /// Exit codes: 0 done, 64 usage, 69 a program that does not answer, or an interface or group that cannot be had, 74 an
    /// output that cannot be written.
    Trace(Trace),
    /// Ask what is known of the plant: which skills can do what, who is there, what ran
    ///
    /// Exit codes: 0 done, 64 usage, or a question there is not, 65 a query that is wrong, 69 nobody answers, or not in time,
    /// 74 a file that cannot be read or an output that cannot be written.
    Ask(Ask),
    /// Print what makes a shell complete the words of ua-space, with the names of skills and topics that are heard
    ///
    /// For bash: `source <(ua-space completion bash)`; for zsh likewise; for fish: `ua-space completion fish | source`.
    Completion(Completion),
    /// What a shell may put in place of the last word
    #[command(hide = true)]
    Complete(Complete),
}

#[derive(Debug, Args)]
pub(crate) struct Completion {
    /// Which shell
    #[arg(value_name = "SHELL", value_enum)]
    pub(crate) shell: Shell,
}

/// A shell that completes words.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Shell {
    /// GNU Bash
    Bash,
    /// Zsh
    Zsh,
    /// Fish
    Fish,
}

#[derive(Debug, Args)]
pub(crate) struct Complete {
    /// Those of the line after `ua-space`, the last of which may be empty
    #[arg(
        value_name = "WORD",
        trailing_var_arg = true,
        allow_hyphen_values = true
    )]
    pub(crate) words: Vec<String>,
}

#[derive(Debug, Args)]
pub(crate) struct Check {
    /// The mappings, or - for stdin
    #[arg(value_name = "FILE", required = true)]
    pub(crate) files: Vec<String>,
    /// One JSON object a file, with its findings
    #[arg(long)]
    pub(crate) json: bool,
    /// For the host whose program serves this space, or these as 2,3; 0 is ua-server. What is wrong with types or NodeSets that only
    /// others need is a warning, as it is for that program. Without it all of a mapping counts
    #[arg(long = "for", value_name = "SPACE", value_delimiter = ',', value_parser = space)]
    pub(crate) spaces: Vec<SpaceId>,
    /// Ask whether the topics, services, types, namespaces and nodes are there: the ROS 1 master (ROS_MASTER_URI), the DDS
    /// domains of the spaces and the OPC UA server, or some of them
    #[arg(
        long,
        value_name = "WHOM",
        value_enum,
        num_args = 0..=1,
        require_equals = true,
        value_delimiter = ',',
        default_missing_value = "ros1,ros2,opcua"
    )]
    pub(crate) environment: Vec<Part>,
    /// How many seconds to listen in a DDS domain at most
    #[arg(long, value_name = "SECONDS", default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..=600))]
    pub(crate) wait: u16,
}

fn space(text: &str) -> Result<SpaceId, &'static str> {
    let number = text.trim().parse().ok();
    number
        .and_then(SpaceId::new)
        .ok_or("a space is 0 (the OPC UA side), 1 (ROS 1) or 2 to 232")
}

/// Whom of its environment to ask.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Part {
    /// The ROS 1 master
    Ros1,
    /// The DDS domains
    Ros2,
    /// The OPC UA server
    Opcua,
}

#[derive(Debug, Args)]
pub(crate) struct Init {
    /// The ROS 1 graph of this master; without a URI that of ROS_MASTER_URI
    #[arg(long, value_name = "URI", num_args = 0..=1)]
    pub(crate) ros1: Option<Option<String>>,
    /// A DDS domain, 0 to 232; without a number that of ROS_DOMAIN_ID. May be repeated
    #[arg(long, value_name = "DOMAIN", num_args = 0..=1, default_missing_value = "", value_parser = domain)]
    pub(crate) ros2: Vec<Option<u16>>,
    /// A NodeSet, as modelling tools export it. May be repeated
    #[arg(long, value_name = "FILE")]
    pub(crate) nodeset: Vec<String>,
    /// An OPC UA server that runs, as opc.tcp://127.0.0.1:4840. May be repeated
    #[arg(long, value_name = "URL")]
    pub(crate) opcua: Vec<String>,
    /// Whoever is found: the OPC UA servers that `ua-space discover` finds, the ROS 1 master and the DDS domain of the environment
    #[arg(long)]
    pub(crate) discover: bool,
    #[command(flatten)]
    pub(crate) look: Look,
    /// Where to write; without it stdout
    #[arg(short, long, value_name = "FILE")]
    pub(crate) output: Option<String>,
    /// Add what is new to the file where it is there already
    #[arg(long, requires = "output")]
    pub(crate) merge: bool,
    /// The namespace URI of values that have no node yet
    #[arg(long, value_name = "URI", default_value = "urn:ua-bridge:cell")]
    pub(crate) namespace: String,
    /// Take in /tf and /tf_static
    #[arg(long)]
    pub(crate) tf: bool,
    /// How many seconds to listen in a DDS domain at most
    #[arg(long, value_name = "SECONDS", default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..=600))]
    pub(crate) wait: u16,
    /// Tell what was written as a JSON object
    #[arg(long, requires = "output")]
    pub(crate) json: bool,
}

/// `None` for the one of the environment.
fn domain(text: &str) -> Result<Option<u16>, &'static str> {
    if text.is_empty() {
        return Ok(None);
    }
    let number = text.parse().ok().filter(|number| *number <= 232);
    number.map(Some).ok_or("a DDS domain is 0 to 232")
}

#[derive(Debug, Args)]
pub(crate) struct Explain {
    /// Such as M014
    #[arg(value_name = "CODE")]
    pub(crate) code: Option<Code>,
}

#[derive(Debug, Args)]
pub(crate) struct MakeKeys {
    /// The file
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// How long the keys for encryption are
    #[arg(long, value_name = "POLICY", value_enum, default_value_t = KeyPolicy::Aes256)]
    pub(crate) policy: KeyPolicy,
    /// Put a new key behind those of the file
    #[arg(long, conflicts_with_all = ["drop", "policy"])]
    pub(crate) next: bool,
    /// Take the first key out of the file, so that the second is used
    #[arg(long, conflicts_with = "policy")]
    pub(crate) drop: bool,
}

/// The SecurityPolicy of a group.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum KeyPolicy {
    /// PubSub-Aes128-CTR
    Aes128,
    /// PubSub-Aes256-CTR
    Aes256,
}

#[derive(Debug, Args)]
pub(crate) struct Decode {
    /// The file, or - for stdin
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// Only datagrams from or to this UDP port of a capture. Without it: port 4840, and every other datagram that
    /// is a NetworkMessage without a fault
    #[arg(long, value_name = "PORT")]
    pub(crate) port: Option<u16>,
    /// Every line of hexadecimal text is a datagram
    #[arg(long)]
    pub(crate) lines: bool,
    /// One JSON array instead of one object a line
    #[arg(long)]
    pub(crate) array: bool,
    #[command(flatten)]
    pub(crate) known: Known,
}

#[derive(Debug, Args)]
pub(crate) struct Encode {
    /// The file, or - for stdin
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// The bytes themselves, back to back
    #[arg(long)]
    pub(crate) raw: bool,
    #[command(flatten)]
    pub(crate) known: Known,
}

/// What a reader has to know besides the datagram.
#[derive(Debug, Args)]
pub(crate) struct Known {
    /// Keys of secured messages: a JSON object or an array of objects with policy, securityTokenId, signingKey,
    /// encryptingKey and keyNonce, and optionally publisherId and writerGroupId
    #[arg(long, value_name = "FILE")]
    pub(crate) keys: Option<PathBuf>,
    /// Fields of RawData messages: a JSON array with builtInType, valueRank, arrayDimensions and maxStringLength of
    /// each, or an array of objects with such a metaData and publisherId, writerGroupId or dataSetWriterId
    #[arg(long, value_name = "FILE")]
    pub(crate) metadata: Option<PathBuf>,
    /// How RawData of padded texts and arrays is laid out
    #[arg(long, value_name = "READING", value_enum, default_value_t = RawReading::Standard)]
    pub(crate) raw_reading: RawReading,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RawReading {
    /// By OPC 10000-14
    Standard,
    /// As open62541 1.5 does it
    Open62541,
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_is_well_formed() {
        Arguments::command().debug_assert();
    }
}
