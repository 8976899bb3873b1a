//! Recordings of the values as MCAP.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use mappings::TopicId;
use uadp::discovery::Announcement;
use uadp::{
    DataSetMessage, FieldEncoding, MessageKind, NetworkHeader, NetworkMessage,
    NetworkMessageEncoder,
};

use super::mcap::{EncodedMessage, McapEncoder};
use super::sink::RecordingFile;
use crate::exit::CommandFailure;
use crate::live::announcements::LatestAnnouncements;
use crate::live::book::ReceivedSample;
use crate::live::channels::{ChannelMismatch, DESCRIBED_WITHIN, TopicChannel, TopicChannels};
use crate::live::copies::Copies;
use crate::live::described::AnnouncedDescription;
use crate::live::robot::RobotModelMessage;
use crate::report::warn;

/// A recording of the values by topic.
pub(super) struct ValueRecorder {
    sink: RecordingFile,
    writer: McapEncoder,
    channels: TopicChannels,
    copies: Copies,
    /// Ids of the channels in the file.
    written: BTreeSet<u16>,
    /// Bytes that are not handed over to the disk.
    part: Vec<u8>,
    /// Values that wait for the description of their topic.
    waiting: VecDeque<UndescribedSample>,
    /// The newest announcement of each topic, as a NetworkMessage.
    announcements: LatestAnnouncements,
    /// The size of all waiting values.
    weight: usize,
    left_out: BTreeMap<ChannelMismatch, u64>,
    scratch: Vec<u8>,
}

/// The outcome of a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RecordOutcome {
    Value,
    /// The same event is in the recording.
    Copy,
    /// The disk is too slow.
    Dropped,
}

/// A value that waits for the description of its topic.
struct UndescribedSample {
    topic: TopicId,
    /// The time of arrival, since the group was joined.
    since: Duration,
    times: Times,
    /// A NetworkMessage with the value alone.
    datagram: Vec<u8>,
}

/// The times of a value, in nanoseconds since 1970.
#[derive(Debug, Clone, Copy)]
struct Times {
    logged: u64,
    published: u64,
}

impl ValueRecorder {
    pub(super) fn new(sink: RecordingFile) -> Self {
        let mut part = Vec::new();
        let writer = McapEncoder::begin(&mut part);
        Self {
            sink,
            writer,
            channels: TopicChannels::new(),
            copies: Copies::default(),
            written: BTreeSet::new(),
            part,
            waiting: VecDeque::new(),
            announcements: LatestAnnouncements::default(),
            weight: 0,
            left_out: BTreeMap::new(),
            scratch: Vec::new(),
        }
    }

    /// Adds the model of a robot as the only message of its channel.
    pub(super) fn add_model(&mut self, model: &RobotModelMessage, time: i128) {
        let channel = match self.channels.of_model(model) {
            Ok(channel) => channel,
            Err(unfit) => return self.leave_out(unfit),
        };
        let time = u64::try_from(time).unwrap_or_default();
        self.writer.channel(&channel, None);
        self.writer.message(&EncodedMessage {
            channel: channel.id,
            sequence: 0,
            logged: time,
            published: time,
            data: &model.data,
        });
    }

    /// Adds a value that arrived at `now`; `time` is the same time since 1970.
    pub(super) fn add(
        &mut self,
        sample: &ReceivedSample<'_>,
        (now, time): (Duration, i128),
    ) -> Result<RecordOutcome, CommandFailure> {
        if self.writer.waiting() >= CHUNK && !self.flush()? {
            return Ok(RecordOutcome::Dropped);
        }
        if self.copies.is_copy(sample, now) {
            return Ok(RecordOutcome::Copy);
        }
        let times = Times::of(sample, time);
        let described = sample.described.as_ref();
        match self.channels.channel(sample.topic, described, now) {
            Ok(channel) => {
                self.release(sample.topic, &channel);
                self.write((sample.topic, &channel), times, &sample.message);
            }
            Err(ChannelMismatch::Undescribed) => self.hold(sample, times, now),
            Err(unfit) => self.leave_out(unfit),
        }
        Ok(RecordOutcome::Value)
    }

