//! Messages by which bridges know each other: DataSetMessages of the PublisherId of a space without
//! a WriterGroupId, so that no topic of the space has them. The first field is the mark of their
//! kind.

use mappings::SpaceId;
use uadp::{
    DataSetHeader, EncodeError, Fields, MessageKind, NetworkHeader, NetworkMessage,
    NetworkMessageEncoder, NetworkMessageType, PublisherId, Scalar, Timestamp, Variant,
};

/// Appends the NetworkMessage with a mark and fields.
pub(crate) fn encode<'a>(
    (space, utc): (SpaceId, Timestamp),
    mark: &str,
    fields: impl IntoIterator<Item = Scalar<'a>>,
    out: &mut Vec<u8>,
) -> Result<(), EncodeError> {
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(space.into())),
        timestamp: Some(utc.time),
        picoseconds: Some(utc.picoseconds),
        ..NetworkHeader::default()
    };
    let mut message = NetworkMessageEncoder::new(out, &header, Some(&[NO_WRITER]))?;
    let mut frame = message.key_frame(&DataSetHeader::default())?;
    frame.scalar(Scalar::String(Some(mark)))?;
    for field in fields {
        frame.scalar(field)?;
    }
    frame.finish()?;
    message.finish()
}

/// Returns the space of a message with a mark, and the fields after the mark; `None` for all other
/// messages.
pub(crate) fn decode<'m>(
    message: &NetworkMessage<'m>,
    mark: &str,
) -> Option<(SpaceId, BridgeFields<'m>)> {
    if message.group().is_some()
        || message.message_type() != NetworkMessageType::DataSet
        || message.is_chunk()
        || message.is_action()
    {
        return None;
    }
    let Some(PublisherId::UInt16(space)) = message.publisher_id() else {
        return None;
    };
    let frame = message.messages().next()?.ok()?;
    if frame.writer_id != Some(NO_WRITER) || frame.kind != MessageKind::KeyFrame {
        return None;
    }
    let mut fields = BridgeFields(frame.fields().ok()?);
    let is_marked = fields.scalar()? == Scalar::String(Some(mark));
    is_marked.then_some((SpaceId::new(space)?, fields))
}

/// The fields of a message after its mark.
pub(crate) struct BridgeFields<'m>(pub(crate) Fields<'m>);

impl<'m> BridgeFields<'m> {
    /// Returns the next field; `None` if there is none, or if it is no scalar.
    pub(crate) fn scalar(&mut self) -> Option<Scalar<'m>> {
        match self.0.next()?.ok()? {
            Variant::Scalar(scalar) => Some(scalar),
            Variant::Null | Variant::Array(_) | Variant::Matrix(_) => None,
        }
    }
}

/// The DataSetWriterId of no topic.
const NO_WRITER: u16 = 0;
