//! Reads the DataSetMessages of a payload.

use uadp::{DataSetMessage, DecodeError, FieldEncoding, MessageKind, NetworkMessage};

use crate::fault::{DecodeFault, FaultLocation, MessagePlace, PartialRead, in_field, offset};
use crate::raw_data::RawDataLayout;
use crate::values::{show_data_value, show_variant};
use crate::{decode, encode, hex, shape};

/// A DataSetMessage of a payload.
pub(crate) struct PayloadMessage<'a> {
    pub(crate) writer_id: Option<u16>,
    /// Offset of the message in the datagram.
    pub(crate) offset: usize,
    pub(crate) bytes: &'a [u8],
}

/// Splits a payload into its DataSetMessages, up to the first fault of their Sizes.
pub(crate) fn split<'a>(
    message: &NetworkMessage<'a>,
) -> (Vec<PayloadMessage<'a>>, Option<DecodeFault>) {
    let payload = message.payload();
    let start = message.payload_offset();
    let ids: Vec<_> = message.writer_ids().into_iter().flatten().collect();
    if ids.len() < 2 {
        let part = PayloadMessage {
            writer_id: ids.first().copied(),
            offset: start,
            bytes: payload,
        };
        return (vec![part], None);
    }
    let fault = |error, in_payload| DecodeFault {
        place: FaultLocation::Payload,
        error,
        offset: start + in_payload,
    };
    let cut = |field, expected, found| DecodeError::Truncated {
        field,
        expected,
        found,
    };
    let Some((sizes, mut rest)) = payload.split_at_checked(ids.len() * 2) else {
        let error = cut("Sizes", ids.len() * 2, payload.len());
        return (Vec::new(), Some(fault(error, 0)));
    };
    let mut parts = Vec::new();
    let (sizes, _) = sizes.as_chunks();
    for (id, size) in ids.into_iter().zip(sizes) {
        let size = usize::from(u16::from_le_bytes(*size));
        let at = payload.len() - rest.len();
        let Some((bytes, behind)) = rest.split_at_checked(size) else {
            let error = cut("DataSetMessage", size, rest.len());
            return (parts, Some(fault(error, at)));
        };
        parts.push(PayloadMessage {
            writer_id: Some(id),
            offset: start + at,
            bytes,
        });
        rest = behind;
    }
    let left = match rest.len() {
        0 => None,
        left => Some(fault(
            DecodeError::TrailingBytes(left),
            payload.len() - left,
        )),
    };
    (parts, left)
}

/// Reads a DataSetMessage; RawData is read with the layout. The fields before a fault are included.
pub(crate) fn read(
    part: &PayloadMessage<'_>,
    layout: Option<&RawDataLayout<'_>>,
) -> (shape::DataSetMessageJson, Option<DecodeFault>) {
    let mut shown = shape::DataSetMessageJson::default();
    let bytes = part.bytes;
    let stop = match DataSetMessage::decode(part.writer_id, bytes) {
        Ok(message) => {
            show_header(&message, &mut shown);
            let stop = read_fields(&message, layout, |field| shown.fields.push(field)).err();
            show_rest(&message, layout, stop.is_some(), &mut shown);
            if stop.is_none() {
                shown.configured_size =
                    configured_size(&message, bytes, layout, shown.fields.len());
            }
            if !message.is_valid() {
                return (show_invalid(shown, bytes, layout), None);
            }
            stop
        }
        Err(error) => Some((None, error)),
    };
    let fault = stop.map(|stop| {
        let (field, error) = stop;
        let place = MessagePlace {
            writer_id: part.writer_id,
            field,
        };
        let in_message = offset(bytes, stop, |bytes| stop_of(bytes, layout));
        DecodeFault {
            place: FaultLocation::Message(place),
            error,
            offset: part.offset + in_message,
        }
    });
    shown.malformed = fault.as_ref().map(DecodeFault::to_string);
    (shown, fault)
}

/// Returns the field and error at which reading a DataSetMessage stops.
fn stop_of(bytes: &[u8], layout: Option<&RawDataLayout<'_>>) -> Option<PartialRead> {
    match DataSetMessage::decode(None, bytes) {
        Ok(message) => read_fields(&message, layout, |_| {}).err(),
        Err(error) => Some((None, error)),
    }
}