    /// Keeps the announcement of a topic, and records the values that wait for it.
    pub(super) fn described(
        &mut self,
        (topic, announcement): (TopicId, &Announcement<'_>),
        described: &Arc<AnnouncedDescription>,
        now: Duration,
    ) {
        self.announcements.keep(topic, announcement);
        if self.waiting.iter().any(|waiting| waiting.topic == topic)
            && let Ok(channel) = self.channels.channel(topic, Some(described), now)
        {
            self.release(topic, &channel);
        }
    }

    /// Returns whether values wait for a description.
    pub(super) fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Records the values that have waited too long for a description, without it.
    pub(super) fn give_up_waiting(&mut self, now: Duration) {
        while let Some(first) = self.waiting.front()
            && now >= first.since + DESCRIBED_WITHIN
        {
            let topic = first.topic;
            match self.channels.channel(topic, None, now) {
                Ok(channel) => self.release(topic, &channel),
                Err(unfit) => {
                    if let Some(dropped) = self.waiting.pop_front() {
                        self.weight -= dropped.datagram.len();
                    }
                    self.leave_out(unfit);
                }
            }
        }
    }

    /// Hands over the current chunk. Returns false if the disk is too slow.
    pub(super) fn flush(&mut self) -> Result<bool, CommandFailure> {
        if self.part.is_empty() {
            self.writer.end_chunk(self.sink.length(), &mut self.part);
        }
        self.sink.offer(&mut self.part)
    }

    /// Ends the file. Returns its length.
    pub(super) fn finish(mut self) -> Result<u64, CommandFailure> {
        self.give_up_waiting(Duration::MAX);
        for (unfit, count) in &self.left_out {
            warn(&format!("{count} left out: {}", unfit.label()));
        }
        let unknown: Vec<&str> = self.channels.unknown().iter().map(String::as_str).collect();
        if !unknown.is_empty() {
            warn(&format!(
                "recorded as JSON, because these definitions are not known here: {}\n  = help: set AMENT_PREFIX_PATH or ROS_PACKAGE_PATH to folders that have them",
                unknown.join(", ")
            ));
        }
        let at = self.sink.length();
        let begin = self.part.len();
        let at = at + u64::try_from(begin).unwrap_or_default();
        let mut end = Vec::new();
        self.writer.finish(at, &mut end);
        self.part.extend(end);
        self.sink.finish(self.part)
    }

    fn write(
        &mut self,
        (topic, channel): (TopicId, &TopicChannel),
        times: Times,
        message: &DataSetMessage<'_>,
    ) {
        self.scratch.clear();
        let mut data = std::mem::take(&mut self.scratch);
        match channel.encode(message, &mut data) {
            Ok(()) => {
                if self.written.insert(channel.id) {
                    let announcement = self.announcements.get(topic);
                    let announcement = announcement.filter(|_| channel.is_described());
                    self.writer.channel(channel, announcement);
                }
                self.writer.message(&EncodedMessage {
                    channel: channel.id,
                    sequence: message.sequence_number().unwrap_or_default().into(),
                    logged: times.logged,
                    published: times.published,
                    data: &data,
                });
            }
            Err(unfit) => self.leave_out(unfit),
        }
        self.scratch = data;
    }

    fn hold(&mut self, sample: &ReceivedSample<'_>, times: Times, now: Duration) {
        let Some(datagram) = alone(&sample.message) else {
            return self.leave_out(ChannelMismatch::Undescribed);
        };
        self.weight += datagram.len();
        self.waiting.push_back(UndescribedSample {
            topic: sample.topic,
            since: now,
            times,
            datagram,
        });
        while self.waiting.len() > MOST_WAITING || self.weight > MOST_WEIGHT {
            let Some(oldest) = self.waiting.pop_front() else {
                break;
            };
            self.weight -= oldest.datagram.len();
            self.leave_out(ChannelMismatch::Undescribed);
        }
    }

    fn release(&mut self, topic: TopicId, channel: &TopicChannel) {
        if self.waiting.is_empty() {
            return;
        }
        let all = std::mem::take(&mut self.waiting);
        let (ready, rest): (VecDeque<_>, VecDeque<_>) =
            all.into_iter().partition(|waiting| waiting.topic == topic);
        self.waiting = rest;
        for waiting in ready {
            self.weight -= waiting.datagram.len();
            let message = NetworkMessage::decode(&waiting.datagram).ok();
            let message = message.and_then(|message| message.messages().next()?.ok());
            match message {
                Some(message) => self.write((topic, channel), waiting.times, &message),
                None => self.leave_out(ChannelMismatch::Mismatch),
            }
        }
    }

    fn leave_out(&mut self, unfit: ChannelMismatch) {
        *self.left_out.entry(unfit).or_default() += 1;
    }
}

impl Times {
    fn of(sample: &ReceivedSample<'_>, arrived: i128) -> Self {
        let logged = u64::try_from(arrived).unwrap_or_default();
        let published = sample.taken().or_else(|| sample.sent());
        let published = published.and_then(|nanos| u64::try_from(nanos).ok());
        Self {
            logged,
            published: published.unwrap_or(logged),
        }
    }
}

/// Returns a NetworkMessage with this message alone; `None` for messages other than whole ones of
/// Variants.
fn alone(message: &DataSetMessage<'_>) -> Option<Vec<u8>> {
    let is_whole = matches!(message.kind, MessageKind::KeyFrame | MessageKind::Event);
    if !is_whole || message.encoding() != FieldEncoding::Variant {
        return None;
    }
    let mut datagram = Vec::new();
    let mut writer =
        NetworkMessageEncoder::new(&mut datagram, &NetworkHeader::default(), None).ok()?;
    let mut frame = writer.key_frame(&message.header()).ok()?;
    frame.fields_block(message.payload()).ok()?;
    frame.finish().ok()?;
    writer.finish().ok()?;
    Some(datagram)
}

/// Size in bytes at which a chunk is handed over.
const CHUNK: usize = 1 << 20;
/// Maximum number and size of values that wait for descriptions.
const MOST_WAITING: usize = 10_000;
const MOST_WEIGHT: usize = 16 << 20;

#[cfg(test)]
mod tests;
