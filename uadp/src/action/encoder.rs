//! Writing requests and responses.

use super::{ActionDialect, ActionEncoding, ActionFields, ActionHeader, ActionState};
use crate::encoder::{self, NetworkMessageEncoder};
use crate::field_encoder::FieldEncoder;
use crate::{DataSetHeader, EncodeError, Extras, NetworkHeader, Seal, data_set_message as message};

/// Appends one NetworkMessage of requests or responses to a buffer (OPC 10000-14, 7.2.4.5.9 and 7.2.4.5.10).
///
/// As with [`NetworkMessageEncoder`] the flags follow from what the headers hold, and after an error the buffer holds
/// an unfinished message.
#[derive(Debug)]
#[must_use = "a message is complete with `finish`"]
pub struct ActionEncoder<'b> {
    message: NetworkMessageEncoder<'b>,
    dialect: ActionDialect,
    /// DataSetMessage type in DataSetFlags2.
    kind: u8,
}

/// How a NetworkMessage of Actions begins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActionStart<'a> {
    /// The PublisherId in it is the Responder's.
    pub network: NetworkHeader<'a>,
    /// What belongs to all messages.
    pub action: ActionHeader<'a>,
    /// How they are laid out.
    pub dialect: ActionDialect,
    /// The headers few messages have, the SecurityHeader among them.
    pub extras: Extras<'a>,
}

/// What a request or response says of itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ActionCall {
    /// What the Action is called on.
    pub target_id: u16,
    /// Tells the requests of one RequestorId and CorrelationData apart.
    pub request_id: u16,
    /// The state wanted, or the one there is.
    pub state: ActionState,
}

impl<'b> ActionEncoder<'b> {
    /// Appends the headers to `buf`. `writer_ids` are the Responder's DataSetWriters, one message each.
    ///
    /// # Errors
    /// [`EncodeError::MessageCount`] when `writer_ids` is empty, or more than one where the dialect has but one;
    /// [`EncodeError::Misplaced`] without a PublisherId; [`EncodeError::TooBig`] as
    /// [`NetworkMessageEncoder::with`] and for what is longer than its length in the ActionHeader can say.
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

    /// Opens a request or response of Variants. One left without [`FieldEncoder::finish`] is taken back by the next
    /// call.
    ///
    /// # Errors
    /// [`EncodeError::MessageCount`] when all announced messages are written, [`EncodeError::Misplaced`] where the
    /// dialect has RawData, and for header fields where it has no DataSetMessage header.
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

    /// Appends a request or response of RawData: `count` fields, which `write` appends, for instance with
    /// [`RawLayout::write`](crate::RawLayout::write).
    ///
    /// # Errors
    /// As for [`variants`](Self::variants) the other way round, and what `write` gives.
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

    /// Appends a request or response whose fields were encoded before.
    ///
    /// # Errors
    /// As for [`variants`](Self::variants) and [`raw_data`](Self::raw_data); [`EncodeError::Misplaced`] also for RawData
    /// without the FieldCount that the dialect has, and for Variants shorter than theirs.
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

    /// As [`NetworkMessageEncoder::configured_size`].
    pub fn configured_size(&mut self, size: u16) {
        self.message.configured_size(size);
    }

    /// Position in the buffer of the payload, which starts with the ActionHeader.
    #[must_use]
    pub const fn payload_offset(&self) -> usize {
        self.message.payload_offset()
    }

    /// Ends the NetworkMessage.
    ///
    /// # Errors
    /// As [`NetworkMessageEncoder::finish`].
    pub fn finish(self) -> Result<(), EncodeError> {
        self.message.finish()
    }

    /// Ends the NetworkMessage with a SecurityFooter.
    ///
    /// # Errors
    /// As [`NetworkMessageEncoder::finish_with_footer`].
    pub fn finish_with_footer(self, footer: &[u8]) -> Result<(), EncodeError> {
        self.message.finish_with_footer(footer)
    }

    /// Ends a NetworkMessage that was begun with the [`header`](Seal::header) of this seal: encrypts it from the
    /// ActionHeader on and appends the signature.
    ///
    /// # Errors
    /// As [`NetworkMessageEncoder::finish_sealed`].
    pub fn finish_sealed(self, seal: Seal<'_>) -> Result<(), EncodeError> {
        self.message.finish_sealed(seal)
    }

    /// Appends what stands in front of the fields, FieldCount excluded.
    fn begin(
        &mut self,
        header: &DataSetHeader,
        call: ActionCall,
        encoding: ActionEncoding,
    ) -> Result<encoder::Offsets, EncodeError> {
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
                encoder::Offsets::default()
            }
        };
        buf.extend_from_slice(&call.target_id.to_le_bytes());
        buf.extend_from_slice(&call.request_id.to_le_bytes());
        buf.push(call.state.byte());
        Ok(offsets)
    }
}
