//! Probes for the calls of other programs.

use std::collections::{BTreeMap, HashSet};
use std::time::Duration;

use mappings::{SpaceId, TopicId};
use uadp::discovery::{Probe, ProbeLimits, ProbeStep, ProbeTimer, WireArray};

/// The calls that a probe asks for: those of a space, or of one of its namespaces. A cell may have
/// hundreds of programs in space 0, so a probe for a single program names its namespace.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(in super::super) struct ProbedCalls {
    space: SpaceId,
    namespace: Option<u16>,
}

impl ProbedCalls {
    /// Asks for all calls of a space.
    pub(in super::super) const fn space(space: SpaceId) -> Self {
        Self {
            space,
            namespace: None,
        }
    }

    /// Asks for the calls of a namespace.
    pub(in super::super) const fn namespace(space: SpaceId, namespace: u16) -> Self {
        Self {
            space,
            namespace: Some(namespace),
        }
    }

    /// Returns the space to which the probe is addressed.
    pub(in super::super) const fn publisher(self) -> SpaceId {
        self.space
    }

    /// Returns the probe: for the PubSubConnections of the space, or for the WriterGroup of the
    /// namespace.
    pub(in super::super) const fn probe(self) -> Probe<'static> {
        match self.namespace {
            None => Probe::PubSubConnections {
                transport_profile_uris: WireArray::null(),
                include_writer_groups: false,
                include_data_set_writers: false,
            },
            Some(writer_group_id) => Probe::WriterGroupConfiguration {
                writer_group_id,
                include_data_set_writers: false,
            },
        }
    }

    /// Returns whether the response to this probe is also a response to the other probe.
    fn includes(self, other: Self) -> bool {
        self.space == other.space && (self.namespace.is_none() || self == other)
    }
}

/// The spaces and namespaces that are probed for their calls.
#[derive(Debug, Default)]
pub(super) struct Rolls {
    timers: BTreeMap<ProbedCalls, ProbeTimer>,
    /// Namespaces with a program that was already probed for its calls.
    met: HashSet<(SpaceId, u16)>,
}

impl Rolls {
    /// Plans a probe, unless a probe for these calls is in progress.
    pub(super) fn plan(&mut self, asked: ProbedCalls, (since, random): (Duration, u32)) {
        if self.timers.contains_key(&ProbedCalls::space(asked.space)) {
            return;
        }
        let limits = ProbeLimits {
            max_period: Duration::from_secs(1),
            attempts: 2,
        };
        self.timers
            .entry(asked)
            .or_insert_with(|| ProbeTimer::new(since, random, limits));
    }

    /// Plans a probe for the calls of a program when it is first received.
    pub(super) fn meet(&mut self, topic: TopicId, at: (Duration, u32)) {
        let (_, namespace, _) = topic.triple();
        if self.met.len() < MAX_MET && self.met.insert((topic.space, namespace)) {
            self.plan(ProbedCalls::namespace(topic.space, namespace), at);
        }
    }

    /// Records the probe of another program. Its answer serves this program too.
    pub(super) fn handle_probe(&mut self, other: ProbedCalls, since: Duration) {
        for (asked, timer) in &mut self.timers {
            if other.includes(*asked) {
                timer.handle_probe(since);
            }
        }
    }

    /// Completes the probes that a known call answers.
    pub(super) fn handle_answer(&mut self, topic: TopicId) {
        let (_, namespace, _) = topic.triple();
        for asked in [
            ProbedCalls::space(topic.space),
            ProbedCalls::namespace(topic.space, namespace),
        ] {
            if let Some(timer) = self.timers.get_mut(&asked) {
                timer.handle_answer();
            }
        }
    }

    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let timers = self.timers.values();
        timers.filter_map(ProbeTimer::poll_timeout).min()
    }

    /// Returns the probes that are due.
    pub(super) fn poll(&mut self, (since, random): (Duration, u32)) -> Vec<ProbedCalls> {
        let mut due = Vec::new();
        self.timers.retain(|asked, timer| {
            let turn =
                u32::from(asked.space.get()) + u32::from(asked.namespace.unwrap_or_default());
            match timer.poll(since, random.rotate_left(turn % u32::BITS)) {
                ProbeStep::Wait => true,
                ProbeStep::Send => {
                    due.push(*asked);
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
