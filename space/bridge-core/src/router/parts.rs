//! Several bridges of the own space that carry different namespaces: nothing of other namespaces
//! crosses this bridge in either direction.

use std::collections::BTreeSet;
use std::net::SocketAddr;

use mappings::SpaceId;
use uadp::NetworkMessage;

use super::{DropSite, Router, TopicQueues};
use crate::counters::Reason;
use crate::output::Output;
use crate::part::{LOST, OwnPart, PartAnnouncement};
use crate::settings::Now;

impl Router {
    /// Lets this program carry only these namespaces, in both directions, because other bridges of
    /// its space carry the others. Its announcements have the name. Nothing crosses until other
    /// bridges had time to respond. Call it after [`set_instance`](Self::set_instance).
    pub fn set_part(&mut self, namespaces: BTreeSet<u16>, name: String, now: Now) {
        let [.., a, b, c, d] = self.instance;
        let instance = u32::from_le_bytes([a, b, c, d]);
        let all = namespaces.iter().copied();
        self.values.claims.claim(all, now.monotonic);
        self.values.part = Some(Box::new(OwnPart::new(namespaces, name, (instance, now))));
    }

    /// Announces the own namespaces if it is due.
    pub(super) fn look_at_part(&mut self, now: Now) {
        let own = self.values.settings.own;
        let is_due = self
            .values
            .part
            .as_mut()
            .is_some_and(|part| part.poll(now.monotonic));
        if !is_due {
            return;
        }
        let mut bytes = self.values.buffer();
        let written = self
            .values
            .part
            .as_ref()
            .map(|part| part.announcement().encode(own, now.utc, &mut bytes));
        match written {
            Some(Ok(())) => self.values.tell(Output::Discovery { bytes }),
            Some(Err(_)) | None => self.values.recycle(bytes),
        }
    }

    /// Handles the announcement of the namespaces of a bridge. Returns false for all other
    /// messages.
    pub(super) fn is_part(
        &mut self,
        message: &NetworkMessage<'_>,
        from: SocketAddr,
        now: Now,
    ) -> bool {
        let Some((space, announced)) = PartAnnouncement::decode(message) else {
            return false;
        };
        let about = DropSite::sender(from);
        if self.security.is_on() && !self.security.is_authentic() {
            let cause = (Reason::Unsecured, "namespaces");
            self.values.count(about, cause, 1, || {
                "its announcement of namespaces is in clear, and there are secured groups"
                    .to_owned()
            });
            return true;
        }
        if space != self.values.settings.own {
            let at = (from, now.monotonic);
            self.other_parts.meet(space, &announced, at);
            return true;
        }
        if self.values.settings.source.is_some() && self.values.is_source(from) {
            return true;
        }
        let Some(part) = &mut self.values.part else {
            let name = announced.name;
            self.values.count(about, (Reason::SpaceTaken, "part"), 1, || {
                format!(
                    "{name} ({from}) carries a part of space {space}, and this program carries all of it: start this \
                     program with --namespaces too"
                )
            });
            return true;
        };
        let (common, is_theirs) = part.overlap(&announced, now.monotonic);
        let (_, _, silence) = self.values.periods();
        // Announcements may be less frequent than values.
        let heard = now.monotonic + LOST.saturating_sub(silence);
        for namespace in common.into_iter().filter(|_| is_theirs) {
            if self.values.claims.take(namespace, heard) {
                self.values.tell(Output::Taken {
                    namespace,
                    by: Some(from),
                    name: announced.name.clone(),
                });
            }
        }
        true
    }
}

impl TopicQueues {
    /// Returns whether another bridge of the space carries the namespace. While that is unknown
    /// after the start, samples wait in their queues.
    pub(super) fn is_elsewhere(&self, namespace: u16) -> bool {
        self.part
            .as_ref()
            .is_some_and(|part| !part.has(namespace) || self.claims.is_taken(namespace))
    }

    /// Returns whether this program carries the namespace: no other bridge of its space does.
    pub(super) fn carries(&self, namespace: u16) -> bool {
        self.part
            .as_ref()
            .is_none_or(|part| part.has(namespace) && !self.claims.withholds(namespace))
    }

    /// Returns whether received values of the namespace are dropped unread: another bridge of the
    /// space delivers them, or this program does not use them. Values in own namespaces show other
    /// writers, and tapped topics show each arrival.
    pub(super) fn is_unused(&self, space: SpaceId, namespace: u16) -> bool {
        let is_used = || {
            self.tap.is_on()
                || self.concern.has(space, namespace)
                || self.is_ours(space, Some(namespace))
        };
        !self.carries(namespace) || !is_used()
    }
}
