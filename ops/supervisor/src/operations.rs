//! The users of a program, and the commands that they may send.

use bridge_node::BoxFuture;
use bytes::Bytes;
use mappings::{NodeIdText, TopicId};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// The users and commands of a program with a page.
pub trait Operations: Send + Sync + 'static {
    /// Returns whether the program has users. Without users, sign-in is refused.
    fn has_users(&self) -> bool;

    /// Checks the password of a user, and reports the attempt to the audit.
    fn sign_in(&self, user: String, password: String) -> BoxFuture<bool>;

    /// Returns the roles of a user, as `operator,engineer`; `None` if the user was removed.
    fn roles(&self, user: &str) -> Option<String>;

    /// Returns whether the roles of a user include the operation of machines.
    fn may_operate(&self, user: &str) -> bool;

    /// Returns whether the roles of a user include the sources of the knowledge of the plant.
    fn may_load(&self, user: &str) -> bool;

    /// Sends a request for a call on behalf of a user, and returns the fields of the response.
    fn call(
        &self,
        user: String,
        topic: TopicId,
        request: Bytes,
    ) -> BoxFuture<Result<Bytes, OperationFault>>;

    /// Writes a value of a variable on behalf of a user. `block` has a single field.
    fn write(
        &self,
        user: String,
        node: &NodeIdText,
        block: Bytes,
    ) -> BoxFuture<Result<(), OperationFault>>;

    /// Returns the conditions of the program, at most [`MOST_CONDITIONS`]: first the conditions
    /// that need attention, by falling severity.
    fn conditions(&self) -> Vec<ConditionState>;

    /// Acknowledges or confirms a condition on behalf of a user.
    ///
    /// # Errors
    /// The user may not do it, or the condition does not admit it.
    fn change_condition(&self, user: &str, change: &ConditionChange) -> Result<(), OperationFault>;
}

/// The largest number of conditions on the page.
pub const MOST_CONDITIONS: usize = 500;

/// The state of a condition (OPC 10000-9).
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ConditionState {
    /// The NodeId of the condition.
    pub condition: String,
    /// The id of its last event, in hexadecimal.
    pub event: String,
    /// The name of the condition.
    pub name: String,
    /// From 1 to 1000.
    pub severity: u16,
    /// The level, such as `HighHigh`, `Active` or `Inactive`.
    pub level: &'static str,
    /// Whether the condition is active.
    pub is_active: bool,
    /// Whether the condition is evaluated.
    pub is_enabled: bool,
    /// Whether a user has acknowledged its state.
    pub is_acknowledged: bool,
    /// Whether a user has confirmed the acknowledged state; true if nothing is to be confirmed.
    pub is_confirmed: bool,
    /// The message of the last event.
    pub message: String,
    /// The comment of the last user.
    pub comment: String,
    /// The last user that changed the condition.
    pub user: String,
    /// The time of the last event, in milliseconds since 1970.
    pub since_ms: i64,
}

impl ConditionState {
    /// Returns whether the condition needs the attention of an operator.
    #[must_use]
    pub const fn is_open(&self) -> bool {
        self.is_enabled && (self.is_active || !self.is_acknowledged || !self.is_confirmed)
    }
}

/// A change of a condition by a user.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct ConditionChange {
    /// The NodeId of the condition.
    pub condition: String,
    /// The id of the event that the user has seen, in hexadecimal.
    pub event: String,
    /// The kind of change.
    pub action: ConditionAction,
    /// A comment; empty for no comment.
    #[serde(default)]
    pub comment: String,
}

/// The kind of change of a condition.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ConditionAction {
    /// The user has seen the state.
    Acknowledge,
    /// The user has seen that the acknowledged state was handled.
    Confirm,
}

impl ConditionAction {
    /// Returns the name of the Method of the standard.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Acknowledge => "Acknowledge",
            Self::Confirm => "Confirm",
        }
    }
}

/// The reason why a command has failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OperationFault {
    /// The user has no permission for it.
    Denied,
    /// It was not executed.
    Refused(String),
    /// It was executed and failed.
    Failed(String),
    /// It may have been executed.
    Unknown(String),
}

/// Returns the view of the conditions; null if the program has none, because it is not a server.
pub(crate) fn alarms(conditions: Option<&[ConditionState]>) -> Value {
    let is_open = |one: &&ConditionState| one.is_open();
    let open = conditions.map(|all| all.iter().filter(is_open).count());
    json!({ "conditions": conditions, "open": open })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn alarms_are_counted_while_they_are_open_and_are_null_without_a_server() {
        assert_eq!(alarms(None), json!({ "conditions": null, "open": null }));
        let state = |name: &str, is_acknowledged| ConditionState {
            condition: format!("ns=1;s={name}"),
            event: "00".to_owned(),
            name: name.to_owned(),
            severity: 500,
            level: "Inactive",
            is_active: false,
            is_enabled: true,
            is_acknowledged,
            is_confirmed: true,
            message: String::new(),
            comment: String::new(),
            user: String::new(),
            since_ms: 0,
        };
        let shown = alarms(Some(&[state("Speed", false), state("Guard", true)]));
        assert_eq!(
            (&shown["open"], &shown["conditions"][0]["name"]),
            (&json!(1), &json!("Speed"))
        );
    }
}
