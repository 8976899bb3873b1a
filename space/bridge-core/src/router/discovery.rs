//! Announcements and probes of other programs.

use std::collections::BTreeSet;
use std::net::SocketAddr;

use mappings::{Lasting, SpaceId, TopicId};
use messages::{MessageType, Selection};
use uadp::discovery::{AnnouncedContent, Announcement, DataSetMetaDataType, Probe};
use uadp::{NetworkMessage, NetworkMessageType, PublisherId, StatusCode};

use super::announcements::ProbedCalls;
use super::receive::DISCOVERY;
use super::values::TopicQueues;
use super::{DropSite, Router};
use crate::application::Application;
use crate::call::{ValueDescription, split_name};
use crate::counters::Reason;
use crate::loop_rule::Owned;
use crate::settings::{Local, Now};

impl Router {
    /// Sets the description of this program. It is announced once, and in response to probes for
    /// applications or for its Endpoints. The other applications are probed once, unless this
    /// program is [limited](Self::limit_to): in a group of hundreds, all of them would respond to
    /// each new one. A program without values is discovered by this description.
    pub fn introduce(&mut self, own: Application, now: Now) {
        self.announcements.introduce(own, now);
        if !self.values.concern.is_limited() {
            self.announcements.probe_applications(now);
        }
    }

    /// Returns the known other applications of the group with the space and the address of each.
    pub fn applications(&self) -> impl Iterator<Item = (SpaceId, SocketAddr, &Application)> {
        self.announcements.applications()
    }

    /// Sets the description of an own value, and announces it at once and after each change. It is
    /// for a local side with fields as payload, and replaces the description in the mapping.
    pub fn describe_value(&mut self, topic: TopicId, description: ValueDescription, now: Now) {
        if self.values.settings.local != Local::Fields || !self.values.is_home(topic) {
            return;
        }
        let overflow = description.overflow;
        let at = self.values.follow(topic, now);
        let Some(entry) = self.values.topics.at_mut(at) else {
            return;
        };
        entry.said = Some(Box::new(description));
        let rules = (overflow, Lasting::from(overflow));
        if (entry.overflow, entry.lasting) != rules {
            self.values.requeue(topic, rules);
        }
        self.describe(topic, None, now);
    }

    /// Limits this program to the namespaces of these topics and of the [wanted](Self::want_call)
    /// calls. Values, descriptions and calls of other namespaces are neither decoded nor stored nor
    /// counted. The namespaces of the own space stay under observation for other writers.
    pub fn limit_to(&mut self, topics: impl IntoIterator<Item = TopicId>) {
        self.values.concern.limit();
        for topic in topics {
            self.values.concern.add(topic);
        }
    }

    /// Probes the spaces of the mapping and the default spaces for their calls when the program
    /// starts. Otherwise the calls would be known only after their next periodic announcement. A
    /// [limited](Self::limit_to) program probes its namespaces only.
    pub fn call_the_roll(&mut self, now: Now) {
        if let Some(namespaces) = self.values.concern.namespaces() {
            for (space, namespace) in namespaces {
                let asked = ProbedCalls::namespace(*space, *namespace);
                self.announcements.probe_calls(asked, now);
            }
            return;
        }
        let own = self.values.settings.own;
        let declared = self.values.mapping.spaces().iter().map(|space| space.id);
        let usual = [0, 1, 2].into_iter().filter_map(SpaceId::new);
        let spaces: BTreeSet<SpaceId> = declared.chain(usual).collect();
        for space in spaces {
            if space != own || own == SpaceId::UA {
                self.announcements
                    .probe_calls(ProbedCalls::space(space), now);
            }
        }
    }

    /// Counts an announcement or probe that could not be sent.
    pub fn not_announced(&mut self, reason: Reason, detail: &str) {
        self.values
            .count(DropSite::NOTHING, (reason, "socket"), 1, || {
                detail.to_owned()
            });
    }

    /// Announces a topic of the own space with its type.
    pub(super) fn describe(
        &mut self,
        topic: TopicId,
        message: Option<(&MessageType, &Selection)>,
        now: Now,
    ) {
        self.announcements
            .describe(&mut self.values, topic, message, now);
    }

    /// Plans the probes that values need.
    pub(super) fn inquire(&mut self, now: Now) {
        self.announcements.inquire(&mut self.values, now);
    }

    /// Sends the due announcements and probes.
    pub(super) fn announce_due(&mut self, now: Now) {
        let calls = self.calls.as_deref();
        let announce_call = |values: &mut TopicQueues, topic: TopicId, number: u16| {
            if let Some(calls) = calls {
                calls.announce(values, topic, number, now);
            }
        };
        self.announcements
            .handle_timeout(&mut self.values, announce_call, now);
    }

    /// Handles a probe without a particular Publisher. Returns false for all other messages.
    pub(super) fn is_for_all(
        &mut self,
        message: &NetworkMessage<'_>,
        from: SocketAddr,
        now: Now,
    ) -> bool {
        if message.message_type() != NetworkMessageType::Probe
            || !matches!(message.publisher_id(), None | Some(PublisherId::Byte(0)))
            || Probe::decode(message) != Ok(Probe::FindApplications)
        {
            return false;
        }
        let ours = self.values.settings.source.is_some() && self.values.is_source(from);
        if !ours {
            self.announcements
                .handle_application_probe(&Probe::FindApplications, now);
        }
        true
    }

