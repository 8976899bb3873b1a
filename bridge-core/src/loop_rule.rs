//! Why nothing loops: the space in a name is where the value is produced.

use mappings::SpaceId;

/// Which side of a bridge something was heard on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Side {
    /// The bridge's own space: a ROS graph, or the address space of an OPC UA server.
    Local,
    /// The OPC UA PubSub space.
    Ua,
}

/// Whether a value of space `origin` may cross a bridge of space `own` from the side it was heard on.
///
/// From its own side a bridge takes only what is produced there, from the UA side only what is produced elsewhere.
/// So a value crosses UA once and enters each other space once, with any set of bridges of distinct spaces, and no
/// memory or hop count is needed.
#[must_use]
pub fn may_cross(own: SpaceId, heard_on: Side, origin: SpaceId) -> bool {
    match heard_on {
        Side::Local => origin == own,
        Side::Ua => origin != own,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_own_values_leave_and_only_foreign_ones_enter() {
        let [own, other] = [2, 7].map(|id| SpaceId::new(id).unwrap());
        assert!(may_cross(own, Side::Local, own));
        assert!(!may_cross(own, Side::Local, other));
        assert!(!may_cross(own, Side::Ua, own));
        assert!(may_cross(own, Side::Ua, other));
    }
}
