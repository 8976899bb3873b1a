//! A NetworkMessage encoded once, whose values are replaced in place from then on.

use std::ops::Range;

use crate::header::{self, Flags, PublisherId};
use crate::reader::Reader;
use crate::{
    BuiltinType, DataSetMessage, DateTime, DecodeError, FieldEncoding, MessageKind, NetworkMessage,
    Scalar, StatusCode, Variant,
};

/// A key frame message of fixed layout, kept as its bytes: sending it again costs the copies of what changed.
///
/// Made from a datagram that [`NetworkMessageEncoder`](crate::NetworkMessageEncoder) wrote. What can be replaced is
/// what was there: header fields, and values of fixed size by values of the same type.
///
/// ```
/// use uadp::{DataSetHeader, MessageTemplate, NetworkHeader, NetworkMessageEncoder, Scalar};
///
/// let mut datagram = Vec::new();
/// let mut encoder = NetworkMessageEncoder::new(&mut datagram, &NetworkHeader::default(), Some(&[10]))?;
/// let header = DataSetHeader { sequence_number: Some(0), ..DataSetHeader::default() };
/// let mut fields = encoder.key_frame(&header)?;
/// fields.scalar(Scalar::Double(0.0))?;
/// fields.finish()?;
/// encoder.finish()?;
///
/// let mut template = MessageTemplate::new(datagram)?;
/// let mut message = template.message(0).ok_or("one DataSetMessage")?;
/// message.sequence_number(1)?;
/// message.field(0, Scalar::Double(2.5))?;
/// assert_eq!(template.bytes().len(), 18);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone)]
pub struct MessageTemplate {
    bytes: Vec<u8>,
    group_sequence_number: Option<usize>,
    timestamp: Option<usize>,
    messages: Vec<Slots>,
}

/// One DataSetMessage of a [`MessageTemplate`].
#[derive(Debug)]
pub struct MessagePatch<'t> {
    bytes: &'t mut [u8],
    slots: &'t Slots,
}

/// Why a part of a template was not replaced. The template is as it was before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PatchError {
    /// The header field is not in the message.
    #[error("the message has no {0}")]
    Absent(&'static str),
    /// No so many fields.
    #[error("no field {0}")]
    NoField(usize),
    /// The field has another type, or a value whose size varies.
    #[error("field {field} does not take {found} in place")]
    Type {
        /// Position of the field, from 0.
        field: usize,
        /// Type of the value given.
        found: BuiltinType,
    },
    /// The array, or the payload of RawData, has another number of bytes.
    #[error("field {field} has {expected} bytes, not {found}")]
    Size {
        /// Position of the field, from 0.
        field: usize,
        /// Bytes of its elements.
        expected: usize,
        /// Bytes given.
        found: usize,
    },
}

/// A Rust number or truth value that is a builtin type of fixed size.
pub trait Fixed: Copy + sealed::Sealed {
    /// The type.
    const BUILTIN: BuiltinType;
    #[doc(hidden)]
    type Bytes: AsRef<[u8]>;
    #[doc(hidden)]
    fn wire(self) -> Self::Bytes;
}

mod sealed {
    #[expect(
        unnameable_types,
        reason = "what keeps others from implementing `Fixed`"
    )]
    pub trait Sealed {}
}

macro_rules! fixed {
    ($($rust:ty: $builtin:ident, $size:literal;)*) => { $(
        impl sealed::Sealed for $rust {}
        impl Fixed for $rust {
            const BUILTIN: BuiltinType = BuiltinType::$builtin;
            type Bytes = [u8; $size];
            #[inline]
            fn wire(self) -> [u8; $size] {
                self.to_le_bytes()
            }
        }
    )* };
}

fixed! {
    i8: SByte, 1;
    u8: Byte, 1;
    i16: Int16, 2;
    u16: UInt16, 2;
    i32: Int32, 4;
    u32: UInt32, 4;
    i64: Int64, 8;
    u64: UInt64, 8;
    f32: Float, 4;
    f64: Double, 8;
}

impl sealed::Sealed for bool {}
impl Fixed for bool {
    const BUILTIN: BuiltinType = BuiltinType::Boolean;
    type Bytes = [u8; 1];
    #[inline]
    fn wire(self) -> [u8; 1] {
        [u8::from(self)]
    }
}

