//! Calls of other programs: what they are, who executes them, and since when nobody does.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{SpaceId, TopicId};
use uadp::discovery::ActionMetaData;

use super::super::{About, Router};
use super::Calls;
use crate::call::{CallDescription, CallRole, split_name};
use crate::call_announcement;
use crate::counters::Reason;
use crate::learned::Weight;
use crate::output::Output;
use crate::settings::Now;

/// What is known of a call.
#[derive(Debug)]
pub(super) struct Known {
    pub(super) description: Arc<CallDescription>,
    /// Who executes it.
    pub(super) from: SocketAddr,
    /// ActionTargetId of it in this life of that program.
    pub(super) target: u16,
    /// When that was last said.
    said: Instant,
    /// When it was last another than before.
    changed: Instant,
    /// The port holds it to be gone.
    pub(super) gone: bool,
}

/// Who executes the calls of a namespace: one program, which in most cases sends values there too.
#[derive(Debug)]
pub(super) struct Group {
    from: SocketAddr,
    /// When it last said something of a call.
    said: Instant,
    /// When values of it were last heard. `None` where it has none, or said so after the last of them had ended.
    heard: Option<Instant>,
    /// It is silent.
    gone: bool,
    /// Since when it was asked what its calls are, and nothing is heard of it: somebody else says that it has them, or it
    /// executes nothing.
    doubted: Option<Instant>,
    /// It was asked what its calls are, since its values are missing.
    asked: bool,
}

impl Group {
    /// Whether its values are missing for so long that it is to be asked whether it lives. The values of a producer that has
    /// left end, and the program that executes the calls may be there all the same.
    fn is_to_be_asked(&self, now: Instant, missing: Duration) -> bool {
        !self.gone && !self.asked && self.lacks_values(now, missing)
    }

    fn lacks_values(&self, now: Instant, missing: Duration) -> bool {
        self.heard
            .is_some_and(|heard| now.saturating_duration_since(heard) >= missing)
    }

    /// It said what its calls are. One whose values are missing sends none until the next of them comes.
    fn lives(&mut self, now: Instant, missing: Duration) {
        if self.lacks_values(now, missing) {
            self.heard = None;
        }
        (self.said, self.gone) = (now, false);
        (self.doubted, self.asked) = (None, false);
    }

    /// Whether nothing is heard of it any more.
    fn is_silent(&self, now: Instant, (silence, forgotten): (Duration, Duration)) -> bool {
        let since = |at: Instant| now.saturating_duration_since(at);
        if self.doubted.is_some_and(|at| since(at) >= silence) {
            return true;
        }
        match self.heard {
            Some(heard) => since(heard) >= silence,
            None => since(self.said) >= forgotten,
        }
    }
}

impl Calls {
    /// A message of values of that namespace came.
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

    /// The program that executes a call spoke of it.
    pub(super) fn spoke(&mut self, topic: TopicId) {
        let (_, namespace, _) = topic.triple();
        if let Some(group) = self.groups.get_mut(&(topic.space, namespace)) {
            group.doubted = None;
        }
    }

    /// The program of a namespace is back: its calls are there again.
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

