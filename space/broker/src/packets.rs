//! The packets of MQTT 3.1.1 and 5.0.

use mappings::MqttVersion;
use mqtt_protocol_core::mqtt;
use mqtt_protocol_core::mqtt::packet::{
    ContentType, MaximumPacketSize, MessageExpiryInterval, Packet, Property, Qos, SubEntry,
    SubOpts, UserProperty, v3_1_1, v5_0,
};
use mqtt_protocol_core::mqtt::result_code::MqttError;

use crate::queue::QueuedPublish;
use crate::settings::{BrokerSettings, Will};
use crate::topics::TopicFilter;

/// A received publication.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ReceivedPublish {
    pub(crate) topic: String,
    pub(crate) payload: Vec<u8>,
    pub(crate) retained: bool,
}

/// The response of a broker to a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ConnectAck {
    /// The largest packet that the broker takes.
    pub(crate) max_packet: Option<u32>,
    /// Whether the broker takes retained messages. With MQTT 3.1.1 it does not say so.
    pub(crate) retains: bool,
}

/// Returns the packet that opens a session without stored state. The broker retains the will if it
/// takes retained messages.
pub(crate) fn connect(
    settings: &BrokerSettings,
    (version, retains): (MqttVersion, bool),
) -> Result<Packet, MqttError> {
    let id = settings.client_id.as_str();
    let login = settings.credentials.as_ref();
    Ok(match version {
        MqttVersion::V3_1_1 => {
            let mut connect = v3_1_1::Connect::builder()
                .client_id(id)?
                .clean_session(true)
                .keep_alive(KEEP_ALIVE);
            if let Some(Will { topic, payload }) = &settings.will {
                connect =
                    connect.will_message(topic.as_str(), payload, Qos::AtLeastOnce, retains)?;
            }
            if let Some(login) = login {
                connect = connect
                    .user_name(login.user.as_str())?
                    .password(login.password.as_str())?;
            }
            connect.build()?.into()
        }
        MqttVersion::V5 => {
            let limit = MaximumPacketSize::new(MAX_RECEIVED)?;
            let mut connect = v5_0::Connect::builder()
                .client_id(id)?
                .clean_start(true)
                .keep_alive(KEEP_ALIVE)
                .props(vec![Property::MaximumPacketSize(limit)]);
            if let Some(Will { topic, payload }) = &settings.will {
                connect =
                    connect.will_message(topic.as_str(), payload, Qos::AtLeastOnce, retains)?;
            }
            if let Some(login) = login {
                connect = connect
                    .user_name(login.user.as_str())?
                    .password(login.password.as_str())?;
            }
            connect.build()?.into()
        }
    })
}

/// Returns the packet that subscribes a filter.
pub(crate) fn subscribe(
    TopicFilter { name, confirmed }: &TopicFilter,
    (version, id): (MqttVersion, u16),
) -> Result<Packet, MqttError> {
    let qos = if *confirmed {
        Qos::AtLeastOnce
    } else {
        Qos::AtMostOnce
    };
    let options = SubOpts::new().set_qos(qos);
    Ok(match version {
        MqttVersion::V3_1_1 => v3_1_1::Subscribe::builder()
            .packet_id(id)
            .entries(vec![SubEntry::new(name, options)?])
            .build()?
            .into(),
        // Own messages are not returned.
        MqttVersion::V5 => v5_0::Subscribe::builder()
            .packet_id(id)
            .entries(vec![SubEntry::new(name, options.set_nl(true))?])
            .build()?
            .into(),
    })
}

/// Returns the packet of a publication. `id` is set for a publication that is confirmed.
pub(crate) fn publish(
    publication: QueuedPublish,
    (version, id): (MqttVersion, Option<u16>),
) -> Result<Packet, MqttError> {
    let qos = match id {
        Some(_) => Qos::AtLeastOnce,
        None => Qos::AtMostOnce,
    };
    let QueuedPublish {
        topic,
        payload,
        retained,
        within,
        message_type,
        content_type,
        promoted,
        ..
    } = publication;
    Ok(match version {
        MqttVersion::V3_1_1 => {
            let mut packet = v3_1_1::Publish::builder()
                .topic_name(topic)?
                .qos(qos)
                .retain(retained)
                .payload(payload);
            if let Some(id) = id {
                packet = packet.packet_id(id);
            }
            packet.build()?.into()
        }
        MqttVersion::V5 => {
            let mut properties = Vec::new();
            // An empty payload clears a retained message.
            if !payload.is_empty() {
                properties.push(Property::UserProperty(UserProperty::new(
                    "UAMessageType",
                    message_type,
                )?));
                properties.push(Property::ContentType(ContentType::new(content_type)?));
            }
            for (name, text) in promoted.iter() {
                let property = UserProperty::new(name, text)?;
                properties.push(Property::UserProperty(property));
            }
            if let Some(within) = within {
                let seconds = within.as_secs() + u64::from(within.subsec_nanos() > 0);
                let seconds = u32::try_from(seconds).unwrap_or(u32::MAX);
                let expiry = MessageExpiryInterval::new(seconds)?;
                properties.push(Property::MessageExpiryInterval(expiry));
            }
            let mut packet = v5_0::Publish::builder()
                .topic_name(topic)?
                .qos(qos)
                .retain(retained)
                .props(properties)
                .payload(payload);
            if let Some(id) = id {
                packet = packet.packet_id(id);
            }
            packet.build()?.into()
        }
    })
}

/// Returns the packet that ends a session.
pub(crate) fn disconnect(version: MqttVersion) -> Result<Packet, MqttError> {
    Ok(match version {
        MqttVersion::V3_1_1 => v3_1_1::Disconnect::builder().build()?.into(),
        MqttVersion::V5 => v5_0::Disconnect::builder().build()?.into(),
    })
}

