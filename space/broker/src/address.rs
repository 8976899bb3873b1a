//! The ids of a NetworkMessage, from which its topic follows.

use mappings::TopicId;
use uadp::action::{ActionDialect, ActionKind};
use uadp::discovery::{AnnouncedContent, Announcement, ConnectionState, CyclicStatus};
use uadp::{NetworkMessage, NetworkMessageType, PublisherId};

use crate::topics::{Address, TopicMessageType};

/// The evaluation of a NetworkMessage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Addressed {
    pub(crate) address: Address,
    /// The topic that a discovery message withdraws.
    pub(crate) withdrawn: Option<TopicId>,
}

/// Returns the ids of an own message; `None` if it cannot be carried.
pub(crate) fn of(message: &NetworkMessage<'_>, own: Option<u16>) -> Option<Addressed> {
    let publisher = publisher(message)?;
    let group = message.group().and_then(|group| group.writer_group_id);
    let mut writers = message.writer_ids().into_iter().flatten();
    let writer = writers.next().filter(|_| writers.next().is_none());
    let address = |kind| Address {
        kind,
        publisher,
        group,
        writer,
    };
    let addressed = |address| Addressed {
        address,
        withdrawn: None,
    };
    match message.message_type() {
        NetworkMessageType::Probe => Some(addressed(alone(TopicMessageType::Probe, publisher))),
        NetworkMessageType::Announcement => Some(announcement(message, publisher)),
        NetworkMessageType::DataSet if is_action(message) => {
            Some(addressed(address(action_kind(message, publisher, own))))
        }
        NetworkMessageType::DataSet => Some(addressed(address(TopicMessageType::Data))),
    }
}

/// Returns the PublisherId of a message if it is the number of a space.
pub(crate) fn publisher(message: &NetworkMessage<'_>) -> Option<u16> {
    match message.publisher_id()? {
        PublisherId::Byte(id) => Some(id.into()),
        PublisherId::UInt16(id) => Some(id),
        PublisherId::UInt32(id) => id.try_into().ok(),
        PublisherId::UInt64(id) => id.try_into().ok(),
        PublisherId::String(_) => None,
    }
}

/// Returns whether the type, the group and the writer of a message are those of its topic, as far
/// as the topic names them.
pub(crate) fn agrees(network: &NetworkMessage<'_>, address: Address) -> bool {
    let kind = address.kind;
    let is_call = matches!(
        kind,
        TopicMessageType::ActionRequest | TopicMessageType::ActionResponse
    );
    match network.message_type() {
        NetworkMessageType::Probe => return kind == TopicMessageType::Probe,
        NetworkMessageType::Announcement => {
            return !is_call && !matches!(kind, TopicMessageType::Data | TopicMessageType::Probe);
        }
        NetworkMessageType::DataSet => {}
    }
    let found = of(network, None).map(|found| found.address.kind);
    // A sealed message or a chunk does not show whether it is a request or a response.
    let is_hidden = is_call && (network.is_sealed() || network.is_chunk());
    if found != Some(kind) && !(is_hidden && found == Some(TopicMessageType::ActionRequest)) {
        return false;
    }
    let group = network.group().and_then(|group| group.writer_group_id);
    let is_group = address.group.is_none_or(|wanted| group == Some(wanted));
    let is_writer = address
        .writer
        .is_none_or(|wanted| match network.writer_ids() {
            Some(mut writers) => writers.all(|id| id == wanted),
            None => !is_call,
        });
    is_group && is_writer
}

/// Returns the status in a message.
pub(crate) fn status(
    message: &NetworkMessage<'_>,
) -> Option<(ConnectionState, Option<CyclicStatus>)> {
    if message.is_sealed() || message.is_chunk() {
        return None;
    }
    match Announcement::decode(message).ok()?.announced {
        AnnouncedContent::ApplicationStatus { state, cyclic } => Some((state, cyclic)),
        AnnouncedContent::PublisherEndpoints { .. }
        | AnnouncedContent::DataSetMetaData { .. }
        | AnnouncedContent::DataSetWriterConfiguration { .. }
        | AnnouncedContent::PubSubConnections(_)
        | AnnouncedContent::PubSubConnection { .. }
        | AnnouncedContent::ApplicationDescription { .. }
        | AnnouncedContent::ActionResponder(_)
        | AnnouncedContent::ActionMetaData(_) => None,
    }
}

/// Returns the ids of a message without a group and a writer.
pub(crate) const fn alone(kind: TopicMessageType, publisher: u16) -> Address {
    Address {
        kind,
        publisher,
        group: None,
        writer: None,
    }
}

/// A chunk without DataSetWriterIds is of a request or response.
fn is_action(message: &NetworkMessage<'_>) -> bool {
    message.is_action() || (message.is_chunk() && message.writer_ids().is_none())
}

/// The PublisherId is that of the executor, in requests and in responses.
fn action_kind(message: &NetworkMessage<'_>, publisher: u16, own: Option<u16>) -> TopicMessageType {
    let readable = message.is_action() && !message.is_sealed() && !message.is_chunk();
    let actions = readable.then(|| message.actions(ActionDialect::Standard).ok());
    let first = actions
        .flatten()
        .and_then(|mut actions| actions.next()?.ok());
    match first.map(|first| first.action.kind) {
        Some(ActionKind::Request) => TopicMessageType::ActionRequest,
        Some(ActionKind::Response) => TopicMessageType::ActionResponse,
        None if own == Some(publisher) => TopicMessageType::ActionResponse,
        None => TopicMessageType::ActionRequest,
    }
}

