//! The datagrams that the kernel drops for a program that uses few namespaces.

use bridge_core::Interest;
use transport::{ByteTest, KeyRule};

/// Returns the rules that drop the datagrams that the program does not handle: values and calls of
/// other namespaces, probes for the calls of other namespaces, and announcements of other spaces.
/// All other datagrams are received, such as those of writers with another layout of the header.
pub(crate) fn rules(interest: &Interest) -> Vec<KeyRule> {
    let namespaces = || {
        let all = interest.namespaces.iter();
        all.map(|(space, namespace)| key(u16::from(*space), *namespace))
    };
    let announced = interest.announced.iter().map(|space| u16::from(*space));
    vec![
        KeyRule {
            layout: vec![GROUP_OF_PUBLISHER, PLAIN, bit(4, WRITER_GROUP)],
            key: [2, 5],
            wanted: namespaces().collect(),
        },
        KeyRule {
            layout: vec![
                GROUP_OF_PUBLISHER,
                EXTENDED,
                test(2, MESSAGE_TYPE, 0),
                bit(5, WRITER_GROUP),
            ],
            key: [3, 6],
            wanted: namespaces().collect(),
        },
        KeyRule {
            layout: vec![
                PUBLISHER_ALONE,
                EXTENDED,
                test(2, MESSAGE_TYPE, ANNOUNCEMENT),
            ],
            key: [3, 3],
            wanted: announced.map(|space| key(space, space)).collect(),
        },
        KeyRule {
            layout: vec![
                PUBLISHER_ALONE,
                test(1, 0xFF, EXTENDED.value | SECURITY_HEADER),
                test(2, 0xFF, PROBE),
                // Neither signed nor encrypted, and without a nonce.
                test(5, 0xFF, 0),
                test(10, 0xFF, 0),
                test(11, 0xFF, PUBLISHER_INFORMATION),
                test(12, 0xFF, WRITER_GROUP_CONFIGURATION),
            ],
            key: [3, 13],
            wanted: namespaces().collect(),
        },
    ]
}

/// Returns the key of two numbers, which are little-endian.
fn key(first: u16, second: u16) -> [u8; 4] {
    let ([a, b], [c, d]) = (first.to_le_bytes(), second.to_le_bytes());
    [a, b, c, d]
}

const fn test(offset: u16, mask: u8, value: u8) -> ByteTest {
    ByteTest {
        offset,
        mask,
        value,
    }
}

/// Returns a test for bits that are set.
const fn bit(offset: u16, mask: u8) -> ByteTest {
    test(offset, mask, mask)
}

