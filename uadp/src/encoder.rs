//! Encodes a NetworkMessage: first the headers, then the DataSetMessages, in a single pass.

use crate::action::ActionHeader;
use crate::data_set_message as message;
use crate::field_encoder::{DataValueEncoder, DeltaEncoder, FieldEncoder};
use crate::header_writer::{self, Extras, MessageForm, PayloadHeader};
use crate::writer::flag;
use crate::{DataSetHeader, EncodeError, NetworkHeader, NetworkMessageType, Seal, writer};
use alloc::vec::Vec;

/// Appends a NetworkMessage to a buffer (OPC 10000-14, 7.2.4.4.2).
///
/// The flags follow from the fields that are set in the headers. After an error the buffer holds an
/// incomplete message.
#[derive(Debug)]
#[must_use = "a message is complete with `finish`"]
pub struct NetworkMessageEncoder<'b> {
    pub(crate) buf: &'b mut Vec<u8>,
    pub(crate) progress: PayloadProgress,
    timestamp_at: Option<usize>,
    /// Offsets of the NetworkMessage and of its payload in the buffer.
    start: usize,
    payload_at: usize,
    /// The SecurityHeader announces a signature.
    sealed: bool,
    /// Bytes of the announced SecurityFooter.
    footer_size: usize,
    payload_header: bool,
}

/// Progress of the payload.
#[derive(Debug)]
pub(crate) struct PayloadProgress {
    /// Number of DataSetMessages that the payload header announces.
    announced: usize,
    written: usize,
    /// Offset of the Sizes; `None` for a single message.
    sizes_at: Option<usize>,
    /// End of the last finished DataSetMessage.
    end: usize,
    /// Fixed size of every DataSetMessage in bytes, 0 for variable sizes.
    configured_size: usize,
}

impl PayloadProgress {
    /// Counts the DataSetMessage at the end of the buffer and patches its size.
    #[inline]
    pub(crate) fn message_finished(&mut self, buf: &mut Vec<u8>) -> Result<(), EncodeError> {
        if self.configured_size != 0 {
            self.fit(buf);
        }
        if let Some(sizes_at) = self.sizes_at {
            let len = buf.len() - self.end;
            let size = u16::try_from(len).map_err(|_| EncodeError::TooBig {
                what: "DataSetMessage",
                len,
            })?;
            writer::patch(buf, sizes_at + self.written * 2, size.to_le_bytes());
        }
        self.written += 1;
        self.end = buf.len();
        Ok(())
    }

    /// Resizes the DataSetMessage at the end of the buffer to its ConfiguredSize.
    #[cold]
    fn fit(&self, buf: &mut Vec<u8>) {
        let end = self.end + self.configured_size;
        if buf.len() > end {
            // A message that is too long becomes zeros: its valid bit is cleared, so its content is
            // meaningless.
            buf.truncate(self.end);
        }
        buf.resize(end, 0);
    }
}

impl<'b> NetworkMessageEncoder<'b> {
    /// Appends the headers to `buf`. The payload header holds `writer_ids`, one per DataSetMessage.
    /// With `None` there is no payload header and exactly a single DataSetMessage.
    ///
    /// # Errors
    /// [`EncodeError::MessageCount`] if `writer_ids` is empty; [`EncodeError::TooBig`] if it has
    /// more than 255 ids, or if the PublisherId exceeds the maximum length of a String.
    #[inline]
    pub fn new(
        buf: &'b mut Vec<u8>,
        header: &NetworkHeader<'_>,
        writer_ids: Option<&[u16]>,
    ) -> Result<Self, EncodeError> {
        Self::with(buf, header, writer_ids, &Extras::default())
    }

    /// Appends the headers as [`new`](Self::new), with rarely used headers.
    ///
    /// # Errors
    /// As [`new`](Self::new), and [`EncodeError::TooBig`] for PromotedFields of more than 65535
    /// bytes or a nonce of more than 255 bytes.
    #[inline]
    pub fn with(
        buf: &'b mut Vec<u8>,
        header: &NetworkHeader<'_>,
        writer_ids: Option<&[u16]>,
        extras: &Extras<'_>,
    ) -> Result<Self, EncodeError> {
        Self::with_action(buf, header, writer_ids, extras, None)
    }

