//! The places of running queries.
//!
//! Named questions, updates and plans have places of their own. Any other query starts in a quick
//! place; a query that holds it for too long moves to a long place, or is stopped if there is none.
//! Each client has a share of the long places. The text of a long query is remembered, so that its
//! repetitions do not take quick places.

use std::collections::{BTreeMap, VecDeque};
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::net::IpAddr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::query::QueryFault;

/// The kind of a query, which decides its places.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Lane {
    /// A named question.
    Named,
    /// An update.
    Write,
    /// A plan of a process, which is no query.
    Plan,
    /// Any query of the client with this address.
    Open(IpAddr),
    /// Any query of the users whose names have this hash.
    User(u64),
}

impl Lane {
    fn is_open(self) -> bool {
        matches!(self, Self::Open(_) | Self::User(_))
    }
}

/// The places of a server.
#[derive(Debug)]
pub(crate) struct Lanes {
    named: Arc<Semaphore>,
    write: Arc<Semaphore>,
    plan: Arc<Semaphore>,
    quick: Arc<Semaphore>,
    /// Number of queries that wait for a quick place.
    waiting: AtomicUsize,
    /// Maximum number of long queries.
    long: usize,
    seats: Mutex<Seats>,
}

#[derive(Debug, Default)]
struct Seats {
    /// The running queries, in the order of their starts.
    taken: BTreeMap<u64, Taken>,
    next: u64,
    /// Memory of the program before the first of the running queries.
    memory: Option<u64>,
    /// Hashes of the texts of long queries.
    slow: VecDeque<u64>,
}

#[derive(Debug)]
struct Taken {
    lane: Lane,
    text: u64,
    is_long: bool,
    is_stopped: bool,
    /// The place in the lane of named or quick queries.
    place: Option<OwnedSemaphorePermit>,
}

/// A running query. Dropping it frees the place.
#[derive(Debug)]
pub(crate) struct Seat {
    lanes: Arc<Lanes>,
    number: u64,
}

impl Lanes {
    /// Creates places for `long` long queries, and as many named and quick queries.
    pub(crate) fn new(long: usize) -> Arc<Self> {
        Arc::new(Self {
            named: Arc::new(Semaphore::new(long.max(QUICK_PLACES))),
            write: Arc::new(Semaphore::new(WRITE_PLACES)),
            plan: Arc::new(Semaphore::new(PLAN_PLACES)),
            quick: Arc::new(Semaphore::new(QUICK_PLACES)),
            waiting: AtomicUsize::new(0),
            long,
            seats: Mutex::default(),
        })
    }

    /// Waits for a place of a query. `memory` is the memory of the program.
    ///
    /// # Errors
    /// [`QueryFault::Busy`] if there is none within [`WAIT`].
    pub(crate) async fn enter(
        self: &Arc<Self>,
        lane: Lane,
        text: &str,
        memory: Option<u64>,
    ) -> Result<Seat, QueryFault> {
        let mut hasher = DefaultHasher::new();
        text.hash(&mut hasher);
        let text = hasher.finish();
        let is_slow = lane.is_open() && self.seats().slow.contains(&text);
        if is_slow {
            let mut seats = self.seats();
            if !seats.has_long(lane, self.long) {
                return Err(QueryFault::Busy(self.long));
            }
            return Ok(self.seat(&mut seats, (lane, text, true), None, memory));
        }
        let places = match lane {
            Lane::Named => &self.named,
            Lane::Write => &self.write,
            Lane::Plan => &self.plan,
            Lane::Open(_) | Lane::User(_) => &self.quick,
        };
        let waits = Waits::new(&self.waiting, lane);
        let place = tokio::time::timeout(WAIT, Arc::clone(places).acquire_owned()).await;
        drop(waits);
        let Ok(Ok(place)) = place else {
            return Err(QueryFault::Busy(self.long));
        };
        let mut seats = self.seats();
        Ok(self.seat(&mut seats, (lane, text, false), Some(place), memory))
    }

    fn seat(
        self: &Arc<Self>,
        seats: &mut Seats,
        (lane, text, is_long): (Lane, u64, bool),
        place: Option<OwnedSemaphorePermit>,
        memory: Option<u64>,
    ) -> Seat {
        if seats.taken.is_empty() {
            seats.memory = memory;
        }
        let number = seats.next;
        seats.next += 1;
        let taken = Taken {
            lane,
            text,
            is_long,
            is_stopped: false,
            place,
        };
        seats.taken.insert(number, taken);
        Seat {
            lanes: Arc::clone(self),
            number,
        }
    }

