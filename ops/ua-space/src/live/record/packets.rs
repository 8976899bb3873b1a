//! Recordings of all messages as pcapng.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};

use super::sink::RecordingFile;
use crate::capture::{LinkLayer, PcapNg};
use crate::exit::CommandFailure;

/// A recording of the messages as they were received.
#[derive(Debug)]
pub(super) struct Packets {
    sink: RecordingFile,
    writer: PcapNg,
    /// Whole blocks that are not handed over to the disk.
    part: Vec<u8>,
}

impl Packets {
    pub(super) fn new(sink: RecordingFile, link: LinkLayer, interface: &str) -> Self {
        let mut part = Vec::new();
        let writer = PcapNg::begin(link, interface, &mut part);
        Self { sink, writer, part }
    }

    /// Adds a message. Returns false if the message is dropped because the disk is too slow.
    pub(super) fn add(
        &mut self,
        time: i128,
        from: SocketAddr,
        message: &[u8],
    ) -> Result<bool, CommandFailure> {
        if self.part.len() >= PART && !self.sink.offer(&mut self.part)? {
            return Ok(false);
        }
        let from = match from {
            SocketAddr::V4(from) => from,
            SocketAddr::V6(_) => SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0),
        };
        self.writer.packet(time, from, message, &mut self.part);
        Ok(true)
    }

    /// Hands over the messages so far.
    pub(super) fn flush(&mut self) -> Result<(), CommandFailure> {
        // If the disk is too slow, the part is offered again.
        self.sink.offer(&mut self.part).map(|_| ())
    }

    /// Ends the file with the numbers of received and dropped messages. Returns its length.
    pub(super) fn finish(
        mut self,
        time: i128,
        (received, dropped): (u64, u64),
    ) -> Result<u64, CommandFailure> {
        PcapNg::end(time, received, dropped, &mut self.part);
        self.sink.finish(self.part)
    }
}

/// The size in bytes at which a part is handed over. The parts that wait take at most some
/// megabytes.
const PART: usize = 64 << 10;
