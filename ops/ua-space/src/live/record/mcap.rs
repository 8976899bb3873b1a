//! Writes MCAP files: the container that viewers of robot data read
//! (<https://mcap.dev/spec>). Messages are in chunks without compression, with an index.

use std::collections::BTreeMap;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;

use crate::live::channels::{ANNOUNCEMENT, TopicChannel};

/// Encodes the records of a file.
#[derive(Debug, Default)]
pub(super) struct McapEncoder {
    /// The records of the current chunk.
    chunk: Vec<u8>,
    /// The times and offsets of the messages in the current chunk, by channel.
    index: BTreeMap<u16, Vec<(u64, u64)>>,
    chunks: Vec<ChunkIndex>,
    /// The Schema and Channel records, which are repeated at the end of the file.
    schemas: Vec<u8>,
    channels: Vec<u8>,
    /// The number of messages of each channel.
    counts: BTreeMap<u16, u64>,
    span: Option<(u64, u64)>,
    chunk_span: Option<(u64, u64)>,
}

/// A message of a channel.
#[derive(Debug, Clone, Copy)]
pub(super) struct EncodedMessage<'a> {
    pub(super) channel: u16,
    pub(super) sequence: u32,
    /// The time of arrival, in nanoseconds since 1970.
    pub(super) logged: u64,
    /// The time at which the writer took the value.
    pub(super) published: u64,
    pub(super) data: &'a [u8],
}

#[derive(Debug)]
struct ChunkIndex {
    span: (u64, u64),
    start: u64,
    length: u64,
    /// The offsets of the MessageIndex records, by channel.
    indexes: Vec<(u16, u64)>,
    indexes_length: u64,
    size: u64,
}

impl McapEncoder {
    /// Appends the start of a file.
    pub(super) fn begin(out: &mut Vec<u8>) -> Self {
        out.extend(MAGIC);
        let library = concat!("ua-space ", env!("CARGO_PKG_VERSION"));
        record(HEADER, out, |out| {
            text("", out);
            text(library, out);
        });
        Self::default()
    }

    /// Adds a channel with its schema to the current chunk, and the announcement of its topic, with
    /// which its values can be sent again.
    pub(super) fn channel(&mut self, channel: &TopicChannel, announcement: Option<&[u8]>) {
        let mut schema = Vec::new();
        record(SCHEMA, &mut schema, |out| {
            out.extend(channel.id.to_le_bytes());
            text(&channel.schema_name, out);
            text(channel.schema_encoding, out);
            text(&channel.schema, out);
        });
        let mut described = Vec::new();
        record(CHANNEL, &mut described, |out| {
            // Each channel has a schema of its own.
            out.extend(channel.id.to_le_bytes());
            out.extend(channel.id.to_le_bytes());
            text(&channel.name, out);
            text(channel.encoding, out);
            sized(out, |out| {
                for (key, value) in &channel.metadata {
                    text(key, out);
                    text(value, out);
                }
                if let Some(announcement) = announcement {
                    text(ANNOUNCEMENT, out);
                    text(&BASE64.encode(announcement), out);
                }
            });
        });
        self.chunk.extend(&schema);
        self.chunk.extend(&described);
        self.schemas.extend(schema);
        self.channels.extend(described);
        self.counts.insert(channel.id, 0);
    }

    /// Adds a message to the current chunk.
    pub(super) fn message(&mut self, message: &EncodedMessage<'_>) {
        let at = size(self.chunk.len());
        record(MESSAGE, &mut self.chunk, |out| {
            out.extend(message.channel.to_le_bytes());
            out.extend(message.sequence.to_le_bytes());
            out.extend(message.logged.to_le_bytes());
            out.extend(message.published.to_le_bytes());
            out.extend(message.data);
        });
        let index = self.index.entry(message.channel).or_default();
        index.push((message.logged, at));
        *self.counts.entry(message.channel).or_default() += 1;
        let widen = |span: &mut Option<(u64, u64)>| {
            let (first, last) = span.unwrap_or((message.logged, message.logged));
            *span = Some((first.min(message.logged), last.max(message.logged)));
        };
        widen(&mut self.span);
        widen(&mut self.chunk_span);
    }

    /// Returns the size of the current chunk in bytes.
    pub(super) const fn waiting(&self) -> usize {
        self.chunk.len()
    }

    /// Appends the current chunk with its index. `at` is the offset of the end of `out` in the
    /// file.
    pub(super) fn end_chunk(&mut self, at: u64, out: &mut Vec<u8>) {
        let records = std::mem::take(&mut self.chunk);
        let span = self.chunk_span.take().unwrap_or_default();
        if records.is_empty() {
            return;
        }
        let begin = out.len();
        let offset = |out: &Vec<u8>| at + size(out.len() - begin);
        record(CHUNK, out, |out| {
            out.extend(span.0.to_le_bytes());
            out.extend(span.1.to_le_bytes());
            out.extend(size(records.len()).to_le_bytes());
            out.extend(crc32fast::hash(&records).to_le_bytes());
            text("", out);
            out.extend(size(records.len()).to_le_bytes());
            out.extend(&records);
        });
        let length = offset(out) - at;
        let mut indexes = Vec::new();
        for (channel, entries) in std::mem::take(&mut self.index) {
            indexes.push((channel, offset(out)));
            record(MESSAGE_INDEX, out, |out| {
                out.extend(channel.to_le_bytes());
                sized(out, |out| {
                    for (time, place) in &entries {
                        out.extend(time.to_le_bytes());
                        out.extend(place.to_le_bytes());
                    }
                });
            });
        }
        self.chunks.push(ChunkIndex {
            span,
            start: at,
            length,
            indexes,
            indexes_length: offset(out) - at - length,
            size: size(records.len()),
        });
    }

