//! The document as it is written: keys and their documentation for the schema. Nothing is checked
//! across keys.

mod alarm;
mod carriers;
mod security;

use std::collections::BTreeMap;

use messages::Literal;
use schemars::JsonSchema;

use crate::call::Assigned;
use crate::code::Code;
use crate::mapping::UaField;
use crate::read::{FromNode, Located, NodeReader, choice, document, help_octal, is_octal, short};
use crate::server_entries::{FindSkillsEntry, FromEntry, RemoteServerEntry, ToEntry};
use crate::tree::{TextSpan, YamlKind, YamlNode};

pub(crate) use alarm::{AcknowledgesEntry, AlarmEntry, ReportsEntry};
pub(crate) use carriers::{CarrierEntry, EthernetEntry, PubSubForm, UdpEntry};
pub(crate) use security::{
    GroupEntry, GroupModeEntry, GroupPolicyEntry, KeysEntry, ReplayEntry, SksEntry,
};

document! {
    /// A cell: its ROS spaces, its OPC UA nodes, and the ROS topics that belong to the nodes.
    #[schemars(title = "UA bridge mapping")]
    struct Document {
        /// Files that are part of this document, a single path or a list, relative to this file.
        /// `*` in the last part matches any characters, as in robots/*.yaml.
        include: Includes,
        /// The ROS sides of the cell. The OPC UA side is space 0 and always exists.
        spaces: Vec<Located<SpaceEntry>>,
        /// Folders with ROS packages, or single files, with definitions (.msg, .srv, .action, .idl)
        /// that take precedence over built-in definitions; relative to this file. At most 256.
        type_paths: Vec<Located<String>>,
        /// How values travel between the spaces: a map, or a list of carriers.
        pubsub: PubSubForm,
        /// Groups of programs that may read and write messages: SecurityGroups of OPC UA PubSub, at
        /// most 64. Default: every program of the network may.
        security: Vec<Located<GroupEntry>>,
        /// The OPC UA server of the cell.
        server: ServerEntry,
        /// Existing OPC UA servers, such as the servers of PLCs, at most 256: variables come `from`
        /// them or go `to` them, and their Methods execute calls.
        servers: Vec<Located<RemoteServerEntry>>,
        /// Namespace index in node ids -> namespace URI. A server may use other indexes; the URI
        /// identifies the namespace.
        #[schemars(with = "Option<BTreeMap<u16, String>>")]
        namespaces: Namespaces,
        /// The values of the cell, at most 100 000.
        variables: Vec<Located<VariableEntry>>,
        /// Patterns of topics that become values when they appear, at most 1000. The first matching
        /// pattern applies; an entry of `variables` with the same topic takes precedence.
        patterns: Vec<Located<PatternEntry>>,
        /// Calls: executed in one space and requested from the others, at most 5000. ROS services
        /// and actions with a name of the space (/ua_1_2_61) need no entry.
        calls: Vec<Located<CallEntry>>,
    }

    /// A ROS side.
    struct SpaceEntry {
        /// 1 for ROS 1, 2 to 232 for ROS 2. It is the first number in topic names and the PublisherId.
        #[schemars(required, range(min = 1, max = 232))]
        id: u16,
        /// 1 or 2. Default: 1 for space 1, 2 for all others.
        #[schemars(range(min = 1, max = 2))]
        ros: u16,
        /// DDS domain of a ROS 2 space. Default: the number of the space.
        #[schemars(range(max = 232))]
        domain: u16,
    }

    /// How values travel between the spaces.
    struct PubSubEntry {
        /// Multicast group or unicast address and port, such as opc.udp://239.192.0.40:4840 (the
        /// default), or an MQTT broker, such as mqtt://broker.local:1883 or
        /// mqtts://broker.local:8883.
        #[schemars(regex(pattern = r"^(opc\.udp|(opc\.)?mqtts?)://"))]
        address: String,
        /// Settings of the MQTT broker in `address`.
        mqtt: MqttEntry,
        /// Ethernet frames instead of UDP, without `address`, `mqtt`, `interface` and `ttl`.
        eth: EthernetEntry,
        /// Name or address of the network interface. Default: the operating system chooses.
        interface: String,
        /// Hops a multicast datagram may travel. Default 1: it stays on the link.
        #[schemars(range(max = 255))]
        ttl: u16,
        /// PublisherIds that are accepted for a space: `exact` (the default) a UInt16 of its
        /// number, `any_width` its number in any unsigned integer type.
        publisher_id: PublisherIdEntry,
        /// An unchanged value is sent again after this time; default 1s.
        #[schemars(regex(pattern = DURATION))]
        key_frame_period: String,
        /// A writer without new values sends a keep-alive message after this time; default 1s.
        #[schemars(regex(pattern = DURATION))]
        keep_alive_period: String,
        /// A writer is lost after this time without a message; default 3s, and longer than
        /// `keep_alive_period`.
        #[schemars(regex(pattern = DURATION))]
        receive_timeout: String,
        /// Period of the announcement of the fields of a writer (DataSetMetaData), which is also
        /// sent at the start and on request; default 30s.
        #[schemars(regex(pattern = DURATION))]
        metadata_period: String,
        /// Bytes of the largest datagram sent, 512 to 65507 (the default); larger NetworkMessages
        /// are sent in chunks of this size. 1472 fits an Ethernet frame.
        #[schemars(range(min = 512, max = 65507))]
        max_datagram: u16,
        /// MiB of the largest message sent or put together from chunks, 1 to 1024; default 64.
        #[schemars(range(min = 1, max = 1024))]
        max_message: u16,
        /// Maximum number of DataSetMessages in a datagram, 1 (the default) to 255. Waiting values
        /// of one namespace then share a datagram of at most 1472 bytes, which saves time if very
        /// many values change. Leave it at 1 with subscribers that read only the first, such as
        /// open62541.
        #[schemars(range(min = 1, max = 255))]
        messages_per_datagram: u16,
    }

    /// Settings of an MQTT broker. Programs that share a broker and its prefix are one space.
    struct MqttEntry {
        /// Address of the broker, such as mqtt://broker.local:1883, in a list of carriers. Without a
        /// list, `address` of `pubsub` is the address.
        #[schemars(regex(pattern = r"^(opc\.)?mqtts?://"))]
        address: String,
        /// Version of MQTT. Default: 5.0, and 3.1.1 if the broker refuses it.
        version: MqttVersionEntry,
        /// First levels of every topic; default `opcua`.
        #[schemars(length(min = 1, max = 128))]
        prefix: String,
        /// Message mapping of sent messages; default `uadp`. Messages of every mapping are received.
        encoding: EncodingEntry,
        /// Form of the topics of values: `tree` (the default), as opcua/uadp/data/1/2/10, or `names`, as opcua/ua_1_2_10.
        topics: TopicFormEntry,
        /// Quality of service of values that are not commands: 0 (the default) or 1. Commands and
        /// calls are always sent with 0.
        #[schemars(range(max = 1))]
        qos: u16,
        /// Age at which a received message is dropped, because a broker may deliver it late; default 1s. Requires synchronised
        /// clocks.
        #[schemars(regex(pattern = DURATION))]
        within: String,
        /// Whether the access rules of the broker decide who may request calls; default false: over a broker, calls need a
        /// secured group or `open: true`.
        acl: bool,
        /// Whether the broker reports the loss of a bridge at once (an MQTT will); default false: readers
        /// take a program as failed when its next status is overdue. Only if one program alone uses
        /// each PublisherId; the programs of space 0 share theirs and have no will.
        will: bool,
        /// PEM file with the certificates of authorities for mqtts://, relative to this file. Default: the authorities of the
        /// system.
        #[schemars(length(min = 1))]
        ca: String,
        /// PEM file with the certificate of this client, relative to this file.
        #[schemars(length(min = 1))]
        certificate: String,
        /// PEM file with the key of the certificate, relative to this file.
        #[schemars(length(min = 1))]
        key: String,
        /// File with the user name in its first line and the password in its second, relative to this file, that only its
        /// owner can read (chmod 600).
        #[schemars(length(min = 1))]
        credentials: String,
        /// Beginning of the ClientIds, which the programs complete so that they are unique; default `ua-bridge`.
        #[schemars(length(min = 1, max = 32))]
        client_id: String,
    }

    /// The OPC UA server of the cell.
    struct ServerEntry {
        /// Where clients connect; default opc.tcp://127.0.0.1:4840.
        #[schemars(regex(pattern = r"^opc\.tcp://"))]
        endpoint: String,
        /// ApplicationUri; default urn:ua-bridge:server.
        application_uri: String,
        /// ApplicationUris of two or three redundant servers, by their `--rank`, instead of
        /// `application_uri`.
        redundant: Vec<Located<String>>,
        /// Endpoints of the servers of `redundant`, in the same order. Each server has the endpoint
        /// of its rank unless `--endpoint` gives another, and lists the others in FindServers.
        redundant_endpoints: Vec<Located<String>>,
        /// Security policies that the server offers. Default: all, and `None` only if the endpoint
        /// is a loopback address.
        security: Vec<Located<SecurityEntry>>,
        /// Role of anonymous users: `off` (refused), `observer`, `operator` or `engineer`. Default:
        /// observer; operator if the endpoint is a loopback address and the server has no users.
        anonymous: AnonymousEntry,
        /// Whether other servers are refused if their trusted certificates do not include the host
        /// of the URL, as after a new DHCP lease; default false: the server connects to them and
        /// logs a warning.
        refuse_other_hosts: bool,
        /// A value of another program becomes bad (BadNoCommunication) after being uncertain for
        /// this time, unless its own `quality` gives another time. Default: it stays uncertain.
        #[schemars(regex(pattern = DURATION))]
        bad_after: String,
        /// Whether the server has alarms for the publishers of the space: lost, dropped values,
        /// another clock. Default false.
        publisher_alarms: bool,
        /// Clients to which the server connects, so that they reach it through a firewall that
        /// permits no connections to it (ReverseHello, OPC 10000-6): their listening addresses, such
        /// as opc.tcp://192.168.0.30:4841; at most 16. With hosts other than this one, the defaults
        /// of `security` and `anonymous` are those of an endpoint that other hosts reach.
        #[schemars(length(max = 16))]
        reverse_connect: Vec<Located<String>>,
        /// Limits of the history of the server.
        history: HistoryEntry,
        /// Limits for clients.
        limits: LimitsEntry,
        /// Servers with skills that discovery finds and that do not take part in the space:
        /// ua-server shows their skills in the space and runs them, like the skills of `servers`
        /// with `skills`. Default: no search.
        find_skills: FindSkillsEntry,
        /// NodeSet2 files with further nodes of the server, in any order, relative to this file; at
        /// most 64. A variable whose `node` is one of these nodes gives it values; `namespaces`
        /// lists its namespace.
        nodesets: Vec<Located<String>>,
    }

    /// Limits of the history that the server keeps in memory, and its file.
    struct HistoryEntry {
        /// Values of each variable without its own `history`, 0 to 65535; default 1000.
        values: u16,
        /// MiB of all of them together, 1 to 16384; default 64.
        #[schemars(range(min = 1, max = 16384))]
        megabytes: u16,
        /// File in which ua-server stores the history and the states of alarms, so that they
        /// survive a restart, relative to this file; it is created if it is missing. Without it,
        /// they are in memory only.
        file: String,
    }

    /// Limits for clients of the server. Requests above a limit are refused.
    struct LimitsEntry {
        /// Simultaneous sessions; default 50. At the limit, the oldest session that was never
        /// activated is closed for a new one; without such a session, the new one gets
        /// BadTooManySessions.
        #[schemars(range(min = 1, max = 10000))]
        sessions: u16,
        /// Sessions of a client address, enforced only while less than an eighth of the sessions is
        /// free; default half of the sessions. SCADA hosts and gateways run many clients on an
        /// address.
        #[schemars(range(min = 1, max = 10000))]
        sessions_per_address: u16,
        /// Connections; default four times the sessions and 100 more. At the limit, the oldest
        /// connection without an activated session is closed.
        #[schemars(range(min = 1, max = 65535))]
        connections: u16,
        /// Connections of a client address; default twice the sessions and 50 more.
        #[schemars(range(min = 1, max = 65535))]
        connections_per_address: u16,
        /// Subscriptions of a session; default 50.
        #[schemars(range(min = 1, max = 1000))]
        subscriptions: u16,
        /// Monitored items of a subscription; default 10000.
        #[schemars(range(min = 1, max = 65535))]
        items: u16,
        /// Nodes that a request reads or writes, or monitored items that it creates; default 10000
        /// and 1000.
        #[schemars(range(min = 1, max = 65535))]
        operations: u16,
    }

    /// A value of the cell.
    struct VariableEntry {
        /// The OPC UA node, such as ns=2;i=10.
        #[schemars(required, regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        node: String,
        /// Name of the node; dots separate its folders, such as Line.Conveyor.Speed.
        #[schemars(required, length(min = 1, max = 512))]
        name: String,
        /// OPC UA builtin type, such as Boolean or Double[]. Default: the type of the bound ROS
        /// field.
        r#type: String,
        /// For a publisher that is not a bridge and sends several fields in the DataSetMessages of
        /// this value: the field of the value, by its index from 0 or by its name in the
        /// DataSetMetaData of the publisher. Default: the only field, or the field with the `name`
        /// of this variable.
        ua_field: UaFieldEntry,
        /// Text for users: the Description of the node. Default: the name of its topic.
        #[schemars(length(min = 1, max = 1000))]
        description: String,
        /// Number of decimal places to show (ValuePrecision), for a number.
        #[schemars(range(max = 15))]
        precision: u16,
        /// Unit of the value in OPC UA: a symbol such as m/s, a UNECE code such as MTS, or a name.
        unit: String,
        /// Lowest and highest expected value in OPC UA, such as [0, 1.5].
        range: Vec<Located<f64>>,
        /// Texts for the numbers of the value, such as {0: idle, 1: moving}.
        #[schemars(with = "Option<BTreeMap<String, String>>")]
        r#enum: EnumTexts,
        /// The space that produces the value: 0 for the OPC UA side, otherwise an id of `spaces`.
        #[schemars(required, range(max = 232))]
        origin: u16,
        /// Replaces the identifier in topic names if the node id is not a number from 1 to 65535,
        /// or is in namespace 0. In the topic names of nodes of namespace 0 the namespace is 65535.
        #[schemars(range(min = 1, max = 65535))]
        alias: u16,
        /// The ROS topics and services of the value, a single binding or a list, at most one per
        /// space. The topic is read in the space of its origin and written elsewhere. Default: a
        /// topic with the name of the space, such as /ua_1_2_10.
        ros: Bindings,
        /// With `origin: 0`: the node of another OPC UA server that the value comes from. The
        /// server of the cell receives each change and passes it on with its time and quality;
        /// while the other server is lost, the value is bad.
        from: FromEntry,
        /// The node of another OPC UA server that each value is written to, from this space or
        /// another.
        to: ToEntry,
        /// `keep_latest` for a state: only the newest value matters, and late ROS subscribers
        /// receive it. `{drop_oldest: 100}` for events: each value is delivered once, to present
        /// subscribers. Default: an event for values of origin 0 and values that call a service;
        /// otherwise a state if the ROS publisher is latched or transient-local, and an event if
        /// not.
        queue: Queue,
        /// Published once into ROS, or sent to the service that the value calls, when the commander
        /// of the value has stopped or timed out after it published a value: `zero`, a value of the
        /// bound `field`, fields of the message or request such as {linear.x: 0.1}, or {call:
        /// ns=2;i=48} for the service of that variable.
        on_loss: OnLossEntry,
        /// With `on_loss`: the value is also lost if it is not renewed within this time, such as
        /// 500ms.
        #[schemars(regex(pattern = DURATION))]
        hold: String,
        /// Values that the origin sends: `always` (the default) every value, `on_change` only
        /// values that differ from the last sent value.
        publish: PublishEntry,
        /// As `publish: on_change`, but numbers (each element of an array) must differ by more than
        /// this.
        deadband: f64,
        /// Highest rate at which the origin sends the value, such as 10 Hz: of faster values, the
        /// newest is sent after the period.
        #[schemars(regex(pattern = r"^[0-9]+(\.[0-9]+)? ?Hz$"))]
        at_most: String,
        /// The longest time between two values of a periodic value, such as 100ms. Each program
        /// counts longer times (`deadline_missed`), and the server shows the value as uncertain
        /// after this time, unless `quality` has another.
        #[schemars(regex(pattern = DURATION))]
        deadline: String,
        /// Age limits after which the server no longer shows the value as good.
        quality: QualityEntry,
        /// Values that raise an alarm at the server, such as {high: 70, high_high: 90} or {normal:
        /// false}.
        alarm: AlarmEntry,
        /// `alarms`, with `origin: 0`: the value is a diagnostic_msgs/DiagnosticArray that the
        /// server makes of its conditions, once a second and when one changes. Diagnostics of
        /// robots are not in it.
        reports: ReportsEntry,
        /// Confirmation that a value has arrived. `bridge`, the default for events of origin 0 and
        /// for values that call a service: each bridge with a binding of the value confirms when a
        /// present subscriber or the service has received it; the value is sent again until then,
        /// for 1 s at most, and the result of a write states the outcome. `none`: a write succeeds
        /// when the value has been sent. {within: 2s} for another time; {by: ns=2;i=31} with
        /// `origin: 0` for a variable that the robot sends as confirmation.
        confirm: ConfirmedEntry,
        /// Number of past values that the server keeps, 0 to 65535. Default: as in
        /// `server.history`.
        history: u16,
        /// Permissions of roles for the node.
        permissions: PermissionsEntry,
    }

    /// Age limits after which the server no longer shows a value as good.
    struct QualityEntry {
        /// A value is uncertain (UncertainLastUsableValue) after this time without a newer value,
        /// even while messages of its writer are received: for periodic values. Default: no age
        /// limit while messages of its writer are received.
        #[schemars(regex(pattern = DURATION))]
        uncertain_after: String,
        /// A value becomes bad (BadNoCommunication) and is not shown after being uncertain for this
        /// time, because of its age or the loss of its writer. Default: as in `server.bad_after`.
        #[schemars(regex(pattern = DURATION))]
        bad_after: String,
    }

    /// A service that stops the robot.
    struct StopCallEntry {
        /// Node of the variable whose values call it with a fixed request, such as ns=2;i=48.
        #[schemars(required, regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        call: String,
    }

    /// Confirmation that a value has arrived. With `by`, a write without a confirmation in time
    /// returns BadTimeout, the variable shows its previous value, and the value is not sent to late
    /// subscribers.
    struct ConfirmEntry {
        /// Node of the variable that confirms, such as ns=2;i=31: a variable of another space, or
        /// with `from`. It is sent again for each write. Default: the bridges confirm.
        #[schemars(regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        by: String,
        /// Time limit of the confirmation; default 2s, and 1s for confirmations of the bridges.
        #[schemars(regex(pattern = DURATION))]
        within: String,
        /// The value that confirms: `same` (the default) a value that equals the written value,
        /// `any` every later value.
        when: ConfirmWhenEntry,
        /// Instead of `when`: the value that confirms, such as true, 3 or done.
        equals: String,
    }

    /// Permissions of roles for a variable.
    struct PermissionsEntry {
        /// Roles that may read it, a single role or a list; default every user.
        read: RoleList,
        /// Roles that may write it, with `origin: 0`; default [operator, engineer].
        write: RoleList,
    }

    /// Permissions of roles for a call.
    struct CallPermissionsEntry {
        /// Roles that may call the Method, a single role or a list; default [operator, engineer].
        call: RoleList,
    }

    /// ROS topics that become values when they appear.
    struct PatternEntry {
        /// The topics, such as /robot*/joint_states: `*` matches one or more characters of a part
        /// between slashes, a part `**` matches any number of parts.
        #[schemars(required, regex(pattern = r"^/.*\*"))]
        topics: String,
        /// Excluded topics or patterns, such as [/robot9/**].
        exclude: Vec<Located<String>>,
        /// The ROS space of the topics.
        #[schemars(required, range(min = 1, max = 1))]
        origin: u16,
        /// The OPC UA node of each topic, such as ns=2;i=10{1}: {1} is the text that the first
        /// wildcard matches, {2} the second. A topic without a number from 1 to 65535 is ignored
        /// with a log message.
        #[schemars(required, regex(pattern = r"^ns=[0-9]+;[isgb]="))]
        node: String,
        /// Name of the node, such as Robot{1}Joints.
        #[schemars(required, length(min = 1))]
        name: String,
        /// Replaces the identifier in topic names if the node id is not a number, such as 10{1}.
        alias: String,
        /// Message type, such as sensor_msgs/JointState: topics of another type are ignored.
        /// Default: any type.
        r#type: String,
        /// The field of the value, or a part of it, as in a binding. Default: the whole message, a
        /// field per leaf.
        field: String,
        /// Several fields of the message instead of `field`, as in a binding.
        fields: FieldList,
        /// As in a binding.
        scale: f64,
        /// As in a binding.
        offset: f64,
        /// As in a binding.
        invert: bool,
        /// As in a binding.
        out_of_range: OutOfRangeEntry,
        /// Form of the messages: `fields` (the default) as OPC UA values, `bytes` unchanged, one
        /// ByteString each, `structure` as one OPC UA structure each, as in a binding.
        r#as: AsEntry,
    }

    /// A ROS topic or service of a value: exactly one of `topic`, `call`, `answer` and `poll`.
    struct BindingEntry {
        /// Space of the topic or service. Default: the origin of the value.
        #[schemars(range(min = 1, max = 232))]
        space: u16,
        /// Absolute topic name, such as /conveyor/running.
        #[schemars(regex(pattern = "^/"))]
        topic: String,
        /// Absolute name of a ROS 1 service that is called with each value from another space:
        /// `field` of the request takes the value, or `fields` its fields. Without them the request
        /// is fixed, and `when` selects the values that call.
        #[schemars(regex(pattern = "^/"))]
        call: String,
        /// Node of the variable with a `call`, such as ns=2;i=20: the value is the response of this
        /// service: a field of it, several fields or all.
        #[schemars(regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        answer: String,
        /// Absolute name of a ROS 1 service that is called with `request` in the period `every`:
        /// the value is its response: a field of it, several fields or all.
        #[schemars(regex(pattern = "^/"))]
        poll: String,
        /// Message type, such as std_msgs/Bool. Default: the std_msgs type for the `type` of the
        /// variable. With `call` and `poll` the service type, such as std_srvs/SetBool, which is
        /// required.
        r#type: String,
        /// The field of the value, such as data or pose.position.x. Default: the whole message, a
        /// field per leaf. A part of an array can be read: an element such as position[2], an
        /// element by the text at its position in another array of the message, such as
        /// position[name=joint_3], several elements such as ranges[0:90].
        field: String,
        /// Several fields of the message instead of `field`, in this order, such as [linear.x,
        /// angular.z]; a converted field such as {field: linear.x, scale: 1000}. For a written
        /// message they are in the order of the message, and all other fields are zero or empty.
        fields: FieldList,
        /// Factor: the value in OPC UA is the value of the field times `scale` plus `offset`; the
        /// inverse is written to ROS.
        scale: f64,
        /// Added to the value of the field for OPC UA, after `scale`; subtracted again for ROS.
        offset: f64,
        /// The value in OPC UA is true if the field is false.
        invert: bool,
        /// Numbers that do not fit the target type: `refuse` (the default) drops and counts them,
        /// `clamp` replaces them by the nearest possible number. Required if this can happen;
        /// integers are rounded to the nearest.
        out_of_range: OutOfRangeEntry,
        /// With `call` and `poll`: fixed fields of the request, such as {id: 12, pose: {x: 1.5}} or
        /// {pose.x: 1.5}; the name of a constant of the request gives its value. All other fields
        /// are zero or empty.
        request: Request,
        /// With `call` and without `field` and `fields`: the value that calls the service. Default:
        /// true for a Boolean, every value for other types.
        #[schemars(extend("type" = ["string", "boolean", "number", "null"]))]
        when: String,
        /// With `call` and `poll`: time limit of the service; default 5s.
        #[schemars(regex(pattern = DURATION))]
        timeout: String,
        /// With `poll`: period of the calls; default 1s.
        #[schemars(regex(pattern = DURATION))]
        every: String,
        /// Form of the message: `fields` (the default) as OPC UA values; `bytes` unchanged, one
        /// ByteString, for large or deeply nested messages such as images, which a reader can
        /// decode only with the message type, and not together with `field`; `structure` as one OPC
        /// UA structure, which the DataSetMetaData describe; `field` may then select a nested
        /// message.
        r#as: AsEntry,
    }

    /// A call that is executed in one space: a service or action of ROS, a Method of an OPC UA
    /// server, or a call of a component.
    struct CallEntry {
        /// The OPC UA Method, such as ns=2;i=61. An action takes five numbers: this number for its
        /// goal, the next four for its cancel, its result, its feedback and its status.
        #[schemars(required, regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        node: String,
        /// Name of the Method; dots separate its folders, such as Conveyor.Switch.
        #[schemars(required, length(min = 1, max = 512))]
        name: String,
        /// Description for users.
        about: String,
        /// The space that executes it: 0 for the OPC UA side, otherwise an id of `spaces`.
        #[schemars(required, range(max = 232))]
        origin: u16,
        /// As with a variable.
        #[schemars(range(min = 1, max = 65535))]
        alias: u16,
        /// ROS services or actions, a single binding or a list, at most one per space. The binding
        /// of the origin executes the call; the bridge offers the bindings of other spaces there
        /// and requests the call. In a space without a binding the call has its own name, such as
        /// /ua_1_2_61.
        ros: CallBindings,
        /// With `origin: 0`: the Method of another OPC UA server that executes the call.
        opcua: MethodEntry,
        /// `alarms`, with `origin: 0` and without `opcua`: the server executes the call, and
        /// acknowledges an alarm. The request has the texts `event_id` and `comment`, the response
        /// `success` and `message`, as in ua_msgs/AcknowledgeAlarm. The event_id is that of a status
        /// of `reports: alarms`.
        acknowledges: AcknowledgesEntry,
        /// Whether requests from other hosts are executed. Default: only requests from a loopback
        /// address, because the sender of unsecured requests is unknown.
        open: bool,
        /// Time limit of the service or Method, and of the caller; default 30s. For an action: the
        /// time until a goal is accepted or rejected.
        #[schemars(regex(pattern = DURATION))]
        timeout: String,
        /// Roles that may call the Method at the server of the cell.
        permissions: CallPermissionsEntry,
    }

    /// A service or action of ROS that executes or requests a call: exactly one of `service` and
    /// `action`.
    #[schemars(extend("oneOf" = [{ "required": ["service"] }, { "required": ["action"] }]))]
    struct CallBindingEntry {
        /// Space of the service or action. Default: the origin of the call.
        #[schemars(range(min = 1, max = 232))]
        space: u16,
        /// Absolute name of the service, such as /conveyor/switch.
        #[schemars(regex(pattern = "^/"))]
        service: String,
        /// Absolute name of the action, such as /navigate_to_pose: in ROS 1 the name before /goal,
        /// /cancel and /result.
        #[schemars(regex(pattern = "^/"))]
        action: String,
        /// Type of the service or action, such as std_srvs/SetBool.
        #[schemars(required)]
        r#type: String,
        /// For a requesting service: the sources of the fields of the call's request, such as {id:
        /// 6, on: {field: data}}: a constant, or a field of the request here. A message includes
        /// all its fields. Fields without an entry come from the field of the same name.
        request: FieldMapEntry,
        /// For a requesting service: the sources of the fields of the response here, such as
        /// {success: true, message: {field: text}}: a constant, or a field of the call's response.
        response: FieldMapEntry,
        /// For a requesting action: the sources of the fields of the executed goal, like `request`:
        /// constants, or fields of the goal here.
        goal: FieldMapEntry,
        /// For a requesting action: the sources of the fields of the feedback here, like
        /// `response`: constants, or fields of the feedback of the executed action.
        feedback: FieldMapEntry,
        /// For a requesting action: the sources of the fields of the result here, like `response`:
        /// constants, or fields of the result of the executed action.
        result: FieldMapEntry,
    }

    /// A Method of an OPC UA server: of one of `servers`, or of the server at an endpoint.
    #[schemars(extend("oneOf" = [{ "required": ["server"] }, { "required": ["endpoint"] }]))]
    struct MethodEntry {
        /// The server, by its `name` among `servers`.
        server: String,
        /// The endpoint of the server, such as opc.tcp://127.0.0.1:4841, for anonymous users.
        #[schemars(regex(pattern = r"^opc\.tcp://"))]
        endpoint: String,
        /// The Object of the Method, such as nsu=urn:plc;s=Line: its namespace by the URI, which
        /// stays valid if the indexes of the server change, or by the index there, such as
        /// ns=3;i=7.
        #[schemars(required, regex(pattern = EXPANDED_NODE_ID))]
        object: String,
        /// The Method, likewise.
        #[schemars(required, regex(pattern = EXPANDED_NODE_ID))]
        method: String,
    }

    /// One of several fields, with its conversion.
    struct FieldEntry {
        /// The field, as in a binding with a single field.
        #[schemars(required)]
        field: String,
        /// As in a binding with a single field.
        scale: f64,
        /// As in a binding with a single field.
        offset: f64,
        /// As in a binding with a single field.
        invert: bool,
        /// As in a binding with a single field.
        out_of_range: OutOfRangeEntry,
    }
}