    fn seats(&self) -> MutexGuard<'_, Seats> {
        self.seats.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the number of running threads.
    #[cfg(test)]
    pub(crate) fn running(&self) -> usize {
        self.seats().taken.len()
    }

    /// Returns a handle for the observer of a query.
    pub(crate) fn watch(self: &Arc<Self>, seat: &Seat) -> QueryObserver {
        QueryObserver {
            lanes: Arc::clone(self),
            number: seat.number,
        }
    }
}

impl Seats {
    /// Returns whether a client can take a long place: one is free, and the client holds less than
    /// its share, which is half of them.
    fn has_long(&self, lane: Lane, most: usize) -> bool {
        let long = |taken: &&Taken| taken.is_long;
        let of_client = self.taken.values().filter(long);
        let of_client = of_client.filter(|taken| taken.lane == lane).count();
        self.taken.values().filter(long).count() < most && of_client < most.div_ceil(2)
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        self.lanes.seats().taken.remove(&self.number);
    }
}

/// The observer of a running query.
#[derive(Debug)]
pub(crate) struct QueryObserver {
    lanes: Arc<Lanes>,
    number: u64,
}

impl QueryObserver {
    /// Moves a query that runs for `since` to a long place when its time in the quick place is
    /// over, which is earlier while other queries wait.
    ///
    /// # Errors
    /// [`QueryFault::Busy`] if there is no long place.
    pub(crate) fn lengthen(&self, since: Duration) -> Result<(), QueryFault> {
        let is_awaited = self.lanes.waiting.load(Ordering::Relaxed) > 0;
        if since < (if is_awaited { QUICK_AWAITED } else { QUICK }) {
            return Ok(());
        }
        let mut seats = self.lanes.seats();
        let has_long = |seats: &Seats, lane| seats.has_long(lane, self.lanes.long);
        let (lane, text) = match seats.taken.get(&self.number) {
            Some(taken) if !taken.is_long && taken.lane.is_open() => (taken.lane, taken.text),
            _ => return Ok(()),
        };
        if !seats.slow.contains(&text) {
            seats.slow.push_back(text);
            if seats.slow.len() > SLOW_TEXTS {
                seats.slow.pop_front();
            }
        }
        if !has_long(&seats, lane) {
            return Err(QueryFault::Busy(self.lanes.long));
        }
        if let Some(taken) = seats.taken.get_mut(&self.number) {
            taken.is_long = true;
            drop(taken.place.take());
        }
        Ok(())
    }

    /// Returns whether this query has to stop because the program has grown by more than `most`
    /// bytes. The oldest query stops first; the next stops only when the memory of the first does
    /// not suffice.
    pub(crate) fn exceeds(&self, now: Option<u64>, most: u64) -> bool {
        let seats = self.lanes.seats();
        let (Some(before), Some(now)) = (seats.memory, now) else {
            return false;
        };
        let grown = now.saturating_sub(before);
        let open = || {
            let all = seats.taken.iter();
            all.filter(|(_, taken)| taken.lane.is_open())
        };
        let is_oldest = open()
            .find(|(_, taken)| !taken.is_stopped)
            .is_some_and(|(number, _)| *number == self.number);
        let is_freeing = open().any(|(_, taken)| taken.is_stopped);
        let most = if is_freeing {
            most.saturating_add(most / 2)
        } else {
            most
        };
        grown > most && is_oldest
    }

    /// Marks the query as stopped: its place is free when its thread has ended.
    pub(crate) fn stopped(&self) {
        if let Some(taken) = self.lanes.seats().taken.get_mut(&self.number) {
            taken.is_stopped = true;
        }
    }

    /// Forgets that the text of the query was long, if it ended `since` its start in the time of a
    /// quick query.
    pub(crate) fn ended(&self, text: &str, since: Duration) {
        if since < QUICK_AWAITED {
            let mut hasher = DefaultHasher::new();
            text.hash(&mut hasher);
            let text = hasher.finish();
            self.lanes.seats().slow.retain(|slow| *slow != text);
        }
    }
}

/// Counts a waiting query.
struct Waits<'a>(Option<&'a AtomicUsize>);

