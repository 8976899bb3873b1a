//! Values of clients on their way out: a Write is answered when its value has been sent, or when it
//! is known that the value is not sent.
//!
//! The value passes from a thread of the server to the run loop, and the result comes back. Both
//! threads poll for a short time before they sleep, because waking a thread takes longer than
//! sending a value.

use std::collections::{HashMap, VecDeque};
use std::sync::LazyLock;
use std::thread::available_parallelism;
use std::time::Duration;

use bridge_node::{BusyPoll, Reason, Unsent, Verdict};
use mappings::TopicId;
use opcua::types::StatusCode;
use tokio::sync::oneshot;
use tokio::sync::oneshot::error::TryRecvError;
use tokio::time::timeout;

/// The result of sending a value, for the client that wrote it.
#[derive(Debug)]
pub(crate) struct Departure {
    /// The written field of the topic, or `None` for all fields.
    field: Option<usize>,
    result: oneshot::Sender<StatusCode>,
}

/// The result of sending a value that is still to come.
#[derive(Debug)]
pub(crate) struct Departing(oneshot::Receiver<StatusCode>);

/// Creates the two ends of a result, for a write of a field or of all fields.
pub(crate) fn departure(field: Option<usize>) -> (Departure, Departing) {
    let (result, pending) = oneshot::channel();
    (Departure { field, result }, Departing(pending))
}

impl Departure {
    /// Answers the Write of a value that is not sent, because another server is active.
    pub(crate) fn refuse(self) {
        self.answer(NOT_ACTIVE);
    }

    fn answer(self, status: StatusCode) {
        // The client may be lost.
        let _gone = self.result.send(status);
    }
}

impl Departing {
    /// Waits until the value has been sent.
    ///
    /// # Errors
    /// Returns `BadInvalidState` if another server is active, `BadRequestCancelledByRequest` if a
    /// newer write replaced the value, `BadCommunicationError` if the value was not sent for
    /// another reason, `BadShutdown` if the server stopped, and `BadTimeout` if the value still
    /// waits. The outcome of the last two is unknown.
    pub(crate) async fn left(mut self) -> Result<(), StatusCode> {
        let result = match self.poll().await {
            Some(result) => result,
            None => match timeout(LONGEST_WAY_OUT, self.0).await {
                Ok(result) => result.map_err(|_| StatusCode::BadShutdown),
                Err(_) => Err(StatusCode::BadTimeout),
            },
        };
        match result? {
            StatusCode::Good => Ok(()),
            status => Err(status),
        }
    }

    /// Polls for the result without sleeping, for [`POLLING`].
    async fn poll(&mut self) -> Option<Result<StatusCode, StatusCode>> {
        if !*SEVERAL_CORES {
            return None;
        }
        let now = || bridge_node::now().monotonic;
        let until = now() + POLLING;
        loop {
            match self.0.try_recv() {
                Ok(status) => return Some(Ok(status)),
                Err(TryRecvError::Closed) => return Some(Err(StatusCode::BadShutdown)),
                Err(TryRecvError::Empty) if now() >= until => return None,
                Err(TryRecvError::Empty) => tokio::task::yield_now().await,
            }
        }
    }
}

/// The writes whose values the run loop has received and not sent yet.
///
/// Each topic has at most as many entries as its queue in the Router has places, and one more for a
/// value that waits because of `at_most`.
#[derive(Debug)]
pub(crate) struct Leaving {
    topics: HashMap<TopicId, TopicWrites>,
    /// The topics in the order of [`drained`](Self::drained). An answered topic stays until its
    /// turn.
    order: VecDeque<TopicId>,
    /// The writes of the reported value that the run loop has not handled. The run loop may send
    /// earlier values first, and their results do not belong to this value.
    reported: Vec<Departure>,
    /// Polls for the next write of a client that waits for each result.
    next: BusyPoll,
}

