//! The message by which redundant bridges know each other.

use std::cmp::Reverse;

use mappings::SpaceId;
use uadp::{EncodeError, NetworkMessage, Scalar, Timestamp, Variant};

use super::role::{RedundancyRank, RedundancyRole};
use crate::bridge_message;

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
        let flags = u8::from(self.is_fit) | u8::from(self.is_released) << 1;
        let fields = [
            Scalar::Byte(self.rank.get()),
            Scalar::Byte(self.role.number()),
            Scalar::Byte(flags),
            Scalar::UInt32(self.epoch),
            Scalar::UInt32(self.instance),
        ];
        // Readers ignore further fields, so that programs of different versions know each other.
        let level = self.service_level.map(Scalar::Byte);
        bridge_message::encode((space, utc), MARK, fields.into_iter().chain(level), out)
    }

    /// Reads the heartbeat of a bridge of any space; `None` for all other messages.
    pub(crate) fn decode(message: &NetworkMessage<'_>) -> Option<(SpaceId, Self)> {
        let (space, mut fields) = bridge_message::decode(message, MARK)?;
        let Scalar::Byte(rank) = fields.scalar()? else {
            return None;
        };
        let Scalar::Byte(role) = fields.scalar()? else {
            return None;
        };
        let Scalar::Byte(flags) = fields.scalar()? else {
            return None;
        };
        let Scalar::UInt32(epoch) = fields.scalar()? else {
            return None;
        };
        let Scalar::UInt32(instance) = fields.scalar()? else {
            return None;
        };
        let level = fields.0.next().transpose().ok()?;
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
        Some((space, heartbeat))
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

/// The first field of a heartbeat.
const MARK: &str = "ua-bridge redundancy 1";
