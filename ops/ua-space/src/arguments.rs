//! The command line arguments.

mod cell;
mod discover;
mod job;
mod live;
mod module;
mod recording;
mod tap;
mod write;

pub(crate) use cell::{CellTemplate, Doctor, DriverTemplate, NewCellArguments, StatusArguments};
pub(crate) use discover::{Discover, DiscoverArguments};
pub(crate) use live::{
    AskArguments, CallArguments, EchoArguments, GroupArguments, Hz, InfoArguments, InfoSkill,
    ListArguments, ListSkills, MesAt, NamedTarget, PlanArguments, Skills, SkillsVerb,
    SourceArguments, SourceAt, SourceVerb, StartSkill, Top, Trace, TypesArguments, WatchSkills,
};
pub(crate) use recording::{RecordArguments, ReplayArguments, Viewers};
pub(crate) use tap::TapArguments;
pub(crate) use write::Write;

pub(crate) use job::{
    GoalArguments, JobArguments, JobVerb, ProcessArguments, ProcessVerb, ProductArguments,
};
pub(crate) use module::{
    AasArguments, MtpAlarms, MtpArguments, MtpConnect, MtpPicture, MtpRdf, MtpRun, MtpSkills,
    MtpVerb, PeaArguments,
};

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use mappings::{Code, SpaceId};

use crate::page::PageArguments;

