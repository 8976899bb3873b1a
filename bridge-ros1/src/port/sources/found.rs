//! Topics of the graph that the mapping does not name. They are subscribed up to a limit, because
//! any node can publish made-up topics.
//!
//! Topics in the mapping are never refused. Other topics that are not published give way to new
//! topics, and refused topics are reported as long as the limit is reached.

use std::collections::HashSet;
use std::ops::Bound;
use std::time::Duration;

use bridge_node::policy::{MAX_TOPICS, TopicMeaning};
use mappings::TopicId;
use messages::{Selection, TypeName};
use tracing::warn;

use super::super::side::Ros1Side;
use super::{Refused, SubscribedTopics};
use crate::source::Ros1Source;

impl SubscribedTopics {
    /// Subscribes to published topics with a name of this space or of a pattern, and removes topics
    /// that are not published. `written_topics` returns the topics to which values of other spaces
    /// are written.
    pub(in crate::port) fn find(
        &mut self,
        side: &mut Ros1Side,
        written_topics: impl Fn(&Ros1Side) -> HashSet<String>,
    ) {
        let mut found = Vec::new();
        let mut written = None;
        self.refused.topics = 0;
        // The search continues after the last added topic, so each topic gets its turn even beyond
        // the limit.
        let after = (Bound::Excluded(self.taken_last.clone()), Bound::Unbounded);
        let before = ..=self.taken_last.clone();
        let publishers = &side.graph.publishers;
        let topics = publishers.range(after).chain(publishers.range(before));
        for (ros_topic, publishers) in topics {
            if self.by_name.contains_key(ros_topic)
                || publishers.iter().all(|name| name == side.node.name())
            {
                continue;
            }
            if ros_topic.len() > MAX_NAME {
                self.refused.topics += 1;
                continue;
            }
            let typed = side.graph.types.get(ros_topic).and_then(|t| t.parse().ok());
            let made = match side.policy.found(ros_topic, typed.as_ref()) {
                TopicMeaning::Named(topic) => Ok((topic, None, Selection::Whole)),
                // Other publishers of topics to which values of other spaces are written do not
                // produce values of this space.
                TopicMeaning::Made(_) | TopicMeaning::Fault(_)
                    if written
                        .get_or_insert_with(|| written_topics(side))
                        .contains(ros_topic) =>
                {
                    continue;
                }
                TopicMeaning::Made(made) => Ok((made.topic, made.message_type, made.selection)),
                TopicMeaning::Fault(fault) => Err(fault.to_string()),
                TopicMeaning::Tied(_) | TopicMeaning::Nothing => continue,
            };
            found.push((ros_topic.clone(), made));
        }
        let mut places = self.places();
        for (ros_topic, made) in found {
            match made {
                Ok(value) => self.add_found(side, ros_topic, value, &mut places),
                Err(fault) => {
                    side.policy.told.once(&ros_topic, "pattern", || fault);
                }
            }
        }
        // Known topics may have lost their subscription.
        for index in 0..self.list.len() {
            self.resubscribe(side, index);
        }
        for source in &mut self.list {
            let published = side.graph.publishers.contains_key(&source.ros_topic);
            let connected = source
                .subscription
                .as_ref()
                .is_some_and(|s| s.publishers() > 0);
            // A restarted master does not list all publishers yet.
            if source.found && !published && !connected && !source.is_live() {
                source.subscription = None;
            }
        }
    }

    /// Subscribes to a topic without a subscription, if another node publishes it.
    fn resubscribe(&mut self, side: &mut Ros1Side, index: usize) {
        let lost = |s: &&Ros1Source| s.subscription.is_none() && !s.values.is_empty();
        let Some(source) = self.list.get(index).filter(lost) else {
            return;
        };
        let publishers = side.graph.publishers.get(&source.ros_topic);
        let others = |names: &Vec<String>| names.iter().any(|name| name != side.node.name());
        if !publishers.is_some_and(others) {
            return;
        }
        let ros_topic = source.ros_topic.clone();
        if let Err(error) = self.subscribe(side, index) {
            side.policy
                .told
                .once(&ros_topic, "not subscribed", || error.to_string());
        }
    }

    /// Returns the room for topics that the mapping does not name.
    fn places(&self) -> Places {
        let found = self.list.iter().filter(|source| source.found);
        let places = self.list.iter().enumerate();
        let silent = places.filter(|(_, source)| source.gives_way());
        Places {
            free: MAX_TOPICS.saturating_sub(found.count()),
            silent: silent.map(|(index, _)| index).collect(),
        }
    }

