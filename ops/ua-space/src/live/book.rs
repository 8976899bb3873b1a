//! A bounded table of the topics and descriptions received in a group.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use mappings::TopicId;
use uadp::action::{ActionDialect, ActionKind, ActionMessage};
use uadp::discovery::{AnnouncedContent, Announcement};
use uadp::{
    DataSetMessage, DateTime, DecodeError, FieldEncoding, MessageKind, NetworkHeader,
    NetworkMessage, NetworkMessageType, PublisherId, Reassembler, ReassemblyLimits, StatusCode,
    Timestamp,
};

use super::application::AnnouncedProgram;
use super::described::{AnnouncedDescription, topic_of};

/// All received topics, descriptions and applications. Any host in the group can send made-up
/// topics, senders and announcements, so the table is bounded and counts the entries that it drops.
pub(crate) struct Book {
    topics: BTreeMap<TopicId, TopicValues>,
    announced: BTreeMap<Subject, Announcing>,
    applications: BTreeMap<(u16, SocketAddr), AnnouncedProgram>,
    /// The approximate size of all descriptions, in bytes.
    weight: usize,
    reassembler: Reassembler<SocketAddr>,
    counters: BTreeMap<Drop, u64>,
}

/// The subject of an announcement, and its sender.
type Subject = (TopicId, NameKind, SocketAddr);

/// The kind of item that is announced under a name of the space.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum NameKind {
    Value,
    Call,
}

struct Announcing {
    described: Arc<AnnouncedDescription>,
    first: Duration,
}

/// A topic with received values.
#[derive(Debug, Clone)]
pub(crate) struct TopicValues {
    /// Number of messages with values.
    pub(crate) values: u64,
    /// Number of keep-alive messages.
    pub(crate) keep_alives: u64,
    pub(crate) first: Duration,
    pub(crate) last: Duration,
    /// The sender of the last message.
    pub(crate) from: SocketAddr,
    /// Number of changes of the sender; it keeps growing if two programs use the same ids.
    pub(crate) changed_hands: u64,
    /// True if the messages cannot be decrypted because keys are missing.
    pub(crate) secured: bool,
    /// The builtin type of the only field, if the message contains the type and has a single field.
    pub(crate) only: Option<(uadp::BuiltinType, bool)>,
    /// The worst quality in the last message with values.
    pub(crate) quality: StatusCode,
}

/// The reason why a message was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Drop {
    /// The datagram is not a NetworkMessage, or a part of it is malformed.
    Malformed,
    /// A secured announcement without its keys.
    Secured,
    /// The PublisherId is not a space, or the ids that make a topic are missing.
    NotInSpace,
    /// The table of topics is full.
    Topics,
    /// The table of descriptions is full.
    Descriptions,
    /// The description is too large, or its name is not a topic.
    Useless,
}

impl Drop {
    /// Returns the text for output.
    pub(crate) const fn label(self) -> &'static str {
        match self {
            Self::Malformed => "malformed",
            Self::Secured => "secured; `--keys FILE` reads them",
            Self::NotInSpace => "not in the space",
            Self::Topics => "more topics than the table holds",
            Self::Descriptions => "more descriptions than the table holds",
            Self::Useless => "descriptions that are too large, or of no topic",
        }
    }
}

/// The contents of a datagram.
pub(crate) enum DatagramContent<'a> {
    /// A value, or a keep-alive message.
    Sample(ReceivedSample<'a>),
    /// A response of an Action, and its sender.
    Response(ActionMessage<'a>, SocketAddr),
    /// The new or changed announcement of a topic or call, and its sender.
    Announced {
        topic: TopicId,
        kind: NameKind,
        described: &'a Arc<AnnouncedDescription>,
        from: SocketAddr,
        announcement: &'a Announcement<'a>,
    },
}

/// A DataSetMessage of a topic.
pub(crate) struct ReceivedSample<'a> {
    pub(crate) topic: TopicId,
    /// The address of the sender.
    pub(crate) from: SocketAddr,
    /// The description announced by the sender.
    pub(crate) described: Option<Arc<AnnouncedDescription>>,
    /// The header of its NetworkMessage.
    pub(crate) network: NetworkHeader<'a>,
    pub(crate) message: DataSetMessage<'a>,
}

