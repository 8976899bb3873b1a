//! The parameter server: reading, setting and following parameters.
//!
//! A followed parameter is read anew whenever the master says that something in it changed. What the master says
//! the change is, is not used: it does not tell an emptied namespace from a deleted one, and two of its calls may
//! overtake each other.

mod argument;
mod follow;
mod value;

use std::fmt;
use std::sync::Arc;

use thiserror::Error;
use tokio::sync::watch;

use crate::master::MasterError;
use crate::names::NameError;
use crate::node::Inner;
use crate::xmlrpc::Value;

pub(crate) use self::argument::value as argument_value;
pub(crate) use self::follow::{Heard, Params, settle};
pub use self::value::ParamValue;

/// The parameters of a node's master, with names as the node sees them: `~` and remappings apply, and `/` is the
/// whole tree. It may outlive the borrow of the node, and goes on to work when the node has ended, except for
/// subscriptions.
///
/// Every call is one request to the master and takes a few seconds at most; all fail while there is no master.
#[derive(Clone)]
pub struct Parameters {
    node: Arc<Inner>,
}

impl Parameters {
    pub(crate) const fn new(node: Arc<Inner>) -> Self {
        Self { node }
    }

    /// The value of a parameter, or all that a namespace holds as a map; `None` when it is not set.
    pub async fn get(&self, name: &str) -> Result<Option<ParamValue>, ParamError> {
        let name = self.node.parameter_name(name)?;
        Ok(read(&self.node, &name).await?)
    }

    /// Sets a parameter. A map replaces all that the namespace held.
    pub async fn set(&self, name: &str, value: impl Into<ParamValue>) -> Result<(), ParamError> {
        let name = self.node.parameter_name(name)?;
        write(&self.node, &name, value.into()).await?;
        // The master tells everyone but the node that made the change.
        self.node.parameter_changed(&name);
        Ok(())
    }

    /// Deletes a parameter or a namespace with all it holds. Returns whether it was set.
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

    /// Whether a parameter or namespace is set.
    pub async fn has(&self, name: &str) -> Result<bool, ParamError> {
        let name = self.node.parameter_name(name)?;
        Ok(exists(&self.node, &name).await?)
    }

    /// Looks for the first part of a relative name in the node's own namespace, then in those above it, and gives the
    /// full name where it is found, such as `/line/robot_description` for `robot_description`. A name that is not
    /// relative, or remapped, is looked for where it is.
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

    /// The full names of all parameters of the master.
    pub async fn names(&self) -> Result<Vec<String>, ParamError> {
        let names = self.node.master.call("getParamNames", vec![]).await?;
        Ok(crate::master::strings(&names).ok_or(MasterError::Shape("getParamNames"))?)
    }

    /// Follows a parameter, or all that a namespace holds, through restarts of the master. There need not be a master
    /// yet. Fails only when the name is no ROS name.
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

impl fmt::Debug for Parameters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let master = self.node.master.uri();
        f.debug_struct("Parameters")
            .field("master", &master)
            .finish_non_exhaustive()
    }
}

/// Follows one parameter or namespace. It holds one value, the newest: changes that come faster than they are taken
/// become one. Dropping it unsubscribes.
pub struct ParamSubscription {
    name: String,
    heard: watch::Receiver<Heard>,
    node: Arc<Inner>,
}

impl ParamSubscription {
    /// The parameter's resolved name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The value as last told by the master; `None` when it is not set, or the master has not been asked yet.
    pub fn current(&self) -> Option<ParamValue> {
        match &*self.heard.borrow() {
            Heard::Value(value) => value.clone(),
            Heard::Nothing => None,
        }
    }

    /// Waits for a value that was not returned before: the first time what the master says now, then each change.
    /// `None` says that the parameter is not set. Cancel-safe. Fails with [`ParamError::NodeEnded`] once the node has
    /// ended.
    pub async fn recv(&mut self) -> Result<Option<ParamValue>, ParamError> {
        loop {
            let changed = self.heard.changed().await;
            changed.map_err(|_| ParamError::NodeEnded)?;
            if let Heard::Value(value) = &*self.heard.borrow_and_update() {
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

/// Why a parameter was not read or set.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ParamError {
    /// The name is no ROS name.
    #[error(transparent)]
    Name(#[from] NameError),
    /// An integer that XML-RPC cannot say. Nothing was sent.
    #[error(
        "{0} does not fit into the 32 bits of a ROS integer: give it as a number with a point, or in quotes as text"
    )]
    IntRange(String),
    /// The master is not there or refused.
    #[error(transparent)]
    Master(#[from] MasterError),
    /// The node that held the subscription has ended.
    #[error("the node has ended, and its parameters are no longer followed")]
    NodeEnded,
}

/// Asks the master for a parameter by its full name.
async fn read(node: &Inner, name: &str) -> Result<Option<ParamValue>, MasterError> {
    match node.master.call("getParam", vec![name.into()]).await {
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

fn known(method: &'static str, value: Value) -> Result<ParamValue, MasterError> {
    ParamValue::from_wire(value).ok_or(MasterError::Shape(method))
}
