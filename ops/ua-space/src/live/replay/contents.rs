//! The contents of a recording, and the messages in it that are sent again.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use mappings::{Motion, SpaceId, TopicId};
use uadp::discovery::{AnnouncedContent, Announcement};
use uadp::{NetworkMessage, NetworkMessageType, PublisherId};

use super::datagram;
use crate::arguments::ReplayArguments;
use crate::exit::CommandFailure;
use crate::live::announcements::LatestAnnouncements;
use crate::live::book::{BAD, Book, DatagramContent, NameKind};
use crate::live::described::{AnnouncedDescription, topic_of};
use crate::live::sealing::Sealing;
use crate::recorded::{RecordingReader, UnusableValue};

/// The reason why a message is not sent again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum ReplayOmission {
    /// A value of the OPC UA side, or a value that acts where it arrives.
    Command,
    /// A value that may be a command, because the recording has no description of it.
    Undescribed,
    /// A request, a response or the description of a call.
    Call,
    /// The description of a program, which does not run.
    Program,
    /// A question of a tool or program.
    Probe,
    /// A description that is sent before the values.
    SentBefore,
    /// A secured message without its keys.
    Secured,
    /// A message of a space that is not wanted.
    OtherSpace,
    /// No message of the space.
    Foreign,
    Malformed,
}

impl ReplayOmission {
    /// Returns the text for output.
    pub(super) const fn label(self) -> &'static str {
        match self {
            Self::Command => "commands, which --commands sends",
            Self::Undescribed => {
                "values without a description, which may be commands; --commands sends them"
            }
            Self::Call => "requests, responses and descriptions of calls, which --commands sends",
            Self::Program => "descriptions of programs",
            Self::Probe => "probes",
            Self::SentBefore => "large descriptions, which are sent before the values",
            Self::Secured => "secured messages, which need --keys",
            Self::OtherSpace => "messages of other spaces than --space",
            Self::Foreign => {
                "heartbeats of redundant bridges, and datagrams without a name of the space"
            }
            Self::Malformed => "malformed messages",
        }
    }
}

/// A message to send, without security.
#[derive(Debug)]
pub(super) struct Prepared {
    pub(super) plain: Vec<u8>,
    /// Whether it was secured in the recording.
    pub(super) secured: bool,
    /// Values that were removed from it, by reason.
    pub(super) removed: BTreeMap<ReplayOmission, u64>,
}

/// The topics of a recording.
pub(super) struct RecordingContents {
    commands: bool,
    only: BTreeSet<SpaceId>,
    /// The time of the first message of the space.
    pub(super) first: i128,
    book: Book,
    /// The first description of each topic, and one that acts.
    descriptions: BTreeMap<TopicId, Vec<Arc<AnnouncedDescription>>>,
    announcements: LatestAnnouncements,
    /// Values of an MCAP file that cannot be sent again.
    pub(super) unusable: BTreeMap<UnusableValue, u64>,
}

impl RecordingContents {
    /// Reads the descriptions and topics of a recording.
    ///
    /// # Errors
    /// A [`CommandFailure`] if the file cannot be read.
    pub(super) fn read(
        arguments: &ReplayArguments,
        sealing: &mut Option<Sealing>,
    ) -> Result<Self, CommandFailure> {
        let mut recorded = RecordingReader::open(&arguments.file)?;
        let mut contents = Self {
            commands: arguments.commands,
            only: arguments.space.iter().copied().collect(),
            first: i128::MAX,
            book: Book::new(),
            descriptions: BTreeMap::new(),
            announcements: LatestAnnouncements::default(),
            unusable: BTreeMap::new(),
        };
        let mut scratch = Vec::new();
        while let Some(datagram) = recorded.next()? {
            let Ok(message) = NetworkMessage::decode(&datagram.bytes) else {
                continue;
            };
            if space(&message).is_none() {
                continue;
            }
            contents.first = contents.first.min(datagram.time);
            let since = u64::try_from(datagram.time - contents.first).unwrap_or_default();
            let now = Duration::from_nanos(since);
            scratch.clear();
            let message = match sealing {
                Some(sealing) => sealing.open(message, &mut scratch),
                None => message,
            };
            let from = datagram.from;
            let descriptions = &mut contents.descriptions;
            let announcements = &mut contents.announcements;
            let mut each =
                |news: DatagramContent<'_>| describe((descriptions, announcements), &news);
            contents.book.handle((&message, from), now, &mut each);
        }
        contents.unusable = recorded.unusable();
        Ok(contents)
    }

