//! A topic of the graph that we write values of other spaces to.

use std::sync::Arc;
use std::time::Instant;

use bytes::{Bytes, BytesMut};
use mappings::{Overflow, TopicId, Variable};
use messages::{MessageType, Selection, TypeName};
use tcpros::{Publisher, PublisherOptions, RosTime};

/// Where the values of one topic of another space go.
#[derive(Debug)]
pub(crate) struct Sink {
    pub(crate) ros_topic: String,
    /// What the mapping ties it to; it decides alone.
    pub(crate) mapped: Option<(TypeName, Selection)>,
    /// What the writer of the value says it is, and what of the message it makes.
    pub(crate) learned: Option<(TypeName, Selection)>,
    /// The std_msgs type of the value the Router holds, if it is one value and there is such a type.
    pub(crate) standard: Option<TypeName>,
    /// The topic as it is written.
    pub(crate) open: Option<Open>,
    /// Since when its writer in the space is silent.
    pub(crate) silent: Option<Instant>,
    latch: bool,
}

/// A publisher and its type.
#[derive(Debug)]
pub(crate) struct Open {
    pub(crate) message_type: Arc<MessageType>,
    pub(crate) publisher: Publisher,
    /// Losses of slow subscribers that were reported.
    pub(crate) reported: u64,
    /// Whether its header's stamp is ours to set: only one field of the message is the value, and not the stamp.
    pub(crate) stamps: bool,
}

impl Open {
    /// The message with the time in its header, if that is not part of the value.
    pub(crate) fn stamped(&self, message: Bytes, now: RosTime) -> Bytes {
        if !self.stamps {
            return message;
        }
        let mut message = message
            .try_into_mut()
            .unwrap_or_else(|shared| BytesMut::from(shared.as_ref()));
        // std_msgs/Header: seq, then stamp, then frame_id.
        if let Some(stamp) = message.get_mut(4..12) {
            let (secs, nsecs) = stamp.split_at_mut(4);
            secs.copy_from_slice(&now.secs.to_le_bytes());
            nsecs.copy_from_slice(&now.nsecs.to_le_bytes());
        }
        message.freeze()
    }
}

impl Sink {
    /// For a value with or without a variable in the mapping, but without a ROS topic there.
    pub(crate) fn by_name(topic: TopicId, variable: Option<&Variable>) -> Self {
        let overflow = variable
            .map(|variable| variable.overflow)
            .unwrap_or_default();
        Self::new(format!("/{topic}"), None, overflow)
    }

    /// For a value the mapping ties to a ROS topic.
    pub(crate) fn mapped(
        ros_topic: String,
        message_type: TypeName,
        selection: Selection,
        overflow: Overflow,
    ) -> Self {
        Self::new(ros_topic, Some((message_type, selection)), overflow)
    }

    fn new(ros_topic: String, mapped: Option<(TypeName, Selection)>, overflow: Overflow) -> Self {
        // The value of a state is of use to who comes late, an event is not.
        let latch = overflow == Overflow::KeepLatest;
        Self {
            ros_topic,
            mapped,
            learned: None,
            standard: None,
            open: None,
            silent: None,
            latch,
        }
    }

    /// Whether the mapping says the same of both.
    pub(crate) fn is_like(&self, other: &Self) -> bool {
        self.ros_topic == other.ros_topic
            && self.mapped == other.mapped
            && self.latch == other.latch
    }

    /// The types it could have, best first: the mapping's; what subscribers ask for; what its writer
    /// says; the standard type of the value.
    pub(crate) fn candidates(&self, asked_for: Option<&str>) -> Vec<TypeName> {
        if let Some((message_type, _)) = &self.mapped {
            return vec![message_type.clone()];
        }
        let refused = self
            .open
            .as_ref()
            .and_then(|open| open.publisher.refused_type());
        let asked_for = asked_for.map(str::to_owned).into_iter().chain(refused);
        let mut candidates: Vec<TypeName> = Vec::new();
        for name in asked_for
            .filter_map(|name| name.parse().ok())
            .chain(self.learned.as_ref().map(|(name, _)| name.clone()))
            .chain(self.standard.clone())
        {
            if !candidates.contains(&name) {
                candidates.push(name);
            }
        }
        candidates
    }

    /// Whether what is open serves somebody, or nobody asked for anything else: it is then not to be given up.
    pub(crate) fn serves(&self) -> bool {
        self.open.as_ref().is_some_and(|open| {
            open.publisher.subscribers() > 0 || open.publisher.refused_type().is_none()
        })
    }

    /// What of a message of that type the value is.
    pub(crate) fn selection(&self, name: &TypeName) -> Selection {
        let learned = self.learned.as_ref().filter(|(learned, _)| learned == name);
        self.mapped
            .as_ref()
            .or(learned)
            .map_or(Selection::Whole, |(_, selection)| selection.clone())
    }

    /// Whether the stamp at the beginning of such messages is no part of the value.
    pub(crate) fn stamps(&self, message_type: &MessageType) -> bool {
        bridge_node::wants_stamp(message_type, Some(&self.selection(message_type.name())))
    }

    /// The Router's queue says what waits; behind it, as much is held for a slow subscriber as for any.
    pub(crate) fn options(&self) -> PublisherOptions {
        PublisherOptions {
            latch: self.latch,
            ..PublisherOptions::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_of_one_field_gets_a_stamp_and_a_whole_one_keeps_its_own() {
        let imu: TypeName = "sensor_msgs/Imu".parse().unwrap();
        let registry = messages::Registry::bundle(messages::Dialect::Ros1);
        let message_type = registry.get(&imu).unwrap();
        let stamps = |selection: Selection| {
            Sink::mapped(
                "/imu".to_owned(),
                imu.clone(),
                selection,
                Overflow::KeepLatest,
            )
            .stamps(&message_type)
        };
        assert!(stamps(Selection::Field("angular_velocity.z".to_owned())));
        assert!(!stamps(Selection::Field("header.stamp".to_owned())));
        assert!(!stamps(Selection::Whole));
        assert!(!stamps(Selection::Bytes));
    }

    #[test]
    fn a_subscriber_decides_before_the_standard_type() {
        let mut sink = Sink::by_name("ua_2_2_3".parse().unwrap(), None);
        sink.standard = Some("std_msgs/Float64".parse().unwrap());
        assert_eq!(sink.ros_topic, "/ua_2_2_3");
        assert_eq!(sink.candidates(None), ["std_msgs/Float64".parse().unwrap()]);
        let asked: [TypeName; 2] = [
            "std_msgs/Float32".parse().unwrap(),
            "std_msgs/Float64".parse().unwrap(),
        ];
        assert_eq!(sink.candidates(Some("std_msgs/Float32")), asked);
        assert_eq!(sink.candidates(Some("*")).len(), 1);
    }

    #[test]
    fn the_mapping_decides_before_any_subscriber() {
        let bool: TypeName = "std_msgs/Bool".parse().unwrap();
        let sink = Sink::mapped(
            "/button".to_owned(),
            bool.clone(),
            Selection::Whole,
            Overflow::DropOldest(8.try_into().unwrap()),
        );
        assert_eq!(sink.candidates(Some("std_msgs/String")), [bool]);
        assert!(!sink.options().latch);
    }
}