fn show_header(message: &DataSetMessage<'_>, shown: &mut shape::DataSetMessageJson) {
    let header = message.header();
    shown.valid = header.valid;
    shown.kind = match message.kind {
        MessageKind::KeyFrame => shape::MessageKindJson::KeyFrame,
        MessageKind::DeltaFrame => shape::MessageKindJson::DeltaFrame,
        MessageKind::Event => shape::MessageKindJson::Event,
        MessageKind::KeepAlive => shape::MessageKindJson::KeepAlive,
    };
    shown.field_encoding = match message.encoding() {
        FieldEncoding::Variant => shape::FieldEncodingJson::Variant,
        FieldEncoding::RawData => shape::FieldEncodingJson::RawData,
        FieldEncoding::DataValue => shape::FieldEncodingJson::DataValue,
    };
    shown.sequence_number = header.sequence_number;
    shown.timestamp = header.timestamp.map(decode::show_timestamp);
    shown.pico_seconds = header.picoseconds;
    shown.status16 = header.status;
    shown.major_version = header.major_version;
    shown.minor_version = header.minor_version;
}

/// Adds the metadata, or the bytes of RawData fields that cannot be shown otherwise.
fn show_rest(
    message: &DataSetMessage<'_>,
    layout: Option<&RawDataLayout<'_>>,
    stopped: bool,
    shown: &mut shape::DataSetMessageJson,
) {
    let is_raw = is_raw(message);
    if is_raw && let Some(layout) = layout {
        shown.meta_data = Some(layout.metadata().to_vec());
    }
    let unknown = is_raw && layout.is_none() && !message.payload().is_empty();
    if unknown || (stopped && is_raw) {
        shown.raw_data_hex = Some(hex::text(message.payload()));
    }
}

/// Shows a message with a cleared valid bit. Its contents have no meaning, so they are shown as
/// fields only if encoding them gives the same bytes.
fn show_invalid(
    shown: shape::DataSetMessageJson,
    bytes: &[u8],
    layout: Option<&RawDataLayout<'_>>,
) -> shape::DataSetMessageJson {
    if encode::message_bytes(&shown, layout).is_ok_and(|again| again == bytes) {
        return shown;
    }
    shape::DataSetMessageJson {
        valid: false,
        message_hex: Some(hex::text(bytes)),
        ..shape::DataSetMessageJson::default()
    }
}

fn is_raw(message: &DataSetMessage<'_>) -> bool {
    message.encoding() == FieldEncoding::RawData && message.kind != MessageKind::KeepAlive
}

/// Passes the fields to `each`.
fn read_fields(
    message: &DataSetMessage<'_>,
    layout: Option<&RawDataLayout<'_>>,
    mut each: impl FnMut(shape::FieldJson),
) -> Result<(), PartialRead> {
    if is_raw(message) {
        return match layout {
            Some(layout) => layout.read(message.payload(), each),
            None => Ok(()),
        };
    }
    let values = message.values().map_err(|error| (None, error))?;
    let is_delta = message.kind == MessageKind::DeltaFrame;
    let is_data_value = message.encoding() == FieldEncoding::DataValue;
    for (value, at) in values.zip(0..) {
        let shown = value.and_then(|field| {
            let value = match (is_data_value, &field.value.value) {
                (false, Some(variant)) => show_variant(variant)?,
                _ => show_data_value(&field.value)?,
            };
            Ok(shape::FieldJson {
                index: is_delta.then_some(field.index),
                value,
            })
        });
        each(shown.map_err(|error| in_field(at, error))?);
    }
    Ok(())
}

/// Returns the size to which the message is padded with zeros, if it is padded.
fn configured_size(
    message: &DataSetMessage<'_>,
    bytes: &[u8],
    layout: Option<&RawDataLayout<'_>>,
    fields: usize,
) -> Option<u16> {
    let field_count = match message.kind {
        MessageKind::KeyFrame | MessageKind::DeltaFrame | MessageKind::Event
            if !is_raw(message) =>
        {
            2
        }
        MessageKind::KeyFrame
        | MessageKind::DeltaFrame
        | MessageKind::Event
        | MessageKind::KeepAlive => 0,
    };
    let zeros = bytes.iter().rev().take_while(|byte| **byte == 0).count();
    let least = bytes.len() - message.payload().len() + field_count;
    if zeros == 0 || (is_raw(message) && layout.is_none()) {
        return None;
    }
    let complete = |end: usize| {
        let Some(Ok(message)) = bytes
            .get(..end)
            .map(|bytes| DataSetMessage::decode(None, bytes))
        else {
            return false;
        };
        let mut read = 0;
        read_fields(&message, layout, |_| read += 1).is_ok() && read == fields
    };
    // The search finds the shortest prefix that holds all fields; the bytes after it are zeros.
    let (mut end, mut short) = (bytes.len(), least.max(bytes.len() - zeros));
    while short < end {
        let middle = short + (end - short) / 2;
        if complete(middle) {
            end = middle
        } else {
            short = middle + 1
        }
    }
    if end < bytes.len() {
        u16::try_from(bytes.len()).ok()
    } else {
        None
    }
}