/// Shows a running space (topics, values, skills and calls), proposes and checks mappings, and
/// converts datagrams of OPC UA PubSub to JSON and back.
#[derive(Debug, Parser)]
#[command(name = "ua-space", version = build_info::version())]
pub(crate) struct ToolArguments {
    #[command(subcommand)]
    pub(crate) verb: Verb,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Verb {
    /// Check a mapping and print all findings
    ///
    /// Each finding has a code, its location with the line, and a remedy; `ua-space explain CODE`
    /// explains the code. Definitions of messages are those of type_paths, of ROS_PACKAGE_PATH and
    /// AMENT_PREFIX_PATH, and the built-in ones. The network is used only with --environment.
    ///
    /// Exit codes: 0 all can run (with --for: there), with or without warnings, 64 usage, 69 a part
    /// of the environment is not available, 74 a file cannot be read or the output cannot be
    /// written, 78 a mapping cannot run.
    Check(CheckArguments),
    /// Propose a mapping of running robots and servers
    ///
    /// Inspects SysML models, ROS graphs, running OPC UA servers and NodeSets, or all discovered
    /// sources, and writes a commented mapping that runs. A model has a stereotype at each property
    /// that crosses (ua-space new profile, ua-space new sysml). Topics and nodes of several sources
    /// with the same name and type are joined, and marked as guesses. Topics of ROS itself (logs,
    /// actions, transforms) are left out, with a comment.
    ///
    /// An existing file keeps every byte: with --merge new entries are appended. Topics or nodes
    /// that its comments name are not proposed again, unless this command commented them out
    /// because a definition was missing.
    ///
    /// Exit codes: 0 done, 64 usage, 65 a NodeSet or model is malformed, 69 a master, domain or
    /// server is not available, 74 a file cannot be read or written, or exists and --merge is
    /// missing, 78 the existing file cannot run.
    Init(Init),
    /// Explain the code of a finding, with an example
    ///
    /// Without a code: all codes, a line each.
    ///
    /// Exit codes: 0 done, 64 an unknown code, 74 the output cannot be written.
    Explain(Explain),
    /// Print the JSON Schema of mappings, for editors
    ///
    /// With `# yaml-language-server: $schema=PATH` as the first line of a mapping, editors that
    /// know YAML schemas complete its keys and show their meaning.
    Schema,
    /// Create a file with keys for a secured group, or change an existing file
    ///
    /// Only its owner can read the file. Copy it to each host of the cell; `keys: {file: FILE}`
    /// under `security` in the mapping names it. To rotate keys while all programs run: --next,
    /// copy it to all hosts, --drop, copy it again.
    ///
    /// Exit codes: 0 done, 64 usage, 65 the file has no keys, 74 the file cannot be read or
    /// written, or exists.
    Keys(MakeKeys),
    /// Write the access rules of an MQTT broker for a mapping
    ///
    /// Prints an `acl_file` of mosquitto: a user for each space, which may write the messages of
    /// its space only, and a user for `ua-space`.
    ///
    /// Exit codes: 0 done, 64 the mapping names no broker, 65 the mapping cannot be read, 74 the
    /// file cannot be read or the output cannot be written.
    Acl(Acl),
    /// Show the contents of a datagram, or of each datagram of a capture
    ///
    /// Reads a datagram as hexadecimal text or as its bytes, or the UDP datagrams of a pcap or
    /// pcapng file. A datagram is shown as a JSON object, the datagrams of a capture as an object
    /// per line. Faults are reported on stderr, with the offset of the byte.
    ///
    /// Exit codes: 0 done, 64 usage, 65 a datagram is malformed or cannot be decrypted, 74 a file
    /// cannot be read or the output cannot be written.
    Decode(Decode),
    /// Create datagrams from the output of `decode`
    ///
    /// Writes the datagrams of a JSON object, of several objects or of an array, as hexadecimal
    /// text, a line each. Flags and sizes follow from the contents.
    ///
    /// Exit codes: 0 done, 64 usage, 65 the JSON is not a datagram, 74 a file cannot be read or the
    /// output cannot be written.
    Encode(Encode),
    /// List programs and servers: discovery servers, servers, components, bridges
    ///
    /// Listens for announcements (mDNS) on the interface, or on all interfaces of this host, asks
    /// the discovery servers and listens in the group. Each server is asked for its description.
    /// Only announced addresses are contacted, and those of --scan.
    ///
    /// Exit codes: 0 done, 64 usage, 74 the output cannot be written, 130 interrupted.
    Discover(Discover),
    /// List the programs, topics and calls of a running space
    ///
    /// Shows name, origin, rate and type of all topics that are received or announced in the group.
    /// Needs no mapping.
    ///
    /// Exit codes: 0 done, 64 usage, 69 an interface or group is not available, 74 the output
    /// cannot be written.
    List(ListArguments),
    /// Show all details of a topic or call
    ///
    /// Exit codes: 0 done, 64 usage, 69 nothing was received, or an interface or group is not
    /// available, 74 the output cannot be written.
    Info(InfoArguments),
    /// Show the values of a topic
    ///
    /// Shows each field by its announced name, as YAML, or with --json as a JSON object per value.
    ///
    /// Exit codes: 0 done, 64 usage, 65 no received value can be read, 69 nothing was received, or
    /// an interface or group is not available, 74 the output cannot be written.
    Echo(EchoArguments),
    /// Measure the rate of a topic
    ///
    /// Exit codes: 0 done, 64 usage, 69 nothing was received, or an interface or group is not
    /// available, 74 the output cannot be written.
    Hz(Hz),
    /// Measure the bandwidth of a topic
    ///
    /// Counts the bytes of the values, without the headers of the network.
    ///
    /// Exit codes: 0 done, 64 usage, 69 nothing was received, or an interface or group is not
    /// available, 74 the output cannot be written.
    Bw(Hz),
    /// Show the topics live: rates, delays, dropped samples
    ///
    /// Keys: q quits, s sorts by the next column, r reverses the order, / filters, arrows scroll.
    /// Drops are those of the programs on this host that have --metrics. In a pipe a table is
    /// printed once.
    ///
    /// Exit codes: 0 done, 64 usage, 69 an interface or group is not available, 74 the output
    /// cannot be written.
    Top(Top),
    /// Show the skill types of the cell with their parameters
    ///
    /// Exit codes: 0 done, 64 usage, 69 no such type, or an interface or group is not available,
    /// 74 the output cannot be written.
    Types(TypesArguments),
    /// Show all programs of the cell: whether they are ready, and what they wait for
    ///
    /// Finds the programs of this host and asks those with --metrics for their status; programs of
    /// other hosts are known by their announcements in the group, and with their URLs as arguments
    /// by their status.
    ///
    /// Exit codes: 0 all are ready, 1 a program is not ready, 64 usage, 69 no program was found,
    /// 74 the output cannot be written.
    Status(StatusArguments),
    /// Look for faults of the cell and of this host, and say what to do
    ///
    /// Checks interfaces, multicast, sockets, firewall, ROS settings, programs, mappings, clocks,
    /// certificates and limits of the kernel. Each finding has a code, the reason why it matters,
    /// and a remedy. Sends one datagram per interface, which does not leave this host.
    ///
    /// Exit codes: 0 no errors and warnings, 1 errors or warnings, 64 usage, 74 a file cannot be
    /// written.
    Doctor(Doctor),
    /// Write a commented starting file: a component, a MES, a mapping or a model
    ///
    /// Exit codes: 0 done, 64 usage, 74 the file exists or cannot be written.
    New(NewCellArguments),
    /// List the skills of all components with their states; show, start or watch skills
    ///
    /// Exit codes: 0 done, and the run succeeded, 1 refused, or the run did not succeed, 64 usage,
    /// or a parameter is missing or wrong, 69 no such skill, or an interface or group is not
    /// available, 74 the output cannot be written, 130 interrupted.
    Skills(Skills),
    /// Call a skill of a component, a service or action of a robot, or a Method
    ///
    /// Values are parsed by the announced types. A started skill is followed to the end of its run,
    /// with its states, progress and result; Ctrl-C halts it, and a second Ctrl-C leaves at once.
    ///
    /// Exit codes: 0 answered, and the run succeeded, 1 refused, or the run did not succeed, 64
    /// usage, or a parameter is missing or wrong, 69 the call has no executor, or its outcome is
    /// unknown, 74 the output cannot be written, 130 interrupted.
    Call(CallArguments),
    /// Show each sample of a topic at the programs, and why it crosses or not
    ///
    /// Asks the programs of this host with --metrics, or those of --metrics, for the steps of each
    /// sample: taken from ROS or OPC UA, sent, received, published, or dropped with the reason. A
    /// program records the steps of a topic while it is tapped.
    ///
    /// Exit codes: 0 done, 64 usage, 69 no program with --metrics, or none knows the name, 74 the
    /// output cannot be written.
    Tap(TapArguments),
    /// Write a value of the OPC UA side (origin 0), as an OPC UA client does
    ///
    /// Beside a ua-server that has the value, it is written at this server, with the permissions of
    /// --user. Without a server it is sent to the group, by the mapping of the cell. The value is
    /// sent at once and delivered once. Bridges confirm a command (`confirm` in the mapping).
    ///
    /// Exit codes: 0 written, and confirmed where the mapping says so, 1 refused, and nothing was
    /// sent, 64 usage, or the value is wrong, 69 nothing has the value, or its outcome is unknown,
    /// 74 the output cannot be written, 78 the mapping cannot run, 130 interrupted.
    #[command(visible_alias = "pub")]
    Write(Write),
    /// Show the delays of values, hop by hop
    ///
    /// Shows the delays that programs measured (at the address of their --metrics), and those of
    /// each topic on its way to this program, from the timestamps in its messages.
    ///
    /// Exit codes: 0 done, 64 usage, 65 recordings that cannot be compared, 69 a program does not
    /// answer, or an interface or group is not available, 74 a file cannot be read or the output
    /// cannot be written.
    Trace(Trace),
    /// Record the messages of a running space: all as pcapng, or the values as MCAP
    ///
    /// A .pcapng file has each message as it was received, with its time in nanoseconds; Wireshark,
    /// tshark and `ua-space decode`, `replay` read it. Messages of a secured group stay encrypted;
    /// keys are never in the file. An .mcap file has the values as ROS messages, or as JSON without
    /// a ROS type. Ctrl-C ends a recording whole.
    ///
    /// Exit codes: 0 done, 64 usage, 69 an interface or group is not available, 74 the file exists
    /// or cannot be written; what was written before is whole.
    Record(RecordArguments),
    /// Send a recording into a group again, with its intervals
    ///
    /// Values and their descriptions are sent as recorded; their times are moved to the present.
    /// Commands and calls are left out unless --commands is given: values of the OPC UA side,
    /// values that act where they arrive, values without a description, and requests. A group with
    /// live programs of the same spaces is refused unless --onto-live is given.
    ///
    /// Exit codes: 0 done, 1 live programs of the same spaces were found, 64 usage, 65 the file is
    /// malformed or has nothing to send, 69 an interface or group is not available, 74 the file
    /// cannot be read, 130 interrupted.
    Replay(ReplayArguments),
    /// Show the values of a running space in viewers of robot data, as Lichtblick or Foxglove
    ///
    /// Serves the Foxglove WebSocket protocol at ws://127.0.0.1:8765 (`foxglove.sdk.v1` and
    /// `foxglove.websocket.v1`), read-only and without ROS. Values are ROS messages, or JSON
    /// without a ROS type. A viewer that reads too slowly loses its oldest values.
    ///
    /// Exit codes: 0 done, 64 usage, 69 the port, an interface or group is not available, 74 the
    /// output cannot be written.
    Live(Viewers),
    /// Serve the page of the cell in a browser, read-only and without a server
    ///
    /// The page is at http://127.0.0.1:8090/ unless --metrics names another address. The mapping
    /// adds names, units and ROS topics.
    ///
    /// Exit codes: 0 done, 64 usage, 69 the address or an interface is not available, 78 the
    /// mapping cannot run.
    Page(PageArguments),
    /// Query the knowledge of the plant: skills, components, runs
    ///
    /// Exit codes: 0 done, 64 usage, or an unknown question, 65 the query is wrong, 69 no answer in
    /// time, 74 a file cannot be read or the output cannot be written.
    Ask(AskArguments),
    /// Show which components would run a process, with the reasons
    ///
    /// Lists each skill that the MES considered for each need of the process, and why it was chosen
    /// or not. Without a process: the processes that the MES knows.
    ///
    /// Exit codes: 0 the process can run, 1 a component is missing, 64 usage, or an unknown
    /// process, 65 the answer was not understood, 69 no answer in time, 74 the output cannot be
    /// written.
    Plan(PlanArguments),
    /// Change the sources of the knowledge of the plant while ua-mes runs
    ///
    /// Adds, replaces and removes NodeSets, manifests of modules, Turtle and processes. Sources
    /// that the YAML of ua-mes names are changed there; SIGHUP reads them again.
    ///
    /// Exit codes: 0 done, 64 usage, or an unknown source, 65 the source is wrong, 69 no answer in
    /// time, or the user may not change sources, 74 a file cannot be read or the output cannot be
    /// written.
    Source(SourceArguments),
    /// Import processes from recipes of other programs: BatchML and BPMN
    ///
    /// Exit codes: 0 done, with or without notes, 64 usage, 65 the recipe is wrong, or no process
    /// can have it, 69 no answer in time, or the user may not change sources, 74 a file cannot be
    /// read or the output cannot be written.
    Process(ProcessArguments),
    /// Start, list and stop jobs: runs of the processes that ua-mes knows
    ///
    /// Exit codes: 0 done, 1 the job failed (with --wait), 64 usage, or an unknown process or job,
    /// 69 no answer in time, the outcome of the job is unknown, or the user may not run jobs, 74
    /// the output cannot be written.
    Job(JobArguments),
    /// Configure the components of a product from an AutomationML file
    ///
    /// Each element of the file with an attribute ApplicationUri is a component, and its other
    /// attributes are the fields of its configuration. ua-mes checks all fields at all components
    /// first, and then sets them. If a component refuses or is lost meanwhile, the others are set
    /// back.
    ///
    /// Exit codes: 0 all fields are set, or accepted with --check, 1 a component refuses its fields
    /// or was lost, and all have their values from before, 64 usage, or the file is wrong, 69 no
    /// answer in time, it is unknown which values a component has, or the user may not configure,
    /// 74 the file cannot be read or the output cannot be written.
    Configure(ProductArguments),
    /// Show the sequence of actions that reaches a goal, with the proof of each step
    ///
    /// Actions are capabilities with facts that hold before and after them. Those with a skill in
    /// the plant are used. `ua-space job start GOAL` runs the sequence.
    ///
    /// Exit codes: 0 done, 1 the goal cannot be reached, 64 usage, or an unknown goal, 69 no answer
    /// in time, 74 the output cannot be written.
    Goal(GoalArguments),
    /// Run an RML mapping of XML files and print RDF
    ///
    /// The mapping is Turtle in the vocabulary of R2RML and RML (semweb.mmlab.be/ns/rml#) or in
    /// that of w3id.org/rml/. It reads files of its own folder. Values that are no term are
    /// reported on stderr, and cost single statements only. `ua-space source add FILE --rml
    /// MAPPING` adds the statements to the knowledge of the plant.
    ///
    /// Exit codes: 0 done, 64 usage, 65 the mapping or a file is wrong, 74 a file cannot be read or
    /// the output cannot be written.
    Rml(Rml),
    /// Show the products of STEP files with their extents
    ///
    /// Extents are the box around a product in its own axes, in millimetres. They are shown if they
    /// are proven to 0.1 mm; otherwise a finding names the face or edge and the reason. `ua-space
    /// source add FILE` adds the products to the knowledge of the plant.
    ///
    /// Exit codes: 0 done, 65 a file is no STEP file of products, or the extents of a product are
    /// not proven, 74 a file cannot be read or the output cannot be written.
    Products(ProductsArguments),
    /// Print NodeSets as OWL ontologies
    ///
    /// Prints all nodes, references, modelling rules, interfaces, DataTypes and values as Turtle.
    /// Required models are imports. Each NodeSet is an ontology of its own; name several files to
    /// get all of them in one graph.
    ///
    /// Exit codes: 0 done, 65 a file is no NodeSet, 74 a file cannot be read or the output cannot
    /// be written.
    Owl(Owl),
    /// Read manifests of process modules (MTP): check, skills, pictures, RDF, run
    ///
    /// Documents that a manifest refers to are read from its folder or its container.
    ///
    /// Exit codes: 0 done, with or without notes, 64 usage, 65 a file is no manifest, or an element
    /// is inconsistent, 74 a file cannot be read or the output cannot be written.
    Mtp(MtpArguments),
    /// Print the asset administration shell (AAS V3, JSON) of a process module
    ///
    /// Its submodels are the digital nameplate, the capabilities of its services, its OPC UA servers
    /// with their nodes, and the manifest.
    ///
    /// Exit codes: 0 done, 64 usage, 65 the file is no manifest, 74 the file cannot be read or the
    /// output cannot be written.
    Aas(AasArguments),
    /// Simulate the process module (PEA) of a manifest as an OPC UA server
    ///
    /// Serves all nodes of the manifest, with modes, the state machines of the services and their
    /// parameters, until SIGINT or SIGTERM. Options make it deviate from the standard, as modules
    /// in the field do.
    ///
    /// Exit codes: 0 ended by a signal, 64 usage, 65 the file is no manifest, 69 the address is not
    /// available, 74 the file cannot be read.
    Pea(PeaArguments),
    /// Print the completion script of a shell, which also completes names of skills and topics
    ///
    /// For bash: `source <(ua-space completion bash)`; for zsh likewise; for fish: `ua-space
    /// completion fish | source`.
    Completion(Completion),
    /// Candidates for the last word
    #[command(hide = true)]
    Complete(Complete),
}

#[derive(Debug, Args)]
pub(crate) struct Completion {
    /// Which shell
    #[arg(value_name = "SHELL", value_enum)]
    pub(crate) shell: CompletionShell,
}

/// A shell that completes words.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum CompletionShell {
    /// GNU Bash
    Bash,
    /// Zsh
    Zsh,
    /// Fish
    Fish,
}