// The headers of NetworkMessages (OPC 10000-14, 7.2.4.4.2).
/// UADPFlags: version 1, PublisherId, GroupHeader and ExtendedFlags1, with or without a
/// PayloadHeader.
const GROUP_OF_PUBLISHER: ByteTest = test(0, 0xBF, 0xB1);
/// UADPFlags: version 1, PublisherId and ExtendedFlags1.
const PUBLISHER_ALONE: ByteTest = test(0, 0xFF, 0x91);
/// ExtendedFlags1: the PublisherId is a UInt16; neither DataSetClassId nor ExtendedFlags2.
const PLAIN: ByteTest = test(1, 0x8F, 0x01);
/// ExtendedFlags1: the PublisherId is a UInt16; no DataSetClassId, but ExtendedFlags2.
const EXTENDED: ByteTest = test(1, 0x8F, 0x81);
const SECURITY_HEADER: u8 = 0x10;
/// ExtendedFlags2: the type of the NetworkMessage.
const MESSAGE_TYPE: u8 = 0x1C;
const PROBE: u8 = 0x04;
const ANNOUNCEMENT: u8 = 0x08;
/// GroupFlags: the WriterGroupId.
const WRITER_GROUP: u8 = 0x01;
// The body of a probe (OPC 10000-14, 7.2.4.6.12).
const PUBLISHER_INFORMATION: u8 = 1;
const WRITER_GROUP_CONFIGURATION: u8 = 4;

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;
    use std::sync::Arc;
    use std::time::Duration;

    use bridge_core::{
        CallDescription, CallRole, Local, LocalMessage, Now, OfferedCall, Output, Owned, Router,
        RouterSettings, ValueDescription,
    };
    use mappings::{Mapping, Overflow, SpaceId, TopicId};
    use uadp::{
        BuiltinType, DataSetHeader, NetworkHeader, NetworkMessage, NetworkMessageEncoder,
        NetworkMessageType, Scalar,
    };

    use super::*;
    use crate::clock::now;

    fn topic(namespace: u16, id: u16) -> TopicId {
        TopicId::new(0, namespace, id).unwrap()
    }

    fn component(namespace: u16) -> Router {
        let settings = RouterSettings {
            own: SpaceId::UA,
            local: Local::Fields,
            source: Some(SocketAddr::from(([127, 0, 0, 1], namespace))),
        };
        let mut router = Router::new(settings, Arc::new(Mapping::default()));
        router.set_owned(Owned::Only([namespace].into()), now());
        router
    }

    /// Returns the datagrams of a component with a value, a large value and a call.
    fn sent(namespace: u16) -> Vec<Vec<u8>> {
        let mut router = component(namespace);
        router.claim(now());
        let field = |path: &str| messages::Leaf {
            path: path.to_owned(),
            builtin: BuiltinType::String,
            rank: messages::ArrayRank::Scalar,
        };
        let described = ValueDescription {
            name: "gripper.State".to_owned(),
            message_type: None,
            about: String::new(),
            fields: vec![field("data")],
            overflow: Overflow::KeepLatest,
        };
        router.describe_value(topic(namespace, 10), described, now());
        let offered = OfferedCall {
            description: CallDescription {
                name: "gripper.Start".to_owned(),
                about: String::new(),
                role: CallRole::Call,
                request: Vec::new(),
                response: Vec::new(),
            },
            open: false,
        };
        router.offer(topic(namespace, 105), offered, now());
        let texts = ["Ready".to_owned(), "x".repeat(100_000)];
        for text in texts {
            let payload = block(&text);
            let heard = LocalMessage {
                topic: topic(namespace, 10),
                payload: &payload,
                received: now().utc,
                latched_by: None,
            };
            let _verdict = router.handle_local(heard, now());
        }
        let start = now();
        let mut sent = Vec::new();
        for step in 0..2_000 {
            let at = Now {
                monotonic: start.monotonic + Duration::from_millis(step),
                ..start
            };
            router.handle_timeout(at);
            while let Some(output) = router.poll_output(at) {
                if let Output::Datagram { bytes, .. }
                | Output::Discovery { bytes }
                | Output::Action { bytes, .. } = output
                {
                    sent.push(bytes);
                }
            }
        }
        sent
    }

    /// Returns a block of fields with a text.
    fn block(text: &str) -> Vec<u8> {
        let mut bytes = Vec::new();
        let header = NetworkHeader::default();
        let mut message = NetworkMessageEncoder::new(&mut bytes, &header, None).unwrap();
        let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
        frame.scalar(Scalar::String(Some(text))).unwrap();
        frame.finish().unwrap();
        message.finish().unwrap();
        let message = NetworkMessage::decode(&bytes).unwrap();
        let message = message.messages().next().unwrap().unwrap();
        message.fields().unwrap().bytes().to_vec()
    }

    fn announcements(datagrams: &[Vec<u8>]) -> usize {
        let messages = datagrams
            .iter()
            .map(|bytes| NetworkMessage::decode(bytes).unwrap().message_type());
        messages
            .filter(|of| *of == NetworkMessageType::Announcement)
            .count()
    }

    fn dropped(interest: &Interest, datagrams: &[Vec<u8>]) -> usize {
        let rules = rules(interest);
        let is_dropped = |bytes: &&Vec<u8>| rules.iter().any(|rule| rule.drops(bytes));
        datagrams.iter().filter(is_dropped).count()
    }

    #[test]
    fn a_component_does_not_receive_what_others_send_to_each_other() {
        let mut router = component(5);
        router.limit_to([]);
        let interest = router.interest().unwrap();
        let others = sent(7);
        assert!(others.len() > 10, "{}", others.len());
        assert_eq!(dropped(&interest, &others), others.len());
        // A program with the same namespace is received.
        let rival = sent(5);
        assert_eq!(dropped(&interest, &rival), announcements(&rival));
    }

    #[test]
    fn a_component_receives_the_namespaces_that_it_uses() {
        let mut router = component(5);
        router.limit_to([topic(7, 10)]);
        let interest = router.interest().unwrap();
        assert_eq!(dropped(&interest, &sent(7)), 0);
        // The announcements of a space do not name the namespace in their headers.
        let others = sent(9);
        assert_eq!(
            dropped(&interest, &others),
            others.len() - announcements(&others)
        );
        router.want_call(topic(9, 105), now());
        let interest = router.interest().unwrap();
        assert_eq!(dropped(&interest, &others), 0);
    }

    #[test]
    fn while_a_namespace_is_claimed_the_announcements_of_others_are_received() {
        let mut router = component(5);
        router.limit_to([]);
        router.claim(now());
        let interest = router.interest().unwrap();
        let rival = sent(5);
        assert_eq!(dropped(&interest, &rival), 0);
        router.tap(&[topic(9, 1)]);
        assert_eq!(router.interest(), None);
    }

    #[test]
    fn a_program_without_a_limit_receives_everything() {
        assert_eq!(component(5).interest(), None);
    }
}