    /// Handles a probe or an announcement from or to the Publisher of `space`.
    pub(super) fn handle_discovery(
        &mut self,
        message: &NetworkMessage<'_>,
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) {
        let own = self.values.settings.own;
        if message.message_type() == NetworkMessageType::Probe {
            self.handle_probe(message, (space, from), now);
        } else if space == own
            && (self.values.is_redundant_peer(from) || self.values.part.is_some())
            && !self.values.is_source(from)
        {
            // Another bridge of the space announces its own part, or what this program announces
            // when it is active.
        } else if space == own && (self.values.owned == Owned::All || self.values.is_source(from)) {
            if !self.values.follow_peer(message, None, from, now) {
                self.values.drop_own(None, from, now);
            }
        } else if message.is_chunk() && !message.is_sealed() {
            self.handle_chunk(message, (space, 0), from, now);
        } else {
            match Announcement::decode(message) {
                Ok(announcement) => {
                    self.values.meet_confirmer(space, from);
                    self.learn(&announcement, (space, from), now);
                }
                Err(error) => self.values.drop_undecoded(None, from, &error),
            }
        }
    }

    fn handle_probe(
        &mut self,
        message: &NetworkMessage<'_>,
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) {
        let own = self.values.settings.own;
        match Probe::decode(message) {
            Ok(Probe::DataSetMetaData(ids)) => {
                self.announcements.handle_probe(ids, (space, own), now);
            }
            // Own probes are received, too.
            Ok(Probe::PubSubConnections { .. }) if self.values.is_source(from) => {}
            Ok(Probe::PubSubConnections { .. }) => {
                // It is also used as a probe for calls.
                self.announcements
                    .handle_roll(ProbedCalls::space(space), now);
                if space == own {
                    self.call_traffic().announce_calls(now);
                    self.announcements.plan_silent(&self.values, now);
                }
            }
            Ok(Probe::WriterGroupConfiguration {
                writer_group_id: namespace,
                include_data_set_writers: false,
            }) => {
                // Own probes are received, too.
                if !self.values.is_source(from) {
                    let asked = ProbedCalls::namespace(space, namespace);
                    self.announcements.handle_roll(asked, now);
                    if space == own {
                        self.call_traffic().announce_calls_of(namespace, now);
                    }
                }
            }
            Ok(probe @ (Probe::PublisherEndpoints | Probe::FindApplications)) => {
                if probe == Probe::FindApplications || space == own {
                    self.announcements.handle_application_probe(&probe, now);
                }
            }
            // Probes for configurations are not supported.
            Ok(_) => self.values.drop_undecoded(None, from, &DISCOVERY),
            Err(error) => self.values.drop_undecoded(None, from, &error),
        }
    }

    /// Handles the announcement of a writer of another space.
    pub(super) fn learn(
        &mut self,
        announcement: &Announcement<'_>,
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) {
        match &announcement.announced {
            AnnouncedContent::ActionMetaData(action) => {
                self.call_traffic().learn_call(action, (space, from), now);
            }
            // A limited program does not use the descriptions of others.
            AnnouncedContent::ApplicationDescription { .. } if self.values.concern.is_limited() => {
            }
            AnnouncedContent::ApplicationDescription {
                description,
                capabilities,
            } => self.announcements.meet_application(
                &mut self.values,
                (description, *capabilities),
                (space, from),
                now,
            ),
            AnnouncedContent::DataSetMetaData {
                writer_id,
                meta_data,
                status,
            } => {
                let named = meta_data.name.and_then(split_name);
                let namespace = named.map(|(topic, _)| topic.triple().1);
                if self.values.is_unsaid(&self.security, namespace, from) {
                    return;
                }
                self.learn_value((*writer_id, *status), meta_data, (space, from), now);
            }
            AnnouncedContent::PublisherEndpoints { .. }
            | AnnouncedContent::DataSetWriterConfiguration { .. }
            | AnnouncedContent::PubSubConnections(_)
            | AnnouncedContent::PubSubConnection { .. }
            | AnnouncedContent::ApplicationStatus { .. }
            | AnnouncedContent::ActionResponder(_) => {
                self.values.drop_undecoded(None, from, &DISCOVERY);
            }
        }
    }

    /// Handles the metadata of a topic, or the announcement that a topic does not exist.
    fn learn_value(
        &mut self,
        (writer_id, status): (u16, StatusCode),
        meta_data: &DataSetMetaDataType<'_>,
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) {
        let named = meta_data.name.and_then(split_name);
        let topic = named.map(|(topic, _)| topic);
        let topic = topic.filter(|topic| topic.space == space && topic.triple().2 == writer_id);
        if let Some(topic) = topic.filter(|topic| self.values.is_home(*topic)) {
            let (_, namespace, _) = topic.triple();
            return self.values.drop_own(Some(namespace), from, now);
        }
        let bad = status.0 & STATUS_BAD != 0;
        match topic {
            // This program uses no values of the namespace.
            Some(topic) if !self.values.concern.has_topic(topic) => {}
            Some(topic) if bad => {
                self.values.unlearn(topic, from, now);
                let mut calls = self.call_traffic();
                calls.unlearn_call(topic, from);
                calls.settle(now);
            }
            Some(topic) => {
                let announcements = &mut self.announcements;
                let answered = || announcements.answered(space, |other| other == topic);
                self.values.learn(topic, (meta_data, from), answered, now);
            }
            None if bad => {
                let denial = (writer_id, (space, from));
                self.announcements
                    .handle_denial(&mut self.values, denial, now);
            }
            None => {
                let about = DropSite::sender(from);
                self.values.count(about, Reason::NotInSpace, 1, String::new);
            }
        }
    }
}

/// The severity of a Bad StatusCode (OPC 10000-4, 7.39.1).
const STATUS_BAD: u32 = 0x8000_0000;
