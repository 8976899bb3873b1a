//! The delays of samples on their way: of all topics for the statistics, and of tapped topics.

use mappings::TopicId;
use uadp::Timestamp;

use super::values::TopicQueues;
use crate::hops::Hop;
use crate::place::SequencePosition;
use crate::settings::Now;
use crate::tap::Crossing;

impl TopicQueues {
    /// Records the delays of a sample. A stored value, or a sample held back by its rate limit,
    /// waited intentionally; only its network delay is recorded.
    pub(super) fn record_way(
        &mut self,
        topic: TopicId,
        (place, sent): (&SequencePosition, Option<Timestamp>),
        now: Now,
    ) {
        // Some stacks send zeros in timestamps that they do not fill.
        let filled = |stamp: &Timestamp| stamp.time.0 != 0;
        let Some(sent) = sent.filter(filled) else {
            return;
        };
        let arrived = self.arrival(now);
        self.record_hop(topic, Hop::Network, (sent, arrived));
        let waited = place.is_stored() || (!place.held_back.is_zero() && !place.is_fresh());
        if let Some(taken) = place.stamp.filter(filled)
            && !waited
        {
            self.record_hop(topic, Hop::Origin, (taken, sent));
        }
    }

    /// Records the delay of a hop between two times.
    pub(super) fn record_hop(
        &mut self,
        topic: TopicId,
        hop: Hop,
        (from, to): (Timestamp, Timestamp),
    ) {
        self.hops.record(hop, from, to);
        self.tap.note(topic, || Crossing::Measured {
            hop,
            nanos: to.unix_nanos() - from.unix_nanos(),
        });
    }
}