choice! {
    enum MqttVersionEntry {
        /// MQTT 3.1.1.
        V311 = "3.1.1",
        /// MQTT 5.0.
        V5 = "5.0",
    }

    enum EncodingEntry {
        /// UADP, the binary mapping.
        Uadp = "uadp",
        /// JSON, Verbose: plain values for readers that know the metadata.
        JsonVerbose = "json-verbose",
        /// JSON, Compact: every value has its type, defaults are left out.
        JsonCompact = "json-compact",
        /// JSON of version 1.04, reversible.
        JsonReversible = "json-reversible",
        /// JSON of version 1.04, non-reversible: bare values.
        JsonNonReversible = "json-non-reversible",
    }

    enum TopicFormEntry {
        /// The tree of OPC 10000-14, 7.3.4.7.
        Tree = "tree",
        /// The name of the topic in the space.
        Names = "names",
    }
}

choice! {
    enum PublisherIdEntry {
        /// A UInt16 of the number.
        Exact = "exact",
        /// The number in any unsigned integer type.
        AnyWidth = "any_width",
    }

    enum ConfirmWhenEntry {
        /// A value that equals the written value.
        Same = "same",
        /// Every value.
        Any = "any",
    }

    enum PublishEntry {
        /// Each value.
        Always = "always",
        /// Values that differ from the last sent value.
        OnChange = "on_change",
    }

    enum AsEntry {
        /// A value per field.
        Fields = "fields",
        /// The message as it is, one ByteString.
        Bytes = "bytes",
        /// The message as one structure.
        Structure = "structure",
    }

    enum OutOfRangeEntry {
        /// The value is dropped.
        Refuse = "refuse",
        /// The nearest value that fits.
        Clamp = "clamp",
    }

    enum RoleEntry {
        /// Reads values.
        Observer = "observer",
        /// Runs the cell.
        Operator = "operator",
        /// Configures the cell.
        Engineer = "engineer",
        /// Manages users and permissions.
        SecurityAdmin = "security_admin",
    }

    enum AnonymousEntry {
        /// Anonymous users are refused.
        Off = "off",
        /// Anonymous users read.
        Observer = "observer",
        /// Anonymous users read, write and call.
        Operator = "operator",
        /// Anonymous users have the permissions of engineers.
        Engineer = "engineer",
    }

    enum SecurityEntry {
        /// Neither signed nor encrypted.
        None = "None",
        /// Signed, or signed and encrypted.
        Basic256Sha256 = "Basic256Sha256",
        /// Signed, or signed and encrypted with AES of 128 bits.
        Aes128Sha256RsaOaep = "Aes128_Sha256_RsaOaep",
        /// Signed with RSA-PSS, or signed so and encrypted.
        Aes256Sha256RsaPss = "Aes256_Sha256_RsaPss",
    }
}