/// Where the parts of a DataSetMessage stand in the datagram.
#[derive(Debug, Clone)]
struct Slots {
    sequence_number: Option<usize>,
    timestamp: Option<usize>,
    status: Option<usize>,
    fields: Vec<Slot>,
    /// The payload of a RawData message, empty for others.
    raw: Range<usize>,
}

#[derive(Debug, Clone, Copy)]
struct Slot {
    at: u32,
    /// Bytes of the elements, for arrays only.
    array: Option<u32>,
    /// `None` where the size of the value varies.
    fixed: Option<BuiltinType>,
}

impl MessageTemplate {
    /// Takes a datagram apart.
    ///
    /// # Errors
    /// [`DecodeError::Misread`] for anything but unsecured key frames, heartbeats and keep-alives with Variant or RawData
    /// fields; else as reading the datagram does. Fields of RawData are not found: theirs is the
    /// RawLayout to know; [`raw`](MessagePatch::raw) replaces their bytes.
    pub fn new(datagram: Vec<u8>) -> Result<Self, DecodeError> {
        let network = NetworkMessage::decode(&datagram)?;
        if network.security().is_some() {
            return Err(DecodeError::Misread("with a SecurityHeader, not fixed"));
        }
        if network.promoted_fields().is_some() {
            return Err(DecodeError::Misread("with PromotedFields, not fixed"));
        }
        let picoseconds = network.header().picoseconds.map_or(0, |_| 2);
        let timestamp = network
            .header()
            .timestamp
            .and_then(|_| network.payload_offset().checked_sub(picoseconds + 8));
        let mut messages = Vec::new();
        for message in network.messages() {
            messages.push(Slots::of(&message?, &datagram)?);
        }
        Ok(Self {
            group_sequence_number: group_sequence_number(&datagram)?,
            timestamp,
            messages,
            bytes: datagram,
        })
    }

    /// The datagram as it is now.
    #[inline]
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// The DataSetMessage at that position, from 0.
    #[inline]
    #[must_use]
    pub fn message(&mut self, index: usize) -> Option<MessagePatch<'_>> {
        Some(MessagePatch {
            bytes: &mut self.bytes,
            slots: self.messages.get(index)?,
        })
    }

    /// Replaces the SequenceNumber of the group header.
    ///
    /// # Errors
    /// [`PatchError::Absent`] without one.
    #[inline]
    pub fn group_sequence_number(&mut self, number: u16) -> Result<(), PatchError> {
        let at = self.group_sequence_number;
        put(&mut self.bytes, at, number.to_le_bytes(), "SequenceNumber")
    }

    /// Replaces the Timestamp of the NetworkMessage.
    ///
    /// # Errors
    /// [`PatchError::Absent`] without one.
    #[inline]
    pub fn timestamp(&mut self, time: DateTime) -> Result<(), PatchError> {
        let at = self.timestamp;
        put(&mut self.bytes, at, time.0.to_le_bytes(), "Timestamp")
    }
}