    /// Returns the topics with the number of their values, and the reason why they are left out.
    pub(super) fn topics(&self) -> impl Iterator<Item = (TopicId, u64, Option<ReplayOmission>)> {
        self.book.topics().map(|(topic, heard)| {
            let why = self.left_out(topic);
            // The keys do not help if the space is not wanted.
            let is_closed = heard.secured && why != Some(ReplayOmission::OtherSpace);
            let closed = is_closed.then_some(ReplayOmission::Secured);
            (topic, heard.values, closed.or(why))
        })
    }

    /// Returns the description of a topic.
    pub(super) fn described(&self, topic: TopicId) -> Option<&Arc<AnnouncedDescription>> {
        self.descriptions.get(&topic)?.first()
    }

    /// Returns the spaces with messages to send.
    pub(super) fn spaces(&self) -> BTreeSet<u16> {
        let topics = self.book.topics();
        let sent = topics.filter(|(topic, _)| self.left_out(*topic).is_none());
        let mut spaces: BTreeSet<u16> = sent.map(|(topic, ..)| topic.space.into()).collect();
        if self.commands {
            let wanted = |space: &u16| SpaceId::new(*space).is_some_and(|of| self.is_wanted(of));
            spaces.extend(self.book.spaces().into_iter().filter(wanted));
        }
        spaces
    }

    /// Returns the announcements of the topics that are sent.
    pub(super) fn announcements(&self) -> impl Iterator<Item = (TopicId, &[u8])> {
        let all = self.announcements.iter();
        all.filter(|(topic, _)| self.left_out(*topic).is_none())
    }

    fn is_wanted(&self, space: SpaceId) -> bool {
        self.only.is_empty() || self.only.contains(&space)
    }

    /// Returns the reason why the values of a topic are left out.
    fn left_out(&self, topic: TopicId) -> Option<ReplayOmission> {
        if !self.is_wanted(topic.space) {
            return Some(ReplayOmission::OtherSpace);
        }
        if self.commands {
            return None;
        }
        if topic.space == SpaceId::UA {
            return Some(ReplayOmission::Command);
        }
        match self.descriptions.get(&topic) {
            None => Some(ReplayOmission::Undescribed),
            Some(all) => all
                .iter()
                .any(|one| acts(one))
                .then_some(ReplayOmission::Command),
        }
    }

    /// Returns the message to send for a recorded datagram, or the reason why it is left out.
    pub(super) fn prepare(
        &self,
        datagram: &[u8],
        sealing: &mut Option<Sealing>,
    ) -> Result<Prepared, ReplayOmission> {
        let message = NetworkMessage::decode(datagram).map_err(|_| ReplayOmission::Malformed)?;
        if message.message_type() == NetworkMessageType::Probe {
            return Err(ReplayOmission::Probe);
        }
        let space = space(&message).ok_or(ReplayOmission::Foreign)?;
        if !self.is_wanted(space) {
            return Err(ReplayOmission::OtherSpace);
        }
        let secured = message.is_sealed();
        let mut scratch = Vec::new();
        let message = match sealing {
            Some(sealing) => sealing.open(message, &mut scratch),
            None => message,
        };
        if message.is_sealed() {
            return Err(ReplayOmission::Secured);
        }
        let mut removed = BTreeMap::new();
        let plain = datagram::plain(&message);
        let plain = match self.place(&message, space)? {
            SendWay::Whole => plain,
            SendWay::Values(namespace) => {
                let keeps = |id| {
                    let topic = TopicId::new(space.into(), namespace, id);
                    let why =
                        topic.map_or(Some(ReplayOmission::Foreign), |topic| self.left_out(topic));
                    if let Some(why) = why {
                        *removed.entry(why).or_default() += 1;
                    }
                    why.is_none()
                };
                let kept = datagram::filtered(plain, keeps);
                kept.map_err(|_| ReplayOmission::Malformed)?
                    .unwrap_or_default()
            }
        };
        Ok(Prepared {
            plain,
            secured,
            removed,
        })
    }

