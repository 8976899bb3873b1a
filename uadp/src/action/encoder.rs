//! Encodes requests and responses.

use super::{ActionDialect, ActionEncoding, ActionFields, ActionHeader, ActionState};
use crate::encoder::{self, NetworkMessageEncoder};
use crate::field_encoder::FieldEncoder;
use crate::{DataSetHeader, EncodeError, Extras, NetworkHeader, Seal, data_set_message as message};
use alloc::vec::Vec;

/// Appends one NetworkMessage of requests or responses to a buffer (OPC 10000-14, 7.2.4.5.9 and
/// 7.2.4.5.10).
///
/// As with [`NetworkMessageEncoder`], the flags follow from the fields that are set in the headers.
/// After an error the buffer holds an incomplete message.
#[derive(Debug)]
#[must_use = "a message is complete with `finish`"]
pub struct ActionEncoder<'b> {
    message: NetworkMessageEncoder<'b>,
    dialect: ActionDialect,
    /// DataSetMessage type in DataSetFlags2.
    kind: u8,
}

/// Headers of a NetworkMessage of requests or responses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActionStart<'a> {
    /// NetworkMessage header, with the PublisherId of the Responder.
    pub network: NetworkHeader<'a>,
    /// ActionHeader, shared by all messages.
    pub action: ActionHeader<'a>,
    /// Layout of the messages.
    pub dialect: ActionDialect,
    /// Rarely used headers, such as the SecurityHeader.
    pub extras: Extras<'a>,
}

/// Target, id and state of a request or response.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ActionCall {
    /// Target that the Action is called on.
    pub target_id: u16,
    /// Distinguishes requests with the same RequestorId and CorrelationData.
    pub request_id: u16,
    /// Requested state in a request, current state in a response.
    pub state: ActionState,
}

impl<'b> ActionEncoder<'b> {
    /// Appends the headers to `buf`. `writer_ids` are the Responder's DataSetWriters, one per
    /// message.
    ///
    /// # Errors
    /// - [`EncodeError::MessageCount`] if `writer_ids` is empty, or has several ids in a dialect
    ///   with a single message per NetworkMessage.
    /// - [`EncodeError::Misplaced`] without a PublisherId.
    /// - [`EncodeError::TooBig`] as for [`NetworkMessageEncoder::with`], and for ActionHeader
    ///   fields that exceed their length field.
    pub fn new(
        buf: &'b mut Vec<u8>,
        start: &ActionStart<'_>,
        writer_ids: &[u16],
    ) -> Result<Self, EncodeError> {
        let ActionStart {
            network,
            action,
            dialect,
            extras,
        } = start;
        if network.publisher_id.is_none() {
            return Err(EncodeError::Misplaced(
                "an Action message without PublisherId",
            ));
        }
        if matches!(dialect, ActionDialect::UaNetStandard(_)) && writer_ids.len() > 1 {
            return Err(EncodeError::MessageCount {
                announced: writer_ids.len(),
                written: 1,
            });
        }
        let message = NetworkMessageEncoder::with_action(
            buf,
            network,
            Some(writer_ids),
            extras,
            Some(action),
        )?;
        Ok(Self {
            message,
            dialect: *dialect,
            kind: action.kind.data_set_message_type(),
        })
    }

