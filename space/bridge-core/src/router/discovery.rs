//! Metadata of topics: announcements of own topics, and discovery of the topics of other spaces.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::{Mapping, SpaceId, TopicId};
use uadp::discovery::{
    AnnounceLimits, Announced, Announcement, Announcer, DataSetMetaDataType, Included, List, Probe,
    ProbeLimits, ProbeStep, ProbeTimer, Subject,
};
use uadp::{NetworkMessage, NetworkMessageType, PublisherId, SecurityHeader, StatusCode};

use super::applications::Applications;
use super::receive::DISCOVERY;
use super::{About, Router, Values};
use crate::call::split_name;
use crate::counters::Reason;
use crate::description::Described;
use crate::layout::Layout;
use crate::learned::{News, Rank};
use crate::loop_rule::Owned;
use crate::output::Output;
use crate::reader::Ask;
use crate::settings::{Local, Now};
use crate::topic::{Role, Topic};

/// Planned announcements and probes, and received metadata.
#[derive(Debug)]
pub(super) struct Discovery {
    /// The origin of time for the timers.
    start: Instant,
    pub(super) announcer: Announcer,
    /// Topics of the own space by DataSetWriterId, because a probe contains only DataSetWriterIds.
    pub(super) writers: BTreeMap<u16, Vec<TopicId>>,
    /// Own calls by DataSetWriterId.
    pub(super) actions: BTreeMap<u16, Vec<TopicId>>,
    /// The spaces that are probed for their calls.
    pub(super) rolls: BTreeMap<SpaceId, ProbeTimer>,
    /// Namespaces with a program that was already probed for its calls.
    pub(super) met: HashSet<(SpaceId, u16)>,
    /// The Publishers that are probed for metadata.
    probing: BTreeMap<SpaceId, Probing>,
    pub(super) applications: Applications,
    /// The time of the next action. It is read in every iteration and computed only after changes.
    due: Option<Instant>,
}

/// The pending probe of a Publisher.
#[derive(Debug)]
struct Probing {
    timer: ProbeTimer,
    topics: BTreeSet<TopicId>,
}

impl Discovery {
    fn new(own: SpaceId, start: Instant) -> Self {
        let limits = AnnounceLimits {
            // Programs that receive the same probe respond at different times.
            gather: Duration::from_millis(50 + u64::from(own.get() % 50)),
            ..AnnounceLimits::default()
        };
        Self {
            start,
            announcer: Announcer::new([], limits),
            writers: BTreeMap::new(),
            actions: BTreeMap::new(),
            rolls: BTreeMap::new(),
            met: HashSet::new(),
            probing: BTreeMap::new(),
            applications: Applications::default(),
            due: None,
        }
    }

    pub(super) fn since_start(&self, now: Now) -> Duration {
        now.monotonic.saturating_duration_since(self.start)
    }

    pub(super) fn reckon(&mut self) {
        let probes = self.probing.values();
        let probes = probes.filter_map(|probing| probing.timer.poll_timeout());
        let rolls = self.rolls.values().filter_map(ProbeTimer::poll_timeout);
        let next = probes
            .chain(rolls)
            .chain(self.applications.poll_timeout())
            .chain(self.announcer.poll_timeout())
            .min();
        self.due = next.map(|due| self.start + due);
    }

    pub(super) fn plan(&mut self, topic: TopicId, now: Now) {
        let since = self.since_start(now);
        let (_, _, writer_id) = topic.triple();
        let subject = Subject::DataSetMetaData(writer_id);
        // A planned announcement already contains the information.
        let _planned = self
            .announcer
            .announce(subject, Included::default(), since)
            .is_ok();
        self.reckon();
    }

    /// Removes topics of a Publisher from its pending probe.
    pub(super) fn answered(&mut self, space: SpaceId, is_it: impl Fn(TopicId) -> bool) {
        if let Some(probing) = self.probing.get_mut(&space) {
            probing.topics.retain(|topic| !is_it(*topic));
            if probing.topics.is_empty() {
                self.probing.remove(&space);
            }
            self.reckon();
        }
    }
}

impl Router {
    pub(super) fn discovery(&mut self, now: Now) -> &mut Discovery {
        let own = self.values.settings.own;
        self.discovery
            .get_or_insert_with(|| Box::new(Discovery::new(own, now.monotonic)))
    }

