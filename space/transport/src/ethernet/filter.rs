//! The kernel's filter for received frames.
//!
//! The kernel removes the tag of a frame before a socket gets it, so that only a filter can check
//! the VLAN.

use socket2::SockFilter;

use super::frame::ETHERTYPE;

/// Returns the filter for UADP of other hosts: frames of the VLAN, or frames outside of all VLANs.
///
/// Frames that this host sends are dropped, also those of other programs. The kernel marks a frame
/// of a VLAN that the host does not know as a frame for another host, where the filter is for
/// frames outside of all VLANs. A frame of a VLAN that the host knows arrives from the interface of
/// that VLAN, so that it does not have the index of the own interface.
pub(super) fn program(vlan: Option<u16>, index: u32) -> Vec<SockFilter> {
    let mut program = vec![
        SockFilter::new(LOAD_WORD, 0, 0, PACKET_TYPE),
        SockFilter::new(JUMP_IF_AT_LEAST, 0, 1, OTHER_HOST),
        drop_frame(),
        SockFilter::new(LOAD_HALF, 0, 0, ETHERTYPE_AT),
        SockFilter::new(JUMP_IF_EQUAL, 1, 0, u32::from(ETHERTYPE)),
        drop_frame(),
    ];
    if let Some(vlan) = vlan {
        program.extend([
            SockFilter::new(LOAD_WORD, 0, 0, TAG_PRESENT),
            SockFilter::new(JUMP_IF_EQUAL, 0, 1, 0),
            drop_frame(),
            SockFilter::new(LOAD_WORD, 0, 0, TAG),
            SockFilter::new(AND, 0, 0, VLAN_BITS),
            SockFilter::new(JUMP_IF_EQUAL, 1, 0, u32::from(vlan)),
            drop_frame(),
        ]);
    } else {
        program.extend([
            SockFilter::new(LOAD_WORD, 0, 0, INTERFACE),
            SockFilter::new(JUMP_IF_EQUAL, 1, 0, index),
            drop_frame(),
        ]);
    }
    program.push(SockFilter::new(RETURN, 0, 0, ACCEPT));
    program
}

/// Returns the instruction that drops a frame.
fn drop_frame() -> SockFilter {
    SockFilter::new(RETURN, 0, 0, 0)
}

// Instructions of classic BPF, see `Documentation/networking/filter.rst` of Linux.
const LOAD_HALF: u16 = 0x28;
const LOAD_WORD: u16 = 0x20;
const AND: u16 = 0x54;
const JUMP_IF_EQUAL: u16 = 0x15;
const JUMP_IF_AT_LEAST: u16 = 0x35;
const RETURN: u16 = 0x06;

/// Offset of the EtherType in a frame without a tag.
const ETHERTYPE_AT: u32 = 12;
// Offsets of what the kernel knows about a frame, from `SKF_AD_OFF`.
const PACKET_TYPE: u32 = 0xFFFF_F000 + 4;
const INTERFACE: u32 = 0xFFFF_F000 + 8;
const TAG: u32 = 0xFFFF_F000 + 44;
const TAG_PRESENT: u32 = 0xFFFF_F000 + 48;
/// The bits of the VLAN in a tag.
const VLAN_BITS: u32 = 0x0FFF;
/// Frames for this host, for all hosts and for groups have smaller packet types. Frames that this
/// host sends have a larger one.
const OTHER_HOST: u32 = 3;
/// The maximum number of bytes to accept.
const ACCEPT: u32 = u32::MAX;
