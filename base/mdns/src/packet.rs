//! Reads mDNS packets without copying them (RFC 1035, 4.1). Any host on the network can send them.
//!
//! A packet that ends too early, or with an invalid name, has no further records.

use std::net::Ipv4Addr;

/// An mDNS packet with a complete header.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DnsPacket<'p>(&'p [u8]);

impl<'p> DnsPacket<'p> {
    /// Returns `None` if the header is not complete.
    pub(crate) fn new(bytes: &'p [u8]) -> Option<Self> {
        (bytes.len() >= HEADER).then_some(Self(bytes))
    }

    /// Returns whether the packet is a response; otherwise it is a query.
    pub(crate) fn is_response(self) -> bool {
        self.0.get(2).is_some_and(|flags| flags & 0x80 != 0)
    }

    /// Returns the names of the questions.
    pub(crate) fn questions(self) -> impl Iterator<Item = DnsName<'p>> {
        let mut left = self.number(QUESTIONS).unwrap_or_default();
        let mut at = HEADER;
        std::iter::from_fn(move || {
            left = left.checked_sub(1)?;
            let name = self.name(at);
            at = name.end()?.checked_add(4)?;
            Some(name)
        })
    }

    /// Returns the records of all sections.
    pub(crate) fn records(self) -> impl Iterator<Item = DnsRecord<'p>> {
        let count = |at| self.number(at).map_or(0, u32::from);
        let mut at = self.after_questions();
        let mut left = count(QUESTIONS + 2) + count(QUESTIONS + 4) + count(QUESTIONS + 6);
        std::iter::from_fn(move || {
            left = left.checked_sub(1)?;
            let record = self.record(at?);
            at = record.map(|record| record.data + record.length);
            record
        })
    }

    fn after_questions(self) -> Option<usize> {
        (0..self.number(QUESTIONS)?).try_fold(HEADER, |at, _| self.name(at).end()?.checked_add(4))
    }

    fn record(self, at: usize) -> Option<DnsRecord<'p>> {
        let owner = self.name(at);
        let fixed = owner.end()?;
        let lifetime = self.0.get(fixed + 4..fixed + 8)?;
        let (data, length) = (fixed + 10, usize::from(self.number(fixed + 8)?));
        self.0.get(data..data + length)?;
        Some(DnsRecord {
            packet: self,
            owner,
            kind: self.number(fixed)?,
            is_withdrawn: lifetime.iter().all(|byte| *byte == 0),
            data,
            length,
        })
    }

    fn name(self, at: usize) -> DnsName<'p> {
        DnsName {
            packet: self,
            at,
            turns: MOST_TURNS,
        }
    }

    fn number(self, at: usize) -> Option<u16> {
        let bytes = self.0.get(at..at.checked_add(2)?)?;
        Some(u16::from_be_bytes(bytes.try_into().ok()?))
    }
}

/// Returns a query for the SRV records of a name, to be answered to the group. `None` if a label is
/// too long.
pub(crate) fn server_query(labels: &[&[u8]]) -> Option<Vec<u8>> {
    // One question.
    let mut bytes = vec![0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0];
    for label in labels {
        let length = u8::try_from(label.len()).ok();
        bytes.push(length.filter(|length| (1..=63).contains(length))?);
        bytes.extend_from_slice(label);
    }
    bytes.push(0);
    bytes.extend(SRV.to_be_bytes());
    bytes.extend(INTERNET.to_be_bytes());
    Some(bytes)
}

/// A record of a packet.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DnsRecord<'p> {
    packet: DnsPacket<'p>,
    /// The name of the record.
    pub(crate) owner: DnsName<'p>,
    kind: u16,
    /// Whether the record is withdrawn: its lifetime is 0 (RFC 6762, 10.1).
    pub(crate) is_withdrawn: bool,
    data: usize,
    length: usize,
}