    /// Appends the headers as [`with`](Self::with), and an ActionHeader at the start of the payload
    /// if given.
    #[inline]
    pub(crate) fn with_action(
        buf: &'b mut Vec<u8>,
        header: &NetworkHeader<'_>,
        writer_ids: Option<&[u16]>,
        extras: &Extras<'_>,
        action: Option<&ActionHeader<'_>>,
    ) -> Result<Self, EncodeError> {
        let start = buf.len();
        let ids = writer_ids.map_or(PayloadHeader::None, PayloadHeader::Count);
        let timestamp_at = header_writer::write(
            buf,
            header,
            ids,
            MessageForm {
                message_type: NetworkMessageType::DataSet,
                chunk: false,
                action: action.is_some(),
                extras,
            },
        )?;
        let payload_at = buf.len();
        if let Some(action) = action {
            action.write(buf)?;
        }
        let announced = writer_ids.map_or(1, <[u16]>::len);
        let sizes_at = (announced > 1).then(|| {
            let sizes_at = buf.len();
            buf.resize(sizes_at + announced * 2, 0);
            sizes_at
        });
        let progress = PayloadProgress {
            announced,
            written: 0,
            sizes_at,
            end: buf.len(),
            configured_size: 0,
        };
        Ok(Self {
            buf,
            progress,
            timestamp_at,
            start,
            payload_at,
            sealed: extras
                .security
                .is_some_and(|security| security.is_secured()),
            footer_size: extras
                .security
                .and_then(|security| security.footer_size)
                .unwrap_or_default()
                .into(),
            payload_header: writer_ids.is_some(),
        })
    }

