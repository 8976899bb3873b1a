//! The task that calls one service.

use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use mappings::TopicId;
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval, sleep};
use tracing::info;

use super::pending::Pending;

/// One service of a ROS graph, to be called.
pub trait ServiceCall: Send + 'static {
    /// Its name there.
    fn service(&self) -> &str;

    /// One call: a request as the messages of that ROS are on the wire, and the answer likewise.
    ///
    /// # Errors
    /// [`CallFault`]; a call ends in bounded time.
    fn call(&self, request: Bytes) -> impl Future<Output = Result<Bytes, CallFault>> + Send;

    /// Whether the service has the request of the call that is under way, as far as that is known
    /// before its answer.
    fn has_request(&self) -> bool {
        false
    }
}

/// Why a call brought no answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CallFault {
    /// For people.
    pub text: String,
    /// Whether the same call may succeed later, with nobody changing anything but the service
    /// coming back.
    pub may_pass: bool,
    /// Whether the service ran.
    pub ran: Ran,
}

/// Whether a service ran although there is no answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ran {
    /// It never had the request.
    No,
    /// It had the request, and no more is known.
    Perhaps,
    /// It did, and says that it failed.
    Yes,
}

/// What became of a call.
#[derive(Debug)]
pub struct Outcome {
    /// What it was made for.
    pub(super) of: Source,
    /// The answer, or why there is none.
    pub(super) result: Result<Bytes, String>,
}

/// What makes calls.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Source {
    /// The values of a topic.
    Value(TopicId),
    /// The clock; the number of the poll.
    Poll(usize),
}

/// Calls one service and reports what came of it.
#[derive(Debug)]
pub(super) struct Caller<C> {
    client: C,
    of: Source,
    report: mpsc::Sender<Outcome>,
    /// Whether the last call came to nothing.
    failing: bool,
}

impl<C: ServiceCall> Caller<C> {
    pub(super) const fn new(client: C, of: Source, report: mpsc::Sender<Outcome>) -> Self {
        Self {
            client,
            of,
            report,
            failing: false,
        }
    }

    /// Calls with each request in turn. A state (`insist`) is tried until the service takes it or a
    /// newer value has come, an event once.
    pub(super) async fn serve(mut self, pending: Arc<Pending>, insist: bool) {
        loop {
            let mut request = pending.take().await;
            let mut wait = FIRST_WAIT;
            while let (number, Some(asked)) = request.clone()
                && self.call_for((&pending, number), asked, insist).await == Next::Again
            {
                tokio::select! {
                    newer = pending.take() => (request, wait) = (newer, FIRST_WAIT),
                    () = sleep(wait) => wait = (wait * 2).min(LAST_WAIT),
                }
            }
        }
    }

    /// Calls with one request every so often.
    pub(super) async fn poll(mut self, request: Bytes, every: Duration) {
        let mut ticks = interval(every);
        // A slow service is asked again in its turn, not twice in a row.
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            let answer = self.client.call(request.clone()).await;
            self.report(answer, false).await;
        }
    }

    /// Calls with a request, and notes whether the service has it.
    async fn call_for(
        &mut self,
        (pending, number): (&Pending, u64),
        request: Bytes,
        insist: bool,
    ) -> Next {
        let answer = {
            let mut call = pin!(self.client.call(request));
            let mut looks = interval(LOOK);
            loop {
                tokio::select! {
                    answer = &mut call => break answer,
                    _ = looks.tick() => {
                        if self.client.has_request() {
                            pending.took(number);
                        }
                    }
                }
            }
        };
        match &answer {
            Err(CallFault { ran: Ran::No, .. }) => pending.refused(number),
            Ok(_) | Err(_) => pending.took(number),
        }
        self.report(answer, insist).await
    }

    async fn report(&mut self, answer: Result<Bytes, CallFault>, insist: bool) -> Next {
        let mut next = Next::Done;
        let result = answer.map_err(|CallFault { text, may_pass, .. }| {
            self.failing = true;
            if insist && may_pass {
                next = Next::Again;
                return format!("{text}; trying again");
            }
            text
        });
        if result.is_ok() && std::mem::take(&mut self.failing) {
            info!(service = self.client.service(), "the service answers again");
        }
        let outcome = Outcome {
            of: self.of,
            result,
        };
        // Nobody is left to be told when the port is gone.
        drop(self.report.send(outcome).await);
        next
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Next {
    Done,
    Again,
}

/// How often it is looked whether a service has the request.
const LOOK: Duration = Duration::from_millis(20);
/// The first wait before a state is handed to its service again, doubling to the last.
const FIRST_WAIT: Duration = Duration::from_millis(250);
const LAST_WAIT: Duration = Duration::from_secs(5);
