//! Invalid datagrams: the reported error and its byte, and that no datagram makes the dissector
//! fail.

use system_tests::{CaptureFile, Cell, Dissected, Peer};
use uadp::{DecodeError, MessageKind, NetworkMessage, NetworkMessageType, Scalar};

use crate::dissector::{
    dissected,
    messages::key_frame,
    vectors::{DissectorVector, unhex},
};

/// PublisherId UInt16 2, WriterGroupId 5, DataSetWriterId 10: 10 bytes.
const HEADERS: &str = "f1010200010500010a00";

/// Datagrams, the position of the wrong byte, and the error.
const WRONG: &[(&str, usize, &str)] = &[
    ("f2010200010500010a0001", 0, "UADPVersion 2, not 1"),
    ("f1050200", 1, "PublisherId type 5 is reserved"),
    ("f1814000", 2, "ExtendedFlags2 0x40 has reserved bits"),
    ("f1810c00", 2, "NetworkMessage type 3 is reserved"),
    ("f101020011", 4, "GroupFlags 0x11 has reserved bits"),
    (
        "f10102000105",
        5,
        "WriterGroupId is cut off: 2 bytes expected, 1 left",
    ),
    ("f101020001050000", 7, "Count is 0"),
    ("f104ffffffff", 2, "PublisherId is the null String"),
    (
        "f1110200010500010a0010",
        10,
        "SecurityFlags 0x10 has reserved bits",
    ),
    (
        "f1110200010500010a0001010000000001",
        16,
        "Signature of 32 bytes does not fit in the 1 left",
    ),
    ("+07", 10, "field encoding 3 is reserved"),
    ("+8104", 11, "DataSetMessage type 4 is reserved"),
    ("+8107", 11, "DataSetMessage type 7 is reserved"),
    ("+8106", 10, "action response without ActionHeader"),
    ("+8140", 11, "DataSetFlags2 0x40 has reserved bits"),
    (
        "+010300",
        11,
        "FieldCount 3 does not fit in the 0 bytes left",
    ),
    ("+01010020", 13, "Variant encoding 0x20 is reserved"),
    ("+01010043", 13, "Variant encoding 0x43 is reserved"),
    ("+01010018", 13, "a Variant directly in a Variant"),
    (
        "+0101000b0000",
        14,
        "Double is cut off: 8 bytes expected, 2 left",
    ),
    ("+0101000cfeffffff", 14, "length of String is -2"),
    (
        "+0101000c05000000616263",
        18,
        "String is cut off: 5 bytes expected, 3 left",
    ),
    ("+0101000c01000000ff", 18, "String is not UTF-8"),
    (
        "+01010086ffffff7f00",
        14,
        "Int32 array of length 2147483647 does not fit in the 1 bytes left",
    ),
    (
        "+010100c302000000010201000000 0300",
        20,
        "ArrayDimensions of length 1 does not fit in the 2 bytes left",
    ),
    (
        "+010100c302000000010201000000030000 00",
        20,
        "ArrayDimensions do not fit the 2 elements",
    ),
    ("+01010011 4600", 14, "NodeId encoding 0x46 is reserved"),
    (
        "+01010015 04",
        14,
        "LocalizedText encoding mask 0x04 is reserved",
    ),
    (
        "+01010016 000003",
        16,
        "ExtensionObject encoding 3 is reserved",
    ),
    (
        "+01010017 40",
        14,
        "DataValue encoding mask 0x40 is reserved",
    ),
    (
        "+01010019 80",
        14,
        "DiagnosticInfo encoding mask 0x80 is reserved",
    ),
    (
        "+010100030700000001",
        15,
        "4 bytes behind the end of the message",
    ),
    ("+810301", 12, "1 bytes behind the end of the message"),
    (
        "f10102000105000201000200030005000701000101000308",
        16,
        "field encoding 3 is reserved",
    ),
    (
        "f1010200010500020100020001000100010101",
        18,
        "1 bytes behind the last DataSetMessage",
    ),
    (
        "f10102000105000201000200010009000101",
        17,
        "DataSetMessage of DataSetWriterId 2 is cut off",
    ),
    (
        "f181010200010500050001000000000004000000",
        20,
        "a chunk without data",
    ),
    (
        "f18101020001050005000100030000000400000001 02",
        12,
        "2 bytes from ChunkOffset 3 on do not fit in TotalSize 4",
    ),
    (
        "918104020001",
        1,
        "a discovery message without SecurityHeader",
    ),
    (
        "91910402000000000000000103",
        13,
        "length of DataSetWriterIds is cut off",
    ),
    ("919104020000000000000009", 11, "ProbeType 9 is reserved"),
    (
        "919108020000000000000009",
        11,
        "AnnouncementType 9 is reserved",
    ),
];

