//! Services and actions: texts of several messages, separated by lines that begin with `---`.

use std::collections::BTreeMap;
use std::sync::Arc;

use md5::{Digest, Md5};

use crate::definition::MessageDefinition;
use crate::idl;
use crate::resolve::{self, TypeResolver};
use crate::{DefinitionError, Dialect, MessageType, TextKind, TypeName};

/// A service type with all types it needs resolved.
#[derive(Debug)]
pub struct ServiceType {
    name: TypeName,
    md5: String,
    request: Arc<MessageType>,
    response: Arc<MessageType>,
}

impl ServiceType {
    /// Returns package and name.
    pub fn name(&self) -> &TypeName {
        &self.name
    }

    /// Returns the 32 hex digits that ROS 1 peers compare, as in gensrv; empty for a ROS 2 type.
    pub fn md5(&self) -> &str {
        &self.md5
    }

    /// Returns whether requests and responses have the same wire format, by their fields and the
    /// fields of all nested messages.
    pub fn is_same(&self, other: &Self) -> bool {
        self.request.is_same(&other.request) && self.response.is_same(&other.response)
    }

    /// Returns the request of a caller, `package/NameRequest`.
    pub fn request(&self) -> &Arc<MessageType> {
        &self.request
    }

    /// Returns the response of the service, `package/NameResponse`.
    pub fn response(&self) -> &Arc<MessageType> {
        &self.response
    }
}

/// The seven messages of an action type, `package/Name` (actionlib, "Detailed Description").
#[derive(Debug)]
pub struct ActionType {
    name: TypeName,
    action: Arc<MessageType>,
    action_goal: Arc<MessageType>,
    action_result: Arc<MessageType>,
    action_feedback: Arc<MessageType>,
    goal: Arc<MessageType>,
    result: Arc<MessageType>,
    feedback: Arc<MessageType>,
}

impl ActionType {
    pub(crate) fn of(
        name: &TypeName,
        get: impl Fn(&TypeName) -> Result<Arc<MessageType>, DefinitionError>,
    ) -> Result<Self, DefinitionError> {
        let part = |suffix| get(&derived(name, suffix)?);
        Ok(Self {
            name: name.clone(),
            action: part("Action")?,
            action_goal: part("ActionGoal")?,
            action_result: part("ActionResult")?,
            action_feedback: part("ActionFeedback")?,
            goal: part("Goal")?,
            result: part("Result")?,
            feedback: part("Feedback")?,
        })
    }

    /// Returns package and name.
    pub fn name(&self) -> &TypeName {
        &self.name
    }

    /// Returns `NameAction`, the three messages below in one. It is never sent; its md5 is the md5
    /// of the action.
    pub fn action(&self) -> &Arc<MessageType> {
        &self.action
    }

    /// Returns `NameActionGoal`, the type of the topic `goal`.
    pub fn action_goal(&self) -> &Arc<MessageType> {
        &self.action_goal
    }

    /// Returns `NameActionResult`, the type of the topic `result`.
    pub fn action_result(&self) -> &Arc<MessageType> {
        &self.action_result
    }

    /// Returns `NameActionFeedback`, the type of the topic `feedback`.
    pub fn action_feedback(&self) -> &Arc<MessageType> {
        &self.action_feedback
    }

    /// Returns `NameGoal`, the first part of the text.
    pub fn goal(&self) -> &Arc<MessageType> {
        &self.goal
    }

    /// Returns `NameResult`, the second part.
    pub fn result(&self) -> &Arc<MessageType> {
        &self.result
    }

    /// Returns `NameFeedback`, the third part.
    pub fn feedback(&self) -> &Arc<MessageType> {
        &self.feedback
    }
}

/// The messages that are specific to a ROS 2 action, `package/Name` (design.ros2.org, "Actions").
/// Goals and feedback follow the 16 bytes of an id on the wire. A result has a message of its own,
/// because the alignment after its status differs from that of the result alone.
#[derive(Debug)]
pub struct ActionMessages {
    goal: Arc<MessageType>,
    result_response: Arc<MessageType>,
    feedback: Arc<MessageType>,
}