fn announcement(message: &NetworkMessage<'_>, publisher: u16) -> Addressed {
    let hidden = Addressed {
        address: alone(TopicMessageType::Discovery, publisher),
        withdrawn: None,
    };
    if message.is_sealed() || message.is_chunk() {
        return hidden;
    }
    let Ok(announcement) = Announcement::decode(message) else {
        return hidden;
    };
    let plain = |kind| Addressed {
        address: alone(kind, publisher),
        withdrawn: None,
    };
    let of_topic = |kind, name: Option<&str>| {
        let (_, group, writer) = topic(name)?.triple();
        Some(Addressed {
            address: Address {
                kind,
                publisher,
                group: Some(group),
                writer: Some(writer),
            },
            withdrawn: None,
        })
    };
    match announcement.announced {
        AnnouncedContent::DataSetMetaData {
            meta_data, status, ..
        } => match status.0 & BAD {
            0 => of_topic(TopicMessageType::MetaData, meta_data.name).unwrap_or(hidden),
            _ => Addressed {
                withdrawn: topic(meta_data.name),
                ..hidden
            },
        },
        AnnouncedContent::ActionMetaData(action) => {
            of_topic(TopicMessageType::ActionMetaData, action.request.name).unwrap_or(hidden)
        }
        AnnouncedContent::ApplicationDescription { .. } => plain(TopicMessageType::Application),
        AnnouncedContent::PublisherEndpoints { .. } => plain(TopicMessageType::Endpoints),
        AnnouncedContent::ApplicationStatus { .. } => plain(TopicMessageType::Status),
        AnnouncedContent::PubSubConnections(_) | AnnouncedContent::PubSubConnection { .. } => {
            plain(TopicMessageType::Connection)
        }
        AnnouncedContent::ActionResponder(_) => plain(TopicMessageType::ActionResponder),
        AnnouncedContent::DataSetWriterConfiguration { .. } => hidden,
    }
}

/// Returns the topic that begins the name of a DataSet or Action, as in `ua_1_2_10 battery`.
fn topic(name: Option<&str>) -> Option<TopicId> {
    name?.split(' ').next()?.parse().ok()
}

/// The severity bit of a bad StatusCode.
const BAD: u32 = 0x8000_0000;

#[cfg(test)]
mod tests {
    use uadp::discovery::DataSetMetaDataType;
    use uadp::{
        DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, SecurityHeader,
        StatusCode,
    };

    use super::*;

    fn value(writers: &[u16]) -> Vec<u8> {
        let network = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(1)),
            group: Some(GroupHeader {
                writer_group_id: Some(2),
                ..GroupHeader::default()
            }),
            ..NetworkHeader::default()
        };
        let mut bytes = Vec::new();
        let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(writers)).unwrap();
        for _ in writers {
            message.keep_alive(&DataSetHeader::default()).unwrap();
        }
        message.finish().unwrap();
        bytes
    }

    fn addressed(bytes: &[u8]) -> Addressed {
        of(&NetworkMessage::decode(bytes).unwrap(), Some(1)).unwrap()
    }

    #[test]
    fn a_value_has_the_topic_of_its_writer_and_several_have_that_of_their_group() {
        let Address {
            kind,
            publisher,
            group,
            writer,
        } = addressed(&value(&[10])).address;
        assert_eq!(
            (kind, publisher, group, writer),
            (TopicMessageType::Data, 1, Some(2), Some(10))
        );
        assert_eq!(addressed(&value(&[10, 11])).address.writer, None);
    }

    #[test]
    fn metadata_has_the_topic_in_its_name_and_a_bad_status_withdraws_it() {
        for (status, kind) in [
            (StatusCode::GOOD, TopicMessageType::MetaData),
            (StatusCode(0x803E_0000), TopicMessageType::Discovery),
        ] {
            let announcement = Announcement {
                sequence_number: 1,
                announced: AnnouncedContent::DataSetMetaData {
                    writer_id: 10,
                    meta_data: DataSetMetaDataType {
                        name: Some("ua_1_2_10 battery"),
                        ..DataSetMetaDataType::default()
                    },
                    status,
                },
            };
            let mut bytes = Vec::new();
            let publisher = PublisherId::UInt16(1);
            announcement
                .encode(publisher, SecurityHeader::NONE, &mut bytes)
                .unwrap();
            let Addressed { address, withdrawn } = addressed(&bytes);
            assert_eq!(address.kind, kind);
            let is_withdrawn = kind == TopicMessageType::Discovery;
            assert_eq!(withdrawn.is_some(), is_withdrawn);
            assert_eq!(address.writer.is_some(), !is_withdrawn);
        }
    }

    #[test]
    fn a_value_is_accepted_at_the_topic_of_its_writer_only() {
        let bytes = value(&[10]);
        let message = NetworkMessage::decode(&bytes).unwrap();
        for kind in TopicMessageType::ALL {
            let address = Address {
                kind,
                publisher: 1,
                group: Some(2),
                writer: Some(10),
            };
            let is_data = kind == TopicMessageType::Data;
            assert_eq!(agrees(&message, address), is_data, "{kind:?}");
            let other = Address {
                writer: Some(11),
                ..address
            };
            assert!(!agrees(&message, other), "{kind:?}");
            assert_eq!(agrees(&message, alone(kind, 1)), is_data, "{kind:?}");
        }
    }
}