#[derive(Debug, Args)]
pub(crate) struct Rml {
    /// The mapping, a file of Turtle
    #[arg(value_name = "MAPPING")]
    pub(crate) mapping: String,
    /// Files in the place of those that the mapping names, as NAME=FILE; FILE alone if it names one
    /// file only. - for stdin
    #[arg(value_name = "FILE")]
    pub(crate) files: Vec<String>,
    /// The format of the output
    #[arg(long, value_name = "FORMAT", value_enum, default_value = "turtle")]
    pub(crate) format: RdfFormat,
}

#[derive(Debug, Args)]
pub(crate) struct ProductsArguments {
    /// STEP files of AP203, AP214 or AP242, or - for stdin
    #[arg(value_name = "FILE", required = true)]
    pub(crate) files: Vec<String>,
    /// Print JSON, in metres
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct Owl {
    /// NodeSet2 files, or - for stdin
    #[arg(value_name = "FILE", required = true)]
    pub(crate) files: Vec<String>,
}

/// A format of RDF.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RdfFormat {
    /// Turtle; TriG if the mapping has graphs
    Turtle,
    /// N-Quads
    Nquads,
}

#[derive(Debug, Args)]
pub(crate) struct Complete {
    /// The words of the line after `ua-space`; the last may be empty
    #[arg(
        value_name = "WORD",
        trailing_var_arg = true,
        allow_hyphen_values = true
    )]
    pub(crate) words: Vec<String>,
}

