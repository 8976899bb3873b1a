//! Selects the topics of a graph to leave out, and the bindings of the others.

use messages::{ArrayRank, Dialect, Leaf, TypeName, TypeRegistry};
use uadp::BuiltinType;

/// The reason why a topic is left out; its text is the heading of a list of topics.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum OmittedTopic {
    Log,
    Time,
    Transforms,
    Action,
    Configuration,
    Hidden,
    InSpace,
    Untyped,
}

impl OmittedTopic {
    pub(super) const fn heading(self) -> &'static str {
        match self {
            Self::Log => "log, parameters and life cycle of nodes",
            Self::Time => "simulated time, which each ROS side has of its own",
            Self::Transforms => "transforms (with --tf they are not left out)",
            Self::Action => "what actions are made of",
            Self::Configuration => "dynamic_reconfigure and bonds of nodelets",
            Self::Hidden => "hidden, by an underscore",
            Self::InSpace => "names of the space, which cross without a mapping",
            Self::Untyped => "its type is not known, or differs",
        }
    }

    /// Returns the reason to leave out the topic, by its name and type.
    pub(super) fn of(topic: &str, kind: Option<&TypeName>, transforms: bool) -> Option<Self> {
        let parts: Vec<&str> = topic.trim_start_matches('/').split('/').collect();
        let last = parts.last().copied().unwrap_or_default();
        if let [one] = parts.as_slice()
            && one.parse::<mappings::TopicId>().is_ok()
        {
            return Some(Self::InSpace);
        }
        if parts.contains(&"_action") {
            return Some(Self::Action);
        }
        if parts.iter().any(|part| part.starts_with('_')) {
            return Some(Self::Hidden);
        }
        match topic {
            "/rosout" | "/rosout_agg" | "/statistics" | "/parameter_events" => {
                return Some(Self::Log);
            }
            "/clock" => return Some(Self::Time),
            "/tf" | "/tf_static" if transforms => return None,
            "/tf" | "/tf_static" => return Some(Self::Transforms),
            _ => {}
        }
        let kind = kind?;
        match (kind.package(), kind.name()) {
            ("actionlib_msgs" | "action_msgs", _) => Some(Self::Action),
            (_, name) if is_of_action(last, name) => Some(Self::Action),
            ("rcl_interfaces" | "lifecycle_msgs" | "rosgraph_msgs", _) => Some(Self::Log),
            ("dynamic_reconfigure" | "bond", _) => Some(Self::Configuration),
            _ => None,
        }
    }
}

/// Returns true for the goal, feedback and result topics of a ROS 1 action.
fn is_of_action(topic: &str, kind: &str) -> bool {
    [
        ("goal", "ActionGoal"),
        ("feedback", "ActionFeedback"),
        ("result", "ActionResult"),
    ]
    .iter()
    .any(|(name, end)| topic == *name && kind.ends_with(end))
}

/// The part of a message that is the value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum ValueForm {
    /// The path of the only field, and its type; `None` if the type is unknown here.
    Field(String, Option<(BuiltinType, bool)>),
    /// All fields.
    Whole,
    /// The serialized message.
    Bytes,
}

impl ValueForm {
    /// Returns the form in which a message of this type is bound.
    pub(super) fn of(kind: &TypeName, registry: &TypeRegistry) -> Self {
        if BULKY.contains(&kind.as_str()) {
            return Self::Bytes;
        }
        let known = registry.get(kind);
        match known.as_ref().map(|known| known.leaves()) {
            Ok([one]) if one.builtin != BuiltinType::ExtensionObject => {
                Self::Field(one.path.clone(), Some(value_type(one)))
            }
            Ok(_) | Err(_) => Self::Whole,
        }
    }
}

fn value_type(leaf: &Leaf) -> (BuiltinType, bool) {
    (leaf.builtin, matches!(leaf.rank, ArrayRank::Array { .. }))
}

/// Returns the built-in definitions for ROS 1 or ROS 2.
pub(super) fn registry(ros2: bool) -> TypeRegistry {
    TypeRegistry::bundle(if ros2 { Dialect::Ros2 } else { Dialect::Ros1 })
}

/// Types with messages that are not useful field by field.
const BULKY: [&str; 9] = [
    "map_msgs/OccupancyGridUpdate",
    "nav_msgs/OccupancyGrid",
    "sensor_msgs/CompressedImage",
    "sensor_msgs/Image",
    "sensor_msgs/PointCloud",
    "sensor_msgs/PointCloud2",
    "stereo_msgs/DisparityImage",
    "visualization_msgs/MarkerArray",
    "visualization_msgs/InteractiveMarkerUpdate",
];

/// Returns the words of a name in camel case: `/conveyor/is_running` is `ConveyorIsRunning`.
pub(super) fn camel(topic: &str) -> String {
    let words = topic.split(|c: char| !c.is_ascii_alphanumeric());
    let mut name = String::new();
    for word in words {
        let mut letters = word.chars();
        name.extend(letters.next().map(|first| first.to_ascii_uppercase()));
        name.push_str(letters.as_str());
    }
    name
}

/// Normalizes a name for comparisons, without case and punctuation: `Conveyor.Is_Running` is
/// `conveyorisrunning`.
pub(super) fn normal(name: &str) -> String {
    let letters = name.chars().filter(|c| c.is_alphanumeric());
    letters.flat_map(char::to_lowercase).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn left_out(topic: &str, kind: &str) -> Option<OmittedTopic> {
        OmittedTopic::of(topic, Some(&kind.parse().unwrap()), false)
    }

    #[test]
    fn what_ros_is_run_with_is_left_out() {
        for (topic, kind, expected) in [
            ("/rosout", "rosgraph_msgs/Log", OmittedTopic::Log),
            ("/move/goal", "a/MoveActionGoal", OmittedTopic::Action),
            (
                "/move/cancel",
                "actionlib_msgs/GoalID",
                OmittedTopic::Action,
            ),
            (
                "/move/_action/feedback",
                "a/Move_FeedbackMessage",
                OmittedTopic::Action,
            ),
            ("/tf", "tf2_msgs/TFMessage", OmittedTopic::Transforms),
            ("/ua_2_5_10", "std_msgs/Bool", OmittedTopic::InSpace),
            ("/arm/_internal", "std_msgs/Bool", OmittedTopic::Hidden),
            (
                "/cam/parameter_updates",
                "dynamic_reconfigure/Config",
                OmittedTopic::Configuration,
            ),
        ] {
            assert_eq!(left_out(topic, kind), Some(expected), "{topic}");
        }
        assert_eq!(left_out("/goal", "geometry_msgs/PoseStamped"), None);
        assert_eq!(left_out("/joint_states", "sensor_msgs/JointState"), None);
        assert_eq!(OmittedTopic::of("/tf", None, true), None);
    }

    #[test]
    fn names_are_compared_without_their_spelling() {
        assert_eq!(camel("/conveyor/is_running"), "ConveyorIsRunning");
        assert_eq!(
            normal("Conveyor.Is_Running"),
            normal("/conveyor/is_running")
        );
    }
}
