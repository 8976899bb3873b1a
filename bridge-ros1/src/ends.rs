//! The ends of actions that a node has, of which there is one each.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};

use tcpros::actionlib::ActionError;
use tokio::sync::Mutex;

/// The clients and servers of actions that are in use, by the names of the actions: a node has one of each. Who takes one up
/// again while its predecessor is about to go has the same.
#[derive(Debug, Default)]
pub(crate) struct Ends {
    pub(crate) clients: BTreeMap<String, Known<tcpros::actionlib::ActionClient>>,
    pub(crate) servers: BTreeMap<String, Known<Server>>,
}

/// A server that one after another waits for.
pub(crate) type Server = Mutex<tcpros::actionlib::ActionServer>;

/// An end of an action whose messages have that checksum.
#[derive(Debug)]
pub(crate) struct Known<E> {
    md5: String,
    end: Weak<E>,
}

/// The end of an action that is in use, else one that is made.
pub(crate) fn shared<E>(
    known: &mut BTreeMap<String, Known<E>>,
    (action, md5): (&str, &str),
    make: impl FnOnce() -> Result<E, ActionError>,
) -> Result<Arc<E>, String> {
    known.retain(|_, known| known.end.strong_count() > 0);
    let in_use = known.get(action).filter(|known| known.md5 == md5);
    if let Some(end) = in_use.and_then(|known| known.end.upgrade()) {
        return Ok(end);
    }
    let end = Arc::new(make().map_err(|error| error.to_string())?);
    let made = Known {
        md5: md5.to_owned(),
        end: Arc::downgrade(&end),
    };
    known.insert(action.to_owned(), made);
    Ok(end)
}
