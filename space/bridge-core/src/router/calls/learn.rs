//! Calls of other programs: their descriptions, their executors, and the detection of lost
//! executors.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{SpaceId, TopicId};
use uadp::discovery::ActionMetaData;

use super::super::DropSite;
use super::executors::{CallState, NamespaceExecutor};
use super::{CallTraffic, RouterCalls};
use crate::call::{CallDescription, CallRole, split_name};
use crate::call_announcement;
use crate::counters::Reason;
use crate::learned::Weight;
use crate::output::Output;
use crate::settings::Now;

impl RouterCalls {
    /// Records a received message with values of the namespace.
    #[inline]
    pub(in super::super) fn heard(
        &mut self,
        space: SpaceId,
        namespace: u16,
        from: SocketAddr,
        now: Now,
    ) {
        let Some(group) = self.groups.get_mut(&(space, namespace)) else {
            return;
        };
        if group.from != from {
            return;
        }
        group.heard = Some(now.monotonic);
        (group.doubted, group.asked) = (None, false);
        if std::mem::take(&mut group.gone) {
            self.revive((space, namespace), now.monotonic);
        }
    }

    /// Records a response of the executor of a call.
    pub(super) fn spoke(&mut self, topic: TopicId) {
        let (_, namespace, _) = topic.triple();
        if let Some(group) = self.groups.get_mut(&(topic.space, namespace)) {
            group.doubted = None;
        }
    }

    /// Restores the calls of a namespace after the return of its executor.
    fn revive(&mut self, of: (SpaceId, u16), now: Instant) {
        for (topic, call) in &mut self.table {
            let (_, namespace, _) = topic.triple();
            if (topic.space, namespace) == of
                && let Some(known) = &mut call.known
                && known.gone
            {
                known.gone = false;
                self.news.push_back(Output::CallKnown {
                    topic: *topic,
                    description: Arc::clone(&known.description),
                });
            }
        }
        self.look_at.get_or_insert(now + LOOK);
        self.reckon();
    }

    /// Returns whether there is room for another call. Removes lost and unused calls if necessary.
    fn has_room(&mut self, weight: usize) -> bool {
        let full = |calls: &Self| {
            calls.table.len() >= MAX_CALLS || calls.weight.saturating_add(weight) > MAX_WEIGHT
        };
        if full(self) {
            let gone = self.table.extract_if(|_, call| {
                let gone = call.known.as_ref().is_none_or(|known| known.gone);
                gone && call.bound.is_none() && call.own.is_none() && call.open == 0
            });
            let freed: usize = gone
                .filter_map(|(_, call)| call.known)
                .map(|known| known.description.weight())
                .sum();
            self.weight -= freed;
        }
        !full(self)
    }
}

