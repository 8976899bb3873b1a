//! Writes pcapng files (draft-ietf-opsawg-pcapng) with a single interface and times in nanoseconds.

use std::net::SocketAddrV4;

use super::{
    BYTE_ORDER, END_OF_OPTIONS, ENHANCED_PACKET, INTERFACE_DESCRIPTION, INTERFACE_STATISTICS,
    SECTION_HEADER, TIME_RESOLUTION, reversed,
};
use crate::packet;

/// Encodes the blocks of a file. The file is whole after each block.
#[derive(Debug)]
pub(crate) struct PcapNg {
    link: LinkLayer,
    /// The Identification of the next IP packet.
    identification: u16,
}

/// The form of the packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LinkLayer {
    /// IPv4 packets with the UDP datagrams that were sent to an address.
    Udp(SocketAddrV4),
    /// NetworkMessages that a broker delivered, as exported PDUs.
    Exported,
}

impl PcapNg {
    /// Appends the first blocks of a file. `interface` is the name of the network interface or
    /// broker.
    pub(crate) fn begin(link: LinkLayer, interface: &str, out: &mut Vec<u8>) -> Self {
        let program = concat!("ua-space ", env!("CARGO_PKG_VERSION"));
        block(header_type(), out, |out| {
            out.extend(reversed(BYTE_ORDER));
            out.extend(1_u16.to_le_bytes());
            out.extend(0_u16.to_le_bytes());
            // The length of the section is unknown.
            out.extend(u64::MAX.to_le_bytes());
            option(USER_APPLICATION, program.as_bytes(), out);
            option(END_OF_OPTIONS, &[], out);
        });
        let link_type = match link {
            LinkLayer::Udp(_) => packet::RAW,
            LinkLayer::Exported => packet::EXPORTED,
        };
        block(INTERFACE_DESCRIPTION, out, |out| {
            out.extend(link_type.to_le_bytes());
            out.extend([0; 2]);
            // No limit of the captured bytes.
            out.extend(0_u32.to_le_bytes());
            option(INTERFACE_NAME, interface.as_bytes(), out);
            option(TIME_RESOLUTION, &[NANOSECONDS], out);
            option(END_OF_OPTIONS, &[], out);
        });
        Self {
            link,
            identification: 0,
        }
    }

    /// Appends a message that was received from `from` at `time`, in nanoseconds since 1970.
    pub(crate) fn packet(
        &mut self,
        time: i128,
        from: SocketAddrV4,
        message: &[u8],
        out: &mut Vec<u8>,
    ) {
        let head = match self.link {
            LinkLayer::Udp(to) => {
                self.identification = self.identification.wrapping_add(1);
                packet::ipv4_head((from, to), self.identification, message.len())
            }
            LinkLayer::Exported => packet::exported_head(),
        };
        let length = u32::try_from(head.len() + message.len()).unwrap_or(u32::MAX);
        block(ENHANCED_PACKET, out, |out| {
            out.extend(0_u32.to_le_bytes());
            out.extend(halves(time));
            out.extend(length.to_le_bytes());
            out.extend(length.to_le_bytes());
            out.extend(head);
            out.extend(message);
            pad(out);
        });
    }

    /// Appends the numbers of received and dropped messages, as the last block.
    pub(crate) fn end(time: i128, received: u64, dropped: u64, out: &mut Vec<u8>) {
        block(INTERFACE_STATISTICS, out, |out| {
            out.extend(0_u32.to_le_bytes());
            out.extend(halves(time));
            option(RECEIVED, &received.to_le_bytes(), out);
            option(DROPPED, &dropped.to_le_bytes(), out);
            option(END_OF_OPTIONS, &[], out);
        });
    }
}

/// Appends a block with its type and both lengths. `body` appends a multiple of four bytes.
fn block(kind: u32, out: &mut Vec<u8>, body: impl FnOnce(&mut Vec<u8>)) {
    let mut inner = Vec::new();
    body(&mut inner);
    let length = u32::try_from(inner.len() + 12).unwrap_or(u32::MAX);
    out.extend(kind.to_le_bytes());
    out.extend(length.to_le_bytes());
    out.extend(inner);
    out.extend(length.to_le_bytes());
}

