//! The action clients and servers of a node, at most one of each per action.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};

use bridge_node::GraphError;
use tcpros::actionlib::ActionlibError;
use tokio::sync::Mutex;

/// The action clients and servers in use, by action name. A node has at most one of each, so a new
/// user shares the client or server with a user that is about to be dropped.
#[derive(Debug, Default)]
pub(crate) struct Ends {
    pub(crate) clients: BTreeMap<String, ActionEndpoint<tcpros::actionlib::ActionlibClient>>,
    pub(crate) servers: BTreeMap<String, ActionEndpoint<SharedActionServer>>,
}

/// An action server that its users lock in turn.
pub(crate) type SharedActionServer = Mutex<tcpros::actionlib::ActionlibServer>;

/// A client or server of an action with the MD5 sum of its messages.
#[derive(Debug)]
pub(crate) struct ActionEndpoint<E> {
    md5: String,
    end: Weak<E>,
}

/// Returns the client or server of an action that is in use, or makes a new one.
pub(crate) fn shared<E>(
    known: &mut BTreeMap<String, ActionEndpoint<E>>,
    (action, md5): (&str, &str),
    make: impl FnOnce() -> Result<E, ActionlibError>,
) -> Result<Arc<E>, GraphError> {
    known.retain(|_, known| known.end.strong_count() > 0);
    let in_use = known.get(action).filter(|known| known.md5 == md5);
    if let Some(end) = in_use.and_then(|known| known.end.upgrade()) {
        return Ok(end);
    }
    let end = Arc::new(make().map_err(GraphError::library)?);
    let made = ActionEndpoint {
        md5: md5.to_owned(),
        end: Arc::downgrade(&end),
    };
    known.insert(action.to_owned(), made);
    Ok(end)
}
