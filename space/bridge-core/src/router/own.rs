//! The namespaces of the space that only this program writes, and the handling of other programs
//! that write them.

use std::collections::BTreeSet;
use std::net::SocketAddr;

use mappings::{SpaceId, TopicId};

use super::announcements::ProbedCalls;
use super::claims::FreeNamespace;
use super::{DropSite, Router, TopicQueues};
use crate::counters::Reason;
use crate::interest::Interest;
use crate::loop_rule::{Crosses, Owned, Side, may_cross};
use crate::output::Output;
use crate::settings::Now;
use crate::topic::{Topic, TopicSide};
use crate::topics::Handle;

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
                matches!(entry.role, TopicSide::Ours(_)) != self.values.is_home(*topic)
            })
            .map(|(topic, _)| topic)
            .collect();
        for topic in moved {
            self.drop_topic(topic);
        }
        self.call_traffic().sort_calls(now);
        self.values.claims.retain(&self.values.owned);
    }

    /// Probes for other writers of the own namespaces, and waits for a moment before anything is
    /// sent in them. If another program writes a namespace, nothing is sent in it until that
    /// program has been silent for `receive_timeout`. The probes are repeated, and a writer that is
    /// received in the first seconds only is found too: probes may be lost, and a program that
    /// starts at the same moment does not respond. Has no effect for a program that does not share
    /// its space.
    pub fn claim(&mut self, now: Now) {
        let Owned::Only(namespaces) = &self.values.owned else {
            return;
        };
        let [a, b, c, d, ..] = self.instance;
        let claims = &mut self.values.claims;
        claims.set_random(u32::from_le_bytes([a, b, c, d]));
        claims.claim_by_probes(namespaces.iter().copied(), now.monotonic);
        self.probe_claims(now);
    }

    /// Returns the messages of other programs that this program handles; `None` for all of them.
    /// It changes with each input.
    #[must_use]
    pub fn interest(&self) -> Option<Interest> {
        let TopicQueues {
            concern,
            owned: Owned::Only(owned),
            redundant: None,
            part: None,
            ..
        } = &self.values
        else {
            return None;
        };
        let used = concern.namespaces()?;
        if self.values.tap.is_on() {
            return None;
        }
        let mut topics = self.values.topics.iter();
        if topics.any(|(_, topic)| topic.confirming.is_some()) {
            // Confirmations have the PublisherIds of the bridges.
            return None;
        }
        let own = self.values.settings.own;
        let namespaces = owned.iter().map(|namespace| (own, *namespace));
        let mut announced: BTreeSet<SpaceId> = used.iter().map(|(space, _)| *space).collect();
        if !self.values.claims.is_empty() {
            // The announcements of another writer show that a claimed namespace is taken.
            announced.insert(own);
        }
        Some(Interest {
            namespaces: used.iter().copied().chain(namespaces).collect(),
            announced,
        })
    }

    /// Sends the due probes for other writers of claimed namespaces.
    fn probe_claims(&mut self, now: Now) {
        let own = self.values.settings.own;
        for namespace in self.values.claims.take_probes(now.monotonic) {
            // The programs of other namespaces do not respond: there may be hundreds of them.
            let asked = ProbedCalls::namespace(own, namespace);
            self.values.send_probe(&asked.probe(), Some(own));
        }
    }

    /// Starts to send in free namespaces.
    pub(super) fn look_at_claims(&mut self, now: Now) {
        self.probe_claims(now);
        let (_, _, silence) = self.values.periods();
        for free in self.values.claims.poll(silence, now.monotonic) {
            let FreeNamespace {
                namespace,
                was_taken,
            } = free;
            if was_taken {
                let by = None;
                let name = String::new();
                self.values.tell(Output::Taken {
                    namespace,
                    by,
                    name,
                });
            }
            self.send_again(namespace, was_taken, now);
        }
    }

    /// Sends the waiting items of a namespace, and announces its topics and calls. If items were
    /// dropped, the kept values are repeated.
    fn send_again(&mut self, namespace: u16, dropped: bool, now: Now) {
        for at in self.values.topics.handles() {
            let topic = at.topic();
            let (_, of, _) = topic.triple();
            let Some(Topic {
                role: TopicSide::Ours(writer),
                announce_at,
                ..
            }) = self.values.topics.at_mut(at).filter(|_| of == namespace)
            else {
                continue;
            };
            if dropped {
                writer.begin_round(now.monotonic);
            }
            *announce_at = announce_at.map(|_| now.monotonic);
            self.values.resume(at);
            self.announcements
                .announce_again(&mut self.values, topic, now);
            self.values.schedule(at);
        }
        self.call_traffic().announce_calls(now);
    }

    /// Removes a topic and stops its announcements.
    fn drop_topic(&mut self, topic: TopicId) {
        self.values.remove(topic);
        self.announcements.forget(&mut self.values, topic);
    }
}

impl TopicQueues {
    /// Returns whether only this program writes the topic.
    pub(super) fn is_home(&self, topic: TopicId) -> bool {
        self.owned.is_home(self.settings.own, topic)
    }

    /// Returns whether the topic of the own space has a producer that has not sent a value yet.
    pub(super) fn is_silent(&self, topic: TopicId) -> bool {
        let role = self.topics.get(&topic).map(|entry| &entry.role);
        matches!(role, Some(TopicSide::Ours(writer)) if writer.is_live() && !writer.has_sent())
    }

    pub(super) fn may_cross(&self, heard_on: Side, what: Crosses, topic: TopicId) -> bool {
        may_cross(self.is_home(topic), heard_on, what)
    }

    /// Records a message of another program in an own namespace.
    pub(super) fn contend(&mut self, namespace: u16, from: SocketAddr, now: Now) {
        if self.claims.contend(namespace, now.monotonic) {
            let by = Some(from);
            let name = String::new();
            self.tell(Output::Taken {
                namespace,
                by,
                name,
            });
        }
    }

    /// Returns whether nothing of the topic may be sent at the moment.
    pub(super) fn is_withheld(&self, topic: TopicId) -> bool {
        let (_, namespace, _) = topic.triple();
        let is_elsewhere = self.part.as_ref().is_some_and(|part| !part.has(namespace));
        topic.space == self.settings.own && (self.claims.withholds(namespace) || is_elsewhere)
    }

    /// Keeps the waiting items of a topic while it is unknown whether the namespace is free, or
    /// drops them if it is taken.
    pub(super) fn withhold(&mut self, at: Handle) {
        let topic = at.topic();
        let (_, namespace, _) = topic.triple();
        let is_taken = self.claims.is_taken(namespace);
        let Some(entry) = self.topics.at_mut(at) else {
            return;
        };
        entry.ready = false;
        if is_taken {
            let mut dropped = u64::from(entry.sending.take().is_some());
            while entry.take(&mut self.buffers).is_some() {
                dropped += 1;
            }
            if let Some(gate) = &mut entry.gate {
                gate.forget_last();
            }
            self.count(
                DropSite::topic(topic),
                (Reason::SpaceTaken, "withheld"),
                dropped,
                String::new,
            );
        }
    }
}