    /// Sets the number of DataSetMessages without payload header. Receivers find them by
    /// DataSetOffset (OPC 10000-14, 6.3.1.3.5), so each should have a
    /// [`configured_size`](Self::configured_size).
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] with a payload header.
    pub const fn fixed_layout(mut self, count: usize) -> Result<Self, EncodeError> {
        if self.payload_header {
            return Err(EncodeError::Misplaced("a payload header in a fixed layout"));
        }
        self.progress.announced = count;
        Ok(self)
    }

    /// Pads every following DataSetMessage with zeros to `size` bytes. A longer message becomes an
    /// invalid message of that size (ConfiguredSize: OPC 10000-14, 6.3.1.3.3). 0 disables the
    /// padding.
    pub fn configured_size(&mut self, size: u16) {
        self.progress.configured_size = size.into();
    }

    /// Starts a key frame of Variants. A key frame without [`FieldEncoder::finish`] is removed by
    /// the next call. Without fields it is a heartbeat with a FieldCount. This is not the form of
    /// the standard ([`heartbeat`](Self::heartbeat)), but the form that peers support.
    ///
    /// # Errors
    /// [`EncodeError::MessageCount`] if all announced messages are written.
    #[inline]
    pub fn key_frame(&mut self, header: &DataSetHeader) -> Result<FieldEncoder<'_>, EncodeError> {
        self.counted(header, message::KIND_KEY_FRAME, 0)
    }

    /// Starts an event (OPC 10000-14, 7.2.4.5.7).
    ///
    /// # Errors
    /// As for [`key_frame`](Self::key_frame).
    pub fn event(&mut self, header: &DataSetHeader) -> Result<FieldEncoder<'_>, EncodeError> {
        self.counted(header, message::KIND_EVENT, 0)
    }

    /// Starts a delta frame of Variants (OPC 10000-14, 7.2.4.5.6).
    ///
    /// # Errors
    /// As for [`key_frame`](Self::key_frame).
    pub fn delta_frame(&mut self, header: &DataSetHeader) -> Result<DeltaEncoder<'_>, EncodeError> {
        let fields = self.counted(header, message::KIND_DELTA_FRAME, 0)?;
        Ok(DeltaEncoder::new(fields))
    }

    /// Starts a key frame of DataValues.
    ///
    /// # Errors
    /// As for [`key_frame`](Self::key_frame).
    pub fn data_values(
        &mut self,
        header: &DataSetHeader,
    ) -> Result<DataValueEncoder<'_>, EncodeError> {
        let encoding = message::DATA_VALUE_FIELDS;
        let fields = self.counted(header, message::KIND_KEY_FRAME, encoding)?;
        Ok(DataValueEncoder::new(fields, false))
    }

    /// Starts a delta frame of DataValues.
    ///
    /// # Errors
    /// As for [`key_frame`](Self::key_frame).
    pub fn delta_data_values(
        &mut self,
        header: &DataSetHeader,
    ) -> Result<DataValueEncoder<'_>, EncodeError> {
        let encoding = message::DATA_VALUE_FIELDS;
        let fields = self.counted(header, message::KIND_DELTA_FRAME, encoding)?;
        Ok(DataValueEncoder::new(fields, true))
    }

    /// Appends a key frame of RawData. `write` appends the fields, for example with
    /// [`RawLayout::write`](crate::RawLayout::write).
    ///
    /// # Errors
    /// As for [`key_frame`](Self::key_frame), and the errors of `write`.
    pub fn raw_key_frame(
        &mut self,
        header: &DataSetHeader,
        write: impl FnOnce(&mut Vec<u8>) -> Result<(), EncodeError>,
    ) -> Result<(), EncodeError> {
        self.raw_or_bare(header, message::RAW_FIELDS, write)
    }

    /// Appends a heartbeat: the header of a key frame without fields (OPC 10000-14, 7.2.4.5.5). The
    /// tested peers, open62541 1.5 and asyncua 2.1, cannot decode it.
    ///
    /// # Errors
    /// As for [`key_frame`](Self::key_frame).
    pub fn heartbeat(&mut self, header: &DataSetHeader) -> Result<(), EncodeError> {
        self.raw_or_bare(header, 0, |_| Ok(()))
    }

    /// Appends a keep-alive. Its sequence number is the number of the next message (OPC 10000-14,
    /// 7.2.4.5.8).
    ///
    /// # Errors
    /// [`EncodeError::MessageCount`] if all announced messages are written.
    pub fn keep_alive(&mut self, header: &DataSetHeader) -> Result<(), EncodeError> {
        self.begin_message()?;
        write_data_set_header(self.buf, header, message::KIND_KEEP_ALIVE, 0, false);
        self.progress.message_finished(self.buf)
    }

    /// Appends an encoded DataSetMessage of another NetworkMessage.
    ///
    /// # Errors
    /// [`EncodeError::MessageCount`] if all announced messages are written; [`EncodeError::TooBig`]
    /// if there are several messages and this message has more than 65535 bytes.
    pub fn encoded(&mut self, message: &[u8]) -> Result<(), EncodeError> {
        self.begin_message()?;
        self.buf.extend_from_slice(message);
        self.progress.message_finished(self.buf)
    }

    /// Appends a key frame without FieldCount.
    fn raw_or_bare(
        &mut self,
        header: &DataSetHeader,
        encoding: u8,
        write: impl FnOnce(&mut Vec<u8>) -> Result<(), EncodeError>,
    ) -> Result<(), EncodeError> {
        self.begin_message()?;
        write_data_set_header(self.buf, header, message::KIND_KEY_FRAME, encoding, false);
        write(self.buf)?;
        self.progress.message_finished(self.buf)
    }

    /// Starts a message with a FieldCount.
    #[inline]
    fn counted(
        &mut self,
        header: &DataSetHeader,
        kind: u8,
        encoding: u8,
    ) -> Result<FieldEncoder<'_>, EncodeError> {
        self.begin_message()?;
        let offsets = write_data_set_header(self.buf, header, kind, encoding, true);
        Ok(FieldEncoder::new(self.buf, &mut self.progress, offsets))
    }

    /// Finishes the NetworkMessage.
    ///
    /// # Errors
    /// [`EncodeError::MessageCount`] if an announced message was not written.
    /// [`EncodeError::Misplaced`] if the SecurityHeader announces a footer, or a signature, which
    /// requires [`finish_sealed`](Self::finish_sealed).
    #[inline]
    pub fn finish(self) -> Result<(), EncodeError> {
        self.finish_with_footer(&[])
    }

    /// Finishes the NetworkMessage with a SecurityFooter.
    ///
    /// # Errors
    /// As for [`finish`](Self::finish), and [`EncodeError::Misplaced`] if the length of the footer
    /// differs from the SecurityHeader.
    #[inline]
    pub fn finish_with_footer(self, footer: &[u8]) -> Result<(), EncodeError> {
        if self.sealed {
            return Err(EncodeError::Misplaced("a secured message left unsealed"));
        }
        if self.footer_size != footer.len() {
            return Err(EncodeError::Misplaced(
                "the size of the SecurityFooter differs from the SecurityHeader",
            ));
        }
        self.check_finished()?;
        self.buf.extend_from_slice(footer);
        Ok(())
    }

    /// Finishes a NetworkMessage that was started with the [`header`](Seal::header) of this seal:
    /// encrypts the payload and appends the signature (OPC 10000-14, 7.2.4.4.3).
    ///
    /// # Errors
    /// As [`finish`](Self::finish); [`EncodeError::Misplaced`] if the SecurityHeader does not
    /// belong to the seal.
    pub fn finish_sealed(self, seal: Seal<'_>) -> Result<(), EncodeError> {
        self.check_finished()?;
        if !self.sealed {
            return Err(EncodeError::Misplaced("a seal without SecurityHeader"));
        }
        seal.finish(self.buf, self.start, self.payload_at)
    }

    #[inline]
    const fn check_finished(&self) -> Result<(), EncodeError> {
        let PayloadProgress {
            announced,
            written,
            end,
            ..
        } = self.progress;
        if announced != written || end != self.buf.len() {
            return Err(EncodeError::MessageCount { announced, written });
        }
        Ok(())
    }

    /// Returns the offset of the payload in the buffer. The payload starts with the ActionHeader if
    /// present, otherwise with the Sizes of several DataSetMessages, otherwise with the
    /// DataSetMessage.
    #[must_use]
    pub const fn payload_offset(&self) -> usize {
        self.payload_at
    }

    /// Returns the offset of the Timestamp (Int64) of the NetworkMessage in the buffer, to patch it
    /// before sending.
    #[must_use]
    pub const fn timestamp_offset(&self) -> Option<usize> {
        self.timestamp_at
    }

    #[inline]
    pub(crate) fn begin_message(&mut self) -> Result<(), EncodeError> {
        let PayloadProgress {
            announced,
            written,
            end,
            ..
        } = self.progress;
        if written == announced {
            return Err(EncodeError::MessageCount {
                announced,
                written: written + 1,
            });
        }
        self.buf.truncate(end);
        Ok(())
    }
}

