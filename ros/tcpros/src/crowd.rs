//! Limits of connections, in total and per address, and the choice of the connection to close.
//!
//! The number of file descriptors of a process is limited. The limits of this module reserve enough
//! descriptors for the node itself, so that idle connections of peers cannot separate the node from
//! its master.

use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::process::{Resource, getrlimit};
use tokio::task::AbortHandle;

/// Connection limits of a listener.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ConnectionLimits {
    pub(crate) total: usize,
    pub(crate) per_address: usize,
}

impl ConnectionLimits {
    const fn shared(total: usize) -> Self {
        Self {
            total,
            per_address: total.div_ceil(2),
        }
    }
}

/// Division of the file descriptors of a process. The rest is for calls to the master, for files,
/// and for all other descriptors of the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Shares {
    /// Subscribers and clients of services.
    pub(crate) subscribers: ConnectionLimits,
    /// Callers of the slave API.
    pub(crate) callers: ConnectionLimits,
    /// Callers of a master in this process, all of which may be on one host.
    pub(crate) nodes: ConnectionLimits,
    /// Publishers that are connected or being connected.
    pub(crate) publishers: usize,
    /// Publishers of a topic that are connected or being connected.
    pub(crate) publishers_of_topic: usize,
}

impl Shares {
    /// Returns the shares for the limit of this process (`RLIMIT_NOFILE`).
    pub(crate) fn of_process() -> Self {
        let limit = getrlimit(Resource::Nofile).current;
        // Without a process limit the limit of the system applies, which is at least the useful
        // maximum.
        Self::of(limit.map_or(usize::MAX, |limit| {
            usize::try_from(limit).unwrap_or(usize::MAX)
        }))
    }

    const fn of(descriptors: usize) -> Self {
        let eighth = descriptors / 8;
        let publishers = at_most(eighth.saturating_mul(3), 8192);
        let nodes = at_most(eighth.saturating_mul(4), 4096);
        Self {
            subscribers: ConnectionLimits::shared(at_most(eighth.saturating_mul(3), 4096)),
            callers: ConnectionLimits::shared(at_most(eighth, 1024)),
            nodes: ConnectionLimits {
                total: nodes,
                per_address: nodes,
            },
            publishers,
            publishers_of_topic: at_most(publishers.div_ceil(2), 1024),
        }
    }
}

/// Limits a number, with a minimum of 1: without descriptors nothing works anyway.
const fn at_most(number: usize, most: usize) -> usize {
    if number == 0 {
        1
    } else if number < most {
        number
    } else {
        most
    }
}

/// The connections of a listener in the order of arrival.
#[derive(Debug)]
pub(crate) struct Crowd {
    places: ConnectionLimits,
    open: Vec<Guest>,
}

#[derive(Debug)]
struct Guest {
    address: IpAddr,
    settled: Settled,
    task: AbortHandle,
}

/// Marks a connection that has completed its handshake or request. A connection without the mark
/// may be closed in favour of another connection.
#[derive(Clone, Debug, Default)]
pub(crate) struct Settled(Arc<AtomicBool>);

