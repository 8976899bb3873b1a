//! Which namespaces of the space this program alone writes, and what it does where somebody else writes them.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::TopicId;
use uadp::discovery::{List, Probe};
use uadp::{PublisherId, SecurityHeader};

use super::{About, Router};
use crate::counters::Reason;
use crate::loop_rule::{Owned, Side, What, may_cross};
use crate::output::Output;
use crate::settings::Now;
use crate::topic::{Role, Topic};

/// The namespaces of ours in which nothing is sent for now.
#[derive(Debug, Default)]
pub(super) struct Claims {
    of: BTreeMap<u16, Claim>,
}

#[derive(Debug, Clone, Copy)]
enum Claim {
    /// Whether somebody else writes it is listened for until then.
    Listening { until: Instant },
    /// Somebody else does.
    Taken { heard: Instant },
}

impl Claims {
    /// When a namespace may be free.
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
    /// Says which namespaces of the space this program alone writes; at first it is all of them. What it wrote in others, or
    /// heard in these, it forgets.
    pub fn set_owned(&mut self, owned: Owned, now: Now) {
        if owned == self.owned {
            return;
        }
        self.owned = owned;
        let moved: Vec<TopicId> = self
            .topics
            .iter()
            .filter(|(topic, entry)| matches!(entry.role, Role::Ours(_)) != self.is_home(**topic))
            .map(|(topic, _)| *topic)
            .collect();
        for topic in moved {
            self.drop_topic(topic);
        }
        self.sort_calls(now);
        if let Some(claims) = &mut self.claims {
            claims.of.retain(|namespace, _| self.owned.has(*namespace));
        }
    }

    /// Whether that topic is of what this program alone writes.
    pub(super) fn is_home(&self, topic: TopicId) -> bool {
        self.owned.is_home(self.settings.own, topic)
    }

    pub(super) fn may_cross(&self, heard_on: Side, what: What, topic: TopicId) -> bool {
        may_cross(self.is_home(topic), heard_on, what)
    }

    /// Listens for a moment if somebody else writes our namespaces, of which it asks, before anything is sent in them. Where
    /// somebody does, nothing is sent until that one has been silent for `receive_timeout`. Does nothing for a program that
    /// has its space for itself.
    pub fn claim(&mut self, now: Now) {
        let Owned::Only(namespaces) = &self.owned else {
            return;
        };
        let until = now.monotonic + LISTEN;
        let claims = self.claims.get_or_insert_default();
        for namespace in namespaces {
            claims
                .of
                .entry(*namespace)
                .or_insert(Claim::Listening { until });
        }
        let mut bytes = self.buffer();
        let probe = Probe::PubSubConnections {
            transport_profile_uris: List::null(),
            include_writer_groups: false,
            include_data_set_writers: false,
        };
        let publisher = Some(PublisherId::UInt16(self.settings.own.into()));
        if probe
            .encode(publisher, SecurityHeader::NONE, &mut bytes)
            .is_ok()
        {
            self.tell(Output::Discovery { bytes });
        }
    }

    /// Somebody else writes a namespace of ours.
    pub(super) fn contend(&mut self, namespace: u16, from: SocketAddr, now: Now) {
        let claims = self.claims.as_mut();
        let Some(claim) = claims.and_then(|claims| claims.of.get_mut(&namespace)) else {
            // It is ours since before that one came.
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

    /// Whether nothing of the topic is sent for now.
    pub(super) fn is_withheld(&self, topic: TopicId) -> bool {
        let (_, namespace, _) = topic.triple();
        let claims = self.claims.as_ref();
        claims.is_some_and(|claims| {
            topic.space == self.settings.own && claims.of.contains_key(&namespace)
        })
    }

    /// Whether somebody else was there first in a namespace of ours.
    pub(super) fn is_taken(&self, namespace: u16) -> bool {
        let claims = self.claims.as_ref();
        let claim = claims.and_then(|claims| claims.of.get(&namespace));
        matches!(claim, Some(Claim::Taken { .. }))
    }

    /// Leaves what waits of the topic where it is, while it is not known whether the namespace is free, or drops it.
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

    /// Begins to send in the namespaces that are free.
    pub(super) fn look_at_claims(&mut self, now: Now) {
        let (_, _, silence) = self.periods();
        let Some(claims) = &mut self.claims else {
            return;
        };
        let over = |claim: &Claim| claim.ends(silence) <= now.monotonic;
        let free = claims.of.iter().filter(|(_, claim)| over(claim));
        let free: Vec<(u16, Claim)> = free.map(|(of, claim)| (*of, *claim)).collect();
        claims.of.retain(|_, claim| !over(claim));
        if claims.of.is_empty() {
            self.claims = None;
        }
        for (namespace, claim) in free {
            let again = matches!(claim, Claim::Taken { .. });
            if again {
                self.tell(Output::Taken {
                    namespace,
                    by: None,
                });
            }
            self.send_again(namespace, again, now);
        }
    }

    /// Sends what waits in a namespace, and announces what is in it; where other things were dropped, with what was kept.
    fn send_again(&mut self, namespace: u16, dropped: bool, now: Now) {
        let ours = |(topic, entry): (&TopicId, &Topic)| {
            let (_, of, _) = topic.triple();
            (of == namespace && matches!(entry.role, Role::Ours(_))).then_some(*topic)
        };
        let topics: Vec<TopicId> = self.topics.iter().filter_map(ours).collect();
        for topic in topics {
            let Some(entry) = self.topics.get_mut(&topic) else {
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
                self.ready.push_back(topic);
            }
            self.announce_again(topic, now);
            self.schedule(topic);
        }
        self.announce_calls(now);
    }

    /// No longer follows a topic. What was counted of it stays.
    fn drop_topic(&mut self, topic: TopicId) {
        let Some(entry) = self.topics.remove(&topic) else {
            return;
        };
        self.others.absorb(&entry.counters);
        if let Role::Theirs(reader) = entry.role
            && let Some(base) = reader.base
        {
            self.base_bytes = self.base_bytes.saturating_sub(base.weight());
        }
        self.forget_described(topic);
    }
}

/// Those who write the same namespace answer within 100 ms.
const LISTEN: Duration = Duration::from_millis(300);