#[derive(Debug, Args)]
pub(crate) struct CheckArguments {
    /// The mappings, or - for stdin
    #[arg(value_name = "FILE", required = true)]
    pub(crate) files: Vec<String>,
    /// Prints a JSON object per file, with its findings
    #[arg(long)]
    pub(crate) json: bool,
    /// For the host whose program serves this space, or these as 2,3; 0 is ua-server. Faults of
    /// types or NodeSets that only other spaces need are warnings, as for that program. Without it
    /// the whole mapping counts
    #[arg(long = "for", value_name = "SPACE", value_delimiter = ',', value_parser = space)]
    pub(crate) spaces: Vec<SpaceId>,
    /// Ask whether topics, services, types, namespaces and nodes exist: the ROS 1 master
    /// (ROS_MASTER_URI), the DDS domains of the spaces and the OPC UA server, or some of them
    #[arg(
        long,
        value_name = "WHOM",
        value_enum,
        num_args = 0..=1,
        require_equals = true,
        value_delimiter = ',',
        default_missing_value = "ros1,ros2,opcua"
    )]
    pub(crate) environment: Vec<EnvironmentPart>,
    /// Longest time to listen in a DDS domain, in seconds
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
pub(crate) enum EnvironmentPart {
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
    /// A NodeSet file of a modelling tool. May be repeated
    #[arg(long, value_name = "FILE")]
    pub(crate) nodeset: Vec<String>,
    /// A SysML model: the .uml file of Papyrus, or SysML v2 text. May be repeated
    #[arg(long, value_name = "FILE")]
    pub(crate) model: Vec<String>,
    /// A running OPC UA server, as opc.tcp://127.0.0.1:4840. May be repeated
    #[arg(long, value_name = "URL")]
    pub(crate) opcua: Vec<String>,
    /// All discovered sources: the OPC UA servers that `ua-space discover` finds, the ROS 1 master
    /// and the DDS domain of the environment
    #[arg(long)]
    pub(crate) discover: bool,
    #[command(flatten)]
    pub(crate) look: DiscoverArguments,
    /// The output file; without it stdout
    #[arg(short, long, value_name = "FILE")]
    pub(crate) output: Option<String>,
    /// Append new entries to an existing file
    #[arg(long, requires = "output")]
    pub(crate) merge: bool,
    /// The namespace URI of values without a node
    #[arg(long, value_name = "URI", default_value = "urn:ua-bridge:cell")]
    pub(crate) namespace: String,
    /// Include /tf and /tf_static
    #[arg(long)]
    pub(crate) tf: bool,
    /// Longest time to listen in a DDS domain, in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..=600))]
    pub(crate) wait: u16,
    /// Print the summary as a JSON object
    #[arg(long, requires = "output")]
    pub(crate) json: bool,
}

