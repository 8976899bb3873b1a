//! The state of both levels, for the status pages and the discovery server.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use discovery::lds::{Added, Gated};
use registry::renamed;
use serde::Serialize;
use tokio::sync::watch;

/// The level of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Level {
    /// Above the station.
    Above,
    /// Below the station.
    Below,
}

/// A server in the status.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub(crate) struct StatusPeer {
    /// The displayed name, unique on its level.
    pub(crate) name: String,
    pub(crate) uri: String,
    /// `waiting`, `refused`, `connected`, `busy` or `away`.
    pub(crate) state: &'static str,
    /// The reason why it is not connected or not configured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) fault: Option<String>,
    /// Whether its certificate has been verified.
    pub(crate) secured: bool,
    /// Number of connection attempts at which its certificate was refused.
    pub(crate) certificates_refused: u64,
    pub(crate) methods: usize,
    pub(crate) methods_kept_back: usize,
    pub(crate) variables: usize,
    pub(crate) variables_kept_back: usize,
    /// Number of notifications of values and events that were lost.
    pub(crate) notifications_lost: u64,
    /// The place that it was configured with.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) place: Option<String>,
}

impl StatusPeer {
    /// Returns whether there is a connection to it.
    fn is_there(&self) -> bool {
        self.state == CONNECTED || self.state == BUSY
    }
}

#[derive(Debug, Default)]
struct State {
    /// The face below, which is listed like a registered server; `None` without a level above.
    own: Option<Gated>,
    place: Option<String>,
    discovery_above: Option<String>,
    peers: BTreeMap<(Level, String), StatusPeer>,
}

/// The shared state of both levels.
#[derive(Debug)]
pub(crate) struct Board {
    state: Mutex<State>,
    tell: watch::Sender<Added>,
}

impl Board {
    pub(crate) fn new() -> (Self, watch::Receiver<Added>) {
        let (tell, added) = watch::channel(Added::default());
        let board = Self {
            state: Mutex::default(),
            tell,
        };
        board.change(|_| ());
        (board, added)
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn change<T>(&self, how: impl FnOnce(&mut State) -> T) -> T {
        let mut state = self.lock();
        let done = how(&mut state);
        self.report(&state);
        done
    }

    fn report(&self, state: &State) {
        self.tell.send_replace(Added {
            gated: gated(state),
            status: Some(status(state)),
            not_ready: not_ready(state),
        });
    }

    /// Adds the face below.
    pub(crate) fn own(&self, own: Gated) {
        self.change(|state| state.own = Some(own));
    }

    pub(crate) fn place(&self, place: Option<String>) {
        self.change(|state| state.place = place);
    }

    pub(crate) fn discovery_above(&self, url: Option<String>) {
        self.change(|state| state.discovery_above = url);
    }

    /// Adds a server under a name that is unique on its level: the requested name, or the requested
    /// name with a number.
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

    /// Updates the entry of a server, if it exists. An entry that stays the same is not reported:
    /// each report contains all servers.
    pub(crate) fn note(&self, level: Level, url: &str, how: impl FnOnce(&mut StatusPeer)) {
        let mut state = self.lock();
        let Some(peer) = state.peers.get_mut(&(level, url.to_owned())) else {
            return;
        };
        let before = peer.clone();
        how(peer);
        if *peer != before {
            self.report(&state);
        }
    }

    /// Returns whether a connected server of the level has this ApplicationUri in a verified
    /// certificate.
    pub(crate) fn knows(&self, level: Level, application_uri: &str) -> bool {
        let state = self.lock();
        state.peers.iter().any(|((at, _), peer)| {
            *at == level && peer.is_there() && peer.secured && peer.uri == application_uri
        })
    }

    /// Removes a server. Returns its name.
    pub(crate) fn leave(&self, level: Level, url: &str) -> Option<String> {
        let gone = self.change(|state| state.peers.remove(&(level, url.to_owned())));
        gone.map(|peer| peer.name)
    }
}

/// Returns the servers that are listed beside the registered servers: the face below, and the
/// neighbours that are called through it.
fn gated(state: &State) -> Vec<Gated> {
    let above = state
        .peers
        .iter()
        .filter(|((level, _), peer)| *level == Level::Above && peer.is_there() && peer.methods > 0);
    let through = state.own.iter().flat_map(|own| {
        above.clone().map(|(_, peer)| Gated {
            application_uri: peer.uri.clone(),
            name: peer.name.clone(),
            gateway_uri: own.application_uri.clone(),
            url: own.url.clone(),
        })
    });
    state.own.iter().cloned().chain(through).collect()
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

/// Returns the reasons why the station is not ready: the levels whose servers are all refused, or
/// not connected beside a refused server.
fn not_ready(state: &State) -> Vec<String> {
    let levels = [(Level::Above, "above"), (Level::Below, "below")];
    let reasons = levels.into_iter().filter_map(|(level, name)| {
        let peers = state.peers.iter().filter(|((at, _), _)| *at == level);
        let mut refused = peers.clone().filter(|(_, peer)| peer.state == REFUSED);
        let ((_, url), first) = refused.next()?;
        if peers.clone().any(|(_, peer)| peer.is_there()) {
            return None;
        }
        let (peer, count) = (&first.name, refused.count().saturating_add(1));
        let why = first.fault.as_deref().unwrap_or("no reason is known");
        Some(format!(
            "no server of the level {name} is connected; refused: {count}, the first {peer} ({url}): {why}"
        ))
    });
    reasons.collect()
}

pub(crate) const CONNECTED: &str = "connected";
pub(crate) const REFUSED: &str = "refused";
/// Connected, but not responding: the server is executing a method.
pub(crate) const BUSY: &str = "busy";

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
        let (board, added) = Board::new();
        board.own(own.clone());
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

    #[test]
    fn a_station_whose_servers_are_refused_is_not_ready() {
        let (board, added) = Board::new();
        let not_ready = || added.borrow().not_ready.clone();
        board.enter(Level::Below, "u1", "press");
        board.enter(Level::Below, "u2", "robot");
        assert_eq!(not_ready(), [""; 0], "no server is refused");
        let refuse = |url: &str| {
            board.note(Level::Below, url, |peer| {
                peer.state = REFUSED;
                peer.fault = Some("not trusted".to_owned());
            });
        };
        refuse("u1");
        let one = "no server of the level below is connected; refused: 1, the first press (u1): \
                   not trusted";
        assert_eq!(not_ready(), [one]);
        refuse("u2");
        let two = one.replace("refused: 1", "refused: 2");
        assert_eq!(not_ready(), [two]);
        board.note(Level::Below, "u2", |peer| peer.state = BUSY);
        assert_eq!(not_ready(), [""; 0], "a server is connected");
        board.leave(Level::Below, "u2");
        assert_eq!(not_ready(), [one]);
        board.leave(Level::Below, "u1");
        assert_eq!(not_ready(), [""; 0]);
    }

    #[test]
    fn a_server_that_is_searched_again_without_a_change_is_not_reported() {
        let (board, mut added) = Board::new();
        board.enter(Level::Below, "u1", "a");
        let connected = |peer: &mut StatusPeer| peer.state = CONNECTED;
        board.note(Level::Below, "u1", connected);
        added.mark_unchanged();
        board.note(Level::Below, "u1", connected);
        board.note(Level::Below, "u2", connected);
        assert!(!added.has_changed().unwrap());
        board.note(Level::Below, "u1", |peer| peer.state = BUSY);
        assert!(added.has_changed().unwrap());
    }
}
