//! Reads the channels and messages of an MCAP file in order (<https://mcap.dev/spec>). Chunks may
//! not be compressed.

use std::collections::BTreeMap;
use std::io::{self, Read};
use std::sync::Arc;

use crate::capture::CaptureError;

/// Reads the messages of a file.
#[derive(Debug)]
pub(super) struct McapReader<R> {
    reader: R,
    /// Number of bytes read so far.
    at: u64,
    /// The records of the current chunk, and the number of its bytes that are read.
    chunk: Vec<u8>,
    chunk_at: usize,
    schemas: BTreeMap<u16, Arc<McapSchema>>,
    channels: BTreeMap<u16, Arc<McapChannel>>,
    /// The size of all schemas and channels.
    weight: usize,
}

/// The definition of the messages of a channel.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct McapSchema {
    pub(super) data: Vec<u8>,
}

/// A channel with its schema.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct McapChannel {
    pub(super) encoding: String,
    pub(super) metadata: BTreeMap<String, String>,
    pub(super) schema: Arc<McapSchema>,
}

/// A message, and its channel.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct McapMessage {
    pub(super) channel: Arc<McapChannel>,
    pub(super) channel_id: u16,
    pub(super) sequence: u32,
    /// The time of arrival, in nanoseconds since 1970.
    pub(super) logged: u64,
    /// The time at which the writer took the value.
    pub(super) published: u64,
    pub(super) data: Vec<u8>,
}

impl<R: Read> McapReader<R> {
    /// Reads the start of a file; `reader` returns the bytes after the first four.
    pub(super) fn new(reader: R) -> Result<Self, CaptureError> {
        let mut mcap = Self {
            reader,
            at: 4,
            chunk: Vec::new(),
            chunk_at: 0,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            weight: 0,
        };
        let mut rest = [0; 4];
        mcap.exact(&mut rest, 0)?;
        if rest == *b"P0\r\n" {
            Ok(mcap)
        } else {
            Err(CaptureError::Broken {
                at: 4,
                what: "this version of MCAP is not known",
            })
        }
    }

    /// Returns the next message, or `None` at the end of the data. A file that ends after a whole
    /// record without the end of an MCAP file is read up to there.
    pub(super) fn next_message(&mut self) -> Result<Option<McapMessage>, CaptureError> {
        loop {
            let at = self.at;
            let Some((kind, body)) = self.record()? else {
                return Ok(None);
            };
            let mut body = Body(&body);
            let read = match kind {
                SCHEMA => self.schema(&mut body),
                CHANNEL => self.channel(&mut body),
                CHUNK => self.open_chunk(&mut body),
                MESSAGE => match self.message(&mut body) {
                    Ok(message) => return Ok(Some(message)),
                    Err(what) => Err(what),
                },
                DATA_END | FOOTER => return Ok(None),
                _ => Ok(()),
            };
            read.map_err(|what| CaptureError::Broken { at, what })?;
        }
    }