impl<'p> DnsRecord<'p> {
    /// Returns the target of a PTR record; `None` for records of other types.
    pub(crate) fn pointer(&self) -> Option<DnsName<'p>> {
        (self.kind == PTR).then(|| self.packet.name(self.data))
    }

    /// Returns the port and the host name of an SRV record; `None` for records of other types.
    pub(crate) fn server(&self) -> Option<(u16, DnsName<'p>)> {
        if self.kind != SRV || self.length <= SRV_FIXED {
            return None;
        }
        let port = self.packet.number(self.data + SRV_FIXED - 2)?;
        Some((port, self.packet.name(self.data + SRV_FIXED)))
    }

    /// Returns the address of an A record; `None` for records of other types.
    pub(crate) fn address(&self) -> Option<Ipv4Addr> {
        let data: [u8; 4] = self.data()?.try_into().ok()?;
        (self.kind == A).then(|| Ipv4Addr::from(data))
    }

    /// Returns the first value of a key in a TXT record (RFC 6763, 6.4); `None` for records of
    /// other types.
    pub(crate) fn text(&self, key: &str) -> Option<&'p [u8]> {
        if self.kind != TXT {
            return None;
        }
        let mut rest = self.data()?;
        while let Some((length, more)) = rest.split_first() {
            let (text, after) = more.split_at_checked(usize::from(*length))?;
            rest = after;
            let Some(name) = text.get(..key.len()) else {
                continue;
            };
            if name.eq_ignore_ascii_case(key.as_bytes())
                && let Some((b'=', value)) = text.get(key.len()..)?.split_first()
            {
                return Some(value);
            }
        }
        None
    }

    /// Returns whether this is a TXT record.
    pub(crate) fn is_text(&self) -> bool {
        self.kind == TXT
    }

    fn data(&self) -> Option<&'p [u8]> {
        self.packet.0.get(self.data..self.data + self.length)
    }
}

/// A name of a packet, which may continue at another place of the packet.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DnsName<'p> {
    packet: DnsPacket<'p>,
    at: usize,
    /// The number of labels and pointers that may still follow. No valid name has more.
    turns: usize,
}

impl<'p> DnsName<'p> {
    /// Returns the first label and the rest of the name, `Some(None)` at its end, and `None` if the
    /// name is invalid.
    pub(crate) fn split_first(mut self) -> Option<Option<(&'p [u8], Self)>> {
        let bytes = self.packet.0;
        loop {
            self.turns = self.turns.checked_sub(1)?;
            let length = usize::from(*bytes.get(self.at)?);
            match length {
                0 => return Some(None),
                1..=63 => {
                    let label = bytes.get(self.at + 1..self.at + 1 + length)?;
                    self.at += 1 + length;
                    return Some(Some((label, self)));
                }
                0xC0.. => {
                    self.at = (length & 0x3F) << 8 | usize::from(*bytes.get(self.at + 1)?);
                }
                _ => return None,
            }
        }
    }

    /// Returns whether the name has these labels, in any case.
    pub(crate) fn is(self, labels: &[&[u8]]) -> bool {
        let mut rest = self;
        for label in labels {
            match rest.split_first() {
                Some(Some((first, more))) if first.eq_ignore_ascii_case(label) => rest = more,
                Some(_) | None => return false,
            }
        }
        rest.split_first() == Some(None)
    }

    /// Returns whether two names are the same, in any case.
    pub(crate) fn is_same(self, other: Self) -> bool {
        let (mut one, mut other) = (self, other);
        loop {
            match (one.split_first(), other.split_first()) {
                (Some(None), Some(None)) => return true,
                (Some(Some((label, more))), Some(Some((its, rest))))
                    if label.eq_ignore_ascii_case(its) =>
                {
                    (one, other) = (more, rest);
                }
                (Some(_) | None, _) => return false,
            }
        }
    }

    /// Returns the name as text, with a dot behind each label; `None` for names that are not UTF-8.
    pub(crate) fn text(self) -> Option<String> {
        let mut text = String::new();
        let mut rest = self;
        while let Some((label, more)) = rest.split_first()? {
            text.push_str(std::str::from_utf8(label).ok()?);
            text.push('.');
            rest = more;
        }
        Some(text)
    }

    /// Returns the offset behind the name, without following its pointers.
    fn end(self) -> Option<usize> {
        let mut at = self.at;
        for _ in 0..self.turns {
            let length = usize::from(*self.packet.0.get(at)?);
            match length {
                0 => return Some(at + 1),
                1..=63 => at += 1 + length,
                0xC0.. => return Some(at + 2),
                _ => return None,
            }
        }
        None
    }
}

impl PartialEq for DnsName<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.is_same(*other)
    }
}