pub(crate) const EXPANDED_NODE_ID: &str = r"^(ns=[0-9]+;|nsu=[^;]+;)?[isgb]=";

pub(crate) const DURATION: &str = r"^[0-9]+(\.[0-9]+)?(ms|s|min|h)$";

/// Index and URI, each with its position.
pub(crate) type Namespaces = Vec<(Located<u16>, Located<String>)>;

impl FromNode for Namespaces {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let pairs = reader.pairs(node, "a map of namespace index and URI")?;
        let read = pairs.into_iter().map(|pair| {
            let key =
                pair.key.parse().ok().filter(|_| {
                    pair.key.bytes().all(|b| b.is_ascii_digit()) && !is_octal(pair.key)
                });
            if key.is_none() {
                let message = format!(
                    "expected a namespace index from 1 to 65535, found `{}`",
                    short(pair.key)
                );
                let note = reader.findings.error(Code::WrongValue, pair.place, message);
                help_octal(note, pair.key);
            }
            (
                Located {
                    place: pair.place,
                    value: key,
                },
                reader.at(pair.value),
            )
        });
        Some(read.collect())
    }
}

/// Value and text, each with its position.
pub(crate) type EnumTexts = Vec<(Located<i64>, Located<String>)>;

impl FromNode for EnumTexts {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let pairs = reader.pairs(node, "a map of value and text, as {0: idle, 1: moving}")?;
        let read = pairs.into_iter().map(|pair| {
            let value = pair.key.parse().ok().filter(|_| !is_octal(pair.key));
            if value.is_none() {
                let message = format!("expected a whole number, found `{}`", short(pair.key));
                let note = reader.findings.error(Code::WrongValue, pair.place, message);
                help_octal(note, pair.key);
            }
            let place = pair.place;
            (Located { place, value }, reader.at(pair.value))
        });
        Some(read.collect())
    }
}

