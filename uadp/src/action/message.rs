//! Decodes requests and responses.

use super::{ActionCall, ActionHeader, ActionKind};
use crate::data_set_message::{self as message, Head};
use crate::reader::ByteReader;
use crate::{DataSetHeader, DecodeError, Fields, NetworkHeader, PublisherId};

/// Layout of Actions on the wire. Requestor and Responder have to use the same dialect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ActionDialect {
    /// Layout of OPC 10000-14. A request or response is a DataSetMessage with a header (7.2.4.5.4)
    /// of type 5 or 6 that contains the field encoding. A FieldCount precedes the fields in both
    /// encodings (7.2.4.5.9). A NetworkMessage can hold several requests or responses.
    #[default]
    Standard,
    /// Layout of UA-.NETStandard 2.0:
    ///
    /// - There is no DataSetMessage header, so there is no Status, and both sides have to know the
    ///   field encoding.
    /// - RawData has no FieldCount.
    /// - A NetworkMessage holds a single request or response.
    /// - There is no repetition and no acknowledgement: a request is sent once and executed each
    ///   time it is received.
    UaNetStandard(ActionEncoding),
}

/// Encoding of the fields of a request or response. DataValues are not allowed (OPC 10000-14,
/// 7.2.4.5.9 and 7.2.4.5.10).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ActionEncoding {
    /// Each field carries its type.
    #[default]
    Variant,
    /// Fields without types, decoded with the ActionMetaData (OPC 10000-14, 7.2.4.5.11).
    RawData,
}

/// State of an execution of an Action: the requested state in a request, the current state in a
/// response (OPC 10000-14, 6.2.11.2.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ActionState {
    /// Nothing is executed, and a previous execution is forgotten.
    Idle,
    /// In progress.
    Executing,
    /// Finished; the fields are the results.
    Done,
}

/// Encoded fields of a request or response.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ActionFields<'a> {
    /// FieldCount and that many Variants, the input of [`Fields::parse`].
    Variants(&'a [u8]),
    /// Values without types, the input of [`RawLayout::read`](crate::RawLayout::read).
    RawData {
        /// FieldCount; `None` in a dialect without it.
        count: Option<u16>,
        /// Encoded values.
        payload: &'a [u8],
    },
}

/// Iterator over the requests or responses of a NetworkMessage, in the order of the
/// DataSetWriterIds.
///
/// A malformed message among several is returned as an `Err`, and the iteration continues with the
/// next message. The iteration ends with an `Err` if a size exceeds the datagram or if bytes are
/// left after the last message.
#[derive(Debug, Clone)]
pub struct Actions<'a> {
    of: Of<'a>,
    writer_ids: &'a [[u8; 2]],
    /// `None` for a single message, which spans the whole payload.
    sizes: Option<&'a [[u8; 2]]>,
    payload: ByteReader<'a>,
}

/// A request or response, with the headers of its NetworkMessage (OPC 10000-14, 7.2.4.5.9 and
/// 7.2.4.5.10).
#[derive(Debug, Clone, Copy)]
pub struct ActionMessage<'a> {
    /// PublisherId of the Responder, also in requests.
    pub publisher_id: PublisherId<'a>,
    /// WriterGroup of the Responder, if present.
    pub writer_group_id: Option<u16>,
    /// DataSetWriter of the Responder.
    pub writer_id: u16,
    /// ActionHeader, shared by all messages of the NetworkMessage.
    pub action: ActionHeader<'a>,
    /// Target that the Action is called on, from its ActionMetaData.
    pub target_id: u16,
    /// Distinguishes requests with the same RequestorId and CorrelationData.
    pub request_id: u16,
    /// Requested state in a request, current state in a response.
    pub state: ActionState,
    /// Encoded fields.
    pub fields: ActionFields<'a>,
    /// Layout of the message.
    pub dialect: ActionDialect,
    head: Option<Head<'a>>,
}

