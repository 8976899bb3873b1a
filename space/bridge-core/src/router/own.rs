//! The namespaces of the space that only this program writes, and the handling of other programs
//! that write them.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::TopicId;
use uadp::discovery::{List, Probe};
use uadp::{PublisherId, SecurityHeader};

use super::{About, Router, Values};
use crate::counters::Reason;
use crate::loop_rule::{Owned, Side, What, may_cross};
use crate::output::Output;
use crate::settings::Now;
use crate::topic::{Role, Topic};

/// The own namespaces in which nothing is sent at the moment.
#[derive(Debug, Default)]
pub(super) struct Claims {
    of: BTreeMap<u16, Claim>,
}

#[derive(Debug, Clone, Copy)]
enum Claim {
    /// The program waits until this time for messages of another writer.
    Listening { until: Instant },
    /// Another program writes the namespace.
    Taken { heard: Instant },
}

impl Claims {
    /// Returns the earliest time at which a namespace may be free.
    pub(super) fn due(&self, silence: Duration) -> Option<Instant> {
        let due = self.of.values().map(|claim| claim.ends(silence));
        due.min()
    }
}

impl Claim {
    fn ends(self, silence: Duration) -> Instant {
        match self {
            Self::Listening { until } => until,
            Self::Taken { heard } => heard + silence,
        }
    }
}

impl Router {
    /// Sets the namespaces of the space that only this program writes; initially all. Own topics in
    /// namespaces that are not owned any more, and received topics in newly owned namespaces, are
    /// removed.
    pub fn set_owned(&mut self, owned: Owned, now: Now) {
        if owned == self.values.owned {
            return;
        }
        self.values.owned = owned;
        let moved: Vec<TopicId> = self
            .values
            .topics
            .iter()
            .filter(|(topic, entry)| {
                matches!(entry.role, Role::Ours(_)) != self.values.is_home(**topic)
            })
            .map(|(topic, _)| *topic)
            .collect();
        for topic in moved {
            self.drop_topic(topic);
        }
        self.sort_calls(now);
        if let Some(claims) = &mut self.values.claims {
            claims
                .of
                .retain(|namespace, _| self.values.owned.has(*namespace));
        }
    }

    /// Probes for other writers of the own namespaces, and waits for a moment before anything is
    /// sent in them. If another program writes a namespace, nothing is sent in it until that
    /// program has been silent for `receive_timeout`. Has no effect for a program that does not
    /// share its space.
    pub fn claim(&mut self, now: Now) {
        let Owned::Only(namespaces) = &self.values.owned else {
            return;
        };
        let until = now.monotonic + LISTEN;
        let claims = self.values.claims.get_or_insert_default();
        for namespace in namespaces {
            claims
                .of
                .entry(*namespace)
                .or_insert(Claim::Listening { until });
        }
        let mut bytes = self.values.buffer();
        let probe = Probe::PubSubConnections {
            transport_profile_uris: List::null(),
            include_writer_groups: false,
            include_data_set_writers: false,
        };
        let publisher = Some(PublisherId::UInt16(self.values.settings.own.into()));
        if probe
            .encode(publisher, SecurityHeader::NONE, &mut bytes)
            .is_ok()
        {
            self.values.tell(Output::Discovery { bytes });
        }
    }

    /// Starts to send in free namespaces.
    pub(super) fn look_at_claims(&mut self, now: Now) {
        let (_, _, silence) = self.values.periods();
        let Some(claims) = &mut self.values.claims else {
            return;
        };
        let over = |claim: &Claim| claim.ends(silence) <= now.monotonic;
        let free = claims.of.iter().filter(|(_, claim)| over(claim));
        let free: Vec<(u16, Claim)> = free.map(|(of, claim)| (*of, *claim)).collect();
        claims.of.retain(|_, claim| !over(claim));
        if claims.of.is_empty() {
            self.values.claims = None;
        }
        for (namespace, claim) in free {
            let again = matches!(claim, Claim::Taken { .. });
            if again {
                self.values.tell(Output::Taken {
                    namespace,
                    by: None,
                });
            }
            self.send_again(namespace, again, now);
        }
    }