/// Constants of a request: path of the field, its position, and the value.
#[derive(Clone, Debug)]
pub(crate) struct Request(pub(crate) Vec<(String, TextSpan, Literal)>);

impl FromNode for Request {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let mut found = Vec::new();
        constants(node, "", reader, &mut found)?;
        Some(Self(found))
    }
}

/// Returns `None` for faulty constants, which are noted. Maps nest no deeper than documents do.
fn constants(
    node: &YamlNode<'_>,
    prefix: &str,
    reader: &mut NodeReader<'_>,
    found: &mut Vec<(String, TextSpan, Literal)>,
) -> Option<()> {
    let mut sound = Some(());
    for pair in reader.pairs(node, "a map of field and value")? {
        let path = format!("{prefix}{}", pair.key);
        let literal = match &pair.value.kind {
            YamlKind::Map(_) => {
                let inner = constants(pair.value, &format!("{path}."), reader, found);
                sound = sound.and(inner);
                continue;
            }
            YamlKind::Scalar(text) => Some(Literal::One(text.clone().into_owned())),
            YamlKind::List(items) => {
                let texts = items
                    .iter()
                    .map(|item| reader.text(item, "a single value").map(str::to_owned));
                texts.collect::<Option<_>>().map(Literal::List)
            }
            YamlKind::Null => {
                reader.wrong(pair.value, "a value, a list or a map");
                None
            }
        };
        match literal {
            Some(literal) => found.push((path, pair.place, literal)),
            None => sound = None,
        }
    }
    sound
}

