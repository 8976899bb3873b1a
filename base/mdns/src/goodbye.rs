//! Goodbyes without delay. mDNS keeps a withdrawn record for another second (RFC 6762, 10.1), in
//! case another host still has it. The name of a server is its own, so no other host has it, and a
//! second is half of the available time.

use std::net::{Ipv4Addr, SocketAddrV4};

use registry::label;
use socket2::{Domain, Protocol, Socket, Type};
use tokio::net::UdpSocket;

use crate::interface::MdnsInterface;

/// Opens a socket for the packets of the mDNS group on one interface.
pub fn listen(interface: &MdnsInterface) -> std::io::Result<UdpSocket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_reuse_address(true)?;
    socket.set_reuse_port(true)?;
    // Excludes the groups that other programs have joined on other interfaces.
    socket.set_multicast_all_v4(false)?;
    // Binds to the group only: unicast packets to this host are for the program that sent the
    // query.
    socket.bind(&GROUP.into())?;
    for address in interface.addresses() {
        socket.join_multicast_v4(GROUP.ip(), &address)?;
    }
    socket.set_nonblocking(true)?;
    UdpSocket::from_std(socket.into())
}

/// Returns the instances of the OPC UA service that a packet withdraws.
pub fn goodbyes(packet: &[u8]) -> Vec<String> {
    taken_back(packet).unwrap_or_default()
}

/// Returns the withdrawn instances, or `None` for a packet that ends too early.
fn taken_back(packet: &[u8]) -> Option<Vec<String>> {
    let number = |at: usize| Some(u16::from_be_bytes(packet.get(at..at + 2)?.try_into().ok()?));
    let is_response = packet.get(2)? & 0x80 != 0;
    if !is_response {
        return Some(Vec::new());
    }
    let (questions, answers) = (number(4)?, number(6)?);
    let mut at = HEADER;
    for _ in 0..questions {
        at = name(packet, at)?.1 + 4;
    }
    let mut found = Vec::new();
    for _ in 0..answers {
        let (owner, fixed) = name(packet, at)?;
        let kind = number(fixed)?;
        let lives = packet
            .get(fixed + 4..fixed + 8)?
            .iter()
            .any(|byte| *byte != 0);
        let data = fixed + 10;
        at = data + usize::from(number(fixed + 8)?);
        if kind == PTR && !lives && is_service(&owner) {
            let (target, _) = name(packet, data)?;
            found.extend(target.split_first().and_then(|(instance, service)| {
                let instance = std::str::from_utf8(instance).ok()?;
                let fits = is_service(service) && label(instance) == instance;
                fits.then(|| instance.to_owned())
            }));
        }
    }
    Some(found)
}

fn is_service(labels: &[&[u8]]) -> bool {
    let same = |(one, other): (&&[u8], &&[u8])| one.eq_ignore_ascii_case(other);
    labels.len() == SERVICE.len() && labels.iter().zip(&SERVICE).all(same)
}

/// Returns a name, which may contain a pointer (RFC 1035, 4.1.4), and the position after the name.
fn name(packet: &[u8], mut at: usize) -> Option<(Vec<&[u8]>, usize)> {
    let mut labels = Vec::new();
    let mut after = None;
    // Each turn reads a label or follows a pointer; no valid name has more.
    for _ in 0..MOST_LABELS {
        let length = usize::from(*packet.get(at)?);
        match length {
            0 => return Some((labels, after.unwrap_or(at + 1))),
            1..=63 => {
                labels.push(packet.get(at + 1..at + 1 + length)?);
                at += 1 + length;
            }
            0xC0.. => {
                after = after.or(Some(at + 2));
                at = (length & 0x3F) << 8 | usize::from(*packet.get(at + 1)?);
            }
            _ => return None,
        }
    }
    None
}

const GROUP: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(224, 0, 0, 251), 5353);
const HEADER: usize = 12;
const PTR: u16 = 12;
const MOST_LABELS: usize = 64;
const SERVICE: [&[u8]; 3] = [b"_opcua-tcp", b"_tcp", b"local"];

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a response with a PTR record. Its target points to its owner.
    fn packet(lifetime: u8) -> Vec<u8> {
        [
            &[0, 0, 0x84, 0, 0, 0, 0, 1, 0, 0, 0, 0][..],
            b"\x0a_opcua-tcp\x04_tcp\x05local\0",
            &[0, 12, 0, 1, 0, 0, 0, lifetime, 0, 6],
            b"\x03arm\xc0\x0c",
        ]
        .concat()
    }

    #[test]
    fn a_goodbye_is_heard_and_an_announcement_is_none() {
        assert_eq!(goodbyes(&packet(0)), ["arm"]);
        assert!(goodbyes(&packet(1)).is_empty());
    }

    #[test]
    fn no_packet_is_read_past_its_end_or_for_ever() {
        let whole = packet(0);
        for end in 0..whole.len() {
            assert!(goodbyes(&whole[..end]).is_empty(), "{end}");
            for byte in 0..=255 {
                let mut changed = whole.clone();
                changed[end] = byte;
                assert!(goodbyes(&changed).len() <= 1);
            }
        }
        // A name that points to itself.
        let mut around = whole;
        around.truncate(12);
        around.extend([0xC0, 12]);
        assert!(goodbyes(&around).is_empty());
    }
}