/// Returns the packet that the broker answers at once.
pub(crate) fn ping(version: MqttVersion) -> Result<Packet, MqttError> {
    Ok(match version {
        MqttVersion::V3_1_1 => v3_1_1::Pingreq::builder().build()?.into(),
        MqttVersion::V5 => v5_0::Pingreq::builder().build()?.into(),
    })
}

/// A packet of interest.
pub(crate) enum PacketEvent {
    Accepted(ConnectAck),
    Refused {
        why: String,
        version: bool,
        /// The broker does not take retained messages, and the will is one.
        retained_will: bool,
    },
    Message(ReceivedPublish),
    /// The broker confirmed or refused a subscription.
    Subscribed {
        id: u16,
        refused: bool,
    },
    Ended(String),
    Other,
}

/// Reads a received packet.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "acknowledgements and packets of brokers are handled by the protocol library"
)]
pub(crate) fn event(packet: Packet) -> PacketEvent {
    match packet {
        Packet::V3_1_1Connack(packet) => {
            let code = packet.return_code();
            let version = code == mqtt::result_code::ConnectReturnCode::UnacceptableProtocolVersion;
            if code.is_success() {
                PacketEvent::Accepted(ConnectAck {
                    max_packet: None,
                    retains: true,
                })
            } else {
                PacketEvent::Refused {
                    why: format!("the broker refuses the connection: {code:?}"),
                    version,
                    retained_will: false,
                }
            }
        }
        Packet::V5_0Connack(packet) => {
            let code = packet.reason_code();
            let version = code == mqtt::result_code::ConnectReasonCode::UnsupportedProtocolVersion;
            if code == mqtt::result_code::ConnectReasonCode::Success {
                PacketEvent::Accepted(ConnectAck {
                    max_packet: packet.props().iter().find_map(|property| match property {
                        Property::MaximumPacketSize(size) => Some(size.val()),
                        _ => None,
                    }),
                    retains: !packet.props().iter().any(|property| {
                        matches!(property, Property::RetainAvailable(takes) if takes.val() == 0)
                    }),
                })
            } else {
                let retained_will =
                    code == mqtt::result_code::ConnectReasonCode::RetainNotSupported;
                PacketEvent::Refused {
                    why: format!("the broker refuses the connection: {code:?}"),
                    version,
                    retained_will,
                }
            }
        }
        Packet::V3_1_1Publish(packet) => PacketEvent::Message(ReceivedPublish {
            topic: packet.topic_name().to_owned(),
            payload: packet.payload().as_slice().to_vec(),
            retained: packet.retain(),
        }),
        Packet::V5_0Publish(packet) => PacketEvent::Message(ReceivedPublish {
            topic: packet.topic_name().to_owned(),
            payload: packet.payload().as_slice().to_vec(),
            retained: packet.retain(),
        }),
        Packet::V3_1_1Suback(packet) => {
            let codes = packet.return_codes();
            PacketEvent::Subscribed {
                id: packet.packet_id(),
                refused: !codes.iter().all(|code| code.is_success()),
            }
        }
        Packet::V5_0Suback(packet) => {
            let codes = packet.reason_codes();
            PacketEvent::Subscribed {
                id: packet.packet_id(),
                refused: !codes.iter().all(|code| code.is_success()),
            }
        }
        Packet::V5_0Disconnect(packet) => PacketEvent::Ended(format!(
            "the broker ended the connection: {:?}",
            packet.reason_code()
        )),
        _ => PacketEvent::Other,
    }
}

/// The time in seconds after which the broker may consider the program gone, times 1.5.
const KEEP_ALIVE: u16 = 10;
/// The largest packet in bytes that is received.
pub(crate) const MAX_RECEIVED: u32 = 16 << 20;

#[cfg(test)]
mod tests {
    use super::*;
    use mqtt_protocol_core::mqtt::packet::GenericPacketTrait as _;

    use crate::json::PromotedTexts;

    #[test]
    fn promoted_fields_are_user_properties_of_mqtt_5_only() {
        let fields = [("Speed", "12.5"), ("Name", "\"a\"")];
        let publication = |promoted| QueuedPublish {
            topic: "opcua/uadp/data/1/2/10".to_owned(),
            payload: vec![1],
            retained: false,
            confirmed: false,
            replaceable: false,
            outlasts: false,
            within: None,
            message_type: "ua-data",
            content_type: "application/opcua+uadp",
            promoted,
        };
        let promoted = || PromotedTexts::from_iter(fields);
        let Packet::V5_0Publish(packet) =
            publish(publication(promoted()), (MqttVersion::V5, None)).unwrap()
        else {
            panic!("a publication")
        };
        let properties = packet.props().iter();
        let seen: Vec<_> = properties
            .filter_map(|property| {
                if let Property::UserProperty(pair) = property {
                    Some((pair.key(), pair.val()))
                } else {
                    None
                }
            })
            .collect();
        assert_eq!(
            seen,
            [&[("UAMessageType", "ua-data")], &fields[..]].concat()
        );
        let size = |promoted, version| {
            let packet = publish(publication(promoted), (version, None)).unwrap();
            packet.size()
        };
        let none = PromotedTexts::default;
        let with = size(promoted(), MqttVersion::V5);
        assert_eq!(with - size(none(), MqttVersion::V5), promoted().size());
        let with = size(promoted(), MqttVersion::V3_1_1);
        assert_eq!(with, size(none(), MqttVersion::V3_1_1));
    }
}