impl JsonSchema for Request {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Request".into()
    }

    fn json_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
        schemars::json_schema!({ "type": "object" })
    }
}

/// Reaction to the loss of a value's commander.
#[derive(Clone, Debug)]
pub(crate) enum OnLossEntry {
    /// A message of zeros.
    Zero,
    /// The value of the bound field.
    Value(Literal),
    /// Fields of the message.
    Fields(Request),
    /// A service.
    Call(StopCallEntry),
}

impl FromNode for OnLossEntry {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        match &node.kind {
            YamlKind::Scalar(text) if text == "zero" => Some(Self::Zero),
            YamlKind::Scalar(text) => Some(Self::Value(Literal::One(text.clone().into_owned()))),
            YamlKind::Map(pairs) if pairs.iter().any(|(key, _)| is_scalar(key, "call")) => {
                StopCallEntry::read(node, reader).map(Self::Call)
            }
            YamlKind::Map(_) => Request::read(node, reader).map(Self::Fields),
            YamlKind::Null | YamlKind::List(_) => {
                reader.wrong(
                    node,
                    "`zero`, a value, the fields of a message as {linear.x: 0.1}, or {call: ns=2;i=48}",
                );
                None
            }
        }
    }
}

fn is_scalar(node: &YamlNode<'_>, wanted: &str) -> bool {
    matches!(&node.kind, YamlKind::Scalar(text) if text == wanted)
}

