//! The message by which redundant bridges know each other.

use std::cmp::Reverse;

use mappings::SpaceId;
use uadp::{
    DataSetHeader, EncodeError, MessageKind, NetworkHeader, NetworkMessage, NetworkMessageEncoder,
    NetworkMessageType, PublisherId, Scalar, Timestamp, Variant,
};

use super::role::{RedundancyRank, RedundancyRole};

/// The message by which redundant bridges of a space know each other.
///
/// It is a DataSetMessage of the PublisherId of the space without a WriterGroupId, so that no topic
/// of the space has it. In secured groups it is secured with the keys of the discovery messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Heartbeat {
    pub(super) rank: RedundancyRank,
    pub(super) role: RedundancyRole,
    pub(super) epoch: u32,
    pub(super) instance: u32,
    pub(super) is_fit: bool,
    pub(super) is_released: bool,
    /// The ServiceLevel of an OPC UA server; `None` for a bridge.
    pub(super) service_level: Option<u8>,
}

impl Heartbeat {
    /// Appends the NetworkMessage.
    pub(crate) fn encode(
        &self,
        space: SpaceId,
        utc: Timestamp,
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
        let flags = u8::from(self.is_fit) | u8::from(self.is_released) << 1;
        frame.scalar(Scalar::String(Some(MARK)))?;
        frame.scalar(Scalar::Byte(self.rank.get()))?;
        frame.scalar(Scalar::Byte(self.role.number()))?;
        frame.scalar(Scalar::Byte(flags))?;
        frame.scalar(Scalar::UInt32(self.epoch))?;
        frame.scalar(Scalar::UInt32(self.instance))?;
        // Readers ignore further fields, so that programs of different versions know each other.
        if let Some(level) = self.service_level {
            frame.scalar(Scalar::Byte(level))?;
        }
        frame.finish()?;
        message.finish()
    }

    /// Reads the heartbeat of a bridge of any space; `None` for all other messages.
    pub(crate) fn decode(message: &NetworkMessage<'_>) -> Option<(SpaceId, Self)> {
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
        let mut fields = frame.fields().ok()?;
        let mut next = || match fields.next()?.ok()? {
            Variant::Scalar(scalar) => Some(scalar),
            Variant::Null | Variant::Array(_) | Variant::Matrix(_) => None,
        };
        let Scalar::String(Some(MARK)) = next()? else {
            return None;
        };
        let Scalar::Byte(rank) = next()? else {
            return None;
        };
        let Scalar::Byte(role) = next()? else {
            return None;
        };
        let Scalar::Byte(flags) = next()? else {
            return None;
        };
        let Scalar::UInt32(epoch) = next()? else {
            return None;
        };
        let Scalar::UInt32(instance) = next()? else {
            return None;
        };
        let level = fields.next().transpose().ok()?;
        let service_level = if let Some(Variant::Scalar(Scalar::Byte(level))) = level {
            Some(level)
        } else {
            None
        };
        let heartbeat = Self {
            rank: RedundancyRank::new(rank)?,
            role: RedundancyRole::of(role)?,
            epoch,
            instance,
            is_fit: flags & 1 != 0,
            is_released: flags & 2 != 0,
            service_level,
        };
        Some((SpaceId::new(space)?, heartbeat))
    }

    pub(crate) const fn instance(&self) -> u32 {
        self.instance
    }

    pub(crate) fn is_active(&self) -> bool {
        self.role == RedundancyRole::Active
    }

    /// Returns the order of bridges that are active at once: the highest stays active.
    pub(crate) const fn precedence(&self) -> (u32, Reverse<RedundancyRank>, u32) {
        (self.epoch, Reverse(self.rank), self.instance)
    }
}

/// The DataSetWriterId of no topic.
const NO_WRITER: u16 = 0;
/// The first field of a heartbeat.
const MARK: &str = "ua-bridge redundancy 1";