fn datagram(digits: &str) -> Vec<u8> {
    unhex(&digits.replace('+', HEADERS).replace(' ', ""))
}

#[test]
fn what_is_wrong_is_said_at_its_byte() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let capture = CaptureFile::of(WRONG.iter().map(|(digits, ..)| datagram(digits)));
    for (shown, (digits, at, why)) in cell.dissect(&capture, &[]).iter().zip(WRONG) {
        let said = shown.expert_infos();
        let expected = format!("At byte {at}: {why}");
        assert!(
            said.iter().any(|said| said.starts_with(&expected)),
            "{digits}: {said:?}, not {expected:?}"
        );
        assert!(shown.has("uadp.malformed"), "{digits}");
    }
}

#[test]
fn a_malformed_message_does_not_hide_the_next() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let shown = dissected(
        &cell,
        &datagram("f10102000105000201000200030005000701000101000308"),
    );
    assert!(shown.has("uadp.malformed"));
    assert_eq!(shown.all("uadp.field.byte"), ["8"]);
}

#[test]
fn a_datagram_cut_by_who_captured_it_is_not_called_malformed() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let whole = key_frame(|fields| {
        fields.scalar(Scalar::Int32(7)).unwrap();
        fields.scalar(Scalar::String(Some("some text"))).unwrap();
    });
    let vectors = [
        "nm_everything",
        "wire_sign_aes128",
        "composite_announce_metadata",
    ];
    let vectors = vectors.map(|name| DissectorVector::load(name).datagram);
    let cut = [whole]
        .into_iter()
        .chain(vectors)
        .flat_map(|datagram| (1..datagram.len()).map(move |kept| (datagram.clone(), kept)));
    for shown in cell.dissect(&CaptureFile::cut(cut), &[]) {
        assert!(shown.has("uadp.cut_by_capture"), "{shown:?}");
        assert!(!shown.has("uadp.malformed"), "{shown:?}");
        assert!(!shown.has("uadp.dissector_bug"), "{shown:?}");
    }
}

#[test]
fn values_nested_too_deep_and_too_many_to_show_do_no_harm() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let nested = |levels: usize| {
        let mut bytes = datagram("+010100");
        for _ in 0..levels {
            bytes.extend([0x98, 1, 0, 0, 0]);
        }
        bytes.extend([0x03, 7]);
        bytes
    };
    let nulls = |last: u8| {
        let mut bytes = datagram("+0160ea");
        bytes.resize(bytes.len() + 59_999, 0);
        bytes.push(last);
        bytes
    };
    let capture = CaptureFile::of([
        nested(100),
        nested(101),
        nested(5000),
        nulls(0),
        nulls(0x20),
    ]);
    let shown = cell.dissect(&capture, &["-o", "uadp.max_items:5000"]);
    let malformed: Vec<bool> = shown
        .iter()
        .map(|shown| shown.has("uadp.malformed"))
        .collect();
    assert_eq!(malformed, [false, true, true, false, true]);
    assert!(shown[3].has("uadp.hidden"));
    assert!(shown.iter().all(|shown| !shown.has("uadp.dissector_bug")));
}

