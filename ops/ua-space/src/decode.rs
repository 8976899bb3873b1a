//! Decodes a datagram to its JSON.

use std::time::Duration;

use serde_json::json;
use uadp::discovery::{Announcement, Probe};
use uadp::{
    ChunkRefusal, DateTime, DecodeError, Extras, NetworkMessage, NetworkMessageEncoder,
    NetworkMessageType, PublisherId, Reassembled, Reassembler, ReassemblyLimits, SecurityHeader,
    TokenKeys,
};

use crate::arguments::RawReading;
use crate::fault::{DecodeFault, FaultLocation, offset};
use crate::keys::{self, KeyFile};
use crate::metadata::{MetaDataFile, WriterKey};
use crate::raw_data::RawDataLayout;
use crate::values::show_variant;
use crate::{actions, discovery, hex, iso_time, messages, shape};

/// The keys and metadata that decoding needs besides the datagrams.
#[derive(Debug)]
pub(crate) struct DecodeContext {
    pub(crate) keys: Option<KeyFile>,
    pub(crate) metadata: MetaDataFile,
    pub(crate) raw_reading: RawReading,
}

/// Reassembles chunks in the order of a file.
#[derive(Debug)]
pub(crate) struct ChunkReassembler {
    reassembler: Reassembler,
    now: Duration,
    start: Option<i128>,
}

/// The decoded contents of a datagram.
#[derive(Debug, Default)]
pub(crate) struct DecodedDatagram {
    pub(crate) shape: shape::DatagramJson,
    pub(crate) faults: Vec<DecodeFault>,
    /// The reason why the message was not decrypted although keys were given.
    pub(crate) refused: Option<String>,
    /// The message that this chunk completes.
    pub(crate) whole: Option<Box<Self>>,
    /// Further notes for the user.
    pub(crate) notes: Vec<String>,
    /// The bytes to which the offsets of the faults refer: the datagram, decrypted where possible.
    pub(crate) bytes: Vec<u8>,
}

impl DecodeContext {
    /// Reads a datagram to its end, or to the first fault of each of its parts. With `chunks`, the
    /// reading of a chunk that completes a message includes that message.
    pub(crate) fn read(
        &self,
        datagram: &[u8],
        chunks: Option<&mut ChunkReassembler>,
    ) -> DecodedDatagram {
        let mut reading = DecodedDatagram {
            bytes: datagram.to_vec(),
            ..DecodedDatagram::default()
        };
        let message = match NetworkMessage::decode(datagram) {
            Ok(message) => message,
            Err(error) => {
                reading.unreadable(datagram, error);
                return reading;
            }
        };
        match &self.keys {
            Some(keys) if message.is_sealed() => self.open(&message, keys, &mut reading, chunks),
            _ => self.show(&message, &mut reading, chunks),
        }
        reading
    }

    /// Shows a sealed message decrypted, or only its headers if it cannot be decrypted.
    fn open(
        &self,
        sealed: &NetworkMessage<'_>,
        keys: &KeyFile,
        reading: &mut DecodedDatagram,
        chunks: Option<&mut ChunkReassembler>,
    ) {
        let found = match keys.find(sealed) {
            Ok(found) => found,
            Err(why) => {
                self.show(sealed, reading, None);
                reading.refused = Some(why.to_string());
                return;
            }
        };
        // If several key sets share the signing key, the right set decrypts to a readable message.
        let reads = |keys: &&TokenKeys| {
            let mut tried = DecodedDatagram {
                bytes: sealed.datagram().to_vec(),
                ..DecodedDatagram::default()
            };
            self.show_opened(sealed, keys, &mut tried, None);
            tried.faults.is_empty()
        };
        let right = match found.as_slice() {
            [only] => Some(*only),
            several => several.iter().copied().find(reads),
        };
        if let Some(keys) = right.or_else(|| found.first().copied()) {
            self.show_opened(sealed, keys, reading, chunks);
        }
    }

    fn show_opened(
        &self,
        sealed: &NetworkMessage<'_>,
        keys: &TokenKeys,
        reading: &mut DecodedDatagram,
        chunks: Option<&mut ChunkReassembler>,
    ) {
        let mut scratch = Vec::new();
        match keys::open(keys, sealed, &mut scratch) {
            Ok(message) => {
                reading.bytes.truncate(sealed.payload_offset());
                reading.bytes.extend_from_slice(message.payload());
                reading.bytes.extend_from_slice(message.footer());
                self.show(&message, reading, chunks);
            }
            Err(why) => reading.refused = Some(why.to_string()),
        }
    }

