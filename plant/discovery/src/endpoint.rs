//! The listener of the discovery server, and its limit of connections.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::task::AbortHandle;
use tracing::debug;

use crate::connection::{ServerShared, count, serve};
use crate::uses::ConnectionUse;

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
        let used = shared.uses.begin();
        let client = (peer, used.clone());
        let task = tokio::spawn(async move { serve(stream, client, &of).await });
        if crowd.admit(peer.ip(), used, task.abort_handle()) {
            count(&shared.counters.refused_connections);
        }
    }
}

/// The open connections. New connections are always admitted. If a limit is reached, the connection
/// is closed that was not used for the longest time; if an address has reached its share, that of
/// this address. A client that only watches this server sends a message each second, so its
/// connection gives way before a connection with a request.
#[derive(Debug, Default)]
struct Crowd(Vec<OpenConnection>);

#[derive(Debug)]
struct OpenConnection {
    address: IpAddr,
    used: ConnectionUse,
    task: AbortHandle,
}

impl Crowd {
    /// Adds a connection. Returns whether another connection was closed.
    fn admit(&mut self, address: IpAddr, used: ConnectionUse, task: AbortHandle) -> bool {
        self.0.retain(|open| !open.task.is_finished());
        let of_address = self.0.iter().filter(|open| open.address == address);
        let has_share = of_address.count() >= MOST_OF_ONE;
        let mut gave_way = false;
        if has_share || self.0.len() >= MOST {
            let open = self.0.iter().enumerate();
            let may_end = open.filter(|(_, open)| !has_share || open.address == address);
            let unused = may_end.min_by_key(|(_, open)| open.used.last());
            if let Some(at) = unused.map(|(at, _)| at) {
                let open = self.0.swap_remove(at);
                let from = open.address;
                debug!(%from, "closed a connection in favour of a new connection");
                open.task.abort();
                gave_way = true;
            }
        }
        self.0.push(OpenConnection {
            address,
            used,
            task,
        });
        gave_way
    }
}

impl Drop for Crowd {
    /// Closes all connections of a discovery server that has ended.
    fn drop(&mut self) {
        for open in &self.0 {
            open.task.abort();
        }
    }
}

const MOST: usize = 128;
const MOST_OF_ONE: usize = 64;
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests {
    use std::future::pending;

    use super::*;
    use crate::uses::UseOrder;

    /// The connections, and the use and the task of each in the order of their start.
    #[derive(Default)]
    struct OpenCrowd {
        crowd: Crowd,
        order: UseOrder,
        opened: Vec<(ConnectionUse, tokio::task::JoinHandle<()>)>,
    }

    impl OpenCrowd {
        /// Opens a connection. Returns whether another connection was closed.
        fn open(&mut self, last: u8) -> bool {
            let used = self.order.begin();
            let task = tokio::spawn(pending());
            let address = IpAddr::from([10, 0, 0, last]);
            let gave_way = self.crowd.admit(address, used.clone(), task.abort_handle());
            self.opened.push((used, task));
            gave_way
        }

        /// Returns the connections that were closed.
        async fn closed(&self) -> Vec<usize> {
            tokio::task::yield_now().await;
            let all = self.opened.iter().enumerate();
            let closed = all.filter(|(_, (_, task))| task.is_finished());
            closed.map(|(at, _)| at).collect()
        }
    }

    #[tokio::test]
    async fn the_unused_connections_of_a_full_address_give_way_in_the_order_of_their_last_use() {
        let mut all = OpenCrowd::default();
        assert!(!all.open(2));
        for _ in 0..MOST_OF_ONE {
            assert!(!all.open(1));
        }
        // The oldest connection of the address has a request, and the next is idle.
        all.order.note(&all.opened[1].0);
        assert!(all.open(1));
        assert!(all.open(1));
        assert_eq!(all.closed().await, [2, 3]);
    }

    #[tokio::test]
    async fn the_unused_connections_of_all_addresses_give_way_when_the_server_is_full() {
        let mut all = OpenCrowd::default();
        let addresses = [1, 2, 3, 4];
        for _ in 0..MOST / addresses.len() {
            for address in addresses {
                assert!(!all.open(address));
            }
        }
        all.order.note(&all.opened[0].0);
        assert!(all.open(5));
        assert_eq!(all.closed().await, [1]);
    }
}