    /// Adds a topic that the mapping does not name, unless the limit is reached or another topic
    /// already produces the value.
    fn add_found(
        &mut self,
        side: &mut Ros1Side,
        ros_topic: String,
        (topic, expected, selection): (TopicId, Option<TypeName>, Selection),
        places: &mut Places,
    ) {
        if places.free == 0 {
            let Some(silent) = places.silent.pop() else {
                self.refused.topics += 1;
                return;
            };
            self.vacate(side, silent);
            places.free += 1;
        }
        let same = |source: &&Ros1Source| source.values.iter().any(|(other, _)| *other == topic);
        if let Some(other) = self.list.iter().find(same) {
            let other = other.ros_topic.clone();
            side.policy.tell_same(&ros_topic, topic, &other);
            return;
        }
        self.taken_last.clone_from(&ros_topic);
        let index = self.source(ros_topic, expected);
        if let Some(source) = self.list.get_mut(index) {
            source.values.push((topic, selection));
            source.found = true;
            places.free -= 1;
        }
        self.resubscribe(side, index);
    }

    /// Logs refused topics, at first immediately and then every minute.
    pub(in crate::port) fn tell_refused(&mut self) {
        let Refused { topics, told } = self.refused;
        let now = bridge_node::now().monotonic;
        let due = told.is_none_or(|told| now.duration_since(told) >= REFUSED_AGAIN);
        if due && topics > 0 {
            warn!(
                topics,
                limit = MAX_TOPICS,
                "ignored further topics that the mapping does not name: their limit is reached; add the \
                 topics to the mapping to exempt them from the limit"
            );
            self.refused.told = Some(now);
        }
    }
}

/// Room for topics that the mapping does not name.
#[derive(Debug)]
struct Places {
    free: usize,
    /// Sources that give way if there is no free room.
    silent: Vec<usize>,
}

/// Maximum length of the name of such a topic, in bytes.
const MAX_NAME: usize = 512;
/// Interval between two log messages about refused topics.
const REFUSED_AGAIN: Duration = Duration::from_secs(60);

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use bridge_node::Port as _;
    use mappings::{Mapping, SpaceId};
    use tcpros::{MasterGraph, NodeOptions};

    use super::*;
    use crate::port::{Ros1Port, Ros1PortOptions};

    fn port(mapping: &str) -> Ros1Port {
        let mut node = NodeOptions::from_env("n");
        // No server listens at this address.
        "http://127.0.0.1:1".clone_into(&mut node.master_uri);
        node.advertise_as("127.0.0.1");
        let mapping = if mapping.is_empty() {
            Mapping::default()
        } else {
            Mapping::from_yaml(mapping, "cell.yaml").mapping.unwrap()
        };
        Ros1Port::start(Ros1PortOptions {
            node,
            own: SpaceId::ROS1,
            mapping: Arc::new(mapping),
            types: Arc::default(),
            packages: Vec::new(),
        })
        .unwrap()
    }

    /// Returns a graph with this number of published topics of namespace 1, and optionally one
    /// topic of namespace 9.
    fn graph(made_up: usize, honest: bool) -> Option<Arc<MasterGraph>> {
        let made_up = (1..=made_up).map(|id| format!("/ua_1_1_{id}"));
        let topics = made_up.chain(honest.then(|| HONEST.to_owned()));
        let publishers = topics.map(|topic| (topic, vec!["/p".to_owned()]));
        Some(Arc::new(MasterGraph {
            publishers: publishers.collect(),
            ..MasterGraph::default()
        }))
    }

    /// A topic with a single value, which has a standard type.
    const HONEST: &str = "/ua_1_9_9";

    #[tokio::test]
    async fn topics_that_nobody_publishes_any_more_leave_their_place_to_a_new_one() {
        let mut port = port("");
        port.look(graph(5000, false));
        assert_eq!(port.sources.by_name.len(), MAX_TOPICS);
        assert_eq!(port.sources.refused.topics, 5000 - MAX_TOPICS);
        assert!(port.sources.refused.told.is_some(), "the operator is told");
        // The topics leave the graph, and the next comparison detects it.
        port.look(graph(0, true));
        port.look(graph(0, true));
        assert!(port.sources.by_name.contains_key(HONEST));
        assert_eq!(
            (port.sources.list.len(), port.sources.refused.topics),
            (MAX_TOPICS, 0)
        );
    }

    #[tokio::test]
    async fn topics_that_only_the_master_says_are_published_give_way_in_turn() {
        let mut port = port("");
        let mut looks = 0;
        while !port.sources.by_name.contains_key(HONEST) {
            port.look(graph(6000, true));
            assert!(port.sources.by_name.len() <= MAX_TOPICS);
            looks += 1;
            // Each turn takes ten seconds, and 6000 topics take two turns.
            assert!(looks <= 50, "it never has its turn");
        }
        assert_eq!(port.sources.list.len(), MAX_TOPICS);
    }

    const MAPPED: &str = "
spaces: [{id: 1}, {id: 2}]
namespaces: {5: urn:a:b}
variables:
  - {node: ns=5;i=11, name: Turn, origin: 1, ros: {space: 1, topic: /turn, type: geometry_msgs/Twist}}
";

    #[tokio::test]
    async fn what_the_mapping_names_has_room_beside_all_the_rest() {
        let mut port = port("");
        port.look(graph(5000, false));
        let mapping = Mapping::from_yaml(MAPPED, "cell.yaml").mapping.unwrap();
        port.reload(&Arc::new(mapping), &Arc::default());
        assert!(port.sources.by_name.contains_key("/turn"));
    }
}
