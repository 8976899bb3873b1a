//! Probes for the metadata of topics of other spaces.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use mappings::{SpaceId, TopicId};
use uadp::discovery::{ProbeLimits, ProbeStep, ProbeTimer, WireArray};

/// The Publishers that are probed for the metadata of their topics.
#[derive(Debug, Default)]
pub(super) struct MetadataProbes {
    publishers: BTreeMap<SpaceId, Probing>,
}

/// The pending probe of a Publisher.
#[derive(Debug)]
struct Probing {
    timer: ProbeTimer,
    topics: BTreeSet<TopicId>,
}

impl MetadataProbes {
    /// Plans a probe for the metadata of a topic.
    pub(super) fn plan(&mut self, topic: TopicId, (since, random): (Duration, u32)) {
        let probing = self
            .publishers
            .entry(topic.space)
            .or_insert_with(|| Probing {
                timer: ProbeTimer::new(since, random, ProbeLimits::default()),
                topics: BTreeSet::new(),
            });
        // Other topics are announced periodically.
        if probing.topics.len() < MAX_ASKED {
            probing.topics.insert(topic);
        }
    }

    /// Records the probe of another program. The own probe is not sent if it would ask for nothing
    /// else.
    pub(super) fn handle_probe(
        &mut self,
        space: SpaceId,
        ids: WireArray<'_, u16>,
        since: Duration,
    ) {
        let Some(probing) = self.publishers.get_mut(&space) else {
            return;
        };
        // A single pass: a datagram has room for 32 000 ids, and each pass decodes all of them.
        let mut missing: BTreeSet<u16> = probing.topics.iter().map(|t| t.triple().2).collect();
        for id in ids {
            missing.remove(&id);
            if missing.is_empty() {
                probing.timer.handle_probe(since);
                break;
            }
        }
    }

    /// Returns the probed topics of a Publisher.
    pub(super) fn topics_of(&self, space: SpaceId) -> impl Iterator<Item = TopicId> {
        let probing = self.publishers.get(&space).into_iter();
        probing.flat_map(|probing| &probing.topics).copied()
    }

    /// Removes topics of a Publisher from its pending probe.
    pub(super) fn answered(&mut self, space: SpaceId, is_it: impl Fn(TopicId) -> bool) {
        if let Some(probing) = self.publishers.get_mut(&space) {
            probing.topics.retain(|topic| !is_it(*topic));
            if probing.topics.is_empty() {
                self.publishers.remove(&space);
            }
        }
    }

    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let publishers = self.publishers.values();
        let timeouts = publishers.filter_map(|probing| probing.timer.poll_timeout());
        timeouts.min()
    }

    /// Returns the due probes: the Publisher and the DataSetWriterIds of each.
    pub(super) fn poll(&mut self, (since, random): (Duration, u32)) -> Vec<(SpaceId, Vec<u16>)> {
        let mut due = Vec::new();
        self.publishers.retain(|space, probing| {
            let random = random.rotate_left(space.get().into());
            match probing.timer.poll(since, random) {
                ProbeStep::Wait => true,
                ProbeStep::Send => {
                    due.push((*space, probing.writer_ids()));
                    true
                }
                ProbeStep::Answered | ProbeStep::GivenUp => false,
            }
        });
        due
    }
}

impl Probing {
    fn writer_ids(&self) -> Vec<u16> {
        let ids: BTreeSet<u16> = self.topics.iter().map(|topic| topic.triple().2).collect();
        ids.into_iter().take(MAX_ASKED).collect()
    }
}

/// The maximum number of topics in a probe of a Publisher, which fits into any datagram.
const MAX_ASKED: usize = 200;
