//! A topic of the domain to which the bridge writes values of other spaces.

use std::num::NonZeroU16;
use std::time::Instant;

use bridge_node::policy::{Choice, Destination};
use bytes::{Bytes, BytesMut};
use mappings::{Lasting, Overflow};
use messages::TypeName;
use ros2_node::clock::Ros2Time;
use ros2_node::compatibility::finite_deadline;
use ros2_node::graph::{RemoteEndpoint, dds_topic};
use ros2_node::outlet::Outlet;
use ros2_node::qos::Offered;
use rustdds::Duration;

use crate::definitions::TypeDefinition;

/// The destination of the values of a topic of another space.
#[derive(Debug)]
pub(crate) struct Ros2Sink {
    pub(crate) dds_topic: String,
    pub(crate) offered: Offered,
    /// The choice of the type.
    pub(crate) choice: Choice,
    /// The open writer of the topic.
    pub(crate) open: Option<OpenWriter>,
    /// The time at which its publisher in the space fell silent.
    pub(crate) silent: Option<Instant>,
}

/// A writer and its type.
#[derive(Debug)]
pub(crate) struct OpenWriter {
    pub(crate) definition: TypeDefinition,
    pub(crate) outlet: Outlet,
    /// The shortest deadline that readers requested, which the writer offers.
    pub(crate) deadline: Option<Duration>,
    /// How often the deadline was shortened.
    pub(crate) tightened: u32,
    /// Whether the bridge sets the stamp of the header: only one field of the message is the value,
    /// and it is not the stamp.
    pub(crate) stamps: bool,
}

impl OpenWriter {
    /// Returns the message with the time in its header, if the stamp is not part of the value.
    pub(crate) fn stamped(&self, message: Bytes, now: impl Fn() -> Ros2Time) -> Bytes {
        if !self.stamps {
            return message;
        }
        let mut message = message
            .try_into_mut()
            .unwrap_or_else(|shared| BytesMut::from(shared.as_ref()));
        // After the encapsulation header, std_msgs/Header: stamp, then frame_id. Written messages
        // are little endian.
        if let Some(stamp) = message.get_mut(4..12) {
            let Ros2Time { sec, nanosec } = now();
            let (secs, nanos) = stamp.split_at_mut(4);
            secs.copy_from_slice(&sec.to_le_bytes());
            nanos.copy_from_slice(&nanosec.to_le_bytes());
        }
        message.freeze()
    }

    /// Returns a deadline that a reader requests and the writer does not offer yet.
    pub(crate) fn shorter_deadline(&self, readers: &[RemoteEndpoint]) -> Option<Duration> {
        shortest_deadline(readers)
            .filter(|wanted| self.deadline.is_none_or(|offered| *wanted < offered))
            .filter(|_| self.tightened < MOST_TIGHTENED)
    }
}

/// Returns the shortest deadline that the readers request.
pub(crate) fn shortest_deadline(readers: &[RemoteEndpoint]) -> Option<Duration> {
    let deadlines = readers.iter().map(|reader| finite_deadline(&reader.qos));
    deadlines.flatten().min()
}

impl Ros2Sink {
    pub(crate) fn new(destination: Destination) -> Self {
        let Destination {
            ros_topic,
            mapped,
            overflow,
            lasting,
        } = destination;
        Self {
            dds_topic: dds_topic(&ros_topic),
            offered: offered(overflow, lasting),
            choice: Choice::new(mapped),
            open: None,
            silent: None,
        }
    }

    /// Returns whether the mapping defines both alike.
    pub(crate) fn is_like(&self, other: &Self) -> bool {
        self.dds_topic == other.dds_topic
            && self.choice.mapped() == other.choice.mapped()
            && self.offered == other.offered
    }

    /// Returns the candidate types, best first; among the types that subscribers request, the
    /// written type comes first.
    pub(crate) fn candidates(&self, readers: &[RemoteEndpoint]) -> Vec<TypeName> {
        let asked_for = readers
            .iter()
            .filter_map(|reader| TypeName::from_dds(&reader.type_name).ok());
        let written = self.open.as_ref().map(|open| open.definition.name());
        let is_asked_for = |name: &&TypeName| {
            let dds_type = name.dds();
            readers.iter().any(|reader| reader.type_name == dds_type)
        };
        let written = written.filter(is_asked_for).cloned();
        self.choice.candidates(written.into_iter().chain(asked_for))
    }

    /// Returns whether the open writer serves a subscriber or there is no subscriber, so that it is
    /// not given up for another type. A subscriber with an unknown definition, which no node
    /// describes, is not served by ours: it may misread the values.
    pub(crate) fn serves(&self, readers: &[RemoteEndpoint]) -> bool {
        self.open.as_ref().is_some_and(|open| {
            let dds_type = open.definition.name().dds();
            let served = |reader: &RemoteEndpoint| reader.is_of(&dds_type, open.definition.hash);
            readers.is_empty() || readers.iter().any(served)
        })
    }
}

/// Each change of the deadline needs another writer, so their number is limited.
const MOST_TIGHTENED: u32 = 8;

/// Returns the policies of a topic. If the source decides whether the topic is a state, it is
/// offered as a state, and its events are removed once they are delivered. The published RustDDS
/// cannot remove them, so the topic is then offered as an event topic.
fn offered(overflow: Overflow, lasting: Lasting) -> Offered {
    let is_offered = match lasting {
        Lasting::State => true,
        Lasting::Event => false,
        Lasting::AsSource => ros2_node::limits::PATCHED,
    };
    match overflow {
        Overflow::KeepLatest if is_offered => Offered::KeepLatest,
        Overflow::KeepLatest => Offered::DropOldest(NonZeroU16::MIN),
        Overflow::DropOldest(depth) => Offered::DropOldest(depth),
    }
}

#[cfg(test)]
mod tests {
    use bridge_node::policy::{PortStep, Word};
    use messages::Selection;
    use rustdds::GUID;

    use super::*;

    fn reader(name: &str) -> RemoteEndpoint {
        RemoteEndpoint {
            guid: GUID::GUID_UNKNOWN,
            type_name: name.parse::<TypeName>().unwrap().dds(),
            reliable: true,
            transient_local: false,
            type_hash: None,
            qos: Default::default(),
        }
    }

    fn names(candidates: &[TypeName]) -> Vec<String> {
        candidates.iter().map(ToString::to_string).collect()
    }

    fn sink(ros_topic: &str, mapped: Option<&str>) -> Ros2Sink {
        Ros2Sink::new(Destination {
            ros_topic: ros_topic.to_owned(),
            mapped: mapped.map(|name| (name.parse().unwrap(), Selection::Whole)),
            overflow: Overflow::KeepLatest,
            lasting: Lasting::State,
        })
    }

    #[test]
    fn a_subscriber_decides_before_the_standard_type() {
        let mut sink = sink("/ua_1_2_3", None);
        let word = Word {
            standard: Some("std_msgs/Float64".parse().unwrap()),
            ..Word::default()
        };
        assert_eq!(sink.choice.hear(word, None), PortStep::Open);
        assert_eq!(names(&sink.candidates(&[])), ["std_msgs/Float64"]);
        assert_eq!(
            names(&sink.candidates(&[reader("std_msgs/Float32")])),
            ["std_msgs/Float32", "std_msgs/Float64"]
        );
    }

    #[test]
    fn a_topic_has_the_name_of_ros_in_the_domain() {
        let mapped = sink("/button", Some("std_msgs/Bool"));
        assert_eq!(mapped.dds_topic, "rt/button");
        assert_eq!(sink("/ua_1_2_3", None).dds_topic, "rt/ua_1_2_3");
    }
}
