//! Values that contain values: DataValue, DiagnosticInfo, and nested Variants.

use alloc::vec::Vec;
use core::fmt;
use core::marker::PhantomData;

use crate::reader::ByteReader;
use crate::{DateTime, DecodeError, EncodeError, StatusCode, Variant, writer};

/// DataValue (OPC 10000-6, 5.2.2.17): a value with its quality and its times. Fields that are
/// `None` are not encoded.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DataValue<'a> {
    /// The value.
    pub value: Option<Variant<'a>>,
    /// Quality; omitted for Good.
    pub status: Option<StatusCode>,
    /// Time at the source.
    pub source_timestamp: Option<DateTime>,
    /// Part of the source time below its resolution, in units of 10 ps.
    pub source_picoseconds: Option<u16>,
    /// Time at which the server or publisher received the value.
    pub server_timestamp: Option<DateTime>,
    /// Part of the server time below its resolution, in units of 10 ps.
    pub server_picoseconds: Option<u16>,
}

/// DiagnosticInfo (OPC 10000-6, 5.2.2.12). Fields that are `None` are not encoded. The first four
/// fields are indexes into a string table of the containing message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DiagnosticInfo<'a> {
    /// Name of the error.
    pub symbolic_id: Option<i32>,
    /// Namespace of the name.
    pub namespace_uri: Option<i32>,
    /// Language of the text.
    pub locale: Option<i32>,
    /// Text for people.
    pub localized_text: Option<i32>,
    /// Further information of the sender. The inner `None` is the null String.
    pub additional_info: Option<Option<&'a str>>,
    /// StatusCode of the underlying system.
    pub inner_status_code: Option<StatusCode>,
    /// DiagnosticInfo of the underlying system.
    pub inner: Option<Nested<'a, Self>>,
}

/// A value of type `T` in encoded form, checked when it was created. Nesting therefore needs no
/// allocation.
///
/// Equality compares the bytes.
pub struct Nested<'a, T> {
    bytes: &'a [u8],
    value: PhantomData<fn() -> T>,
}

/// A value that can be nested in another value.
pub(crate) trait Nest<'a>: Sized {
    fn read_nested(reader: &mut ByteReader<'a>, depth: Depth) -> Result<Self, DecodeError>;

    /// Skips and checks a value.
    #[inline]
    fn skip(reader: &mut ByteReader<'a>, depth: Depth) -> Result<(), DecodeError> {
        Self::read_nested(reader, depth).map(|_| ())
    }
}

/// Maximum nesting depth of decoded values. Deeper values are [`DecodeError::TooDeep`].
///
/// Version 1.05 requires decoders to support at least 4 levels of DiagnosticInfo, and expects no
/// more than 10 (OPC 10000-6, 5.2.2.12). Each additional level would increase the cost of reading
/// all values of a deeply nested datagram.
pub const MAX_NESTING: u8 = 10;

/// Number of levels that a value may still contain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Depth {
    /// The number of remaining levels.
    Left(u8),
    /// No limit: the bytes were checked before, and nothing follows them. Nested values are not
    /// skipped through again; otherwise descending level by level would take quadratic time.
    Checked,
}

impl Depth {
    pub(crate) const FULL: Self = Self::Left(MAX_NESTING);

    #[inline]
    pub(crate) fn inner(self) -> Result<Self, DecodeError> {
        match self {
            Self::Left(0) => Err(DecodeError::TooDeep),
            Self::Left(left) => Ok(Self::Left(left - 1)),
            Self::Checked => Ok(Self::Checked),
        }
    }
}

/// Skips `count` values.
pub(crate) fn skip<'a, T: Nest<'a>>(
    count: usize,
    reader: &mut ByteReader<'a>,
    depth: Depth,
) -> Result<(), DecodeError> {
    for _ in 0..count {
        T::skip(reader, depth.inner()?)?;
    }
    Ok(())
}

