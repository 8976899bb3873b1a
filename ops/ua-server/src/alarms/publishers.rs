//! Conditions of the publishers of the space: a lost publisher, dropped values, and clocks that
//! differ. Times and counters are inputs.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use bridge_core::Hop;
use bridge_node::{Reason, Router};
use mappings::{Mapping, SpaceId};
use opcua::types::{NodeId, ObjectId, StatusCode};

use super::condition::{Levels, SourceReport};
use super::event::{ConditionIdentity, ConditionType};
use super::{Entry, space_name};
use crate::address;

/// Returns the spaces of the variables, if the mapping wants alarms for their publishers.
pub(super) fn spaces(mapping: &Mapping) -> BTreeSet<SpaceId> {
    if !mapping.server().publisher_alarms {
        return BTreeSet::new();
    }
    let all = mapping.variables().iter().map(|one| one.topic.space);
    all.filter(|space| *space != SpaceId::UA).collect()
}

/// The state of the publishers.
#[derive(Debug, Default)]
pub(super) struct PublisherStates {
    /// The time of the last message of each space.
    heard: BTreeMap<SpaceId, Instant>,
    /// Number of dropped values of each space, and of values that were lost on their way.
    dropped: BTreeMap<SpaceId, u64>,
    /// Number of values that arrived before they were sent.
    early: u64,
    timeout: Duration,
}

impl PublisherStates {
    pub(super) fn of(router: &Router, timeout: Duration) -> Self {
        let mut seen = Self {
            timeout,
            early: router.hops().of(Hop::Network).negative(),
            ..Self::default()
        };
        for (topic, at) in router.heard() {
            let last = seen.heard.entry(topic.space).or_insert(at);
            *last = at.max(*last);
        }
        for (topic, counters) in router.topics() {
            let lost = |(reason, _): &(Reason, u64)| {
                // Values that are sent again arrive several times.
                !reason.is_routine() && *reason != Reason::Duplicate
            };
            let drops: u64 = counters.drops().filter(lost).map(|(_, count)| count).sum();
            let sum = seen.dropped.entry(topic.space).or_default();
            *sum = sum.saturating_add(drops).saturating_add(counters.missing);
        }
        seen
    }
}

/// A counter that is a fault while it rises.
#[derive(Debug, Default, Clone, Copy)]
struct Rising {
    last: u64,
    /// The count before the counter began to rise, and the time of its last rise.
    since: Option<(u64, Instant)>,
}

impl Rising {
    /// Returns by how much the counter has risen until now, or `None` if it did not rise lately.
    fn look(&mut self, count: u64, now: Instant) -> Option<u64> {
        if count > self.last {
            let begun = self.since.map_or(self.last, |(begun, _)| begun);
            self.since = Some((begun, now));
        }
        self.last = count;
        let (begun, at) = self.since?;
        if now.saturating_duration_since(at) >= CALM {
            self.since = None;
            return None;
        }
        Some(count.saturating_sub(begun))
    }
}

/// The publishers with conditions.
#[derive(Debug, Default)]
pub(super) struct Publishers {
    spaces: BTreeMap<SpaceId, Rising>,
    clocks: Rising,
    /// False before the first look, which takes the counters as they are.
    has_looked: bool,
}

impl Publishers {
    /// Sets the spaces, and returns their conditions in their first state.
    pub(super) fn follow(&mut self, spaces: BTreeSet<SpaceId>) -> Vec<Entry> {
        self.spaces.retain(|space, _| spaces.contains(space));
        let mut entries = Vec::new();
        for space in spaces {
            self.spaces.entry(space).or_default();
            for fault in ["lost", "drops"] {
                entries.push(Entry::new(identity(Some(space), fault), SEVERITY));
            }
        }
        if !entries.is_empty() {
            entries.push(Entry::new(identity(None, "clock"), SEVERITY));
        }
        entries
    }

    /// Returns true if there are no conditions of publishers.
    pub(super) fn is_empty(&self) -> bool {
        self.spaces.is_empty()
    }