impl JsonSchema for OnLossEntry {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        "OnLoss".into()
    }

    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        let call = generator.subschema_for::<StopCallEntry>();
        schemars::json_schema!({
            "anyOf": [{ "const": "zero" }, { "type": ["number", "boolean", "string"] }, call, { "type": "object" }]
        })
    }
}

/// Confirmation that a value has arrived.
#[derive(Clone, Debug)]
pub(crate) enum ConfirmedEntry {
    /// No confirmation.
    None,
    /// Confirmation by the bridges that the value is for.
    Bridge,
    /// Confirmation by the bridges or by a value, as the map says.
    Map(Box<ConfirmEntry>),
}

impl FromNode for ConfirmedEntry {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        match &node.kind {
            YamlKind::Scalar(text) if text == "bridge" => Some(Self::Bridge),
            YamlKind::Scalar(text) if text == "none" => Some(Self::None),
            YamlKind::Map(_) => {
                let read = ConfirmEntry::read(node, reader);
                read.map(|read| Self::Map(Box::new(read)))
            }
            YamlKind::Scalar(_) | YamlKind::Null | YamlKind::List(_) => {
                reader.wrong(
                    node,
                    "`bridge`, `none`, {within: 2s}, or {by: ns=2;i=31, within: 2s}",
                );
                None
            }
        }
    }
}

