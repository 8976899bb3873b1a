//! Compares our codec with `zerodds-opcua-pubsub`, an independent implementation of UADP: both
//! write the same bytes, and each reads the bytes of the other. Damaged bytes are either read
//! equally by both or refused by one of them.

mod content;
mod ours;

use proptest::prelude::*;
use proptest::sample::Index;
use zerodds_opcua_gateway::data_value::{DataValue, Variant, VariantValue};
use zerodds_opcua_pubsub::uadp::{DataSetData, DataSetMessage, NetworkMessage};
use zerodds_opcua_pubsub::{from_binary, to_binary};

use content::messages;
use ours::Unread;

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(1000) })]

    #[test]
    fn both_write_the_same_bytes(message in messages()) {
        let ours = ours::write(&message).unwrap();
        prop_assert_eq!(ours, to_binary(&message).unwrap());
    }

    #[test]
    fn theirs_reads_what_ours_wrote(message in messages()) {
        let datagram = ours::write(&message).unwrap();
        let read: NetworkMessage = from_binary(&datagram).unwrap();
        prop_assert_eq!(content(&read), content(&message));
    }

    #[test]
    fn ours_reads_what_theirs_wrote(message in messages()) {
        let datagram = to_binary(&message).unwrap();
        let read = ours::read(&datagram).unwrap();
        prop_assert_eq!(content(&read), content(&message));
        // Compares also the bits of a NaN, which its text does not show.
        prop_assert_eq!(ours::write(&read).unwrap(), datagram);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(5000) })]

    #[test]
    fn damaged_bytes_that_both_accept_say_the_same_to_both(
        message in messages(),
        damages in proptest::collection::vec(damage(), 1..4),
    ) {
        let mut datagram = to_binary(&message).unwrap();
        for damage in damages {
            damage.apply(&mut datagram);
        }
        if let (Ok(ours), Ok(theirs)) = (ours::read(&datagram), from_binary::<NetworkMessage>(&datagram))
            && !has_its_own_order(&ours)
        {
            prop_assert_eq!(content(&settled(ours)), content(&settled(theirs)), "{:02x?}", datagram);
        }
    }
}

/// Messages that the standard allows and the foreign codec does not read; the reason why
/// [`content`] leaves them out.
const ONLY_OURS: &[(&str, &[u8])] = &[
    ("heartbeat without FieldCount", &[0x01, 0x01]),
    ("ExpandedNodeId", &[0x01, 0x01, 1, 0, 18, 0, 5]),
    (
        "DataValue in a Variant",
        &[0x01, 0x01, 1, 0, 23, 0x01, 3, 5],
    ),
    ("DiagnosticInfo", &[0x01, 0x01, 1, 0, 25, 0]),
    (
        "array of Variants",
        &[0x01, 0x01, 1, 0, 0x80 | 24, 1, 0, 0, 0, 3, 5],
    ),
    (
        "null array",
        &[0x01, 0x01, 1, 0, 0x83, 0xFF, 0xFF, 0xFF, 0xFF],
    ),
    (
        "padding to a ConfiguredSize",
        &[
            0x41, 2, 1, 0, 2, 0, 5, 0, 3, 0, 0x01, 0, 0, 0, 0, 0x01, 0, 0,
        ],
    ),
    (
        "SecurityHeader of an unsecured message",
        &[0x81, 0x10, 0, 0, 0, 0, 0, 0, 0x01, 0, 0],
    ),
    ("invalid message", &[0x01, 0x00, 1, 0, 0x3F]),
];

/// Messages that the foreign codec reads although the standard has no such message.
const ONLY_THEIRS: &[(&str, &[u8])] = &[
    ("bytes behind the end", &[0x01, 0x01, 0, 0, 7]),
    ("Count 0", &[0x41, 0]),
    ("no DataSetMessage", &[0x01]),
    (
        "null PublisherId",
        &[0x91, 0x04, 0xFF, 0xFF, 0xFF, 0xFF, 0x01, 0, 0],
    ),
    ("type of an absent PublisherId", &[0x81, 0x05, 0x01, 0, 0]),
    ("ExtendedFlags2 bit 6", &[0x81, 0x80, 0x40, 0x01, 0, 0]),
    ("GroupFlags bit 4", &[0x21, 0x10, 0x01, 0, 0]),
    ("DataSetFlags2 bit 6", &[0x01, 0x81, 0x40, 0, 0]),
    ("DataValue mask bit 6", &[0x01, 0x05, 1, 0, 0x40]),
    ("LocalizedText mask bit 2", &[0x01, 0x01, 1, 0, 21, 0x04]),
    ("NodeId encoding bit 4", &[0x01, 0x01, 1, 0, 17, 0x10, 5]),
    ("array of the null type", &[0x01, 0x01, 1, 0, 0x80]),
    (
        "ArrayDimensions without an array",
        &[0x01, 0x01, 1, 0, 0x43, 5, 0, 0, 0, 0],
    ),
    ("length -2", &[0x01, 0x01, 1, 0, 12, 0xFE, 0xFF, 0xFF, 0xFF]),
    (
        "dimensions of another number of elements",
        &[
            0x01, 0x01, 1, 0, 0xC3, 1, 0, 0, 0, 5, 2, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0,
        ],
    ),
];

#[test]
fn what_only_one_of_the_two_reads_is_known() {
    for (what, datagram) in ONLY_OURS {
        assert!(
            !matches!(ours::read(datagram), Err(Unread::Refused(_))),
            "{what}"
        );
        assert!(from_binary::<NetworkMessage>(datagram).is_err(), "{what}");
    }
    for (what, datagram) in ONLY_THEIRS {
        assert!(
            matches!(ours::read(datagram), Err(Unread::Refused(_))),
            "{what}"
        );
        assert!(from_binary::<NetworkMessage>(datagram).is_ok(), "{what}");
    }
}

