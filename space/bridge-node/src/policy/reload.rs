//! Going over to another mapping: what both say alike is left as it is.

use std::collections::BTreeMap;
use std::sync::Arc;

use bridge_core::PublisherKey;
use bytes::Bytes;
use mappings::{Lasting, Overflow, TopicId};
use messages::{MessageType, Selection, TypeName};
use uadp::Timestamp;

use super::Policy;
use crate::PortEvent;

/// The topics the mapping reads, by the names the graph has for them: the type each is to have, and
/// the values made of it.
pub type Read = BTreeMap<String, (TypeName, Vec<(TopicId, Selection)>)>;

/// Where the values of a topic of another space go.
#[derive(Debug, Clone, PartialEq)]
pub struct Destination {
    /// The ROS topic as the mapping has it, or the name of the value as a full one: `/ua_0_7_101`.
    pub ros_topic: String,
    /// The type, and what of a message the value is, where the mapping says it.
    pub mapped: Option<(TypeName, Selection)>,
    /// How many values wait.
    pub overflow: Overflow,
    /// Whether subscribers that come late get the last value.
    pub lasting: Lasting,
}

impl Policy {
    /// What the mapping reads. `resolve` makes of a topic of the mapping the name the graph has for
    /// it; a topic it fails at is told of and left out.
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
                    tracing::warn!(topic = %variable.topic, "the value cannot be read: {error}");
                }
            }
        }
        read
    }

    /// Where the values of another space go: to what the mapping ties them to, else to a topic of
    /// their name.
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

    /// The values of other spaces that the mapping ties to topics of our graph.
    pub fn written(&self) -> impl Iterator<Item = TopicId> + use<> {
        let bound = self.mapping.bindings(self.own);
        let written: Vec<TopicId> = bound
            .map(|(variable, _)| variable.topic)
            .filter(|topic| topic.space != self.own)
            .collect();
        written.into_iter()
    }

    /// Whether a value of another space is for a service of our graph, so that it has no topic.
    #[must_use]
    pub fn is_for_service(&self, topic: TopicId) -> bool {
        let variable = self.mapping.variable(topic);
        let service = variable.and_then(|variable| variable.service.as_ref());
        service.is_some_and(|service| service.space == self.own)
    }
}

/// The values that are made of a topic by the mapping that is gone over to: what that says of it,
/// if the type is the one the topic has; else, where it does not name the topic, what was `found`
/// of it.
#[must_use]
pub fn still_made(
    named: Option<&(TypeName, Vec<(TopicId, Selection)>)>,
    has_type: Option<&TypeName>,
    found: impl FnOnce() -> Option<(TopicId, Selection)>,
) -> Vec<(TopicId, Selection)> {
    match named {
        // Another type: everything of it is different.
        Some((wanted, _)) if has_type != Some(wanted) => Vec::new(),
        Some((_, values)) => values.clone(),
        None => found().into_iter().collect(),
    }
}

/// What a port reports of a value that comes to be made of a topic that is read already: what is
/// latched there was sent before and will not be again.
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
    use messages::{Dialect, Registry};

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
        let bool_type = Registry::bundle(Dialect::Ros1).get(&"std_msgs/Bool".parse().unwrap());
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
