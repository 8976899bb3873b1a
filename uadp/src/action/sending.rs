//! What a Requestor or Responder has to say next, and to whom it belongs.

use super::{
    ActionCall, ActionDialect, ActionEncoder, ActionFields, ActionHeader, ActionMessage,
    ActionStart, ActionState,
};
use crate::{DataSetHeader, EncodeError, Extras, GroupHeader, NetworkHeader, OwnedPublisherId};

/// What an Action is called by: its Responder, and which of its targets (OPC 10000-14, 7.2.4.5.9).
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ActionAddress {
    /// PublisherId of the Responder.
    pub publisher_id: OwnedPublisherId,
    /// Its WriterGroup, where messages say it.
    pub writer_group_id: Option<u16>,
    /// Its DataSetWriter.
    pub writer_id: u16,
    /// The target in the ActionMetaData of the DataSetWriter.
    pub target_id: u16,
}

/// A request or response that is due, to be written into a NetworkMessage of its own.
#[derive(Debug, Clone, Copy)]
pub struct ActionToSend<'a> {
    /// The Responder, in responses too.
    pub address: &'a ActionAddress,
    /// The ActionHeader.
    pub action: ActionHeader<'a>,
    /// Which of the Requestor's requests it is.
    pub request_id: u16,
    /// Which call of its Requestor or Responder it is of. Nothing of the wire: it tells a repetition, for which chunks are to
    /// have the MessageSequenceNumber that they had before.
    pub call: u64,
    /// The state wanted, or the one there is.
    pub state: ActionState,
    /// Status of the DataSetMessage header, in responses.
    pub status: Option<u16>,
    /// The fields.
    pub fields: ActionFields<'a>,
    /// How the peer wants to have it.
    pub dialect: ActionDialect,
}

/// Owned form of [`ActionFields`].
#[derive(Debug, Clone)]
pub(super) enum KeptFields {
    None,
    Variants(Box<[u8]>),
    RawData {
        count: Option<u16>,
        payload: Box<[u8]>,
    },
}

impl ActionAddress {
    /// True for the address of the message.
    #[must_use]
    pub fn is_of(&self, message: &ActionMessage<'_>) -> bool {
        self.publisher_id.as_id() == message.publisher_id
            && self.writer_group_id == message.writer_group_id
            && (self.writer_id, self.target_id) == (message.writer_id, message.target_id)
    }
}

impl From<&ActionMessage<'_>> for ActionAddress {
    fn from(message: &ActionMessage<'_>) -> Self {
        Self {
            publisher_id: message.publisher_id.into(),
            writer_group_id: message.writer_group_id,
            writer_id: message.writer_id,
            target_id: message.target_id,
        }
    }
}

impl ActionToSend<'_> {
    /// Appends the NetworkMessage to `buf`, up to its [`finish`](ActionEncoder::finish) or
    /// [`finish_sealed`](ActionEncoder::finish_sealed). What `network` says of PublisherId and WriterGroupId is replaced
    /// by the address.
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] when the PublisherId or a part of the ActionHeader is longer than its length can say.
    pub fn encode<'b>(
        &self,
        buf: &'b mut Vec<u8>,
        network: &NetworkHeader<'_>,
        extras: &Extras<'_>,
    ) -> Result<ActionEncoder<'b>, EncodeError> {
        let group = network.group.unwrap_or_default();
        let group = GroupHeader {
            writer_group_id: self.address.writer_group_id,
            ..group
        };
        let start = ActionStart {
            network: NetworkHeader {
                publisher_id: Some(self.address.publisher_id.as_id()),
                group: Some(group).filter(|group| *group != GroupHeader::default()),
                ..*network
            },
            action: self.action,
            dialect: self.dialect,
            extras: *extras,
        };
        let call = ActionCall {
            target_id: self.address.target_id,
            request_id: self.request_id,
            state: self.state,
        };
        let header = DataSetHeader {
            status: self.status,
            ..DataSetHeader::default()
        };
        let mut encoder = ActionEncoder::new(buf, &start, &[self.address.writer_id])?;
        encoder.fields(&header, call, self.fields)?;
        Ok(encoder)
    }
}

impl KeptFields {
    pub(super) fn as_fields(&self) -> ActionFields<'_> {
        match self {
            Self::None => ActionFields::NONE,
            Self::Variants(block) => ActionFields::Variants(block),
            Self::RawData { count, payload } => ActionFields::RawData {
                count: *count,
                payload,
            },
        }
    }
}

impl From<ActionFields<'_>> for KeptFields {
    fn from(fields: ActionFields<'_>) -> Self {
        match fields {
            ActionFields::Variants(block) => Self::Variants(block.into()),
            ActionFields::RawData { count, payload } => Self::RawData {
                count,
                payload: payload.into(),
            },
        }
    }
}
