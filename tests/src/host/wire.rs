//! The wire between two hosts: frames enter at an end and leave at the other end, later or never.
//!
//! `tc netem` does the same on kernels that have it. This module needs only packet sockets, and
//! loses the same frames of a sequence each time.

use std::{
    collections::VecDeque,
    os::fd::{AsFd, AsRawFd, OwnedFd},
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};

use nix::{
    errno::Errno,
    ifaddrs::getifaddrs,
    poll::{PollFd, PollFlags, ppoll},
    sys::{
        socket::{
            AddressFamily, MsgFlags, SockFlag, SockProtocol, SockType, bind, recv, send,
            setsockopt, socket, sockopt,
        },
        time::TimeSpec,
    },
};

/// The effect of a wire on frames, in each direction.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct WireEffect {
    /// The share of lost frames, 0 to 1.
    pub loss: f64,
    /// The delay of a frame.
    pub delay: Duration,
}

/// Orders to a wire that carries frames.
#[derive(Debug, Default)]
pub(super) struct WireOrders {
    pub(super) end: AtomicBool,
    pub(super) cut: AtomicBool,
}

/// Interval in which a direction checks its orders.
const LOOK_UP: Duration = Duration::from_millis(50);
/// Buffer size of a packet socket, for bursts.
const ROOM: usize = 64 << 20;

impl WireEffect {
    /// Carries frames between two interfaces of this thread's network until the orders end it.
    pub(super) fn carry(self, ends: [&str; 2], orders: &WireOrders) {
        let sockets = ends.map(packet_socket);
        let mut directions = [
            Direction::new(self, 0x2545_f491),
            Direction::new(self, 0x9e37_79b9),
        ];
        let mut frame = vec![0; 65_536];
        while !orders.end.load(Ordering::Relaxed) {
            let due = directions.iter().filter_map(Direction::due).min();
            let wait = due.map_or(LOOK_UP, |due| {
                due.saturating_duration_since(Instant::now()).min(LOOK_UP)
            });
            let mut polled = sockets
                .each_ref()
                .map(|socket| PollFd::new(socket.as_fd(), PollFlags::POLLIN));
            ppoll(&mut polled, Some(TimeSpec::from_duration(wait)), None).unwrap();
            for (from, to) in [(0, 1), (1, 0)] {
                while let Some(length) = receive(&sockets[from], &mut frame) {
                    if orders.cut.load(Ordering::Relaxed) {
                        continue;
                    }
                    directions[from].take(&mut frame[..length]);
                }
                directions[from].deliver(&sockets[to]);
            }
        }
    }
}

struct Direction {
    wire: WireEffect,
    random: u64,
    under_way: VecDeque<(Instant, Vec<u8>)>,
}

impl Direction {
    fn new(wire: WireEffect, seed: u64) -> Self {
        Self {
            wire,
            random: seed,
            under_way: VecDeque::new(),
        }
    }

    fn due(&self) -> Option<Instant> {
        self.under_way.front().map(|(due, _)| *due)
    }

    fn take(&mut self, frame: &mut [u8]) {
        // xorshift64
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        let chance = (self.random >> 11) as f64 / (1_u64 << 53) as f64;
        if chance >= self.wire.loss {
            finish_checksum(frame);
            self.under_way
                .push_back((Instant::now() + self.wire.delay, frame.to_vec()));
        }
    }

    fn deliver(&mut self, socket: &OwnedFd) {
        let now = Instant::now();
        while self.due().is_some_and(|due| due <= now) {
            let Some((_, frame)) = self.under_way.pop_front() else {
                return;
            };
            match send(socket.as_raw_fd(), &frame, MsgFlags::empty()) {
                // The other host is leaving, or its queue is full: as on any wire, the frame is
                // lost.
                Ok(_) | Err(Errno::ENETDOWN | Errno::ENOBUFS | Errno::ENXIO) => {}
                Err(error) => panic!("a frame of {} bytes: {error}", frame.len()),
            }
        }
    }
}

/// Completes the checksum of a UDP datagram or TCP segment over IPv4. The sender's kernel leaves it
/// to the network card, which a pair of veth does not have. For UDP it is optional, and cleared.
fn finish_checksum(frame: &mut [u8]) {
    let is_ipv4 = frame.len() > ETHERNET + 20
        && frame[12..14] == [0x08, 0x00]
        // Only the first fragment has the header.
        && u16::from_be_bytes([frame[ETHERNET + 6], frame[ETHERNET + 7]]) & 0x1fff == 0;
    if !is_ipv4 {
        return;
    }
    let header = ETHERNET + usize::from(frame[ETHERNET] & 0x0f) * 4;
    match frame[ETHERNET + 9] {
        UDP => {
            if let Some(checksum) = frame.get_mut(header + 6..header + 8) {
                checksum.fill(0);
            }
        }
        TCP => {
            let total = usize::from(u16::from_be_bytes([
                frame[ETHERNET + 2],
                frame[ETHERNET + 3],
            ]));
            // A short frame has padding behind the packet.
            let end = (ETHERNET + total).min(frame.len());
            if header + 20 > end {
                return;
            }
            frame[header + 16..header + 18].fill(0);
            let length = u16::try_from(end - header).unwrap();
            let addresses = &frame[ETHERNET + 12..ETHERNET + 20];
            let sum = sum_of(addresses) + u32::from(TCP) + u32::from(length);
            let sum = sum + sum_of(&frame[header..end]);
            let folded = (sum & 0xffff) + (sum >> 16);
            let folded = (folded & 0xffff) + (folded >> 16);
            let checksum = !u16::try_from(folded).unwrap();
            frame[header + 16..header + 18].copy_from_slice(&checksum.to_be_bytes());
        }
        _ => {}
    }
}

