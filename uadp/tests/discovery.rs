//! Discovery messages: decoded as intended by their senders, encoded byte for byte, and rejected at
//! no cost if malformed.

mod asyncua;
mod cost;
mod kinds;
mod properties;
mod vectors;

use uadp::discovery::{Announcement, Probe};
use uadp::{NetworkMessage, PublisherId, SecurityHeader};

fn unhex(hex: &str) -> Vec<u8> {
    let digits = hex.trim().as_bytes().chunks_exact(2);
    digits
        .map(|pair| u8::from_str_radix(str::from_utf8(pair).unwrap(), 16).unwrap())
        .collect()
}

fn body(announcement: &Announcement<'_>) -> Vec<u8> {
    let mut out = Vec::new();
    announcement.encode_body(&mut out).unwrap();
    out
}

fn probe_body(probe: &Probe<'_>) -> Vec<u8> {
    let mut out = Vec::new();
    probe.encode_body(&mut out).unwrap();
    out
}

/// Returns the datagram of a Publisher without security.
fn datagram(announcement: &Announcement<'_>) -> Vec<u8> {
    let mut out = Vec::new();
    announcement
        .encode(PublisherId::UInt16(2234), SecurityHeader::NONE, &mut out)
        .unwrap();
    let message = NetworkMessage::decode(&out).unwrap();
    assert_eq!(message.payload(), body(announcement));
    out
}
