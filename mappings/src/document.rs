//! The document as it is written. The keys, their meaning for a reader of the schema, and nothing checked across them.

use std::collections::BTreeMap;

use schemars::JsonSchema;

use crate::code::Code;
use crate::read::{At, Read, Reader, choice, document, short};
use crate::tree::{Kind, Node, Place};

document! {
    /// One cell: its ROS spaces, its OPC UA nodes, and which ROS topic is which node.
    #[schemars(title = "UA bridge mapping")]
    struct Document {
        /// The ROS sides of the cell. The OPC UA side is space 0 and always there.
        spaces: Vec<At<SpaceEntry>>,
        /// How values travel between the spaces.
        pubsub: PubSubEntry,
        /// The OPC UA server of the cell.
        server: ServerEntry,
        /// Namespace index in node ids -> namespace URI. A server may number its namespaces otherwise; the URI counts.
        #[schemars(with = "Option<BTreeMap<u16, String>>")]
        namespaces: Namespaces,
        /// The values of the cell, at most 20 000.
        variables: Vec<At<VariableEntry>>,
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
        /// Multicast group or unicast address and port, as opc.udp://239.192.0.40:4840 (the default).
        #[schemars(regex(pattern = r"^opc\.udp://"))]
        address: String,
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
    }

    /// The OPC UA server of the cell.
    struct ServerEntry {
        /// Where clients connect; default opc.tcp://127.0.0.1:4840.
        #[schemars(regex(pattern = r"^opc\.tcp://"))]
        endpoint: String,
        /// ApplicationUri; default urn:ua-bridge:server.
        application_uri: String,
        /// Security policies it offers; default both.
        security: Vec<At<SecurityEntry>>,
    }

    /// One value of the cell.
    struct VariableEntry {
        /// The OPC UA node, as ns=2;i=10.
        #[schemars(required, regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        node: String,
        /// Name of the node.
        #[schemars(required, length(min = 1, max = 512))]
        name: String,
        /// OPC UA builtin type, as Boolean or Double[]. May be left out where a ROS type says it.
        r#type: String,
        /// The space that produces the value: 0 the OPC UA side, else one of `spaces`.
        #[schemars(required, range(max = 232))]
        origin: u16,
        /// Stands for the identifier in topic names when the node id is no number from 1 to 65535 or in namespace
        /// 0. In the topic names of nodes of namespace 0 the namespace is 65535.
        #[schemars(range(min = 1, max = 65535))]
        alias: u16,
        /// The ROS topics tied to the value, one or a list, at most one per space. In the space of its origin the topic is
        /// read, elsewhere it is written. Without any, the topic is named after the space: /ua_1_2_10.
        ros: Bindings,
        /// What its queue does when full: `keep_latest` (the default, for states) or `{drop_oldest: 100}` (for events).
        queue: Queue,
    }

    /// A ROS topic tied to a value.
    struct BindingEntry {
        /// Whose topic it is. Left out: the origin of the value.
        #[schemars(range(min = 1, max = 232))]
        space: u16,
        /// Absolute topic name, as /conveyor/running.
        #[schemars(required, regex(pattern = "^/"))]
        topic: String,
        /// Message type, as std_msgs/Bool. Left out: the std_msgs type of the variable's `type`.
        r#type: String,
        /// The field that holds the value, as data or pose.position.x. Left out: the whole message, a field per leaf.
        field: String,
        /// How the message crosses: `fields` (the default) as OPC UA values, `bytes` as it is, one ByteString that only a
        /// reader who knows the message type can read. For messages too big or too deep to be of use as values, as
        /// images; not together with `field`.
        r#as: AsEntry,
    }
}

choice! {
    enum PublisherIdEntry {
        /// A UInt16 of the number.
        Exact = "exact",
        /// The number in any unsigned integer type.
        AnyWidth = "any_width",
    }

    enum AsEntry {
        /// A value per field.
        Fields = "fields",
        /// The message as it is, one ByteString.
        Bytes = "bytes",
    }

    enum SecurityEntry {
        /// Neither signed nor encrypted.
        None = "None",
        /// Signed, or signed and encrypted.
        Basic256Sha256 = "Basic256Sha256",
    }
}

const DURATION: &str = r"^[0-9]+(\.[0-9]+)?(ms|s|min|h)$";

/// Index and URI, each at its place.
pub(crate) type Namespaces = Vec<(At<u16>, At<String>)>;

impl Read for Namespaces {
    fn read(node: &Node, reader: &mut Reader<'_>) -> Option<Self> {
        let pairs = reader.pairs(node, "a map of namespace index and URI")?;
        let read = pairs.into_iter().map(|pair| {
            let key = pair
                .key
                .parse()
                .ok()
                .filter(|_| pair.key.bytes().all(|b| b.is_ascii_digit()));
            if key.is_none() {
                let message = format!(
                    "expected a namespace index from 1 to 65535, found `{}`",
                    short(pair.key)
                );
                reader.findings.error(Code::WrongValue, pair.place, message);
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

/// One binding or a list of them.
#[derive(Clone, Debug)]
pub(crate) struct Bindings(pub(crate) Vec<At<BindingEntry>>);

impl Read for Bindings {
    fn read(node: &Node, reader: &mut Reader<'_>) -> Option<Self> {
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
    fn read(node: &Node, reader: &mut Reader<'_>) -> Option<Self> {
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

fn found(node: &Node) -> String {
    match &node.kind {
        Kind::Scalar(text) => format!("`{}`", short(text)),
        Kind::Null | Kind::List(_) | Kind::Map(_) => node.kind.name().to_owned(),
    }
}

/// Reads the whole document; an empty one is one without any key.
pub(crate) fn read(root: &Node, reader: &mut Reader<'_>) -> Option<(Document, Place)> {
    if matches!(root.kind, Kind::Null) {
        let document = Document {
            spaces: None,
            pubsub: None,
            server: None,
            namespaces: None,
            variables: None,
        };
        return Some((document, root.place));
    }
    Some((Document::read(root, reader)?, root.place))
}

/// The JSON Schema of the document, for editors: shapes and ranges, without what only checking across keys finds.
#[must_use]
pub fn schema() -> String {
    let schema = schemars::schema_for!(Document);
    // Every key is a string, which is all that could fail.
    let mut text = serde_json::to_string_pretty(&schema).unwrap_or_default();
    text.push('\n');
    text
}
