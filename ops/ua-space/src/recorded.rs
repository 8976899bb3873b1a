//! Reads the datagrams of a recording: a capture, or an MCAP file with values.

mod json;
mod mcap;
mod unusable;
mod values;

use std::collections::BTreeMap;
use std::io::Read;
use std::net::SocketAddr;
use std::path::Path;

use crate::capture::CaptureReader;
use crate::exit::CommandFailure;
use crate::input::{self, InputFile};
use crate::packet::{self, Fragments, PacketContent};

pub(crate) use self::unusable::UnusableValue;
use self::values::RecordedValues;

/// Reads the NetworkMessages of a recording.
pub(crate) struct RecordingReader {
    name: String,
    source: RecordedSource,
}

enum RecordedSource {
    Packets(Packets),
    Values(Box<RecordedValues<Box<dyn Read>>>),
}

/// The packets of a capture.
struct Packets {
    capture: CaptureReader<Box<dyn Read>>,
    fragments: Fragments,
    /// The time of the last message.
    time: i128,
}

/// A recorded datagram.
#[derive(Debug)]
pub(crate) struct RecordedDatagram {
    /// Nanoseconds since 1970.
    pub(crate) time: i128,
    pub(crate) from: SocketAddr,
    pub(crate) bytes: Vec<u8>,
}

impl RecordingReader {
    /// Opens a capture, or an MCAP file of `ua-space record`.
    ///
    /// # Errors
    /// A [`CommandFailure`] if the file cannot be read or is no recording.
    pub(crate) fn open(file: &Path) -> Result<Self, CommandFailure> {
        let name = file.display().to_string();
        let source = match input::open_recording(&name)? {
            Some(InputFile::Capture(capture)) => RecordedSource::Packets(Packets {
                capture,
                fragments: Fragments::default(),
                time: 0,
            }),
            Some(InputFile::Mcap(reader)) => {
                let values =
                    RecordedValues::new(reader).map_err(|error| input::failure(&name, error))?;
                RecordedSource::Values(Box::new(values))
            }
            Some(InputFile::Datagram(_) | InputFile::Lines(_)) | None => {
                return Err(CommandFailure::Data(format!(
                    "{name} is no pcapng, pcap or MCAP file; `ua-space record` makes one"
                )));
            }
        };
        Ok(Self { name, source })
    }

    /// Returns the next datagram: a UDP datagram that was captured as a whole, or a value of an
    /// MCAP file.
    pub(crate) fn next(&mut self) -> Result<Option<RecordedDatagram>, CommandFailure> {
        let next = match &mut self.source {
            RecordedSource::Packets(packets) => packets.next(),
            RecordedSource::Values(values) => values.next(),
        };
        next.map_err(|error| input::failure(&self.name, error))
    }

    /// Returns whether the recording has values only, without security.
    pub(crate) const fn has_only_values(&self) -> bool {
        matches!(self.source, RecordedSource::Values(_))
    }

    /// Returns the numbers of values so far that cannot be sent again, by reason.
    pub(crate) fn unusable(&self) -> BTreeMap<UnusableValue, u64> {
        match &self.source {
            RecordedSource::Packets(_) => BTreeMap::new(),
            RecordedSource::Values(values) => values.unusable().clone(),
        }
    }
}

impl Packets {
    fn next(&mut self) -> Result<Option<RecordedDatagram>, crate::capture::CaptureError> {
        while let Some(packet) = self.capture.next_packet()? {
            self.time = packet.time.unwrap_or(self.time);
            let found = packet::udp(packet.link_type, &packet.data, &mut self.fragments);
            if let PacketContent::Udp(udp) = found
                && udp.missing == 0
            {
                return Ok(Some(RecordedDatagram {
                    time: self.time,
                    from: udp.source,
                    bytes: udp.payload.into_owned(),
                }));
            }
        }
        Ok(None)
    }
}
