//! Carriers in the document: how values travel between the spaces.

use super::patterns::DURATION;
use crate::read::{FromNode, Located, NodeReader, OptionalKey, choice, document, inline_schema};
use crate::tree::{YamlKind, YamlNode};

document! {
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
        /// Shared memory of this host instead of UDP, without `address`, `mqtt`, `interface` and
        /// `ttl`.
        shm: SharedMemoryEntry,
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

    /// A carrier of the space, or the settings of all carriers.
    struct CarrierEntry {
        /// UDP multicast or unicast.
        udp: UdpEntry,
        /// An MQTT broker; its `address` is required.
        mqtt: MqttEntry,
        /// Ethernet frames with the EtherType of UADP, B62C; their `interface` is required.
        eth: EthernetEntry,
        /// Shared memory between programs of this host.
        shm: SharedMemoryEntry,
        /// Names of publishers at this carrier; their messages are forwarded to the other carriers:
        /// a space (ua_1), a namespace of it (ua_1_2) or a topic (ua_1_2_10), at most 1000. Requests
        /// of calls and confirmations of commands cross in the other direction. Default: none.
        forward: Vec<Located<String>>,
        /// Settings of all carriers, in an entry without a carrier.
        settings: PubSubEntry,
    }

    /// UADP over Ethernet. The program needs the capability CAP_NET_RAW.
    struct EthernetEntry {
        /// Name of the network interface, such as eth0.
        #[schemars(required)]
        interface: String,
        /// MAC address of a group, 01-00-5E-00-00-00 to 01-00-5E-7F-FF-FF, or of another host.
        /// Default 01-00-5E-40-00-28. Also as opc.eth://01-00-5E-40-00-28:5.6, with the VLAN and
        /// the priority.
        address: String,
        /// VLAN of the frames, 1 to 4094. Default: no VLAN.
        #[schemars(range(min = 1, max = 4094))]
        vlan: u16,
        /// Priority of sent frames (PCP), 0 to 7. Default 0.
        #[schemars(range(max = 7))]
        priority: u16,
    }

    /// Shared memory between programs of this host and of one user, by iceoryx2. Only programs that
    /// were built with the feature `shm` have it.
    struct SharedMemoryEntry {
        /// Name of the group: letters, digits, `-` and `_`; default `cell`. Programs with the same
        /// name receive each other's messages.
        #[schemars(length(min = 1, max = 64))]
        group: String,
    }

    /// UDP multicast or unicast.
    struct UdpEntry {
        /// Multicast group or unicast address and port; default opc.udp://239.192.0.40:4840.
        #[schemars(regex(pattern = r"^opc\.udp://"))]
        address: String,
        /// Name or address of the network interface. Default: the operating system chooses.
        interface: String,
        /// Other hosts by address and port, such as [10.0.0.2:4840], for networks that carry
        /// multicast badly: each datagram is sent to each of them. `address` is then the address
        /// and port of this host.
        peers: Vec<Located<String>>,
        /// Hops a multicast datagram may travel. Default 1: it stays on the link.
        #[schemars(range(max = 255))]
        ttl: u16,
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

    enum PublisherIdEntry {
        /// A UInt16 of the number.
        Exact = "exact",
        /// The number in any unsigned integer type.
        AnyWidth = "any_width",
    }
}

/// The settings of a single carrier, or a list of carriers.
#[derive(Clone, Debug)]
pub(crate) enum PubSubForm {
    One(Box<PubSubEntry>),
    Several(Vec<Located<CarrierEntry>>),
}

impl PubSubForm {
    /// Returns the settings of the brokers.
    pub(crate) fn brokers(&mut self) -> impl Iterator<Item = &mut MqttEntry> {
        let (one, several): (
            Option<&mut OptionalKey<MqttEntry>>,
            &mut [Located<CarrierEntry>],
        ) = match self {
            Self::One(entry) => (Some(&mut entry.mqtt), &mut []),
            Self::Several(entries) => (None, entries.as_mut_slice()),
        };
        let several = several.iter_mut().filter_map(|at| at.value.as_mut());
        let fields = one.into_iter().chain(several.map(|entry| &mut entry.mqtt));
        fields.filter_map(|field| field.as_mut()?.value.as_mut())
    }
}

impl FromNode for PubSubForm {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        match &node.kind {
            YamlKind::List(_) => Vec::read(node, reader).map(Self::Several),
            YamlKind::Scalar(_) | YamlKind::Null | YamlKind::Map(_) => {
                PubSubEntry::read(node, reader).map(|entry| Self::One(Box::new(entry)))
            }
        }
    }
}

inline_schema!(PubSubForm, generator => {
    let one = generator.subschema_for::<PubSubEntry>();
    let carrier = generator.subschema_for::<CarrierEntry>();
    schemars::json_schema!({
        "anyOf": [one, { "type": "array", "items": carrier, "minItems": 1 }]
    })
});
