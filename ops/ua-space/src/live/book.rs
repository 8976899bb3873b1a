//! What is heard in a group, kept within bounds: who sends what, and what it is said to be.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use mappings::TopicId;
use uadp::action::{ActionDialect, ActionKind, ActionMessage};
use uadp::discovery::{Announced, Announcement};
use uadp::{
    DataSetMessage, DecodeError, MessageKind, NetworkHeader, NetworkMessage, NetworkMessageType,
    PublisherId, Reassembler, ReassemblyLimits,
};

use super::application::Application;
use super::described::{Described, topic_of};

/// All that was heard. Whoever can send to the group can make up topics, senders and announcements: there is room for
/// so many, and what there is none for is counted.
pub(crate) struct Book {
    topics: BTreeMap<TopicId, Heard>,
    announced: BTreeMap<Subject, Announcing>,
    applications: BTreeMap<(u16, SocketAddr), Application>,
    /// Bytes of all descriptions, roughly.
    weight: usize,
    reassembler: Reassembler<SocketAddr>,
    counters: BTreeMap<Drop, u64>,
}

/// What an announcement is about, and whose word it is.
type Subject = (TopicId, Kind, SocketAddr);

/// What is announced under a name of the space.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Kind {
    Value,
    Call,
}

struct Announcing {
    described: Arc<Described>,
    first: Duration,
}

/// A topic that values were heard of.
#[derive(Debug, Clone)]
pub(crate) struct Heard {
    /// Messages with values.
    pub(crate) values: u64,
    /// Messages without: their writer lives.
    pub(crate) keep_alives: u64,
    pub(crate) first: Duration,
    pub(crate) last: Duration,
    /// Who sent the last one.
    pub(crate) from: SocketAddr,
    /// How often that was another than before: of two programs with the same ids, all the time.
    pub(crate) changed_hands: u64,
    /// It cannot be read without keys.
    pub(crate) secured: bool,
    /// Builtin type of the only field, where it says it and there is one.
    pub(crate) only: Option<(uadp::BuiltinType, bool)>,
}

/// Why something was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Drop {
    /// No NetworkMessage, or something in it is malformed.
    Malformed,
    /// Not of the space: another PublisherId, or without the ids that make a topic.
    NotInSpace,
    /// There is no room for more topics.
    Topics,
    /// There is no room for more descriptions.
    Descriptions,
    /// A description that is too much, or of what is no topic.
    Useless,
}

impl Drop {
    /// For people.
    pub(crate) const fn label(self) -> &'static str {
        match self {
            Self::Malformed => "malformed",
            Self::NotInSpace => "not in the space",
            Self::Topics => "more topics than there is room for",
            Self::Descriptions => "more descriptions than there is room for",
            Self::Useless => "descriptions of no use",
        }
    }
}