impl JsonSchema for ConfirmedEntry {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Confirmed".into()
    }

    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        let map = generator.subschema_for::<ConfirmEntry>();
        schemars::json_schema!({
            "anyOf": [{ "const": "bridge" }, { "const": "none" }, map]
        })
    }
}

/// Sources of fields: path of the field, its position, and the source.
#[derive(Clone, Debug)]
pub(crate) struct FieldMapEntry(pub(crate) Vec<(String, TextSpan, Assigned)>);

impl FromNode for FieldMapEntry {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let mut found = Vec::new();
        assignments(node, "", reader, &mut found)?;
        Some(Self(found))
    }
}

/// Returns `None` for faulty assignments, which are noted. Maps nest no deeper than documents do.
fn assignments(
    node: &YamlNode<'_>,
    prefix: &str,
    reader: &mut NodeReader<'_>,
    found: &mut Vec<(String, TextSpan, Assigned)>,
) -> Option<()> {
    let mut sound = Some(());
    for pair in reader.pairs(
        node,
        "a map of field and value, or of field and {field: ..}",
    )? {
        let path = format!("{prefix}{}", pair.key);
        let assigned = match &pair.value.kind {
            YamlKind::Map(pairs) => {
                if let [(key, value)] = &pairs[..]
                    && matches!(&key.kind, YamlKind::Scalar(key) if key == "field")
                    && let YamlKind::Scalar(text) = &value.kind
                {
                    Some(Assigned::Field(text.clone().into_owned()))
                } else {
                    let inner = assignments(pair.value, &format!("{path}."), reader, found);
                    sound = sound.and(inner);
                    continue;
                }
            }
            YamlKind::Scalar(text) => {
                Some(Assigned::Constant(Literal::One(text.clone().into_owned())))
            }
            YamlKind::List(items) => {
                let texts = items
                    .iter()
                    .map(|item| reader.text(item, "a single value").map(str::to_owned));
                let texts: Option<Vec<String>> = texts.collect();
                texts.map(|texts| Assigned::Constant(Literal::List(texts)))
            }
            YamlKind::Null => {
                reader.wrong(pair.value, "a value, a list, or {field: name}");
                None
            }
        };
        match assigned {
            Some(assigned) => found.push((path, pair.place, assigned)),
            None => sound = None,
        }
    }
    sound
}

impl JsonSchema for FieldMapEntry {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        "FieldMap".into()
    }

    fn json_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
        schemars::json_schema!({ "type": "object" })
    }
}

/// A service or action of a call, or a list of them.
#[derive(Clone, Debug)]
pub(crate) struct CallBindings(pub(crate) Vec<Located<CallBindingEntry>>);

impl FromNode for CallBindings {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        match &node.kind {
            YamlKind::List(_) => Vec::read(node, reader).map(Self),
            YamlKind::Map(_) => Some(Self(vec![reader.at(node)])),
            YamlKind::Null | YamlKind::Scalar(_) => {
                reader.wrong(
                    node,
                    "a service such as `{service: /a/b, type: std_srvs/SetBool}`, or a list of them",
                );
                None
            }
        }
    }
}

impl JsonSchema for CallBindings {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        "CallBindings".into()
    }

    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        let one = generator.subschema_for::<CallBindingEntry>();
        schemars::json_schema!({ "anyOf": [one, { "type": "array", "items": one }] })
    }
}

/// A field of a DataSet, by its index or its name.
#[derive(Clone, Debug)]
pub(crate) struct UaFieldEntry(pub(crate) UaField);

impl FromNode for UaFieldEntry {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let wanted = "the place of a field as 2, or its name as Temperature";
        let text = reader.text(node, wanted)?;
        if !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit()) {
            return Some(Self(UaField::Place(u16::read(node, reader)?)));
        }
        if text.is_empty() || text.len() > MAX_FIELD_NAME {
            let message = format!("expected {wanted}, found `{}`", short(text));
            let note = reader.findings.error(Code::WrongValue, node.place, message);
            note.help(format!("a name has 1 to {MAX_FIELD_NAME} bytes"));
            return None;
        }
        Some(Self(UaField::Name(text.to_owned())))
    }
}

impl JsonSchema for UaFieldEntry {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        "UaFieldEntry".into()
    }

    fn json_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
        schemars::json_schema!({ "anyOf": [
            { "type": "integer", "minimum": 0, "maximum": 65535 },
            { "type": "string", "minLength": 1, "maxLength": MAX_FIELD_NAME }
        ] })
    }
}

/// Longest field name, in bytes, that is kept from the metadata of writers.
const MAX_FIELD_NAME: usize = 255;

/// A path or a list of paths.
#[derive(Clone, Debug)]
pub(crate) struct Includes(pub(crate) Vec<Located<String>>);

