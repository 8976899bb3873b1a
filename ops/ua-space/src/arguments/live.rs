//! The command line arguments of the commands that inspect a running space.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use clap::{Args, Subcommand};
use mappings::{SpaceId, TopicId};

use crate::live::Sort;

/// Where the space is.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct GroupArguments {
    /// The network interface of the PubSub group, by name or address
    #[arg(long, value_name = "NAME|ADDRESS", env = "UA_INTERFACE")]
    pub(crate) interface: Option<String>,
    /// The PubSub group, as opc.udp://239.192.0.40:4840, or an MQTT broker, as
    /// mqtt://broker.local:1883
    #[arg(long, value_name = "URL", env = "UA_ADDRESS")]
    pub(crate) address: Option<String>,
    /// A mapping with the settings of an MQTT broker (`pubsub`): its address, TLS, log-in and
    /// prefix
    #[arg(long, value_name = "MAPPING", env = "UA_BROKER")]
    pub(crate) broker: Option<PathBuf>,
    /// The cell at an MQTT broker: the prefix of its topics, as plant/cell-4. `list` also takes
    /// plant/+, and lists the cells
    #[arg(long, value_name = "PREFIX", env = "UA_CELL")]
    pub(crate) cell: Option<String>,
    /// The keys of a secured group, in the format of `ua-space keys` and `decode`: messages are
    /// decrypted with them, and requests are secured with the first
    #[arg(long, value_name = "FILE", env = "UA_KEYS")]
    pub(crate) keys: Option<PathBuf>,
    /// Only sign requests, for a group with `mode: sign`
    #[arg(long, requires = "keys")]
    pub(crate) sign: bool,
}