impl ActionMessages {
    pub(crate) fn of(
        name: &TypeName,
        get: impl Fn(&TypeName) -> Result<Arc<MessageType>, DefinitionError>,
    ) -> Result<Self, DefinitionError> {
        let part = |suffix| get(&derived(name, suffix)?);
        Ok(Self {
            goal: part("Goal")?,
            result_response: part(RESULT_RESPONSE)?,
            feedback: part("Feedback")?,
        })
    }

    /// Returns `Name_Goal`, the first part of the text.
    pub fn goal(&self) -> &Arc<MessageType> {
        &self.goal
    }

    /// Returns `Name_GetResult_Response`: the field `status`, of `action_msgs/GoalStatus`, and
    /// below `result` the fields of `Name_Result`, the second part of the text.
    pub fn result_response(&self) -> &Arc<MessageType> {
        &self.result_response
    }

    /// Returns `Name_Feedback`, the third part of the text.
    pub fn feedback(&self) -> &Arc<MessageType> {
        &self.feedback
    }
}

/// The two messages of a `.srv` text.
#[derive(Clone, Debug)]
pub(crate) struct ServiceDefinition {
    request: Arc<MessageDefinition>,
    response: Arc<MessageDefinition>,
}

impl ServiceDefinition {
    pub(crate) fn parse(
        dialect: Dialect,
        name: &TypeName,
        text: &str,
    ) -> Result<Self, DefinitionError> {
        let [request, response] = parts(
            name,
            text,
            "expected one line `---` between request and response",
        )?;
        Ok(Self {
            request: request.parse(dialect, &derived(name, "Request")?)?,
            response: response.parse(dialect, &derived(name, "Response")?)?,
        })
    }

    pub(crate) fn of_idl(name: &TypeName, text: &str) -> Result<Self, DefinitionError> {
        let parts = [
            ("_Request", derived(name, "Request")?),
            ("_Response", derived(name, "Response")?),
        ];
        let [request, response] = idl::definitions(TextKind::Service, name, text, parts)?;
        Ok(Self {
            request: Arc::new(request),
            response: Arc::new(response),
        })
    }

    /// Returns request and response.
    pub(crate) fn parts(&self) -> [&Arc<MessageDefinition>; 2] {
        [&self.request, &self.response]
    }

    pub(crate) fn messages(&self) -> BTreeMap<TypeName, Arc<MessageDefinition>> {
        [&self.request, &self.response]
            .into_iter()
            .map(|definition| (definition.name.clone(), Arc::clone(definition)))
            .collect()
    }

    pub(crate) fn resolve(
        &self,
        name: &TypeName,
        resolver: &mut TypeResolver<'_>,
    ) -> Result<ServiceType, DefinitionError> {
        let request = resolver.message_type(&self.request.name, None)?;
        let response = resolver.message_type(&self.response.name, None)?;
        let md5 = match request.dialect() {
            Dialect::Ros1 => {
                let mut sum = Md5::new();
                sum.update(resolver.md5_text(&self.request.name)?);
                sum.update(resolver.md5_text(&self.response.name)?);
                resolve::hex(&sum.finalize())
            }
            Dialect::Ros2 => String::new(),
        };
        Ok(ServiceType {
            name: name.clone(),
            md5,
            request: Arc::new(request),
            response: Arc::new(response),
        })
    }
}

/// Parses goal, result and feedback of an `.action` text.
pub(crate) fn action_parts(
    dialect: Dialect,
    name: &TypeName,
    text: &str,
) -> Result<[Arc<MessageDefinition>; 3], DefinitionError> {
    let [goal, result, feedback] = parts(name, text, ACTION_PARTS)?;
    Ok([
        goal.parse(dialect, &derived(name, "Goal")?)?,
        result.parse(dialect, &derived(name, "Result")?)?,
        feedback.parse(dialect, &derived(name, "Feedback")?)?,
    ])
}

const RESULT_RESPONSE: &str = "_GetResult_Response";
const ACTION_PARTS: &str = "expected two lines `---` between goal, result and feedback";

/// Returns the messages that genaction creates from an `.action` text, or the messages of rosidl
/// that differ between actions.
pub(crate) fn action(
    dialect: Dialect,
    name: &TypeName,
    text: &str,
) -> Result<Vec<(TypeName, Arc<MessageDefinition>)>, DefinitionError> {
    let goal_result_feedback = action_parts(dialect, name, text)?;
    with_made(dialect, name, goal_result_feedback)
}