/// Headers shared by the messages of a NetworkMessage.
#[derive(Debug, Clone, Copy)]
struct Of<'a> {
    publisher_id: PublisherId<'a>,
    writer_group_id: Option<u16>,
    action: ActionHeader<'a>,
    dialect: ActionDialect,
}

impl ActionState {
    pub(crate) const fn byte(self) -> u8 {
        match self {
            Self::Idle => IDLE,
            Self::Executing => EXECUTING,
            Self::Done => DONE,
        }
    }

    fn read(reader: &mut ByteReader<'_>) -> Result<Self, DecodeError> {
        match reader.u8("ActionState")? {
            IDLE => Ok(Self::Idle),
            EXECUTING => Ok(Self::Executing),
            DONE => Ok(Self::Done),
            value => Err(DecodeError::Reserved {
                field: "ActionState",
                value: value.into(),
            }),
        }
    }
}

impl<'a> ActionFields<'a> {
    /// No fields.
    pub const NONE: Self = Self::Variants(&[0, 0]);

    /// Returns the encoded fields, with the FieldCount for Variants.
    #[must_use]
    pub const fn bytes(&self) -> &'a [u8] {
        match self {
            Self::Variants(bytes) | Self::RawData { payload: bytes, .. } => bytes,
        }
    }

    /// Returns an iterator over the Variants.
    ///
    /// # Errors
    /// [`DecodeError::Misread`] for RawData; otherwise as [`Fields::parse`].
    pub fn variants(&self) -> Result<Fields<'a>, DecodeError> {
        match self {
            Self::Variants(block) => Fields::parse(block),
            Self::RawData { .. } => Err(DecodeError::Misread(
                "encoded as RawData, to be read with its ActionMetaData",
            )),
        }
    }

    fn read(
        encoding: ActionEncoding,
        counted: bool,
        reader: &mut ByteReader<'a>,
    ) -> Result<Self, DecodeError> {
        match encoding {
            ActionEncoding::Variant => {
                let block = reader.take_rest();
                Fields::parse(block)?;
                Ok(Self::Variants(block))
            }
            ActionEncoding::RawData => Ok(Self::RawData {
                count: if counted {
                    Some(reader.u16("FieldCount")?)
                } else {
                    None
                },
                payload: reader.take_rest(),
            }),
        }
    }
}

impl<'a> Actions<'a> {
    /// Reads the ActionHeader, and the Sizes if there are several messages.
    pub(crate) fn read(
        header: &NetworkHeader<'a>,
        writer_ids: Option<&'a [[u8; 2]]>,
        mut payload: ByteReader<'a>,
        dialect: ActionDialect,
    ) -> Result<Self, DecodeError> {
        // An Action is addressed by PublisherId and DataSetWriterId (OPC 10000-14, 7.2.4.5.9).
        let (Some(publisher_id), Some(writer_ids)) = (header.publisher_id, writer_ids) else {
            return Err(DecodeError::Reserved {
                field: "UADPFlags of an Action message",
                value: 0,
            });
        };
        let action = ActionHeader::read(&mut payload)?;
        let sizes = match (writer_ids.len(), dialect) {
            (1, _) => None,
            (count, ActionDialect::UaNetStandard(_)) => {
                return Err(DecodeError::Reserved {
                    field: "Count of an Action message",
                    value: u32::try_from(count).unwrap_or(u32::MAX),
                });
            }
            (count, ActionDialect::Standard) => {
                let (sizes, _) = payload.bytes(count * 2, "Sizes")?.as_chunks();
                Some(sizes)
            }
        };
        Ok(Self {
            of: Of {
                publisher_id,
                writer_group_id: header.group.and_then(|group| group.writer_group_id),
                action,
                dialect,
            },
            writer_ids,
            sizes,
            payload,
        })
    }

    /// Returns the ActionHeader, shared by all messages.
    #[must_use]
    pub const fn header(&self) -> &ActionHeader<'a> {
        &self.of.action
    }
}

impl<'a> Iterator for Actions<'a> {
    type Item = Result<ActionMessage<'a>, DecodeError>;