#[expect(private_bounds, reason = "the three values that nest are all of them")]
impl<'a, T: Nest<'a>> Nested<'a, T> {
    /// Checks that the bytes are exactly a single value.
    ///
    /// # Errors
    /// Fails as decoding the value, and for bytes behind it.
    pub fn new(bytes: &'a [u8]) -> Result<Self, DecodeError> {
        let mut reader = ByteReader::new(bytes);
        let encoded = Self::read(&mut reader, Depth::FULL)?;
        match reader.remaining() {
            0 => Ok(encoded),
            left => Err(DecodeError::TrailingBytes(left)),
        }
    }

    /// Decodes the value; nested values stay encoded.
    ///
    /// # Errors
    /// Does not fail, because the bytes were checked before. The `Result` avoids a panic.
    pub fn get(self) -> Result<T, DecodeError> {
        T::read_nested(&mut ByteReader::new(self.bytes), Depth::Checked)
    }

    pub(crate) fn read(reader: &mut ByteReader<'a>, depth: Depth) -> Result<Self, DecodeError> {
        if depth == Depth::Checked {
            return Ok(Self::written(reader.take_rest()));
        }
        let before = *reader;
        T::skip(reader, depth)?;
        Ok(Self::written(reader.since(&before)))
    }
}

impl<'a, T> Nested<'a, T> {
    /// Returns the encoded value.
    #[must_use]
    pub const fn bytes(self) -> &'a [u8] {
        self.bytes
    }
}

impl<'a> Nested<'a, Variant<'a>> {
    /// Encodes a Variant to the start of `buffer`, as an element of an array of Variants.
    ///
    /// # Errors
    /// As encoding the value.
    pub fn variant(value: &Variant<'_>, buffer: &'a mut Vec<u8>) -> Result<Self, EncodeError> {
        buffer.clear();
        value.write(buffer)?;
        Ok(Self::written(buffer))
    }
}

impl<'a> Nested<'a, DataValue<'a>> {
    /// Encodes a DataValue to the start of `buffer`.
    ///
    /// # Errors
    /// As encoding the value.
    pub fn data_value(value: &DataValue<'_>, buffer: &'a mut Vec<u8>) -> Result<Self, EncodeError> {
        buffer.clear();
        value.write(buffer)?;
        Ok(Self::written(buffer))
    }
}

impl<'a> Nested<'a, DiagnosticInfo<'a>> {
    /// Encodes a DiagnosticInfo to the start of `buffer`.
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] for a text that exceeds its length field.
    pub fn diagnostic_info(
        value: &DiagnosticInfo<'_>,
        buffer: &'a mut Vec<u8>,
    ) -> Result<Self, EncodeError> {
        buffer.clear();
        value.write(buffer)?;
        Ok(Self::written(buffer))
    }
}

impl<'a, T> Nested<'a, T> {
    const fn written(bytes: &'a [u8]) -> Self {
        Self {
            bytes,
            value: PhantomData,
        }
    }
}

impl<T> Clone for Nested<'_, T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Nested<'_, T> {}

impl<T> PartialEq for Nested<'_, T> {
    fn eq(&self, other: &Self) -> bool {
        self.bytes == other.bytes
    }
}

impl<T> Eq for Nested<'_, T> {}

impl<'a, T: Nest<'a> + fmt::Debug> fmt::Debug for Nested<'a, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.get() {
            Ok(value) => value.fmt(f),
            Err(_) => self.bytes.fmt(f),
        }
    }
}

impl<'a> Nest<'a> for Variant<'a> {
    fn read_nested(reader: &mut ByteReader<'a>, depth: Depth) -> Result<Self, DecodeError> {
        Self::read_at(reader, depth)
    }

    #[inline]
    fn skip(reader: &mut ByteReader<'a>, depth: Depth) -> Result<(), DecodeError> {
        Self::skip_at(reader, depth)
    }
}

impl<'a> Nest<'a> for DataValue<'a> {
    fn read_nested(reader: &mut ByteReader<'a>, depth: Depth) -> Result<Self, DecodeError> {
        Self::read_at(reader, depth)
    }
}

impl<'a> DataValue<'a> {
    #[inline]
    pub(crate) fn read(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        Self::read_at(reader, Depth::FULL)
    }

