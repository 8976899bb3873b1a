//! Secured messages: accepted messages, rejected messages with their reasons, and sent messages.

mod allocation;
mod foreign;
mod refusing;
mod replay;
mod rollover;
mod sealing;

use std::time::Duration;

use uadp::{
    DataSetHeader, EncodeError, Extras, GroupHeader, NetworkHeader, NetworkMessage,
    NetworkMessageEncoder, Opener, OpenerOptions, PublisherId, Scalar, Seal, SecurityError,
    SecurityMode, SecurityPolicy, TokenKeys,
};

const START: Duration = Duration::ZERO;

/// Returns keys that repeat a single byte.
fn keys(byte: u8) -> TokenKeys {
    TokenKeys::from_bytes(SecurityPolicy::PubSubAes128Ctr, &[byte; 52]).unwrap()
}

/// Returns an opener with the current key `keys(1)` of token 1.
fn opener(mode: SecurityMode) -> Opener {
    opener_with(OpenerOptions::default(), mode)
}

fn opener_with(options: OpenerOptions, mode: SecurityMode) -> Opener {
    let mut opener = Opener::with(mode, options);
    opener.update_keys(1, [keys(1)]).unwrap();
    opener
}

/// Returns an encrypted message sealed with `keys(token as u8)`, of publisher 2 and WriterGroup 5.
fn sealed(token: u32, sequence: u32) -> Vec<u8> {
    sealed_by(PublisherId::UInt16(2), Some(5), token, sequence)
}

fn sealed_by(publisher: PublisherId<'_>, group: Option<u16>, token: u32, sequence: u32) -> Vec<u8> {
    let keys = keys(token as u8);
    let mode = SecurityMode::SignAndEncrypt;
    let random = sequence.wrapping_mul(0x9E37_79B9).to_be_bytes();
    let seal = Seal::with_nonce(&keys, token, mode, nonce(random, sequence));
    let mut datagram = Vec::new();
    write(&mut datagram, &header(publisher, group), seal).unwrap();
    datagram
}

fn nonce([a, b, c, d]: [u8; 4], sequence: u32) -> [u8; 8] {
    let [e, f, g, h] = sequence.to_le_bytes();
    [a, b, c, d, e, f, g, h]
}

fn header(publisher: PublisherId<'_>, group: Option<u16>) -> NetworkHeader<'_> {
    NetworkHeader {
        publisher_id: Some(publisher),
        group: group.map(|id| GroupHeader {
            writer_group_id: Some(id),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    }
}

/// Appends a message of DataSetWriter 10 with the field Int32 42.
fn write(
    datagram: &mut Vec<u8>,
    header: &NetworkHeader<'_>,
    seal: Seal<'_>,
) -> Result<(), EncodeError> {
    let extras = Extras {
        security: Some(seal.header()),
        ..Extras::default()
    };
    let mut message = NetworkMessageEncoder::with(datagram, header, Some(&[10]), &extras)?;
    let mut fields = message.key_frame(&DataSetHeader::default())?;
    fields.scalar(Scalar::Int32(42))?;
    fields.finish()?;
    message.finish_sealed(seal)
}

/// Opens the datagram at a time. Returns true for a message with constant sequence number.
fn open_at(opener: &mut Opener, datagram: &[u8], now: Duration) -> Result<bool, SecurityError> {
    let message = NetworkMessage::decode(datagram).unwrap();
    let mut scratch = Vec::new();
    let opened = opener.open(&message, now, &mut scratch)?;
    assert!(!opened.message.is_sealed());
    for message in opened.message.messages() {
        assert!(message.unwrap().fields().is_ok());
    }
    Ok(opened.constant_sequence)
}

fn open(opener: &mut Opener, datagram: &[u8]) -> Result<bool, SecurityError> {
    open_at(opener, datagram, START)
}