    /// Returns the time of the next call of [`discover`](Self::discover).
    pub(super) fn discovery_due(&self) -> Option<Instant> {
        self.discovery.as_ref()?.due
    }

    /// Sends due announcements and probes.
    pub(super) fn discover(&mut self, now: Now) {
        if self.discovery_due().is_none_or(|due| due > now.monotonic) {
            return;
        }
        let Some(mut discovery) = self.discovery.take() else {
            return;
        };
        let since = discovery.since_start(now);
        while let Some(due) = discovery.announcer.poll(since) {
            if matches!(
                due.subject,
                Subject::ApplicationInformation | Subject::PublisherEndpoints
            ) {
                let endpoints = due.subject == Subject::PublisherEndpoints;
                self.tell_application(&discovery, endpoints, due.sequence_number);
                continue;
            }
            let (Subject::DataSetMetaData(writer_id) | Subject::ActionMetaData(writer_id)) =
                due.subject
            else {
                continue;
            };
            let values = discovery.writers.get(&writer_id);
            let calls = discovery.actions.get(&writer_id);
            for topic in values.into_iter().flatten() {
                self.announce(*topic, due.sequence_number, now);
            }
            for topic in calls.into_iter().flatten() {
                self.announce_call(*topic, due.sequence_number, now);
            }
            // If several programs share the space, another program may have the writer.
            if values.is_none() && calls.is_none() && self.values.owned == Owned::All {
                self.deny(writer_id, due.sequence_number);
            }
        }
        // The clock is random enough to probe at another time than other programs.
        let random = u32::try_from(now.utc.unix_nanos() & 0xFFFF_FFFF).unwrap_or_default();
        let spaces: Vec<SpaceId> = discovery.probing.keys().copied().collect();
        for space in spaces {
            let Some(probing) = discovery.probing.get_mut(&space) else {
                continue;
            };
            match probing
                .timer
                .poll(since, random.rotate_left(space.get().into()))
            {
                ProbeStep::Wait => {}
                ProbeStep::Send => self.probe(space, &probing.topics),
                ProbeStep::Answered | ProbeStep::GivenUp => {
                    discovery.probing.remove(&space);
                }
            }
        }
        self.call_rolls(&mut discovery, (since, random));
        self.ask_all(&mut discovery, (since, random));
        discovery.reckon();
        self.discovery = Some(discovery);
    }

    /// Probes a Publisher for the metadata of some of its topics.
    fn probe(&mut self, space: SpaceId, topics: &BTreeSet<TopicId>) {
        let ids: BTreeSet<u16> = topics.iter().map(|topic| topic.triple().2).collect();
        let ids: Vec<u16> = ids.into_iter().take(MAX_ASKED).collect();
        let mut bytes = self.values.buffer();
        let publisher = Some(PublisherId::UInt16(space.into()));
        if Probe::DataSetMetaData(List::new(&ids))
            .encode(publisher, SecurityHeader::NONE, &mut bytes)
            .is_ok()
        {
            self.values.tell(Output::Discovery { bytes });
        }
    }

    pub(super) fn plan_probe(&mut self, topic: TopicId, now: Now) {
        let random = u32::try_from(now.utc.unix_nanos() & 0xFFFF_FFFF).unwrap_or_default();
        let discovery = self.discovery(now);
        let since = discovery.since_start(now);
        let probing = discovery
            .probing
            .entry(topic.space)
            .or_insert_with(|| Probing {
                timer: ProbeTimer::new(since, random, ProbeLimits::default()),
                topics: BTreeSet::new(),
            });
        // Other topics are announced periodically.
        if probing.topics.len() < MAX_ASKED {
            probing.topics.insert(topic);
        }
        discovery.reckon();
    }

