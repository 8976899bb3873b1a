//! Extracts the UDP datagram of a captured packet: link layers, IPv4, IPv6, and fragments of both.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV4};

/// A UDP datagram.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct UdpPacket<'a> {
    pub(crate) source: SocketAddr,
    pub(crate) destination: SocketAddr,
    pub(crate) payload: Cow<'a, [u8]>,
    /// Number of bytes of the payload that were not captured.
    pub(crate) missing: usize,
}

/// The contents of a packet.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum PacketContent<'a> {
    Udp(UdpPacket<'a>),
    /// A fragment of a datagram that is not complete yet.
    Fragment,
    /// Another protocol, or a packet with truncated headers.
    Other,
    /// An unsupported LINKTYPE.
    UnknownLink,
}

/// Extracts the UDP datagram of a packet.
pub(crate) fn udp<'a>(
    link_type: u16,
    data: &'a [u8],
    fragments: &mut Fragments,
) -> PacketContent<'a> {
    if link_type == EXPORTED {
        return exported(data);
    }
    let packet = match link_type {
        ETHERNET => ethernet(data),
        RAW | RAW_BSD | RAW_OPENBSD | IPV4 | IPV6 => Some(data),
        // The address family has different numbers on different systems; the version in the IP
        // header is used instead.
        NULL | LOOP => data.get(4..),
        LINUX_SLL => data.get(16..),
        LINUX_SLL2 => data.get(20..),
        _ => return PacketContent::UnknownLink,
    };
    let Some(ip) = packet.and_then(Ip::read) else {
        return PacketContent::Other;
    };
    if ip.protocol != UDP {
        return PacketContent::Other;
    }
    let addresses = (ip.source, ip.destination);
    match ip.fragment {
        None => read_udp(addresses, ip.payload, ip.missing)
            .map_or(PacketContent::Other, |(header, payload)| {
                PacketContent::Udp(header.with(Cow::Borrowed(payload)))
            }),
        // A fragment that was not captured completely leaves a gap that never closes.
        Some(fragment) => {
            match fragments.add((addresses, fragment.identification), &fragment, ip.payload) {
                None => PacketContent::Fragment,
                Some(whole) => read_udp(addresses, &whole, 0).map_or(
                    PacketContent::Other,
                    |(header, payload)| {
                        PacketContent::Udp(header.with(Cow::Owned(payload.to_vec())))
                    },
                ),
            }
        }
    }
}

/// Returns the NetworkMessage of an exported PDU, which has no addresses.
fn exported(mut data: &[u8]) -> PacketContent<'_> {
    let nowhere = SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0));
    let mut is_uadp = false;
    while let Some((&[a, b, c, d], rest)) = data.split_first_chunk() {
        let length = usize::from(u16::from_be_bytes([c, d]));
        match u16::from_be_bytes([a, b]) {
            END_OF_TAGS if is_uadp => {
                return PacketContent::Udp(UdpPacket {
                    source: nowhere,
                    destination: nowhere,
                    payload: Cow::Borrowed(rest),
                    missing: 0,
                });
            }
            END_OF_TAGS => return PacketContent::Other,
            DISSECTOR => is_uadp = rest.get(..length).is_some_and(|name| name == UADP),
            _ => {}
        }
        data = rest.get(length..).unwrap_or_default();
    }
    PacketContent::Other
}

/// Returns the tags before the NetworkMessage in an exported PDU.
pub(crate) fn exported_head() -> Vec<u8> {
    let tag = |tag: u16, value: &[u8]| {
        let length = u16::try_from(value.len()).unwrap_or_default();
        [&tag.to_be_bytes()[..], &length.to_be_bytes(), value].concat()
    };
    [tag(DISSECTOR, UADP), tag(END_OF_TAGS, &[])].concat()
}

/// Returns the headers of IPv4 and UDP of a datagram, without a checksum of UDP.
pub(crate) fn ipv4_head(
    (from, to): (SocketAddrV4, SocketAddrV4),
    identification: u16,
    length: usize,
) -> Vec<u8> {
    let length = |headers: usize| u16::try_from(length + headers).unwrap_or(u16::MAX);
    let mut head = vec![0x45, 0];
    head.extend(length(28).to_be_bytes());
    head.extend(identification.to_be_bytes());
    head.extend([0, 0, 1, UDP, 0, 0]);
    head.extend(from.ip().octets());
    head.extend(to.ip().octets());
    let (words, _) = head.as_chunks();
    let sum: u32 = words
        .iter()
        .map(|word| u32::from(u16::from_be_bytes(*word)))
        .sum();
    let folded = (sum & 0xFFFF) + (sum >> 16);
    let checksum = !u16::try_from((folded & 0xFFFF) + (folded >> 16)).unwrap_or_default();
    if let Some(place) = head.get_mut(10..12) {
        place.copy_from_slice(&checksum.to_be_bytes());
    }
    for part in [from.port(), to.port(), length(8), 0] {
        head.extend(part.to_be_bytes());
    }
    head
}

