//! Makes the messages of a recording of values again: the announcements and the values of the
//! channels that `ua-space record` writes.

use std::collections::{BTreeMap, VecDeque};
use std::io::Read;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use bridge_core::encode_fields;
use mappings::TopicId;
use messages::{Dialect, MessagePlan, TypeName, TypeRegistry};
use uadp::discovery::{AnnouncedContent, Announcement};
use uadp::{
    ChunkBudget, ChunkEncoder, DataSetHeader, Extras, GroupHeader, NetworkHeader, NetworkMessage,
    NetworkMessageEncoder, NetworkMessageType, PublisherId, Scalar, Timestamp, Whole,
};

use super::mcap::{McapChannel, McapMessage, McapReader};
use super::unusable::UnusableValue;
use super::{RecordedDatagram, json};
use crate::capture::CaptureError;
use crate::live::channels::{ANNOUNCEMENT, MODEL, ros_plan};
use crate::live::described::{AnnouncedDescription, topic_of};
use crate::messages as parts;

/// Reads the messages of a recording of values.
pub(super) struct RecordedValues<R> {
    mcap: McapReader<R>,
    channels: BTreeMap<u16, Rebuilt>,
    /// Datagrams of the last value that are not read yet.
    ready: VecDeque<RecordedDatagram>,
    unusable: BTreeMap<UnusableValue, u64>,
    /// The number of the last value that is larger than a datagram.
    large: u16,
}

/// A channel of the file as a topic of the space.
struct Rebuilt {
    of: Arc<McapChannel>,
    topic: Result<Topic, UnusableValue>,
}

struct Topic {
    id: TopicId,
    form: RecordedForm,
    /// The announcement, until it is read.
    announcement: Option<Vec<u8>>,
    /// Whether the writer numbers its messages.
    numbered: bool,
}

/// The conversion of a message to the fields of a value.
enum RecordedForm {
    Ros(Box<MessagePlan>),
    /// The only field is the message.
    Bytes,
    Json(AnnouncedDescription),
}

impl<R: Read> RecordedValues<R> {
    /// Reads the start of a file; `reader` returns the bytes after the first four.
    pub(super) fn new(reader: R) -> Result<Self, CaptureError> {
        Ok(Self {
            mcap: McapReader::new(reader)?,
            channels: BTreeMap::new(),
            ready: VecDeque::new(),
            unusable: BTreeMap::new(),
            large: 0,
        })
    }

    /// Returns the next datagram; `None` at the end of the file.
    pub(super) fn next(&mut self) -> Result<Option<RecordedDatagram>, CaptureError> {
        loop {
            if let Some(datagram) = self.ready.pop_front() {
                return Ok(Some(datagram));
            }
            let Some(message) = self.mcap.next_message()? else {
                return Ok(None);
            };
            if let Err(why) = self.add(&message) {
                *self.unusable.entry(why).or_default() += 1;
            }
        }
    }

    /// Returns the numbers of values that cannot be sent again, by reason.
    pub(super) const fn unusable(&self) -> &BTreeMap<UnusableValue, u64> {
        &self.unusable
    }

    /// Makes the datagrams of a message.
    fn add(&mut self, message: &McapMessage) -> Result<(), UnusableValue> {
        let known = self.channels.get(&message.channel_id);
        if known.is_none_or(|known| !Arc::ptr_eq(&known.of, &message.channel)) {
            let rebuilt = Rebuilt {
                of: Arc::clone(&message.channel),
                topic: Topic::read(&message.channel),
            };
            self.channels.insert(message.channel_id, rebuilt);
        }
        let rebuilt = self.channels.get_mut(&message.channel_id);
        let topic = rebuilt.ok_or(UnusableValue::Foreign)?.topic.as_mut();
        let topic = topic.map_err(|why| *why)?;
        topic.numbered |= message.sequence != 0;
        let time = i128::from(message.logged);
        let ready = &mut self.ready;
        let mut put = |bytes| {
            ready.push_back(RecordedDatagram {
                time,
                from: SENDER,
                bytes,
            });
        };
        if let Some(announcement) = topic.announcement.take() {
            put(announcement);
        }
        let datagram = topic.datagram(message)?;
        if datagram.len() <= ChunkBudget::IPV4.network_message {
            put(datagram);
            return Ok(());
        }
        self.large = self.large.wrapping_add(1);
        for chunk in chunks(&datagram, self.large)? {
            put(chunk);
        }
        Ok(())
    }
}

impl Topic {
    fn read(channel: &McapChannel) -> Result<Self, UnusableValue> {
        if channel.metadata.contains_key(MODEL) {
            return Err(UnusableValue::Model);
        }
        let id = channel.metadata.get("topic");
        let id: Option<TopicId> = id.and_then(|topic| topic.parse().ok());
        let id = id.ok_or(UnusableValue::Foreign)?;
        let text = channel.metadata.get(ANNOUNCEMENT);
        let bytes = text.and_then(|text| BASE64.decode(text).ok());
        let announcement = bytes.ok_or(UnusableValue::Undescribed)?;
        let described = described(id, &announcement).ok_or(UnusableValue::Undescribed)?;
        let form = match channel.encoding.as_str() {
            "json" => RecordedForm::Json(described),
            "cdr" | "ros1" if described.is_bytes() => RecordedForm::Bytes,
            "cdr" => ros(channel, &described).ok_or(UnusableValue::Mismatch)?,
            _ => return Err(UnusableValue::Foreign),
        };
        Ok(Self {
            id,
            form,
            announcement: Some(announcement),
            numbered: false,
        })
    }

