//! Which other hosts are out of reach, by the addresses of this host that have lost their link.

use std::net::IpAddr;
use std::sync::Arc;

use tokio::net::TcpStream;
use tokio::sync::watch;

/// The addresses of this host that have no link. Shared by a node and its connections.
#[derive(Clone, Debug)]
pub(crate) struct NetworkReach(watch::Receiver<Arc<[IpAddr]>>);

impl NetworkReach {
    /// Returns the state without lost addresses, and the sender that changes it.
    pub(crate) fn new() -> (watch::Sender<Arc<[IpAddr]>>, Self) {
        let (changes, state) = watch::channel(Arc::default());
        (changes, Self(state))
    }

    /// Returns whether an address has no link.
    pub(crate) fn is_lost(&self) -> bool {
        !self.0.borrow().is_empty()
    }

    /// Returns whether the connections of this address are cut off.
    pub(crate) fn has_lost(&self, address: IpAddr) -> bool {
        self.0.borrow().contains(&address)
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

    /// Waits until a connection is cut off, by its [`left_by`] address. Never returns without an
    /// address, or if the node has ended.
    pub(crate) async fn cut_off(&self, address: Option<IpAddr>) {
        let mut state = self.0.clone();
        if let Some(address) = address
            && state.wait_for(|lost| lost.contains(&address)).await.is_ok()
        {
            return;
        }
        std::future::pending().await
    }
}

/// Returns the address of this host that a connection to another host uses; `None` for a connection
/// within this host.
pub(crate) fn left_by(stream: &TcpStream) -> Option<IpAddr> {
    match (stream.local_addr(), stream.peer_addr()) {
        (Ok(local), Ok(peer)) => {
            let (local, peer) = (local.ip().to_canonical(), peer.ip().to_canonical());
            (local != peer && !peer.is_loopback()).then_some(local)
        }
        // The connection has just failed.
        _ => None,
    }
}