/// Offsets in the buffer of header fields that are patched when a message is sent again.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct HeaderOffsets {
    pub(crate) sequence_number: Option<usize>,
    pub(crate) timestamp: Option<usize>,
}

/// Appends the header of a DataSetMessage and, if `counted`, space for the FieldCount.
#[inline]
pub(crate) fn write_data_set_header(
    buf: &mut Vec<u8>,
    header: &DataSetHeader,
    kind: u8,
    encoding: u8,
    counted: bool,
) -> HeaderOffsets {
    let flags2 = kind
        | flag(header.timestamp.is_some(), message::TIMESTAMP)
        | flag(header.picoseconds.is_some(), message::PICOSECONDS);
    let flags1 = encoding
        | flag(header.valid, message::VALID)
        | flag(header.sequence_number.is_some(), message::SEQUENCE_NUMBER)
        | flag(header.status.is_some(), message::STATUS)
        | flag(header.major_version.is_some(), message::MAJOR_VERSION)
        | flag(header.minor_version.is_some(), message::MINOR_VERSION)
        | flag(flags2 != 0, message::FLAGS2);
    let start = buf.len();
    writer::with_room::<32, _>(buf, |fixed| {
        fixed.put([flags1]);
        if flags2 != 0 {
            fixed.put([flags2]);
        }
        let sequence_number = header.sequence_number.map(|number| {
            let at = start + fixed.len();
            fixed.put(number.to_le_bytes());
            at
        });
        let timestamp = header.timestamp.map(|time| {
            let at = start + fixed.len();
            fixed.put(time.0.to_le_bytes());
            at
        });
        if let Some(picoseconds) = header.picoseconds {
            fixed.put(picoseconds.to_le_bytes());
        }
        if let Some(status) = header.status {
            fixed.put(status.to_le_bytes());
        }
        if let Some(version) = header.major_version {
            fixed.put(version.to_le_bytes());
        }
        if let Some(version) = header.minor_version {
            fixed.put(version.to_le_bytes());
        }
        if counted {
            fixed.put([0; 2]);
        }
        HeaderOffsets {
            sequence_number,
            timestamp,
        }
    })
    .unwrap_or_default()
}