const HEADER: usize = 12;
/// The offset of the number of questions; the numbers of records follow.
const QUESTIONS: usize = 4;
const MOST_TURNS: usize = 64;
/// The priority, the weight and the port of an SRV record.
const SRV_FIXED: usize = 6;
const A: u16 = 1;
const PTR: u16 = 12;
const TXT: u16 = 16;
const SRV: u16 = 33;
/// The class of all records of mDNS.
const INTERNET: u16 = 1;

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a response with a PTR, an SRV, a TXT and an A record of a server.
    fn packet() -> Vec<u8> {
        [
            &[0, 0, 0x84, 0, 0, 0, 0, 1, 0, 0, 0, 3][..],
            b"\x0a_opcua-tcp\x04_tcp\x05local\0",
            &[0, 12, 0, 1, 0, 0, 0, 120, 0, 6],
            b"\x03arm\xc0\x0c",
            // The instance is at offset 45: behind the header, the service and the fixed part.
            &[0xC0, 45, 0, 33, 0x80, 1, 0, 0, 0, 120, 0, 13],
            &[0, 0, 0, 0, 0x12, 0xE9],
            b"\x04host\xc0\x1c",
            &[0xC0, 45, 0, 16, 0x80, 1, 0, 0, 0, 120, 0, 16],
            b"\x09path=/arm\x05ns=17",
            b"\x04host\xc0\x1c",
            &[0, 1, 0x80, 1, 0, 0, 0, 120, 0, 4, 10, 0, 0, 7],
        ]
        .concat()
    }

    #[test]
    fn the_records_of_a_server_are_read() {
        let bytes = packet();
        let packet = DnsPacket::new(&bytes).unwrap();
        assert!(packet.is_response());
        let [pointer, server, text, address] = packet.records().collect::<Vec<_>>()[..] else {
            panic!("{bytes:?}");
        };
        let instance = pointer.pointer().unwrap();
        assert_eq!(
            instance.text().as_deref(),
            Some("arm._opcua-tcp._tcp.local.")
        );
        assert!(instance.is(&[b"ARM", b"_opcua-tcp", b"_tcp", b"local"]));
        assert!(!instance.is(&[b"arm", b"_opcua-tcp", b"_tcp"]));
        assert!(server.owner.is_same(instance) && text.owner.is_same(instance));
        let (port, host) = server.server().unwrap();
        assert_eq!((port, host.text().as_deref()), (4841, Some("host.local.")));
        assert!(address.owner.is_same(host));
        assert_eq!(address.address(), Some(Ipv4Addr::new(10, 0, 0, 7)));
        assert_eq!(text.text("PATH"), Some(&b"/arm"[..]));
        assert_eq!(text.text("ns"), Some(&b"17"[..]));
        assert_eq!(text.text("n"), None);
        assert_eq!(address.text("ns"), None, "an address has no texts");
    }

    #[test]
    fn a_query_asks_for_a_name() {
        let name: [&[u8]; 2] = [b"arm (2)", b"local"];
        let bytes = server_query(&name).unwrap();
        let packet = DnsPacket::new(&bytes).unwrap();
        assert!(!packet.is_response());
        let [asked] = packet.questions().collect::<Vec<_>>()[..] else {
            panic!("{bytes:?}");
        };
        assert!(asked.is(&name));
        assert_eq!(bytes.get(bytes.len() - 4..), Some(&[0, 33, 0, 1][..]));
        assert_eq!(server_query(&[&[b'a'; 64]]), None);
    }

    #[test]
    fn no_packet_is_read_past_its_end_or_for_ever() {
        let whole = packet();
        for end in 0..whole.len() {
            let read =
                |bytes: &[u8]| DnsPacket::new(bytes).map_or(0, |packet| packet.records().count());
            assert!(read(whole.get(..end).unwrap()) < 4, "{end}");
            for byte in 0..=255 {
                let mut changed = whole.clone();
                changed[end] = byte;
                let packet = DnsPacket::new(&changed).unwrap();
                let names = packet.records().filter_map(|record| record.owner.text());
                assert!(names.count() <= changed.len());
                let asked = packet.questions().filter_map(DnsName::text);
                assert!(asked.count() < changed.len());
            }
        }
    }
}
