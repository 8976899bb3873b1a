//! An action as calls and values of the space: the same fields for the actions of ROS 1 and ROS 2.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::definition::MessageDefinition;
use crate::resolve::TypeResolver;
use crate::service::{ServiceDefinition, derived};
use crate::{DefinitionError, Dialect, MessageType, ServiceType, TypeName};

/// The calls and the two values of an action in the space, built from its goal, result and
/// feedback.
///
/// The first 16 bytes identify a goal. A goal or feedback of ROS 1 or ROS 2 thus becomes a message
/// of this type when its id is put in front of it. Statuses and return codes are as in
/// `action_msgs/GoalStatus` and `action_msgs/CancelGoal`.
#[derive(Debug)]
pub struct ActionCalls {
    goal: Arc<ServiceType>,
    cancel: Arc<ServiceType>,
    result: Arc<ServiceType>,
    outcome: Arc<ServiceType>,
    feedback: Arc<MessageType>,
    status: Arc<MessageType>,
}

impl ActionCalls {
    pub(crate) fn of(
        (dialect, name): (Dialect, &TypeName),
        definitions: &BTreeMap<TypeName, Arc<MessageDefinition>>,
    ) -> Result<Self, DefinitionError> {
        let x = name.name();
        let time = match dialect {
            Dialect::Ros1 => "time",
            Dialect::Ros2 => "builtin_interfaces/Time",
        };
        let service = |name: &TypeName, text: &str| {
            let service = ServiceDefinition::parse(dialect, name, text)?;
            let own = service.messages();
            let sets = [&own, definitions];
            let mut resolver = TypeResolver::new(dialect, &sets);
            service.resolve(name, &mut resolver).map(Arc::new)
        };
        let message = |suffix, text: &str| {
            let name = derived(name, suffix)?;
            let definition = Arc::new(MessageDefinition::parse(dialect, &name, text)?);
            let own = BTreeMap::from([(name.clone(), definition)]);
            let sets = [&own, definitions];
            let mut resolver = TypeResolver::new(dialect, &sets);
            resolver.message_type(&name, None).map(Arc::new)
        };
        let goal =
            format!("{ID}{x}Goal goal\n---\nbool accepted\n{ID}{time} stamp\nstring message\n");
        let cancel = format!("{ID}{time} stamp\n---\nint8 return_code\nuint8[] goal_ids\n");
        let result = format!("{ID}---\nint8 status\nstring message\n{x}Result result\n");
        let outcome = format!("{ID}---\nint8 status\n{x}Result result\n");
        // The goal first: it is reported as missing if the action is unknown.
        Ok(Self {
            goal: service(name, &goal)?,
            cancel: service(&derived(name, "_CancelCall")?, &cancel)?,
            result: service(&derived(name, "_ResultCall")?, &result)?,
            outcome: service(&derived(name, "_OutcomeCall")?, &outcome)?,
            feedback: message(FEEDBACK, &format!("{ID}{x}Feedback feedback\n"))?,
            status: message(STATUS, "uint8[] goal_ids\nuint8[] statuses\n")?,
        })
    }

    /// Returns whether a type is a value of an action, by its name: no graph has such messages
    /// themselves.
    #[must_use]
    pub fn is_value(name: &TypeName) -> bool {
        [FEEDBACK, STATUS]
            .iter()
            .any(|suffix| name.name().ends_with(suffix))
    }

    /// Returns the call that sends a goal, under the name of the action. Request: `goal_id` (16
    /// bytes; all zero if the executor chooses) and `goal`. Response: `accepted`, `goal_id`,
    /// `stamp` (time of acceptance, by the clock of the executor) and `message`.
    #[must_use]
    pub const fn goal(&self) -> &Arc<ServiceType> {
        &self.goal
    }

    /// Returns the call that cancels goals. Request: `goal_id` (all zero: any) and `stamp` (zero:
    /// any; else goals accepted then or before). Response: `return_code` and `goal_ids`, 16 bytes
    /// of each goal that is being cancelled.
    #[must_use]
    pub const fn cancel(&self) -> &Arc<ServiceType> {
        &self.cancel
    }

    /// Returns the call that waits for a result. Request: `goal_id`. Response: `status`, `message`
    /// (for people) and `result`.
    #[must_use]
    pub const fn result(&self) -> &Arc<ServiceType> {
        &self.result
    }

    /// Returns the call [`result`](Self::result) without the `message`: in ROS 2 the response has
    /// the wire format of `X_GetResult_Response`.
    #[must_use]
    pub const fn outcome(&self) -> &Arc<ServiceType> {
        &self.outcome
    }

    /// Returns the value with the progress of a goal: `goal_id` and `feedback`.
    #[must_use]
    pub const fn feedback(&self) -> &Arc<MessageType> {
        &self.feedback
    }

    /// Returns the value with all goals: `goal_ids`, 16 bytes of each, and `statuses`, one byte of
    /// each.
    #[must_use]
    pub const fn status(&self) -> &Arc<MessageType> {
        &self.status
    }
}

