//! Adoption of another mapping: entries that are the same in both mappings stay undisturbed.

use std::collections::BTreeMap;
use std::sync::Arc;

use bridge_core::PublisherKey;
use bytes::Bytes;
use mappings::{Lasting, Overflow, TopicId};
use messages::{MessageType, Selection, TypeName};
use uadp::Timestamp;

use super::Policy;
use crate::PortEvent;

/// The topics that the mapping reads, by their names in the graph: the required type of each, and
/// the values made of it.
pub type Read = BTreeMap<String, (TypeName, Vec<(TopicId, Selection)>)>;

/// The destination of the values of a topic of another space.
#[derive(Debug, Clone, PartialEq)]
pub struct Destination {
    /// The ROS topic in the mapping, or the name of the value with a leading slash: `/ua_0_7_101`.
    pub ros_topic: String,
    /// The type and the selection of a message, if the mapping sets them.
    pub mapped: Option<(TypeName, Selection)>,
    /// The queue limit of the values.
    pub overflow: Overflow,
    /// Whether late subscribers receive the last value.
    pub lasting: Lasting,
}

impl Policy {
    /// Returns the topics that the mapping reads. `resolve` converts a topic of the mapping to its
    /// name in the graph; a topic that cannot be resolved is logged and omitted.
    pub fn read<E: std::fmt::Display>(&self, resolve: impl Fn(&str) -> Result<String, E>) -> Read {
        let mut read = Read::new();
        for (variable, binding) in self.mapping.bindings(self.own) {
            if variable.topic.space != self.own {
                continue;
            }
            match resolve(&binding.ros_topic) {
                Ok(ros_topic) => {
                    let (_, values) = read
                        .entry(ros_topic)
                        .or_insert_with(|| (binding.message_type.clone(), Vec::new()));
                    values.push((variable.topic, binding.selection.clone()));
                }
                Err(error) => {
                    tracing::warn!(topic = %variable.topic, "cannot read the value: {error}");
                }
            }
        }
        read
    }

    /// Returns the destination of the values of another space: the topic in the mapping, else a
    /// topic with the name of the value.
    #[must_use]
    pub fn destination(&self, topic: TopicId) -> Destination {
        let variable = self.mapping.variable(topic);
        let rules = variable.map(|v| (v.overflow, v.lasting));
        let (overflow, lasting) = rules.unwrap_or_default();
        match variable.and_then(|variable| variable.binding(self.own)) {
            Some(binding) => Destination {
                ros_topic: binding.ros_topic.clone(),
                mapped: Some((binding.message_type.clone(), binding.selection.clone())),
                overflow,
                lasting,
            },
            None => Destination {
                ros_topic: format!("/{topic}"),
                mapped: None,
                overflow,
                lasting,
            },
        }
    }

    /// Returns the values of other spaces that the mapping ties to topics of the graph.
    pub fn written(&self) -> impl Iterator<Item = TopicId> + use<> {
        let bound = self.mapping.bindings(self.own);
        let written: Vec<TopicId> = bound
            .map(|(variable, _)| variable.topic)
            .filter(|topic| topic.space != self.own)
            .collect();
        written.into_iter()
    }

    /// Returns whether a value of another space is for a service of the graph, so that it has no
    /// topic.
    #[must_use]
    pub fn is_for_service(&self, topic: TopicId) -> bool {
        let variable = self.mapping.variable(topic);
        let service = variable.and_then(|variable| variable.service.as_ref());
        service.is_some_and(|service| service.space == self.own)
    }
}

/// Returns the values that the new mapping makes of a topic. These are the values it declares, if
/// the type is the present type of the topic; if the mapping does not name the topic, the value
/// that `found` returns.
#[must_use]
pub fn still_made(
    named: Option<&(TypeName, Vec<(TopicId, Selection)>)>,
    has_type: Option<&TypeName>,
    found: impl FnOnce() -> Option<(TopicId, Selection)>,
) -> Vec<(TopicId, Selection)> {
    match named {
        // With another type, all values are different.
        Some((wanted, _)) if has_type != Some(wanted) => Vec::new(),
        Some((_, values)) => values.clone(),
        None => found().into_iter().collect(),
    }
}

