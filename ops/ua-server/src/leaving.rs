//! Values of clients on their way out: a Write is answered when its value has been sent.
//!
//! The value passes from a thread of the server to the run loop, and the result comes back. Both
//! threads poll for a short time before they sleep, because waking a thread takes longer than
//! sending a value.

use std::sync::LazyLock;
use std::thread::available_parallelism;
use std::time::Duration;

use bridge_node::{BusyPoll, Reason};
use mappings::TopicId;
use opcua::types::StatusCode;
use tokio::sync::oneshot;
use tokio::sync::oneshot::error::TryRecvError;
use tokio::time::timeout;

/// The result of sending a value, for the client that wrote it.
#[derive(Debug)]
pub(crate) struct Departure(oneshot::Sender<StatusCode>);

/// The result of sending a value that is still to come.
#[derive(Debug)]
pub(crate) struct Departing(oneshot::Receiver<StatusCode>);

/// Creates the two ends of a result.
pub(crate) fn departure() -> (Departure, Departing) {
    let (result, pending) = oneshot::channel();
    (Departure(result), Departing(pending))
}

impl Departure {
    /// Answers the Write of a value that is not sent, because another server is active.
    pub(crate) fn refuse(self) {
        self.answer(NOT_ACTIVE);
    }

    fn answer(self, status: StatusCode) {
        // The client may be lost.
        let _gone = self.0.send(status);
    }
}

impl Departing {
    /// Waits until the value has been sent.
    ///
    /// # Errors
    /// Returns `BadInvalidState` if another server is active, `BadCommunicationError` if the value
    /// was not sent for another reason, `BadShutdown` if the server stopped, and `BadTimeout` if
    /// the run loop does not answer. The outcome of the last two is unknown.
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

/// The values that the run loop has received and not sent yet. At most one batch of events.
#[derive(Debug)]
pub(crate) struct Leaving {
    values: Vec<(TopicId, Departure)>,
    /// The reported value that the run loop has not handled. The run loop may send the values
    /// before it first, and their results are not those of this value.
    reported: Vec<(TopicId, Departure)>,
    /// Polls for the next write of a client that waits for each result.
    next: BusyPoll,
}

impl Default for Leaving {
    fn default() -> Self {
        let window = if *SEVERAL_CORES {
            POLLING
        } else {
            Duration::ZERO
        };
        Self {
            values: Vec::new(),
            reported: Vec::new(),
            next: BusyPoll::new(window),
        }
    }
}

impl Leaving {
    /// Adds a value that is passed on to the run loop.
    pub(crate) fn add(&mut self, topic: TopicId, departure: Departure) {
        self.next.arrived(bridge_node::now().monotonic);
        self.reported.push((topic, departure));
    }

    /// Records that the run loop has handled the reported value, or answers its write if the value
    /// is dropped.
    pub(crate) fn handled(&mut self, taken: Result<(), Reason>) {
        if taken.is_ok() {
            self.values.append(&mut self.reported);
            return;
        }
        for (_, departure) in self.reported.drain(..) {
            departure.answer(status(taken));
        }
    }

    /// Answers the writes of a topic.
    pub(crate) fn left(&mut self, topic: TopicId, sent: Result<(), Reason>) {
        let left = self.values.extract_if(.., |(of, _)| *of == topic);
        for (_, departure) in left {
            departure.answer(status(sent));
        }
    }

    /// Answers all handled writes: their values equal the previous ones, wait for their turn, or
    /// are not sent because another server is active.
    pub(crate) fn drained(&mut self, is_muted: bool) {
        let status = if is_muted {
            NOT_ACTIVE
        } else {
            StatusCode::Good
        };
        for (_, departure) in self.values.drain(..) {
            departure.answer(status);
        }
    }

    /// Returns whether the run loop polls for the next write instead of sleeping.
    pub(crate) fn polls(&mut self) -> bool {
        self.next.looks(|| bridge_node::now().monotonic)
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
/// Time limit for a write to be sent by the run loop.
pub(crate) const LONGEST_WAY_OUT: Duration = Duration::from_secs(10);
/// Duration of polling before a thread sleeps.
const POLLING: Duration = Duration::from_micros(200);

#[cfg(test)]
mod tests {
    use super::*;

    fn topic(identifier: u16) -> TopicId {
        TopicId::new(0, 2, identifier).unwrap()
    }

    /// Returns the answer to a write of topic 30 after these steps of the run loop.
    async fn answer(steps: impl FnOnce(&mut Leaving)) -> Result<(), StatusCode> {
        let mut leaving = Leaving::default();
        let (departure, departing) = departure();
        leaving.add(topic(30), departure);
        // The values before it were sent.
        leaving.left(topic(30), Ok(()));
        leaving.drained(false);
        leaving.handled(Ok(()));
        steps(&mut leaving);
        drop(leaving);
        departing.left().await
    }

    #[tokio::test]
    async fn a_write_is_good_only_if_its_value_was_sent_or_waits_for_its_turn() {
        let sent = answer(|leaving| leaving.left(topic(30), Ok(()))).await;
        assert_eq!(sent, Ok(()));
        let waits = answer(|leaving| leaving.drained(false)).await;
        assert_eq!(waits, Ok(()));
        let other = answer(|leaving| leaving.left(topic(31), Ok(()))).await;
        assert_eq!(
            other,
            Err(StatusCode::BadShutdown),
            "another topic was sent"
        );
    }

    #[tokio::test]
    async fn a_write_that_was_not_sent_has_a_bad_status() {
        for (reason, status) in [
            (Reason::Takeover, StatusCode::BadInvalidState),
            (Reason::NotSent, StatusCode::BadCommunicationError),
            (Reason::SpaceTaken, StatusCode::BadCommunicationError),
        ] {
            let told = answer(|leaving| {
                leaving.left(topic(30), Err(reason));
                leaving.drained(false);
            });
            assert_eq!(told.await, Err(status), "{reason}");
        }
        let muted = answer(|leaving| leaving.drained(true)).await;
        assert_eq!(muted, Err(StatusCode::BadInvalidState));
        let (departure, departing) = departure();
        departure.refuse();
        assert_eq!(departing.left().await, Err(StatusCode::BadInvalidState));
    }

    #[tokio::test]
    async fn a_write_that_is_dropped_does_not_answer_the_write_before_it() {
        let mut leaving = Leaving::default();
        let (first, queued) = departure();
        let (second, dropped) = departure();
        leaving.add(topic(30), first);
        leaving.handled(Ok(()));
        leaving.add(topic(30), second);
        leaving.handled(Err(Reason::TooBig));
        leaving.left(topic(30), Ok(()));
        assert_eq!(queued.left().await, Ok(()));
        assert_eq!(dropped.left().await, Err(StatusCode::BadCommunicationError));
    }

    #[tokio::test]
    async fn an_answer_after_the_end_of_polling_is_received() {
        let (departure, departing) = departure();
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