#[derive(Debug, Args)]
pub(crate) struct ListArguments {
    /// Only topics of this origin: 0 the OPC UA side, 1 ROS 1, 2 to 232 a ROS 2 space
    #[arg(long, value_name = "SPACE", value_parser = super::space)]
    pub(crate) space: Option<SpaceId>,
    /// Time to listen
    #[arg(long, value_name = "SECONDS", default_value = "3", value_parser = seconds)]
    pub(crate) seconds: f64,
    /// List topics and calls only, without programs
    #[arg(long)]
    pub(crate) topics: bool,
    /// Print a JSON object
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct InfoArguments {
    /// The topic, as ua_1_2_10, or its name, as JointStates or /joint_states
    #[arg(value_name = "TOPIC|NAME")]
    pub(crate) target: NamedTarget,
    /// Time to listen
    #[arg(long, value_name = "SECONDS", default_value = "3", value_parser = seconds)]
    pub(crate) seconds: f64,
    /// Print a JSON object
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct EchoArguments {
    /// The topic, as ua_1_2_10, or its name, as JointStates or /joint_states
    #[arg(value_name = "TOPIC|NAME")]
    pub(crate) target: NamedTarget,
    /// End after this number of values
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) count: Option<u64>,
    /// End after this time. Without it and -n: at Ctrl-C
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub(crate) seconds: Option<f64>,
    /// Print a JSON object per value
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct Hz {
    /// The topic, as ua_1_2_10, or its name, as JointStates or /joint_states
    #[arg(value_name = "TOPIC|NAME")]
    pub(crate) target: NamedTarget,
    /// Largest number of values in a measurement
    #[arg(long, value_name = "N", default_value_t = 10_000, value_parser = window)]
    pub(crate) window: usize,
    /// End after this time. Without it: at Ctrl-C
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub(crate) seconds: Option<f64>,
    /// Print a JSON object per second
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct Top {
    /// The order of the topics
    #[arg(long, value_name = "COLUMN", value_enum, default_value_t)]
    pub(crate) sort: Sort,
    /// Only topics with this text in their topic, name, quality or type
    #[arg(long, value_name = "TEXT")]
    pub(crate) filter: Option<String>,
    /// End after this time; in a pipe the time before the table. Without it: at q, or 3 s in a pipe
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub(crate) seconds: Option<f64>,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct TypesArguments {
    /// Only this type, as GraspSkillType or Grasp
    #[arg(value_name = "TYPE")]
    pub(crate) name: Option<String>,
    /// Time to listen
    #[arg(long, value_name = "SECONDS", default_value = "3", value_parser = seconds)]
    pub(crate) seconds: f64,
    /// Print a JSON array
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(crate) struct Skills {
    #[command(subcommand)]
    pub(crate) verb: Option<SkillsVerb>,
    #[command(flatten)]
    pub(crate) list: ListSkills,
}

#[derive(Debug, Subcommand)]
pub(crate) enum SkillsVerb {
    /// List the skills, as without this verb
    List(ListSkills),
    /// Show a skill: its parameters, its state, the end of its last run
    Info(InfoSkill),
    /// Start a skill, after a Reset if it is Halted, and follow it to its end; Ctrl-C halts it. A
    /// skill whose last outcome is unknown is not reset
    Start(StartSkill),
    /// Watch transitions, progress and results of skills
    Watch(WatchSkills),
}

#[derive(Debug, Args)]
pub(crate) struct StartSkill {
    /// Reset the skill also if its last outcome is unknown, after a look at the machine
    #[arg(long)]
    pub(crate) reset: bool,
    #[command(flatten)]
    pub(crate) call: CallArguments,
}

#[derive(Debug, Args)]
pub(crate) struct InfoSkill {
    /// The skill, as parallel-gripper.Grasp, or Grasp if only one has that name
    #[arg(value_name = "SKILL")]
    pub(crate) skill: String,
    /// Time to listen
    #[arg(long, value_name = "SECONDS", default_value = "3", value_parser = seconds)]
    pub(crate) seconds: f64,
    /// Print a JSON object
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct WatchSkills {
    /// Only this component, as parallel-gripper, or only this skill, as parallel-gripper.Grasp or
    /// Grasp
    #[arg(value_name = "COMPONENT|SKILL")]
    pub(crate) what: Option<String>,
    /// End after this time. Without it: at Ctrl-C
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub(crate) seconds: Option<f64>,
    /// Print a JSON object per event
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct ListSkills {
    /// Only the skills of this component, as parallel-gripper, or only this skill, as
    /// parallel-gripper.Grasp or Grasp
    #[arg(value_name = "COMPONENT|SKILL")]
    pub(crate) what: Option<String>,
    /// Time to listen
    #[arg(long, value_name = "SECONDS", default_value = "3", value_parser = seconds)]
    pub(crate) seconds: f64,
    /// Print a JSON array
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct CallArguments {
    /// A topic as ua_0_7_105, or a name as gripper.Grasp.Halt; gripper.Grasp is gripper.Grasp.Start
    #[arg(value_name = "TOPIC|NAME")]
    pub(crate) target: NamedTarget,
    /// Parameters, as Force=12.5 TargetPosition=0.4,0,0.2,0,0,0; a goal also as YAML, '{order: 5}'
    #[arg(value_name = "NAME=VALUE")]
    pub(crate) parameters: Vec<String>,
    /// Time to wait for the announcement of the call
    #[arg(long, value_name = "SECONDS", default_value = "5", value_parser = seconds)]
    pub(crate) wait: f64,
    /// Time to wait for the response, which is sent to the executor as a deadline
    #[arg(long, value_name = "SECONDS", default_value = "10", value_parser = seconds)]
    pub(crate) timeout: f64,
    /// Call Halt when the run of a skill takes longer, or cancel the goal of an action. Without it:
    /// at Ctrl-C
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub(crate) run_timeout: Option<f64>,
    /// End with the response; the run of a skill or the goal continues
    #[arg(long)]
    pub(crate) no_wait: bool,
    /// Print a JSON object for the response and each step of the run, or each feedback and the
    /// result of the goal
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct Trace {
    /// Show the hops of this topic at each program: ua_1_2_10, or its name. Without it: of all
    /// topics
    #[arg(value_name = "TOPIC|NAME", conflicts_with_all = ["follow", "recording", "otlp", "perfetto", "svg"])]
    pub(crate) target: Option<NamedTarget>,
    /// Ask the program with this address of --metrics. May be repeated. Without it: all programs of
    /// this host with --metrics
    #[arg(long, value_name = "URL")]
    pub(crate) metrics: Vec<String>,
    /// Time to listen in the group; 0 asks the programs only. Without it: 3 s, or with --follow
    /// until Ctrl-C
    #[arg(long, value_name = "SECONDS", value_parser = seconds_or_none)]
    pub(crate) seconds: Option<f64>,
    /// Show the delays of each sample of this topic: ua_1_2_10, or its name
    #[arg(long, value_name = "TOPIC|NAME", conflicts_with = "metrics")]
    pub(crate) follow: Option<NamedTarget>,
    /// Write the samples as a trace of Perfetto: a track for each hop of a topic, and a flow for
    /// each sample
    #[arg(long, value_name = "FILE")]
    pub(crate) perfetto: Option<PathBuf>,
    /// Write a drawing of the delays of each topic: the hops as a waterfall, and their distribution
    #[arg(long, value_name = "FILE")]
    pub(crate) svg: Option<PathBuf>,
    /// Read the recording (pcapng) of a host instead of listening; one for each host, made at the
    /// same time. Shows the offsets of their clocks, and the corrected delays between them
    #[arg(long, value_name = "FILE", conflicts_with_all = ["metrics", "follow", "perfetto", "svg", "otlp"])]
    pub(crate) recording: Vec<PathBuf>,
    /// Send the counters and delays of programs as metrics of OpenTelemetry (OTLP over HTTP), and
    /// samples as traces, to this collector, as http://127.0.0.1:4318, every --seconds (10), until
    /// Ctrl-C
    #[arg(long, value_name = "URL", conflicts_with_all = ["follow", "perfetto", "svg", "json"])]
    pub(crate) otlp: Option<String>,
    /// With --otlp: the number of samples of each topic that are sent as traces in each period; 0
    /// sends metrics only and does not listen in the group
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(0..=1000), requires = "otlp")]
    pub(crate) traces: u16,
    /// Print a JSON object, or with --follow a JSON object for each sample
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct AskArguments {
    /// The question, as what-can-run. Without it all questions are listed
    #[arg(value_name = "QUESTION", conflicts_with = "sparql")]
    pub(crate) question: Option<String>,
    /// Parameters of the question, as capability=urn:example:grasp, or values in its order
    #[arg(value_name = "NAME=VALUE", requires = "question")]
    pub(crate) arguments: Vec<String>,
    /// Run this query of SPARQL 1.1 in a file, or - for stdin
    #[arg(long, value_name = "FILE")]
    pub(crate) sparql: Option<String>,
    #[command(flatten)]
    pub(crate) mes: MesAt,
    /// Print the response unchanged
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct PlanArguments {
    /// The process: its IRI, its name, or the last part of its IRI
    #[arg(value_name = "PROCESS")]
    pub(crate) process: Option<String>,
    #[command(flatten)]
    pub(crate) mes: MesAt,
    /// Print the response of the MES
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct SourceArguments {
    #[command(subcommand)]
    pub(crate) verb: SourceVerb,
}

#[derive(Debug, Subcommand)]
pub(crate) enum SourceVerb {
    /// List the sources with their findings
    List {
        /// Print the response unchanged
        #[arg(long)]
        json: bool,
        #[command(flatten)]
        at: SourceAt,
    },
    /// Add or replace a source
    Add {
        /// A NodeSet, a manifest (.aml, .mtp, .amlx), Turtle (.ttl), a recipe (BatchML, BPMN), a
        /// STEP file (.step, .stp), or XML with --rml; - for stdin
        #[arg(value_name = "FILE")]
        file: String,
        /// file (Turtle), nodeset, mtp, process (Turtle, or a recipe) or product (STEP); found by
        /// the name and contents of the file
        #[arg(long, value_name = "KIND")]
        kind: Option<String>,
        /// The name of the source; the name of the file unless given. A NodeSet is named by its
        /// namespace
        #[arg(long = "as", value_name = "NAME")]
        name: Option<String>,
        /// The RML mapping that makes RDF of the file, which is XML
        #[arg(long, value_name = "MAPPING", conflicts_with = "kind")]
        rml: Option<String>,
        #[command(flatten)]
        at: SourceAt,
    },
    /// Remove a source
    Remove {
        /// file, nodeset, mtp, process or product
        #[arg(value_name = "KIND")]
        kind: String,
        /// The name of the source, as `ua-space source list` shows it
        #[arg(value_name = "NAME")]
        name: String,
        #[command(flatten)]
        at: SourceAt,
    },
    /// Check the knowledge against shapes (SHACL), and print the violations
    ///
    /// The shapes of ua-mes and of the sources are checked. Exit code 65 if there are
    /// violations.
    Check {
        /// Print the report in the vocabulary of SHACL
        #[arg(long)]
        turtle: bool,
        /// Print the report as JSON
        #[arg(long, conflicts_with = "turtle")]
        json: bool,
        #[command(flatten)]
        at: SourceAt,
    },
    /// Run an update of SPARQL 1.1 on the graphs of users
    Update {
        /// The file of the update, or - for stdin
        #[arg(value_name = "FILE")]
        file: String,
        #[command(flatten)]
        at: SourceAt,
    },
}

/// Where ua-mes answers.
#[derive(Debug, Args)]
pub(crate) struct MesAt {
    /// The URL of ua-mes
    #[arg(
        long,
        value_name = "URL",
        env = "UA_SPARQL",
        default_value = "http://127.0.0.1:8087"
    )]
    pub(crate) url: String,
}

#[derive(Debug, Args)]
pub(crate) struct SourceAt {
    #[command(flatten)]
    pub(crate) mes: MesAt,
    /// The user, where ua-mes has users; the password is in UA_PASSWORD
    #[arg(long, value_name = "NAME", env = "UA_USER")]
    pub(crate) user: Option<String>,
    #[arg(long, hide = true, env = "UA_PASSWORD", hide_env_values = true)]
    pub(crate) password: Option<String>,
}

/// A topic or call, by its identifiers or by a name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum NamedTarget {
    Topic(TopicId),
    Name(String),
}

impl FromStr for NamedTarget {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match topic(text) {
            Ok(topic) => Ok(Self::Topic(topic)),
            Err(_) if text.is_empty() => {
                Err("a topic as ua_0_7_105, or a name as gripper.Grasp or /joint_states")
            }
            Err(wrong) if looks_like_topic(text) => Err(wrong),
            Err(_) => Ok(Self::Name(text.to_owned())),
        }
    }
}

impl fmt::Display for NamedTarget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Topic(topic) => topic.fmt(f),
            Self::Name(name) => f.write_str(name),
        }
    }
}

/// Parses a topic in the notation of ROS, with or without the leading slash.
fn topic(text: &str) -> Result<TopicId, &'static str> {
    let name = text.strip_prefix('/').unwrap_or(text);
    name.parse()
        .map_err(|_| "a topic of the space is ua_<space>_<namespace>_<identifier>, as ua_1_2_10")
}

/// Returns true for `ua_` and numbers, which is a misspelt topic and no name.
fn looks_like_topic(text: &str) -> bool {
    let name = text.strip_prefix('/').unwrap_or(text);
    let numbers = name.strip_prefix("ua_");
    numbers.is_some_and(|rest| rest.chars().all(|c| c.is_ascii_digit() || c == '_'))
}

pub(in crate::arguments) fn seconds(text: &str) -> Result<f64, &'static str> {
    let seconds = seconds_or_none(text)?;
    (seconds > 0.0).then_some(seconds).ok_or(A_TIME)
}

fn seconds_or_none(text: &str) -> Result<f64, &'static str> {
    let seconds = text.parse().ok();
    seconds
        .filter(|seconds| (0.0..=MOST_SECONDS).contains(seconds))
        .ok_or(A_TIME)
}

fn window(text: &str) -> Result<usize, &'static str> {
    let window = text.parse().ok();
    window
        .filter(|window| (2..=1_000_000).contains(window))
        .ok_or("a number from 2 to 1000000")
}

const A_TIME: &str = "seconds, up to a million, as 2.5";
const MOST_SECONDS: f64 = 1e6;