fn option(code: u16, value: &[u8], out: &mut Vec<u8>) {
    let value = value.get(..usize::from(u16::MAX)).unwrap_or(value);
    out.extend(code.to_le_bytes());
    out.extend(u16::try_from(value.len()).unwrap_or(u16::MAX).to_le_bytes());
    out.extend(value);
    pad(out);
}

fn pad(out: &mut Vec<u8>) {
    out.resize(out.len().next_multiple_of(4), 0);
}

/// Returns the upper and the lower half of a time.
fn halves(time: i128) -> [u8; 8] {
    let [a, b, c, d, e, f, g, h] = u64::try_from(time).unwrap_or_default().to_be_bytes();
    let [upper, lower] = [[a, b, c, d], [e, f, g, h]].map(u32::from_be_bytes);
    let mut bytes = [0; 8];
    let (first, second) = bytes.split_at_mut(4);
    first.copy_from_slice(&upper.to_le_bytes());
    second.copy_from_slice(&lower.to_le_bytes());
    bytes
}

const fn header_type() -> u32 {
    u32::from_le_bytes(SECTION_HEADER)
}

const USER_APPLICATION: u16 = 4;
const INTERFACE_NAME: u16 = 2;
const RECEIVED: u16 = 4;
const DROPPED: u16 = 5;
/// The value of `if_tsresol` for nanoseconds.
const NANOSECONDS: u8 = 9;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::{CaptureReader, is_capture};
    use crate::packet::{Fragments, PacketContent, udp};

    const TIME: i128 = 1_779_021_296_789_012_345;

    #[test]
    fn a_written_file_is_read_with_its_times_and_addresses() {
        let (from, to) = ("10.0.0.1:5000", "239.192.0.40:4840");
        let link = LinkLayer::Udp(to.parse().unwrap());
        let mut file = Vec::new();
        let mut writer = PcapNg::begin(link, "eth0", &mut file);
        let messages = [&b"one"[..], &[7; 60_000], b""];
        for (message, time) in messages.iter().zip(TIME..) {
            writer.packet(time, from.parse().unwrap(), message, &mut file);
        }
        PcapNg::end(TIME, 3, 1, &mut file);
        let (magic, rest) = file.split_first_chunk().unwrap();
        assert!(is_capture(*magic));
        let mut capture = CaptureReader::new(*magic, rest).unwrap();
        for (message, time) in messages.iter().zip(TIME..) {
            let packet = capture.next_packet().unwrap().unwrap();
            assert_eq!(packet.time, Some(time));
            let mut fragments = Fragments::default();
            let PacketContent::Udp(found) = udp(packet.link_type, &packet.data, &mut fragments)
            else {
                panic!("no datagram");
            };
            assert_eq!((found.payload.as_ref(), found.missing), (*message, 0));
            assert_eq!(found.source, from.parse().unwrap());
            assert_eq!(found.destination, to.parse().unwrap());
        }
        assert_eq!(capture.next_packet().unwrap(), None);
    }

    #[test]
    fn messages_of_a_broker_are_exported_for_the_dissector() {
        let mut file = Vec::new();
        let mut writer = PcapNg::begin(LinkLayer::Exported, "mqtt://broker", &mut file);
        let from = "127.0.0.1:1883".parse().unwrap();
        writer.packet(TIME, from, b"message", &mut file);
        let (magic, rest) = file.split_first_chunk().unwrap();
        let packet = CaptureReader::new(*magic, rest)
            .unwrap()
            .next_packet()
            .unwrap();
        let packet = packet.unwrap();
        assert!(packet.data.windows(4).any(|window| window == b"uadp"));
        let found = udp(packet.link_type, &packet.data, &mut Fragments::default());
        assert!(matches!(found, PacketContent::Udp(found) if found.payload.as_ref() == b"message"));
    }
}