    fn schema(&mut self, body: &mut Body<'_>) -> Result<(), &'static str> {
        let id = body.u16()?;
        let _name = body.text()?;
        let _encoding = body.text()?;
        let data = body.sized()?.to_vec();
        self.weigh(data.len())?;
        let before = self.schemas.insert(id, Arc::new(McapSchema { data }));
        self.weight -= before.map_or(0, |before| before.data.len());
        Ok(())
    }

    fn channel(&mut self, body: &mut Body<'_>) -> Result<(), &'static str> {
        let (id, schema) = (body.u16()?, body.u16()?);
        let _topic = body.text()?;
        let encoding = body.text()?;
        let mut pairs = Body(body.sized()?);
        let size = encoding.len() + pairs.0.len();
        let mut metadata = BTreeMap::new();
        while !pairs.0.is_empty() {
            let key = pairs.text()?;
            metadata.insert(key, pairs.text()?);
        }
        let schema = self.schemas.get(&schema).cloned().unwrap_or_default();
        let channel = McapChannel {
            encoding,
            metadata,
            schema,
        };
        // A file repeats its channels in later chunks.
        if self
            .channels
            .get(&id)
            .is_none_or(|known| **known != channel)
        {
            self.weigh(size)?;
            let _before = self.channels.insert(id, Arc::new(channel));
        }
        Ok(())
    }

    fn message(&self, body: &mut Body<'_>) -> Result<McapMessage, &'static str> {
        let channel_id = body.u16()?;
        let channel = self.channels.get(&channel_id);
        Ok(McapMessage {
            channel: Arc::clone(channel.ok_or("a message without a channel")?),
            channel_id,
            sequence: body.u32()?,
            logged: body.u64()?,
            published: body.u64()?,
            data: body.0.to_vec(),
        })
    }

    fn open_chunk(&mut self, body: &mut Body<'_>) -> Result<(), &'static str> {
        // A chunk is no part of another chunk; at its end it would be read like the next chunk.
        if self.chunk_at < self.chunk.len() {
            return Err("a chunk in a chunk");
        }
        let (_first, _last) = (body.u64()?, body.u64()?);
        let _size = body.u64()?;
        let checksum = body.u32()?;
        if !body.text()?.is_empty() {
            return Err("the chunk is compressed; `mcap decompress` writes a file that is not");
        }
        let length = usize::try_from(body.u64()?).map_err(|_| TOO_LONG)?;
        let records = body.take(length)?;
        if checksum != 0 && checksum != crc32fast::hash(records) {
            return Err("the checksum of the chunk is wrong");
        }
        self.chunk = records.to_vec();
        self.chunk_at = 0;
        Ok(())
    }

    /// Adds the size of a schema or channel.
    const fn weigh(&mut self, size: usize) -> Result<(), &'static str> {
        self.weight = self.weight.saturating_add(size);
        if self.weight <= MOST_WEIGHT {
            Ok(())
        } else {
            Err("more schemas and channels than there is room for")
        }
    }

    /// Returns the next record of a kind that is read, from the current chunk or the file.
    fn record(&mut self) -> Result<Option<(u8, Vec<u8>)>, CaptureError> {
        let start = self.at;
        if let Some(rest) = self
            .chunk
            .get(self.chunk_at..)
            .filter(|rest| !rest.is_empty())
        {
            let mut body = Body(rest);
            let broken = |what| CaptureError::Broken { at: start, what };
            let kind = body.take(1).map_err(broken)?.first().copied();
            let length = usize::try_from(body.u64().map_err(broken)?).unwrap_or(usize::MAX);
            let record = body.take(length).map_err(broken)?.to_vec();
            self.chunk_at = self.chunk.len() - body.0.len();
            return Ok(Some((kind.unwrap_or_default(), record)));
        }
        loop {
            let start = self.at;
            let mut kind = [0];
            if self.reader.by_ref().take(1).read(&mut kind)? == 0 {
                return Ok(None);
            }
            self.at += 1;
            let mut length = [0; 8];
            self.exact(&mut length, start)?;
            let length = u64::from_le_bytes(length);
            if !matches!(
                kind,
                [SCHEMA | CHANNEL | CHUNK | MESSAGE | DATA_END | FOOTER]
            ) {
                let mut skipped = self.reader.by_ref().take(length);
                if io::copy(&mut skipped, &mut io::sink())? < length {
                    return Err(CaptureError::CutOff(start));
                }
                self.at += length;
                continue;
            }
            if length > MOST_RECORD {
                return Err(CaptureError::Broken {
                    at: start,
                    what: TOO_LONG,
                });
            }
            let mut record = Vec::new();
            let read = self.reader.by_ref().take(length).read_to_end(&mut record)?;
            if u64::try_from(read) != Ok(length) {
                return Err(CaptureError::CutOff(start));
            }
            self.at += length;
            let [kind] = kind;
            return Ok(Some((kind, record)));
        }
    }

    /// Fills the bytes. `start` is the offset of the record for errors.
    fn exact(&mut self, bytes: &mut [u8], start: u64) -> Result<(), CaptureError> {
        self.reader.read_exact(bytes).map_err(|error| {
            if error.kind() == io::ErrorKind::UnexpectedEof {
                CaptureError::CutOff(start)
            } else {
                CaptureError::Io(error)
            }
        })?;
        self.at += u64::try_from(bytes.len()).unwrap_or_default();
        Ok(())
    }
}

/// The unread part of a record.
struct Body<'a>(&'a [u8]);

impl<'a> Body<'a> {
    fn take(&mut self, length: usize) -> Result<&'a [u8], &'static str> {
        let (taken, rest) = self.0.split_at_checked(length).ok_or(TOO_SHORT)?;
        self.0 = rest;
        Ok(taken)
    }

    fn number<const N: usize>(&mut self) -> Result<[u8; N], &'static str> {
        let (taken, rest) = self.0.split_first_chunk().ok_or(TOO_SHORT)?;
        self.0 = rest;
        Ok(*taken)
    }

    fn u16(&mut self) -> Result<u16, &'static str> {
        self.number().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Result<u32, &'static str> {
        self.number().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, &'static str> {
        self.number().map(u64::from_le_bytes)
    }

    /// Reads bytes after their length in 32 bits.
    fn sized(&mut self) -> Result<&'a [u8], &'static str> {
        let length = usize::try_from(self.u32()?).map_err(|_| TOO_LONG)?;
        self.take(length)
    }

    fn text(&mut self) -> Result<String, &'static str> {
        let text = str::from_utf8(self.sized()?).map_err(|_| "a text is not UTF-8")?;
        Ok(text.to_owned())
    }
}

