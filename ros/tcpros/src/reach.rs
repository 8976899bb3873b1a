//! Whether other hosts are within reach.

use tokio::net::TcpStream;
use tokio::sync::watch;

/// Whether other hosts are within reach. Shared by a node and its connections; a new one is within
/// reach.
#[derive(Clone, Debug)]
pub(crate) struct NetworkReach(watch::Receiver<bool>);

impl NetworkReach {
    /// Returns the state, and the sender that changes it.
    pub(crate) fn new() -> (watch::Sender<bool>, Self) {
        let (changes, state) = watch::channel(true);
        (changes, Self(state))
    }

    /// Returns whether other hosts are out of reach.
    pub(crate) fn is_lost(&self) -> bool {
        !*self.0.borrow()
    }

    /// Waits for a change after this call. Never returns if the node has ended.
    pub(crate) fn changed(&self) -> impl Future<Output = ()> + Send + use<> {
        let mut state = self.0.clone();
        state.mark_unchanged();
        async move {
            if state.changed().await.is_err() {
                std::future::pending().await
            }
        }
    }
}

/// Returns whether a connection stays within this host, so that no network is needed.
pub(crate) fn stays_on_host(stream: &TcpStream) -> bool {
    match (stream.local_addr(), stream.peer_addr()) {
        (Ok(local), Ok(peer)) => local.ip() == peer.ip() || peer.ip().is_loopback(),
        // The connection has just failed.
        _ => false,
    }
}
