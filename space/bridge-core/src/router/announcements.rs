//! Announcements of this program, and probes for the announcements of other programs.

mod applications;
mod probes;
mod rolls;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::{SpaceId, TopicId};
use messages::{MessageType, Selection};
use uadp::discovery::{
    AnnounceLimits, AnnouncedSubject, Announcer, ApplicationDescription, Included, Probe, WireArray,
};

use self::applications::Applications;
use self::probes::MetadataProbes;
pub(super) use self::rolls::ProbedCalls;
use self::rolls::Rolls;
use super::about::DropSite;
use super::values::TopicQueues;
use crate::application::Application;
use crate::counters::Reason;
use crate::description::{MetaDataSource, OwnAnnouncements, mapped_leaves};
use crate::loop_rule::Owned;
use crate::output::Output;
use crate::settings::Now;
use crate::topic::{Topic, TopicSide};

/// The planned announcements of this program, and the pending probes.
#[derive(Debug)]
pub(super) struct PlannedAnnouncements {
    /// The origin of time for the timers: the first use.
    start: Option<Instant>,
    announcer: Announcer,
    /// Topics of the own space by DataSetWriterId, because a probe contains only DataSetWriterIds.
    writers: BTreeMap<u16, Vec<TopicId>>,
    /// Own calls by DataSetWriterId.
    actions: BTreeMap<u16, Vec<TopicId>>,
    rolls: Rolls,
    probes: MetadataProbes,
    applications: Applications,
    /// The time of the next action. It is read in every iteration and computed only after changes.
    due: Option<Instant>,
}

impl PlannedAnnouncements {
    pub(super) fn new(own: SpaceId) -> Self {
        let limits = AnnounceLimits {
            // Programs that receive the same probe respond at different times.
            gather: Duration::from_millis(50 + u64::from(own.get() % 50)),
            ..AnnounceLimits::default()
        };
        Self {
            start: None,
            announcer: Announcer::new([], limits),
            writers: BTreeMap::new(),
            actions: BTreeMap::new(),
            rolls: Rolls::default(),
            probes: MetadataProbes::default(),
            applications: Applications::default(),
            due: None,
        }
    }

    fn since_start(&mut self, now: Now) -> Duration {
        let start = *self.start.get_or_insert(now.monotonic);
        now.monotonic.saturating_duration_since(start)
    }

    /// Returns the time since the start, and a number that differs between programs. The clock is
    /// random enough to probe at another time than other programs.
    fn at(&mut self, now: Now) -> (Duration, u32) {
        let random = u32::try_from(now.utc.unix_nanos() & 0xFFFF_FFFF).unwrap_or_default();
        (self.since_start(now), random)
    }

    fn reckon(&mut self) {
        let next = [
            self.probes.poll_timeout(),
            self.rolls.poll_timeout(),
            self.applications.poll_timeout(),
            self.announcer.poll_timeout(),
        ];
        let next = next.into_iter().flatten().min();
        self.due = self.start.zip(next).map(|(start, due)| start + due);
    }

    /// Returns the time of the next announcement or probe.
    pub(super) const fn due(&self) -> Option<Instant> {
        self.due
    }

    /// Plans an announcement. A planned announcement already contains the information.
    fn plan(&mut self, subject: AnnouncedSubject, now: Now) {
        let since = self.since_start(now);
        let announced = self.announcer.announce(subject, Included::default(), since);
        let _planned = announced.is_ok();
        self.reckon();
    }

    fn plan_value(&mut self, topic: TopicId, now: Now) {
        let (_, _, writer_id) = topic.triple();
        self.plan(AnnouncedSubject::DataSetMetaData(writer_id), now);
    }

    /// Plans the announcement of an own call.
    pub(super) fn plan_call(&mut self, topic: TopicId, now: Now) {
        let (_, _, writer_id) = topic.triple();
        let topics = self.actions.entry(writer_id).or_default();
        if !topics.contains(&topic) {
            topics.push(topic);
            self.announcer.set_actions(self.actions.keys().copied());
        }
        self.plan(AnnouncedSubject::ActionMetaData(writer_id), now);
    }

