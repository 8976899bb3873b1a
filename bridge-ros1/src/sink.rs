//! A topic of the graph that we write values of other spaces to.

use std::sync::Arc;

use mappings::{Overflow, TopicId, Variable};
use messages::{MessageType, Selection, TypeName};
use tcpros::{Publisher, PublisherOptions};

/// Where the values of one topic of another space go.
#[derive(Debug)]
pub(crate) struct Sink {
    pub(crate) ros_topic: String,
    /// What the mapping ties it to; it decides alone.
    pub(crate) mapped: Option<(TypeName, Selection)>,
    /// The std_msgs type of the value the Router holds, if it is one value and there is such a type.
    pub(crate) standard: Option<TypeName>,
    /// The topic as it is written.
    pub(crate) open: Option<Open>,
    latch: bool,
}

/// A publisher and its type.
#[derive(Debug)]
pub(crate) struct Open {
    pub(crate) message_type: Arc<MessageType>,
    pub(crate) publisher: Publisher,
    /// Losses of slow subscribers that were reported.
    pub(crate) reported: u64,
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
            standard: None,
            open: None,
            latch,
        }
    }

    /// The types it could have, best first: the mapping's; what subscribers ask for; the standard type of the value.
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

    pub(crate) fn selection(&self) -> Selection {
        self.mapped
            .as_ref()
            .map_or(Selection::Whole, |(_, selection)| selection.clone())
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