impl<'a> Waits<'a> {
    fn new(count: &'a AtomicUsize, lane: Lane) -> Self {
        let count = lane.is_open().then_some(count);
        if let Some(count) = count {
            count.fetch_add(1, Ordering::Relaxed);
        }
        Self(count)
    }
}

impl Drop for Waits<'_> {
    fn drop(&mut self) {
        if let Some(count) = self.0 {
            count.fetch_sub(1, Ordering::Relaxed);
        }
    }
}

const QUICK_PLACES: usize = 4;
/// Updates are made one after the other.
const WRITE_PLACES: usize = 2;
const PLAN_PLACES: usize = 2;
/// Time after which a query needs a long place.
const QUICK: Duration = Duration::from_millis(250);
/// The same while other queries wait.
const QUICK_AWAITED: Duration = Duration::from_millis(50);
/// Time to wait for a place.
const WAIT: Duration = Duration::from_secs(2);
const SLOW_TEXTS: usize = 256;

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    const ONE: Lane = Lane::Open(IpAddr::V4(Ipv4Addr::LOCALHOST));
    const OTHER: Lane = Lane::Open(IpAddr::V4(Ipv4Addr::new(127, 0, 0, 2)));

    async fn enter(lanes: &Arc<Lanes>, lane: Lane, text: &str) -> (Seat, QueryObserver) {
        let seat = lanes.enter(lane, text, Some(100)).await.unwrap();
        let watch = lanes.watch(&seat);
        (seat, watch)
    }

    #[tokio::test]
    async fn a_client_has_a_share_of_the_long_places() {
        let lanes = Lanes::new(4);
        let mut seats = Vec::new();
        for (lane, text, has_place) in [
            (ONE, "a", true),
            (ONE, "b", true),
            (ONE, "c", false),
            (OTHER, "d", true),
            (OTHER, "e", true),
        ] {
            let (seat, watch) = enter(&lanes, lane, text).await;
            assert_eq!(watch.lengthen(QUICK / 2), Ok(()));
            assert_eq!(watch.lengthen(QUICK).is_ok(), has_place, "{text}");
            seats.extend(has_place.then_some(seat));
        }
        // The repetition of a long query takes no quick place.
        let again = lanes.enter(OTHER, "a", None).await;
        assert_eq!(again.unwrap_err(), QueryFault::Busy(4));
        // A place is free when its query ends.
        seats.remove(0);
        let (seat, watch) = enter(&lanes, ONE, "a").await;
        watch.ended("a", QUICK);
        assert!(lanes.seats().slow.len() == 5);
        watch.ended("a", QUICK_AWAITED / 2);
        drop(seat);
        let (_seat, watch) = enter(&lanes, ONE, "a").await;
        assert_eq!(watch.lengthen(QUICK_AWAITED), Ok(()));
    }

    #[tokio::test]
    async fn named_questions_have_places_of_their_own() {
        let lanes = Lanes::new(1);
        let mut seats = Vec::new();
        for text in ["a", "b", "c", "d"] {
            seats.push(enter(&lanes, ONE, text).await);
        }
        // A quick place ends earlier while another query waits for it.
        let waits = tokio::spawn({
            let lanes = Arc::clone(&lanes);
            async move { lanes.enter(OTHER, "e", None).await.is_ok() }
        });
        tokio::task::yield_now().await;
        assert_eq!(seats[0].1.lengthen(QUICK_AWAITED), Ok(()));
        assert!(waits.await.unwrap());
        assert_eq!(
            seats[1].1.lengthen(QUICK),
            Err(QueryFault::Busy(1)),
            "there is one long place"
        );
        let (_named, watch) = enter(&lanes, Lane::Named, "named").await;
        assert_eq!(watch.lengthen(QUICK * 10), Ok(()));
    }

    #[tokio::test]
    async fn the_oldest_query_stops_first_when_memory_is_used() {
        let lanes = Lanes::new(2);
        let (_named, _) = enter(&lanes, Lane::Named, "n").await;
        let (seat, old) = enter(&lanes, ONE, "a").await;
        let (_seat, young) = enter(&lanes, ONE, "b").await;
        assert!(!old.exceeds(Some(150), 50));
        assert!(old.exceeds(Some(151), 50));
        assert!(!young.exceeds(Some(151), 50));
        old.stopped();
        assert!(!young.exceeds(Some(170), 50), "the first frees its memory");
        assert!(young.exceeds(Some(176), 50));
        drop(seat);
        assert!(young.exceeds(Some(151), 50));
    }
}