impl MessagePatch<'_> {
    /// Replaces the DataSetMessageSequenceNumber.
    ///
    /// # Errors
    /// [`PatchError::Absent`] without one.
    #[inline]
    pub fn sequence_number(&mut self, number: u16) -> Result<(), PatchError> {
        let at = self.slots.sequence_number;
        put(
            self.bytes,
            at,
            number.to_le_bytes(),
            "DataSetMessageSequenceNumber",
        )
    }

    /// Replaces the Timestamp of the DataSetMessage.
    ///
    /// # Errors
    /// [`PatchError::Absent`] without one.
    #[inline]
    pub fn timestamp(&mut self, time: DateTime) -> Result<(), PatchError> {
        let at = self.slots.timestamp;
        put(
            self.bytes,
            at,
            time.0.to_le_bytes(),
            "DataSetMessage Timestamp",
        )
    }

    /// Replaces the Status by the upper half of a StatusCode.
    ///
    /// # Errors
    /// [`PatchError::Absent`] without one.
    #[inline]
    pub fn status(&mut self, status: StatusCode) -> Result<(), PatchError> {
        let at = self.slots.status;
        put(self.bytes, at, status.status().to_le_bytes(), "Status")
    }

    /// Replaces a field by a value of the same type, one of fixed size.
    ///
    /// # Errors
    /// [`PatchError::NoField`] and [`PatchError::Type`].
    #[inline]
    pub fn field(&mut self, field: usize, value: Scalar<'_>) -> Result<(), PatchError> {
        let found = value.builtin_type();
        let slot = self
            .slots
            .fields
            .get(field)
            .ok_or(PatchError::NoField(field))?;
        if slot.fixed != Some(found) || slot.array.is_some() {
            return Err(PatchError::Type { field, found });
        }
        match value.fixed_bytes() {
            Some((bytes, size)) => {
                let at = slot.at as usize;
                if let (Some(place), Some(bytes)) =
                    (self.bytes.get_mut(at..at + size), bytes.get(..size))
                {
                    place.copy_from_slice(bytes);
                }
                Ok(())
            }
            None => Err(PatchError::Type { field, found }),
        }
    }

    /// Replaces consecutive fields of one type, the first at position `first`.
    ///
    /// # Errors
    /// [`PatchError::NoField`] and [`PatchError::Type`]; nothing is replaced then.
    #[inline]
    pub fn fields<T: Fixed>(&mut self, first: usize, values: &[T]) -> Result<(), PatchError> {
        let end = first.saturating_add(values.len());
        let slots = self
            .slots
            .fields
            .get(first..end)
            .ok_or(PatchError::NoField(end))?;
        if let Some(other) = slots
            .iter()
            .position(|slot| slot.fixed != Some(T::BUILTIN) || slot.array.is_some())
        {
            return Err(PatchError::Type {
                field: first + other,
                found: T::BUILTIN,
            });
        }
        for (slot, value) in slots.iter().zip(values) {
            let wire = value.wire();
            let wire = wire.as_ref();
            let at = slot.at as usize;
            if let Some(place) = self.bytes.get_mut(at..at + wire.len()) {
                place.copy_from_slice(wire);
            }
        }
        Ok(())
    }

    /// Replaces bytes of a RawData payload, `offset` bytes behind the header of the DataSetMessage.
    ///
    /// # Errors
    /// [`PatchError::Size`] when they would reach past the message.
    pub fn raw(&mut self, offset: usize, bytes: &[u8]) -> Result<(), PatchError> {
        let Range { start, end } = self.slots.raw.clone();
        let wrong = PatchError::Size {
            field: 0,
            expected: end - start,
            found: offset.saturating_add(bytes.len()),
        };
        let payload = self.bytes.get_mut(start..end).ok_or(wrong)?;
        let place = payload.get_mut(offset..).ok_or(wrong)?;
        place
            .get_mut(..bytes.len())
            .ok_or(wrong)?
            .copy_from_slice(bytes);
        Ok(())
    }

    /// Replaces the elements of an array field: as many, as on the wire, little-endian and back to back.
    ///
    /// # Errors
    /// [`PatchError::NoField`], [`PatchError::Type`], and [`PatchError::Size`] for another number of bytes.
    pub fn packed_array(
        &mut self,
        field: usize,
        element: BuiltinType,
        bytes: &[u8],
    ) -> Result<(), PatchError> {
        let slot = self
            .slots
            .fields
            .get(field)
            .ok_or(PatchError::NoField(field))?;
        let wrong = PatchError::Type {
            field,
            found: element,
        };
        let expected = slot.array.ok_or(wrong)? as usize;
        if slot.fixed != Some(element) {
            return Err(wrong);
        }
        if expected != bytes.len() {
            return Err(PatchError::Size {
                field,
                expected,
                found: bytes.len(),
            });
        }
        let at = slot.at as usize;
        if let Some(place) = self.bytes.get_mut(at..at + expected) {
            place.copy_from_slice(bytes);
        }
        Ok(())
    }
}

