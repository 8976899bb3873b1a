//! A topic of the domain that we write values of other spaces to.

use std::time::Instant;

use bridge_node::Described;
use bytes::{Bytes, BytesMut};
use mappings::{Overflow, TopicId, Variable};
use messages::{MessageType, Selection, TypeName};
use rustdds::Duration;

use crate::clock::RosTime;
use crate::compatibility::finite_deadline;
use crate::definitions::Definition;
use crate::graph::{Endpoint, dds_topic};
use crate::outlet::Outlet;
use crate::qos::Offered;

/// Where the values of one topic of another space go.
#[derive(Debug)]
pub(crate) struct Sink {
    pub(crate) dds_topic: String,
    pub(crate) offered: Offered,
    /// What the mapping ties it to; it decides alone.
    pub(crate) mapped: Option<(TypeName, Selection)>,
    /// What the writer of the value says of it.
    pub(crate) described: Option<Described>,
    /// The type it says, where it is known here and has those fields, and what of the message they are.
    pub(crate) learned: Option<(TypeName, Selection)>,
    /// The std_msgs type of the value the Router holds, if it is one value and there is such a type.
    pub(crate) standard: Option<TypeName>,
    /// The topic as it is written.
    pub(crate) open: Option<Open>,
    /// Since when its writer in the space is silent.
    pub(crate) silent: Option<Instant>,
}

/// A writer and its type.
#[derive(Debug)]
pub(crate) struct Open {
    pub(crate) definition: Definition,
    pub(crate) outlet: Outlet,
    /// The shortest deadline readers asked for, which the writer offers.
    pub(crate) deadline: Option<Duration>,
    /// How often it was made shorter.
    pub(crate) tightened: u32,
    /// Whether its header's stamp is ours to set: only one field of the message is the value, and not the stamp.
    pub(crate) stamps: bool,
}

impl Open {
    /// The message with the time in its header, if that is not part of the value.
    pub(crate) fn stamped(&self, message: Bytes, now: impl Fn() -> RosTime) -> Bytes {
        if !self.stamps {
            return message;
        }
        let mut message = message
            .try_into_mut()
            .unwrap_or_else(|shared| BytesMut::from(shared.as_ref()));
        // Behind the encapsulation header, std_msgs/Header: stamp, then frame_id. What we write is little endian.
        if let Some(stamp) = message.get_mut(4..12) {
            let RosTime { sec, nanosec } = now();
            let (secs, nanos) = stamp.split_at_mut(4);
            secs.copy_from_slice(&sec.to_le_bytes());
            nanos.copy_from_slice(&nanosec.to_le_bytes());
        }
        message.freeze()
    }

    /// A deadline that a reader asks for and the writer does not offer yet.
    pub(crate) fn shorter_deadline(&self, readers: &[Endpoint]) -> Option<Duration> {
        shortest_deadline(readers)
            .filter(|wanted| self.deadline.is_none_or(|offered| *wanted < offered))
            .filter(|_| self.tightened < MOST_TIGHTENED)
    }
}

/// The shortest deadline among those readers ask for.
pub(crate) fn shortest_deadline(readers: &[Endpoint]) -> Option<Duration> {
    let deadlines = readers.iter().map(|reader| finite_deadline(&reader.qos));
    deadlines.flatten().min()
}

impl Sink {
    /// For a value with or without a variable in the mapping, but without a ROS topic there.
    pub(crate) fn by_name(topic: TopicId, variable: Option<&Variable>) -> Self {
        Self {
            dds_topic: dds_topic(&topic.to_string()),
            offered: offered(
                variable
                    .map(|variable| variable.overflow)
                    .unwrap_or_default(),
            ),
            mapped: None,
            described: None,
            learned: None,
            standard: None,
            open: None,
            silent: None,
        }
    }

    /// For a value the mapping ties to a ROS topic.
    pub(crate) fn mapped(
        ros_topic: &str,
        message_type: TypeName,
        selection: Selection,
        overflow: Overflow,
    ) -> Self {
        Self {
            dds_topic: dds_topic(ros_topic),
            offered: offered(overflow),
            mapped: Some((message_type, selection)),
            described: None,
            learned: None,
            standard: None,
            open: None,
            silent: None,
        }
    }

    /// Whether the mapping says the same of both.
    pub(crate) fn is_like(&self, other: &Self) -> bool {
        self.dds_topic == other.dds_topic
            && self.mapped == other.mapped
            && self.offered == other.offered
    }

