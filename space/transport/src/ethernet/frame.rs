//! The bytes of Ethernet frames with a NetworkMessage (OPC 10000-14, 7.3.3).

use std::net::{Ipv6Addr, SocketAddr};

/// The EtherType of UADP.
pub(super) const ETHERTYPE: u16 = 0xB62C;

/// The tag of frames in a VLAN, or of frames with a priority (IEEE 802.1Q).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VlanTag {
    id: u16,
    priority: u8,
}

impl VlanTag {
    /// Returns the tag of a VLAN, 1 to 4094, with a priority (PCP), 0 to 7. The id 0 gives frames a
    /// priority outside of a VLAN. Returns `None` for other numbers.
    #[must_use]
    pub fn new(id: u16, priority: u8) -> Option<Self> {
        (id <= 4094 && priority <= 7).then_some(Self { id, priority })
    }

    /// Returns the VLAN; `None` if the tag has a priority only.
    #[must_use]
    pub fn vlan(self) -> Option<u16> {
        (self.id != 0).then_some(self.id)
    }

    /// Returns the priority.
    #[must_use]
    pub const fn priority(self) -> u8 {
        self.priority
    }
}

/// The header of the frames that a carrier sends.
#[derive(Debug, Clone, Copy)]
pub(super) struct FrameHeader {
    pub(super) destination: [u8; 6],
    pub(super) source: [u8; 6],
    pub(super) tag: Option<VlanTag>,
}

impl FrameHeader {
    pub(super) fn encode(self) -> Vec<u8> {
        let mut bytes = [self.destination, self.source].concat();
        if let Some(VlanTag { id, priority }) = self.tag {
            bytes.extend(TAGGED.to_be_bytes());
            bytes.extend((u16::from(priority) << 13 | id).to_be_bytes());
        }
        bytes.extend(ETHERTYPE.to_be_bytes());
        bytes
    }
}

/// A received frame. The kernel has removed its tag.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct EthernetFrame<'a> {
    pub(super) source: [u8; 6],
    /// The NetworkMessage. The smallest frames have up to 46 bytes, the last of which may be zeros
    /// of padding.
    pub(super) message: &'a [u8],
}

/// The reason why a frame is dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum FrameFault {
    /// The frame ends before the NetworkMessage.
    Short,
    /// The frame carries another protocol.
    OtherType,
    /// The frame is for another group or host.
    OtherAddress,
}

impl FrameFault {
    /// Returns the name of the counter.
    pub(super) const fn reason(self) -> &'static str {
        match self {
            Self::Short => "frame_short",
            Self::OtherType => "frame_other_type",
            Self::OtherAddress => "frame_other_address",
        }
    }
}

impl<'a> EthernetFrame<'a> {
    /// Decodes a frame for one of two addresses: the group, or the own address.
    pub(super) fn decode(bytes: &'a [u8], wanted: [[u8; 6]; 2]) -> Result<Self, FrameFault> {
        let short = FrameFault::Short;
        let (destination, rest) = bytes.split_first_chunk::<6>().ok_or(short)?;
        let (source, rest) = rest.split_first_chunk::<6>().ok_or(short)?;
        let (ethertype, message) = rest.split_first_chunk::<2>().ok_or(short)?;
        if u16::from_be_bytes(*ethertype) != ETHERTYPE {
            return Err(FrameFault::OtherType);
        }
        if !wanted.contains(destination) {
            return Err(FrameFault::OtherAddress);
        }
        match message {
            [] => Err(short),
            message => Ok(Self {
                source: *source,
                message,
            }),
        }
    }
}

/// Returns a MAC address as the address of a sender: the link-local IPv6 address that is formed
/// from it (RFC 4291, appendix A), with port 0.
pub(super) fn sender([a, b, c, d, e, f]: [u8; 6]) -> SocketAddr {
    let octets = [
        0xFE,
        0x80,
        0,
        0,
        0,
        0,
        0,
        0,
        a ^ 2,
        b,
        c,
        0xFF,
        0xFE,
        d,
        e,
        f,
    ];
    SocketAddr::from((Ipv6Addr::from(octets), 0))
}

/// The EtherType of a tag (IEEE 802.1Q).
const TAGGED: u16 = 0x8100;

#[cfg(test)]
mod tests {
    use super::*;

    const GROUP: [u8; 6] = [0x01, 0x00, 0x5E, 0x7F, 0x00, 0x01];
    const OWN: [u8; 6] = [0x02, 0, 0, 0, 0, 0x0A];
    const OTHER: [u8; 6] = [0x02, 0, 0, 0, 0, 0x0B];

    fn header(destination: [u8; 6], tag: Option<VlanTag>) -> Vec<u8> {
        let header = FrameHeader {
            destination,
            source: OTHER,
            tag,
        };
        header.encode()
    }

    #[test]
    fn a_frame_has_addresses_and_the_ethertype_before_the_message() {
        let bytes = header(GROUP, None);
        let expected = [&GROUP[..], &OTHER, &[0xB6, 0x2C]].concat();
        assert_eq!(bytes, expected);
    }

    #[test]
    fn a_tag_has_priority_and_vlan_and_stands_before_the_ethertype() {
        let tagged = |id, priority| header(GROUP, VlanTag::new(id, priority))[12..].to_vec();
        assert_eq!(tagged(5, 6), [0x81, 0x00, 0xC0, 0x05, 0xB6, 0x2C]);
        assert_eq!(tagged(4094, 7), [0x81, 0x00, 0xEF, 0xFE, 0xB6, 0x2C]);
        assert_eq!(tagged(0, 3), [0x81, 0x00, 0x60, 0x00, 0xB6, 0x2C]);
        assert_eq!(VlanTag::new(4095, 0), None);
        assert_eq!(VlanTag::new(1, 8), None);
        let vlans = [0, 5].map(|id| VlanTag::new(id, 1).unwrap().vlan());
        assert_eq!(vlans, [None, Some(5)]);
    }

    #[test]
    fn a_frame_for_the_group_or_the_host_is_received() {
        for to in [GROUP, OWN] {
            let bytes = [header(to, None), vec![1, 2, 3]].concat();
            let frame = EthernetFrame {
                source: OTHER,
                message: &[1, 2, 3],
            };
            assert_eq!(EthernetFrame::decode(&bytes, [GROUP, OWN]), Ok(frame));
        }
    }

    #[test]
    fn frames_of_others_and_cut_frames_are_faults() {
        let faulty = |bytes: &[u8]| EthernetFrame::decode(bytes, [GROUP, OWN]).err();
        let to_other = [header(OTHER, None), vec![1]].concat();
        assert_eq!(faulty(&to_other), Some(FrameFault::OtherAddress));
        let mut other_type = [header(GROUP, None), vec![1]].concat();
        other_type[13] = 0x2D;
        assert_eq!(faulty(&other_type), Some(FrameFault::OtherType));
        let tagged = [header(GROUP, VlanTag::new(5, 0)), vec![1]].concat();
        assert_eq!(faulty(&tagged), Some(FrameFault::OtherType));
        let whole = header(GROUP, None);
        for length in 0..=whole.len() {
            let fault = faulty(&whole[..length]);
            assert_eq!(fault, Some(FrameFault::Short), "{length} bytes");
        }
    }

    #[test]
    fn each_mac_address_is_another_sender() {
        let expected: SocketAddr = "[fe80::ff:fe00:b]:0".parse().unwrap();
        assert_eq!(sender(OTHER), expected);
        assert_ne!(sender(OWN), sender(OTHER));
    }
}