impl Settled {
    pub(crate) fn settle(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    fn is_settled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Outcome of a new connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ConnectionAdmission {
    /// The connection is admitted.
    Free,
    /// The connection is admitted; the oldest unsettled connection, which was from this address,
    /// was closed.
    InPlaceOf(IpAddr),
    /// The connection is refused: no other connection may be closed for it, and this is the limit.
    Full(usize),
}

impl Crowd {
    pub(crate) const fn new(places: ConnectionLimits) -> Self {
        Self {
            places,
            open: Vec::new(),
        }
    }

    /// Admits a connection from an address and starts its task, or refuses the connection.
    pub(crate) fn admit(
        &mut self,
        address: IpAddr,
        begin: impl FnOnce(Settled) -> AbortHandle,
    ) -> ConnectionAdmission {
        self.open.retain(|guest| !guest.task.is_finished());
        let from_there = self.open.iter().filter(|g| g.address == address).count();
        let has_share = from_there >= self.places.per_address;
        let mut admission = ConnectionAdmission::Free;
        if has_share || self.open.len() >= self.places.total {
            let gives_way = |guest: &Guest| {
                !guest.settled.is_settled() && (!has_share || guest.address == address)
            };
            let Some(at) = self.open.iter().position(gives_way) else {
                return ConnectionAdmission::Full(if has_share {
                    self.places.per_address
                } else {
                    self.places.total
                });
            };
            let guest = self.open.remove(at);
            guest.task.abort();
            admission = ConnectionAdmission::InPlaceOf(guest.address);
        }
        let settled = Settled::default();
        let task = begin(settled.clone());
        self.open.push(Guest {
            address,
            settled,
            task,
        });
        admission
    }
}

#[cfg(test)]
mod tests {
    use std::future::pending;

    use tokio::task::JoinSet;

    use super::*;

    const A: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(10, 0, 0, 1));
    const B: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(10, 0, 0, 2));

    #[test]
    fn what_peers_can_take_leaves_descriptors_for_the_node() {
        for limit in [64, 256, 1024, 20_000, 1 << 20] {
            let shares = Shares::of(limit);
            let taken = shares.subscribers.total + shares.callers.total + shares.publishers;
            assert!(taken <= limit - limit / 8, "{shares:?} of {limit}");
            assert!(shares.nodes.total <= limit / 2, "{shares:?} of {limit}");
        }
        let usual = Shares::of(1024);
        assert_eq!((usual.subscribers.total, usual.callers.total), (384, 128));
        let plenty = Shares::of(usize::MAX);
        assert_eq!(
            (plenty.subscribers.total, plenty.callers.total),
            (4096, 1024)
        );
    }

    #[tokio::test]
    async fn the_oldest_that_says_nothing_gives_way_and_others_stay() {
        let mut tasks: JoinSet<()> = JoinSet::new();
        let mut crowd = Crowd::new(ConnectionLimits {
            total: 4,
            per_address: 2,
        });
        let mut come = |address: IpAddr, settles: bool| {
            let mut place = None;
            let admission = crowd.admit(address, |settled| {
                if settles {
                    settled.settle();
                }
                place = Some(settled);
                tasks.spawn(pending())
            });
            (admission, place)
        };
        assert_eq!(come(A, true).0, ConnectionAdmission::Free);
        assert_eq!(come(B, false).0, ConnectionAdmission::Free);
        let (_, silent) = come(A, false);
        // The address has used its share: its own idle connection is closed, not that of another
        // address.
        let (admission, second) = come(A, false);
        assert_eq!(admission, ConnectionAdmission::InPlaceOf(A));
        drop(silent);
        second.unwrap().settle();
        assert_eq!(come(A, false).0, ConnectionAdmission::Full(2));
        assert_eq!(come(B, true).0, ConnectionAdmission::Free);
        // All connections are in use: the remaining idle connection is closed.
        let c = IpAddr::V4(std::net::Ipv4Addr::new(10, 0, 0, 3));
        assert_eq!(come(c, true).0, ConnectionAdmission::InPlaceOf(B));
        assert_eq!(come(c, false).0, ConnectionAdmission::Full(4));
    }

    #[tokio::test]
    async fn a_connection_that_has_ended_leaves_its_place() {
        let mut crowd = Crowd::new(ConnectionLimits {
            total: 1,
            per_address: 1,
        });
        let mut tasks: JoinSet<()> = JoinSet::new();
        let mut come = |tasks: &mut JoinSet<()>| {
            crowd.admit(A, |settled| {
                settled.settle();
                tasks.spawn(async {})
            })
        };
        assert_eq!(come(&mut tasks), ConnectionAdmission::Free);
        assert_eq!(come(&mut tasks), ConnectionAdmission::Full(1));
        tasks.join_next().await.unwrap().unwrap();
        assert_eq!(come(&mut tasks), ConnectionAdmission::Free);
    }
}
