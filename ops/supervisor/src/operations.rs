//! The users of a program, and the commands that they may send.

use bridge_node::BoxFuture;
use bytes::Bytes;
use mappings::{NodeIdText, TopicId};

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