    /// Sends the waiting items of a namespace, and announces its topics and calls. If items were
    /// dropped, the kept values are repeated.
    fn send_again(&mut self, namespace: u16, dropped: bool, now: Now) {
        let ours = |(topic, entry): (&TopicId, &Topic)| {
            let (_, of, _) = topic.triple();
            (of == namespace && matches!(entry.role, Role::Ours(_))).then_some(*topic)
        };
        let topics: Vec<TopicId> = self.values.topics.iter().filter_map(ours).collect();
        for topic in topics {
            let Some(entry) = self.values.topics.get_mut(&topic) else {
                continue;
            };
            if let Role::Ours(writer) = &mut entry.role
                && dropped
            {
                writer.begin_round(now.monotonic);
            }
            entry.announce_at = entry.announce_at.map(|_| now.monotonic);
            if !entry.ready && entry.has_more() {
                entry.ready = true;
                self.values.ready.push_back(topic);
            }
            self.announce_again(topic, now);
            self.values.schedule(topic);
        }
        self.announce_calls(now);
    }

    /// Removes a topic and keeps its counters in total.
    fn drop_topic(&mut self, topic: TopicId) {
        let Some(entry) = self.values.topics.remove(&topic) else {
            return;
        };
        self.values.others.absorb(&entry.counters);
        if let Role::Theirs(reader) = entry.role
            && let Some(base) = reader.base
        {
            self.values.base_bytes = self.values.base_bytes.saturating_sub(base.weight());
        }
        self.forget_described(topic);
    }
}

impl Values {
    /// Returns whether only this program writes the topic.
    pub(super) fn is_home(&self, topic: TopicId) -> bool {
        self.owned.is_home(self.settings.own, topic)
    }

    pub(super) fn may_cross(&self, heard_on: Side, what: What, topic: TopicId) -> bool {
        may_cross(self.is_home(topic), heard_on, what)
    }

    /// Records a message of another program in an own namespace.
    pub(super) fn contend(&mut self, namespace: u16, from: SocketAddr, now: Now) {
        let claims = self.claims.as_mut();
        let Some(claim) = claims.and_then(|claims| claims.of.get_mut(&namespace)) else {
            // This program used the namespace before the other program.
            return;
        };
        let before = std::mem::replace(
            claim,
            Claim::Taken {
                heard: now.monotonic,
            },
        );
        if matches!(before, Claim::Listening { .. }) {
            let by = Some(from);
            self.tell(Output::Taken { namespace, by });
        }
    }

    /// Returns whether nothing of the topic may be sent at the moment.
    pub(super) fn is_withheld(&self, topic: TopicId) -> bool {
        let (_, namespace, _) = topic.triple();
        let claims = self.claims.as_ref();
        claims.is_some_and(|claims| {
            topic.space == self.settings.own && claims.of.contains_key(&namespace)
        })
    }

    /// Returns whether another program has used an own namespace before this program.
    pub(super) fn is_taken(&self, namespace: u16) -> bool {
        let claims = self.claims.as_ref();
        let claim = claims.and_then(|claims| claims.of.get(&namespace));
        matches!(claim, Some(Claim::Taken { .. }))
    }

    /// Keeps the waiting items of a topic while it is unknown whether the namespace is free, or
    /// drops them if it is taken.
    pub(super) fn withhold(&mut self, topic: TopicId) {
        let (_, namespace, _) = topic.triple();
        let claim = self.claims.as_ref();
        let claim = claim.and_then(|claims| claims.of.get(&namespace)).copied();
        let Some(entry) = self.topics.get_mut(&topic) else {
            return;
        };
        entry.ready = false;
        if matches!(claim, Some(Claim::Taken { .. })) {
            let mut dropped = u64::from(entry.sending.take().is_some());
            while entry.take(&mut self.spare).is_some() {
                dropped += 1;
            }
            self.count(
                About::topic(topic),
                (Reason::SpaceTaken, "withheld"),
                dropped,
                String::new,
            );
        }
    }
}

/// The time to wait for other writers of a namespace, which respond within 100 ms.
const LISTEN: Duration = Duration::from_millis(300);
