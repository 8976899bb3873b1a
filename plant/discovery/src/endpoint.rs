//! The listener of the discovery server, and its limit of connections.

use std::collections::VecDeque;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::task::AbortHandle;
use tracing::debug;

use crate::connection::{ServerShared, count, serve};

/// Accepts clients until the future is dropped.
pub(crate) async fn accept(listener: TcpListener, shared: Arc<ServerShared>) {
    let mut crowd = Crowd::default();
    loop {
        let (stream, peer) = match listener.accept().await {
            Ok(accepted) => accepted,
            // The process probably has no free file descriptor; connections may be closed by the
            // next attempt.
            Err(error) => {
                debug!(%error, "cannot accept a connection");
                tokio::time::sleep(ACCEPT_AGAIN).await;
                continue;
            }
        };
        count(&shared.counters.connections);
        if let Err(error) = stream.set_nodelay(true) {
            debug!(%error, %peer, "a connection is slow to respond");
        }
        let of = Arc::clone(&shared);
        let task = tokio::spawn(async move { serve(stream, peer, &of).await });
        if crowd.admit(peer, task.abort_handle()) {
            count(&shared.counters.refused_connections);
        }
    }
}

/// The open connections in the order of their arrival. New connections are always admitted. If a
/// limit is reached, the oldest connection is closed; if an address has reached its share, the
/// oldest connection of this address. A request takes milliseconds, so old connections are idle.
#[derive(Debug, Default)]
struct Crowd(VecDeque<(IpAddr, AbortHandle)>);

impl Crowd {
    /// Adds a connection. Returns whether another connection was closed.
    fn admit(&mut self, peer: SocketAddr, task: AbortHandle) -> bool {
        let address = peer.ip();
        self.0.retain(|(_, task)| !task.is_finished());
        let same = |(from, _): &&(IpAddr, AbortHandle)| *from == address;
        let has_share = self.0.iter().filter(same).count() >= MOST_OF_ONE;
        let mut gave_way = false;
        if has_share || self.0.len() >= MOST {
            let oldest = self
                .0
                .iter()
                .position(|(from, _)| !has_share || *from == address);
            if let Some((from, task)) = oldest.and_then(|at| self.0.remove(at)) {
                debug!(%from, "closed a connection in favour of a new connection");
                task.abort();
                gave_way = true;
            }
        }
        self.0.push_back((address, task));
        gave_way
    }
}

impl Drop for Crowd {
    /// Closes all connections of a discovery server that has ended.
    fn drop(&mut self) {
        for (_, task) in &self.0 {
            task.abort();
        }
    }
}

const MOST: usize = 128;
const MOST_OF_ONE: usize = 64;
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);