    fn show(
        &self,
        message: &NetworkMessage<'_>,
        reading: &mut DecodedDatagram,
        chunks: Option<&mut ChunkReassembler>,
    ) {
        reading.headers(message);
        if message.is_sealed() {
            reading.shape.sealed = Some(shape::Sealed {
                hex: hex::text(message.payload()),
                chunk: message.is_chunk(),
                action: message.is_action(),
            });
        } else if message.is_chunk() {
            reading.chunk(message);
            if let Some(chunks) = chunks.filter(|_| reading.faults.is_empty()) {
                self.put_together(message, reading, chunks);
            }
        } else if message.is_action() {
            let shown = actions::read(message);
            reading.shape.action_header = shown.header;
            reading.shape.data_set_messages = Some(shown.messages);
            reading.faults.extend(shown.fault);
        } else {
            match message.message_type() {
                NetworkMessageType::DataSet => self.messages(message, reading),
                message_type @ (NetworkMessageType::Probe | NetworkMessageType::Announcement) => {
                    reading.discovery(message_type, message.payload(), message.payload_offset());
                }
            }
        }
        reading.shape.malformed = reading.faults.first().map(DecodeFault::to_string);
    }

    fn messages(&self, message: &NetworkMessage<'_>, reading: &mut DecodedDatagram) {
        let (parts, stop) = messages::split(message);
        self.parts(&parts, reading);
        reading.faults.extend(stop);
    }

    fn parts(&self, parts: &[messages::PayloadMessage<'_>], reading: &mut DecodedDatagram) {
        let mut shown = Vec::new();
        for part in parts {
            let layout = self.layout(&reading.shape, part.writer_id);
            let (message, fault) = messages::read(part, layout.as_ref());
            shown.push(message);
            reading.faults.extend(fault);
        }
        reading.shape.data_set_messages = Some(shown);
    }

    fn put_together(
        &self,
        message: &NetworkMessage<'_>,
        reading: &mut DecodedDatagram,
        chunks: &mut ChunkReassembler,
    ) {
        match chunks.reassembler.receive(message, chunks.now) {
            Ok(Some(whole)) => reading.whole = Some(Box::new(self.read_whole(message, &whole))),
            // A network may deliver a chunk twice.
            Ok(None) | Err(ChunkRefusal::Duplicate) => {}
            Err(refusal) => reading.notes.push(format!("not put together: {refusal}")),
        }
    }

    /// Reads the reassembled bytes of chunks: one DataSetMessage, or the body of a discovery
    /// message after its headers.
    fn read_whole(&self, last: &NetworkMessage<'_>, whole: &Reassembled<'_>) -> DecodedDatagram {
        let mut reading = DecodedDatagram {
            bytes: whole.bytes.to_vec(),
            ..DecodedDatagram::default()
        };
        reading.headers(last);
        match whole.message_type {
            NetworkMessageType::DataSet => {
                let part = messages::PayloadMessage {
                    writer_id: whole.writer_id,
                    offset: 0,
                    bytes: whole.bytes,
                };
                self.parts(&[part], &mut reading);
            }
            message_type @ (NetworkMessageType::Probe | NetworkMessageType::Announcement) => {
                reading.discovery(message_type, whole.bytes, 0);
            }
        }
        if whole.writer_id.is_none() && !reading.faults.is_empty() {
            // UA-.NETStandard splits the NetworkMessage and omits the payload header.
            let other = self.read(whole.bytes, None);
            if other.faults.is_empty() {
                reading = other;
            }
        }
        reading.shape.reassembled = Some(json!({
            "messageSequenceNumber": whole.message_sequence_number,
            "totalSize": whole.bytes.len(),
        }));
        reading.shape.malformed = reading.faults.first().map(DecodeFault::to_string);
        reading
    }

    /// Returns the layout of the RawData of a DataSetWriter, if metadata for it is available.
    pub(crate) fn layout(
        &self,
        datagram: &shape::DatagramJson,
        data_set_writer_id: Option<u16>,
    ) -> Option<RawDataLayout<'_>> {
        let group = datagram.group_header.as_ref();
        let metadata = self.metadata.find(WriterKey {
            publisher_id: datagram.publisher_id.as_ref(),
            writer_group_id: group.and_then(|group| group.writer_group_id),
            data_set_writer_id,
        })?;
        // Invalid layouts were rejected when the metadata file was read.
        RawDataLayout::new(metadata, self.raw_reading).ok()
    }
}