    /// Returns the NetworkMessage of a value.
    fn datagram(&self, message: &McapMessage) -> Result<Vec<u8>, UnusableValue> {
        let (space, namespace, writer_id) = self.id.triple();
        let network = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(space)),
            group: Some(GroupHeader {
                writer_group_id: Some(namespace),
                ..GroupHeader::default()
            }),
            ..NetworkHeader::default()
        };
        let taken = Timestamp::from_unix_nanos(message.published.into());
        // A sequence number of the writer has 16 bits.
        let sequence = u16::try_from(message.sequence).ok();
        let header = DataSetHeader {
            sequence_number: sequence.filter(|_| self.numbered),
            timestamp: Some(taken.time),
            picoseconds: Some(taken.picoseconds),
            ..DataSetHeader::default()
        };
        let mismatch = |_| UnusableValue::Mismatch;
        let ids = [writer_id];
        let mut datagram = Vec::new();
        let mut writer =
            NetworkMessageEncoder::new(&mut datagram, &network, Some(&ids)).map_err(mismatch)?;
        match &self.form {
            RecordedForm::Ros(plan) => {
                let mut frame = writer.key_frame(&header).map_err(mismatch)?;
                encode_fields(plan, &message.data, namespace, &mut frame)
                    .map_err(|_| UnusableValue::Mismatch)?;
                frame.finish().map_err(mismatch)?;
            }
            RecordedForm::Bytes => {
                let mut frame = writer.key_frame(&header).map_err(mismatch)?;
                let bytes = Scalar::ByteString(Some(&message.data));
                frame.scalar(bytes).map_err(mismatch)?;
                frame.finish().map_err(mismatch)?;
            }
            RecordedForm::Json(described) => {
                json::write(&message.data, described.fields(), (&header, &mut writer))?;
            }
        }
        writer.finish().map_err(mismatch)?;
        Ok(datagram)
    }
}

/// Reads the description in an announcement of the topic.
fn described(topic: TopicId, announcement: &[u8]) -> Option<AnnouncedDescription> {
    let message = NetworkMessage::decode(announcement).ok()?;
    let (space, _, writer) = topic.triple();
    let is_of_space = message.publisher_id() == Some(PublisherId::UInt16(space));
    let announcement = Announcement::decode(&message)
        .ok()
        .filter(|_| is_of_space)?;
    let AnnouncedContent::DataSetMetaData {
        writer_id,
        meta_data,
        ..
    } = &announcement.announced
    else {
        return None;
    };
    let is_topic = topic_of(meta_data.name) == Some(topic) && *writer_id == writer;
    is_topic.then(|| AnnouncedDescription::of_value(meta_data).ok())?
}

/// Returns the conversion of the messages of a channel, by the definition in the file.
fn ros(channel: &McapChannel, described: &AnnouncedDescription) -> Option<RecordedForm> {
    let name: TypeName = described.ros_type()?.parse().ok()?;
    let definition = str::from_utf8(&channel.schema.data).ok()?;
    let registry = TypeRegistry::empty(Dialect::Ros2);
    let (found, _) = registry.read_ros1_definition(&name, definition).ok()?;
    ros_plan(&found, &name, described).map(|plan| RecordedForm::Ros(Box::new(plan)))
}

/// Returns a NetworkMessage with a single value in chunks.
fn chunks(datagram: &[u8], number: u16) -> Result<Vec<Vec<u8>>, UnusableValue> {
    let mismatch = |_| UnusableValue::Mismatch;
    let message = NetworkMessage::decode(datagram).map_err(mismatch)?;
    let (values, _) = parts::split(&message);
    let value = values.first().ok_or(UnusableValue::Mismatch)?;
    let whole = Whole {
        message_type: NetworkMessageType::DataSet,
        writer_id: value.writer_id,
        message_sequence_number: number,
        bytes: value.bytes,
    };
    let extras = Extras::default();
    let chunks = ChunkEncoder::new(&message.header(), &extras, whole, ChunkBudget::IPV4);
    let mut chunks = chunks.map_err(|_| UnusableValue::Mismatch)?;
    let mut all = Vec::new();
    loop {
        let mut bytes = Vec::new();
        match chunks.append(&mut bytes, &extras) {
            None => return Ok(all),
            Some(chunk) => drop(chunk.map_err(|_| UnusableValue::Mismatch)?),
        }
        all.push(bytes);
    }
}

/// The recording has no addresses of senders.
const SENDER: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::UNSPECIFIED), 0);
