//! The topic tree (OPC 10000-14, 7.3.4.7). Groups and writers are named by their decimal ids.

use std::fmt::Write as _;

use mappings::{Broker, MessageMapping, TopicForm, TopicId};

/// The type of a message, the third level of its topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum TopicMessageType {
    Data,
    MetaData,
    Status,
    Connection,
    Application,
    Endpoints,
    ActionRequest,
    ActionResponse,
    ActionMetaData,
    ActionResponder,
    /// An announcement that is encrypted or in chunks. It is no part of the standard, which relies
    /// on retained messages.
    Discovery,
    /// A probe, which any program may send to the publisher. It is no part of the standard.
    Probe,
}

impl TopicMessageType {
    pub(crate) const ALL: [Self; 12] = [
        // The status of a publisher is subscribed first, because it decides about the rest.
        Self::Status,
        Self::MetaData,
        Self::Connection,
        Self::Application,
        Self::Endpoints,
        Self::ActionMetaData,
        Self::ActionResponder,
        Self::Discovery,
        Self::Probe,
        Self::ActionRequest,
        Self::ActionResponse,
        Self::Data,
    ];

    pub(crate) const fn level(self) -> &'static str {
        match self {
            Self::Data => "data",
            Self::MetaData => "metadata",
            Self::Status => "status",
            Self::Connection => "connection",
            Self::Application => "application",
            Self::Endpoints => "endpoints",
            Self::ActionRequest => "action-request",
            Self::ActionResponse => "action-response",
            Self::ActionMetaData => "action-metadata",
            Self::ActionResponder => "action-responder",
            Self::Discovery => "discovery",
            Self::Probe => "probe",
        }
    }

    /// Returns whether the broker keeps the last message.
    pub(crate) const fn is_retained(self) -> bool {
        match self {
            Self::MetaData
            | Self::Status
            | Self::Connection
            | Self::Application
            | Self::Endpoints
            | Self::ActionMetaData
            | Self::ActionResponder => true,
            Self::Data
            | Self::ActionRequest
            | Self::ActionResponse
            | Self::Discovery
            | Self::Probe => false,
        }
    }
}

/// The ids in the topic of a message. A topic without a writer holds messages of several writers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct Address {
    pub(crate) kind: TopicMessageType,
    pub(crate) publisher: u16,
    pub(crate) group: Option<u16>,
    pub(crate) writer: Option<u16>,
}

/// A topic of the own prefix.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ReceivedTopic {
    pub(crate) is_json: bool,
    pub(crate) address: Address,
}

/// The second level of a topic.
pub(crate) const fn encoding(mapping: MessageMapping) -> &'static str {
    match mapping {
        MessageMapping::Uadp => UADP,
        MessageMapping::JsonVerbose
        | MessageMapping::JsonCompact
        | MessageMapping::JsonReversible
        | MessageMapping::JsonNonReversible => JSON,
    }
}

pub(crate) const UADP: &str = "uadp";
pub(crate) const JSON: &str = "json";

/// Returns the topic of a message.
pub(crate) fn name(broker: &Broker, encoding: &str, address: Address) -> String {
    let Address {
        kind,
        publisher,
        group,
        writer,
    } = address;
    let prefix = &broker.prefix;
    if let (TopicForm::Names, TopicMessageType::Data, Some(group), Some(writer)) =
        (broker.topics, kind, group, writer)
    {
        return format!("{prefix}/ua_{publisher}_{group}_{writer}");
    }
    let mut topic = format!("{prefix}/{encoding}/{}/{publisher}", kind.level());
    for id in [group, writer].into_iter().flatten() {
        // Writing to a string does not fail.
        let _written = write!(topic, "/{id}");
    }
    topic
}

/// Returns the ids of a received topic; `None` for a topic that is not of the space.
pub(crate) fn parse(broker: &Broker, topic: &str) -> Option<ReceivedTopic> {
    let rest = topic.strip_prefix(&broker.prefix)?.strip_prefix('/')?;
    if let Ok(id) = rest.parse::<TopicId>() {
        let (publisher, group, writer) = id.triple();
        return Some(ReceivedTopic {
            // Commands and sealed values are always UADP; JSON is known by its first byte.
            is_json: false,
            address: Address {
                kind: TopicMessageType::Data,
                publisher,
                group: Some(group),
                writer: Some(writer),
            },
        });
    }
    let mut levels = rest.split('/');
    let is_json = match levels.next()? {
        UADP => false,
        JSON => true,
        _ => return None,
    };
    let kind = levels.next()?;
    let kind = TopicMessageType::ALL
        .into_iter()
        .find(|of| of.level() == kind)?;
    let publisher = number(levels.next()?)?;
    let group = levels.next().map(number);
    let writer = levels.next().map(number);
    (levels.next().is_none()).then_some(ReceivedTopic {
        is_json,
        address: Address {
            kind,
            publisher,
            // Other stacks use names, which are not evaluated.
            group: group.flatten(),
            writer: writer.flatten(),
        },
    })
}