const FOOTER: u8 = 0x02;
const SCHEMA: u8 = 0x03;
const CHANNEL: u8 = 0x04;
const MESSAGE: u8 = 0x05;
const CHUNK: u8 = 0x06;
const DATA_END: u8 = 0x0F;
const TOO_SHORT: &str = "a record is shorter than its contents";
const TOO_LONG: &str = "a record is longer than this program reads";
/// Maximum size of a record. A chunk is usually a few MiB.
const MOST_RECORD: u64 = 256 << 20;
/// Maximum size of all schemas and channels.
const MOST_WEIGHT: usize = 64 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    fn record(kind: u8, body: &[u8]) -> Vec<u8> {
        let mut out = vec![kind];
        out.extend(u64::try_from(body.len()).unwrap().to_le_bytes());
        out.extend(body);
        out
    }

    fn text(text: &str) -> Vec<u8> {
        let mut out = u32::try_from(text.len()).unwrap().to_le_bytes().to_vec();
        out.extend(text.as_bytes());
        out
    }

    fn channel() -> Vec<u8> {
        let pairs = [text("topic"), text("ua_1_2_10")].concat();
        let length = u32::try_from(pairs.len()).unwrap().to_le_bytes();
        let ids = [7, 0, 0, 0];
        let body = [&ids[..], &text("/a"), &text("json"), &length, &pairs].concat();
        record(CHANNEL, &body)
    }

    fn message(channel: u16, data: &[u8]) -> Vec<u8> {
        let mut body = channel.to_le_bytes().to_vec();
        body.extend(3_u32.to_le_bytes());
        body.extend(20_u64.to_le_bytes());
        body.extend(10_u64.to_le_bytes());
        body.extend(data);
        record(MESSAGE, &body)
    }

    fn chunk(compression: &str, checksum: u32, records: &[u8]) -> Vec<u8> {
        let length = u64::try_from(records.len()).unwrap();
        let mut body = [20_u64, 20, length].map(u64::to_le_bytes).concat();
        body.extend(checksum.to_le_bytes());
        body.extend(text(compression));
        body.extend(length.to_le_bytes());
        body.extend(records);
        record(CHUNK, &body)
    }

    /// Returns the data of all messages of a file with these records, or the error.
    fn read(records: &[Vec<u8>]) -> Result<Vec<Vec<u8>>, String> {
        let mut file = b"P0\r\n".to_vec();
        file.extend(records.concat());
        let mut mcap = McapReader::new(file.as_slice()).map_err(|error| error.to_string())?;
        let mut all = Vec::new();
        loop {
            match mcap.next_message() {
                Ok(Some(message)) => {
                    assert_eq!(message.channel.metadata["topic"], "ua_1_2_10");
                    assert_eq!((message.sequence, message.logged), (3, 20));
                    all.push(message.data);
                }
                Ok(None) => return Ok(all),
                Err(error) => return Err(error.to_string()),
            }
        }
    }

    #[test]
    fn messages_are_read_in_chunks_and_outside_of_them() {
        let inner = [channel(), message(7, b"one"), message(7, b"")].concat();
        let records = [
            record(0x01, &[0; 8]),
            chunk("", crc32fast::hash(&inner), &inner),
            record(0x09, &[0; 100]),
            message(7, b"two"),
            record(DATA_END, &[0; 4]),
            message(7, b"behind the data"),
        ];
        let wanted = [&b"one"[..], b"", b"two"].map(<[u8]>::to_vec);
        assert_eq!(read(&records).unwrap(), wanted);
        // A program that is killed leaves a file without an end.
        assert_eq!(read(&records[..2]).unwrap(), wanted[..2]);
    }

    #[test]
    fn broken_files_are_errors_with_their_place() {
        let inner = [channel(), message(7, b"one")].concat();
        let mut cut = chunk("", 0, &inner);
        cut.truncate(cut.len() - 1);
        for (records, why) in [
            (vec![cut], "inside of what starts at byte 8"),
            (vec![chunk("zstd", 0, &inner)], "mcap decompress"),
            (vec![chunk("", 1, &inner)], "checksum"),
            (vec![message(8, b"")], "a message without a channel"),
            (vec![record(MESSAGE, &[7])], "shorter than its contents"),
            (vec![chunk("", 0, &[MESSAGE, 9])], "shorter"),
        ] {
            let wrong = read(&records).unwrap_err();
            assert!(wrong.contains(why), "{wrong}");
        }
        let mut mcap = [MESSAGE].to_vec();
        mcap.extend(u64::MAX.to_le_bytes());
        assert!(read(&[mcap]).unwrap_err().contains("longer"));
        assert!(McapReader::new(&b"P1\r\n"[..]).is_err());
    }
}
