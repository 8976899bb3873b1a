//! Classifies the topics of a graph that the mapping does not name.

use mappings::{PatternFault, PatternVariable, TopicId};
use messages::TypeName;

use super::Policy;

/// The meaning in the space of a topic that the mapping does not name.
#[derive(Debug, Clone, PartialEq)]
pub enum TopicMeaning {
    /// The name of the topic is a value of the own space. The value is the
    /// whole message, of any type.
    Named(TopicId),
    /// The name of the topic is a value of the own space that the mapping ties to something else.
    Tied(TopicId),
    /// A pattern makes a value of the topic.
    Made(PatternVariable),
    /// A pattern matches the topic, but cannot make a value of it.
    Fault(PatternFault),
    /// Not a value.
    Nothing,
}

impl Policy {
    /// Classifies a topic by its full name (`/ua_1_5_3`, `/turtle1/pose`) and its type, if that is
    /// known.
    #[must_use]
    pub fn found(&self, ros_topic: &str, typed: Option<&TypeName>) -> TopicMeaning {
        let name = ros_topic.strip_prefix('/').unwrap_or_default();
        match name.parse::<TopicId>() {
            Ok(topic) if topic.space != self.own => TopicMeaning::Nothing,
            Ok(topic) if self.is_tied(topic) => TopicMeaning::Tied(topic),
            Ok(topic) => TopicMeaning::Named(topic),
            Err(_) => match self.mapping.matching(self.own, ros_topic, typed) {
                Some(Ok(made)) => TopicMeaning::Made(made),
                Some(Err(fault)) => TopicMeaning::Fault(fault),
                None => TopicMeaning::Nothing,
            },
        }
    }

    /// Returns whether the mapping makes this value of another topic of the graph, or of a service.
    fn is_tied(&self, topic: TopicId) -> bool {
        let variable = self.mapping.variable(topic);
        variable.is_some_and(|v| v.binding(self.own).is_some() || v.service.is_some())
    }

    /// Logs once that a topic would become a value that another topic already is.
    pub fn tell_same(&mut self, ros_topic: &str, topic: TopicId, other: &str) {
        self.told.once(ros_topic, "pattern", || {
            format!("ignored this topic: it would be {topic}, which {other} already is")
        });
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use mappings::{Mapping, SpaceId};

    use super::*;

    const CELL: &str = r#"
spaces: [{id: 1}, {id: 2}]
namespaces: {5: urn:a:b}
variables:
  - {node: ns=5;i=11, name: Turn, origin: 1, ros: {space: 1, topic: /turn, type: geometry_msgs/Twist}}
  - {node: ns=5;i=12, name: Named, origin: 1}
patterns:
  - {topics: "/robot/*", origin: 1, node: "ns=5;i=10{1}", name: "Robot{1}", type: std_msgs/Float64}
"#;

    fn found(ros_topic: &str, typed: Option<&str>) -> TopicMeaning {
        let mapping = Mapping::from_yaml(CELL, "cell.yaml");
        let policy = Policy::new(SpaceId::ROS1, Arc::new(mapping.mapping.unwrap()));
        policy.found(ros_topic, typed.map(|name| name.parse().unwrap()).as_ref())
    }

    #[test]
    fn a_topic_with_the_name_of_a_value_of_ours_is_that_value() {
        let topic = |text: &str| text.parse::<TopicId>().unwrap();
        assert_eq!(
            found("/ua_1_9_9", None),
            TopicMeaning::Named(topic("ua_1_9_9"))
        );
        // The mapping declares the value without a source.
        assert_eq!(
            found("/ua_1_5_12", None),
            TopicMeaning::Named(topic("ua_1_5_12"))
        );
        assert_eq!(
            found("/ua_1_5_11", None),
            TopicMeaning::Tied(topic("ua_1_5_11"))
        );
        assert_eq!(found("/ua_2_9_9", None), TopicMeaning::Nothing);
        assert_eq!(found("/other", None), TopicMeaning::Nothing);
    }

    #[test]
    fn a_pattern_makes_values_of_topics_of_its_type() {
        let TopicMeaning::Made(made) = found("/robot/7", Some("std_msgs/Float64")) else {
            panic!("the pattern is about it");
        };
        assert_eq!(made.node.to_string(), "ns=5;i=107");
        assert_eq!(
            found("/robot/7", Some("std_msgs/String")),
            TopicMeaning::Nothing
        );
        assert_eq!(
            found("/turn", None),
            TopicMeaning::Nothing,
            "it has a variable"
        );
    }
}
