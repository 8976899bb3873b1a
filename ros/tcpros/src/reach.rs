//! Which other hosts are out of reach, by the addresses of this host that have lost their link.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::time::{Instant, sleep, timeout};

/// The addresses of this host that have no link. Shared by a node and its connections.
#[derive(Clone, Debug)]
pub(crate) struct NetworkReach(watch::Receiver<Arc<[IpAddr]>>);

impl NetworkReach {
    /// Returns the state without lost addresses, and the sender that changes it.
    pub(crate) fn new() -> (watch::Sender<Arc<[IpAddr]>>, Self) {
        let (changes, state) = watch::channel(Arc::default());
        (changes, Self(state))
    }

    /// Waits until the link of an address is back. Never returns if the node has ended.
    pub(crate) async fn back(&self, address: IpAddr) {
        let mut state = self.0.clone();
        if state
            .wait_for(|lost| !lost.contains(&address))
            .await
            .is_err()
        {
            std::future::pending().await
        }
    }

    /// Waits until the link of an address was lost and is back, and the host of `peer` responds:
    /// the reset of a connection is sent only once. After [`RESPONDS_WITHIN`] it is not awaited any
    /// longer.
    pub(crate) async fn back_after_loss(&self, address: IpAddr, peer: SocketAddr) {
        self.cut_off(Some(address)).await;
        self.back(address).await;
        let mut until = Instant::now() + RESPONDS_WITHIN;
        while Instant::now() < until {
            if self.has_lost(address) {
                self.back(address).await;
                until = Instant::now() + RESPONDS_WITHIN;
            }
            // Nothing listens at the address of a client: a refusal is the response.
            match timeout(RETRY, TcpStream::connect(peer)).await {
                Ok(Ok(_)) => return,
                Ok(Err(error)) if error.kind() == io::ErrorKind::ConnectionRefused => return,
                Ok(Err(_)) => sleep(RETRY).await,
                Err(_) => {}
            }
        }
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

/// Returns the address from which this host sends to an address.
fn source_towards(peer: IpAddr) -> Option<IpAddr> {
    let any: IpAddr = if peer.is_ipv4() {
        Ipv4Addr::UNSPECIFIED.into()
    } else {
        Ipv6Addr::UNSPECIFIED.into()
    };
    let socket = UdpSocket::bind((any, 0)).ok()?;
    // Sends nothing: the kernel chooses the route.
    socket.connect((peer, 9)).ok()?;
    Some(socket.local_addr().ok()?.ip())
}

/// Returns the address of this host that a connection to another host uses, if it is that of the
/// interface between them; `None` for a connection within this host.
pub(crate) fn left_by(stream: &TcpStream) -> Option<IpAddr> {
    match (stream.local_addr(), stream.peer_addr()) {
        (Ok(local), Ok(peer)) => {
            let (local, peer) = (local.ip().to_canonical(), peer.ip().to_canonical());
            // A peer may have connected to an address of another interface than the one between.
            let is_left_by = || source_towards(peer).is_none_or(|source| source == local);
            (local != peer && !peer.is_loopback() && is_left_by()).then_some(local)
        }
        // The connection has just failed.
        _ => None,
    }
}

/// How long the host of a peer may take to respond after the link is back: a port of a switch
/// forwards nothing for 30 s.
const RESPONDS_WITHIN: Duration = Duration::from_secs(60);
const RETRY: Duration = Duration::from_millis(500);