/// Suffixes of the type names of an action's values.
const FEEDBACK: &str = "_FeedbackValue";
const STATUS: &str = "_StatusValue";
/// The field that identifies a goal.
const ID: &str = "uint8[16] goal_id\n";

/// Returns the reason for which a goal was not reached, from the text fields of its result, by
/// their names. A server of ROS 2 has no other field for a reason: `error_msg` of Nav2,
/// `error_string` of ros2_control, `message` of many robots.
#[must_use]
pub fn reason_of<'a>(texts: impl IntoIterator<Item = (&'a str, &'a str)>) -> Option<&'a str> {
    let ranked = texts.into_iter().filter_map(|(name, text)| {
        let name = name.rsplit('.').next().unwrap_or(name);
        let name = name.to_ascii_lowercase();
        let rank = REASONS.iter().position(|known| name.contains(known))?;
        (!text.trim().is_empty()).then_some((rank, text.trim()))
    });
    let best = ranked.min_by_key(|(rank, _)| *rank);
    best.map(|(_, text)| text)
}

/// Parts of the names of fields with a reason, the best first.
const REASONS: [&str; 5] = ["error", "message", "msg", "reason", "text"];

#[cfg(test)]
mod tests {
    use super::reason_of;
    use uadp::BuiltinType;

    use crate::{ActionCalls, Dialect, MessageType, TypeRegistry};

    const COUNT: &str = "int32 order\n---\nint32[] sequence\n---\nint32[] partial\nfloat64 share\n";

    fn leaves(message: &MessageType) -> Vec<(String, BuiltinType)> {
        let leaves = message.leaves().iter();
        leaves
            .map(|leaf| (leaf.path.clone(), leaf.builtin))
            .collect()
    }

    #[test]
    fn an_action_of_either_ros_is_the_same_calls_and_values() {
        let name = "demo_msgs/Count".parse().unwrap();
        let [one, two] = [Dialect::Ros1, Dialect::Ros2].map(|dialect| {
            let mut registry = TypeRegistry::bundle(dialect);
            registry.add_action(&name, COUNT).unwrap();
            let calls = registry.action_calls(&name).unwrap();
            assert_eq!(*calls.goal().name(), name);
            let values = [calls.feedback().name(), calls.status().name(), &name];
            assert_eq!(values.map(ActionCalls::is_value), [true, true, false]);
            [
                leaves(calls.goal().request()),
                leaves(calls.goal().response()),
                leaves(calls.cancel().request()),
                leaves(calls.cancel().response()),
                leaves(calls.result().request()),
                leaves(calls.result().response()),
                leaves(calls.feedback()),
                leaves(calls.status()),
            ]
        });
        assert_eq!(one, two);
        let id = || ("goal_id".to_owned(), BuiltinType::ByteString);
        let leaf = |path: &str, builtin| (path.to_owned(), builtin);
        let [
            goal,
            accepted,
            cancel,
            cancelled,
            ask,
            result,
            feedback,
            status,
        ] = one;
        assert_eq!(goal, [id(), leaf("goal.order", BuiltinType::Int32)]);
        assert_eq!(
            accepted,
            [
                leaf("accepted", BuiltinType::Boolean),
                id(),
                leaf("stamp", BuiltinType::DateTime),
                leaf("message", BuiltinType::String),
            ]
        );
        assert_eq!(cancel, [id(), leaf("stamp", BuiltinType::DateTime)]);
        assert_eq!(
            cancelled,
            [
                leaf("return_code", BuiltinType::SByte),
                leaf("goal_ids", BuiltinType::ByteString),
            ]
        );
        assert_eq!(ask, [id()]);
        assert_eq!(
            result,
            [
                leaf("status", BuiltinType::SByte),
                leaf("message", BuiltinType::String),
                leaf("result.sequence", BuiltinType::Int32),
            ]
        );
        assert_eq!(
            feedback,
            [
                id(),
                leaf("feedback.partial", BuiltinType::Int32),
                leaf("feedback.share", BuiltinType::Double),
            ]
        );
        assert_eq!(
            status,
            [
                leaf("goal_ids", BuiltinType::ByteString),
                leaf("statuses", BuiltinType::ByteString),
            ]
        );
    }

    #[test]
    fn an_action_that_is_not_known_is_named() {
        let registry = TypeRegistry::bundle(Dialect::Ros2);
        let name = "demo_msgs/Count".parse().unwrap();
        let why = registry.action_calls(&name).unwrap_err().to_string();
        assert!(why.contains("demo_msgs/CountGoal"), "{why}");
    }

    #[test]
    fn a_reason_is_the_text_of_a_field_that_is_called_so() {
        let nav2 = [
            ("result.error_msg", "collides with the ground"),
            ("result.frame", "map"),
        ];
        assert_eq!(reason_of(nav2), Some("collides with the ground"));
        let both = [("message", "done"), ("result.ErrorString", " no path ")];
        assert_eq!(reason_of(both), Some("no path"));
        assert_eq!(reason_of([("error_msg", ""), ("name", "arm")]), None);
    }
}