impl Slots {
    fn of(message: &DataSetMessage<'_>, datagram: &[u8]) -> Result<Self, DecodeError> {
        let payload_at = offset_of(message.payload(), datagram);
        let header = message.header();
        // The header's fields stand before the payload in a fixed order (OPC 10000-14, 7.2.4.5.4).
        let mut at = payload_at;
        let mut back = |present: bool, size: usize| {
            present.then(|| {
                at -= size;
                at
            })
        };
        back(header.minor_version.is_some(), 4);
        back(header.major_version.is_some(), 4);
        let status = back(header.status.is_some(), 2);
        back(header.picoseconds.is_some(), 2);
        let timestamp = back(header.timestamp.is_some(), 8);
        let sequence_number = back(header.sequence_number.is_some(), 2);
        let fields = match (message.kind, message.encoding()) {
            (MessageKind::KeyFrame, FieldEncoding::Variant) => Slot::all(message, datagram)?,
            (MessageKind::KeyFrame, FieldEncoding::RawData) | (MessageKind::KeepAlive, _) => {
                Vec::new()
            }
            _ => return Err(DecodeError::Misread("no key frame of Variants or RawData")),
        };
        let raw_len = match message.encoding() {
            FieldEncoding::RawData => message.payload().len(),
            FieldEncoding::Variant | FieldEncoding::DataValue => 0,
        };
        Ok(Self {
            sequence_number,
            timestamp,
            status,
            fields,
            raw: payload_at..payload_at + raw_len,
        })
    }
}

impl Slot {
    /// The fields of a key frame of Variants.
    fn all(message: &DataSetMessage<'_>, datagram: &[u8]) -> Result<Vec<Self>, DecodeError> {
        let base = offset_of(message.payload(), datagram);
        let payload = Reader::new(message.payload());
        let mut reader = payload;
        if reader.remaining() == 0 {
            return Ok(Vec::new());
        }
        let count = reader.u16("FieldCount")?;
        let mut slots = Vec::new();
        for _ in 0..count {
            let value_at = base + reader.since_start(&payload) + 1;
            let variant = Variant::read(&mut reader)?;
            slots.push(Self::new(value_at, &variant));
        }
        Ok(slots)
    }

    fn new(value_at: usize, variant: &Variant<'_>) -> Self {
        let fixed = variant
            .builtin_type()
            .filter(|builtin| builtin.fixed_size().is_some());
        let (skip, array) = match variant {
            Variant::Null | Variant::Scalar(_) => (0, None),
            // Behind the length.
            Variant::Array(array) => (4, u32::try_from(array.bytes().len()).ok()),
            Variant::Matrix(matrix) => (4, u32::try_from(matrix.elements().bytes().len()).ok()),
        };
        let is_array = array.is_some();
        match u32::try_from(value_at + skip) {
            Ok(at) => Self { at, array, fixed },
            // Past 4 GiB, which no datagram has.
            Err(_) => Self {
                at: 0,
                array: is_array.then_some(0),
                fixed: None,
            },
        }
    }
}

/// Position of the SequenceNumber in the group header.
fn group_sequence_number(datagram: &[u8]) -> Result<Option<usize>, DecodeError> {
    let start = Reader::new(datagram);
    let mut reader = start;
    let flags = Flags::read(&mut reader)?;
    if flags.uadp & header::PUBLISHER_ID != 0 {
        PublisherId::read(flags.extended1 & header::PUBLISHER_ID_TYPE, &mut reader)?;
    }
    if flags.extended1 & header::DATA_SET_CLASS_ID != 0 {
        reader.bytes(16, "DataSetClassId")?;
    }
    if flags.uadp & header::GROUP_HEADER == 0 {
        return Ok(None);
    }
    let group = reader.u8("GroupFlags")?;
    let before = [
        (header::WRITER_GROUP_ID, 2),
        (header::GROUP_VERSION, 4),
        (header::NETWORK_MESSAGE_NUMBER, 2),
    ];
    let before: usize = before
        .iter()
        .filter(|(bit, _)| group & bit != 0)
        .map(|(_, size)| size)
        .sum();
    let at = reader.since_start(&start) + before;
    Ok((group & header::GROUP_SEQUENCE_NUMBER != 0).then_some(at))
}

/// Where `part`, a piece of `whole`, starts in it.
fn offset_of(part: &[u8], whole: &[u8]) -> usize {
    part.as_ptr().addr().saturating_sub(whole.as_ptr().addr())
}

#[inline]
fn put<const N: usize>(
    bytes: &mut [u8],
    at: Option<usize>,
    value: [u8; N],
    what: &'static str,
) -> Result<(), PatchError> {
    let at = at.ok_or(PatchError::Absent(what))?;
    crate::writer::patch(bytes, at, value);
    Ok(())
}