    /// Handles a probe or an announcement from or to the Publisher of `space`.
    pub(super) fn handle_discovery(
        &mut self,
        message: &NetworkMessage<'_>,
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) {
        if message.message_type() == NetworkMessageType::Probe {
            match Probe::decode(message) {
                Ok(Probe::DataSetMetaData(ids)) => self.handle_probe(ids, space, now),
                // Own probes are received, too.
                Ok(Probe::PubSubConnections { .. }) if !self.values.is_source(from) => {
                    self.handle_roll(space, now);
                }
                Ok(Probe::PubSubConnections { .. }) => {}
                Ok(probe @ (Probe::PublisherEndpoints | Probe::FindApplications)) => {
                    let is_all = probe == Probe::FindApplications;
                    if is_all || space == self.values.settings.own {
                        self.is_asked(&probe, now);
                    }
                }
                // Probes for configurations are not supported.
                Ok(_) => self.values.drop_undecoded(None, from, &DISCOVERY),
                Err(error) => self.values.drop_undecoded(None, from, &error),
            }
        } else if space == self.values.settings.own
            && (self.values.owned == Owned::All || self.values.is_source(from))
        {
            if !self.follow_peer(message, None, from, now) {
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

    fn handle_probe(&mut self, ids: List<'_, u16>, asked: SpaceId, now: Now) {
        let own = self.values.settings.own;
        let discovery = self.discovery(now);
        let since = discovery.since_start(now);
        if asked == own {
            let probe = Probe::DataSetMetaData(ids);
            discovery.announcer.handle_probe(&probe, since);
        }
        if let Some(probing) = discovery.probing.get_mut(&asked) {
            // A single pass: a datagram has room for 32 000 ids, and each pass decodes all of them.
            let mut missing: BTreeSet<u16> = probing.topics.iter().map(|t| t.triple().2).collect();
            for id in ids {
                missing.remove(&id);
                if missing.is_empty() {
                    probing.timer.handle_probe(since);
                    break;
                }
            }
        }
        discovery.reckon();
    }

    /// Handles the announcement of a writer of another space.
    pub(super) fn learn(
        &mut self,
        announcement: &Announcement<'_>,
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) {
        if let Announced::ActionMetaData(action) = &announcement.announced {
            self.learn_call(action, (space, from), now);
            return;
        }
        if let Announced::ApplicationDescription {
            description,
            capabilities,
        } = &announcement.announced
        {
            self.meet_application((description, *capabilities), (space, from), now);
            return;
        }
        let Announced::DataSetMetaData {
            writer_id,
            meta_data,
            status,
        } = &announcement.announced
        else {
            self.values.drop_undecoded(None, from, &DISCOVERY);
            return;
        };
        let named = meta_data.name.and_then(split_name);
        let namespace = named.map(|(topic, _)| topic.triple().1);
        if self.guard.is_some() && self.is_unsaid(namespace, from) {
            return;
        }
        let Some(topic) = self.subject_of((*writer_id, *status), meta_data, (space, from), now)
        else {
            return;
        };
        let about = About {
            topic: Some(topic),
            from: Some(from),
        };
        if !self.values.may_say(topic, from, now) {
            return;
        }
        let shape = match self.values.topics.get(&topic).map(|entry| &entry.role) {
            Some(Role::Theirs(reader)) => reader.shape.clone(),
            Some(Role::Ours(_)) | None => None,
        };
        let fault = self.values.learn_layout(topic, meta_data, from, now).err();
        if !self.values.is_learned(topic) {
            self.discovery(now).answered(space, |other| other == topic);
            if let Some(why) = fault {
                self.values.count(about, Reason::MetaData, 1, || why);
            }
            return;
        }
        let described = match Described::read(meta_data) {
            Ok(described) => described,
            Err(why) => {
                self.values
                    .count(about, (Reason::MetaData, "useless"), 1, || why);
                return;
            }
        };
        self.discovery(now).answered(space, |other| other == topic);
        if let Some(described) = &described
            && shape.is_some()
            && !self.values.may_be_renamed(topic, described, now)
        {
            self.values
                .count(about, (Reason::MetaData, "too often"), 1, || {
                    "its writer says too often that it is something else".to_owned()
                });
            return;
        }
        match self.values.take_note(topic, described, now) {
            News::Same => {}
            News::Full => self
                .values
                .count(about, (Reason::MetaData, "no room"), 1, || {
                    "there is no room for what more topics consist of".to_owned()
                }),
            News::Other => {
                let counters = self.values.topics.get_mut(&topic);
                let counters =
                    counters.map_or(&mut self.values.others, |entry| &mut entry.counters);
                counters.described += 1;
                if !self.values.arrange(topic, now) && shape.is_some() {
                    self.values.tell_unbound(topic);
                }
            }
        }
    }

    /// Returns the announced topic of another program. Handles announcements that a topic does not
    /// exist, and counts invalid announcements.
    fn subject_of(
        &mut self,
        (writer_id, status): (u16, StatusCode),
        meta_data: &DataSetMetaDataType<'_>,
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) -> Option<TopicId> {
        let named = meta_data.name.and_then(split_name);
        let topic = named.map(|(topic, _)| topic);
        let topic = topic.filter(|topic| topic.space == space && topic.triple().2 == writer_id);
        if let Some(topic) = topic.filter(|topic| self.values.is_home(*topic)) {
            let (_, namespace, _) = topic.triple();
            self.values.drop_own(Some(namespace), from, now);
            return None;
        }
        let bad = status.0 & STATUS_BAD != 0;
        match topic {
            Some(topic) if bad => self.unlearn(topic, from, now),
            None if bad => self.learn_of_none(writer_id, (space, from), now),
            None => self
                .values
                .count(About::sender(from), Reason::NotInSpace, 1, String::new),
            Some(topic) => return Some(topic),
        }
        None
    }

    /// Handles the announcement that a Publisher does not have a DataSetWriter. Its topics are not
    /// probed any more, except topics with values from another sender.
    fn learn_of_none(&mut self, writer_id: u16, (space, from): (SpaceId, SocketAddr), now: Now) {
        let timeout = self.values.mapping.pubsub().receive_timeout;
        let probing = self.discovery.as_ref();
        let probing = probing.and_then(|discovery| discovery.probing.get(&space));
        let asked = probing.into_iter().flat_map(|probing| &probing.topics);
        let (denied, doubtful): (Vec<TopicId>, Vec<TopicId>) = asked
            .filter(|topic| topic.triple().2 == writer_id)
            .partition(
                |topic| match self.values.topics.get(topic).map(|of| &of.role) {
                    Some(Role::Theirs(reader)) => reader.may_be(from, now.monotonic, timeout),
                    Some(Role::Ours(_)) | None => true,
                },
            );
        for topic in doubtful {
            let about = About {
                topic: Some(topic),
                from: Some(from),
            };
            self.values.count(about, (Reason::MetaData, "sender"), 1, || {
                "another program than the one that sends its values says that there is no such writer"
                    .to_owned()
            });
        }
        self.discovery(now)
            .answered(space, |topic| denied.contains(&topic));
    }

    /// Counts an announcement or probe that could not be sent.
    pub fn not_announced(&mut self, reason: Reason, detail: &str) {
        let about = About {
            topic: None,
            from: None,
        };
        self.values
            .count(about, (reason, "socket"), 1, || detail.to_owned());
    }
}

impl Values {
    /// Plans a probe for the metadata of a topic of another space.
    pub(super) fn ask_what(&mut self, topic: TopicId) {
        if self.is_learned(topic) {
            self.inquiries.probe(topic);
        }
    }

    /// Plans a probe for the fields of a topic if its messages cannot be read without them. The
    /// rate of these probes is limited.
    pub(super) fn ask_layout(&mut self, topic: TopicId, now: Now) {
        let Some(Topic {
            role: Role::Theirs(reader),
            ..
        }) = self.topics.get_mut(&topic)
        else {
            return;
        };
        let before = reader.asked_layout;
        if before.is_none_or(|asked| now.monotonic >= asked + ASK_LAYOUT_AGAIN) {
            reader.asked_layout = Some(now.monotonic);
            self.inquiries.probe(topic);
        }
    }

    /// Returns whether the local type of a topic may come from its writer, because the mapping does
    /// not define it.
    fn is_learned(&self, topic: TopicId) -> bool {
        let own = self.settings.own;
        let bound = self.mapping.variable(topic).is_some_and(|variable| {
            let service = variable.service.as_ref();
            variable.binding(own).is_some() || service.is_some_and(|service| service.space == own)
        });
        self.settings.local != Local::Fields && !bound
    }

    /// Returns whether the sender may announce the topic as its writer.
    fn may_say(&mut self, topic: TopicId, from: SocketAddr, now: Now) -> bool {
        let timeout = self.mapping.pubsub().receive_timeout;
        let Some(Topic {
            role: Role::Theirs(reader),
            ..
        }) = self.topics.get(&topic)
        else {
            return true;
        };
        if reader.may_be(from, now.monotonic, timeout) {
            return true;
        }
        // If the mapping defines the type, a restart at another port is not worth a log entry.
        if self.is_learned(topic) {
            let about = About {
                topic: Some(topic),
                from: Some(from),
            };
            self.count(about, (Reason::MetaData, "sender"), 1, || {
                "another program than the one that sends its values says what they are".to_owned()
            });
        }
        false
    }

    /// Stores the announced fields of a topic.
    fn learn_layout(
        &mut self,
        topic: TopicId,
        meta_data: &DataSetMetaDataType<'_>,
        from: SocketAddr,
        now: Now,
    ) -> Result<(), String> {
        let layout = Layout::read(meta_data, from)?;
        let until = (now.monotonic, self.mapping.pubsub().metadata_period);
        let rank = rank(&self.topics, &self.mapping, now.monotonic);
        match self.layouts.learn(topic, layout, until, rank) {
            News::Full => Err("there is no room for what the fields of more topics are".to_owned()),
            News::Same | News::Other => Ok(()),
        }
    }

    /// Stores the description of a topic. An announcement without a ROS type removes the stored
    /// description.
    fn take_note(&mut self, topic: TopicId, described: Option<Described>, now: Now) -> News {
        let until = (now.monotonic, self.mapping.pubsub().metadata_period);
        let Some(described) = described else {
            self.learned.forget(topic);
            return News::Same;
        };
        let rank = rank(&self.topics, &self.mapping, now.monotonic);
        self.learned.learn(topic, described, until, rank)
    }

    /// Returns whether a topic with values may change to the description. The known description is
    /// always accepted.
    fn may_be_renamed(&mut self, topic: TopicId, described: &Described, now: Now) -> bool {
        let known = self.learned.last(topic);
        if known.is_some_and(|known| **known == *described) {
            return true;
        }
        let known = known.is_some();
        match self.topics.get_mut(&topic) {
            Some(Topic {
                role: Role::Theirs(reader),
                ..
            }) => reader.may_be_renamed(known, now.monotonic),
            Some(_) | None => true,
        }
    }

    /// Returns the request to the port for the local type of a topic with values of the given
    /// shape, together with the known description. For a topic that already has a type, it requests
    /// a check of the description.
    pub(super) fn asked(
        &mut self,
        topic: TopicId,
        ask: Ask,
        shape: Vec<(uadp::BuiltinType, bool)>,
        now: Now,
    ) -> Option<Output> {
        if self.arrange(topic, now) {
            return None;
        }
        let described = self.learned.get(topic, now.monotonic).cloned();
        let fits = described
            .as_ref()
            .is_none_or(|described| described.fits(&shape));
        if ask == Ask::IfDescribed && (described.is_none() || !fits) {
            return None;
        }
        if described.is_none() {
            self.ask_what(topic);
        }
        if !fits {
            self.count(About::topic(topic), (Reason::MetaData, "values"), 1, || {
                "its values are not what its writer says they are".to_owned()
            });
        }
        Some(Output::Unbound {
            topic,
            shape,
            described: described.filter(|_| fits),
        })
    }
}

/// The severity of a Bad StatusCode (OPC 10000-4, 7.39.1).
const STATUS_BAD: u32 = 0x8000_0000;
/// The minimum time between two probes of a writer for the fields of its messages.
const ASK_LAYOUT_AGAIN: Duration = Duration::from_secs(10);
/// The maximum number of topics in a probe of a Publisher, which fits into any datagram.
const MAX_ASKED: usize = 200;

/// Returns the precedence of topics when there is no room for all descriptions.
fn rank(
    topics: &HashMap<TopicId, Topic>,
    mapping: &Mapping,
    now: Instant,
) -> impl Fn(TopicId) -> Rank {
    let timeout = mapping.pubsub().receive_timeout;
    move |topic| match topics.get(&topic).map(|of| &of.role) {
        _ if mapping.variable(topic).is_some() => Rank::Mapped,
        Some(Role::Theirs(reader))
            if now.saturating_duration_since(reader.heard_at()) < timeout =>
        {
            Rank::Heard
        }
        Some(_) | None => Rank::Stray,
    }
}