impl ReceivedSample<'_> {
    /// Returns the time at which its writer took the value, in nanoseconds since 1970.
    pub(crate) fn taken(&self) -> Option<i128> {
        let header = self.message.header();
        unix_nanos(header.timestamp, header.picoseconds)
    }

    /// Returns the time of sending, in nanoseconds since 1970.
    pub(crate) fn sent(&self) -> Option<i128> {
        unix_nanos(self.network.timestamp, self.network.picoseconds)
    }
}

fn unix_nanos(time: Option<DateTime>, picoseconds: Option<u16>) -> Option<i128> {
    let stamp = Timestamp {
        time: time?,
        picoseconds: picoseconds.unwrap_or_default(),
    };
    Some(stamp.unix_nanos())
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

    /// Counts a datagram that is not a NetworkMessage.
    pub(crate) fn malformed(&mut self) {
        self.count(Drop::Malformed);
    }

    /// Handles a datagram and passes its values, responses and new announcements to `each`.
    pub(crate) fn handle(
        &mut self,
        (message, from): (&NetworkMessage<'_>, SocketAddr),
        now: Duration,
        each: &mut dyn FnMut(DatagramContent<'_>),
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
            if message.is_sealed() {
                return self.count(Drop::Secured);
            }
            match Announcement::decode(message) {
                Ok(announcement) => self.announcement(&announcement, (space, from), now, each),
                Err(_) => self.count(Drop::Malformed),
            }
            return;
        }
        self.data(message, (space, from), now, each);
    }

    /// Returns the topics with received values or keep-alive messages.
    pub(crate) fn topics(&self) -> impl Iterator<Item = (TopicId, &TopicValues)> {
        self.topics.iter().map(|(topic, heard)| (*topic, heard))
    }

    pub(crate) fn heard(&self, topic: TopicId) -> Option<&TopicValues> {
        self.topics.get(&topic)
    }

    /// Returns the description of a topic that was announced by the sender of its values.
    pub(crate) fn described(&self, topic: TopicId) -> Option<&Arc<AnnouncedDescription>> {
        let from = self.topics.get(&topic)?.from;
        let found = self.announced.get(&(topic, NameKind::Value, from))?;
        Some(&found.described)
    }

    /// Returns the announcements with their senders, in the order of topics. If several senders
    /// announce a topic, returns the first announcement.
    pub(crate) fn announced(
        &self,
    ) -> impl Iterator<Item = (TopicId, NameKind, &Arc<AnnouncedDescription>, SocketAddr)> {
        self.announced_where(|_| true)
    }

    /// Like [`announced`](Self::announced), limited to some senders.
    pub(crate) fn announced_where(
        &self,
        counts: impl Fn(SocketAddr) -> bool,
    ) -> impl Iterator<Item = (TopicId, NameKind, &Arc<AnnouncedDescription>, SocketAddr)> {
        let all = self.announced.iter();
        let mut all: Vec<_> = all.filter(|((_, _, from), _)| counts(*from)).collect();
        all.sort_by_key(|((topic, kind, from), found)| (*topic, *kind, found.first, *from));
        all.dedup_by_key(|((topic, kind, _), _)| (*topic, *kind));
        all.into_iter()
            .map(|((topic, kind, from), found)| (*topic, *kind, &found.described, *from))
    }

    /// Returns all announcements with their senders, in the order of topics.
    pub(crate) fn all_announced(
        &self,
    ) -> impl Iterator<Item = (TopicId, NameKind, &Arc<AnnouncedDescription>, SocketAddr)> {
        let all = self.announced.iter();
        all.map(|((topic, kind, from), found)| (*topic, *kind, &found.described, *from))
    }

    /// Returns the announced calls.
    pub(crate) fn calls(&self) -> impl Iterator<Item = (TopicId, &Arc<AnnouncedDescription>)> {
        let calls = self
            .announced()
            .filter(|(_, kind, ..)| *kind == NameKind::Call);
        calls.map(|(topic, _, described, _)| (topic, described))
    }

    /// Returns the number of addresses that announce a call.
    pub(crate) fn announcers(&self, topic: TopicId) -> usize {
        let all = self.announced.keys();
        all.filter(|(of, kind, _)| (*of, *kind) == (topic, NameKind::Call))
            .count()
    }

    /// Returns the announced applications, by space and address.
    pub(crate) fn applications(
        &self,
    ) -> impl Iterator<Item = (&(u16, SocketAddr), &AnnouncedProgram)> {
        self.applications.iter()
    }

    /// Returns the spaces with received or announced topics, and the spaces of announced
    /// applications.
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

    /// Returns the reasons of dropped messages with their counts.
    pub(crate) fn dropped(&self) -> impl Iterator<Item = (Drop, u64)> {
        self.counters.iter().map(|(drop, count)| (*drop, *count))
    }

    fn data(
        &mut self,
        message: &NetworkMessage<'_>,
        of: (u16, SocketAddr),
        now: Duration,
        each: &mut dyn FnMut(DatagramContent<'_>),
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
        each: &mut dyn FnMut(DatagramContent<'_>),
    ) {
        let Some(writer_id) = message.writer_id else {
            return self.count(Drop::NotInSpace);
        };
        if let Some(topic) = self.hear(writer_id, from, now, Some(&message)) {
            each(DatagramContent::Sample(ReceivedSample {
                topic,
                from: sender,
                described: self.described(topic).cloned(),
                network,
                message,
            }));
        }
    }

    /// Records a message of a topic; `None` stands for a secured message.
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
        let heard = self.topics.entry(topic).or_insert(TopicValues {
            values: 0,
            keep_alives: 0,
            first: now,
            last: now,
            from,
            changed_hands: 0,
            secured: false,
            only: None,
            quality: StatusCode::GOOD,
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
        if let Some(message) = message {
            if heard.only.is_none() {
                heard.only = only(message);
            }
            if message.kind != MessageKind::KeepAlive {
                heard.quality = quality(message);
            }
        }
        Some(topic)
    }

    fn chunk(
        &mut self,
        message: &NetworkMessage<'_>,
        of: (u16, SocketAddr),
        now: Duration,
        each: &mut dyn FnMut(DatagramContent<'_>),
    ) {
        // The reassembled message borrows from the reassembler.
        let mut reassembler = std::mem::take(&mut self.reassembler);
        match reassembler.receive_from(of.1, message, now) {
            Ok(None) => {}
            Ok(Some(whole)) if whole.message_type == NetworkMessageType::Announcement => {
                match Announcement::decode_body(whole.bytes) {
                    Ok(announcement) => self.announcement(&announcement, of, now, each),
                    Err(_) => self.count(Drop::Malformed),
                }
            }
            // Without a payload header the chunks hold a complete encoded NetworkMessage, as the
            // messages of calls do.
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
        each: &mut dyn FnMut(DatagramContent<'_>),
    ) {
        let Ok(actions) = message.actions(ActionDialect::Standard) else {
            return self.count(Drop::Malformed);
        };
        if actions.header().kind == ActionKind::Request {
            return;
        }
        for action in actions {
            match action {
                Ok(action) => each(DatagramContent::Response(action, from)),
                Err(_) => self.count(Drop::Malformed),
            }
        }
    }

    fn announcement(
        &mut self,
        announcement: &Announcement<'_>,
        (space, from): (u16, SocketAddr),
        now: Duration,
        each: &mut dyn FnMut(DatagramContent<'_>),
    ) {
        if let AnnouncedContent::ApplicationDescription {
            description,
            capabilities,
        } = &announcement.announced
        {
            return self.meet(
                AnnouncedProgram::read(description, *capabilities),
                (space, from),
            );
        }
        #[expect(
            clippy::wildcard_enum_match_arm,
            reason = "all else is not about a topic"
        )]
        let (writer_id, name, kind, described) = match &announcement.announced {
            AnnouncedContent::DataSetMetaData {
                writer_id,
                meta_data,
                status,
            } => {
                let is_there = status.0 & BAD == 0;
                let described = is_there.then(|| AnnouncedDescription::of_value(meta_data));
                (*writer_id, meta_data.name, NameKind::Value, described)
            }
            AnnouncedContent::ActionMetaData(of) => {
                let described = Some(AnnouncedDescription::of_call(of));
                (of.writer_id, of.request.name, NameKind::Call, described)
            }
            _ => return,
        };
        let topic = topic_of(name).filter(|topic| {
            let (of, _, id) = topic.triple();
            (of, id) == (space, writer_id)
        });
        match (topic, described) {
            (Some(topic), Some(Ok(described))) => {
                if let Some(described) = self.keep((topic, kind, from), described, now) {
                    each(DatagramContent::Announced {
                        topic,
                        kind,
                        described: &described,
                        from,
                        announcement,
                    });
                }
            }
            // The publisher does not have the item, or has removed it.
            (Some(topic), None) => {
                self.forget((topic, NameKind::Value, from));
                self.forget((topic, NameKind::Call, from));
            }
            (None, None) => {}
            (_, Some(Err(_))) | (None, Some(Ok(_))) => self.count(Drop::Useless),
        }
    }

    /// Stores the description of an application, unless the table is full.
    fn meet(&mut self, application: Option<AnnouncedProgram>, who: (u16, SocketAddr)) {
        let is_known = self.applications.contains_key(&who);
        match application {
            None => self.count(Drop::Useless),
            Some(_) if !is_known && self.applications.len() >= MOST_APPLICATIONS => {
                self.count(Drop::Descriptions);
            }
            Some(application) => drop(self.applications.insert(who, application)),
        }
    }

    /// Stores a description, unless the table is full. Returns it if it is new or changed.
    fn keep(
        &mut self,
        subject: Subject,
        described: AnnouncedDescription,
        now: Duration,
    ) -> Option<Arc<AnnouncedDescription>> {
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

/// Returns the space of a publisher.
fn space(publisher: Option<PublisherId<'_>>) -> Option<u16> {
    match publisher? {
        PublisherId::UInt16(space) => mappings::SpaceId::new(space).map(u16::from),
        PublisherId::Byte(_)
        | PublisherId::UInt32(_)
        | PublisherId::UInt64(_)
        | PublisherId::String(_) => None,
    }
}

/// Returns the type of the only field, and whether it is an array.
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

/// Returns the worst StatusCode of a message and its fields.
fn quality(message: &DataSetMessage<'_>) -> StatusCode {
    let of_message = message.header().status.map(StatusCode::from_status);
    let mut worst = of_message.unwrap_or(StatusCode::GOOD);
    if message.encoding() == FieldEncoding::DataValue
        && let Ok(values) = message.values()
    {
        let all = values.filter_map(|value| value.ok()?.value.status);
        worst = all.fold(worst, |worst, status| {
            // The upper two bits are the severity.
            if status.0 >> 30 > worst.0 >> 30 {
                status
            } else {
                worst
            }
        });
    }
    worst
}

/// The bit of a StatusCode that marks the severity Bad.
pub(super) const BAD: u32 = 0x8000_0000;
const MOST_TOPICS: usize = 16_384;
const MOST_APPLICATIONS: usize = 1_024;
/// Maximum size of all descriptions, in bytes.
const MOST_WEIGHT: usize = 32 << 20;

#[cfg(test)]
mod tests;