#[test]
fn picoseconds_stand_behind_their_time_as_the_standard_has_it_and_theirs_does_not() {
    let value = DataValue {
        value: None,
        status: None,
        source_timestamp: Some(1),
        source_pico_sec: Some(2),
        server_timestamp: Some(3),
        server_pico_sec: Some(4),
    };
    let mut message = DataSetMessage::key_frame_variant(0, Vec::new());
    message.data = DataSetData::DataValue(vec![value]);
    let mut message = NetworkMessage::with_messages(vec![message]);
    message.payload_header = false;
    let [source, server] = [1, 3].map(i64::to_le_bytes);
    let head: &[u8] = &[0x01, 0x05, 1, 0, 0x3C];
    assert_eq!(
        ours::write(&message).unwrap(),
        [head, &source, &[2, 0], &server, &[4, 0]].concat()
    );
    assert_eq!(
        to_binary(&message).unwrap(),
        [head, &source, &server, &[2, 0], &[4, 0]].concat()
    );
}

/// Returns the content of a message as text, in which -0 is not 0, and all NaNs are equal.
fn content(message: &NetworkMessage) -> String {
    format!("{message:#?}")
}

/// A change of a datagram.
#[derive(Debug, Clone)]
enum Damage {
    Flip(Index, u8),
    Set(Index, u8),
    /// A count or length that is about to overflow, or -1.
    Length(Index, i32),
    Remove(Index),
    Insert(Index, u8),
    Cut(Index),
}

fn damage() -> impl Strategy<Value = Damage> {
    let length = prop_oneof![Just(-1), Just(-2), Just(i32::MAX), Just(i32::MIN), -1..9];
    let at = any::<Index>;
    prop_oneof![
        6 => (at(), 0..8_u8).prop_map(|(at, bit)| Damage::Flip(at, bit)),
        3 => (at(), any::<u8>()).prop_map(|(at, byte)| Damage::Set(at, byte)),
        2 => (at(), length).prop_map(|(at, length)| Damage::Length(at, length)),
        1 => at().prop_map(Damage::Remove),
        1 => (at(), any::<u8>()).prop_map(|(at, byte)| Damage::Insert(at, byte)),
        1 => at().prop_map(Damage::Cut),
    ]
}

impl Damage {
    fn apply(&self, datagram: &mut Vec<u8>) {
        if datagram.is_empty() {
            return;
        }
        let len = datagram.len();
        match self {
            Self::Flip(at, bit) => datagram[at.index(len)] ^= 1 << bit,
            Self::Set(at, byte) => datagram[at.index(len)] = *byte,
            Self::Length(at, length) => {
                let places = datagram[at.index(len)..].iter_mut();
                places
                    .zip(length.to_le_bytes())
                    .for_each(|(place, byte)| *place = byte);
            }
            Self::Remove(at) => drop(datagram.remove(at.index(len))),
            Self::Insert(at, byte) => datagram.insert(at.index(len + 1), *byte),
            Self::Cut(at) => datagram.truncate(at.index(len)),
        }
    }
}

/// Returns the message without the parts that the two codecs read differently; each has a reason.
fn settled(mut message: NetworkMessage) -> NetworkMessage {
    for one in &mut message.messages {
        if !one.valid {
            // An invalid message must not be processed (OPC 10000-14, 7.2.4.5.4); the foreign codec
            // reads it.
            let blank = DataSetMessage::key_frame_variant(one.writer_id, Vec::new());
            *one = DataSetMessage {
                valid: false,
                ..blank
            };
        }
        settle_data(&mut one.data);
    }
    message.promoted_fields.iter_mut().for_each(settle);
    message
}

fn settle_data(data: &mut DataSetData) {
    match data {
        DataSetData::Variant(fields) => fields.iter_mut().for_each(settle),
        DataSetData::DeltaVariant(fields) => fields.iter_mut().for_each(|(_, field)| settle(field)),
        DataSetData::DataValue(fields) => fields.iter_mut().for_each(settle_data_value),
        DataSetData::DeltaDataValue(fields) => {
            fields
                .iter_mut()
                .for_each(|(_, field)| settle_data_value(field));
        }
        DataSetData::Raw(_) | DataSetData::None => {}
    }
}

/// Decoders limit PicoSeconds to 9999 (OPC 10000-6, 5.2.2.17); the foreign codec does not.
fn settle_data_value(value: &mut DataValue) {
    value.value.iter_mut().for_each(settle);
    value.source_pico_sec = value.source_pico_sec.map(|rest| rest.min(9999));
    value.server_pico_sec = value.server_pico_sec.map(|rest| rest.min(9999));
}

/// The foreign codec reads a null part of a LocalizedText that is present as empty, ours as absent.
fn settle(variant: &mut Variant) {
    for value in &mut variant.value {
        if let VariantValue::LocalizedText(text) = value {
            text.locale = text.locale.take().filter(|locale| !locale.is_empty());
            text.text = text.text.take().filter(|text| !text.is_empty());
        }
    }
}

/// Returns whether the message has a DataValue with times in another order in the foreign codec.
fn has_its_own_order(message: &NetworkMessage) -> bool {
    let apart =
        |value: &DataValue| value.source_pico_sec.is_some() && value.server_timestamp.is_some();
    message.messages.iter().any(|one| match &one.data {
        DataSetData::DataValue(fields) => fields.iter().any(apart),
        DataSetData::DeltaDataValue(fields) => fields.iter().any(|(_, field)| apart(field)),
        DataSetData::Variant(_)
        | DataSetData::DeltaVariant(_)
        | DataSetData::Raw(_)
        | DataSetData::None => false,
    })
}