/// Returns the events for a new value of a topic that is read already. Latched messages are
/// included, because their publishers do not send them again.
pub fn taken_up<'l>(
    (topic, selection): (TopicId, Selection),
    message_type: &Arc<MessageType>,
    live: bool,
    latched: impl IntoIterator<Item = (PublisherKey, &'l Bytes)>,
    received: Timestamp,
) -> Vec<PortEvent> {
    let mut events = vec![PortEvent::Bound {
        topic,
        message_type: Arc::clone(message_type),
        selection,
    }];
    if live {
        events.push(PortEvent::Live { topic, live });
    }
    events.extend(latched.into_iter().map(|(key, message)| PortEvent::Sample {
        topic,
        payload: message.clone(),
        received,
        latched_by: Some(key),
    }));
    events
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use mappings::{Mapping, SpaceId};
    use messages::{Dialect, TypeRegistry};

    use super::*;

    const CELL: &str = "
spaces: [{id: 1}, {id: 2}]
namespaces: {5: urn:a:b}
variables:
  - {node: ns=5;i=1, name: X, origin: 1, ros: {space: 1, topic: /target, type: geometry_msgs/Point, field: x}}
  - {node: ns=5;i=2, name: Y, origin: 1, ros: {space: 1, topic: /target, type: geometry_msgs/Point, field: y}}
  - {node: ns=5;i=3, name: Park, origin: 2, queue: {drop_oldest: 3}, ros: {space: 1, topic: /park, type: std_msgs/Bool}}
  - {node: ns=5;i=4, name: Named, origin: 2}
";

    fn policy() -> Policy {
        let mapping = Mapping::from_yaml(CELL, "cell.yaml");
        Policy::new(SpaceId::ROS1, Arc::new(mapping.mapping.unwrap()))
    }

    fn topic(text: &str) -> TopicId {
        text.parse().unwrap()
    }

    #[test]
    fn the_values_of_one_topic_are_read_together() {
        let read = policy().read(|topic| Ok::<_, Infallible>(format!("rt{topic}")));
        let [(name, (message_type, values))] = read.iter().collect::<Vec<_>>()[..] else {
            panic!("{read:?}");
        };
        assert_eq!(
            (name.as_str(), message_type.to_string().as_str()),
            ("rt/target", "geometry_msgs/Point")
        );
        let field = |path: &str| Selection::Field(path.to_owned());
        assert_eq!(
            *values,
            [
                (topic("ua_1_5_1"), field("x")),
                (topic("ua_1_5_2"), field("y"))
            ]
        );
        let left_out = policy().read(|_| Err::<String, _>("a name nobody has"));
        assert_eq!(left_out, Read::new());
    }

    #[test]
    fn values_of_others_go_where_the_mapping_says_else_by_their_name() {
        let policy = policy();
        let tied = policy.destination(topic("ua_2_5_3"));
        assert_eq!(
            (tied.ros_topic.as_str(), tied.mapped.is_some()),
            ("/park", true)
        );
        assert_ne!(tied.overflow, Overflow::KeepLatest);
        for name in ["ua_2_5_4", "ua_2_9_9"] {
            let by_name = policy.destination(topic(name));
            assert_eq!(
                (by_name.ros_topic, by_name.mapped),
                (format!("/{name}"), None)
            );
        }
        assert_eq!(policy.written().collect::<Vec<_>>(), [topic("ua_2_5_3")]);
    }

    #[test]
    fn a_topic_that_changes_its_type_loses_all_its_values() {
        let name: TypeName = "std_msgs/Bool".parse().unwrap();
        let value = |text: &str| (topic(text), Selection::Whole);
        let named = (name.clone(), vec![value("ua_1_5_1")]);
        let found = || Some(value("ua_1_5_2"));
        let other = "std_msgs/String".parse().unwrap();
        assert_eq!(still_made(Some(&named), Some(&other), found), []);
        assert_eq!(still_made(Some(&named), None, found), []);
        assert_eq!(
            still_made(Some(&named), Some(&name), found),
            [value("ua_1_5_1")]
        );
        assert_eq!(still_made(None, Some(&name), found), [value("ua_1_5_2")]);
    }

    #[test]
    fn a_value_that_is_taken_up_hears_what_was_latched_before() {
        let bool_type = TypeRegistry::bundle(Dialect::Ros1).get(&"std_msgs/Bool".parse().unwrap());
        let (message, received) = (Bytes::from_static(b"\x01"), Timestamp::from_unix_nanos(7));
        let latched = [(PublisherKey(3), &message)];
        let value = (topic("ua_1_5_1"), Selection::Whole);
        let events = taken_up(value, &bool_type.unwrap(), true, latched, received);
        assert!(matches!(
            &events[..],
            [
                PortEvent::Bound { .. },
                PortEvent::Live { live: true, .. },
                PortEvent::Sample { payload, latched_by: Some(PublisherKey(3)), .. },
            ] if *payload == message
        ));
    }
}