/// What came with a datagram.
pub(crate) enum News<'a> {
    /// A value, or a sign of life without one.
    Sample(Sample<'a>),
    /// A response of an Action, and its sender.
    Response(ActionMessage<'a>, SocketAddr),
    /// The announcement of a topic or call that is new or has changed, and its sender.
    Announced(TopicId, Kind, &'a Arc<Described>, SocketAddr),
}

/// A DataSetMessage of a topic.
pub(crate) struct Sample<'a> {
    pub(crate) topic: TopicId,
    /// Address of its sender.
    pub(crate) from: SocketAddr,
    /// What its writer says it is.
    pub(crate) described: Option<Arc<Described>>,
    /// Of its NetworkMessage.
    pub(crate) network: NetworkHeader<'a>,
    pub(crate) message: DataSetMessage<'a>,
}

impl Book {
    pub(crate) fn new() -> Self {
        Self {
            topics: BTreeMap::new(),
            announced: BTreeMap::new(),
            applications: BTreeMap::new(),
            weight: 0,
            reassembler: Reassembler::new(ReassemblyLimits {
                total: 64 << 20,
                total_per_sender: 32 << 20,
                ..ReassemblyLimits::default()
            }),
            counters: BTreeMap::new(),
        }
    }

    /// A datagram was none of UADP.
    pub(crate) fn malformed(&mut self) {
        self.count(Drop::Malformed);
    }

    /// Takes a datagram; `each` is given what is in it that passes by.
    pub(crate) fn handle(
        &mut self,
        (message, from): (&NetworkMessage<'_>, SocketAddr),
        now: Duration,
        each: &mut dyn FnMut(News<'_>),
    ) {
        if message.message_type() == NetworkMessageType::Probe {
            return;
        }
        let Some(space) = space(message.publisher_id()) else {
            return self.count(Drop::NotInSpace);
        };
        if message.is_action() && !message.is_sealed() {
            return self.actions((message, from), each);
        }
        if message.is_chunk() && !message.is_sealed() {
            return self.chunk(message, (space, from), now, each);
        }
        if message.message_type() == NetworkMessageType::Announcement {
            match Announcement::decode(message) {
                Ok(announcement) => self.announcement(&announcement, (space, from), now, each),
                Err(_) => self.count(Drop::Malformed),
            }
            return;
        }
        self.data(message, (space, from), now, each);
    }

    /// Topics of which values or signs of life were heard.
    pub(crate) fn topics(&self) -> impl Iterator<Item = (TopicId, &Heard)> {
        self.topics.iter().map(|(topic, heard)| (*topic, heard))
    }

    pub(crate) fn heard(&self, topic: TopicId) -> Option<&Heard> {
        self.topics.get(&topic)
    }

    /// What a topic is said to be by who sends its values.
    pub(crate) fn described(&self, topic: TopicId) -> Option<&Arc<Described>> {
        let from = self.topics.get(&topic)?.from;
        let found = self.announced.get(&(topic, Kind::Value, from))?;
        Some(&found.described)
    }

    /// What is announced of topics, and by whom, in the order of the topics; of several who announce one, who was first.
    pub(crate) fn announced(
        &self,
    ) -> impl Iterator<Item = (TopicId, Kind, &Arc<Described>, SocketAddr)> {
        self.announced_where(|_| true)
    }

    /// As [`announced`](Self::announced), by some senders only.
    pub(crate) fn announced_where(
        &self,
        counts: impl Fn(SocketAddr) -> bool,
    ) -> impl Iterator<Item = (TopicId, Kind, &Arc<Described>, SocketAddr)> {
        let all = self.announced.iter();
        let mut all: Vec<_> = all.filter(|((_, _, from), _)| counts(*from)).collect();
        all.sort_by_key(|((topic, kind, from), found)| (*topic, *kind, found.first, *from));
        all.dedup_by_key(|((topic, kind, _), _)| (*topic, *kind));
        all.into_iter()
            .map(|((topic, kind, from), found)| (*topic, *kind, &found.described, *from))
    }

    /// The calls among them.
    pub(crate) fn calls(&self) -> impl Iterator<Item = (TopicId, &Arc<Described>)> {
        let calls = self.announced().filter(|(_, kind, ..)| *kind == Kind::Call);
        calls.map(|(topic, _, described, _)| (topic, described))
    }

    /// How many addresses say what a call is.
    pub(crate) fn announcers(&self, topic: TopicId) -> usize {
        let all = self.announced.keys();
        all.filter(|(of, kind, _)| (*of, *kind) == (topic, Kind::Call))
            .count()
    }

    /// What programs say they are, for which space, and from where.
    pub(crate) fn applications(&self) -> impl Iterator<Item = (&(u16, SocketAddr), &Application)> {
        self.applications.iter()
    }

    /// The spaces that something is heard or known of, and those that an application speaks for.
    pub(crate) fn spaces(&self) -> BTreeSet<u16> {
        let all = self
            .topics
            .keys()
            .chain(self.announced.keys().map(|(topic, ..)| topic));
        let applications = self.applications.keys().map(|(space, _)| *space);
        all.map(|topic| topic.space.into())
            .chain(applications)
            .collect()
    }

    /// What was not taken, and how often.
    pub(crate) fn dropped(&self) -> impl Iterator<Item = (Drop, u64)> {
        self.counters.iter().map(|(drop, count)| (*drop, *count))
    }

    fn data(
        &mut self,
        message: &NetworkMessage<'_>,
        of: (u16, SocketAddr),
        now: Duration,
        each: &mut dyn FnMut(News<'_>),
    ) {
        let network = message.header();
        let namespace = network.group.and_then(|group| group.writer_group_id);
        let (Some(namespace), Some(writer_ids)) = (namespace, message.writer_ids()) else {
            return self.count(Drop::NotInSpace);
        };
        if message.is_sealed() {
            for writer_id in writer_ids {
                self.hear(writer_id, (of, namespace), now, None);
            }
            return;
        }
        for inner in message.messages() {
            match inner {
                Ok(inner) => self.sample((network, inner), (of, namespace), now, each),
                Err(_) => self.count(Drop::Malformed),
            }
        }
    }

    fn sample(
        &mut self,
        (network, message): (NetworkHeader<'_>, DataSetMessage<'_>),
        from @ ((_, sender), _): ((u16, SocketAddr), u16),
        now: Duration,
        each: &mut dyn FnMut(News<'_>),
    ) {
        let Some(writer_id) = message.writer_id else {
            return self.count(Drop::NotInSpace);
        };
        if let Some(topic) = self.hear(writer_id, from, now, Some(&message)) {
            each(News::Sample(Sample {
                topic,
                from: sender,
                described: self.described(topic).cloned(),
                network,
                message,
            }));
        }
    }

    /// Takes note of a message of a topic; without one it is secured.
    fn hear(
        &mut self,
        writer_id: u16,
        ((space, from), namespace): ((u16, SocketAddr), u16),
        now: Duration,
        message: Option<&DataSetMessage<'_>>,
    ) -> Option<TopicId> {
        let Some(topic) = TopicId::new(space, namespace, writer_id) else {
            self.count(Drop::NotInSpace);
            return None;
        };
        if !self.topics.contains_key(&topic) && self.topics.len() >= MOST_TOPICS {
            self.count(Drop::Topics);
            return None;
        }
        let heard = self.topics.entry(topic).or_insert(Heard {
            values: 0,
            keep_alives: 0,
            first: now,
            last: now,
            from,
            changed_hands: 0,
            secured: false,
            only: None,
        });
        heard.changed_hands += u64::from(heard.from != from);
        (heard.last, heard.from) = (now, from);
        heard.secured = message.is_none();
        match message.map(|message| message.kind) {
            Some(MessageKind::KeepAlive) => heard.keep_alives += 1,
            Some(MessageKind::KeyFrame | MessageKind::DeltaFrame | MessageKind::Event) | None => {
                heard.values += 1;
            }
        }
        if let Some(message) = message
            && heard.only.is_none()
        {
            heard.only = only(message);
        }
        Some(topic)
    }

    fn chunk(
        &mut self,
        message: &NetworkMessage<'_>,
        of: (u16, SocketAddr),
        now: Duration,
        each: &mut dyn FnMut(News<'_>),
    ) {
        // The whole borrows from it.
        let mut reassembler = std::mem::take(&mut self.reassembler);
        match reassembler.receive_from(of.1, message, now) {
            Ok(None) => {}
            Ok(Some(whole)) if whole.message_type == NetworkMessageType::Announcement => {
                match Announcement::decode_body(whole.bytes) {
                    Ok(announcement) => self.announcement(&announcement, of, now, each),
                    Err(_) => self.count(Drop::Malformed),
                }
            }
            // Without a payload header it is an encoded NetworkMessage that was cut up, as those of calls are.
            Ok(Some(whole)) if whole.writer_id.is_none() => {
                match NetworkMessage::decode(whole.bytes) {
                    Ok(inner) if inner.is_action() && !inner.is_sealed() => {
                        self.actions((&inner, of.1), each);
                    }
                    Ok(_) | Err(_) => self.count(Drop::Malformed),
                }
            }
            Ok(Some(whole)) => {
                let group = whole.header.group;
                let namespace = group.and_then(|group| group.writer_group_id);
                match (namespace, whole.data_set_message()) {
                    (Some(namespace), Ok(inner)) => {
                        self.sample((whole.header, inner), (of, namespace), now, each);
                    }
                    (None, Ok(_)) => self.count(Drop::NotInSpace),
                    (_, Err(_)) => self.count(Drop::Malformed),
                }
            }
            Err(_) => self.count(Drop::Malformed),
        }
        while reassembler.poll_given_up().is_some() {}
        self.reassembler = reassembler;
    }

    fn actions(
        &mut self,
        (message, from): (&NetworkMessage<'_>, SocketAddr),
        each: &mut dyn FnMut(News<'_>),
    ) {
        let Ok(actions) = message.actions(ActionDialect::Standard) else {
            return self.count(Drop::Malformed);
        };
        if actions.header().kind == ActionKind::Request {
            return;
        }
        for action in actions {
            match action {
                Ok(action) => each(News::Response(action, from)),
                Err(_) => self.count(Drop::Malformed),
            }
        }
    }

    fn announcement(
        &mut self,
        announcement: &Announcement<'_>,
        (space, from): (u16, SocketAddr),
        now: Duration,
        each: &mut dyn FnMut(News<'_>),
    ) {
        if let Announced::ApplicationDescription {
            description,
            capabilities,
        } = &announcement.announced
        {
            return self.meet(Application::read(description, *capabilities), (space, from));
        }
        #[expect(
            clippy::wildcard_enum_match_arm,
            reason = "all else is not about a topic"
        )]
        let (writer_id, name, kind, described) = match &announcement.announced {
            Announced::DataSetMetaData {
                writer_id,
                meta_data,
                status,
            } => {
                let is_there = status.0 & BAD == 0;
                let described = is_there.then(|| Described::of_value(meta_data));
                (*writer_id, meta_data.name, Kind::Value, described)
            }
            Announced::ActionMetaData(of) => {
                let described = Some(Described::of_call(of));
                (of.writer_id, of.request.name, Kind::Call, described)
            }
            _ => return,
        };
        let topic = topic_of(name).filter(|topic| {
            let (of, _, id) = topic.triple();
            (of, id) == (space, writer_id)
        });
        match (topic, described) {
            (Some(topic), Some(Ok(described))) => {
                if let Some(news) = self.keep((topic, kind, from), described, now) {
                    each(News::Announced(topic, kind, &news, from));
                }
            }
            // What a publisher has not got, or not any more.
            (Some(topic), None) => {
                self.forget((topic, Kind::Value, from));
                self.forget((topic, Kind::Call, from));
            }
            (None, None) => {}
            (_, Some(Err(_))) | (None, Some(Ok(_))) => self.count(Drop::Useless),
        }
    }

    /// Takes what a program says it is, if there is room for it.
    fn meet(&mut self, application: Option<Application>, who: (u16, SocketAddr)) {
        let is_known = self.applications.contains_key(&who);
        match application {
            None => self.count(Drop::Useless),
            Some(_) if !is_known && self.applications.len() >= MOST_APPLICATIONS => {
                self.count(Drop::Descriptions);
            }
            Some(application) => drop(self.applications.insert(who, application)),
        }
    }

    /// What is new, if there is room for it.
    fn keep(
        &mut self,
        subject: Subject,
        described: Described,
        now: Duration,
    ) -> Option<Arc<Described>> {
        let before = self.announced.get(&subject);
        if before.is_some_and(|before| *before.described == described) {
            return None;
        }
        let first = before.map_or(now, |before| before.first);
        let freed = before.map_or(0, |before| before.described.weight());
        let weight = self.weight - freed + described.weight();
        if weight > MOST_WEIGHT || (before.is_none() && self.announced.len() >= MOST_TOPICS) {
            self.count(Drop::Descriptions);
            return None;
        }
        self.weight = weight;
        let described = Arc::new(described);
        let kept = Announcing {
            described: Arc::clone(&described),
            first,
        };
        self.announced.insert(subject, kept);
        Some(described)
    }

    fn forget(&mut self, subject: Subject) {
        if let Some(gone) = self.announced.remove(&subject) {
            self.weight -= gone.described.weight();
        }
    }

    fn count(&mut self, drop: Drop) {
        *self.counters.entry(drop).or_default() += 1;
    }
}

/// The space of a publisher.
fn space(publisher: Option<PublisherId<'_>>) -> Option<u16> {
    match publisher? {
        PublisherId::UInt16(space) => mappings::SpaceId::new(space).map(u16::from),
        PublisherId::Byte(_)
        | PublisherId::UInt32(_)
        | PublisherId::UInt64(_)
        | PublisherId::String(_) => None,
    }
}

/// Type of the only field, and whether it is an array.
fn only(message: &DataSetMessage<'_>) -> Option<(uadp::BuiltinType, bool)> {
    if message.kind == MessageKind::DeltaFrame {
        return None;
    }
    let mut values = message.values().ok()?;
    let first: Result<_, DecodeError> = values.next()?;
    let value = first.ok()?.value.value?;
    let builtin = value.builtin_type()?;
    let is_array = !matches!(value, uadp::Variant::Scalar(_));
    values.next().is_none().then_some((builtin, is_array))
}

/// Of the two upper bits of a StatusCode.
const BAD: u32 = 0x8000_0000;
const MOST_TOPICS: usize = 16_384;
const MOST_APPLICATIONS: usize = 1_024;
/// Bytes of all descriptions.
const MOST_WEIGHT: usize = 32 << 20;

#[cfg(test)]
mod tests;