    /// Plans the announcements of described topics that have a producer and no value yet. No
    /// message of such a topic shows others that it exists.
    pub(super) fn plan_silent(&mut self, values: &TopicQueues, now: Now) {
        let topics = self.writers.values().flatten();
        let silent = topics.filter(|topic| values.is_silent(**topic));
        let silent: Vec<TopicId> = silent.take(MOST_SILENT).copied().collect();
        for topic in silent {
            self.plan_value(topic, now);
        }
    }

    /// Plans the announcement of the own application.
    pub(super) fn plan_application(&mut self, now: Now) {
        self.plan(AnnouncedSubject::ApplicationInformation, now);
    }

    /// Sets the description of this program, and announces it.
    pub(super) fn introduce(&mut self, own: Application, now: Now) {
        self.applications.introduce(own);
        self.plan_application(now);
    }

    /// Returns the applications of other programs with the space and the address of each.
    pub(super) fn applications(&self) -> impl Iterator<Item = (SpaceId, SocketAddr, &Application)> {
        self.applications.heard()
    }

    /// Probes for all applications once, unless a probe is in progress.
    pub(super) fn probe_applications(&mut self, now: Now) {
        let at = self.at(now);
        self.applications.plan_probe(at);
        self.reckon();
    }

    /// Plans a probe for the metadata of a topic of another space.
    pub(super) fn probe(&mut self, topic: TopicId, now: Now) {
        let at = self.at(now);
        self.probes.plan(topic, at);
        self.reckon();
    }

    /// Probes a space or one of its namespaces for its calls.
    pub(super) fn probe_calls(&mut self, asked: ProbedCalls, now: Now) {
        let at = self.at(now);
        self.rolls.plan(asked, at);
        self.reckon();
    }

    /// Plans the probes that values need.
    pub(super) fn inquire(&mut self, values: &mut TopicQueues, now: Now) {
        if values.inquiries.is_empty() {
            return;
        }
        let at = self.at(now);
        for topic in values.inquiries.take_met() {
            self.rolls.meet(topic, at);
        }
        for topic in values.inquiries.take_topics() {
            self.probes.plan(topic, at);
        }
        if values.inquiries.take_applications() {
            self.applications.plan_probe(at);
        }
        self.reckon();
    }

    /// Handles a probe for the metadata of topics of the space `asked`.
    pub(super) fn handle_probe(
        &mut self,
        ids: WireArray<'_, u16>,
        (asked, own): (SpaceId, SpaceId),
        now: Now,
    ) {
        let since = self.since_start(now);
        if asked == own {
            let probe = Probe::DataSetMetaData(ids);
            self.announcer.handle_probe(&probe, since);
        }
        self.probes.handle_probe(asked, ids, since);
        self.reckon();
    }

    /// Handles a probe of another program for the calls of a space or of a namespace.
    pub(super) fn handle_roll(&mut self, asked: ProbedCalls, now: Now) {
        let since = self.since_start(now);
        self.rolls.handle_probe(asked, since);
        self.reckon();
    }

    /// Handles a probe for the own application or for all applications.
    pub(super) fn handle_application_probe(&mut self, probe: &Probe<'_>, now: Now) {
        let since = self.since_start(now);
        if self.applications.is_introduced() {
            self.announcer.handle_probe(probe, since);
        }
        if *probe == Probe::FindApplications {
            self.applications.handle_probe(since);
        }
        self.reckon();
    }

    /// Stores the announced application of another program.
    pub(super) fn meet_application(
        &mut self,
        values: &mut TopicQueues,
        (description, capabilities): (&ApplicationDescription<'_>, WireArray<'_, Option<&str>>),
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) {
        let Some(application) = Application::read(description, capabilities) else {
            let cause = (Reason::MetaData, "application");
            values.count(DropSite::sender(from), cause, 1, || {
                "its application announcement is too long or contains unprintable characters"
                    .to_owned()
            });
            return;
        };
        let key = (space, from);
        self.applications.meet(key, application, now.monotonic);
    }