/// Returns the sum of the 16-bit words (RFC 1071) of at most 64 KiB.
fn sum_of(bytes: &[u8]) -> u32 {
    let words = bytes.chunks(2).map(|word| {
        let low = word.get(1).copied().unwrap_or(0);
        u32::from(u16::from_be_bytes([word[0], low]))
    });
    words.sum()
}

/// Length of the header of a frame.
const ETHERNET: usize = 14;
/// Protocol numbers of IPv4.
const UDP: u8 = 17;
const TCP: u8 = 6;

/// Opens a socket that receives all frames of the interface and sends frames through it.
fn packet_socket(interface: &str) -> OwnedFd {
    let made = socket(
        AddressFamily::Packet,
        SockType::Raw,
        SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK,
        SockProtocol::EthAll,
    )
    .unwrap();
    setsockopt(&made, sockopt::RcvBufForce, &ROOM).unwrap();
    let address = getifaddrs()
        .unwrap()
        .filter(|found| found.interface_name == interface)
        .find_map(|found| found.address?.as_link_addr().copied())
        .unwrap_or_else(|| panic!("there is no interface {interface}"));
    bind(made.as_raw_fd(), &address).unwrap();
    made
}

fn receive(socket: &OwnedFd, frame: &mut [u8]) -> Option<usize> {
    match recv(socket.as_raw_fd(), frame, MsgFlags::empty()) {
        Ok(length) => Some(length),
        Err(Errno::EAGAIN | Errno::ENETDOWN) => None,
        Err(error) => panic!("the wire cannot be read: {error}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lossy_wire_loses_about_its_share_and_the_same_frames_each_time() {
        let wire = WireEffect {
            loss: 0.05,
            delay: Duration::ZERO,
        };
        let arrived = || {
            let mut direction = Direction::new(wire, 0x2545_f491);
            for number in 0..10_000_u32 {
                direction.take(&mut number.to_be_bytes().to_vec());
            }
            direction
                .under_way
                .into_iter()
                .map(|(_, frame)| frame)
                .collect::<Vec<_>>()
        };
        let first = arrived();
        assert!((9_300..9_700).contains(&first.len()), "{}", first.len());
        assert_eq!(first, arrived());
    }

    #[test]
    fn only_the_checksum_of_a_datagram_is_cleared() {
        let mut frame = vec![0xff; 60];
        frame[12..14].copy_from_slice(&[0x08, 0x00]);
        frame[14] = 0x45;
        frame[20..22].copy_from_slice(&[0x20, 0x00]);
        frame[23] = 17;
        let mut expected = frame.clone();
        expected[40..42].copy_from_slice(&[0, 0]);
        finish_checksum(&mut frame);
        assert_eq!(frame, expected);

        // A later fragment has data at this position.
        frame[20..22].copy_from_slice(&[0x20, 0xb9]);
        frame[40..42].copy_from_slice(&[7, 7]);
        let later = frame.clone();
        finish_checksum(&mut frame);
        assert_eq!(frame, later);
    }

    #[test]
    fn the_checksum_of_a_segment_is_that_of_the_standard() {
        // A segment of RFC 9293 without data, from 10.77.0.1:4840 to 10.77.0.2:50000.
        let mut frame = vec![0; ETHERNET];
        frame[12..14].copy_from_slice(&[0x08, 0x00]);
        let ip = [
            0x45, 0, 0, 40, 0, 0, 0x40, 0, 64, TCP, 0, 0, 10, 77, 0, 1, 10, 77, 0, 2,
        ];
        frame.extend(ip);
        let tcp = [
            0x12, 0xe8, 0xc3, 0x50, 0, 0, 0, 1, 0, 0, 0, 2, 0x50, 0x10, 1, 0, 0xde, 0xad, 0, 0,
        ];
        frame.extend(tcp);
        // Padding does not count.
        frame.extend([0xff; 6]);
        finish_checksum(&mut frame);
        let segment = &frame[ETHERNET + 20..ETHERNET + 40];
        let sum = sum_of(&ip[12..20]) + u32::from(TCP) + 20 + sum_of(segment);
        assert_eq!((sum & 0xffff) + (sum >> 16), 0xffff, "{segment:02x?}");
        assert_ne!(segment[16..18], [0xde, 0xad]);
    }
}