    fn read_at(reader: &mut ByteReader<'a>, depth: Depth) -> Result<Self, DecodeError> {
        let mask = reader.u8("DataValue")?;
        let reserved = mask & DATA_VALUE_RESERVED;
        if reserved != 0 {
            return Err(DecodeError::Reserved {
                field: "DataValue encoding mask",
                value: reserved.into(),
            });
        }
        let value = match mask & VALUE {
            0 => None,
            _ if depth == Depth::Checked => {
                let (mut value, behind) = reader.split_end(size_behind_value(mask), "DataValue")?;
                *reader = behind;
                Some(Variant::read_at(&mut value, depth)?)
            }
            _ => Some(Variant::read_at(reader, depth)?),
        };
        let status = match mask & STATUS {
            0 => None,
            _ => Some(StatusCode(reader.u32("DataValue Status")?)),
        };
        let (source_timestamp, source_picoseconds) =
            read_time(mask & SOURCE_TIMESTAMP, mask & SOURCE_PICOSECONDS, reader)?;
        let (server_timestamp, server_picoseconds) =
            read_time(mask & SERVER_TIMESTAMP, mask & SERVER_PICOSECONDS, reader)?;
        Ok(Self {
            value,
            status,
            source_timestamp,
            source_picoseconds,
            server_timestamp,
            server_picoseconds,
        })
    }

    pub(crate) fn write(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        let mask = writer::flag(self.value.is_some(), VALUE)
            | writer::flag(self.status.is_some(), STATUS)
            | writer::flag(self.source_timestamp.is_some(), SOURCE_TIMESTAMP)
            | writer::flag(self.source_picoseconds.is_some(), SOURCE_PICOSECONDS)
            | writer::flag(self.server_timestamp.is_some(), SERVER_TIMESTAMP)
            | writer::flag(self.server_picoseconds.is_some(), SERVER_PICOSECONDS);
        out.push(mask);
        if let Some(value) = &self.value {
            value.write(out)?;
        }
        if let Some(status) = self.status {
            out.extend_from_slice(&status.0.to_le_bytes());
        }
        write_time(self.source_timestamp, self.source_picoseconds, out);
        write_time(self.server_timestamp, self.server_picoseconds, out);
        Ok(())
    }
}

impl<'a> From<Variant<'a>> for DataValue<'a> {
    fn from(value: Variant<'a>) -> Self {
        Self {
            value: Some(value),
            ..Self::default()
        }
    }
}

/// Returns the number of bytes behind the value of a DataValue.
fn size_behind_value(mask: u8) -> usize {
    [
        (STATUS, 4),
        (SOURCE_TIMESTAMP, 8),
        (SOURCE_PICOSECONDS, 2),
        (SERVER_TIMESTAMP, 8),
        (SERVER_PICOSECONDS, 2),
    ]
    .iter()
    .filter(|(bit, _)| mask & bit != 0)
    .map(|(_, size)| size)
    .sum()
}

fn read_time(
    timestamp: u8,
    picoseconds: u8,
    reader: &mut ByteReader<'_>,
) -> Result<(Option<DateTime>, Option<u16>), DecodeError> {
    let timestamp = match timestamp {
        0 => None,
        _ => Some(DateTime(reader.i64("DataValue Timestamp")?)),
    };
    let picoseconds = match picoseconds {
        0 => None,
        _ => Some(reader.u16("DataValue PicoSeconds")?.min(MOST_PICOSECONDS)),
    };
    Ok((timestamp, picoseconds))
}

fn write_time(timestamp: Option<DateTime>, picoseconds: Option<u16>, out: &mut Vec<u8>) {
    if let Some(timestamp) = timestamp {
        out.extend_from_slice(&timestamp.0.to_le_bytes());
    }
    if let Some(picoseconds) = picoseconds {
        out.extend_from_slice(&picoseconds.to_le_bytes());
    }
}