    /// Completes the probes for topics of a space.
    pub(super) fn answered(&mut self, space: SpaceId, is_it: impl Fn(TopicId) -> bool) {
        self.probes.answered(space, is_it);
        self.reckon();
    }

    /// Completes the probes for a call that is known.
    pub(super) fn call_known(&mut self, topic: TopicId) {
        self.probes.answered(topic.space, |other| other == topic);
        self.rolls.handle_answer(topic);
        self.reckon();
    }

    /// Handles the announcement that a Publisher does not have a DataSetWriter. Its topics are not
    /// probed any more, except topics with values from another sender.
    pub(super) fn handle_denial(
        &mut self,
        values: &mut TopicQueues,
        (writer_id, (space, from)): (u16, (SpaceId, SocketAddr)),
        now: Now,
    ) {
        let asked = self.probes.topics_of(space);
        let (denied, doubtful): (Vec<TopicId>, Vec<TopicId>) = asked
            .filter(|topic| topic.triple().2 == writer_id)
            .partition(|topic| values.may_be_writer(*topic, from, now));
        for topic in doubtful {
            let about = DropSite {
                topic: Some(topic),
                from: Some(from),
            };
            values.count(about, (Reason::MetaData, "sender"), 1, || {
                "a program that does not send its values reports that the writer does not exist"
                    .to_owned()
            });
        }
        self.answered(space, |topic| denied.contains(&topic));
    }

    /// Announces a topic of the own space with a known type, and again after each change. Without
    /// `message` the mapping or the local side describes the topic.
    pub(super) fn describe(
        &mut self,
        values: &mut TopicQueues,
        topic: TopicId,
        message: Option<(&MessageType, &Selection)>,
        now: Now,
    ) {
        let period = values.mapping.pubsub().metadata_period;
        let Some(Topic {
            plan,
            said,
            description,
            announce_at,
            ..
        }) = values.topics.get_mut(&topic)
        else {
            return;
        };
        let said = said.as_deref();
        let variable = values.mapping.variable(topic).filter(|_| said.is_none());
        let mapped = match (message, variable) {
            (None, Some(variable)) => mapped_leaves(variable),
            (Some(_), _) | (None, None) => Vec::new(),
        };
        let leaves = match (message, plan) {
            (Some(_), Some(plan)) => plan.leaves(),
            (None, _) if said.is_some() => said.map_or(&[][..], |said| &said.fields),
            (None, _) if !mapped.is_empty() => &mapped,
            (Some(_), None) => return,
            (None, _) => {
                // Neither the mapping nor the local side describes the fields any more.
                return self.forget(values, topic);
            }
        };
        let source = MetaDataSource {
            topic,
            message,
            leaves,
            variable,
            said,
            namespaces: values.mapping.namespaces(),
        };
        match OwnAnnouncements::new(source, description.as_deref(), now.utc) {
            Ok(new) if new.differs(description.as_deref()) => {
                *description = Some(Box::new(new));
                *announce_at = Some(now.monotonic + period);
            }
            Ok(_) => return,
            Err(error) => {
                *description = None;
                values.count(DropSite::topic(topic), Reason::MetaData, 1, || {
                    format!("cannot announce its fields: {error}")
                });
                return;
            }
        }
        let (_, namespace, writer_id) = topic.triple();
        let topics = self.writers.entry(writer_id).or_default();
        if !topics.contains(&topic) {
            topics.push(topic);
        }
        self.announcer.add_writer(namespace, writer_id);
        self.plan_value(topic, now);
        values.schedule_topic(topic);
    }

