//! The document as it is written: keys and their documentation for the schema. Nothing is checked
//! across keys.

mod alarm;
mod security;

use std::collections::BTreeMap;

use messages::Literal;
use schemars::JsonSchema;

use crate::call::Assigned;
use crate::code::Code;
use crate::mapping::UaField;
use crate::read::{At, Read, Reader, choice, document, help_octal, is_octal, short};
use crate::server_entries::{FindSkillsEntry, FromEntry, RemoteServerEntry, ToEntry};
use crate::tree::{Kind, Node, Place};

pub(crate) use alarm::{AlarmEntry, ReportsEntry};
pub(crate) use security::{
    GroupEntry, GroupModeEntry, GroupPolicyEntry, KeysEntry, ReplayEntry, SksEntry,
};

document! {
    /// One cell: its ROS spaces, its OPC UA nodes, and which ROS topic is which node.
    #[schemars(title = "UA bridge mapping")]
    struct Document {
        /// Files that belong to this one as if they stood here, one path or a list, from the folder of this file. `*` in the
        /// last part stands for any characters, as in robots/*.yaml.
        include: Includes,
        /// The ROS sides of the cell. The OPC UA side is space 0 and always there.
        spaces: Vec<At<SpaceEntry>>,
        /// Folders with ROS packages, or single files, whose definitions (.msg, .srv, .action, .idl) count before those built in;
        /// relative to this file. At most 256.
        type_paths: Vec<At<String>>,
        /// How values travel between the spaces.
        pubsub: PubSubEntry,
        /// Who may write and read what is sent: SecurityGroups of OPC UA PubSub, at most 64. Left out: anybody may.
        security: Vec<At<GroupEntry>>,
        /// The OPC UA server of the cell.
        server: ServerEntry,
        /// OPC UA servers that exist already, such as those of PLCs, at most 256: variables come `from` them or go `to` them, and
        /// calls are executed by Methods of theirs.
        servers: Vec<At<RemoteServerEntry>>,
        /// Namespace index in node ids -> namespace URI. A server may number its namespaces otherwise; the URI counts.
        #[schemars(with = "Option<BTreeMap<u16, String>>")]
        namespaces: Namespaces,
        /// The values of the cell, at most 100 000.
        variables: Vec<At<VariableEntry>>,
        /// Topics that become values as they appear, at most 1000; the first that fits counts, and an entry of `variables`
        /// with the same topic before all.
        patterns: Vec<At<PatternEntry>>,
        /// What is executed in one space and asked for from the others, at most 5000. Services and actions of ROS that have a name
        /// of the space (/ua_1_2_61) need none.
        calls: Vec<At<CallEntry>>,
    }

    /// One ROS side.
    struct SpaceEntry {
        /// 1 for ROS 1, 2 to 232 for ROS 2. It is the first number in topic names and the PublisherId.
        #[schemars(required, range(min = 1, max = 232))]
        id: u16,
        /// 1 or 2. Left out: 1 for space 1, 2 for all others.
        #[schemars(range(min = 1, max = 2))]
        ros: u16,
        /// DDS domain of a ROS 2 space. Left out: the number of the space.
        #[schemars(range(max = 232))]
        domain: u16,
    }

    /// How values travel between the spaces.
    struct PubSubEntry {
        /// Multicast group or unicast address and port, as opc.udp://239.192.0.40:4840 (the default), or an MQTT broker, as
        /// mqtt://broker.local:1883 or mqtts://broker.local:8883.
        #[schemars(regex(pattern = r"^(opc\.udp|(opc\.)?mqtts?)://"))]
        address: String,
        /// Settings of the MQTT broker in `address`.
        mqtt: MqttEntry,
        /// Name or address of the network interface. Left out: the operating system chooses.
        interface: String,
        /// Hops a multicast datagram may travel. Default 1: it stays on the link.
        #[schemars(range(max = 255))]
        ttl: u16,
        /// Which PublisherId is taken for a space: `exact` (the default) a UInt16 of its number, `any_width` its number in any
        /// unsigned integer type.
        publisher_id: PublisherIdEntry,
        /// An unchanged value is sent again after this time; default 1s.
        #[schemars(regex(pattern = DURATION))]
        key_frame_period: String,
        /// A writer with nothing to say says so after this time; default 1s.
        #[schemars(regex(pattern = DURATION))]
        keep_alive_period: String,
        /// A writer silent for this long counts as gone; default 3s, and longer than `keep_alive_period`.
        #[schemars(regex(pattern = DURATION))]
        receive_timeout: String,
        /// What a writer has in its messages (its DataSetMetaData) is announced this often, beside when it begins and when it
        /// is asked for; default 30s.
        #[schemars(regex(pattern = DURATION))]
        metadata_period: String,
        /// Bytes of the largest datagram sent, 512 to 65507 (the default); larger NetworkMessages go in chunks of it. 1472 fits
        /// an Ethernet frame.
        #[schemars(range(min = 512, max = 65507))]
        max_datagram: u16,
        /// MiB of the largest message sent or put together from chunks, 1 to 1024; default 64.
        #[schemars(range(min = 1, max = 1024))]
        max_message: u16,
        /// The most DataSetMessages in one datagram, 1 (the default) to 255. Of what waits to be sent, as many values of one
        /// namespace then share a datagram of at most 1472 bytes, which spares time where very many change. Leave it at 1
        /// with subscribers that read only the first, as open62541 does.
        #[schemars(range(min = 1, max = 255))]
        messages_per_datagram: u16,
    }

    /// Settings of an MQTT broker. Programs that share a broker and its prefix are one space.
    struct MqttEntry {
        /// Version of MQTT. Default: 5.0, and 3.1.1 if the broker refuses it.
        version: MqttVersionEntry,
        /// First levels of every topic; default `opcua`.
        #[schemars(length(min = 1, max = 128))]
        prefix: String,
        /// Message mapping of sent messages; default `uadp`. Messages of every mapping are received.
        encoding: EncodingEntry,
        /// Form of the topics of values: `tree` (the default), as opcua/uadp/data/1/2/10, or `names`, as opcua/ua_1_2_10.
        topics: TopicFormEntry,
        /// Quality of service of values that are no commands: 0 (the default) or 1. Commands and calls are always sent with 0.
        #[schemars(range(max = 1))]
        qos: u16,
        /// Age at which a received message is dropped, because a broker may deliver it late; default 1s. Requires synchronised
        /// clocks.
        #[schemars(regex(pattern = DURATION))]
        within: String,
        /// Whether the access rules of the broker decide who may request calls; default false: over a broker, calls need a
        /// secured group or `open: true`.
        acl: bool,
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
        /// Security policies it offers. Left out: all of them, and `None` only where the endpoint is a loopback address.
        security: Vec<At<SecurityEntry>>,
        /// What users without a name may be: `off` (they are not let in), `observer`, `operator` or `engineer`. Left out:
        /// observer; and operator where the endpoint is a loopback address and the server has no users.
        anonymous: AnonymousEntry,
        /// Whether other servers are refused at hosts that their trusted certificates do not name, as after another lease of DHCP;
        /// default false: the server connects to them and logs a warning.
        refuse_other_hosts: bool,
        /// A value of another program that has been uncertain for this long is bad (BadNoCommunication), where its own `quality`
        /// says nothing else. Left out: it stays uncertain.
        #[schemars(regex(pattern = DURATION))]
        bad_after: String,
        /// Whether the server has alarms for the publishers of the space: lost, dropped values,
        /// another clock. Default false.
        publisher_alarms: bool,
        /// How much the server keeps of what was.
        history: HistoryEntry,
        /// How much clients may take up.
        limits: LimitsEntry,
        /// Servers with skills that know nothing of the space, and that discovery finds: ua-server shows these skills in the space,
        /// and has them run, as it does those of `servers` that have `skills`. Left out: none is looked for.
        find_skills: FindSkillsEntry,
        /// NodeSet2 files whose nodes the server has beside those of the mapping, in any order, relative to this file; at most 64.
        /// A variable whose `node` is one of them makes it live; its namespace stands in `namespaces`.
        nodesets: Vec<At<String>>,
    }

    /// How much the server keeps of what was, in memory.
    struct HistoryEntry {
        /// Values of each variable that says nothing else, 0 to 65535; default 1000.
        values: u16,
        /// MiB of all of them together, 1 to 16384; default 64.
        #[schemars(range(min = 1, max = 16384))]
        megabytes: u16,
    }

    /// How much clients may take up of the server. What is more is refused.
    struct LimitsEntry {
        /// Sessions at once; default 50. The oldest session that was never activated gives way. Without such a session
        /// the next one gets BadTooManySessions.
        #[schemars(range(min = 1, max = 10000))]
        sessions: u16,
        /// Sessions of one client address, which binds only while less than an eighth of the sessions is free; default half of
        /// the sessions. SCADA hosts and gateways run many clients on one address.
        #[schemars(range(min = 1, max = 10000))]
        sessions_per_address: u16,
        /// Connections; default four times the sessions and 100 more. The oldest one without an activated session gives way.
        #[schemars(range(min = 1, max = 65535))]
        connections: u16,
        /// Connections of one client address; default twice the sessions and 50 more.
        #[schemars(range(min = 1, max = 65535))]
        connections_per_address: u16,
        /// Subscriptions of a session; default 50.
        #[schemars(range(min = 1, max = 1000))]
        subscriptions: u16,
        /// Monitored items of a subscription; default 10000.
        #[schemars(range(min = 1, max = 65535))]
        items: u16,
        /// Nodes that one request reads or writes, or items that it makes; default 10000 and 1000.
        #[schemars(range(min = 1, max = 65535))]
        operations: u16,
    }

    /// One value of the cell.
    struct VariableEntry {
        /// The OPC UA node, as ns=2;i=10.
        #[schemars(required, regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        node: String,
        /// Name of the node; dots part the folders it stands in, as Line.Conveyor.Speed.
        #[schemars(required, length(min = 1, max = 512))]
        name: String,
        /// OPC UA builtin type, as Boolean or Double[]. May be left out where a ROS type says it.
        r#type: String,
        /// Of a publisher that is none of the bridges and sends several fields in the DataSetMessages of this value: the one
        /// that is the value, by its place from 0 or by its name in the DataSetMetaData that the publisher announces. Left out:
        /// the only field, or the one that is announced under the `name` of this variable.
        ua_field: UaFieldEntry,
        /// What the value is, for people: the Description of the node. Left out: the name of its topic.
        #[schemars(length(min = 1, max = 1000))]
        description: String,
        /// How many digits behind the decimal point are worth showing (ValuePrecision), of a value that is a number.
        #[schemars(range(max = 15))]
        precision: u16,
        /// Unit of the value in OPC UA, by its symbol as m/s, its UNECE code as MTS, or its name.
        unit: String,
        /// Lowest and highest value to be expected in OPC UA, as [0, 1.5].
        range: Vec<At<f64>>,
        /// What the numbers of the value mean, as {0: idle, 1: moving}.
        #[schemars(with = "Option<BTreeMap<String, String>>")]
        r#enum: EnumTexts,
        /// The space that produces the value: 0 the OPC UA side, else one of `spaces`.
        #[schemars(required, range(max = 232))]
        origin: u16,
        /// Stands for the identifier in topic names when the node id is no number from 1 to 65535 or in namespace
        /// 0. In the topic names of nodes of namespace 0 the namespace is 65535.
        #[schemars(range(min = 1, max = 65535))]
        alias: u16,
        /// The ROS topics and services tied to the value, one or a list, at most one per space. In the space of its origin
        /// the topic is read, elsewhere it is written. Without any, the topic is named after the space: /ua_1_2_10.
        ros: Bindings,
        /// With `origin: 0`: the node of another OPC UA server that the value comes from. The cell's server hears of each change,
        /// and shows and sends it with the time and the quality it has there; while that server is away it is bad.
        from: FromEntry,
        /// The node of another OPC UA server that each value is written to, be it of this space or of another.
        to: ToEntry,
        /// `keep_latest` for a state: the newest value counts and ROS subscribers that come late get it. `{drop_oldest: 100}`
        /// for events: each value is delivered once, to the subscribers that are present. Left out: an event for values of
        /// origin 0 and values that call a service; others are what their ROS publisher is, a state where it is latched or
        /// transient-local and an event otherwise.
        queue: Queue,
        /// What is published once into ROS, or requested of the service that the value calls, when the commander of the value has
        /// ended or timed out, if a value of it was published since: `zero`, the value of the bound `field`, fields of the
        /// message or request as {linear.x: 0.1}, or {call: ns=2;i=48} for the service that the values of that variable call.
        on_loss: OnLossEntry,
        /// With `on_loss`: a value that is not renewed for this long is lost, too, as 500ms.
        #[schemars(regex(pattern = DURATION))]
        hold: String,
        /// Which values its origin sends: `always` (the default) each, `on_change` those that differ from the last one sent.
        publish: PublishEntry,
        /// As `publish: on_change`, and numbers (each of an array) have to differ by more than this.
        deadband: f64,
        /// Highest rate at which its origin sends it, as 10 Hz: of values that come faster the newest follows when the time
        /// is over.
        #[schemars(regex(pattern = r"^[0-9]+(\.[0-9]+)? ?Hz$"))]
        at_most: String,
        /// When the server no longer shows the value as good, because no newer one comes.
        quality: QualityEntry,
        /// Which values are an alarm at the server, as {high: 70, high_high: 90} or {normal:
        /// false}.
        alarm: AlarmEntry,
        /// `alarms`, with `origin: 0`: the value is a diagnostic_msgs/DiagnosticArray that the
        /// server makes of its conditions, once a second and when one changes. Diagnostics of
        /// robots are not in it.
        reports: ReportsEntry,
        /// What says that a value has arrived. `bridge`, the default for events of origin 0 and for values that call a service:
        /// each bridge that the mapping ties the value to, when a present subscriber or the service has it; the value is sent
        /// again until then, 1 s at most, and a client's write is answered accordingly. `none`: a write is answered when the
        /// value has been sent. {within: 2s} for another time; {by: ns=2;i=31} with `origin: 0` for a value that the robot
        /// answers with.
        confirm: ConfirmedEntry,
        /// How many past values the server keeps, 0 to 65535. Left out: as many as `server.history` says.
        history: u16,
        /// Which roles may do what with the node.
        permissions: PermissionsEntry,
    }

    /// When the server no longer shows a value as good, because no newer one comes.
    struct QualityEntry {
        /// A value that no newer one follows for this long is uncertain (UncertainLastUsableValue), even while its writer is
        /// heard: for values that come regularly. Left out: a value may be of any age as long as its writer is heard.
        #[schemars(regex(pattern = DURATION))]
        uncertain_after: String,
        /// A value that has been uncertain for this long, for its age or because its writer is silent, is bad
        /// (BadNoCommunication) and is not shown. Left out: as `server.bad_after` says.
        #[schemars(regex(pattern = DURATION))]
        bad_after: String,
    }

    /// A service that stops the robot.
    struct StopCallEntry {
        /// Node of the variable whose values call it with the same request each time, as ns=2;i=48.
        #[schemars(required, regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        call: String,
    }

    /// What says that a value has arrived. With `by`, a write without an answer in time is BadTimeout, the variable shows what
    /// it showed before, and the value is not repeated to who comes later.
    struct ConfirmEntry {
        /// Node of the variable that answers, as ns=2;i=31: one of another space, or one that comes `from` a server. The
        /// answer is sent anew for each write. Left out: the bridges confirm.
        #[schemars(regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        by: String,
        /// How long the answer may take; default 2s, and 1s for that of the bridges.
        #[schemars(regex(pattern = DURATION))]
        within: String,
        /// Which answer counts: `same` (the default) one that equals what was written, `any` each that comes after it.
        when: ConfirmWhenEntry,
        /// In place of `when`: the answer that counts, as true, 3 or done.
        equals: String,
    }

    /// Which roles may do what with a variable.
    struct PermissionsEntry {
        /// Who may read it, one role or a list; default everybody.
        read: RoleList,
        /// Who may write it, with `origin: 0`; default [operator, engineer].
        write: RoleList,
    }

    /// Which roles may do what with a call.
    struct CallPermissionsEntry {
        /// Who may call the Method, one role or a list; default [operator, engineer].
        call: RoleList,
    }

    /// ROS topics that become values as they appear.
    struct PatternEntry {
        /// The topics, as /robot*/joint_states: `*` stands for one or more characters of a part between slashes, a part `**`
        /// for any number of parts.
        #[schemars(required, regex(pattern = r"^/.*\*"))]
        topics: String,
        /// Topics left out, patterns too, as [/robot9/**].
        exclude: Vec<At<String>>,
        /// The ROS space of the topics.
        #[schemars(required, range(min = 1, max = 1))]
        origin: u16,
        /// The OPC UA node of each, as ns=2;i=10{1}: {1} is what the first wildcard stands for, {2} the second. A topic whose
        /// number would not be one from 1 to 65535 is left out, with a word in the log.
        #[schemars(required, regex(pattern = r"^ns=[0-9]+;[isgb]="))]
        node: String,
        /// Name of the node, as Robot{1}Joints.
        #[schemars(required, length(min = 1))]
        name: String,
        /// Stands for the identifier in topic names when the node id is no number, as 10{1}.
        alias: String,
        /// Message type, as sensor_msgs/JointState: topics of another type are left out. Left out: any.
        r#type: String,
        /// The field that holds the value, or a part of it, as in a binding. Left out: the whole message, a field per leaf.
        field: String,
        /// Several fields of the message in place of `field`, as in a binding.
        fields: FieldList,
        /// As in a binding.
        scale: f64,
        /// As in a binding.
        offset: f64,
        /// As in a binding.
        invert: bool,
        /// As in a binding.
        out_of_range: OutOfRangeEntry,
        /// How the messages cross: `fields` (the default) as OPC UA values, `bytes` as they are, one ByteString each,
        /// `structure` as one OPC UA structure each, as in a binding.
        r#as: AsEntry,
    }

    /// A ROS topic or service tied to a value: exactly one of `topic`, `call`, `answer` and `poll`.
    struct BindingEntry {
        /// Whose topic it is. Left out: the origin of the value.
        #[schemars(range(min = 1, max = 232))]
        space: u16,
        /// Absolute topic name, as /conveyor/running.
        #[schemars(regex(pattern = "^/"))]
        topic: String,
        /// Absolute name of a ROS 1 service that is called with each value that arrives from another space: the value
        /// stands in `field` of the request, or its fields in `fields`. Without either the request is the same each time,
        /// and `when` says which values call.
        #[schemars(regex(pattern = "^/"))]
        call: String,
        /// Node of the variable with a `call`, as ns=2;i=20: the value is what that service answers to its calls, one field
        /// of the response, several or all.
        #[schemars(regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        answer: String,
        /// Absolute name of a ROS 1 service that is called `every` so often with `request`: the value is what it answers,
        /// one field of the response, several or all.
        #[schemars(regex(pattern = "^/"))]
        poll: String,
        /// Message type, as std_msgs/Bool. Left out: the std_msgs type of the variable's `type`. With `call` and `poll` the
        /// service type, as std_srvs/SetBool, which is never left out.
        r#type: String,
        /// The field that holds the value, as data or pose.position.x. Left out: the whole message, a field per leaf. Of an
        /// array that is read a part: an element as position[2], by the text at its place in another array of the message as
        /// position[name=joint_3], several as ranges[0:90].
        field: String,
        /// Several fields of the message in place of `field`, in this order, as [linear.x, angular.z]; one that is converted
        /// as {field: linear.x, scale: 1000}. Where the message is written, they stand in the order it has them, and all others
        /// are zero or empty.
        fields: FieldList,
        /// The value in OPC UA is the field's times this, and `offset`; written to ROS the other way round.
        scale: f64,
        /// Added to the field's value for OPC UA, after `scale`; written to ROS it is taken off again.
        offset: f64,
        /// The value in OPC UA is true where the field is false.
        invert: bool,
        /// Numbers that the type they become cannot hold: `refuse` (the default), they do not cross and are counted, or
        /// `clamp`, they become the nearest it can hold. Needed where that can happen; integers are rounded to the nearest.
        out_of_range: OutOfRangeEntry,
        /// With `call` and `poll`: fields of the request that stay the same, as {id: 12, pose: {x: 1.5}} or
        /// {pose.x: 1.5}; the name of a constant of the request stands for its value. All others are zero or empty.
        request: Request,
        /// With `call` and without `field` and `fields`: the value that calls the service. Default: true for a Boolean, any value else.
        #[schemars(extend("type" = ["string", "boolean", "number", "null"]))]
        when: String,
        /// With `call` and `poll`: how long the service may take; default 5s.
        #[schemars(regex(pattern = DURATION))]
        timeout: String,
        /// With `poll`: how often the service is called; default 1s.
        #[schemars(regex(pattern = DURATION))]
        every: String,
        /// How the message crosses: `fields` (the default) as OPC UA values, `bytes` as it is, one ByteString that only a
        /// reader who knows the message type can read. For messages too big or too deep to be of use as values, as
        /// images; not together with `field`. `structure`: as one OPC UA structure, which is described in the DataSetMetaData;
        /// `field` may name a message in the message.
        r#as: AsEntry,
    }

    /// Something that is executed in one space: a service or action of ROS, a Method of an OPC UA server, or what a component
    /// executes.
    struct CallEntry {
        /// The OPC UA Method, as ns=2;i=61. An action takes five numbers: its goal this one, its cancel, its result, its feedback
        /// and its status the next four.
        #[schemars(required, regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        node: String,
        /// Name of the Method; dots part the folders it stands in, as Conveyor.Switch.
        #[schemars(required, length(min = 1, max = 512))]
        name: String,
        /// What it does, for people.
        about: String,
        /// The space where it is executed: 0 the OPC UA side, else one of `spaces`.
        #[schemars(required, range(max = 232))]
        origin: u16,
        /// As with a variable.
        #[schemars(range(min = 1, max = 65535))]
        alias: u16,
        /// Services of ROS, or actions, one or a list, at most one per space. That of the origin executes the call; those of other
        /// spaces are offered there and ask for it. A space without one has it under its name, as /ua_1_2_61.
        ros: CallBindings,
        /// With `origin: 0`: the Method of another OPC UA server that executes the call.
        opcua: MethodEntry,
        /// Whether requests from other hosts are executed; left out, only those from a loopback address are, since nobody
        /// knows who sends them.
        open: bool,
        /// How long the service or Method may take, and how long who asks waits; default 30s. Of an action it is the time until a
        /// goal is accepted or refused.
        #[schemars(regex(pattern = DURATION))]
        timeout: String,
        /// Which roles may call the Method at the server of the cell.
        permissions: CallPermissionsEntry,
    }

    /// A service or action of ROS that executes a call, or asks for it: exactly one of `service` and `action`.
    #[schemars(extend("oneOf" = [{ "required": ["service"] }, { "required": ["action"] }]))]
    struct CallBindingEntry {
        /// Whose service or action it is. Left out: the origin of the call.
        #[schemars(range(min = 1, max = 232))]
        space: u16,
        /// Absolute name of the service, as /conveyor/switch.
        #[schemars(regex(pattern = "^/"))]
        service: String,
        /// Absolute name of the action, as /navigate_to_pose: in ROS 1 the name before /goal, /cancel and /result.
        #[schemars(regex(pattern = "^/"))]
        action: String,
        /// Type of the service or action, as std_srvs/SetBool.
        #[schemars(required)]
        r#type: String,
        /// Of a service that asks: what the fields of the call's request are made of, as {id: 6, on: {field: data}}: a constant,
        /// or a field of the request here. A message stands for all fields in it. What is not named is made of the field of the
        /// same name.
        request: FieldMapEntry,
        /// Of a service that asks: what the fields of the response here are made of, as {success: true, message: {field: text}}: a
        /// constant, or a field of the call's response.
        response: FieldMapEntry,
        /// Of an action that asks: what the fields of the goal that is executed are made of, as `request`: constants, or fields of
        /// the goal here.
        goal: FieldMapEntry,
        /// Of an action that asks: what the fields of the feedback here are made of, as `response`: constants, or fields of the
        /// feedback of the action that is executed.
        feedback: FieldMapEntry,
        /// Of an action that asks: what the fields of the result here are made of, as `response`: constants, or fields of the
        /// result of the action that is executed.
        result: FieldMapEntry,
    }

    /// A Method of an OPC UA server: of one of `servers`, or of the one at an endpoint.
    #[schemars(extend("oneOf" = [{ "required": ["server"] }, { "required": ["endpoint"] }]))]
    struct MethodEntry {
        /// The server, by its `name` among `servers`.
        server: String,
        /// The server, as opc.tcp://127.0.0.1:4841, for anonymous users.
        #[schemars(regex(pattern = r"^opc\.tcp://"))]
        endpoint: String,
        /// The Object that the Method is called on, as nsu=urn:plc;s=Line: its namespace by the URI, which holds when the server
        /// numbers its namespaces anew, or by the index there, as ns=3;i=7.
        #[schemars(required, regex(pattern = EXPANDED_NODE_ID))]
        object: String,
        /// The Method, likewise.
        #[schemars(required, regex(pattern = EXPANDED_NODE_ID))]
        method: String,
    }

    /// One of several fields, with what converts it.
    struct FieldEntry {
        /// The field, as in a binding with one.
        #[schemars(required)]
        field: String,
        /// As in a binding with one field.
        scale: f64,
        /// As in a binding with one field.
        offset: f64,
        /// As in a binding with one field.
        invert: bool,
        /// As in a binding with one field.
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
        /// JSON, Verbose: plain for readers that know the metadata.
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
        /// One that equals what was written.
        Same = "same",
        /// Each that comes.
        Any = "any",
    }

    enum PublishEntry {
        /// Each value.
        Always = "always",
        /// Values that differ from the last one sent.
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
        /// The value does not cross.
        Refuse = "refuse",
        /// The nearest value that fits.
        Clamp = "clamp",
    }

    enum RoleEntry {
        /// Sees what there is.
        Observer = "observer",
        /// Runs the cell.
        Operator = "operator",
        /// Sets the cell up.
        Engineer = "engineer",
        /// Says who may do what.
        SecurityAdmin = "security_admin",
    }

    enum AnonymousEntry {
        /// They are not let in.
        Off = "off",
        /// They read.
        Observer = "observer",
        /// They read, write and call.
        Operator = "operator",
        /// They may all that engineers may.
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
pub(crate) type Namespaces = Vec<(At<u16>, At<String>)>;

impl Read for Namespaces {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
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
                At {
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
pub(crate) type EnumTexts = Vec<(At<i64>, At<String>)>;

impl Read for EnumTexts {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
        let pairs = reader.pairs(node, "a map of value and text, as {0: idle, 1: moving}")?;
        let read = pairs.into_iter().map(|pair| {
            let value = pair.key.parse().ok().filter(|_| !is_octal(pair.key));
            if value.is_none() {
                let message = format!("expected a whole number, found `{}`", short(pair.key));
                let note = reader.findings.error(Code::WrongValue, pair.place, message);
                help_octal(note, pair.key);
            }
            let place = pair.place;
            (At { place, value }, reader.at(pair.value))
        });
        Some(read.collect())
    }
}

/// Constants of a request: path of the field, its position, and the value.
#[derive(Clone, Debug)]
pub(crate) struct Request(pub(crate) Vec<(String, Place, Literal)>);

impl Read for Request {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
        let mut found = Vec::new();
        constants(node, "", reader, &mut found)?;
        Some(Self(found))
    }
}

/// Returns `None` for faulty constants, which are noted. Maps nest no deeper than documents do.
fn constants(
    node: &Node<'_>,
    prefix: &str,
    reader: &mut Reader<'_>,
    found: &mut Vec<(String, Place, Literal)>,
) -> Option<()> {
    let mut sound = Some(());
    for pair in reader.pairs(node, "a map of field and value")? {
        let path = format!("{prefix}{}", pair.key);
        let literal = match &pair.value.kind {
            Kind::Map(_) => {
                let inner = constants(pair.value, &format!("{path}."), reader, found);
                sound = sound.and(inner);
                continue;
            }
            Kind::Scalar(text) => Some(Literal::One(text.clone().into_owned())),
            Kind::List(items) => {
                let texts = items
                    .iter()
                    .map(|item| reader.text(item, "a single value").map(str::to_owned));
                texts.collect::<Option<_>>().map(Literal::List)
            }
            Kind::Null => {
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

impl Read for OnLossEntry {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
        match &node.kind {
            Kind::Scalar(text) if text == "zero" => Some(Self::Zero),
            Kind::Scalar(text) => Some(Self::Value(Literal::One(text.clone().into_owned()))),
            Kind::Map(pairs) if pairs.iter().any(|(key, _)| is_scalar(key, "call")) => {
                StopCallEntry::read(node, reader).map(Self::Call)
            }
            Kind::Map(_) => Request::read(node, reader).map(Self::Fields),
            Kind::Null | Kind::List(_) => {
                reader.wrong(
                    node,
                    "`zero`, a value, the fields of a message as {linear.x: 0.1}, or {call: ns=2;i=48}",
                );
                None
            }
        }
    }
}

fn is_scalar(node: &Node<'_>, wanted: &str) -> bool {
    matches!(&node.kind, Kind::Scalar(text) if text == wanted)
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

impl Read for ConfirmedEntry {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
        match &node.kind {
            Kind::Scalar(text) if text == "bridge" => Some(Self::Bridge),
            Kind::Scalar(text) if text == "none" => Some(Self::None),
            Kind::Map(_) => {
                let read = ConfirmEntry::read(node, reader);
                read.map(|read| Self::Map(Box::new(read)))
            }
            Kind::Scalar(_) | Kind::Null | Kind::List(_) => {
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
pub(crate) struct FieldMapEntry(pub(crate) Vec<(String, Place, Assigned)>);

impl Read for FieldMapEntry {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
        let mut found = Vec::new();
        assignments(node, "", reader, &mut found)?;
        Some(Self(found))
    }
}

/// Returns `None` for faulty assignments, which are noted. Maps nest no deeper than documents do.
fn assignments(
    node: &Node<'_>,
    prefix: &str,
    reader: &mut Reader<'_>,
    found: &mut Vec<(String, Place, Assigned)>,
) -> Option<()> {
    let mut sound = Some(());
    for pair in reader.pairs(
        node,
        "a map of field and value, or of field and {field: ..}",
    )? {
        let path = format!("{prefix}{}", pair.key);
        let assigned = match &pair.value.kind {
            Kind::Map(pairs) => {
                if let [(key, value)] = &pairs[..]
                    && matches!(&key.kind, Kind::Scalar(key) if key == "field")
                    && let Kind::Scalar(text) = &value.kind
                {
                    Some(Assigned::Field(text.clone().into_owned()))
                } else {
                    let inner = assignments(pair.value, &format!("{path}."), reader, found);
                    sound = sound.and(inner);
                    continue;
                }
            }
            Kind::Scalar(text) => Some(Assigned::Constant(Literal::One(text.clone().into_owned()))),
            Kind::List(items) => {
                let texts = items
                    .iter()
                    .map(|item| reader.text(item, "a single value").map(str::to_owned));
                let texts: Option<Vec<String>> = texts.collect();
                texts.map(|texts| Assigned::Constant(Literal::List(texts)))
            }
            Kind::Null => {
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
pub(crate) struct CallBindings(pub(crate) Vec<At<CallBindingEntry>>);

impl Read for CallBindings {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
        match &node.kind {
            Kind::List(_) => Vec::read(node, reader).map(Self),
            Kind::Map(_) => Some(Self(vec![reader.at(node)])),
            Kind::Null | Kind::Scalar(_) => {
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

impl Read for UaFieldEntry {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
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
pub(crate) struct Includes(pub(crate) Vec<At<String>>);

impl Read for Includes {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
        match &node.kind {
            Kind::List(_) => Vec::read(node, reader).map(Self),
            Kind::Scalar(_) => Some(Self(vec![reader.at(node)])),
            Kind::Null | Kind::Map(_) => {
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
pub(crate) struct RoleList(pub(crate) Vec<At<RoleEntry>>);

impl Read for RoleList {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
        match &node.kind {
            Kind::List(_) => Vec::read(node, reader).map(Self),
            Kind::Scalar(_) => Some(Self(vec![reader.at(node)])),
            Kind::Null | Kind::Map(_) => {
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
pub(crate) struct FieldList(pub(crate) Vec<At<FieldEntry>>);

impl Read for FieldList {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
        let Kind::List(items) = &node.kind else {
            reader.wrong(node, "a list of fields such as `[linear.x, angular.z]`");
            return None;
        };
        let read = items.iter().map(|item| match &item.kind {
            Kind::Scalar(text) => At {
                place: item.place,
                value: Some(FieldEntry {
                    field: Some(At {
                        place: item.place,
                        value: Some(text.clone().into_owned()),
                    }),
                    scale: None,
                    offset: None,
                    invert: None,
                    out_of_range: None,
                }),
            },
            Kind::Null | Kind::List(_) | Kind::Map(_) => reader.at(item),
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
pub(crate) struct Bindings(pub(crate) Vec<At<BindingEntry>>);

impl Read for Bindings {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
        match &node.kind {
            Kind::List(_) => Vec::read(node, reader).map(Self),
            Kind::Map(_) => Some(Self(vec![reader.at(node)])),
            Kind::Null | Kind::Scalar(_) => {
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

/// What a queue does when it is full.
#[derive(Clone, Copy, Debug, JsonSchema)]
#[schemars(rename_all = "snake_case")]
pub(crate) enum Queue {
    /// A newer value takes the place of the one that waits.
    KeepLatest,
    /// That many values wait, and the oldest goes.
    DropOldest(#[schemars(range(min = 1, max = 65535))] u16),
}

impl Read for Queue {
    fn read(node: &Node<'_>, reader: &mut Reader<'_>) -> Option<Self> {
        match &node.kind {
            Kind::Scalar(text) if text == "keep_latest" => Some(Self::KeepLatest),
            Kind::Map(_) => {
                let [size] = reader.keys(node, ["drop_oldest"])?;
                let size = reader.field::<u16>(size);
                match size.as_ref().map(|at| (at.value, at.place)) {
                    Some((Some(0), place)) => {
                        let message = "a queue of no places holds nothing";
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
                            "`drop_oldest` has no number",
                        );
                        None
                    }
                }
            }
            Kind::Null | Kind::Scalar(_) | Kind::List(_) => {
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

fn found(node: &Node<'_>) -> String {
    match &node.kind {
        Kind::Scalar(text) => format!("`{}`", short(text)),
        Kind::Null | Kind::List(_) | Kind::Map(_) => node.kind.name().to_owned(),
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
pub(crate) fn read(root: &Node<'_>, reader: &mut Reader<'_>) -> Option<(Document, Place)> {
    if matches!(root.kind, Kind::Null) {
        // A file that another file includes may be empty.
        if root.place.file == 0 {
            let message = "the document is empty: it declares no spaces, values or calls";
            let note = reader.findings.error(Code::MissingKey, root.place, message);
            note.help("`ua-space init` writes a mapping of what is there; programs that need no mapping are started without one");
        }
        return Some((Document::default(), root.place));
    }
    Some((Document::read(root, reader)?, root.place))
}