/// A filter of topics to subscribe.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct TopicFilter {
    pub(crate) name: String,
    /// Whether the broker delivers messages with QoS 1. Only values are sent with it. NATS keeps a
    /// replicated consumer for each such filter, which takes a second or more to create.
    pub(crate) confirmed: bool,
}

/// Returns the filters of all messages of the space, in the order of subscription.
pub(crate) fn filters(broker: &Broker) -> Vec<TopicFilter> {
    let prefix = &broker.prefix;
    let mut filters: Vec<TopicFilter> = TopicMessageType::ALL
        .into_iter()
        .flat_map(|kind| {
            [UADP, JSON].map(|encoding| TopicFilter {
                name: format!("{prefix}/{encoding}/{}/#", kind.level()),
                confirmed: broker.at_least_once && kind == TopicMessageType::Data,
            })
        })
        .collect();
    if broker.topics == TopicForm::Names {
        filters.push(TopicFilter {
            name: format!("{prefix}/+"),
            confirmed: broker.at_least_once,
        });
    }
    filters
}

/// Reads a decimal id without leading zeros.
pub(crate) fn number(level: &str) -> Option<u16> {
    let number: u16 = level.parse().ok()?;
    (number.to_string() == level).then_some(number)
}

#[cfg(test)]
mod tests {
    use mappings::BrokerAddress;

    use super::*;

    fn broker(topics: TopicForm) -> Broker {
        let mut broker = Broker::new(BrokerAddress::parse("mqtt://localhost").unwrap());
        broker.topics = topics;
        broker
    }

    const VALUE: Address = Address {
        kind: TopicMessageType::Data,
        publisher: 1,
        group: Some(2),
        writer: Some(10),
    };

    #[test]
    fn the_topic_of_a_value_is_its_name_in_the_space() {
        let tree = broker(TopicForm::Tree);
        assert_eq!(name(&tree, UADP, VALUE), "opcua/uadp/data/1/2/10");
        let names = broker(TopicForm::Names);
        assert_eq!(name(&names, UADP, VALUE), "opcua/ua_1_2_10");
        let status = Address {
            kind: TopicMessageType::Status,
            publisher: 1,
            group: None,
            writer: None,
        };
        assert_eq!(name(&names, JSON, status), "opcua/json/status/1");
    }

    #[test]
    fn every_topic_is_read_as_it_was_written() {
        for form in [TopicForm::Tree, TopicForm::Names] {
            let broker = broker(form);
            for kind in TopicMessageType::ALL {
                let address = Address { kind, ..VALUE };
                let read = parse(&broker, &name(&broker, UADP, address)).unwrap();
                assert_eq!(read.address, address);
                assert!(!read.is_json);
            }
        }
    }

    #[test]
    fn topics_of_others_are_not_read() {
        let broker = broker(TopicForm::Tree);
        for topic in [
            "opcua",
            "opcua/uadp",
            "opcua/uadp/data",
            "opcua/uadp/data/x/2/10",
            "opcua/uadp/data/01/2/10",
            "opcua/uadp/data/70000/2/10",
            "opcua/uadp/data/1/2/10/11",
            "opcua/xml/data/1/2/10",
            "opcua2/uadp/data/1/2/10",
            "other/uadp/data/1/2/10",
        ] {
            assert_eq!(parse(&broker, topic), None, "{topic}");
        }
        let named = parse(&broker, "opcua/uadp/data/1/robots/arm").unwrap();
        assert_eq!((named.address.group, named.address.writer), (None, None));
    }

    #[test]
    fn only_values_are_subscribed_with_qos_1() {
        let mut names = broker(TopicForm::Names);
        assert!(filters(&names).iter().all(|filter| !filter.confirmed));
        names.at_least_once = true;
        let confirmed: Vec<String> = filters(&names)
            .into_iter()
            .filter(|filter| filter.confirmed)
            .map(|filter| filter.name)
            .collect();
        let data = ["opcua/uadp/data/#", "opcua/json/data/#", "opcua/+"];
        assert_eq!(confirmed, data);
    }
}
