//! Codes of findings.

macro_rules! codes {
    ($($name:ident = $text:literal, $explanation:literal;)*) => {
        documents::finding_codes! {
            /// Kind of a finding. A code keeps its meaning from release to release; new codes may
            /// be added.
            Code { $($name = $text, $explanation;)* }
        }

        impl Code {
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
    Syntax = "M001", "The text is not valid YAML, or uses YAML that is not supported: several documents, tags, undefined aliases. The document after this position was not checked.";
    TooLarge = "M002", "The document exceeds a limit: 32 MiB, 2 500 000 values, 100 000 variables, 24 levels of nesting.";
    UnknownKey = "M003", "Unknown key. Keys are written in lower case with underscores; the finding lists the keys that are possible here.";
    DuplicateKey = "M004", "A key occurs twice in one map. Only the first is used: remove the other.";
    WrongValue = "M005", "The value has the wrong form for its key. The finding states the expected form, such as a list, a map, a range of numbers or a fixed word.";
    MissingKey = "M006", "A required key is missing. It has no default.";
    SpaceId = "M010", "A space is 1 (the ROS 1 space) or 2 to 232 (ROS 2 spaces); 0 is the OPC UA side and always exists.";
    SpaceTwice = "M011", "Two spaces have the same id.";
    Domain = "M012", "A DDS domain is 0 to 232, and only a ROS 2 space has one.";
    DomainTwice = "M013", "Two spaces are in the same DDS domain, so the bridges cannot distinguish their topics. Give each space its own domain.";
    UndeclaredSpace = "M014", "A variable names a space that is not listed under `spaces`.";
    Address = "M020", "The PubSub address is neither `opc.udp://<IPv4 or IPv6 address>:<port>` nor `mqtt://<host>:<port>` (with TLS `mqtts://`). Host names of UDP addresses are not supported. Put the user name and password of a broker into a file, `mqtt: {credentials: ..}`. An address under `eth` is the MAC address of a host or group, alone or as `opc.eth://<MAC address>:<VLAN>.<priority>`.";
    DiscoveryGroup = "M021", "224.0.2.14 is the group of OPC UA for discovery messages; data sent there reaches every program that searches for publishers.";
    UnscopedGroup = "M022", "The group is outside 239.0.0.0/8, the range for free use within a site. Other groups are assigned to protocols, and switches may treat them as such.";
    Interface = "M023", "An interface is given by its name in the operating system (at most 15 characters, `ip link` lists them) or by an address of it.";
    Duration = "M024", "A duration is a number with its unit, such as 500ms, 1s or 2.5s, from 10ms to 1h.";
    Timing = "M025", "A writer without new values sends a message once per keep_alive_period. With a shorter receive_timeout it would be reported as lost each time.";
    Carriers = "M026", "A list of carriers has 1 to 4 entries with `udp`, `mqtt`, `eth` or `shm`, each with another address, and at most one entry with `settings` for all of them.";
    Forward = "M027", "A name under `forward` is a space (ua_1), a namespace of it (ua_1_2) or a topic (ua_1_2_10). The publisher of a name is at one carrier, so a name and its parts are listed at one carrier only; otherwise its messages would go round in a circle.";
    Namespace = "M030", "A namespace is an index from 1 to 65535 and a URI; each occurs once.";
    UndeclaredNamespace = "M031", "The namespace index of a node is not listed under `namespaces`. An index alone is ambiguous, because servers number their namespaces differently; the URI identifies the namespace.";
    Endpoint = "M040", "The endpoint is not `opc.tcp://<host>:<port>[/path]`.";
    ApplicationUri = "M041", "The ApplicationUri is a URI such as urn:my-plant:server; certificates contain it.";
    NodeId = "M050", "A node id is `ns=<index>;i=<number>`, or `s=<text>`, `g=<guid>`, `b=<base64>` after the `;`.";
    AliasNeeded = "M051", "The identifier of a topic is a number from 1 to 65535. A node with another id (a text, a Guid, opaque bytes, 0, above 65535, or in namespace 0) needs an `alias`.";
    Alias = "M052", "An alias is 1 to 65535 and replaces a node id that is not such a number; other nodes keep their own number.";
    NodeTwice = "M053", "Two variables have the same node. A value has one origin, so each variable needs its own node.";
    TopicTwice = "M054", "Two variables have the same topic, so their values cannot be distinguished.";
    NameTwice = "M055", "Two variables of a namespace have the same name, so users cannot distinguish them in the server.";
    Name = "M056", "The name of a variable has 1 to 512 characters without control characters.";
    ValueType = "M057", "The type is an OPC UA builtin type, followed by `[]` for an array of one dimension.";
    RosTopic = "M060", "A ROS topic name begins with / and has letters, digits and underscores between slashes; in ROS 1 the first character is a letter, in ROS 2 no part begins with a digit.";
    SpaceName = "M061", "The topic name is a name of the space, but not the name of this variable. Zero configuration would bridge the topic as another value.";
    MessageTypeName = "M062", "A message type is package/Name or package/msg/Name.";
    UnknownMessageType = "M063", "No definition of the message type is built in. A ROS 1 publisher sends the definition with its connection; all other types need a definition file.";
    UnknownField = "M064", "The message type has no such field. Fields of nested messages are written from the outside to the inside: pose.position.x.";
    TypeDiffers = "M065", "The declared type differs from the type of the bound field, or several fields are bound to a variable with a single value.";
    BindingsDiffer = "M066", "The fields of two bindings of one variable differ in number or type, so a value cannot be converted between them.";
    BindingTwice = "M067", "A variable has two bindings in one space.";
    WrittenTwice = "M068", "Two variables are written to one ROS topic, which would carry both values in turn.";
    ReadAndWritten = "M069", "One ROS topic is read for one variable and written for another: written values would be read again as values of the other variable.";
    TopicTypesDiffer = "M070", "One ROS topic is bound with two message types.";
    OpcUaBinding = "M071", "Space 0 is the OPC UA side and has no ROS topics.";
    FieldOfBytes = "M072", "A message with `as: bytes` is transferred unchanged, so its fields cannot be bound.";
    BindingKind = "M073", "A ROS binding has exactly one of `topic`, `call`, `answer` and `poll`, and only the keys that belong to it.";
    ServiceSpace = "M074", "`call` requires values of other spaces; the values of `answer` and `poll` are produced in the space of the service, their origin.";
    UnknownServiceType = "M075", "No definition of the service type is built in. A service connection does not carry the definition, so add a package with the .srv file to `type_paths` or ROS_PACKAGE_PATH before the bridge starts.";
    RequestConstant = "M076", "A constant of a request is a value of its field: the field exists, is given once, is not the field that takes the value, and the value has the type and range of the field.";
    Answer = "M077", "`answer` gives the node of a variable that has a `call`; its value is the response of this service.";
    When = "M078", "`when` is a value of the type of the variable. It requires a `call` without `field` and `fields`: with one of them, each value is sent.";
    TopicPattern = "M079", "A pattern of topics is a topic name in which `*` matches one or more characters within a part, and at most one part `**` matches any number of parts.";
    PatternCapture = "M080", "`{1}` in the `node`, `alias` or `name` of a pattern stands for the text that the first wildcard matches, `{2}` for the second. Node and alias need one of them, because each topic needs its own node.";
    FieldPart = "M081", "Brackets after an array field select a part of it: `[2]` the third element, `[name=joint_3]` the element at the position of joint_3 in the array `name` of the same message, `[0:90]` the first ninety elements.";
    PartWritten = "M082", "A part of an array can only be read from ROS. It cannot be written, because the rest of the array would have no values.";
    Conversion = "M083", "`scale` and `offset` require a number, `invert` a Boolean, each with a single field; `out_of_range` treats numbers that do not fit after a conversion. Several `fields` have their own conversions; fields of a request and of a response are converted in the same way.";
    LossyConversion = "M084", "The target type cannot hold all values of the source type, so a number may be rounded or may not fit. With `out_of_range` numbers are rounded; a number that does not fit is dropped and counted with `refuse`, and replaced by the nearest possible number with `clamp`. Add one of the two beside the `field`, or give the variable a `type` that holds all values, such as Double.";
    Publish = "M085", "`deadband` is a number above 0 and requires a number, or several fields of which at least one is a number; `at_most` is a rate such as 10 Hz, from 0.001 Hz to 1000 Hz.";
    Fields = "M090", "`fields` has at least one field, each once, and replaces `field`. The conversion of a value belongs to its field, such as {field: linear.x, scale: 1000}.";
    FieldOrder = "M091", "Fields that are written to ROS are in the order of the message, and no field contains another.";
    StructureOf = "M092", "A structure is a message: the whole message, or a nested message that `field` selects. A structure on both sides has the same message type.";
    UnitUnknown = "M093", "A `unit` is given by its symbol (m/s), its UNECE code (MTS) or its name (metre per second), and requires a number.";
    ValueRange = "M094", "A `range` is the lowest and the highest value, such as [0, 1.5], and requires a number.";
    EnumTexts = "M095", "An `enum` gives the meaning of the numbers of an integer value, such as {0: idle, 1: moving}: at most 1000 texts that are not empty.";
    UaField = "M096", "`ua_field` selects the field of the value in the messages of a publisher that is not a bridge and sends several fields. A variable with several fields takes all of them, and a bridge sends each value alone.";
    OnLoss = "M097", "`on_loss` is published once into ROS when the commander of a value has stopped or timed out: `zero`, a value for the bound `field`, fields of the message, or `{call: NODE}` for a variable that calls a service with a fixed request. It requires a topic in a space other than the `origin`; `hold` requires `on_loss`.";
    StoredMotion = "M098", "A velocity, a steering command, a joystick or a trajectory with `queue: keep_latest` is stored, so a subscriber that starts late moves the robot with an old command. Without `queue` the value is an event: only present subscribers receive it, once.";
    EndlessMotion = "M099", "When the commander of a joystick or a trajectory is lost, the robot continues with the last command. Zero is a movement for these types, so `on_loss` needs the fields of a message that stops this robot, or a service that stops it.";
    TypePath = "M100", "An entry of `type_paths` is a folder with ROS packages or a definition file (.msg, .srv, .action, .idl), relative to the mapping. A missing or empty folder provides no types; this may be correct on the host of another program of the cell.";
    DefinitionFile = "M101", "A definition file is not valid in its ROS version. It is ignored, and all other files are used.";
    DefinitionsDiffer = "M102", "A definition file differs from the built-in definition of the same name. The file is used. If the peers use the other definition, ROS 1 refuses the connection, and ROS 2 messages are misread unless type hashes are announced.";
    VersionsDiffer = "M103", "The message types of two bindings of one variable have different fields, apart from the fields that ROS 2 renamed. Fields are matched by position, so two fields of different names may have different meanings.";
    Alarm = "M104", "An `alarm` has one trigger: limits of a number in ascending order, `normal` or `when` with values of a Boolean, an integer or a text, or `diagnostics` of a DiagnosticArray. At most 5000 variables have an alarm.";
    Include = "M110", "`include` lists files, relative to the file that contains it, as a single path or a list; `*` in the last part of a path matches any characters. Every file must be readable, and all of them together are one document.";
    IncludeTwice = "M111", "A file is included once, and not by itself. Includes have at most 8 levels and 256 files.";
    EnvironmentVariable = "M112", "`${NAME}` is the value of an environment variable, `${NAME:-default}` has a default for a variable that is unset or empty, and `$${` stands for the text `${`.";
    MergeKey = "M113", "`<<` adds the keys of other maps: of an alias, or of a list of aliases.";
    Secret = "M114", "The file contains a password, in a URL such as rtsp://user:password@camera or under `password`. The finding does not show it, but every reader of the file or of a copy has it. Write ${NAME}, set this environment variable for the program, and restrict the file to its owner (chmod 600). Values that every client can read, such as the URI of a namespace, and the addresses of the mapping cannot contain a password.";
    PatternUnmatched = "M120", "No current topic matches the pattern and its type. Only `ua-space check --environment` checks this; a robot that is switched off is not an error of the mapping.";
    TopicAway = "M121", "No node publishes the topic that is read, or subscribes to the topic that is written, at the moment. Only `ua-space check --environment` checks this.";
    LiveTypeDiffers = "M122", "The topic, service or action currently has another type, so no message would be transferred. Only `ua-space check --environment` checks this.";
    NamespaceIndex = "M123", "The running server has the namespace URI at another index, or not at all, so the node ids of the mapping refer to other nodes, or to none. Only `ua-space check --environment` checks this.";
    ServiceAway = "M124", "No node offers the service or action at the moment. Only `ua-space check --environment` checks this.";
    NodeAway = "M125", "The running server has no such variable. Only `ua-space check --environment` checks this.";
    LiveNodeDiffers = "M126", "The variable of the running server has another data type. Only `ua-space check --environment` checks this.";
    NameTaken = "M127", "Another node already offers a service or action with the name that the bridge would offer. Clients would reach either of the two. Only `ua-space check --environment` checks this.";
    MethodAway = "M128", "The other OPC UA server has no such namespace, Object or Method. Only `ua-space check --environment` checks this.";
    RemoteNodeAway = "M129", "The other OPC UA server of `from` or `to` has no such variable, or the variable cannot be read or written. Only `ua-space check --environment` checks this.";
    CallExecutor = "M130", "A call is executed in the space of its `origin`, by the single service of this space under `ros`. Without such a service another program executes it, such as a component of space 0, and other spaces can request it.";
    CallTopic = "M131", "A call needs its own topic and node, different from those of variables and other calls. An action has five topics: the next four numbers are its cancel, its result, its feedback and its status.";
    CallMap = "M132", "`request` lists the sources of the fields of the request of the call, and `response` the sources of the fields of the response of the service here: constants, or fields of the other side with the same type. `goal`, and `feedback` and `result`, do the same for actions. Fields without an entry are matched by name; a field that has no source then needs a constant. The service or action that executes the call has none of these keys.";
    CallTwice = "M133", "Two calls have the same service or action in a space.";
    CallBinding = "M134", "`ros` of a call has a `service` with its `request` and `response`, or an `action` with its `goal`, `feedback` and `result`. All bindings of a call are of one kind, because a service returns at once and an action takes time. Services request a Method of an OPC UA server.";
    UnknownActionType = "M135", "No definition of the action type is built in, so add a package with the .action file to `type_paths`, ROS_PACKAGE_PATH or AMENT_PREFIX_PATH before the bridge starts.";
    MethodTarget = "M136", "`opcua` gives the Method of another OPC UA server that executes a call: `server`, the name of one of `servers`, or its `endpoint`, then `object` and `method`, the nodes, such as nsu=urn:plc;s=Line.Reset. The server of the cell calls the Method, so the call has `origin: 0` and a node of a namespace of `namespaces`, and the endpoint is another server.";
    Servers = "M137", "An entry of `servers` is an existing OPC UA server: a unique `name` of letters, digits, `_`, `-` and `.`, its `endpoint`, which differs from the endpoint of the cell's own server, and `user` and `password` if it requires a user. `skills` is a namespace of `namespaces` that belongs only to its skills. `server.find_skills` lists the ApplicationUris of servers that discovery finds, and reserves namespaces from `first` on for their skills.";
    RemoteNode = "M138", "`from` and `to` give a node of one of `servers`. A value with `from` is produced there, so its `origin` is 0 and its node is in a namespace of `namespaces`. A value with `to` is a single value, and its target differs from its source.";
    OpenUser = "M139", "With `security: None` a user name and a password are sent in a session without security. The server then decides whether the password is encrypted, and other hosts of the network can take over the session. Write `security: Basic256Sha256`, the default if there is a user.";
    SecurityGroup = "M150", "An entry of `security` is a SecurityGroup of OPC UA PubSub: a unique `group` and its `namespaces`, each in one group only. One group may have no `namespaces`: it has all namespaces that no other group lists.";
    GroupKeys = "M151", "The `keys` of a secured group come from a file that only its owner can read, from a credential of systemd, or from a Security Key Service. They are never part of the mapping, which is copied to every host of the cell.";
    HalfSecured = "M152", "A namespace is not secured, but others are. A host that can write there may influence what is read there. Confirm this with `mode: none` in a group with the namespace.";
    OpenCall = "M153", "A call can be requested without a key, in a cell with secured values. Executing a call needs at least as much protection as reading a value.";
    KeyService = "M154", "With `keys: {sks: {}}` the server of the cell makes the keys of a group and provides them over encrypted sessions, to itself, its bridges and the programs whose ApplicationUris `members` lists; each key is used for `key_lifetime`. With an `endpoint`, another Security Key Service does this and has its own settings for it.";
    Permissions = "M160", "`permissions` lists the roles that may `read`, `write` or `call` a node of the server: observer, operator, engineer, security_admin, a single role or a list, each once. Default: every user reads, operators and engineers write and call. Clients cannot write values that are produced in a space other than 0.";
    OpenServer = "M161", "Other hosts can reach the server, and it is open to them: it offers None, without signature and encryption, or anonymous users may write and call. The mapping has to state both, and rarely should.";
    Quality = "M162", "`quality` limits the age of a good value: after `uncertain_after` without a newer value it is uncertain, and `bad_after` later it is bad. It requires a value of another program. Values that are sent only on change, or more rarely than this time, would be considered stale although they are current.";
    Confirm = "M163", "`confirm` selects the proof that a value has arrived. `bridge` requires an event with a topic or service in another space: each bridge confirms it, within the time `within`. `by` connects the values that clients write to a variable of the robot: it gives the node of this variable, in another space or with `from`, `within` the time limit, and `when` or `equals` the value that confirms. The robot sends this variable again for each write, with the type of the written value unless `equals` or `when: any` is given.";
    NodeSet = "M170", "`server.nodesets` lists NodeSet2 files (XML, OPC 10000-6, Annex F), relative to the file that contains the entry, each of at most 64 MiB. Each namespace that a file needs is in another of the files, or belongs to OPC UA; no two files have the same namespace. Only programs of space 0 read them.";
    NodeSetNode = "M171", "A `node` of a NodeSet is a Variable, or for a call a Method, and the value has the type given in the NodeSet. A node that its NodeSet does not contain is added to the server.";
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
