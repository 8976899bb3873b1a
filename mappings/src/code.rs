//! Codes of findings.

use std::fmt;

macro_rules! codes {
    ($($(#[$doc:meta])* $name:ident = $text:literal, $explanation:literal;)*) => {
        /// Kind of a finding. A code keeps its meaning from release to release; new codes may be
        /// added.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[non_exhaustive]
        pub enum Code { $(#[doc = concat!($text, ": ", $explanation)] $name,)* }

        impl Code {
            /// Every code, in ascending order.
            pub const ALL: &'static [Self] = &[$(Self::$name),*];

            /// Returns the text of the code, such as `M001`.
            #[must_use]
            pub const fn as_str(self) -> &'static str {
                match self { $(Self::$name => $text),* }
            }

            /// Returns the general meaning of the code and the remedy.
            #[must_use]
            pub const fn explanation(self) -> &'static str {
                match self { $(Self::$name => $explanation),* }
            }

            /// Returns a short document with such a finding, and the findings as
            /// [`Checked::render`](crate::Checked::render) renders them.
            #[must_use]
            pub const fn example(self) -> (&'static str, &'static str) {
                match self {
                    $(Self::$name => (
                        include_str!(concat!("../tests/bad/", $text, ".yaml")),
                        include_str!(concat!("../tests/bad/", $text, ".txt")),
                    )),*
                }
            }
        }
    };
}

codes! {
    Syntax = "M001", "The text is not YAML, or uses what is not read here: several documents, tags, references to nothing. Nothing after the place has been looked at.";
    TooLarge = "M002", "The document passes a limit: 32 MiB, 2 500 000 values, 100 000 variables, 24 levels of nesting.";
    UnknownKey = "M003", "No key of that name is read at this place. Keys are spelt in lower case with underscores.";
    DuplicateKey = "M004", "A key occurs twice in one map. The first one counts, which is seldom what was meant.";
    WrongValue = "M005", "The value is not what its key takes: a list, a map, a number of a range, or one of a few words.";
    MissingKey = "M006", "A key that has no default is not there.";
    SpaceId = "M010", "A space is 1 (the one ROS 1 space) or 2..232 (ROS 2 spaces); 0 is the OPC UA side and is always there.";
    SpaceTwice = "M011", "Two spaces have one id.";
    Domain = "M012", "A DDS domain is 0..232 and only a ROS 2 space has one.";
    DomainTwice = "M013", "Two spaces live in one DDS domain, so neither bridge could tell whose a topic is.";
    UndeclaredSpace = "M014", "A variable names a space that is not listed under `spaces`.";
    Address = "M020", "The PubSub address is neither `opc.udp://<IPv4 or IPv6 address>:<port>` nor `mqtt://<host>:<port>` (with TLS `mqtts://`). A host name of a UDP address would have to be resolved, and is not read. The user name and password of a broker are in a file, `mqtt: {credentials: ..}`.";
    DiscoveryGroup = "M021", "224.0.2.14 is the group OPC UA keeps for discovery messages; data sent there reaches everybody who looks for publishers.";
    UnscopedGroup = "M022", "The group is none of 239.0.0.0/8, which sites use as they like; others are assigned to protocols and may be treated by switches as such.";
    Interface = "M023", "An interface is named as the operating system does (at most 15 characters, `ip link` lists them) or by an address of it.";
    Duration = "M024", "A duration is a number with its unit, as 500ms, 1s or 2.5s, from 10ms to 1h.";
    Timing = "M025", "A writer that has nothing to say speaks once per keep_alive_period: with a shorter receive_timeout it would be taken for dead each time.";
    Namespace = "M030", "A namespace is an index 1..65535 and a URI, each of them once.";
    UndeclaredNamespace = "M031", "A node's namespace index is not listed under `namespaces`. The index alone means nothing: servers number their namespaces as they like, the URI ties it down.";
    Endpoint = "M040", "The endpoint is not `opc.tcp://<host>:<port>[/path]`.";
    ApplicationUri = "M041", "The ApplicationUri is a URI as urn:my-plant:server; certificates carry it.";
    NodeId = "M050", "A node id is `ns=<index>;i=<number>`, or `s=<text>`, `g=<guid>`, `b=<base64>` after the `;`.";
    AliasNeeded = "M051", "The identifier of a topic is a number 1..65535. A node whose id is none (a text, a Guid, opaque bytes, 0 or above 65535, or in namespace 0) needs an `alias`.";
    Alias = "M052", "An alias is 1..65535 and stands for a node id that is no such number; other nodes keep their own number.";
    NodeTwice = "M053", "Two variables have one node. A value has one origin; the node of the server would have two.";
    TopicTwice = "M054", "Two variables have one topic, so one would be taken for the other.";
    NameTwice = "M055", "Two variables of one namespace have one name, and look the same to people who browse the server.";
    Name = "M056", "A variable's name has 1..512 characters and none of them is a control character.";
    ValueType = "M057", "The type is an OPC UA builtin type, with `[]` behind it for an array of one dimension.";
    RosTopic = "M060", "A ROS topic name begins with / and has letters, digits and underscores between slashes; in ROS 1 the first character is a letter, in ROS 2 no part begins with a digit.";
    SpaceName = "M061", "The topic's name is one of the space, but not the name of this variable. Zero configuration would carry it as another value.";
    MessageTypeName = "M062", "A message type is package/Name or package/msg/Name.";
    UnknownMessageType = "M063", "No definition of the message type is built in. What a ROS 1 publisher sends brings its definition along; all else must be known.";
    UnknownField = "M064", "The message type has no such field. Fields of nested messages are named from the outside in: pose.position.x.";
    TypeDiffers = "M065", "The declared type is not the type of the bound field, or several fields are bound where one value is declared.";
    BindingsDiffer = "M066", "The fields of two bindings of one variable differ in number or type, so the value of one cannot be written to the other.";
    BindingTwice = "M067", "A variable is bound twice in one space.";
    WrittenTwice = "M068", "Two variables are written to one ROS topic, which would show now the one value, now the other.";
    ReadAndWritten = "M069", "One ROS topic is read for one variable and written for another: what is written would come back under the other name.";
    TopicTypesDiffer = "M070", "One ROS topic is bound with two message types.";
    OpcUaBinding = "M071", "Space 0 is the OPC UA side and has no ROS topics.";
    FieldOfBytes = "M072", "A message bound `as: bytes` crosses as it is, so no field of it can be named.";
    BindingKind = "M073", "A ROS binding has exactly one of `topic`, `call`, `answer` and `poll`, and beside it only the keys that go with it.";
    ServiceSpace = "M074", "`call` takes values from other spaces; what `answer` and `poll` bring is produced in the space of the service, its origin.";
    UnknownServiceType = "M075", "No definition of the service type is built in. The connection to a service does not carry it, so a package with the .srv file must be below one of the folders of ROS_PACKAGE_PATH when the bridge runs.";
    RequestConstant = "M076", "A constant of a request is a value of its field: the field exists, is given once, does not take the value too, and the value is of its type and range.";
    Answer = "M077", "`answer` names the node of a variable that has a `call`; its value is what that service answers.";
    When = "M078", "`when` is a value of the variable's type, and goes with a `call` that has no `field` or `fields`: with one, each value is sent.";
    TopicPattern = "M079", "A pattern of topics is a topic name in which `*` stands for one or more characters of a part, and at most one part `**` for any number of parts.";
    PatternCapture = "M080", "`{1}` in the `node`, `alias` or `name` of a pattern stands for what its first wildcard does, and so on. Node and alias have one, or all topics would be one node.";
    FieldPart = "M081", "In brackets behind a field that is an array of values stands the part of it: `[2]` the third element, `[name=joint_3]` the one whose place has joint_3 in the array `name` beside it, `[0:90]` the first ninety.";
    PartWritten = "M082", "A part of an array is read from ROS. It cannot be written, since nothing says what stands in the rest of the array.";
    Conversion = "M083", "`scale` and `offset` go with a number, `invert` with a Boolean, all of them with one field; `out_of_range` says what becomes of numbers that a conversion makes too big. Of several `fields` each has its own; of a service those of the request, or of what it answers, convert likewise.";
    LossyConversion = "M084", "The type the value becomes cannot hold all that the other type can, so a number would be rounded or not fit. With `out_of_range` it is rounded; one that does not fit then does not cross and is counted with `refuse`, and becomes the nearest that fits with `clamp`. So write one of them beside the `field`; or give the variable a `type` that holds all values, such as Double, and nothing has to be said.";
    Publish = "M085", "`deadband` is a number above 0, of values that are numbers, or of which one at least is; `at_most` a rate as 10 Hz, from 0.001 Hz to 1000 Hz.";
    Fields = "M090", "`fields` names at least one field, each once, and stands in place of `field`. What converts a value stands with its field, as {field: linear.x, scale: 1000}.";
    FieldOrder = "M091", "Fields that are written to ROS stand in the order the message has them, and none of them is in another.";
    StructureOf = "M092", "A structure is a message: the whole one, or a message in it that `field` names. A structure on both sides is of one message type.";
    UnitUnknown = "M093", "A `unit` is one of those known by symbol (m/s), UNECE code (MTS) or name (metre per second), and goes with a value that is a number.";
    ValueRange = "M094", "A `range` is the lowest and the highest value, as [0, 1.5], of a value that is a number.";
    EnumTexts = "M095", "An `enum` says what the numbers of an integer value mean, as {0: idle, 1: moving}: at most 1000 texts that are not empty.";
    UaField = "M096", "`ua_field` names the one field that is the value, out of several that a publisher sends that is none of the bridges. A variable that has several fields takes them all, and a bridge sends the value alone.";
    OnLoss = "M097", "`on_loss` says what is published once into ROS when the commander of a value has ended or timed out: `zero`, a value for the bound `field`, fields of the message, or `{call: NODE}` of a variable that calls a service with the same request each time. It goes with a topic in another space than the `origin`; `hold` goes with it.";
    StoredMotion = "M098", "A velocity, a steering command, a joystick or a trajectory with `queue: keep_latest` is stored, and a subscriber that starts late moves the robot by it. Without `queue` it is an event: present subscribers get it, once.";
    EndlessMotion = "M099", "When the commander of a joystick or a trajectory is lost, the robot goes on with the last one: zero is a movement of these types, so `on_loss` needs the fields of a message that stops this robot, or a service that does.";
    TypePath = "M100", "An entry of `type_paths` is a folder with ROS packages or a definition file (.msg, .srv, .action, .idl), relative to the mapping. One that is not there, or holds none, brings no types; on the host of another program of the cell that may be as it should.";
    DefinitionFile = "M101", "A definition file does not parse, in the ROS it is of. It counts as not there, and all others count.";
    DefinitionsDiffer = "M102", "A definition in a file differs from the one that is built in under its name. The file counts. Where peers have the other one, ROS 1 refuses the connection, and ROS 2 messages are misread unless type hashes are announced.";
    VersionsDiffer = "M103", "The message types of two bindings of one variable have different fields, beyond what ROS 2 renamed. Fields cross by their place in the message, so two of another name may be something else.";
    Alarm = "M104", "An `alarm` has one thing that triggers it: limits of a number in ascending order, `normal` or `when` with values of a Boolean, an integer or a text, or `diagnostics` of a DiagnosticArray. At most 5000 variables have one.";
    Include = "M110", "`include` names files beside the file it stands in, one or a list; in the last part of a path `*` stands for any characters. Each of them can be read, and together they are as one document.";
    IncludeTwice = "M111", "A file is included once, and not by itself. Includes nest no deeper than 8 and lead to no more than 256 files.";
    EnvironmentVariable = "M112", "`${NAME}` is the value of an environment variable, `${NAME:-default}` has a default for one that is not set or empty, and `$${` stands for `${` itself.";
    MergeKey = "M113", "`<<` brings the keys of other maps: of an alias, or of a list of aliases.";
    Secret = "M114", "A password stands in the file, in a URL, as in rtsp://user:password@camera, or under `password`. It is not shown here, but whoever can read the file, or a copy of it, has it. Write it as ${NAME}, which the environment of the program gives, and keep the file to its owner (chmod 600). What everybody gets to read, such as the URI of a namespace, and the addresses of the mapping take none at all.";
    PatternUnmatched = "M120", "No topic that is there now fits the pattern and its type. Only `ua-space check --environment` asks for that; a robot that is switched off is no fault of the mapping.";
    TopicAway = "M121", "Nobody publishes the topic that is read, or nobody subscribes to the one that is written, in the graph as it is now. Only `ua-space check --environment` asks for that.";
    LiveTypeDiffers = "M122", "The topic, service or action is there with another type, so not a single message would cross. Only `ua-space check --environment` asks for that.";
    NamespaceIndex = "M123", "In the server that runs the namespace URI has another index, or none. The node ids of the mapping then mean other nodes, or none. Only `ua-space check --environment` asks for that.";
    ServiceAway = "M124", "Nobody offers the service or action in the graph as it is now. Only `ua-space check --environment` asks for that.";
    NodeAway = "M125", "The server that runs has no such variable. Only `ua-space check --environment` asks for that.";
    LiveNodeDiffers = "M126", "The variable is there in the server with another data type. Only `ua-space check --environment` asks for that.";
    NameTaken = "M127", "Somebody else offers a service or action in the graph under the name that the bridge is to offer the call by. Clients would get the one or the other. Only `ua-space check --environment` asks for that.";
    MethodAway = "M128", "The other OPC UA server has no such namespace, Object or Method. Only `ua-space check --environment` asks for that.";
    RemoteNodeAway = "M129", "The other OPC UA server that a variable comes `from` or goes `to` has no such variable, or none that can be read, or written. Only `ua-space check --environment` asks for that.";
    CallExecutor = "M130", "A call is executed in the space of its `origin`, by the one service under `ros` that is of that space. Without one somebody else executes it, which is so with the components of space 0, and it can be asked for elsewhere.";
    CallTopic = "M131", "A call has a topic and a node of its own; those of a variable, or of another call, are taken. An action has five topics: the next four numbers are those of its cancel, its result, its feedback and its status.";
    CallMap = "M132", "In `request` stands what the fields of the call's request are made of, in `response` what those of the service here are made of: constants, or fields of the other side, of the same type. `goal`, and `feedback` and `result`, are the same of actions. What is not named goes by name, and what then is made of nothing needs a constant. The service or action that executes the call has none of them.";
    CallTwice = "M133", "Two calls have one service or action in a space.";
    CallBinding = "M134", "Under `ros` of a call stands a `service` with its `request` and `response`, or an `action` with its `goal`, `feedback` and `result`. All of a call are of one kind, as a service has an answer at once, and an action takes its time. A Method of an OPC UA server is asked for by services.";
    UnknownActionType = "M135", "No definition of the action type is built in, so a package with the .action file must be in `type_paths`, or below one of the folders of ROS_PACKAGE_PATH or AMENT_PREFIX_PATH, when the bridge runs.";
    MethodTarget = "M136", "`opcua` says which Method of which other OPC UA server executes a call: `server`, the name of one of `servers`, or its `endpoint`, then `object` and `method`, the nodes as nsu=urn:plc;s=Line.Reset. The cell's own server calls it, so the call has `origin: 0`, a node of a namespace of `namespaces`, and the endpoint is not that of the cell's server itself.";
    Servers = "M137", "An entry of `servers` is an OPC UA server that exists already: a `name` of its own, of letters, digits, `_`, `-` and `.`, its `endpoint`, which is not that of the cell's own server, and, where it wants a known user, `user` and `password`. `skills` is a namespace of `namespaces` that is theirs alone. `server.find_skills` names by their ApplicationUris servers that discovery finds, and keeps namespaces from `first` on for the skills of these, in which nothing else is.";
    RemoteNode = "M138", "`from` and `to` name a node of one of `servers`. A value that comes `from` one is produced there, so its `origin` is 0 and it has a node of a namespace of `namespaces`. One that goes `to` one is a single value, and goes to another node than it comes from.";
    OpenUser = "M139", "With `security: None` a user name and a password go to the server over a session without security. Whether the password is encrypted is then the server's choice, and whoever is on the network can take the session over. Write `security: Basic256Sha256`; left out it is the same where there is a user.";
    SecurityGroup = "M150", "An entry of `security` is a SecurityGroup of OPC UA PubSub: a `group`, each once, and the `namespaces` that are its, none of them in two groups. One group may be without `namespaces`: it has all that no other names.";
    GroupKeys = "M151", "The `keys` of a secured group come from a file that only its owner can read, from a credential of systemd, or from a Security Key Service. They never stand in the mapping itself, which is copied to every host of the cell.";
    HalfSecured = "M152", "Some of what is sent is secured, and a namespace is not. Who can write there can steer what is read there. `mode: none` in a group with that namespace says that it is meant.";
    OpenCall = "M153", "A call can be asked for without a key, in a cell where values are secured. To execute something is worth more protection than to read something, and not less.";
    KeyService = "M154", "With `keys: {sks: {}}` the cell's own server makes the keys of a group and hands them out, over encrypted sessions, to its own server and bridges and to the programs that `members` names by the ApplicationUris in their certificates; each key is used for `key_lifetime`. With an `endpoint` another Security Key Service does, and that is then its own affair.";
    Permissions = "M160", "`permissions` says which roles may `read`, `write` or `call` a node at the server: observer, operator, engineer, security_admin, one or a list, each once. Left out: everybody reads, and operators and engineers write and call. What is produced in another space than 0 no client writes.";
    OpenServer = "M161", "A server that other hosts reach is open to them: it offers None, with which nothing is signed or encrypted, or users without a name may write and call. Both have to be said in the mapping, and seldom should be.";
    Quality = "M162", "`quality` says when a value is no longer good because no newer one comes: `uncertain_after` so long, and `bad_after` it has been uncertain for so long. It goes with values that come from other programs. Values that are sent on change only, or less often than that, would be taken for old while they are not.";
    Confirm = "M163", "`confirm` says what tells that a value has arrived. `bridge` goes with events for a topic or a service of another space: each bridge confirms them, within the time that `within` says. `by` ties what clients write to what the robot answers: it is the node of the variable that answers, of another space or `from` a server, `within` how long that may take, and `when` or `equals` which answer counts. The answer is sent anew for each write, and has the type of what is written unless `equals` or `when: any` says otherwise.";
    NodeSet = "M170", "`server.nodesets` names NodeSet2 files (XML, OPC 10000-6, Annex F), each beside the file it stands in, of at most 64 MiB. Each namespace that one of them needs is that of another of them, or OPC UA's own, which every server has; no two have the same. Only programs that serve space 0 read them.";
    NodeSetNode = "M171", "A `node` that a NodeSet has is a Variable, or with a call a Method, and its values are of the type that it has there. In a namespace of a NodeSet a node that it does not have is made anew.";
}

impl Code {
    /// Returns `true` if the finding depends on the type definitions of this host: another host may
    /// have the definition, or another version of it.
    pub(crate) const fn lies_in_definitions(self) -> bool {
        matches!(
            self,
            Self::UnknownMessageType
                | Self::UnknownField
                | Self::TypeDiffers
                | Self::BindingsDiffer
                | Self::UnknownServiceType
                | Self::RequestConstant
                | Self::When
                | Self::FieldPart
                | Self::Conversion
                | Self::LossyConversion
                | Self::FieldOrder
                | Self::StructureOf
                | Self::Alarm
                | Self::CallMap
                | Self::UnknownActionType
                | Self::NodeSet
                | Self::NodeSetNode
        )
    }
}

impl fmt::Display for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl std::str::FromStr for Code {
    type Err = UnknownCode;

    /// Reads a code such as `M001`, in upper or lower case.
    fn from_str(text: &str) -> Result<Self, UnknownCode> {
        let found = Self::ALL
            .iter()
            .find(|code| code.as_str().eq_ignore_ascii_case(text));
        found.copied().ok_or(UnknownCode)
    }
}

/// Error for a text that is not a code.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no finding has that code; codes are M001 to M171")]
pub struct UnknownCode;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_is_read_back_from_its_text() {
        for code in Code::ALL {
            assert_eq!(code.as_str().parse(), Ok(*code));
            assert_eq!(code.as_str().to_lowercase().parse(), Ok(*code));
        }
        assert_eq!("M999".parse::<Code>(), Err(UnknownCode));
    }

    #[test]
    fn codes_ascend_and_none_is_used_twice() {
        let texts: Vec<&str> = Code::ALL.iter().map(|code| code.as_str()).collect();
        assert!(texts.is_sorted_by(|a, b| a < b), "{texts:?}");
        assert_eq!(
            UnknownCode
                .to_string()
                .rsplit("are ")
                .next()
                .unwrap_or_default()
                .to_owned(),
            format!("{} to {}", texts[0], texts[texts.len() - 1])
        );
    }
}