impl ChunkReassembler {
    /// Creates the reassembly buffer. Chunks belong together if they are at most a minute apart,
    /// because the recorded sender may have been slow.
    pub(crate) fn new() -> Self {
        Self {
            reassembler: Reassembler::new(ReassemblyLimits {
                age: Duration::from_secs(60),
                ..ReassemblyLimits::default()
            }),
            now: Duration::ZERO,
            start: None,
        }
    }

    /// Advances the clock to the capture time of the next datagram, in nanoseconds since any epoch.
    /// The clock never moves back.
    pub(crate) fn at(&mut self, time: i128) {
        let since = time - *self.start.get_or_insert(time);
        let since = u64::try_from(since).unwrap_or_default();
        self.now = self.now.max(Duration::from_nanos(since));
    }

    /// Returns true if chunks were not reassembled because other chunks are missing.
    pub(crate) fn is_any_incomplete(&self) -> bool {
        let counters = self.reassembler.counters();
        self.reassembler.poll_timeout().is_some()
            || counters.expired + counters.out_of_bytes + counters.out_of_places != 0
            || counters.superseded + counters.contradicted != 0
    }
}

impl DecodedDatagram {
    /// Returns false for datagrams that other protocols may send by chance: datagrams with a fault,
    /// without PublisherId and GroupHeader, or sealed in a way that no SecurityPolicy defines.
    pub(crate) fn is_plausible(&self) -> bool {
        let shape = &self.shape;
        let names_its_sender = shape.publisher_id.is_some() || shape.group_header.is_some();
        let sealed = shape.sealed.as_ref().zip(shape.security_header.as_ref());
        let is_secured = sealed.is_none_or(|(sealed, header)| {
            header.security_token_id != 0 && header.nonce.len() == 16 && sealed.hex.len() >= 64
        });
        self.faults.is_empty() && self.refused.is_none() && names_its_sender && is_secured
    }

    fn unreadable(&mut self, datagram: &[u8], error: DecodeError) {
        let stop = |bytes: &[u8]| Some((None, NetworkMessage::decode(bytes).err()?));
        let fault = DecodeFault {
            place: FaultLocation::Headers,
            error,
            offset: offset(datagram, (None, error), stop),
        };
        self.shape.malformed = Some(fault.to_string());
        self.faults.push(fault);
    }

    fn headers(&mut self, message: &NetworkMessage<'_>) {
        let header = message.header();
        let shape = &mut self.shape;
        shape.uadp_version = Some(1);
        shape.network_message_type = match message.message_type() {
            NetworkMessageType::DataSet => None,
            NetworkMessageType::Probe => Some(shape::NetworkMessageTypeJson::DiscoveryProbe),
            NetworkMessageType::Announcement => {
                Some(shape::NetworkMessageTypeJson::DiscoveryAnnouncement)
            }
        };
        shape.publisher_id = header.publisher_id.map(Into::into);
        shape.data_set_class_id = header.data_set_class_id.map(|id| id.to_string());
        shape.group_header = header.group.map(|group| shape::GroupHeaderJson {
            writer_group_id: group.writer_group_id,
            group_version: group.group_version,
            network_message_number: group.network_message_number,
            sequence_number: group.sequence_number,
        });
        shape.data_set_writer_ids = message.writer_ids().map(Iterator::collect);
        shape.timestamp = header.timestamp.map(show_timestamp);
        shape.pico_seconds = header.picoseconds;
        shape.security_header = message
            .security()
            .map(|security| show_security(&security, message));
        self.promoted_fields(message);
    }

    fn promoted_fields(&mut self, message: &NetworkMessage<'_>) {
        let Some(promoted) = message.promoted_fields() else {
            return;
        };
        let mut shown = Vec::new();
        for field in promoted {
            match field.and_then(|field| show_variant(&field)) {
                Ok(field) => shown.push(field),
                Err(error) => self
                    .faults
                    .push(promoted_fault(message, shown.len(), error)),
            }
        }
        self.shape.promoted_fields = Some(shown);
    }

    fn chunk(&mut self, message: &NetworkMessage<'_>) {
        match message.chunk() {
            Ok(chunk) => {
                self.shape.chunk = Some(shape::ChunkJson {
                    message_sequence_number: chunk.message_sequence_number,
                    chunk_offset: chunk.offset,
                    total_size: chunk.total_size,
                    chunk_data_hex: hex::text(chunk.data),
                });
            }
            Err(error) => {
                let payload = message.payload().len();
                let in_payload = if let DecodeError::Truncated { found, .. } = error {
                    payload - found
                } else {
                    // The ChunkOffset, which follows the MessageSequenceNumber.
                    2
                };
                self.faults.push(DecodeFault {
                    place: FaultLocation::Chunk,
                    error,
                    offset: message.payload_offset() + in_payload,
                });
            }
        }
    }
}