    /// Appends the end of the file. `at` is the offset of the end of `out` in the file.
    pub(super) fn finish(mut self, at: u64, out: &mut Vec<u8>) {
        let begin = out.len();
        self.end_chunk(at, out);
        record(DATA_END, out, |out| out.extend(0_u32.to_le_bytes()));
        let summary = out.len();
        let offset = |length: usize| at + size(length - begin);
        let mut groups = Vec::new();
        let mut group = |kind: u8, out: &mut Vec<u8>, write: &mut dyn FnMut(&mut Vec<u8>)| {
            let start = out.len();
            write(out);
            if out.len() > start {
                groups.push((kind, offset(start), size(out.len() - start)));
            }
        };
        group(SCHEMA, out, &mut |out| out.extend(&self.schemas));
        group(CHANNEL, out, &mut |out| out.extend(&self.channels));
        group(STATISTICS, out, &mut |out| self.statistics(out));
        group(CHUNK_INDEX, out, &mut |out| {
            for chunk in &self.chunks {
                chunk.write(out);
            }
        });
        let offsets = out.len();
        for (kind, start, length) in groups {
            record(SUMMARY_OFFSET, out, |out| {
                out.push(kind);
                out.extend(start.to_le_bytes());
                out.extend(length.to_le_bytes());
            });
        }
        let footer = out.len();
        record(FOOTER, out, |out| {
            out.extend(offset(summary).to_le_bytes());
            out.extend(offset(offsets).to_le_bytes());
        });
        // The length of the footer includes the checksum, which covers everything before it.
        if let Some(length) = out.get_mut(footer + 1..footer + 9) {
            length.copy_from_slice(&FOOTER_LENGTH.to_le_bytes());
        }
        let checksum = crc32fast::hash(out.get(summary..).unwrap_or_default());
        out.extend(checksum.to_le_bytes());
        out.extend(MAGIC);
    }

    fn statistics(&self, out: &mut Vec<u8>) {
        let (first, last) = self.span.unwrap_or_default();
        let channels = u16::try_from(self.counts.len()).unwrap_or(u16::MAX);
        record(STATISTICS, out, |out| {
            out.extend(self.counts.values().sum::<u64>().to_le_bytes());
            out.extend(channels.to_le_bytes());
            out.extend(u32::from(channels).to_le_bytes());
            // Attachments and Metadata records.
            out.extend([0; 8]);
            out.extend(
                u32::try_from(self.chunks.len())
                    .unwrap_or(u32::MAX)
                    .to_le_bytes(),
            );
            out.extend(first.to_le_bytes());
            out.extend(last.to_le_bytes());
            sized(out, |out| {
                for (channel, count) in &self.counts {
                    out.extend(channel.to_le_bytes());
                    out.extend(count.to_le_bytes());
                }
            });
        });
    }
}

impl ChunkIndex {
    fn write(&self, out: &mut Vec<u8>) {
        record(CHUNK_INDEX, out, |out| {
            out.extend(self.span.0.to_le_bytes());
            out.extend(self.span.1.to_le_bytes());
            out.extend(self.start.to_le_bytes());
            out.extend(self.length.to_le_bytes());
            sized(out, |out| {
                for (channel, offset) in &self.indexes {
                    out.extend(channel.to_le_bytes());
                    out.extend(offset.to_le_bytes());
                }
            });
            out.extend(self.indexes_length.to_le_bytes());
            text("", out);
            out.extend(self.size.to_le_bytes());
            out.extend(self.size.to_le_bytes());
        });
    }
}

/// Appends a record with its length.
fn record(kind: u8, out: &mut Vec<u8>, content: impl FnOnce(&mut Vec<u8>)) {
    out.push(kind);
    let at = out.len();
    out.extend([0; 8]);
    content(out);
    let length = size(out.len() - at - 8);
    if let Some(place) = out.get_mut(at..at + 8) {
        place.copy_from_slice(&length.to_le_bytes());
    }
}

/// Appends a part with its length in 32 bits.
fn sized(out: &mut Vec<u8>, content: impl FnOnce(&mut Vec<u8>)) {
    let at = out.len();
    out.extend([0; 4]);
    content(out);
    let length = u32::try_from(out.len() - at - 4).unwrap_or(u32::MAX);
    if let Some(place) = out.get_mut(at..at + 4) {
        place.copy_from_slice(&length.to_le_bytes());
    }
}

fn text(text: &str, out: &mut Vec<u8>) {
    sized(out, |out| out.extend(text.as_bytes()));
}

fn size(length: usize) -> u64 {
    u64::try_from(length).unwrap_or(u64::MAX)
}

const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', b'0', b'\r', b'\n'];
const HEADER: u8 = 0x01;
const FOOTER: u8 = 0x02;
const SCHEMA: u8 = 0x03;
const CHANNEL: u8 = 0x04;
const MESSAGE: u8 = 0x05;
const CHUNK: u8 = 0x06;
const MESSAGE_INDEX: u8 = 0x07;
const CHUNK_INDEX: u8 = 0x08;
const STATISTICS: u8 = 0x0B;
const SUMMARY_OFFSET: u8 = 0x0E;
const DATA_END: u8 = 0x0F;
/// Two offsets and a checksum.
const FOOTER_LENGTH: u64 = 8 + 8 + 4;