/// The unsent values of a topic, in the order of the Router. A value that was not written by a
/// client has no departure.
#[derive(Debug, Default)]
struct TopicWrites {
    /// The values in the queue of the Router, from the oldest.
    queued: VecDeque<Vec<Departure>>,
    /// The newest value, if it waits because of `at_most`.
    held: Option<Vec<Departure>>,
}

impl TopicWrites {
    /// Returns the values before a newly reported value, which no client wrote.
    fn behind(unsent: Unsent) -> Self {
        let reported = usize::from(!unsent.is_held);
        let before = unsent.all().saturating_sub(reported);
        Self {
            queued: (0..before).map(|_| Vec::new()).collect(),
            held: None,
        }
    }

    fn is_empty(&self) -> bool {
        self.queued.is_empty() && self.held.is_none()
    }

    /// Adds a value of a newer write. The Router has one held value at most, and has dropped the
    /// oldest values if its queue was full.
    fn add(&mut self, mut departures: Vec<Departure>, unsent: Unsent) {
        replace(self.held.take(), Some(&mut departures));
        if unsent.is_held {
            self.held = Some(departures);
        } else {
            self.queued.push_back(departures);
        }
        // A value that is partly sent is not dropped.
        let oldest = usize::from(unsent.is_sending);
        while self.queued.len() > unsent.all() {
            let dropped = self.queued.remove(oldest);
            replace(dropped, self.queued.get_mut(oldest));
        }
    }

    /// Adds a write that changes nothing. The Router drops the held value for it.
    fn add_unchanged(&mut self, departures: Vec<Departure>) {
        answer(self.held.take(), REPLACED);
        match self.queued.back_mut() {
            Some(last) => last.extend(departures),
            None => answer(Some(departures), StatusCode::Good),
        }
    }

    /// Removes the oldest value that is not in the queue of the Router any more.
    fn next_gone(&mut self, unsent: Unsent) -> Option<Vec<Departure>> {
        if !unsent.is_held {
            self.queued.extend(self.held.take());
        }
        (self.queued.len() > unsent.all())
            .then(|| self.queued.pop_front())
            .flatten()
    }
}

impl Default for Leaving {
    fn default() -> Self {
        let window = if *SEVERAL_CORES {
            POLLING
        } else {
            Duration::ZERO
        };
        Self {
            topics: HashMap::new(),
            order: VecDeque::new(),
            reported: Vec::new(),
            next: BusyPoll::new(window),
        }
    }
}

impl Leaving {
    /// Adds a value that is passed on to the run loop.
    pub(crate) fn add(&mut self, departure: Departure) {
        self.next.arrived(bridge_node::now().monotonic);
        self.reported.push(departure);
    }

    /// Records the verdict of the run loop for the reported value of a topic, or for a value that
    /// no client wrote. Answers the writes whose values are dropped or replaced.
    pub(crate) fn handled(&mut self, topic: TopicId, verdict: Verdict, unsent: Unsent) {
        let departures = std::mem::take(&mut self.reported);
        match verdict {
            Verdict::Drop(Reason::Unchanged) => match self.topics.get_mut(&topic) {
                Some(writes) => writes.add_unchanged(departures),
                // The value was sent before.
                None => answer(Some(departures), StatusCode::Good),
            },
            Verdict::Drop(reason) => answer(Some(departures), status(Err(reason))),
            Verdict::Forward | Verdict::ForwardAfterDroppingOldest => {
                if departures.is_empty() && !self.topics.contains_key(&topic) {
                    return;
                }
                let writes = self.topics.entry(topic).or_insert_with(|| {
                    self.order.push_back(topic);
                    TopicWrites::behind(unsent)
                });
                writes.add(departures, unsent);
            }
        }
    }

    /// Answers the oldest write of a topic, if its value has left the queue of the Router. The
    /// datagram may also be a repetition, or a later chunk of a value.
    pub(crate) fn left(&mut self, topic: TopicId, sent: Result<(), Reason>, unsent: Unsent) {
        let Some(writes) = self.topics.get_mut(&topic) else {
            return;
        };
        answer(writes.next_gone(unsent), status(sent));
        if writes.is_empty() {
            self.topics.remove(&topic);
        }
    }

