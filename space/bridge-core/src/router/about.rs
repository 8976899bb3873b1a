//! The subject of a counted drop.

use std::net::SocketAddr;

use mappings::TopicId;

/// The topic and sender of a drop.
#[derive(Clone, Copy)]
pub(super) struct DropSite {
    pub(super) topic: Option<TopicId>,
    pub(super) from: Option<SocketAddr>,
}

impl DropSite {
    pub(super) const NOTHING: Self = Self {
        topic: None,
        from: None,
    };

    pub(super) const fn topic(topic: TopicId) -> Self {
        Self {
            topic: Some(topic),
            from: None,
        }
    }

    pub(super) const fn message(topic: TopicId, from: SocketAddr) -> Self {
        Self {
            topic: Some(topic),
            from: Some(from),
        }
    }

    pub(super) const fn sender(from: SocketAddr) -> Self {
        Self {
            topic: None,
            from: Some(from),
        }
    }
}