impl DecodedDatagram {
    /// Reads a body that starts `start` bytes after the first byte.
    fn discovery(&mut self, message_type: NetworkMessageType, body: &[u8], start: usize) {
        let read: fn(&[u8]) -> Result<(), DecodeError>;
        let shown = match message_type {
            NetworkMessageType::Probe => {
                read = |body| Probe::decode_body(body).map(|_| ());
                discovery::show_probe(body).map(|shown| self.shape.probe = Some(shown))
            }
            NetworkMessageType::Announcement | NetworkMessageType::DataSet => {
                read = |body| Announcement::decode_body(body).map(|_| ());
                discovery::show_announcement(body)
                    .map(|shown| self.shape.announcement = Some(shown))
            }
        };
        if let Err(error) = shown {
            let stop = |bytes: &[u8]| Some((None, read(bytes).err()?));
            self.faults.push(DecodeFault {
                place: FaultLocation::Discovery,
                error,
                offset: start + offset(body, (None, error), stop),
            });
        }
    }
}

fn promoted_fault(message: &NetworkMessage<'_>, field: usize, error: DecodeError) -> DecodeFault {
    let fields = promoted_range(message).unwrap_or_default();
    let bytes = message.datagram().get(fields.clone()).unwrap_or_default();
    let stop = (Some(field), error);
    let read = |bytes: &[u8]| {
        // A NetworkMessage that holds only these fields.
        let size = u16::try_from(bytes.len()).ok()?.to_le_bytes();
        let datagram = [&[0x81, 0x80, 0x02, size[0], size[1]], bytes].concat();
        let message = NetworkMessage::decode(&datagram).ok()?;
        let mut read = 0;
        for field in message.promoted_fields()? {
            match field {
                Ok(_) => read += 1,
                Err(error) => return Some((Some(read), error)),
            }
        }
        None
    };
    DecodeFault {
        place: FaultLocation::PromotedField(field),
        error,
        offset: fields.start + offset(bytes, stop, read),
    }
}

/// Returns the range of the PromotedFields, which precede the SecurityHeader. The headers before
/// them are measured by encoding them again.
fn promoted_range(message: &NetworkMessage<'_>) -> Option<std::ops::Range<usize>> {
    let ids: Option<Vec<_>> = message.writer_ids().map(Iterator::collect);
    let headers_with = |security| {
        let extras = Extras {
            promoted_fields: Some(&[]),
            security,
        };
        let mut headers = Vec::new();
        let encoder = NetworkMessageEncoder::with(
            &mut headers,
            &message.header(),
            ids.as_deref().filter(|_| !message.is_chunk()),
            &extras,
        );
        Some(encoder.ok()?.payload_offset())
    };
    let chunk_id = usize::from(message.is_chunk()) * ids.as_ref().map_or(0, |ids| ids.len() * 2);
    let security = headers_with(message.security())? - headers_with(None)?;
    let start = headers_with(None)? + chunk_id;
    Some(start..message.payload_offset() - security)
}

impl From<PublisherId<'_>> for shape::PublisherIdJson {
    fn from(id: PublisherId<'_>) -> Self {
        let (id_type, value) = match id {
            PublisherId::Byte(id) => (shape::PublisherIdType::Byte, id.into()),
            PublisherId::UInt16(id) => (shape::PublisherIdType::UInt16, id.into()),
            PublisherId::UInt32(id) => (shape::PublisherIdType::UInt32, id.into()),
            PublisherId::UInt64(id) => (shape::PublisherIdType::UInt64, id.to_string().into()),
            PublisherId::String(id) => (shape::PublisherIdType::String, id.into()),
        };
        Self { id_type, value }
    }
}

pub(crate) fn show_timestamp(time: DateTime) -> shape::TimestampJson {
    shape::TimestampJson {
        ticks100ns: Some(time.0),
        iso: Some(iso_time::of_date_time(time)),
    }
}

fn show_security(
    security: &SecurityHeader<'_>,
    message: &NetworkMessage<'_>,
) -> shape::SecurityHeaderJson {
    shape::SecurityHeaderJson {
        signed: security.signed,
        encrypted: security.encrypted,
        footer_enabled: security.footer_size.is_some(),
        force_key_reset: security.force_key_reset,
        security_token_id: security.token_id,
        nonce: hex::text(security.nonce),
        footer_size: security.footer_size,
        footer: security
            .footer_size
            .filter(|_| !message.is_sealed())
            .map(|_| hex::text(message.footer())),
    }
}