    /// Whether there is room for one more.
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

impl Router {
    /// Takes in what a program says of one of its calls.
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
            return self.count(About::sender(from), Reason::NotInSpace, 1, String::new);
        };
        let (_, namespace, _) = topic.triple();
        if self.guard.is_some() && self.is_unsaid(Some(namespace), from) {
            return;
        }
        if self.is_home(topic) {
            return self.drop_own(Some(namespace), from, now);
        }
        if !self.may_execute((space, namespace), from, now) {
            // Who does execute them answers; who does not within the time is gone.
            self.plan_probe(topic, now);
            let cause = (Reason::MetaData, "sender");
            return self.count_call(topic, Some(from), cause, || {
                "another program than the one that executes the calls of its namespace says what it is"
                    .to_owned()
            });
        }
        match call_announcement::read(action, name) {
            Ok(said) => self.take_in_call(topic, said, from, now),
            Err(why) => {
                let cause = (Reason::MetaData, "useless");
                self.count_call(topic, Some(from), cause, || why);
            }
        }
    }

    /// Whether what is said from there may be of the program that executes the calls of that namespace.
    fn may_execute(&mut self, of: (SpaceId, u16), from: SocketAddr, now: Now) -> bool {
        let silences = self.silences();
        let Some(group) = self
            .calls
            .as_mut()
            .and_then(|calls| calls.groups.get_mut(&of))
        else {
            return true;
        };
        let may = group.from == from || group.is_silent(now.monotonic, silences);
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
            // Once it may be another, it is asked what it is.
            self.plan_probe(topic, now);
            let cause = (Reason::MetaData, "too often");
            return self.count_call(topic, Some(from), cause, || {
                "its program says too often that it is something else".to_owned()
            });
        }
        if !same && !calls.has_room(weight) {
            let cause = (Reason::MetaData, "no room");
            return self.count_call(topic, Some(from), cause, || {
                "there is no room for what more calls are".to_owned()
            });
        }
        let group = calls.groups.entry((topic.space, namespace));
        let group = group.or_insert(Group {
            from,
            said: now.monotonic,
            heard: None,
            gone: false,
            doubted: None,
            asked: false,
        });
        if group.from != from {
            // A program that was started anew.
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
                let before = known.replace(Known {
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
        self.answered(topic, now);
        if same && !back {
            return;
        }
        if let Err(why) = self.compile(topic) {
            self.count_call(topic, None, (Reason::Mismatch, "type"), || why);
        }
        if let Some(calls) = &mut self.calls
            && let Some(known) = calls.table.get(&topic).and_then(|call| call.known.as_ref())
        {
            let description = Arc::clone(&known.description);
            let role = description.role;
            calls
                .news
                .push_back(Output::CallKnown { topic, description });
            self.ask_of_values(topic, role, now);
        }
    }

    /// Asks what the values of an action are: the first feedback may come with the first goal, and is none before that is known.
    fn ask_of_values(&mut self, topic: TopicId, role: CallRole, now: Now) {
        let CallRole::Goal(family) = role else {
            return;
        };
        let (space, namespace, _) = topic.triple();
        for id in [family.feedback, family.status] {
            if let Some(value) = TopicId::new(space, namespace, id) {
                self.ask_what(value, now);
            }
        }
    }

    /// Takes in that a program no longer executes a call.
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

    /// Who executes a call has let requests for it go unanswered until it was taken for lost: unless it says soon what its calls
    /// are, they are gone.
    pub(super) fn doubt(&mut self, topic: TopicId, now: Now) {
        let (_, namespace, _) = topic.triple();
        let calls = self.calls.as_mut();
        let group = calls.and_then(|calls| calls.groups.get_mut(&(topic.space, namespace)));
        if let Some(group) = group.filter(|group| !group.gone) {
            group.doubted.get_or_insert(now.monotonic);
            self.plan_probe(topic, now);
        }
    }

    /// Who sends values is gone when they are missing and it does not say, asked, that it has none any more; who sends none,
    /// when its announcements are; and either when it is asked in vain.
    fn silences(&self) -> (Duration, Duration) {
        let pubsub = self.mapping.pubsub();
        let forgotten = pubsub.metadata_period.saturating_mul(MISSED);
        (pubsub.receive_timeout, forgotten)
    }

    /// How long no value comes before a program is asked whether it lives: early enough for an answer, and never before the
    /// next keep-alive is overdue.
    fn missing(&self) -> Duration {
        let pubsub = self.mapping.pubsub();
        let period = pubsub.keep_alive_period;
        let overdue = period.saturating_add(period / 4);
        overdue.max(pubsub.receive_timeout / 2)
    }

    /// Tells of the calls that nobody executes any longer.
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
            // One of its calls is asked for in the name of all.
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
        // Somebody else may have them, or they are back, or they are there without values.
        for topic in asked {
            self.plan_probe(topic, now);
        }
    }

    /// Forgets what is known of calls that are ours now, and what we offer of those that are not.
    pub(in super::super) fn sort_calls(&mut self, now: Now) {
        let (owned, own) = (self.owned.clone(), self.settings.own);
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

/// Announcements that may be lost before a call is held to be gone.
const MISSED: u32 = 3;
/// How often it is looked who is silent.
const LOOK: Duration = Duration::from_millis(500);
/// A call is not another more often than that: the port may have to offer it anew each time.
const CHANGE_AFTER: Duration = Duration::from_secs(1);
/// Calls there may be, and bytes of what they take and give.
const MAX_CALLS: usize = 4_096;
const MAX_WEIGHT: usize = 4 << 20;
