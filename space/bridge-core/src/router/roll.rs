//! Discovery of the calls of other programs, and announcements of added and removed values and
//! calls.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::time::Duration;

use mappings::{Lasting, SpaceId, TopicId};
use uadp::discovery::{Included, List, Probe, ProbeLimits, ProbeStep, ProbeTimer, Subject};
use uadp::{PublisherId, SecurityHeader};

use super::Router;
use super::discovery::Discovery;
use crate::call::ValueDescription;
use crate::output::Output;
use crate::settings::{Local, Now};
use crate::topic::{Role, Topic};

impl Router {
    /// Sets the description of an own value, and announces it at once and after each change. It is
    /// for a local side with fields as payload, and replaces the description in the mapping.
    pub fn describe_value(&mut self, topic: TopicId, description: ValueDescription, now: Now) {
        if self.values.settings.local != Local::Fields || !self.values.is_home(topic) {
            return;
        }
        let overflow = description.overflow;
        let Some(entry) = self.values.follow(topic, None, now) else {
            return;
        };
        entry.said = Some(Box::new(description));
        let rules = (overflow, Lasting::from(overflow));
        if (entry.overflow, entry.lasting) != rules {
            self.values.requeue(topic, rules);
        }
        self.describe(topic, None, now);
    }

    /// Stops the announcements of an own topic.
    pub(super) fn forget_described(&mut self, topic: TopicId) {
        if let Some(entry) = self.values.topics.get_mut(&topic) {
            entry.said = None;
            entry.description = None;
            entry.announce_at = None;
        }
        let (_, _, writer_id) = topic.triple();
        let Some(discovery) = &mut self.discovery else {
            return;
        };
        for of in [&mut discovery.writers, &mut discovery.actions] {
            if let Some(topics) = of.get_mut(&writer_id) {
                topics.retain(|of| *of != topic);
                if topics.is_empty() {
                    of.remove(&writer_id);
                }
            }
        }
        let actions: Vec<u16> = discovery.actions.keys().copied().collect();
        discovery.announcer.set_actions(actions);
    }

    /// Plans the announcement of an own call.
    pub(super) fn plan_action(&mut self, topic: TopicId, now: Now) {
        let (_, _, writer_id) = topic.triple();
        let discovery = self.discovery(now);
        let since = discovery.since_start(now);
        let topics = discovery.actions.entry(writer_id).or_default();
        if !topics.contains(&topic) {
            topics.push(topic);
            let actions: Vec<u16> = discovery.actions.keys().copied().collect();
            discovery.announcer.set_actions(actions);
        }
        let subject = Subject::ActionMetaData(writer_id);
        // A planned announcement already contains the information.
        let _planned = discovery
            .announcer
            .announce(subject, Included::default(), since)
            .is_ok();
        discovery.reckon();
    }

    /// Handles a probe for the PubSubConnections of a space, which is also used as a probe for its
    /// calls.
    pub(super) fn handle_roll(&mut self, asked: SpaceId, now: Now) {
        if let Some(discovery) = &mut self.discovery {
            let since = discovery.since_start(now);
            if let Some(timer) = discovery.rolls.get_mut(&asked) {
                timer.handle_probe(since);
                discovery.reckon();
            }
        }
        if asked == self.values.settings.own {
            self.announce_calls(now);
        }
    }

    /// Probes the spaces of the mapping and the default spaces for their calls when the program
    /// starts. Otherwise the calls would be known only after their next periodic announcement.
    pub fn call_the_roll(&mut self, now: Now) {
        let declared = self.values.mapping.spaces().iter().map(|space| space.id);
        let usual = [0, 1, 2].into_iter().filter_map(SpaceId::new);
        let spaces: BTreeSet<SpaceId> = declared.chain(usual).collect();
        for space in spaces {
            if space != self.values.settings.own || self.values.settings.own == SpaceId::UA {
                self.ask_for_calls(space, now);
            }
        }
    }

    /// Sends the probes that values need.
    pub(super) fn inquire(&mut self, now: Now) {
        if self.values.inquiries.is_empty() {
            return;
        }
        for topic in self.values.inquiries.take_met() {
            self.meet(topic, now);
        }
        for topic in self.values.inquiries.take_topics() {
            self.plan_probe(topic, now);
        }
        if self.values.inquiries.take_applications() {
            self.ask_applications(now);
        }
    }

    /// Probes a program for its calls when it is first received.
    fn meet(&mut self, topic: TopicId, now: Now) {
        let (_, namespace, _) = topic.triple();
        let discovery = self.discovery(now);
        if discovery.met.len() < MAX_MET && discovery.met.insert((topic.space, namespace)) {
            self.ask_for_calls(topic.space, now);
        }
    }

    fn ask_for_calls(&mut self, space: SpaceId, now: Now) {
        let random = u32::try_from(now.utc.unix_nanos() & 0xFFFF_FFFF).unwrap_or_default();
        let discovery = self.discovery(now);
        let since = discovery.since_start(now);
        let limits = ProbeLimits {
            max_period: Duration::from_secs(1),
            attempts: 2,
        };
        discovery
            .rolls
            .entry(space)
            .or_insert_with(|| ProbeTimer::new(since, random, limits));
        discovery.reckon();
    }

    /// Sends the due probes for calls.
    pub(super) fn call_rolls(
        &mut self,
        discovery: &mut Discovery,
        (since, random): (Duration, u32),
    ) {
        let mut asked = Vec::new();
        discovery.rolls.retain(|space, timer| {
            match timer.poll(since, random.rotate_left(space.get().into())) {
                ProbeStep::Wait => true,
                ProbeStep::Send => {
                    asked.push(*space);
                    true
                }
                ProbeStep::Answered | ProbeStep::GivenUp => false,
            }
        });
        for space in asked {
            let probe = Probe::PubSubConnections {
                transport_profile_uris: List::null(),
                include_writer_groups: false,
                include_data_set_writers: false,
            };
            let mut bytes = self.values.buffer();
            let publisher = Some(PublisherId::UInt16(space.into()));
            if probe
                .encode(publisher, SecurityHeader::NONE, &mut bytes)
                .is_ok()
            {
                self.values.tell(Output::Discovery { bytes });
            }
        }
    }

    /// Completes the probes for a call that is known.
    pub(super) fn answered(&mut self, topic: TopicId, now: Now) {
        let discovery = self.discovery(now);
        discovery.answered(topic.space, |other| other == topic);
        if let Some(timer) = discovery.rolls.get_mut(&topic.space) {
            timer.handle_answer();
            discovery.reckon();
        }
    }

    /// Handles the announcement that a program does not have a value or call any more.
    pub(super) fn unlearn(&mut self, topic: TopicId, from: SocketAddr, now: Now) {
        let timeout = self.values.mapping.pubsub().receive_timeout;
        if let Some(Topic {
            role: Role::Theirs(reader),
            ..
        }) = self.values.topics.get_mut(&topic)
            && reader.may_be(from, now.monotonic, timeout)
        {
            let left = reader.leave();
            if self.values.settings.local != Local::Fields {
                reader.withdraw();
            }
            if left {
                self.values.tell_silence(topic);
            }
            self.values.lose(topic, now);
        }
        self.unlearn_call(topic, from);
        self.settle(now);
    }
}

/// The maximum number of namespaces that are probed for their calls when they are first received.
const MAX_MET: usize = 4_096;