/// Fragments of incomplete IP datagrams.
///
/// Holds at most 256 datagrams and 4 MiB; beyond these limits the oldest datagram is discarded.
#[derive(Debug, Default)]
pub(crate) struct Fragments {
    open: VecDeque<Partial>,
    held: usize,
    given_up: usize,
}

/// Source, destination and Identification.
type FragmentKey = ((IpAddr, IpAddr), u32);

#[derive(Debug)]
struct Partial {
    key: FragmentKey,
    /// The fragments in the order of arrival, each with its offset.
    pieces: Vec<(usize, Vec<u8>)>,
    /// The total length, known once the last fragment has arrived.
    length: Option<usize>,
}

impl Fragments {
    /// Returns the number of incomplete IP datagrams so far.
    pub(crate) fn incomplete(&self) -> usize {
        self.given_up + self.open.len()
    }

    fn add(&mut self, key: FragmentKey, fragment: &Fragment, payload: &[u8]) -> Option<Vec<u8>> {
        let place = self.open.iter().position(|partial| partial.key == key);
        let mut partial = match place.and_then(|place| self.open.remove(place)) {
            Some(partial) => partial,
            None => Partial {
                key,
                pieces: Vec::new(),
                length: None,
            },
        };
        self.held = self.held.saturating_sub(partial.held());
        partial.pieces.push((fragment.offset, payload.to_vec()));
        if !fragment.more {
            partial.length = Some(fragment.offset + payload.len());
        }
        if let Some(whole) = partial.whole() {
            return Some(whole);
        }
        self.held += partial.held();
        self.open.push_back(partial);
        while self.open.len() > MAX_OPEN || self.held > MAX_HELD {
            let Some(oldest) = self.open.pop_front() else {
                break;
            };
            self.held = self.held.saturating_sub(oldest.held());
            self.given_up += 1;
        }
        None
    }
}

impl Partial {
    fn held(&self) -> usize {
        let pieces = self.pieces.iter();
        pieces.map(|(_, piece)| piece.len() + PIECE_COST).sum()
    }

    /// Returns all bytes if there is no gap. If fragments overlap, the last received fragment is
    /// used.
    fn whole(&mut self) -> Option<Vec<u8>> {
        let length = self.length?;
        let mut order: Vec<_> = self
            .pieces
            .iter()
            .map(|(offset, piece)| (*offset, offset + piece.len()))
            .collect();
        order.sort_unstable();
        let covered = order
            .iter()
            .try_fold(0, |end, (from, to)| (*from <= end).then_some(end.max(*to)))?;
        if covered < length {
            return None;
        }
        let mut whole = vec![0; covered];
        for (offset, piece) in &self.pieces {
            if let Some(place) = whole.get_mut(*offset..offset + piece.len()) {
                place.copy_from_slice(piece);
            }
        }
        whole.truncate(length);
        Some(whole)
    }
}

/// An IP packet.
struct Ip<'a> {
    source: IpAddr,
    destination: IpAddr,
    protocol: u8,
    fragment: Option<Fragment>,
    payload: &'a [u8],
    /// Number of bytes of the payload that were not captured.
    missing: usize,
}

struct Fragment {
    identification: u32,
    offset: usize,
    /// True if more fragments follow.
    more: bool,
}

impl<'a> Ip<'a> {
    fn read(packet: &'a [u8]) -> Option<Self> {
        match packet.first()? >> 4 {
            4 => Self::read_v4(packet),
            6 => Self::read_v6(packet),
            _ => None,
        }
    }