/// Parses a DDS domain; `None` stands for the domain of the environment.
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
pub(crate) struct Acl {
    /// The mapping of the cell
    #[arg(value_name = "MAPPING")]
    pub(crate) mapping: PathBuf,
    /// Print the authorization of nats-server instead
    #[arg(long)]
    pub(crate) nats: bool,
}

#[derive(Debug, Args)]
pub(crate) struct MakeKeys {
    /// The file
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// The length of the keys for encryption
    #[arg(long, value_name = "POLICY", value_enum, default_value_t = KeyPolicy::Aes256)]
    pub(crate) policy: KeyPolicy,
    /// Append a new key to the file
    #[arg(long, conflicts_with_all = ["drop", "policy"])]
    pub(crate) next: bool,
    /// Remove the first key of the file, so that the second is used
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
    /// Only datagrams from or to this UDP port of a capture. Without it: port 4840, and every other
    /// datagram that is a NetworkMessage without a fault
    #[arg(long, value_name = "PORT")]
    pub(crate) port: Option<u16>,
    /// Every line of hexadecimal text is a datagram
    #[arg(long)]
    pub(crate) lines: bool,
    /// Print a JSON array instead of an object per line
    #[arg(long)]
    pub(crate) array: bool,
    #[command(flatten)]
    pub(crate) known: DecoderArguments,
}