    /// Returns the way in which a message is sent.
    fn place(
        &self,
        message: &NetworkMessage<'_>,
        space: SpaceId,
    ) -> Result<SendWay, ReplayOmission> {
        if message.message_type() == NetworkMessageType::Announcement {
            return self.place_announcement(message, space);
        }
        // Large requests and responses are chunks without a DataSetWriterId.
        let is_call = message.is_action() || message.is_chunk() && message.writer_ids().is_none();
        match (is_call, self.commands) {
            (true, true) => return Ok(SendWay::Whole),
            (true, false) => return Err(ReplayOmission::Call),
            (false, _) => {}
        }
        let group = message.group().and_then(|group| group.writer_group_id);
        group.map(SendWay::Values).ok_or(ReplayOmission::Foreign)
    }

    fn place_announcement(
        &self,
        message: &NetworkMessage<'_>,
        space: SpaceId,
    ) -> Result<SendWay, ReplayOmission> {
        if message.is_chunk() {
            return Err(ReplayOmission::SentBefore);
        }
        let announcement = Announcement::decode(message).map_err(|_| ReplayOmission::Malformed)?;
        if let AnnouncedContent::ActionMetaData(_) = announcement.announced {
            return if self.commands {
                Ok(SendWay::Whole)
            } else {
                Err(ReplayOmission::Call)
            };
        }
        let topic = described_topic(&announcement).filter(|topic| topic.space == space);
        match topic.map(|topic| self.left_out(topic)) {
            None => Err(ReplayOmission::Program),
            Some(None) => Ok(SendWay::Whole),
            Some(Some(why)) => Err(why),
        }
    }
}

/// The way in which a message is sent.
enum SendWay {
    Whole,
    /// Only values that are not left out, of this WriterGroup.
    Values(u16),
}

/// Returns whether a value acts where it arrives.
fn acts(described: &AnnouncedDescription) -> bool {
    described.command || described.ros_type().is_some_and(moves)
}

/// Returns whether messages of a ROS type command a movement.
fn moves(name: &str) -> bool {
    let is_motion = name.parse().is_ok_and(|name| Motion::of(&name).is_some());
    let own = name.rsplit('/').next().unwrap_or_default();
    is_motion
        || own.ends_with("ActionGoal")
        || matches!(own, "JointJog" | "MultiDOFJointTrajectory")
}

/// Keeps the newest announcement of a topic, its first description, and the first description that
/// acts. Values of a topic act if one of its writers said so at any time: a mapping changes, and a
/// program ends.
fn describe(
    (descriptions, announcements): (
        &mut BTreeMap<TopicId, Vec<Arc<AnnouncedDescription>>>,
        &mut LatestAnnouncements,
    ),
    news: &DatagramContent<'_>,
) {
    let DatagramContent::Announced {
        topic,
        kind: NameKind::Value,
        described,
        announcement,
        ..
    } = news
    else {
        return;
    };
    announcements.keep(*topic, announcement);
    let all = descriptions.entry(*topic).or_default();
    if all.is_empty() || (acts(described) && !all.iter().any(|one| acts(one))) {
        all.push(Arc::clone(described));
    }
}

/// Returns the topic that an announcement describes; `None` also for the end of a topic.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "all else is not about a topic"
)]
fn described_topic(announcement: &Announcement<'_>) -> Option<TopicId> {
    match &announcement.announced {
        AnnouncedContent::DataSetMetaData {
            meta_data, status, ..
        } if status.0 & BAD == 0 => topic_of(meta_data.name),
        _ => None,
    }
}

/// Returns the space of a message.
pub(super) fn space(message: &NetworkMessage<'_>) -> Option<SpaceId> {
    match message.publisher_id()? {
        PublisherId::UInt16(space) => SpaceId::new(space),
        PublisherId::Byte(_)
        | PublisherId::UInt32(_)
        | PublisherId::UInt64(_)
        | PublisherId::String(_) => None,
    }
}
