//! Probes that values need, which the announcements send.

use std::mem;

use mappings::{SpaceId, TopicId};

/// The probes that became necessary while values were handled. The Router takes them after each
/// input, so their number is bounded by the messages of a datagram and the due topics.
#[derive(Debug, Default)]
pub(super) struct Inquiries {
    /// The topics of other spaces that need metadata.
    topics: Vec<TopicId>,
    /// Topics of programs that were received for the first time.
    met: Vec<TopicId>,
    /// Whether all applications of the group are probed.
    applications: bool,
}

impl Inquiries {
    /// Requests the metadata of a topic of another space.
    pub(super) fn probe(&mut self, topic: TopicId) {
        if self.topics.last() != Some(&topic) {
            self.topics.push(topic);
        }
    }

    /// Requests the calls of the program of a new topic. Programs of other spaces than 0 announce
    /// each new call.
    pub(super) fn meet(&mut self, topic: TopicId) {
        if topic.space == SpaceId::UA {
            self.met.push(topic);
        }
    }

    /// Requests all applications of the group.
    pub(super) const fn look_for_applications(&mut self) {
        self.applications = true;
    }

    pub(super) const fn is_empty(&self) -> bool {
        self.topics.is_empty() && self.met.is_empty() && !self.applications
    }

    /// Takes the topics that need metadata.
    pub(super) fn take_topics(&mut self) -> Vec<TopicId> {
        mem::take(&mut self.topics)
    }

    /// Takes the topics of new programs.
    pub(super) fn take_met(&mut self) -> Vec<TopicId> {
        mem::take(&mut self.met)
    }

    /// Takes whether all applications are probed.
    pub(super) const fn take_applications(&mut self) -> bool {
        mem::replace(&mut self.applications, false)
    }
}