    fn read_v4(packet: &'a [u8]) -> Option<Self> {
        let header: &[u8; 20] = packet.first_chunk()?;
        let [
            first,
            _,
            total_a,
            total_b,
            id_a,
            id_b,
            flags,
            offset,
            _,
            protocol,
            ..,
        ] = *header;
        let header_length = usize::from(first & 0x0F) * 4;
        let total = match u16::from_be_bytes([total_a, total_b]) {
            // The length is left to the network card to fill in.
            0 => packet.len(),
            total => total.into(),
        };
        let end = total.min(packet.len());
        let word = u16::from_be_bytes([flags, offset]);
        let fragment = Fragment {
            identification: u16::from_be_bytes([id_a, id_b]).into(),
            offset: usize::from(word & 0x1FFF) * 8,
            more: word & 0x2000 != 0,
        };
        Some(Self {
            source: Ipv4Addr::from(array::<4>(header, 12)?).into(),
            destination: Ipv4Addr::from(array::<4>(header, 16)?).into(),
            protocol,
            fragment: (fragment.more || fragment.offset != 0).then_some(fragment),
            payload: packet
                .get(header_length..end)
                .filter(|_| header_length >= 20)?,
            missing: total - end,
        })
    }

    fn read_v6(packet: &'a [u8]) -> Option<Self> {
        let (header, rest) = packet.split_first_chunk::<40>()?;
        let [_, _, _, _, length_a, length_b, mut next, ..] = *header;
        let length = match u16::from_be_bytes([length_a, length_b]) {
            0 => rest.len(),
            length => length.into(),
        };
        let end = length.min(rest.len());
        let mut payload = rest.get(..end)?;
        let mut fragment = None;
        for _ in 0..MAX_EXTENSIONS {
            let &[following, size, ..] = payload.first_chunk::<8>().unwrap_or(&[0; 8]);
            let extension = match next {
                HOP_BY_HOP | ROUTING | DESTINATION | MOBILITY => usize::from(size) * 8 + 8,
                AUTHENTICATION => usize::from(size) * 4 + 8,
                FRAGMENT => {
                    fragment = Fragment::read_v6(payload)?;
                    8
                }
                _ => break,
            };
            next = following;
            payload = payload.get(extension..)?;
            if fragment.is_some() {
                // Further headers of a fragmented packet are read after its reassembly.
                break;
            }
        }
        Some(Self {
            source: Ipv6Addr::from(array::<16>(header, 8)?).into(),
            destination: Ipv6Addr::from(array::<16>(header, 24)?).into(),
            protocol: next,
            fragment,
            payload,
            missing: length - end,
        })
    }
}

impl Fragment {
    /// Reads a fragment header. The outer `None` stands for a truncated header, the inner `None`
    /// for an unfragmented datagram.
    fn read_v6(header: &[u8]) -> Option<Option<Self>> {
        let [_, _, offset_a, offset_b, identification @ ..] = *header.first_chunk::<8>()?;
        let word = u16::from_be_bytes([offset_a, offset_b]);
        let fragment = Self {
            identification: u32::from_be_bytes(identification),
            offset: usize::from(word & 0xFFF8),
            more: word & 1 != 0,
        };
        Some((fragment.more || fragment.offset != 0).then_some(fragment))
    }
}

/// Returns the bytes after the Ethernet header and its VLAN tags, if they are IP.
fn ethernet(frame: &[u8]) -> Option<&[u8]> {
    let mut rest = frame.get(12..)?;
    for _ in 0..=MAX_VLAN_TAGS {
        let (ether_type, behind) = rest.split_first_chunk()?;
        match u16::from_be_bytes(*ether_type) {
            0x0800 | 0x86DD => return Some(behind),
            0x8100 | 0x88A8 | 0x9100 => rest = behind.get(2..)?,
            _ => return None,
        }
    }
    None
}

struct UdpHeader {
    source: SocketAddr,
    destination: SocketAddr,
    missing: usize,
}

