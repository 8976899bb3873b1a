//! The announcements of topics as NetworkMessages, to be stored or sent again.

use std::collections::BTreeMap;

use mappings::TopicId;
use uadp::discovery::{AnnouncedContent, Announcement};
use uadp::{PublisherId, SecurityHeader};

/// The newest announcement of each topic. The size of all is limited.
#[derive(Debug, Default)]
pub(super) struct LatestAnnouncements {
    topics: BTreeMap<TopicId, Vec<u8>>,
    weight: usize,
}

impl LatestAnnouncements {
    /// Keeps the announcement of a topic without its security. The descriptions of calls are left
    /// out.
    pub(super) fn keep(&mut self, topic: TopicId, announcement: &Announcement<'_>) {
        if !matches!(
            announcement.announced,
            AnnouncedContent::DataSetMetaData { .. }
        ) {
            return;
        }
        let publisher = PublisherId::UInt16(topic.space.into());
        let mut datagram = Vec::new();
        let encoded = announcement.encode(publisher, SecurityHeader::NONE, &mut datagram);
        if encoded.is_ok() && self.weight + datagram.len() <= MOST_WEIGHT {
            self.weight += datagram.len();
            let before = self.topics.insert(topic, datagram);
            self.weight -= before.map_or(0, |before| before.len());
        }
    }

    pub(super) fn get(&self, topic: TopicId) -> Option<&[u8]> {
        self.topics.get(&topic).map(Vec::as_slice)
    }

    /// Returns all announcements in the order of topics.
    pub(super) fn iter(&self) -> impl Iterator<Item = (TopicId, &[u8])> {
        let all = self.topics.iter();
        all.map(|(topic, datagram)| (*topic, datagram.as_slice()))
    }
}

/// Maximum size of all announcements.
const MOST_WEIGHT: usize = 32 << 20;
