//! What is known of both levels, and what is told of it.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use discovery::lds::{Added, Gated};
use registry::renamed;
use serde::Serialize;
use tokio::sync::watch;

/// Which level a server is on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Level {
    /// Above the station.
    Above,
    /// Below it.
    Below,
}

/// One server as it is shown in the status.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct Peer {
    /// The name it is shown by, which no other has on its level.
    pub(crate) name: String,
    pub(crate) uri: String,
    /// `waiting`, `refused`, `connected` or `away`.
    pub(crate) state: &'static str,
    /// Why it is not connected or not configured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) fault: Option<String>,
    /// Whether its certificate has been checked.
    pub(crate) secured: bool,
    /// How often its certificate was refused, each attempt to connect counted.
    pub(crate) certificates_refused: u64,
    pub(crate) methods: usize,
    pub(crate) methods_kept_back: usize,
    /// The place it was told.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) place: Option<String>,
}

#[derive(Debug, Default)]
struct State {
    place: Option<String>,
    discovery_above: Option<String>,
    peers: BTreeMap<(Level, String), Peer>,
}

/// Shared by all who tend servers.
#[derive(Debug)]
pub(crate) struct Board {
    /// Our name as a gateway, and where that is on the level below; `None` without a level above.
    gateway: Option<(String, String)>,
    own: Option<Gated>,
    state: Mutex<State>,
    tell: watch::Sender<Added>,
}

impl Board {
    /// `own` is the face below, which is listed as if it had registered.
    pub(crate) fn new(own: Option<Gated>) -> (Self, watch::Receiver<Added>) {
        let (tell, added) = watch::channel(Added::default());
        let gateway = own.as_ref();
        let gateway = gateway.map(|own| (own.application_uri.clone(), own.url.clone()));
        let board = Self {
            gateway,
            own,
            state: Mutex::default(),
            tell,
        };
        board.change(|_| ());
        (board, added)
    }

    fn change<T>(&self, how: impl FnOnce(&mut State) -> T) -> T {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let done = how(&mut state);
        self.tell.send_replace(Added {
            gated: self.gated(&state),
            status: Some(status(&state)),
        });
        done
    }

    fn gated(&self, state: &State) -> Vec<Gated> {
        let above = state.peers.iter().filter(|((level, _), peer)| {
            *level == Level::Above && peer.state == CONNECTED && peer.methods > 0
        });
        let through = self.gateway.iter().flat_map(|(gateway_uri, url)| {
            above.clone().map(|(_, peer)| Gated {
                application_uri: peer.uri.clone(),
                name: peer.name.clone(),
                gateway_uri: gateway_uri.clone(),
                url: url.clone(),
            })
        });
        self.own.iter().cloned().chain(through).collect()
    }

    pub(crate) fn place(&self, place: Option<String>) {
        self.change(|state| state.place = place);
    }

    pub(crate) fn discovery_above(&self, url: Option<String>) {
        self.change(|state| state.discovery_above = url);
    }

    /// Takes a server up under a name that no other of its level has: the wish, or the wish with a number.
    pub(crate) fn enter(&self, level: Level, url: &str, wish: &str) -> String {
        self.change(|state| {
            let taken = |state: &State, name: &str| {
                let mut others = state.peers.iter();
                others.any(|((of, at), peer)| *of == level && at != url && peer.name == name)
            };
            let mut name = wish.to_owned();
            while taken(state, &name) {
                name = renamed(&name);
            }
            let peer = state.peers.entry((level, url.to_owned())).or_default();
            peer.name.clone_from(&name);
            name
        })
    }

    /// Notes something about a server that is there.
    pub(crate) fn note(&self, level: Level, url: &str, how: impl FnOnce(&mut Peer)) {
        self.change(|state| {
            if let Some(peer) = state.peers.get_mut(&(level, url.to_owned())) {
                how(peer);
            }
        });
    }

    /// A server is gone. Gives its name.
    pub(crate) fn leave(&self, level: Level, url: &str) -> Option<String> {
        let gone = self.change(|state| state.peers.remove(&(level, url.to_owned())));
        gone.map(|peer| peer.name)
    }
}

fn status(state: &State) -> serde_json::Value {
    let of = |level: Level| {
        let peers = state.peers.iter().filter(|((at, _), _)| *at == level);
        let peers = peers.map(|((_, url), peer)| serde_json::json!({"url": url, "server": peer}));
        peers.collect::<Vec<_>>()
    };
    serde_json::json!({
        "place": state.place,
        "discovery_above": state.discovery_above,
        "above": of(Level::Above),
        "below": of(Level::Below),
    })
}

pub(crate) const CONNECTED: &str = "connected";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_servers_of_one_name_are_told_apart_and_neighbours_are_listed_through_the_station() {
        let own = Gated {
            application_uri: "urn:a".to_owned(),
            name: "a".to_owned(),
            gateway_uri: String::new(),
            url: "opc.tcp://10.1.0.1:9".to_owned(),
        };
        let (board, added) = Board::new(Some(own.clone()));
        assert_eq!(board.enter(Level::Above, "u1", "b"), "b");
        assert_eq!(board.enter(Level::Above, "u2", "b"), "b (2)");
        assert_eq!(board.enter(Level::Above, "u2", "b"), "b (2)", "again");
        assert_eq!(board.enter(Level::Below, "u3", "b"), "b", "another level");
        board.note(Level::Above, "u1", |peer| {
            peer.uri = "urn:b".to_owned();
            peer.state = CONNECTED;
            peer.methods = 1;
        });
        let through = Gated {
            application_uri: "urn:b".to_owned(),
            name: "b".to_owned(),
            gateway_uri: "urn:a".to_owned(),
            url: own.url.clone(),
        };
        assert_eq!(added.borrow().gated, [own, through]);
        assert_eq!(board.leave(Level::Above, "u1").as_deref(), Some("b"));
        assert_eq!(added.borrow().gated.len(), 1);
    }
}
