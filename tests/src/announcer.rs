//! A DDS participant that only announces itself and records the ACKNACKs sent to it, so that tests
//! see which peers drop it.

use std::net::UdpSocket;
use std::time::{Duration, Instant};

/// A participant of domain 2 on this host with a lease of one second.
pub struct LeasedParticipant {
    socket: UdpSocket,
}

impl LeasedParticipant {
    /// Opens the participant's socket.
    ///
    /// # Panics
    /// Panics if the socket cannot be opened.
    #[must_use]
    pub fn open() -> Self {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.set_read_timeout(Some(POLL)).unwrap();
        Self { socket }
    }

    /// Announces itself to the first participant of domain 2 on this host (RTPS 2.5, 8.5.3).
    ///
    /// # Panics
    /// Panics if the announcement cannot be sent.
    pub fn announce(&self) {
        let port = u32::from(self.socket.local_addr().unwrap().port());
        let locator = [
            &1_u32.to_le_bytes()[..],
            &port.to_le_bytes(),
            &[0; 12],
            &[127, 0, 0, 1],
        ]
        .concat();
        let guid = [&PREFIX[..], &[0, 0, 1, 0xc1]].concat();
        let parameters: [(u16, &[u8]); 7] = [
            (0x15, &[2, 3, 0, 0]),
            (0x16, &[1, 15, 0, 0]),
            (0x50, &guid),
            (0x32, &locator),
            (0x31, &locator),
            // The lease duration: seconds and a fraction.
            (0x02, &[1, 0, 0, 0, 0, 0, 0, 0]),
            // The available builtin endpoints: readers and writers of announcements.
            (0x58, &[0x3f, 0, 0, 0]),
        ];
        let mut payload = vec![0, 3, 0, 0];
        for (id, value) in parameters {
            payload.extend(id.to_le_bytes());
            payload.extend(u16::try_from(value.len()).unwrap().to_le_bytes());
            payload.extend(value);
        }
        payload.extend([1, 0, 0, 0]);
        let data = [
            &[0, 0, 16, 0, 0, 0, 0, 0, 0, 1, 0, 0xc2][..],
            &[0, 0, 0, 0, 1, 0, 0, 0],
            &payload,
        ]
        .concat();
        let length = u16::try_from(data.len()).unwrap().to_le_bytes();
        let header = [b"RTPS\x02\x03\x01\x0f", &PREFIX[..]].concat();
        let datagram = [&header[..], &[0x15, 5], &length, &data].concat();
        self.socket.send_to(&datagram, FIRST_OF_DOMAIN_2).unwrap();
    }

    /// Returns the counts of the ACKNACKs sent to this participant's writers, in their order, until
    /// `enough` accepts them or `time` is over.
    ///
    /// # Panics
    /// Panics if the socket fails.
    pub fn asked(&self, time: Duration, mut enough: impl FnMut(&[i32]) -> bool) -> Vec<i32> {
        let start = Instant::now();
        let (mut counts, mut datagram) = (Vec::new(), [0; 2048]);
        while !enough(&counts) && start.elapsed() < time {
            let Ok(length) = self.socket.recv(&mut datagram) else {
                continue;
            };
            counts.extend(acknacks(&datagram[..length]));
        }
        counts
    }
}

/// Returns the counts of the ACKNACKs for the writer of publications (RTPS 2.5, 9.4.5.3).
fn acknacks(datagram: &[u8]) -> Vec<i32> {
    const ACKNACK: u8 = 0x06;
    const PUBLICATIONS_WRITER: &[u8] = &[0, 0, 3, 0xc2];
    let mut counts = Vec::new();
    let mut rest = datagram.get(20..).unwrap_or_default();
    while let [id, _flags, low, high, body @ ..] = rest {
        let length = usize::from(u16::from_le_bytes([*low, *high]));
        let (body, behind) = body.split_at_checked(length).unwrap_or((body, &[]));
        if *id == ACKNACK && body.get(4..8) == Some(PUBLICATIONS_WRITER) {
            let count = body.last_chunk().copied();
            counts.extend(count.map(i32::from_le_bytes));
        }
        rest = behind;
    }
    counts
}

const PREFIX: &[u8; 12] = b"\x01\x0fannouncer.";
/// The unicast address at which the first participant on a host receives announcements (RTPS 2.5,
/// 9.6.2.3).
const FIRST_OF_DOMAIN_2: &str = "127.0.0.1:7910";
const POLL: Duration = Duration::from_millis(20);