    /// The types it could have, best first: the mapping's; what a subscriber asks for, that in which it is written first;
    /// what its writer says; the standard type of the value.
    pub(crate) fn candidates(&self, readers: &[Endpoint]) -> Vec<TypeName> {
        if let Some((message_type, _)) = &self.mapped {
            return vec![message_type.clone()];
        }
        let mut candidates: Vec<TypeName> = Vec::new();
        let asked_for = readers
            .iter()
            .filter_map(|reader| TypeName::from_dds(&reader.type_name).ok());
        let learned = self.learned.as_ref().map(|(name, _)| name.clone());
        let written = self.open.as_ref().map(|open| open.definition.name());
        let is_asked_for = |name: &&TypeName| {
            let dds_type = name.dds();
            readers.iter().any(|reader| reader.type_name == dds_type)
        };
        candidates.extend(written.filter(is_asked_for).cloned());
        for name in asked_for.chain(learned).chain(self.standard.clone()) {
            if !candidates.contains(&name) {
                candidates.push(name);
            }
        }
        candidates
    }

    /// Whether what is open serves somebody, so that it is not to be given up for another type. A subscriber whose definition
    /// nobody tells is not served by ours: it may misread it.
    pub(crate) fn serves(&self, readers: &[Endpoint]) -> bool {
        self.open.as_ref().is_some_and(|open| {
            let dds_type = open.definition.name().dds();
            let served = |reader: &Endpoint| reader.is_of(&dds_type, open.definition.hash);
            readers.is_empty() || readers.iter().any(served)
        })
    }

    /// Looks at what the writer of the value says again, with the definition that is written.
    pub(crate) fn learn_from(&mut self, message_type: &MessageType) {
        let name = message_type.name();
        let described = self.described.as_ref();
        if let Some(described) = described.filter(|described| described.message_type == *name) {
            let selection = described.selection(message_type);
            self.learned = selection.map(|selection| (name.clone(), selection));
        }
    }

    /// Whether the stamp at the beginning of such messages is no part of the value.
    pub(crate) fn stamps(&self, message_type: &MessageType) -> bool {
        bridge_node::wants_stamp(message_type, Some(&self.selection(message_type.name())))
    }

    /// What of a message of that type the value is.
    pub(crate) fn selection(&self, name: &TypeName) -> Selection {
        let learned = self.learned.as_ref().filter(|(learned, _)| learned == name);
        self.mapped
            .as_ref()
            .or(learned)
            .map_or(Selection::Whole, |(_, selection)| selection.clone())
    }
}

/// Each other deadline needs another writer, so readers get that many.
const MOST_TIGHTENED: u32 = 8;

fn offered(overflow: Overflow) -> Offered {
    match overflow {
        Overflow::KeepLatest => Offered::KeepLatest,
        Overflow::DropOldest(depth) => Offered::DropOldest(depth),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustdds::GUID;

    fn reader(name: &str) -> Endpoint {
        Endpoint {
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

    #[test]
    fn a_subscriber_decides_before_the_standard_type() {
        let mut sink = Sink::by_name("ua_1_2_3".parse().unwrap(), None);
        sink.standard = Some("std_msgs/Float64".parse().unwrap());
        assert_eq!(names(&sink.candidates(&[])), ["std_msgs/Float64"]);
        assert_eq!(
            names(&sink.candidates(&[reader("std_msgs/Float32")])),
            ["std_msgs/Float32", "std_msgs/Float64"]
        );
    }

    #[test]
    fn a_message_of_one_field_gets_a_stamp_and_a_whole_one_keeps_its_own() {
        let imu: TypeName = "sensor_msgs/Imu".parse().unwrap();
        let registry = messages::Registry::bundle(messages::Dialect::Ros2);
        let message_type = registry.get(&imu).unwrap();
        let stamps = |selection| {
            Sink::mapped("/imu", imu.clone(), selection, Overflow::KeepLatest).stamps(&message_type)
        };
        assert!(stamps(Selection::Field("angular_velocity.z".to_owned())));
        assert!(!stamps(Selection::Field("header.stamp".to_owned())));
        assert!(!stamps(Selection::Whole));
        assert!(!stamps(Selection::Bytes));
    }

    #[test]
    fn the_mapping_decides_before_any_subscriber() {
        let sink = Sink::mapped(
            "/button",
            "std_msgs/Bool".parse().unwrap(),
            Selection::Whole,
            Overflow::KeepLatest,
        );
        assert_eq!(
            names(&sink.candidates(&[reader("std_msgs/String")])),
            ["std_msgs/Bool"]
        );
        assert_eq!(sink.dds_topic, "rt/button");
    }

    #[test]
    fn a_topic_of_the_space_has_its_own_name() {
        let sink = Sink::by_name("ua_1_2_3".parse().unwrap(), None);
        assert_eq!(sink.dds_topic, "rt/ua_1_2_3");
    }
}