    /// Answers the writes whose values the Router has dropped, of some topics in turn. If another
    /// server is active, no value is sent.
    pub(crate) fn drained(&mut self, is_muted: bool, unsent: impl Fn(TopicId) -> Unsent) {
        for _ in 0..self.order.len().min(CHECKED_AT_ONCE) {
            let Some(topic) = self.order.pop_front() else {
                return;
            };
            let Some(writes) = self.topics.get_mut(&topic) else {
                continue;
            };
            let (unsent, status) = if is_muted {
                (Unsent::default(), NOT_ACTIVE)
            } else {
                (unsent(topic), StatusCode::BadCommunicationError)
            };
            while let Some(departures) = writes.next_gone(unsent) {
                answer(Some(departures), status);
            }
            if writes.is_empty() {
                self.topics.remove(&topic);
            } else {
                self.order.push_back(topic);
            }
        }
    }

    /// Returns whether the run loop polls for the next write instead of sleeping.
    pub(crate) fn polls(&mut self) -> bool {
        self.next.looks(|| bridge_node::now().monotonic)
    }
}

/// Answers the writes of a value that was dropped for a newer one. Writes of other fields wait for
/// the newer value, which contains theirs.
fn replace(dropped: Option<Vec<Departure>>, mut newer: Option<&mut Vec<Departure>>) {
    for departure in dropped.into_iter().flatten() {
        let is_other = departure.field.is_some()
            && newer.as_ref().is_some_and(|newer| {
                let mut fields = newer.iter().map(|one| one.field);
                fields.all(|field| field.is_some() && field != departure.field)
            });
        match &mut newer {
            Some(newer) if is_other => newer.push(departure),
            _ => departure.answer(REPLACED),
        }
    }
}

/// Answers the writes of a value.
fn answer(departures: Option<Vec<Departure>>, status: StatusCode) {
    for departure in departures.into_iter().flatten() {
        departure.answer(status);
    }
}

/// Returns the answer to a write by the result of sending its value.
const fn status(sent: Result<(), Reason>) -> StatusCode {
    match sent {
        Ok(()) => StatusCode::Good,
        Err(Reason::Takeover) => NOT_ACTIVE,
        Err(_) => StatusCode::BadCommunicationError,
    }
}

/// On a single core, polling would keep the other thread from running.
static SEVERAL_CORES: LazyLock<bool> =
    LazyLock::new(|| available_parallelism().is_ok_and(|cores| cores.get() > 1));

/// The status of a write while another server is active.
pub(crate) const NOT_ACTIVE: StatusCode = StatusCode::BadInvalidState;
/// The status of a write that a newer write replaced before its value was sent.
const REPLACED: StatusCode = StatusCode::BadRequestCancelledByRequest;
/// Time limit for a write to be sent by the run loop.
pub(crate) const LONGEST_WAY_OUT: Duration = Duration::from_secs(10);
/// The number of topics with unsent values that are checked for drops after a turn of the run loop.
const CHECKED_AT_ONCE: usize = 32;
/// Duration of polling before a thread sleeps.
const POLLING: Duration = Duration::from_micros(200);

#[cfg(test)]
mod tests {
    use super::*;

    /// The writes of topic 30 beside a Router.
    #[derive(Default)]
    struct Writes {
        leaving: Leaving,
        unsent: Unsent,
    }

    impl Writes {
        fn topic(identifier: u16) -> TopicId {
            TopicId::new(0, 2, identifier).unwrap()
        }

        /// Reports a value. Afterwards, the Router has these unsent values.
        fn write(&mut self, verdict: Verdict, queued: usize, is_held: bool) -> Departing {
            self.write_field(None, verdict, (queued, is_held))
        }

        fn write_field(
            &mut self,
            field: Option<usize>,
            verdict: Verdict,
            (queued, is_held): (usize, bool),
        ) -> Departing {
            let (departure, departing) = departure(field);
            self.leaving.add(departure);
            self.unsent = Unsent {
                queued,
                is_held,
                ..self.unsent
            };
            self.leaving.handled(Self::topic(30), verdict, self.unsent);
            departing
        }