impl CallTraffic<'_> {
    /// Handles the announcement of a call of another program.
    pub(in super::super) fn learn_call(
        &mut self,
        action: &ActionMetaData<'_>,
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) {
        let named = action.name().and_then(split_name);
        let named =
            named.filter(|(topic, _)| topic.space == space && topic.triple().2 == action.writer_id);
        let Some((topic, name)) = named else {
            return self
                .values
                .count(DropSite::sender(from), Reason::NotInSpace, 1, String::new);
        };
        let (_, namespace, _) = topic.triple();
        if self.values.is_unsaid(self.security, Some(namespace), from) {
            return;
        }
        if self.values.is_home(topic) {
            return self.values.drop_own(Some(namespace), from, now);
        }
        if !self.values.concern.has_topic(topic) {
            return;
        }
        if self
            .values
            .part
            .as_ref()
            .is_some_and(|part| !part.has(namespace))
        {
            // Another bridge of the space offers it.
            return;
        }
        if !self.may_execute((space, namespace), from, now) {
            // The executor answers the probe. An executor that does not answer in time is lost.
            self.announcements.probe(topic, now);
            let cause = (Reason::MetaData, "sender");
            return self.count_call(topic, Some(from), cause, || {
                "its description comes from a program that does not execute the calls of its namespace"
                    .to_owned()
            });
        }
        match call_announcement::read(action, name) {
            Ok(said) => self.take_in_call(topic, said, from, now),
            Err(why) => {
                let cause = (Reason::MetaData, "useless");
                self.count_call(topic, Some(from), cause, || why.to_string());
            }
        }
    }

    /// Returns whether the sender may be the executor of the calls of the namespace.
    fn may_execute(&mut self, of: (SpaceId, u16), from: SocketAddr, now: Now) -> bool {
        let silences = self.silences();
        // The keys of the group show that a redundant bridge has taken over.
        let is_successor = self.senders.is_active(self.security, (of.0, from));
        let Some(group) = self
            .calls
            .as_mut()
            .and_then(|calls| calls.groups.get_mut(&of))
        else {
            return true;
        };
        let may = group.from == from || is_successor || group.is_silent(now.monotonic, silences);
        if !may {
            group.doubted.get_or_insert(now.monotonic);
        }
        may
    }

    fn take_in_call(
        &mut self,
        topic: TopicId,
        (description, target): (CallDescription, u16),
        from: SocketAddr,
        now: Now,
    ) {
        let (_, namespace, _) = topic.triple();
        let missing = self.missing();
        let calls = self.calls_mut(now);
        let weight = description.weight();
        let before = calls.table.get(&topic).and_then(|call| call.known.as_ref());
        let same = before.is_some_and(|known| *known.description == description);
        let back = before.is_none_or(|known| known.gone);
        let changed = before.map(|known| known.changed);
        if !same && changed.is_some_and(|at| now.monotonic < at + CHANGE_AFTER) {
            // The probe makes the program announce the call again when a change is accepted.
            self.announcements.probe(topic, now);
            let cause = (Reason::MetaData, "too often");
            return self.count_call(topic, Some(from), cause, || {
                "its program changes its description too often".to_owned()
            });
        }
        if !same && !calls.has_room(weight) {
            let cause = (Reason::MetaData, "no room");
            return self.count_call(topic, Some(from), cause, || {
                "the limit of described calls is reached".to_owned()
            });
        }
        let group = calls.groups.entry((topic.space, namespace));
        let group = group.or_insert(NamespaceExecutor {
            from,
            said: now.monotonic,
            heard: None,
            gone: false,
            doubted: None,
            asked: false,
        });
        if group.from != from {
            // The program has restarted.
            (group.from, group.heard) = (from, None);
        }
        group.lives(now.monotonic, missing);
        calls.look_at.get_or_insert(now.monotonic + LOOK);
        let call = calls.table.entry(topic).or_default();
        match &mut call.known {
            Some(known) if same => {
                (known.from, known.target) = (from, target);
                (known.said, known.gone) = (now.monotonic, false);
            }
            known => {
                let before = known.replace(CallState {
                    description: Arc::new(description),
                    from,
                    target,
                    said: now.monotonic,
                    changed: now.monotonic,
                    gone: false,
                });
                calls.weight += weight;
                calls.weight -= before.map_or(0, |known| known.description.weight());
            }
        }
        calls.reckon();
        self.announcements.call_known(topic);
        if same && !back {
            return;
        }
        if let Err(why) = self.compile(topic) {
            let cause = (Reason::Mismatch, "type");
            self.count_call(topic, None, cause, || why.to_string());
        }
        if let Some(calls) = &mut self.calls
            && let Some(known) = calls.table.get(&topic).and_then(|call| call.known.as_ref())
        {
            let description = Arc::clone(&known.description);
            let role = description.role;
            calls
                .news
                .push_back(Output::CallKnown { topic, description });
            self.ask_of_values(topic, role);
        }
    }

    /// Probes for the metadata of the values of an action. The first feedback may be sent with the
    /// first goal, and is dropped if its type is unknown.
    fn ask_of_values(&mut self, topic: TopicId, role: CallRole) {
        let CallRole::Goal(family) = role else {
            return;
        };
        let (space, namespace, _) = topic.triple();
        for id in [family.feedback, family.status] {
            if let Some(value) = TopicId::new(space, namespace, id) {
                self.values.ask_what(value);
            }
        }
    }

    /// Removes a call that its executor does not offer any more.
    pub(in super::super) fn unlearn_call(&mut self, topic: TopicId, from: SocketAddr) {
        let calls = self.calls.as_mut();
        if let Some(calls) = calls
            && let Some(call) = calls.table.get_mut(&topic)
            && let Some(known) = &mut call.known
            && known.from == from
            && !std::mem::replace(&mut known.gone, true)
        {
            calls.news.push_back(Output::CallGone { topic });
        }
    }

    /// Handles an executor that did not answer requests before their timeout. Its calls are lost
    /// unless it answers a probe soon.
    pub(super) fn doubt(&mut self, topic: TopicId, now: Now) {
        let (_, namespace, _) = topic.triple();
        let calls = self.calls.as_mut();
        let group = calls.and_then(|calls| calls.groups.get_mut(&(topic.space, namespace)));
        if let Some(group) = group.filter(|group| !group.gone) {
            group.doubted.get_or_insert(now.monotonic);
            self.announcements.probe(topic, now);
        }
    }

    /// Returns the timeouts for executors with values and without values.
    ///
    /// An executor that sends values is lost when values are overdue and it does not answer a
    /// probe. An executor without values is lost when its announcements are overdue. Either is lost
    /// when it does not answer a probe.
    fn silences(&self) -> (Duration, Duration) {
        let pubsub = self.values.mapping.pubsub();
        let forgotten = pubsub.metadata_period.saturating_mul(MISSED);
        (pubsub.receive_timeout, forgotten)
    }

    /// Returns the time without values after which a program is probed. It leaves enough time for
    /// an answer, and is longer than the keep-alive period.
    fn missing(&self) -> Duration {
        let pubsub = self.values.mapping.pubsub();
        let period = pubsub.keep_alive_period;
        let overdue = period.saturating_add(period / 4);
        overdue.max(pubsub.receive_timeout / 2)
    }

    /// Detects lost executors and reports their calls.
    pub(super) fn look_for_silence(&mut self, now: Now) {
        let silences @ (_, forgotten) = self.silences();
        let missing = self.missing();
        let Some(calls) = &mut self.calls else {
            return;
        };
        if calls.look_at.is_none_or(|at| at > now.monotonic) {
            return;
        }
        calls.forget_executions(now.monotonic);
        for group in calls.groups.values_mut() {
            group.gone = group.is_silent(now.monotonic, silences);
        }
        let mut asked = Vec::new();
        for (topic, call) in &mut calls.table {
            let (_, namespace, _) = topic.triple();
            let Some(known) = &mut call.known else {
                continue;
            };
            let group = calls.groups.get(&(topic.space, namespace));
            let old = now.monotonic.saturating_duration_since(known.said) >= forgotten;
            let silent = group.is_none_or(|group| group.gone);
            if (old || silent) && !std::mem::replace(&mut known.gone, true) {
                calls.news.push_back(Output::CallGone { topic: *topic });
                if group.is_some_and(|group| group.doubted.is_some()) {
                    asked.push(*topic);
                }
            }
            // A single call is probed for all calls of the program.
            let group = calls.groups.get_mut(&(topic.space, namespace));
            if !known.gone
                && let Some(group) = group
                && group.is_to_be_asked(now.monotonic, missing)
            {
                group.asked = true;
                asked.push(*topic);
            }
        }
        calls
            .groups
            .retain(|_, group| now.monotonic.saturating_duration_since(group.said) < forgotten);
        let some = !calls.groups.is_empty() || !calls.executions.is_empty();
        calls.look_at = some.then(|| now.monotonic + LOOK);
        // Another program may execute the calls, or their executor has returned, or it executes
        // calls without sending values.
        for topic in asked {
            self.announcements.probe(topic, now);
        }
    }

    /// Removes the descriptions of calls that became own calls, and own calls that became calls of
    /// other programs.
    pub(in super::super) fn sort_calls(&mut self, now: Now) {
        let (owned, own) = (self.values.owned.clone(), self.values.settings.own);
        let Some(calls) = &mut self.calls else {
            return;
        };
        for (topic, call) in &mut calls.table {
            if !owned.is_home(own, *topic) {
                call.own = None;
            } else if let Some(known) = call.known.take() {
                calls.weight -= known.description.weight();
                if !known.gone {
                    calls.news.push_back(Output::CallGone { topic: *topic });
                }
            }
        }
        self.announce_calls(now);
    }
}

/// The number of announcements that may be lost before a call is considered lost.
const MISSED: u32 = 3;
/// The period of the check for lost executors.
const LOOK: Duration = Duration::from_millis(500);
/// The minimum time between two changes of a call. After each change the port may have to create
/// the call again.
const CHANGE_AFTER: Duration = Duration::from_secs(1);
/// The maximum number of calls, and the maximum number of bytes of their descriptions.
const MAX_CALLS: usize = 4_096;
const MAX_WEIGHT: usize = 4 << 20;