    /// Returns the reports of all conditions.
    pub(super) fn look(
        &mut self,
        seen: &PublisherStates,
        now: Instant,
    ) -> Vec<(NodeId, SourceReport)> {
        let mut reports = Vec::new();
        for (space, rising) in &mut self.spaces {
            let name = space_name(*space);
            let silent = seen
                .heard
                .get(space)
                .map(|at| now.saturating_duration_since(*at));
            let lost = silent.filter(|silent| *silent >= seen.timeout);
            reports.push((
                node(Some(*space), "lost"),
                report(lost.map(|_| format!("the publisher of {name} is lost"))),
            ));
            let count = seen.dropped.get(space).copied().unwrap_or_default();
            if !self.has_looked {
                rising.last = count;
            }
            let dropped = rising.look(count, now);
            reports.push((
                node(Some(*space), "drops"),
                report(
                    dropped.map(|_| format!("values of {name} are dropped; /metrics counts them")),
                ),
            ));
        }
        if !self.has_looked {
            self.clocks.last = seen.early;
        }
        let early = self.clocks.look(seen.early, now);
        reports.push((
            node(None, "clock"),
            report(early.map(|_| {
                "values arrive before they were sent: the clocks of two hosts differ".to_owned()
            })),
        ));
        self.has_looked = true;
        reports
    }
}

fn node(space: Option<SpaceId>, fault: &str) -> NodeId {
    match space {
        Some(space) => NodeId::new(1, format!("UaSpace.Alarms/{space}/{fault}")),
        None => NodeId::new(1, format!("UaSpace.Alarms/{fault}")),
    }
}

fn identity(space: Option<SpaceId>, fault: &str) -> ConditionIdentity {
    let (source, source_name) = match space {
        Some(space) => (address::origin_folder(space), space_name(space)),
        None => (ObjectId::Server.into(), "Server".to_owned()),
    };
    ConditionIdentity {
        node: node(space, fault),
        kind: ConditionType::SystemOffNormal,
        source,
        name: match fault {
            "lost" => format!("{source_name}: publisher lost"),
            "drops" => format!("{source_name}: values dropped"),
            _ => "Clocks differ".to_owned(),
        },
        source_name,
        input: NodeId::null(),
        limits: [None; 4],
        normal: NodeId::null(),
        confirms: false,
        delay: Duration::ZERO,
    }
}

fn report(fault: Option<String>) -> SourceReport {
    SourceReport {
        levels: if fault.is_some() {
            Levels::ON
        } else {
            Levels::NONE
        },
        severity: SEVERITY,
        message: fault.unwrap_or_else(|| "normal".to_owned()),
        quality: StatusCode::Good,
    }
}

/// The severity of faults of publishers.
const SEVERITY: u16 = 700;
/// A counter that does not rise for this time is no fault.
const CALM: Duration = Duration::from_secs(10);

#[cfg(test)]
mod tests {
    use super::*;

    fn active(reports: &[(NodeId, SourceReport)], node: &NodeId) -> bool {
        let found = reports.iter().find(|(each, _)| each == node);
        found.unwrap().1.levels.is_active()
    }

    #[test]
    fn a_space_that_was_heard_and_is_silent_is_lost_and_drops_are_a_fault_while_they_go_on() {
        let space = SpaceId::new(2).unwrap();
        let mut publishers = Publishers::default();
        assert_eq!(publishers.follow(BTreeSet::from([space])).len(), 3);
        let begin = bridge_node::now().monotonic;
        let at = |seconds| begin + Duration::from_secs(seconds);
        let mut seen = PublisherStates {
            timeout: Duration::from_secs(3),
            dropped: BTreeMap::from([(space, 7)]),
            early: 2,
            ..PublisherStates::default()
        };
        let (lost, drops) = (node(Some(space), "lost"), node(Some(space), "drops"));
        let clock = node(None, "clock");
        let first = publishers.look(&seen, at(0));
        for node in [&lost, &drops, &clock] {
            assert!(!active(&first, node), "{node}: what was before counts not");
        }
        seen.heard.insert(space, at(1));
        seen.dropped.insert(space, 8);
        let second = publishers.look(&seen, at(2));
        assert!(!active(&second, &lost) && active(&second, &drops));
        seen.early = 3;
        let third = publishers.look(&seen, at(4));
        assert!(active(&third, &lost) && active(&third, &drops) && active(&third, &clock));
        seen.heard.insert(space, at(13));
        let last = publishers.look(&seen, at(15));
        for node in [&lost, &drops, &clock] {
            assert!(!active(&last, node), "{node}: it is over");
        }
    }
}
