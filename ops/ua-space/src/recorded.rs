//! Reads the datagrams of a recording.

use std::io::Read;
use std::net::SocketAddr;
use std::path::Path;

use crate::capture::Capture;
use crate::exit::Failure;
use crate::input::{self, Input};
use crate::packet::{self, Found, Fragments};

/// Reads the NetworkMessages of a recording.
pub(crate) struct Recorded {
    name: String,
    capture: Capture<Box<dyn Read>>,
    fragments: Fragments,
    /// The time of the last message.
    time: i128,
}

/// A recorded datagram.
pub(crate) struct Datagram {
    /// Nanoseconds since 1970.
    pub(crate) time: i128,
    pub(crate) from: SocketAddr,
    pub(crate) bytes: Vec<u8>,
}

impl Recorded {
    /// Opens a capture.
    ///
    /// # Errors
    /// A [`Failure`] if the file cannot be read or is no capture.
    pub(crate) fn open(file: &Path) -> Result<Self, Failure> {
        let name = file.display().to_string();
        match input::open(&name, false)? {
            Input::Capture(capture) => Ok(Self {
                name,
                capture,
                fragments: Fragments::default(),
                time: 0,
            }),
            Input::Datagram(_) | Input::Lines(_) => Err(Failure::Data(format!(
                "{name} is no pcapng or pcap file; `ua-space record` makes one"
            ))),
        }
    }

    /// Returns the next UDP datagram that was captured as a whole.
    pub(crate) fn next(&mut self) -> Result<Option<Datagram>, Failure> {
        loop {
            let packet = self.capture.next_packet();
            let packet = packet.map_err(|error| input::failure(&self.name, error))?;
            let Some(packet) = packet else {
                return Ok(None);
            };
            self.time = packet.time.unwrap_or(self.time);
            let found = packet::udp(packet.link_type, &packet.data, &mut self.fragments);
            if let Found::Udp(udp) = found
                && udp.missing == 0
            {
                return Ok(Some(Datagram {
                    time: self.time,
                    from: udp.source,
                    bytes: udp.payload.into_owned(),
                }));
            }
        }
    }
}
