//! The document as it is written: keys and their documentation for the schema. Nothing is checked
//! across keys.

mod alarm;
mod binding;
mod call;
mod carriers;
mod patterns;
mod permissions;
mod request;
mod security;
mod server;
mod servers;
mod variable;

use std::collections::BTreeMap;

use crate::code::Code;
use crate::read::{
    FromNode, Located, NodeReader, document, help_octal, inline_schema, is_octal, short,
};
use crate::tree::{TextSpan, YamlKind, YamlNode};

pub(crate) use alarm::{AcknowledgesEntry, AlarmEntry, ReportsEntry};
pub(crate) use binding::{
    AsEntry, BindingEntry, Bindings, FieldEntry, FieldList, OutOfRangeEntry, PatternEntry,
};
pub(crate) use call::{CallBindingEntry, CallEntry, FieldMapEntry, MethodEntry};
pub(crate) use carriers::{
    CarrierEntry, EncodingEntry, EthernetEntry, MqttEntry, MqttVersionEntry, PubSubEntry,
    PubSubForm, PublisherIdEntry, SharedMemoryEntry, TopicFormEntry, UdpEntry,
};
pub(crate) use permissions::{CallPermissionsEntry, PermissionsEntry, RoleEntry, RoleList};
pub(crate) use request::Request;
pub(crate) use security::{
    GroupEntry, GroupModeEntry, GroupPolicyEntry, KeysEntry, ReplayEntry, SksEntry,
};
pub(crate) use server::{AnonymousEntry, HistoryEntry, LimitsEntry, ServerEntry};
pub(crate) use servers::{FromEntry, RemoteServerEntry, SecurityEntry, ToEntry};
pub(crate) use variable::{
    ConfirmEntry, ConfirmWhenEntry, ConfirmedEntry, OnLossEntry, PublishEntry, Queue,
    StopCallEntry, UaFieldEntry, VariableEntry,
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
}

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

/// A path or a list of paths.
#[derive(Clone, Debug)]
pub(crate) struct Includes(pub(crate) Vec<Located<String>>);

impl FromNode for Includes {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let is_one = matches!(node.kind, YamlKind::Scalar(_));
        let wanted = "a path such as `robots.yaml`, or a list of them";
        reader.one_or_list(node, is_one, wanted).map(Self)
    }
}

inline_schema!(Includes, generator => {
    let one = generator.subschema_for::<String>();
    schemars::json_schema!({ "anyOf": [one, { "type": "array", "items": one }] })
});

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