    /// Stops the announcements of an own topic.
    pub(super) fn forget(&mut self, values: &mut TopicQueues, topic: TopicId) {
        if let Some(entry) = values.topics.get_mut(&topic) {
            entry.said = None;
            entry.description = None;
            entry.announce_at = None;
        }
        let (_, _, writer_id) = topic.triple();
        for of in [&mut self.writers, &mut self.actions] {
            if let Some(topics) = of.get_mut(&writer_id) {
                topics.retain(|of| *of != topic);
                if topics.is_empty() {
                    of.remove(&writer_id);
                }
            }
        }
        self.announcer.set_actions(self.actions.keys().copied());
    }

    /// Plans the next announcement of a topic, if it is due and the topic has a producer.
    pub(super) fn announce_again(&mut self, values: &mut TopicQueues, topic: TopicId, now: Now) {
        let period = values.mapping.pubsub().metadata_period;
        let Some(Topic {
            role: TopicSide::Ours(writer),
            announce_at: Some(at),
            ..
        }) = values.topics.get_mut(&topic)
        else {
            return;
        };
        if *at > now.monotonic {
            return;
        }
        *at = now.monotonic + period;
        if writer.is_live() {
            self.plan_value(topic, now);
        }
    }

    /// Sends due announcements and probes. `announce_call` sends the announcement of an own call
    /// with the sequence number.
    pub(super) fn handle_timeout(
        &mut self,
        values: &mut TopicQueues,
        announce_call: impl Fn(&mut TopicQueues, TopicId, u16),
        now: Now,
    ) {
        if self.due.is_none_or(|due| due > now.monotonic) {
            return;
        }
        let at @ (since, _) = self.at(now);
        while let Some(due) = self.announcer.poll(since) {
            let number = due.sequence_number;
            match due.subject {
                AnnouncedSubject::ApplicationInformation => {
                    self.send_application(values, false, number)
                }
                AnnouncedSubject::PublisherEndpoints => self.send_application(values, true, number),
                AnnouncedSubject::DataSetMetaData(writer_id)
                | AnnouncedSubject::ActionMetaData(writer_id) => {
                    let topics = self.writers.get(&writer_id);
                    let calls = self.actions.get(&writer_id);
                    for topic in topics.into_iter().flatten() {
                        values.announce(*topic, number, now);
                    }
                    for topic in calls.into_iter().flatten() {
                        announce_call(values, *topic, number);
                    }
                    // If several programs share the space, another program may have the writer.
                    if topics.is_none()
                        && calls.is_none()
                        && values.owned == Owned::All
                        && values.part.is_none()
                    {
                        values.deny(writer_id, number);
                    }
                }
                AnnouncedSubject::PubSubConnections
                | AnnouncedSubject::WriterGroupConfiguration(_)
                | AnnouncedSubject::DataSetWriterConfiguration(_)
                | AnnouncedSubject::ActionResponder => {}
            }
        }
        for (space, ids) in self.probes.poll(at) {
            let probe = Probe::DataSetMetaData(WireArray::new(&ids));
            values.send_probe(&probe, Some(space));
        }
        for asked in self.rolls.poll(at) {
            values.send_probe(&asked.probe(), Some(asked.publisher()));
        }
        if self.applications.poll(at) {
            values.send_probe(&Probe::FindApplications, None);
        }
        self.reckon();
    }

    /// Announces the own application or its Endpoints.
    fn send_application(&self, values: &mut TopicQueues, endpoints: bool, sequence_number: u16) {
        let mut bytes = values.buffer();
        let head = (values.settings.own, sequence_number);
        let written = self.applications.write(endpoints, head, &mut bytes);
        let (max_datagram, _) = values.sizes();
        match written {
            Some(Ok(())) if bytes.len() <= usize::from(max_datagram) => {
                values.tell(Output::Discovery { bytes });
            }
            Some(Ok(()) | Err(_)) => {
                values.recycle(bytes);
                values.count(DropSite::NOTHING, Reason::TooBig, 1, || {
                    "the announcement of this program does not fit into a datagram".to_owned()
                });
            }
            None => values.recycle(bytes),
        }
    }
}

/// The largest number of topics without a value that are announced for a probe. The others follow
/// with the announcements of all topics.
const MOST_SILENT: usize = 512;