impl UdpHeader {
    fn with(self, payload: Cow<'_, [u8]>) -> UdpPacket<'_> {
        UdpPacket {
            source: self.source,
            destination: self.destination,
            payload,
            missing: self.missing,
        }
    }
}

fn read_udp(
    (source, destination): (IpAddr, IpAddr),
    bytes: &[u8],
    missing: usize,
) -> Option<(UdpHeader, &[u8])> {
    let (&[source_a, source_b, to_a, to_b, length_a, length_b, _, _], rest) =
        bytes.split_first_chunk::<8>()?;
    let length = match u16::from_be_bytes([length_a, length_b]) {
        0 => rest.len() + missing,
        length => usize::from(length).checked_sub(8)?,
    };
    let header = UdpHeader {
        source: SocketAddr::new(source, u16::from_be_bytes([source_a, source_b])),
        destination: SocketAddr::new(destination, u16::from_be_bytes([to_a, to_b])),
        missing: length.saturating_sub(rest.len()),
    };
    Some((header, rest.get(..length).unwrap_or(rest)))
}

fn array<const N: usize>(bytes: &[u8], at: usize) -> Option<[u8; N]> {
    bytes.get(at..)?.first_chunk().copied()
}

/// LINKTYPE numbers (draft-ietf-opsawg-pcaplinktype).
const NULL: u16 = 0;
const ETHERNET: u16 = 1;
const RAW_BSD: u16 = 12;
const RAW_OPENBSD: u16 = 14;
pub(crate) const RAW: u16 = 101;
const LOOP: u16 = 108;
const LINUX_SLL: u16 = 113;
const IPV4: u16 = 228;
const IPV6: u16 = 229;
const LINUX_SLL2: u16 = 276;
/// A PDU that names its dissector.
pub(crate) const EXPORTED: u16 = 252;

/// The tags of an exported PDU.
const END_OF_TAGS: u16 = 0;
const DISSECTOR: u16 = 12;
const UADP: &[u8] = b"uadp";

/// Protocol numbers of IP.
const HOP_BY_HOP: u8 = 0;
const UDP: u8 = 17;
const ROUTING: u8 = 43;
const FRAGMENT: u8 = 44;
const AUTHENTICATION: u8 = 51;
const DESTINATION: u8 = 60;
const MOBILITY: u8 = 135;

const MAX_VLAN_TAGS: usize = 4;
const MAX_EXTENSIONS: usize = 16;
const MAX_OPEN: usize = 256;
const MAX_HELD: usize = 4 << 20;
/// Bytes counted for a fragment in addition to its data.
const PIECE_COST: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    const V4: (&str, &str) = ("10.0.0.1:5000", "239.192.0.40:4840");
    const V6: (&str, &str) = ("[fe80::1]:5000", "[ff02::40]:4840");

    fn udp_bytes(payload: &[u8]) -> Vec<u8> {
        let length = u16::try_from(payload.len() + 8).unwrap().to_be_bytes();
        let mut bytes = [5000_u16, 4840].map(u16::to_be_bytes).concat();
        bytes.extend([length[0], length[1], 0, 0]);
        bytes.extend(payload);
        bytes
    }

    fn v4(fragment: u16, identification: u8, body: &[u8]) -> Vec<u8> {
        let total = u16::try_from(body.len() + 24).unwrap().to_be_bytes();
        let fragment = fragment.to_be_bytes();
        // Four bytes of options.
        let mut packet = vec![0x46, 0, total[0], total[1], 0, identification];
        packet.extend([fragment[0], fragment[1], 1, UDP, 0, 0]);
        packet.extend([10, 0, 0, 1, 239, 192, 0, 40, 1, 1, 1, 0]);
        packet.extend(body);
        packet
    }

    fn v6(next: u8, body: &[u8]) -> Vec<u8> {
        let length = u16::try_from(body.len()).unwrap().to_be_bytes();
        let mut packet = vec![0x60, 0, 0, 0, length[0], length[1], next, 64];
        packet.extend("fe80::1".parse::<Ipv6Addr>().unwrap().octets());
        packet.extend("ff02::40".parse::<Ipv6Addr>().unwrap().octets());
        packet.extend(body);
        packet
    }

