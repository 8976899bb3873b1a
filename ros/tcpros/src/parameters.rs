//! The parameter server: reads, sets and subscribes to parameters.
//!
//! A subscribed parameter is read again whenever the master reports a change in it. The reported
//! value is not used: it does not distinguish an emptied namespace from a deleted namespace, and
//! two calls of the master may overtake each other.

mod argument;
mod follow;
mod value;

use std::fmt;
use std::sync::Arc;

use thiserror::Error;
use tokio::sync::watch;

use crate::master::{Master, MasterError};
use crate::names::ResourceNameError;
use crate::node::Inner;
use crate::xmlrpc::XmlRpcValue;

pub(crate) use self::argument::value as argument_value;
pub(crate) use self::follow::{ParameterState, Params, settle};
pub use self::value::ParamValue;

/// The parameters of a node's master, with names as the node sees them: `~` and remappings apply,
/// and `/` is the whole tree. The handle may outlive the borrow of the node. It stays usable after
/// the end of the node, except for subscriptions.
///
/// Every call is a request to the master and takes a few seconds at most; all calls fail without
/// a master.
#[derive(Clone)]
pub struct NodeParameters {
    node: Arc<Inner>,
}

impl NodeParameters {
    pub(crate) const fn new(node: Arc<Inner>) -> Self {
        Self { node }
    }

    /// Returns the value of a parameter, or the members of a namespace as a map, or `None` if it is
    /// not set.
    pub async fn get(&self, name: &str) -> Result<Option<ParamValue>, ParamError> {
        let name = self.node.parameter_name(name)?;
        Ok(read(&self.node.master, &name).await?)
    }

    /// Reads a parameter, or a namespace as a map, from the master at `uri` (`http://host:port`)
    /// without registering a node; `None` if it is not set. `name` is its full name. Takes at most
    /// 3 s.
    ///
    /// # Errors
    /// Fails if the URI is invalid, or if the master cannot be reached or violates the API.
    pub async fn of_master(
        uri: &str,
        caller_id: &str,
        name: &str,
    ) -> Result<Option<ParamValue>, MasterError> {
        read(&Master::at(uri, caller_id)?, name).await
    }

    /// Sets a parameter. A map replaces all members of the namespace.
    pub async fn set(&self, name: &str, value: impl Into<ParamValue>) -> Result<(), ParamError> {
        let name = self.node.parameter_name(name)?;
        write(&self.node, &name, value.into()).await?;
        // The master notifies all nodes except the node that made the change.
        self.node.parameter_changed(&name);
        Ok(())
    }

    /// Deletes a parameter, or a namespace with all its members. Returns whether it was set.
    pub async fn delete(&self, name: &str) -> Result<bool, ParamError> {
        let name = self.node.parameter_name(name)?;
        let params = vec![name.as_str().into()];
        match self.node.master.call("deleteParam", params).await {
            Ok(_) => {
                self.node.parameter_changed(&name);
                Ok(true)
            }
            Err(MasterError::Refused { .. }) => Ok(false),
            Err(error) => Err(error.into()),
        }
    }

    /// Returns whether a parameter or namespace is set.
    pub async fn has(&self, name: &str) -> Result<bool, ParamError> {
        let name = self.node.parameter_name(name)?;
        Ok(exists(&self.node, &name).await?)
    }

