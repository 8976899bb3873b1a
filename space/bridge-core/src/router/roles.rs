//! The changes of the role of a redundant bridge: a standby sends nothing, and an active bridge
//! continues where the former active bridge ended.

use std::net::SocketAddr;
use std::time::Duration;

use uadp::{NetworkMessage, Timestamp};

use super::about::DropSite;
use super::announcements::PlannedAnnouncements;
use super::calls::{CallTraffic, RouterCalls};
use super::security::MessageSecurity;
use super::senders::RedundantSenders;
use super::values::TopicQueues;
use crate::counters::Reason;
use crate::loop_rule::Owned;
use crate::output::Output;
use crate::redundancy::{Heartbeat, RoleChange, SwitchRefusal, TakeoverCause};
use crate::settings::Now;
use crate::topic::PolledSample;

/// The redundancy of the own space with the parts of the Router that a change of the role affects.
pub(super) struct SpaceRedundancy<'r> {
    pub(super) calls: &'r mut Option<Box<RouterCalls>>,
    pub(super) values: &'r mut TopicQueues,
    pub(super) announcements: &'r mut PlannedAnnouncements,
    pub(super) security: &'r MessageSecurity,
    pub(super) senders: &'r mut RedundantSenders,
    pub(super) instance: [u8; 16],
}