        /// Sends a datagram of the topic. Afterwards, the queue of the Router has that many values.
        fn leave(&mut self, sent: Result<(), Reason>, queued: usize) {
            self.unsent.queued = queued;
            self.leaving.left(Self::topic(30), sent, self.unsent);
        }

        fn drain(&mut self, is_muted: bool) {
            let unsent = self.unsent;
            self.leaving.drained(is_muted, |_| unsent);
        }
    }

    /// Returns the answer that has arrived, or `None`.
    fn answer_of(departing: &mut Departing) -> Option<StatusCode> {
        departing.0.try_recv().ok()
    }

    #[tokio::test]
    async fn a_write_is_good_when_its_value_has_been_sent() {
        let mut writes = Writes::default();
        let mut departing = writes.write(Verdict::Forward, 1, false);
        // The value waits for its turn, and another topic is sent.
        writes.drain(false);
        let unsent = writes.unsent;
        writes.leaving.left(Writes::topic(31), Ok(()), unsent);
        assert_eq!(answer_of(&mut departing), None);
        writes.leave(Ok(()), 0);
        writes.drain(false);
        assert_eq!(departing.left().await, Ok(()));
        assert!(writes.leaving.topics.is_empty() && writes.leaving.order.is_empty());
    }

    #[tokio::test]
    async fn a_write_without_a_change_is_answered_with_the_value_before_it() {
        let unchanged = Verdict::Drop(Reason::Unchanged);
        let mut writes = Writes::default();
        let sent_before = writes.write(unchanged, 0, false);
        assert_eq!(sent_before.left().await, Ok(()));
        let queued = writes.write(Verdict::Forward, 1, false);
        let mut same = writes.write(unchanged, 1, false);
        assert_eq!(answer_of(&mut same), None);
        writes.leave(Err(Reason::NotSent), 0);
        assert_eq!(queued.left().await, Err(StatusCode::BadCommunicationError));
        assert_eq!(same.left().await, Err(StatusCode::BadCommunicationError));
    }

    #[tokio::test]
    async fn a_value_that_waits_for_its_time_is_good_when_it_leaves_or_cancelled_by_a_newer_one() {
        let mut writes = Writes::default();
        let first = writes.write(Verdict::Forward, 0, true);
        let mut second = writes.write(Verdict::Forward, 0, true);
        assert_eq!(first.left().await, Err(REPLACED));
        // An earlier value is repeated meanwhile.
        writes.leave(Ok(()), 0);
        writes.drain(false);
        assert_eq!(answer_of(&mut second), None);
        writes.unsent.is_held = false;
        writes.leave(Ok(()), 0);
        assert_eq!(second.left().await, Ok(()));
    }

    #[tokio::test]
    async fn the_oldest_value_of_a_full_queue_is_cancelled_and_the_others_leave_in_order() {
        let overflow = Verdict::ForwardAfterDroppingOldest;
        let mut writes = Writes::default();
        let first = writes.write(Verdict::Forward, 1, false);
        let second = writes.write(Verdict::Forward, 2, false);
        let mut third = writes.write(overflow, 2, false);
        assert_eq!(first.left().await, Err(REPLACED));
        writes.leave(Ok(()), 1);
        assert_eq!(second.left().await, Ok(()));
        // A second chunk of the same value.
        writes.leave(Ok(()), 1);
        assert_eq!(answer_of(&mut third), None);
        writes.leave(Ok(()), 0);
        assert_eq!(third.left().await, Ok(()));
    }

    #[tokio::test]
    async fn a_large_value_is_good_with_its_last_datagram_and_is_not_cancelled_by_a_newer_one() {
        let mut writes = Writes::default();
        let mut large = writes.write(Verdict::Forward, 1, false);
        // It waits for the pace of large messages.
        writes.unsent = Unsent {
            is_sending: true,
            ..Unsent::default()
        };
        writes.drain(false);
        let newer = writes.write(Verdict::Forward, 1, false);
        writes.leave(Ok(()), 1);
        assert_eq!(answer_of(&mut large), None);
        writes.unsent.is_sending = false;
        writes.leave(Ok(()), 1);
        assert_eq!(large.left().await, Ok(()));
        writes.leave(Ok(()), 0);
        assert_eq!(newer.left().await, Ok(()));
    }