    /// Searches for the first part of a relative name in the node's own namespace, then in the
    /// parent namespaces. Returns the full name in the namespace that contains the first part, such
    /// as `/line/robot_description` for `robot_description`. A name that is absolute, private or
    /// remapped is checked only at its own location.
    pub async fn search(&self, name: &str) -> Result<Option<String>, ParamError> {
        let asked = self.node.searched_name(name)?;
        match self
            .node
            .master
            .call("searchParam", vec![asked.into()])
            .await
        {
            Ok(found) => {
                let found = found.as_str().map(str::to_owned);
                Ok(Some(found.ok_or(MasterError::Shape("searchParam"))?))
            }
            Err(MasterError::Refused { .. }) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Returns the full names of all parameters of the master.
    pub async fn names(&self) -> Result<Vec<String>, ParamError> {
        let names = self.node.master.call("getParamNames", vec![]).await?;
        Ok(crate::master::strings(&names).ok_or(MasterError::Shape("getParamNames"))?)
    }

    /// Subscribes to a parameter, or to all members of a namespace, across restarts of the master.
    /// The master may start later. Fails only if the name is not a valid ROS name.
    pub fn subscribe(&self, name: &str) -> Result<ParamSubscription, ParamError> {
        let name = self.node.parameter_name(name)?;
        let heard = self.node.params.hold(&name);
        self.node.changed.notify_one();
        Ok(ParamSubscription {
            name,
            heard,
            node: Arc::clone(&self.node),
        })
    }
}

impl fmt::Debug for NodeParameters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let master = self.node.master.uri();
        f.debug_struct("Parameters")
            .field("master", &master)
            .finish_non_exhaustive()
    }
}

/// A subscription to a parameter or namespace. It holds only the newest value: changes that
/// arrive faster than they are read are merged. Dropping it unsubscribes.
pub struct ParamSubscription {
    name: String,
    heard: watch::Receiver<ParameterState>,
    node: Arc<Inner>,
}

impl ParamSubscription {
    /// Returns the resolved name of the parameter.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the last value from the master, or `None` if the parameter is not set or was not
    /// read yet.
    pub fn current(&self) -> Option<ParamValue> {
        match &*self.heard.borrow() {
            ParameterState::Value(value) => value.clone(),
            ParameterState::Nothing => None,
        }
    }

    /// Waits for a value that was not returned before: first the current value at the master, then
    /// each change. `None` means that the parameter is not set. Cancel-safe. Fails with
    /// [`ParamError::NodeEnded`] once the node has ended.
    pub async fn recv(&mut self) -> Result<Option<ParamValue>, ParamError> {
        loop {
            let changed = self.heard.changed().await;
            changed.map_err(|_| ParamError::NodeEnded)?;
            if let ParameterState::Value(value) = &*self.heard.borrow_and_update() {
                return Ok(value.clone());
            }
        }
    }
}

impl fmt::Debug for ParamSubscription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ParamSubscription")
            .field("name", &self.name)
            .field("heard", &self.heard)
            .finish_non_exhaustive()
    }
}

impl Drop for ParamSubscription {
    fn drop(&mut self) {
        self.node.params.release(&self.name);
        self.node.changed.notify_one();
    }
}

/// Error while reading or setting a parameter.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ParamError {
    /// The name is not a valid ROS name.
    #[error(transparent)]
    Name(#[from] ResourceNameError),
    /// An integer that XML-RPC cannot represent. Nothing was sent.
    #[error(
        "{0} does not fit into the 32 bits of a ROS integer: give it as a number with a point, or in quotes as text"
    )]
    IntRange(String),
    /// The master is not reachable or refused the call.
    #[error(transparent)]
    Master(#[from] MasterError),
    /// The node of the subscription has ended.
    #[error("the node has ended, so its parameters are not updated")]
    NodeEnded,
}

/// Reads a parameter from the master by its full name.
async fn read(master: &Master, name: &str) -> Result<Option<ParamValue>, MasterError> {
    match master.call("getParam", vec![name.into()]).await {
        Ok(value) => known("getParam", value).map(Some),
        Err(MasterError::Refused { .. }) => Ok(None),
        Err(error) => Err(error),
    }
}

async fn write(node: &Inner, name: &str, value: ParamValue) -> Result<(), MasterError> {
    let params = vec![name.into(), value.into_wire()];
    node.master.call("setParam", params).await.map(drop)
}

async fn exists(node: &Inner, name: &str) -> Result<bool, MasterError> {
    let answer = node.master.call("hasParam", vec![name.into()]).await?;
    let flag = answer.as_int().ok_or(MasterError::Shape("hasParam"))?;
    Ok(flag != 0)
}

fn known(method: &'static str, value: XmlRpcValue) -> Result<ParamValue, MasterError> {
    ParamValue::from_wire(value).ok_or(MasterError::Shape(method))
}