impl FromNode for Includes {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        match &node.kind {
            YamlKind::List(_) => Vec::read(node, reader).map(Self),
            YamlKind::Scalar(_) => Some(Self(vec![reader.at(node)])),
            YamlKind::Null | YamlKind::Map(_) => {
                reader.wrong(node, "a path such as `robots.yaml`, or a list of them");
                None
            }
        }
    }
}

impl JsonSchema for Includes {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Includes".into()
    }

    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        let one = generator.subschema_for::<String>();
        schemars::json_schema!({ "anyOf": [one, { "type": "array", "items": one }] })
    }
}

/// A role or a list of roles.
#[derive(Clone, Debug)]
pub(crate) struct RoleList(pub(crate) Vec<Located<RoleEntry>>);

impl FromNode for RoleList {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        match &node.kind {
            YamlKind::List(_) => Vec::read(node, reader).map(Self),
            YamlKind::Scalar(_) => Some(Self(vec![reader.at(node)])),
            YamlKind::Null | YamlKind::Map(_) => {
                reader.wrong(node, "a role such as `engineer`, or a list of them");
                None
            }
        }
    }
}

impl JsonSchema for RoleList {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        "RoleList".into()
    }

    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        let one = generator.subschema_for::<RoleEntry>();
        schemars::json_schema!({ "anyOf": [one, { "type": "array", "items": one, "minItems": 1 }] })
    }
}

/// Several fields of a message.
#[derive(Clone, Debug)]
pub(crate) struct FieldList(pub(crate) Vec<Located<FieldEntry>>);

impl FromNode for FieldList {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let YamlKind::List(items) = &node.kind else {
            reader.wrong(node, "a list of fields such as `[linear.x, angular.z]`");
            return None;
        };
        let read = items.iter().map(|item| match &item.kind {
            YamlKind::Scalar(text) => Located {
                place: item.place,
                value: Some(FieldEntry {
                    field: Some(Located {
                        place: item.place,
                        value: Some(text.clone().into_owned()),
                    }),
                    scale: None,
                    offset: None,
                    invert: None,
                    out_of_range: None,
                }),
            },
            YamlKind::Null | YamlKind::List(_) | YamlKind::Map(_) => reader.at(item),
        });
        Some(Self(read.collect()))
    }
}

impl JsonSchema for FieldList {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        "FieldList".into()
    }

    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        let one = generator.subschema_for::<FieldEntry>();
        schemars::json_schema!({ "type": "array", "items": { "anyOf": [{ "type": "string" }, one] } })
    }
}

/// A binding or a list of bindings.
#[derive(Clone, Debug)]
pub(crate) struct Bindings(pub(crate) Vec<Located<BindingEntry>>);

impl FromNode for Bindings {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        match &node.kind {
            YamlKind::List(_) => Vec::read(node, reader).map(Self),
            YamlKind::Map(_) => Some(Self(vec![reader.at(node)])),
            YamlKind::Null | YamlKind::Scalar(_) => {
                reader.wrong(node, "a binding such as `{topic: /a/b, type: std_msgs/Bool, field: data}`, or a list of them");
                None
            }
        }
    }
}

impl JsonSchema for Bindings {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Bindings".into()
    }

    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        let one = generator.subschema_for::<BindingEntry>();
        schemars::json_schema!({ "anyOf": [one, { "type": "array", "items": one }] })
    }
}

/// Overflow policy of a queue.
#[derive(Clone, Copy, Debug, JsonSchema)]
#[schemars(rename_all = "snake_case")]
pub(crate) enum Queue {
    /// A newer value takes the place of the one that waits.
    KeepLatest,
    /// That many values wait, and the oldest goes.
    DropOldest(#[schemars(range(min = 1, max = 65535))] u16),
}

impl FromNode for Queue {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        match &node.kind {
            YamlKind::Scalar(text) if text == "keep_latest" => Some(Self::KeepLatest),
            YamlKind::Map(_) => {
                let [size] = reader.keys(node, ["drop_oldest"])?;
                let size = reader.field::<u16>(size);
                match size.as_ref().map(|at| (at.value, at.place)) {
                    Some((Some(0), place)) => {
                        let message = "a queue of size 0 cannot hold a value";
                        reader
                            .findings
                            .error(Code::WrongValue, place, message)
                            .help("1 to 65535, or `keep_latest`");
                        None
                    }
                    Some((size, _)) => Some(Self::DropOldest(size?)),
                    None => {
                        reader.findings.error(
                            Code::MissingKey,
                            node.place,
                            "`drop_oldest` needs a number",
                        );
                        None
                    }
                }
            }
            YamlKind::Null | YamlKind::Scalar(_) | YamlKind::List(_) => {
                let note = reader.findings.error(
                    Code::WrongValue,
                    node.place,
                    format!(
                        "expected `keep_latest` or `drop_oldest`, found {}",
                        found(node)
                    ),
                );
                note.help("queue: keep_latest, or queue: {drop_oldest: 100}");
                None
            }
        }
    }
}

fn found(node: &YamlNode<'_>) -> String {
    match &node.kind {
        YamlKind::Scalar(text) => format!("`{}`", short(text)),
        YamlKind::Null | YamlKind::List(_) | YamlKind::Map(_) => node.kind.name().to_owned(),
    }
}

impl Default for Document {
    /// Returns a document without any key.
    fn default() -> Self {
        Self {
            include: None,
            spaces: None,
            type_paths: None,
            pubsub: None,
            security: None,
            server: None,
            servers: None,
            namespaces: None,
            variables: None,
            patterns: None,
            calls: None,
        }
    }
}

/// Reads the whole document; an empty text is a document without any key.
pub(crate) fn read(
    root: &YamlNode<'_>,
    reader: &mut NodeReader<'_>,
) -> Option<(Document, TextSpan)> {
    if matches!(root.kind, YamlKind::Null) {
        // A file that another file includes may be empty.
        if root.place.file == 0 {
            let message = "the document is empty: it declares no spaces, values or calls";
            let note = reader.findings.error(Code::MissingKey, root.place, message);
            note.help("make a mapping of the running cell with `ua-space init`; start programs that need no \
                       mapping without a file");
        }
        return Some((Document::default(), root.place));
    }
    Some((Document::read(root, reader)?, root.place))
}