    #[tokio::test]
    async fn a_write_behind_a_large_value_of_the_program_is_answered_for_itself() {
        let mut writes = Writes::default();
        writes.unsent.is_sending = true;
        let first = writes.write(Verdict::Forward, 1, false);
        let mut second = writes.write(Verdict::ForwardAfterDroppingOldest, 1, false);
        assert_eq!(first.left().await, Err(REPLACED));
        writes.unsent.is_sending = false;
        writes.leave(Ok(()), 1);
        assert_eq!(answer_of(&mut second), None);
        writes.leave(Ok(()), 0);
        assert_eq!(second.left().await, Ok(()));
    }

    #[tokio::test]
    async fn a_value_that_replaces_another_contains_the_other_fields_that_were_written() {
        let overflow = Verdict::ForwardAfterDroppingOldest;
        for (verdict, waits) in [(Verdict::Forward, (0, true)), (overflow, (1, false))] {
            let mut writes = Writes::default();
            let mut write = |field| writes.write_field(field, verdict, waits);
            let [first, second, again] = [write(Some(0)), write(Some(1)), write(Some(0))];
            assert_eq!(first.left().await, Err(REPLACED));
            writes.unsent.is_held = false;
            writes.leave(Ok(()), 0);
            assert_eq!(second.left().await, Ok(()));
            assert_eq!(again.left().await, Ok(()));
        }
    }

    #[tokio::test]
    async fn a_write_that_was_not_sent_has_a_bad_status() {
        for (reason, status) in [
            (Reason::Takeover, StatusCode::BadInvalidState),
            (Reason::NotSent, StatusCode::BadCommunicationError),
            (Reason::SpaceTaken, StatusCode::BadCommunicationError),
        ] {
            let mut writes = Writes::default();
            let failed = writes.write(Verdict::Forward, 1, false);
            writes.leave(Err(reason), 0);
            assert_eq!(failed.left().await, Err(status), "{reason}");
            let refused = writes.write(Verdict::Drop(reason), 0, false);
            assert_eq!(refused.left().await, Err(status), "{reason}");
        }
        let mut writes = Writes::default();
        // The Router drops the values of a namespace that another program has.
        let dropped = writes.write(Verdict::Forward, 1, false);
        writes.unsent = Unsent::default();
        writes.drain(false);
        assert_eq!(dropped.left().await, Err(StatusCode::BadCommunicationError));
        let muted = writes.write(Verdict::Forward, 0, true);
        writes.drain(true);
        assert_eq!(muted.left().await, Err(StatusCode::BadInvalidState));
        let (departure, departing) = departure(None);
        departure.refuse();
        assert_eq!(departing.left().await, Err(StatusCode::BadInvalidState));
    }

    #[tokio::test]
    async fn a_write_that_is_dropped_does_not_answer_the_write_before_it() {
        let mut writes = Writes::default();
        let queued = writes.write(Verdict::Forward, 1, false);
        let dropped = writes.write(Verdict::Drop(Reason::TooBig), 1, false);
        writes.leave(Ok(()), 0);
        assert_eq!(queued.left().await, Ok(()));
        assert_eq!(dropped.left().await, Err(StatusCode::BadCommunicationError));
    }

    #[tokio::test]
    async fn an_answer_after_the_end_of_polling_is_received() {
        let (departure, departing) = departure(None);
        let late = async {
            let until = bridge_node::now().monotonic + 2 * POLLING;
            while bridge_node::now().monotonic < until {
                tokio::task::yield_now().await;
            }
            departure.answer(StatusCode::Good);
        };
        let (left, ()) = tokio::join!(departing.left(), late);
        assert_eq!(left, Ok(()));
    }
}
