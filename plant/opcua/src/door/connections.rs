//! The open connections of a door, and the selection of the connection that a new connection
//! replaces.

use std::collections::{BTreeMap, HashMap};
use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use tokio::task::AbortHandle;

/// An open connection.
#[derive(Debug)]
struct Connection {
    address: IpAddr,
    /// Whether the client presented a trusted certificate.
    admitted: Arc<AtomicBool>,
    task: AbortHandle,
}

/// Open connections by number, oldest first.
#[derive(Debug)]
pub(super) struct Connections {
    open: BTreeMap<u64, Connection>,
    next: u64,
    most: usize,
    /// Maximum number of connections per address; 0 for no limit.
    most_per_address: usize,
}

impl Connections {
    pub(super) const fn new(most: usize, most_per_address: usize) -> Self {
        Self {
            open: BTreeMap::new(),
            next: 0,
            most,
            most_per_address,
        }
    }

    /// Returns the number of the next connection.
    pub(super) const fn next(&mut self) -> u64 {
        self.next += 1;
        self.next
    }

    /// Adds an open connection.
    pub(super) fn insert(
        &mut self,
        number: u64,
        address: IpAddr,
        (admitted, task): (Arc<AtomicBool>, AbortHandle),
    ) {
        let connection = Connection {
            address,
            admitted,
            task,
        };
        self.open.insert(number, connection);
    }

    /// Removes a closed connection.
    pub(super) fn remove(&mut self, number: u64) {
        self.open.remove(&number);
    }

    /// Makes sure that another connection of an address can be opened. Connections of admitted
    /// clients stay open. Returns `false` if the new connection must be refused.
    pub(super) fn make_room(&mut self, address: IpAddr) -> bool {
        let of_address = self.open.values().filter(|one| one.address == address);
        if self.most_per_address > 0 && of_address.count() >= self.most_per_address {
            return self.give_way(|other| other == address);
        }
        self.open.len() < self.most || self.give_way(|_| true)
    }

    /// Closes the oldest connection of a client that is not admitted, of the address with the most
    /// such connections. Returns `false` if all clients are admitted.
    pub(super) fn give_way(&mut self, may_end: impl Fn(IpAddr) -> bool) -> bool {
        // By address: the number of connections, and the number of the oldest connection.
        let mut others: HashMap<IpAddr, (usize, u64)> = HashMap::new();
        for (number, connection) in &self.open {
            if may_end(connection.address) && !connection.admitted.load(Ordering::Relaxed) {
                others.entry(connection.address).or_insert((0, *number)).0 += 1;
            }
        }
        let oldest = others
            .into_values()
            .max_by_key(|(count, oldest)| (*count, std::cmp::Reverse(*oldest)));
        let Some(connection) = oldest.and_then(|(_, number)| self.open.remove(&number)) else {
            return false;
        };
        connection.task.abort();
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ip(last: u8) -> IpAddr {
        [10, 0, 0, last].into()
    }

    /// Returns open connections of these addresses. The connections with the numbers `admitted` are
    /// admitted.
    fn opened(most: (usize, usize), addresses: &[u8], admitted: &[u64]) -> Connections {
        let mut connections = Connections::new(most.0, most.1);
        for address in addresses {
            let number = connections.next();
            let is_admitted = Arc::new(AtomicBool::new(admitted.contains(&number)));
            let task = tokio::spawn(std::future::pending::<()>()).abort_handle();
            connections.insert(number, ip(*address), (is_admitted, task));
        }
        connections
    }

    fn open(connections: &Connections) -> Vec<u64> {
        connections.open.keys().copied().collect()
    }

    #[tokio::test]
    async fn the_oldest_client_that_is_not_admitted_gives_way() {
        let mut connections = opened((4, 0), &[1, 2, 1, 2], &[1]);
        assert!(connections.make_room(ip(3)));
        // Address 2 had two connections, and address 1 had one connection.
        assert_eq!(open(&connections), [1, 3, 4]);
        assert!(connections.make_room(ip(3)));
        assert_eq!(open(&connections), [1, 3, 4]);
    }

    #[tokio::test]
    async fn admitted_clients_stay() {
        let mut connections = opened((2, 0), &[1, 1], &[1, 2]);
        assert!(!connections.make_room(ip(2)));
        connections.remove(1);
        assert!(connections.make_room(ip(2)));
        assert_eq!(open(&connections), [2]);
    }

    #[tokio::test]
    async fn one_address_takes_its_share_only() {
        let mut connections = opened((10, 2), &[2, 1, 1], &[2]);
        assert!(connections.make_room(ip(1)));
        assert_eq!(open(&connections), [1, 2]);
        let mut connections = opened((10, 2), &[1, 1], &[1, 2]);
        assert!(!connections.make_room(ip(1)));
        assert!(connections.make_room(ip(2)));
    }
}