/// Returns the messages of a `.idl` text, as [`action`].
pub(crate) fn idl_action(
    name: &TypeName,
    text: &str,
) -> Result<Vec<(TypeName, Arc<MessageDefinition>)>, DefinitionError> {
    let parts = [
        ("_Goal", derived(name, "Goal")?),
        ("_Result", derived(name, "Result")?),
        ("_Feedback", derived(name, "Feedback")?),
    ];
    let found = idl::definitions(TextKind::Action, name, text, parts)?;
    with_made(Dialect::Ros2, name, found.map(Arc::new))
}

/// Returns goal, result and feedback with the messages derived from them.
fn with_made(
    dialect: Dialect,
    name: &TypeName,
    goal_result_feedback: [Arc<MessageDefinition>; 3],
) -> Result<Vec<(TypeName, Arc<MessageDefinition>)>, DefinitionError> {
    let x = name.name();
    let made = match dialect {
        Dialect::Ros1 => wrappers(x),
        Dialect::Ros2 => vec![(RESULT_RESPONSE, format!("int8 status\n{x}Result result\n"))],
    };
    let mut found = goal_result_feedback.to_vec();
    for (suffix, text) in made {
        let part = DefinitionPart { before: 0, text };
        found.push(part.parse(dialect, &derived(name, suffix)?)?);
    }
    let named = found
        .into_iter()
        .map(|definition| (definition.name.clone(), definition));
    Ok(named.collect())
}

/// Returns `XAction` and its parts.
fn wrappers(x: &str) -> Vec<(&'static str, String)> {
    let status =
        |part| format!("std_msgs/Header header\nactionlib_msgs/GoalStatus status\n{x}{part}");
    vec![
        (
            "Action",
            format!(
                "{x}ActionGoal action_goal\n{x}ActionResult action_result\n{x}ActionFeedback action_feedback\n"
            ),
        ),
        (
            "ActionGoal",
            format!("std_msgs/Header header\nactionlib_msgs/GoalID goal_id\n{x}Goal goal\n"),
        ),
        ("ActionResult", status("Result result\n")),
        ("ActionFeedback", status("Feedback feedback\n")),
    ]
}

/// A part of a text, and the number of lines before it.
struct DefinitionPart {
    before: usize,
    text: String,
}

impl DefinitionPart {
    /// Parses the part. An error contains the line number in the whole text.
    fn parse(
        &self,
        dialect: Dialect,
        name: &TypeName,
    ) -> Result<Arc<MessageDefinition>, DefinitionError> {
        match MessageDefinition::parse(dialect, name, &self.text) {
            Ok(definition) => Ok(Arc::new(definition)),
            Err(DefinitionError::Syntax {
                name,
                line,
                reason,
                text,
            }) => Err(DefinitionError::Syntax {
                name,
                line: self.before + line,
                reason,
                text,
            }),
            Err(other) => Err(other),
        }
    }
}

/// Splits a text into `N` parts. As in genmsg and genaction, text after the three dashes belongs to
/// the separator line.
fn parts<const N: usize>(
    name: &TypeName,
    text: &str,
    reason: &'static str,
) -> Result<[DefinitionPart; N], DefinitionError> {
    let mut found = vec![DefinitionPart {
        before: 0,
        text: String::new(),
    }];
    for (number, line) in text.lines().enumerate() {
        if line.starts_with("---") {
            found.push(DefinitionPart {
                before: number + 1,
                text: String::new(),
            });
        } else if let Some(part) = found.last_mut() {
            part.text.push_str(line);
            part.text.push('\n');
        }
    }
    found.try_into().map_err(|_| DefinitionError::Syntax {
        name: name.clone(),
        line: text.lines().count(),
        reason,
        text: String::new(),
    })
}

pub(crate) fn derived(name: &TypeName, suffix: &str) -> Result<TypeName, DefinitionError> {
    TypeName::new(name.package(), &format!("{}{suffix}", name.name())).map_err(|_| {
        DefinitionError::TooBig {
            name: name.clone(),
            what: "names of more than 255 bytes",
        }
    })
}
