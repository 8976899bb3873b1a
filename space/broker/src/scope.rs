//! The ids and the role of a message, which decide to which carriers it belongs.

use uadp::NetworkMessage;

use crate::address::{self, Addressed};
use crate::topics::TopicMessageType;

/// The ids and the role of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MessageScope {
    /// The PublisherId; of a request and a response, the PublisherId of the executor.
    pub publisher: u16,
    /// The WriterGroupId; `None` for announcements of a whole publisher.
    pub group: Option<u16>,
    /// The DataSetWriterId, if the message has one.
    pub writer: Option<u16>,
    /// The role.
    pub role: MessageRole,
}

/// The role of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MessageRole {
    /// Values or keep-alives of writers.
    Value,
    /// A discovery announcement of the publisher.
    Announcement,
    /// A discovery probe for the publisher.
    Probe,
    /// A request of a call.
    Request,
    /// A response, or a confirmation of a command.
    Response,
    /// An encrypted or large request or response, which does not show its direction.
    HiddenCall,
}

/// Returns the scope of a message; `None` if the message has no PublisherId of a space.
#[must_use]
pub fn scope(message: &NetworkMessage<'_>) -> Option<MessageScope> {
    let Addressed { address, withdrawn } = address::of(message, None)?;
    let is_hidden = message.is_sealed() || message.is_chunk();
    let role = match address.kind {
        TopicMessageType::Data => MessageRole::Value,
        TopicMessageType::Probe => MessageRole::Probe,
        TopicMessageType::ActionRequest | TopicMessageType::ActionResponse if is_hidden => {
            MessageRole::HiddenCall
        }
        TopicMessageType::ActionRequest => MessageRole::Request,
        TopicMessageType::ActionResponse => MessageRole::Response,
        TopicMessageType::MetaData
        | TopicMessageType::Status
        | TopicMessageType::Connection
        | TopicMessageType::Application
        | TopicMessageType::Endpoints
        | TopicMessageType::ActionMetaData
        | TopicMessageType::ActionResponder
        | TopicMessageType::Discovery => MessageRole::Announcement,
    };
    let triple = withdrawn.map(mappings::TopicId::triple);
    Some(MessageScope {
        publisher: address.publisher,
        group: address.group.or_else(|| triple.map(|(_, group, _)| group)),
        writer: address
            .writer
            .or_else(|| triple.map(|(_, _, writer)| writer)),
        role,
    })
}