impl SpaceRedundancy<'_> {
    fn call_traffic(&mut self) -> CallTraffic<'_> {
        CallTraffic {
            calls: self.calls,
            values: self.values,
            announcements: self.announcements,
            security: self.security,
            senders: self.senders,
            instance: self.instance,
        }
    }

    /// Hands over to a standby.
    pub(super) fn switch_over(&mut self, now: Now) -> Result<(), SwitchRefusal> {
        let redundant = self.values.redundant.as_mut();
        let redundant = redundant.ok_or(SwitchRefusal::NotActive)?;
        // The lease may have ended.
        if let Some(change) = redundant.check(now) {
            self.change(change, now);
            return Err(SwitchRefusal::NotActive);
        }
        let change = redundant.switch_over(now)?;
        self.change(change, now);
        self.handle_timeout(now);
        Ok(())
    }

    /// Records whether the network took the last heartbeat.
    pub(super) fn heartbeat_sent(&mut self, is_sent: bool, now: Now) {
        let redundant = self.values.redundant.as_mut();
        if let Some(change) = redundant.and_then(|of| of.heartbeat_sent(is_sent, now)) {
            self.change(change, now);
        }
    }

    /// Records that there were no keys for a heartbeat.
    pub(super) fn heartbeat_not_sealed(&mut self, now: Now) {
        let redundant = self.values.redundant.as_mut();
        if let Some(change) = redundant.and_then(|of| of.heartbeat_not_sealed(now)) {
            self.change(change, now);
        }
    }

    /// Mutes this program if its lease has ended.
    pub(super) fn check_lease(&mut self, now: Now) {
        let redundant = self.values.redundant.as_mut();
        if let Some(change) = redundant.and_then(|redundant| redundant.check(now)) {
            self.change(change, now);
        }
    }

    /// Sends the heartbeat if it is due, and takes over if the active bridge is lost.
    pub(super) fn handle_timeout(&mut self, now: Now) {
        self.check_lease(now);
        let Some(redundant) = &mut self.values.redundant else {
            return;
        };
        let (is_due, change) = redundant.poll(now);
        if let Some(change) = change {
            self.change(change, now);
        }
        if is_due {
            self.send_heartbeat(now);
        }
    }

    /// Queues the heartbeat before all other outputs.
    fn send_heartbeat(&mut self, now: Now) {
        let mut bytes = self.values.buffer();
        let own = self.values.settings.own;
        let Some(heartbeat) = self.values.redundancy().map(|state| state.heartbeat()) else {
            return;
        };
        match heartbeat.encode(own, now.utc, &mut bytes) {
            Ok(()) => self.values.told.push_front(Output::Heartbeat { bytes }),
            Err(_) => self.values.recycle(bytes),
        }
    }

    /// Handles the heartbeat of a redundant bridge. Returns false for all other messages.
    pub(super) fn is_heartbeat(
        &mut self,
        message: &NetworkMessage<'_>,
        from: SocketAddr,
        now: Now,
    ) -> bool {
        let Some((space, heartbeat)) = Heartbeat::decode(message) else {
            return false;
        };
        if self.security.is_on() && !self.security.is_authentic() {
            let cause = (Reason::Unsecured, "heartbeat");
            self.values.count(DropSite::sender(from), cause, 1, || {
                "its heartbeat is in clear, and there are secured groups".to_owned()
            });
            return true;
        }
        // In space 0, other programs share the space with redundant servers.
        let is_shared = self.values.redundant.is_none() && self.values.owned != Owned::All;
        let is_other = space != self.values.settings.own || is_shared;
        let at = (from, now.monotonic);
        let is_forged = !self.security.is_authentic()
            && match is_other {
                true => self.senders.is_forged(space, &heartbeat, at),
                false => {
                    let state = self.values.redundancy();
                    state.is_some_and(|state| state.is_forged(&heartbeat, from, now.monotonic))
                }
            };
        if is_forged {
            let cause = (Reason::Forged, "heartbeat");
            self.values.count(DropSite::sender(from), cause, 1, || {
                format!(
                    "its heartbeat has the instance of a bridge of space {space} that sends from another address"
                )
            });
            return true;
        }
        if is_other {
            self.senders.meet(space, heartbeat, at);
            return true;
        }
        let Some(redundant) = &mut self.values.redundant else {
            self.values.drop_own(None, from, now);
            return true;
        };
        if let Some(change) = redundant.hear(heartbeat, from, now) {
            self.change(change, now);
        }
        true
    }

    /// Records the clock of the sender of a message that was processed.
    pub(super) fn note_clock(&mut self, sent: Option<Timestamp>, from: SocketAddr, now: Now) {
        // Unsecured messages of a secured group can be forged.
        let is_trusted = !self.security.is_on() || self.security.is_authentic();
        if let Some(redundant) = self.values.redundant.as_mut().filter(|_| is_trusted)
            && let Some(sent) = sent.filter(|sent| sent.time.0 != 0)
        {
            redundant.note_clock(from, sent, now);
        }
    }

    fn change(&mut self, change: RoleChange, now: Now) {
        match change {
            RoleChange::TookOver { gap, cause, .. } => self.take_over((gap, cause), now),
            RoleChange::Muted { .. } => self.stand_by(now),
            RoleChange::CutOff
            | RoleChange::Follows { .. }
            | RoleChange::Rival { .. }
            | RoleChange::SameRank { .. } => {}
        }
        self.values.tell(Output::Role(change));
    }

    /// Empties all queues.
    fn stand_by(&mut self, now: Now) {
        if let Some(redundant) = &mut self.values.redundant {
            redundant.stand_by();
        }
        self.call_traffic().end_term(now);
        for at in self.values.topics.handles() {
            self.values.mute_topic(at.topic(), now);
            self.values.withdraw_states(at);
        }
        self.values.paced.clear();
        // A heartbeat that was made before is outdated.
        self.values.told.retain(|told| {
            !matches!(
                told,
                Output::CommanderLost { .. } | Output::Heartbeat { .. }
            )
        });
    }

    /// Continues where the former active bridge ended. `gap` is the time since its last heartbeat.
    fn take_over(&mut self, of: (Option<Duration>, TakeoverCause), now: Now) {
        // The former active bridge may have sent or published the samples that wait here.
        let topics = self.values.topics.handles();
        for at in &topics {
            self.values.empty_topic(at.topic(), now);
        }
        let Some(redundant) = &mut self.values.redundant else {
            return;
        };
        let left = redundant.take_over(of, now);
        for (topic, count) in left.unsure {
            let cause = (Reason::Takeover, "gap");
            self.values
                .count_only(DropSite::topic(topic), cause, count, String::new);
        }
        for at in topics {
            self.values.continue_own(at, now);
        }
        for state in left.states {
            self.values
                .push_to(state.topic, PolledSample::Delivery(state));
        }
        for reaction in left.losses {
            let topic = reaction.topic;
            self.values.tell(Output::CommanderLost { topic });
            self.values.push_to(topic, PolledSample::Delivery(reaction));
        }
        for buffer in left.spent {
            self.values.recycle(buffer);
        }
        // Its confirmations count after its announcement.
        self.announcements.plan_application(now);
        self.call_traffic().begin_term(now);
    }
}