    /// Starts a request or response of Variants. A message without [`FieldEncoder::finish`] is
    /// removed by the next call.
    ///
    /// # Errors
    /// - [`EncodeError::MessageCount`] if all announced messages are written.
    /// - [`EncodeError::Misplaced`] if the dialect uses RawData, or if header fields are set and
    ///   the dialect has no DataSetMessage header.
    pub fn variants(
        &mut self,
        header: &DataSetHeader,
        call: ActionCall,
    ) -> Result<FieldEncoder<'_>, EncodeError> {
        let offsets = self.begin(header, call, ActionEncoding::Variant)?;
        let NetworkMessageEncoder { buf, progress, .. } = &mut self.message;
        buf.extend_from_slice(&[0; 2]);
        Ok(FieldEncoder::new(buf, progress, offsets))
    }

    /// Appends a request or response of RawData with `count` fields. `write` appends the fields,
    /// for example with [`RawLayout::write`](crate::RawLayout::write).
    ///
    /// # Errors
    /// As for [`variants`](Self::variants) with the encodings swapped, and the errors of `write`.
    pub fn raw_data(
        &mut self,
        header: &DataSetHeader,
        call: ActionCall,
        count: u16,
        write: impl FnOnce(&mut Vec<u8>) -> Result<(), EncodeError>,
    ) -> Result<(), EncodeError> {
        self.begin(header, call, ActionEncoding::RawData)?;
        let NetworkMessageEncoder { buf, progress, .. } = &mut self.message;
        if self.dialect == ActionDialect::Standard {
            buf.extend_from_slice(&count.to_le_bytes());
        }
        write(buf)?;
        progress.message_finished(buf)
    }

    /// Appends a request or response with encoded fields.
    ///
    /// # Errors
    /// As for [`variants`](Self::variants) and [`raw_data`](Self::raw_data). Also
    /// [`EncodeError::Misplaced`] for RawData without the FieldCount that the dialect requires, and
    /// for Variants shorter than their FieldCount.
    pub fn fields(
        &mut self,
        header: &DataSetHeader,
        call: ActionCall,
        fields: ActionFields<'_>,
    ) -> Result<(), EncodeError> {
        match fields {
            ActionFields::Variants(block) => {
                let mut encoder = self.variants(header, call)?;
                encoder.fields_block(block)?;
                encoder.finish()
            }
            ActionFields::RawData { count, payload } => {
                if count.is_none() && self.dialect == ActionDialect::Standard {
                    return Err(EncodeError::Misplaced("RawData without a FieldCount"));
                }
                self.raw_data(header, call, count.unwrap_or_default(), |buf| {
                    buf.extend_from_slice(payload);
                    Ok(())
                })
            }
        }
    }

    /// Sets the configured size, as [`NetworkMessageEncoder::configured_size`].
    pub fn configured_size(&mut self, size: u16) {
        self.message.configured_size(size);
    }

    /// Returns the position of the payload in the buffer. The payload starts with the ActionHeader.
    #[must_use]
    pub const fn payload_offset(&self) -> usize {
        self.message.payload_offset()
    }

    /// Finishes the NetworkMessage.
    ///
    /// # Errors
    /// As [`NetworkMessageEncoder::finish`].
    pub fn finish(self) -> Result<(), EncodeError> {
        self.message.finish()
    }

    /// Finishes the NetworkMessage with a SecurityFooter.
    ///
    /// # Errors
    /// As [`NetworkMessageEncoder::finish_with_footer`].
    pub fn finish_with_footer(self, footer: &[u8]) -> Result<(), EncodeError> {
        self.message.finish_with_footer(footer)
    }

    /// Finishes a NetworkMessage that was started with the [`header`](Seal::header) of this seal:
    /// encrypts it from the ActionHeader on and appends the signature.
    ///
    /// # Errors
    /// As [`NetworkMessageEncoder::finish_sealed`].
    pub fn finish_sealed(self, seal: Seal<'_>) -> Result<(), EncodeError> {
        self.message.finish_sealed(seal)
    }

    /// Appends the bytes before the fields, without the FieldCount.
    fn begin(
        &mut self,
        header: &DataSetHeader,
        call: ActionCall,
        encoding: ActionEncoding,
    ) -> Result<encoder::HeaderOffsets, EncodeError> {
        self.message.begin_message()?;
        let buf = &mut *self.message.buf;
        let offsets = match self.dialect {
            ActionDialect::Standard if !header.valid => {
                return Err(EncodeError::Misplaced("an Action marked as invalid"));
            }
            ActionDialect::Standard => {
                let encoding = match encoding {
                    ActionEncoding::Variant => 0,
                    ActionEncoding::RawData => message::RAW_FIELDS,
                };
                encoder::write_data_set_header(buf, header, self.kind, encoding, false)
            }
            ActionDialect::UaNetStandard(known) => {
                if known != encoding {
                    return Err(EncodeError::Misplaced(
                        "another field encoding than the peer is set to",
                    ));
                }
                if *header != DataSetHeader::default() {
                    return Err(EncodeError::Misplaced(
                        "DataSetMessage header fields where the dialect has none",
                    ));
                }
                encoder::HeaderOffsets::default()
            }
        };
        buf.extend_from_slice(&call.target_id.to_le_bytes());
        buf.extend_from_slice(&call.request_id.to_le_bytes());
        buf.push(call.state.byte());
        Ok(offsets)
    }
}