/// A fixed sequence of pseudo-random numbers (xorshift), so that a failure can be reproduced.
struct Noise(u64);

impl Noise {
    fn below(&mut self, bound: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        usize::try_from(self.0 >> 20).unwrap() % bound
    }

    fn byte(&mut self) -> u8 {
        u8::try_from(self.below(256)).unwrap()
    }

    /// Returns a datagram with a few bytes changed, cut, inserted or removed.
    fn damage(&mut self, datagram: &[u8]) -> Vec<u8> {
        let mut damaged = datagram.to_vec();
        let at = self.below(damaged.len());
        match self.below(5) {
            0 => damaged.truncate(at.max(1)),
            1 => damaged[at] = self.byte(),
            2 => damaged[at] ^= 1 << self.below(8),
            3 => damaged.insert(at, self.byte()),
            _ if damaged.len() > 1 => {
                damaged.remove(at);
            }
            _ => damaged.push(0),
        }
        damaged
    }
}

/// Returns our reader's result for a whole message; `None` if the reader does not decide whether it
/// is malformed.
fn judged(datagram: &[u8]) -> Option<Result<(), DecodeError>> {
    let message = match NetworkMessage::decode(datagram) {
        Ok(message) => message,
        Err(error) => return Some(Err(error)),
    };
    let data = message.message_type() == NetworkMessageType::DataSet;
    if !data || message.is_chunk() || message.is_sealed() {
        return None;
    }
    for field in message.promoted_fields().into_iter().flatten() {
        if let Err(error) = field {
            return Some(Err(error));
        }
    }
    if message.is_action() {
        // Checked in the module of Actions.
        return None;
    }
    for data_set_message in message.messages() {
        let read = data_set_message.and_then(|found| {
            let raw = found.encoding() == uadp::FieldEncoding::RawData;
            match found.kind {
                _ if !found.is_valid() => Ok(()),
                MessageKind::KeyFrame | MessageKind::KeepAlive if raw => Ok(()),
                _ => found.values()?.try_for_each(|field| field.map(|_| ())),
            }
        });
        match read {
            // Without payload header, further messages may follow.
            Err(DecodeError::TrailingBytes(_)) if message.writer_ids().is_none() => return None,
            Err(error) => return Some(Err(error)),
            Ok(()) => {}
        }
    }
    Some(Ok(()))
}

#[test]
fn damaged_datagrams_are_called_malformed_when_our_reader_refuses_them() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let mut noise = Noise(0x9E37_79B9_7F4A_7C15);
    let datagrams: Vec<Vec<u8>> = DissectorVector::all()
        .iter()
        .flat_map(|vector| {
            (0..30)
                .map(|_| noise.damage(&vector.datagram))
                .collect::<Vec<_>>()
        })
        .collect();
    let shown = cell.dissect(&CaptureFile::of(datagrams.clone()), &[]);
    let mut counts = [0, 0];
    let mut differences = Vec::new();
    for (datagram, shown) in datagrams.iter().zip(&shown) {
        assert!(!shown.has("uadp.dissector_bug"), "{datagram:02x?}");
        let malformed = shown.has("uadp.malformed");
        match judged(datagram) {
            None | Some(Err(DecodeError::Unsupported(_))) => {}
            Some(judged) if judged.is_err() == malformed => counts[usize::from(malformed)] += 1,
            Some(judged) => differences.push(difference(datagram, &judged, shown)),
        }
    }
    assert!(differences.is_empty(), "{}", differences.join("\n"));
    assert!(counts.iter().all(|count| *count > 1000), "{counts:?}");
}

fn difference(datagram: &[u8], judged: &Result<(), DecodeError>, shown: &Dissected) -> String {
    format!(
        "{datagram:02x?}: {judged:?}, but {:?}",
        shown.expert_infos()
    )
}
