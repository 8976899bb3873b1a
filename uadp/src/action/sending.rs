//! Messages that a Requestor or Responder has to send, and their addresses.

use super::{
    ActionCall, ActionDialect, ActionEncoder, ActionFields, ActionHeader, ActionMessage,
    ActionStart, ActionState,
};
use crate::{DataSetHeader, EncodeError, Extras, GroupHeader, NetworkHeader, OwnedPublisherId};
use alloc::boxed::Box;
use alloc::vec::Vec;

/// Address of an Action: its Responder and target (OPC 10000-14, 7.2.4.5.9).
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ActionAddress {
    /// PublisherId of the Responder.
    pub publisher_id: OwnedPublisherId,
    /// WriterGroup of the Responder, if messages contain it.
    pub writer_group_id: Option<u16>,
    /// DataSetWriter of the Responder.
    pub writer_id: u16,
    /// Target in the ActionMetaData of the DataSetWriter.
    pub target_id: u16,
}

/// A request or response that is due, encoded as a separate NetworkMessage.
#[derive(Debug, Clone, Copy)]
pub struct ActionToSend<'a> {
    /// Address of the Responder, also in responses.
    pub address: &'a ActionAddress,
    /// The ActionHeader.
    pub action: ActionHeader<'a>,
    /// Time in ms for which the Requestor still waits, in requests. It is not encoded. It differs
    /// from the TimeoutHint of a repeated [large](super::RequestorSettings::large) request.
    pub left: Option<f64>,
    /// RequestId of the request.
    pub request_id: u16,
    /// Identifies the call within its Requestor or Responder. It is not encoded; it identifies
    /// repetitions. Their chunks have to carry the MessageSequenceNumber of the first transmission.
    pub call: u64,
    /// Requested state in a request, current state in a response.
    pub state: ActionState,
    /// Status of the DataSetMessage header, in responses.
    pub status: Option<u16>,
    /// Encoded fields.
    pub fields: ActionFields<'a>,
    /// Dialect of the peer.
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
    /// Returns true if the message has this address.
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
    /// Returns the message with the time that is [`left`](Self::left) as its TimeoutHint. The
    /// chunks of such a repetition cannot replace lost chunks of another.
    #[must_use]
    pub const fn with_time_left(mut self) -> Self {
        self.action.timeout_hint = self.left;
        self
    }

    /// Appends the NetworkMessage to `buf`, up to its [`finish`](ActionEncoder::finish) or
    /// [`finish_sealed`](ActionEncoder::finish_sealed). The address replaces PublisherId and
    /// WriterGroupId of `network`.
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] if the PublisherId or a field of the ActionHeader exceeds its length
    /// field.
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