    fn wanted<'a>(addresses: (&str, &str), payload: &'a [u8], missing: usize) -> PacketContent<'a> {
        PacketContent::Udp(UdpPacket {
            source: addresses.0.parse().unwrap(),
            destination: addresses.1.parse().unwrap(),
            payload: Cow::Borrowed(payload),
            missing,
        })
    }

    #[test]
    fn every_link_layer_leads_to_the_datagram() {
        let ip = v4(0, 1, &udp_bytes(b"payload"));
        let vlan = [0x88, 0xA8, 0, 1, 0x81, 0, 0, 2, 0x08, 0];
        for (link_type, head) in [
            (ETHERNET, [&[7; 12][..], &[0x08, 0]].concat()),
            (ETHERNET, [&[7; 12][..], &vlan].concat()),
            (RAW, vec![]),
            (RAW_BSD, vec![]),
            (IPV4, vec![]),
            (NULL, vec![2, 0, 0, 0]),
            (LOOP, vec![0, 0, 0, 2]),
            (LINUX_SLL, vec![0; 16]),
            (LINUX_SLL2, vec![0; 20]),
        ] {
            let frame = [head, ip.clone()].concat();
            let found = udp(link_type, &frame, &mut Fragments::default());
            assert_eq!(found, wanted(V4, b"payload", 0), "LINKTYPE {link_type}");
        }
        let found = udp(147, &ip, &mut Fragments::default());
        assert_eq!(found, PacketContent::UnknownLink);
    }

    #[test]
    fn padding_of_short_frames_is_no_payload() {
        let mut packet = v4(0, 1, &udp_bytes(b"x"));
        packet.extend([0; 20]);
        let found = udp(RAW, &packet, &mut Fragments::default());
        assert_eq!(found, wanted(V4, b"x", 0));
    }

    #[test]
    fn what_was_not_captured_is_counted() {
        let packet = v4(0, 1, &udp_bytes(b"payload"));
        let found = udp(RAW, &packet[..packet.len() - 3], &mut Fragments::default());
        assert_eq!(found, wanted(V4, b"payl", 3));
    }

    #[test]
    fn headers_of_ipv6_are_passed_over() {
        let body = [&[UDP, 1][..], &[0; 14], &udp_bytes(b"payload")].concat();
        let packet = v6(HOP_BY_HOP, &body);
        let found = udp(RAW, &packet, &mut Fragments::default());
        assert_eq!(found, wanted(V6, b"payload", 0));
        let packet = v6(UDP, &udp_bytes(b"payload"));
        let found = udp(RAW, &packet, &mut Fragments::default());
        assert_eq!(found, wanted(V6, b"payload", 0));
    }

    #[test]
    fn other_protocols_and_headers_that_are_cut_off_are_passed_over() {
        let packet = v4(0, 1, &udp_bytes(b"payload"));
        for end in 0..32 {
            let found = udp(RAW, &packet[..end], &mut Fragments::default());
            assert_eq!(found, PacketContent::Other, "{end} bytes");
        }
        let mut tcp = packet;
        tcp[9] = 6;
        assert_eq!(
            udp(RAW, &tcp, &mut Fragments::default()),
            PacketContent::Other
        );
    }

    #[test]
    fn fragments_make_the_datagram_in_any_order() {
        let payload: Vec<u8> = (0..100).collect();
        let bytes = udp_bytes(&payload);
        let pieces = [
            v4(0x2000, 9, &bytes[..48]),
            v4(0x2000 | 6, 9, &bytes[48..96]),
            v4(12, 9, &bytes[96..]),
        ];
        for order in [[0, 1, 2], [2, 1, 0], [1, 2, 0]] {
            let mut fragments = Fragments::default();
            for index in &order[..2] {
                assert_eq!(
                    udp(RAW, &pieces[*index], &mut fragments),
                    PacketContent::Fragment
                );
                // A fragment of another datagram is not mixed in.
                let other = v4(0x2000 | 6, 8, &[0xEE; 48]);
                assert_eq!(udp(RAW, &other, &mut fragments), PacketContent::Fragment);
            }
            let found = udp(RAW, &pieces[order[2]], &mut fragments);
            assert_eq!(found, wanted(V4, &payload, 0));
            assert_eq!(fragments.incomplete(), 1);
        }
        let piece = |offset: u16, body: &[u8]| {
            let [a, b] = offset.to_be_bytes();
            let head = [UDP, 0, a, b, 0, 0, 0, 7];
            v6(FRAGMENT, &[&head[..], body].concat())
        };
        let mut fragments = Fragments::default();
        let first = piece(1, &bytes[..64]);
        assert_eq!(udp(RAW, &first, &mut fragments), PacketContent::Fragment);
        let last = piece(64, &bytes[64..]);
        let found = udp(RAW, &last, &mut fragments);
        assert_eq!(found, wanted(V6, &payload, 0));
    }

    #[test]
    fn fragments_that_never_end_are_given_up() {
        let mut fragments = Fragments::default();
        for number in 0..=255 {
            for high in 0..4 {
                let mut piece = v4(0x2000, number, &[0; 1400]);
                piece[4] = high;
                assert_eq!(udp(RAW, &piece, &mut fragments), PacketContent::Fragment);
            }
        }
        assert_eq!(fragments.open.len(), MAX_OPEN);
        assert_eq!(fragments.incomplete(), 1024);
        for _ in 0..10_000 {
            let piece = v4(0x2000, 7, &[0; 1400]);
            assert_eq!(udp(RAW, &piece, &mut fragments), PacketContent::Fragment);
        }
        assert!(fragments.held <= MAX_HELD);
    }
}
