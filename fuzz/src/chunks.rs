//! Fuzzes messages in chunks that arrive in any order, mixed with other chunks.

use std::time::Duration;

use uadp::{
    ChunkBudget, ChunkEncoder, Extras, NetworkHeader, NetworkMessage, NetworkMessageType,
    PublisherId, Reassembler, ReassemblyLimits, Whole,
};

use crate::input::Input;

const LIMITS: ReassemblyLimits = ReassemblyLimits {
    whole: 4096,
    total: 16_384,
    total_per_sender: 12_288,
    open: 6,
    open_per_sender: 5,
    open_per_writer: 3,
    pieces: 64,
    age: Duration::from_millis(200),
};

/// Maximum number of chunks; more chunks add no coverage.
const CHUNKS: usize = 256;

struct Sent {
    datagram: Vec<u8>,
    whole: usize,
}

/// Runs operations, each a byte: split a message, deliver a chunk, deliver an arbitrary datagram,
/// let time pass. A reassembled message equals the split message, and stored data stays within the
/// limits.
pub fn chunks(data: &[u8]) {
    let mut input = Input::new(data);
    let mut reassembler = Reassembler::new(LIMITS);
    let mut wholes: Vec<Vec<u8>> = Vec::new();
    let mut sent: Vec<Sent> = Vec::new();
    let mut now = Duration::ZERO;
    // Nothing is signed here, so forged chunks may be mixed with the chunks of a message.
    let mut forged = false;
    while !input.is_empty() {
        match input.byte() % 4 {
            0 if sent.len() < CHUNKS => split(&mut input, &mut wholes, &mut sent),
            1 => {
                let index = usize::from(input.byte());
                if let Some(chunk) = sent.get(index) {
                    let whole = wholes.get(chunk.whole).expect("split before");
                    let came = deliver(&mut reassembler, &chunk.datagram, now);
                    assert!(forged || came.is_none_or(|came| came == *whole));
                }
            }
            2 => {
                forged = true;
                let datagram = [&[0xD1, 0x80, 0x01, 2][..], input.bytes()].concat();
                deliver(&mut reassembler, &datagram, now);
            }
            3 => {
                now += Duration::from_millis(input.byte().into());
                reassembler.expire(now);
                assert!(reassembler.poll_timeout().is_none_or(|at| at > now));
            }
            _ => {}
        }
        assert!(
            reassembler.held() <= LIMITS.total,
            "more is held than may be"
        );
    }
}

fn split(input: &mut Input<'_>, wholes: &mut Vec<Vec<u8>>, sent: &mut Vec<Sent>) {
    let pattern = input.bytes();
    let repeat = usize::from(input.byte() & 31) + 1;
    let bytes = pattern.repeat(repeat);
    let number = u16::try_from(wholes.len()).expect("few wholes");
    let whole = Whole {
        message_type: NetworkMessageType::DataSet,
        writer_id: Some(u16::from(input.byte() & 1)),
        message_sequence_number: number,
        bytes: &bytes,
    };
    let budget = ChunkBudget {
        network_message: usize::from(input.byte()) + 8,
        ..ChunkBudget::IPV4
    };
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::Byte(2)),
        ..NetworkHeader::default()
    };
    let Ok(mut chunks) = ChunkEncoder::new(&header, &Extras::default(), whole, budget) else {
        return;
    };
    let mut buffer = Vec::new();
    let before = sent.len();
    while sent.len() < CHUNKS {
        let Some(chunk) = chunks.append(&mut buffer, &Extras::default()) else {
            break;
        };
        let start = chunk.expect("nothing is secured").start;
        let datagram = buffer.split_off(start);
        assert!(datagram.len() <= budget.network_message, "over the budget");
        sent.push(Sent {
            datagram,
            whole: wholes.len(),
        });
    }
    assert_chunks(sent.get(before..).unwrap_or_default());
    wholes.push(bytes);
}

/// Asserts that all chunks except the last have the same size (OPC 10000-14, 7.2.4.4.4).
fn assert_chunks(sent: &[Sent]) {
    let sizes: Vec<usize> = sent.iter().map(|chunk| chunk.datagram.len()).collect();
    if let Some((last, others)) = sizes.split_last() {
        assert!(others.windows(2).all(|pair| pair[0] == pair[1]));
        assert!(others.iter().all(|size| size >= last));
    }
}

fn deliver(reassembler: &mut Reassembler, datagram: &[u8], now: Duration) -> Option<Vec<u8>> {
    let message = NetworkMessage::decode(datagram).ok()?;
    let whole = reassembler.receive(&message, now).ok()??;
    let _ = whole.data_set_message();
    Some(whole.bytes.to_vec())
}
