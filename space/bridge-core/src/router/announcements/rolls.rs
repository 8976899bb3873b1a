//! Probes for the calls of other programs.

use std::collections::{BTreeMap, HashSet};
use std::time::Duration;

use mappings::{SpaceId, TopicId};
use uadp::discovery::{ProbeLimits, ProbeStep, ProbeTimer};

/// The spaces that are probed for their calls.
#[derive(Debug, Default)]
pub(super) struct Rolls {
    timers: BTreeMap<SpaceId, ProbeTimer>,
    /// Namespaces with a program that was already probed for its calls.
    met: HashSet<(SpaceId, u16)>,
}

impl Rolls {
    /// Plans a probe, unless a probe of the space is in progress.
    pub(super) fn plan(&mut self, space: SpaceId, (since, random): (Duration, u32)) {
        let limits = ProbeLimits {
            max_period: Duration::from_secs(1),
            attempts: 2,
        };
        self.timers
            .entry(space)
            .or_insert_with(|| ProbeTimer::new(since, random, limits));
    }

    /// Plans a probe for the calls of a program when it is first received.
    pub(super) fn meet(&mut self, topic: TopicId, at: (Duration, u32)) {
        let (_, namespace, _) = topic.triple();
        if self.met.len() < MAX_MET && self.met.insert((topic.space, namespace)) {
            self.plan(topic.space, at);
        }
    }

    /// Records the probe of another program. Its answer serves this program too.
    pub(super) fn handle_probe(&mut self, space: SpaceId, since: Duration) {
        if let Some(timer) = self.timers.get_mut(&space) {
            timer.handle_probe(since);
        }
    }

    /// Completes the probe of a space with a known call.
    pub(super) fn handle_answer(&mut self, space: SpaceId) {
        if let Some(timer) = self.timers.get_mut(&space) {
            timer.handle_answer();
        }
    }

    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let timers = self.timers.values();
        timers.filter_map(ProbeTimer::poll_timeout).min()
    }

    /// Returns the spaces whose probes are due.
    pub(super) fn poll(&mut self, (since, random): (Duration, u32)) -> Vec<SpaceId> {
        let mut due = Vec::new();
        self.timers.retain(|space, timer| {
            match timer.poll(since, random.rotate_left(space.get().into())) {
                ProbeStep::Wait => true,
                ProbeStep::Send => {
                    due.push(*space);
                    true
                }
                ProbeStep::Answered | ProbeStep::GivenUp => false,
            }
        });
        due
    }
}

/// The maximum number of namespaces that are probed for their calls when they are first received.
const MAX_MET: usize = 4_096;