#[derive(Debug, Args)]
pub(crate) struct Encode {
    /// The file, or - for stdin
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// Write the bytes themselves, one datagram after another
    #[arg(long)]
    pub(crate) raw: bool,
    #[command(flatten)]
    pub(crate) known: DecoderArguments,
}

/// What a reader has to know besides the datagram.
#[derive(Debug, Args)]
pub(crate) struct DecoderArguments {
    /// Keys of secured messages: a JSON object or an array of objects with policy, securityTokenId,
    /// signingKey, encryptingKey and keyNonce, and optionally publisherId and writerGroupId
    #[arg(long, value_name = "FILE")]
    pub(crate) keys: Option<PathBuf>,
    /// Fields of RawData messages: a JSON array with builtInType, valueRank, arrayDimensions and
    /// maxStringLength of each, or an array of objects with such a metaData and publisherId,
    /// writerGroupId or dataSetWriterId
    #[arg(long, value_name = "FILE")]
    pub(crate) metadata: Option<PathBuf>,
    /// The layout of padded texts and arrays in RawData
    #[arg(long, value_name = "READING", value_enum, default_value_t = RawReading::Standard)]
    pub(crate) raw_reading: RawReading,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RawReading {
    /// By OPC 10000-14
    Standard,
    /// As in open62541 1.5
    Open62541,
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_is_well_formed() {
        ToolArguments::command().debug_assert();
    }
}