impl<'a> Nest<'a> for DiagnosticInfo<'a> {
    fn read_nested(reader: &mut ByteReader<'a>, depth: Depth) -> Result<Self, DecodeError> {
        let mask = reader.u8("DiagnosticInfo")?;
        if mask & DIAGNOSTIC_RESERVED != 0 {
            return Err(DecodeError::Reserved {
                field: "DiagnosticInfo encoding mask",
                value: (mask & DIAGNOSTIC_RESERVED).into(),
            });
        }
        let mut index = |bit, what| match mask & bit {
            0 => Ok(None),
            _ => reader.i32(what).map(Some),
        };
        let symbolic_id = index(SYMBOLIC_ID, "DiagnosticInfo SymbolicId")?;
        let namespace_uri = index(NAMESPACE_URI, "DiagnosticInfo NamespaceUri")?;
        let locale = index(LOCALE, "DiagnosticInfo Locale")?;
        let localized_text = index(LOCALIZED_TEXT, "DiagnosticInfo LocalizedText")?;
        let additional_info = match mask & ADDITIONAL_INFO {
            0 => None,
            _ => Some(reader.text("DiagnosticInfo AdditionalInfo")?),
        };
        let inner_status_code = match mask & INNER_STATUS_CODE {
            0 => None,
            _ => Some(StatusCode(reader.u32("DiagnosticInfo InnerStatusCode")?)),
        };
        let inner = match mask & INNER {
            0 => None,
            _ => Some(Nested::read(reader, depth.inner()?)?),
        };
        Ok(Self {
            symbolic_id,
            namespace_uri,
            locale,
            localized_text,
            additional_info,
            inner_status_code,
            inner,
        })
    }
}

impl DiagnosticInfo<'_> {
    fn write(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        let indexes = [
            (self.symbolic_id, SYMBOLIC_ID),
            (self.namespace_uri, NAMESPACE_URI),
            (self.locale, LOCALE),
            (self.localized_text, LOCALIZED_TEXT),
        ];
        let mask = indexes
            .iter()
            .map(|(index, bit)| writer::flag(index.is_some(), *bit))
            .fold(0, |mask, bit| mask | bit)
            | writer::flag(self.additional_info.is_some(), ADDITIONAL_INFO)
            | writer::flag(self.inner_status_code.is_some(), INNER_STATUS_CODE)
            | writer::flag(self.inner.is_some(), INNER);
        out.push(mask);
        for (index, _) in indexes {
            if let Some(index) = index {
                out.extend_from_slice(&index.to_le_bytes());
            }
        }
        if let Some(text) = self.additional_info {
            let text = text.map(str::as_bytes);
            writer::byte_string(out, text, "DiagnosticInfo AdditionalInfo")?;
        }
        if let Some(status) = self.inner_status_code {
            out.extend_from_slice(&status.0.to_le_bytes());
        }
        if let Some(inner) = self.inner {
            out.extend_from_slice(inner.bytes);
        }
        Ok(())
    }
}

const VALUE: u8 = 0x01;
const STATUS: u8 = 0x02;
const SOURCE_TIMESTAMP: u8 = 0x04;
const SERVER_TIMESTAMP: u8 = 0x08;
const SOURCE_PICOSECONDS: u8 = 0x10;
const SERVER_PICOSECONDS: u8 = 0x20;
const DATA_VALUE_RESERVED: u8 = 0xC0;
/// Maximum value; decoders reduce larger values to it (OPC 10000-6, 5.2.2.17).
const MOST_PICOSECONDS: u16 = 9999;

const SYMBOLIC_ID: u8 = 0x01;
const NAMESPACE_URI: u8 = 0x02;
const LOCALIZED_TEXT: u8 = 0x04;
const LOCALE: u8 = 0x08;
const ADDITIONAL_INFO: u8 = 0x10;
const INNER_STATUS_CODE: u8 = 0x20;
const INNER: u8 = 0x40;
const DIAGNOSTIC_RESERVED: u8 = 0x80;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn picoseconds_of_a_whole_tick_and_more_are_read_as_the_most_there_are() {
        let mask = SOURCE_PICOSECONDS | SERVER_PICOSECONDS;
        let mut bytes = vec![mask];
        for picoseconds in [9_998_u16, 10_000] {
            bytes.extend_from_slice(&picoseconds.to_le_bytes());
        }
        let value = DataValue::read(&mut ByteReader::new(&bytes)).unwrap();
        assert_eq!(value.source_picoseconds, Some(9_998));
        assert_eq!(value.server_picoseconds, Some(9_999));
    }
}