    fn next(&mut self) -> Option<Self::Item> {
        let Some((writer_id, writer_ids)) = self.writer_ids.split_first() else {
            return message::check_padding(self.payload.take_rest())
                .err()
                .map(Err);
        };
        let writer_id = u16::from_le_bytes(*writer_id);
        let bytes = match self.sizes {
            None => Ok(self.payload.take_rest()),
            Some(sizes) => {
                let (size, rest) = sizes.split_first()?;
                self.sizes = Some(rest);
                let size = u16::from_le_bytes(*size).into();
                self.payload.bytes(size, "DataSetMessage")
            }
        };
        match bytes {
            Ok(bytes) => {
                self.writer_ids = writer_ids;
                Some(self.of.read(writer_id, ByteReader::new(bytes)))
            }
            Err(error) => {
                self.writer_ids = &[];
                self.payload = ByteReader::new(&[]);
                Some(Err(error))
            }
        }
    }
}

impl core::iter::FusedIterator for Actions<'_> {}

impl ActionMessage<'_> {
    /// Returns target, request id and state.
    #[must_use]
    pub const fn call(&self) -> ActionCall {
        ActionCall {
            target_id: self.target_id,
            request_id: self.request_id,
            state: self.state,
        }
    }

    /// Returns the header fields of the DataSetMessage, or the default in a dialect without that
    /// header.
    #[must_use]
    pub fn header(&self) -> DataSetHeader {
        self.head
            .as_ref()
            .map_or_else(DataSetHeader::default, Head::fields)
    }
}

impl<'a> Of<'a> {
    fn read(
        &self,
        writer_id: u16,
        mut reader: ByteReader<'a>,
    ) -> Result<ActionMessage<'a>, DecodeError> {
        let (head, encoding) = match self.dialect {
            ActionDialect::Standard => {
                let (head, encoding) = self.read_head(&mut reader)?;
                (Some(head), encoding)
            }
            ActionDialect::UaNetStandard(encoding) => (None, encoding),
        };
        Ok(ActionMessage {
            publisher_id: self.publisher_id,
            writer_group_id: self.writer_group_id,
            writer_id,
            action: self.action,
            target_id: reader.u16("ActionTargetId")?,
            request_id: reader.u16("RequestId")?,
            state: ActionState::read(&mut reader)?,
            fields: ActionFields::read(encoding, head.is_some(), &mut reader)?,
            dialect: self.dialect,
            head,
        })
    }

    fn read_head(
        &self,
        reader: &mut ByteReader<'a>,
    ) -> Result<(Head<'a>, ActionEncoding), DecodeError> {
        let flags1 = reader.u8("DataSetFlags1")?;
        if flags1 & message::VALID == 0 {
            return Err(DecodeError::Misread("marked as invalid by its sender"));
        }
        let (head, ()) = Head::read(flags1, reader, |kind| {
            if kind == self.kind() {
                Ok(())
            } else {
                Err(DecodeError::Reserved {
                    field: "DataSetMessage type under an ActionHeader",
                    value: kind.into(),
                })
            }
        })?;
        match flags1 & message::FIELD_ENCODING {
            0 => Ok((head, ActionEncoding::Variant)),
            message::RAW_FIELDS => Ok((head, ActionEncoding::RawData)),
            encoding => Err(DecodeError::Reserved {
                field: "field encoding of an Action",
                value: (encoding >> 1).into(),
            }),
        }
    }

    const fn kind(&self) -> u8 {
        self.action.kind.data_set_message_type()
    }
}

impl ActionKind {
    /// Returns the DataSetMessage type in DataSetFlags2.
    pub(crate) const fn data_set_message_type(self) -> u8 {
        match self {
            Self::Request => message::KIND_ACTION_REQUEST,
            Self::Response => message::KIND_ACTION_RESPONSE,
        }
    }
}

const IDLE: u8 = 0;
const EXECUTING: u8 = 1;
const DONE: u8 = 2;
