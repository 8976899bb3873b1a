//! The list of carriers.

use schemars::JsonSchema;

use super::{MqttEntry, PubSubEntry};
use crate::read::{FromNode, Located, NodeReader, OptionalKey, document};
use crate::tree::{YamlKind, YamlNode};

document! {
    /// A carrier of the space, or the settings of all carriers.
    struct CarrierEntry {
        /// UDP multicast or unicast.
        udp: UdpEntry,
        /// An MQTT broker; its `address` is required.
        mqtt: MqttEntry,
        /// Ethernet frames with the EtherType of UADP, B62C; their `interface` is required.
        eth: EthernetEntry,
        /// Names of publishers at this carrier, whose messages are forwarded to the other carriers:
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

impl JsonSchema for PubSubForm {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        "PubSubForm".into()
    }

    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        let one = generator.subschema_for::<PubSubEntry>();
        let carrier = generator.subschema_for::<CarrierEntry>();
        schemars::json_schema!({
            "anyOf": [one, { "type": "array", "items": carrier, "minItems": 1 }]
        })
    }
}
