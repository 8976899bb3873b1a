//! Reading requests and responses.

use super::{ActionCall, ActionHeader, ActionKind};
use crate::data_set_message::{self as message, Head};
use crate::reader::Reader;
use crate::{DataSetHeader, DecodeError, Fields, NetworkHeader, PublisherId};

/// How a peer lays out Actions. Both sides have to be set to the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ActionDialect {
    /// By the text of OPC 10000-14: a request or response is a DataSetMessage with its header (7.2.4.5.4), whose type
    /// is 5 or 6 and which says the field encoding; a FieldCount stands in front of the fields of either encoding
    /// (7.2.4.5.9). Several may share a NetworkMessage.
    #[default]
    Standard,
    /// As UA-.NETStandard 2.0 does it: no DataSetMessage header, so no Status and no field encoding either, which both
    /// sides have to know; no FieldCount with RawData; one request or response in a NetworkMessage. It knows neither
    /// repetition nor acknowledgement: a request is sent once and executed as often as it comes.
    UaNetStandard(ActionEncoding),
}

/// How the fields of a request or response are encoded. DataValues are not allowed (OPC 10000-14, 7.2.4.5.9 and
/// 7.2.4.5.10).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ActionEncoding {
    /// Each with its type.
    #[default]
    Variant,
    /// Without types, to be read with the ActionMetaData (OPC 10000-14, 7.2.4.5.11).
    RawData,
}

/// State of one execution of an Action: in a request the one the Requestor wants, in a response the one it is in
/// (OPC 10000-14, 6.2.11.2.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ActionState {
    /// Nothing is executed; what was is forgotten.
    Idle,
    /// Under way.
    Executing,
    /// Over, and this is what came out.
    Done,
}

/// The fields of a request or response as they stand on the wire, unread.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ActionFields<'a> {
    /// FieldCount and so many Variants, as [`Fields::parse`] takes them.
    Variants(&'a [u8]),
    /// Values without types, as [`RawLayout::read`](crate::RawLayout::read) takes them.
    RawData {
        /// FieldCount; `None` from a peer that does not say it.
        count: Option<u16>,
        /// The values.
        payload: &'a [u8],
    },
}

/// The requests or responses of a NetworkMessage one by one, in the order of the DataSetWriterIds.
///
/// With several a malformed one is an `Err` in its place and the next ones follow. Sizes that reach past the datagram
/// end the iteration with one `Err`, as do bytes that belong to no message.
#[derive(Debug, Clone)]
pub struct Actions<'a> {
    of: Of<'a>,
    writer_ids: &'a [[u8; 2]],
    /// `None` for a single message, which takes the whole payload.
    sizes: Option<&'a [[u8; 2]]>,
    payload: Reader<'a>,
}

/// One request or response, with the headers it came under (OPC 10000-14, 7.2.4.5.9 and 7.2.4.5.10).
#[derive(Debug, Clone, Copy)]
pub struct ActionMessage<'a> {
    /// PublisherId of the Responder, in requests too.
    pub publisher_id: PublisherId<'a>,
    /// WriterGroup of the Responder, if it is said.
    pub writer_group_id: Option<u16>,
    /// DataSetWriter of the Responder.
    pub writer_id: u16,
    /// What belongs to all messages of the NetworkMessage.
    pub action: ActionHeader<'a>,
    /// What the Action is called on: one of the targets in its ActionMetaData.
    pub target_id: u16,
    /// Tells the requests of one RequestorId and CorrelationData apart.
    pub request_id: u16,
    /// The state wanted, or the one there is.
    pub state: ActionState,
    /// The fields.
    pub fields: ActionFields<'a>,
    /// How it was laid out.
    pub dialect: ActionDialect,
    head: Option<Head<'a>>,
}

/// What the messages of one NetworkMessage have in common.
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

    fn read(reader: &mut Reader<'_>) -> Result<Self, DecodeError> {
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

    /// The bytes, of Variants with the FieldCount.
    #[must_use]
    pub const fn bytes(&self) -> &'a [u8] {
        match self {
            Self::Variants(bytes) | Self::RawData { payload: bytes, .. } => bytes,
        }
    }

    /// The Variants one by one.
    ///
    /// # Errors
    /// [`DecodeError::Misread`] for RawData; else as [`Fields::parse`].
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
        reader: &mut Reader<'a>,
    ) -> Result<Self, DecodeError> {
        match encoding {
            ActionEncoding::Variant => {
                let block = reader.take_rest();
                Fields::parse(block)?;
                Ok(Self::Variants(block))
            }
            ActionEncoding::RawData => Ok(Self::RawData {
                count: match counted {
                    true => Some(reader.u16("FieldCount")?),
                    false => None,
                },
                payload: reader.take_rest(),
            }),
        }
    }
}

impl<'a> Actions<'a> {
    /// Reads the ActionHeader, and the Sizes where there are some.
    pub(crate) fn read(
        header: &NetworkHeader<'a>,
        writer_ids: Option<&'a [[u8; 2]]>,
        mut payload: Reader<'a>,
        dialect: ActionDialect,
    ) -> Result<Self, DecodeError> {
        // An Action is addressed by them (OPC 10000-14, 7.2.4.5.9).
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

    /// What belongs to all of them.
    #[must_use]
    pub const fn header(&self) -> &ActionHeader<'a> {
        &self.of.action
    }
}

impl<'a> Iterator for Actions<'a> {
    type Item = Result<ActionMessage<'a>, DecodeError>;

    fn next(&mut self) -> Option<Self::Item> {
        let Some((writer_id, writer_ids)) = self.writer_ids.split_first() else {
            return match self.payload.take_rest().len() {
                0 => None,
                left => Some(Err(DecodeError::TrailingBytes(left))),
            };
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
                Some(self.of.read(writer_id, Reader::new(bytes)))
            }
            Err(error) => {
                self.writer_ids = &[];
                self.payload = Reader::new(&[]);
                Some(Err(error))
            }
        }
    }
}

impl std::iter::FusedIterator for Actions<'_> {}

impl ActionMessage<'_> {
    /// What it says of itself.
    #[must_use]
    pub const fn call(&self) -> ActionCall {
        ActionCall {
            target_id: self.target_id,
            request_id: self.request_id,
            state: self.state,
        }
    }

    /// The header fields of the DataSetMessage; the default where the dialect has none.
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
        mut reader: Reader<'a>,
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
        reader: &mut Reader<'a>,
    ) -> Result<(Head<'a>, ActionEncoding), DecodeError> {
        let flags1 = reader.u8("DataSetFlags1")?;
        if flags1 & message::VALID == 0 {
            return Err(DecodeError::Misread("marked as invalid by its sender"));
        }
        let (head, ()) = Head::read(flags1, reader, |kind| match kind == self.kind() {
            true => Ok(()),
            false => Err(DecodeError::Reserved {
                field: "DataSetMessage type under an ActionHeader",
                value: kind.into(),
            }),
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
    /// The type in DataSetFlags2.
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
