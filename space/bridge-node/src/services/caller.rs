//! The task that calls a service.

use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use mappings::TopicId;
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval, sleep};
use tracing::info;

use super::pending::Pending;

/// The client of one service of a ROS graph.
pub trait ServiceCall: Send + 'static {
    /// Returns the name of the service in the graph.
    fn service(&self) -> &str;

    /// Calls the service. Request and response are in the wire format of the ROS. The request is
    /// not sent after `start_by`, which is compared directly before it is sent.
    ///
    /// # Errors
    /// [`CallFault`]; a call ends in bounded time.
    fn call_by(
        &self,
        request: Bytes,
        start_by: Option<Instant>,
    ) -> impl Future<Output = Result<Bytes, CallFault>> + Send;

    /// Returns whether the service has received the request of the running call, as far as that is
    /// known before the response.
    fn has_request(&self) -> bool {
        false
    }
}

/// The reason why a call has no response.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CallFault {
    /// Text for the user.
    pub text: String,
    /// Whether the same call may succeed later without any change other than the return of the
    /// service.
    pub may_pass: bool,
    /// Whether the service ran.
    pub ran: MayHaveRun,
}

/// Whether a service ran although there is no response.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MayHaveRun {
    /// The service never received the request.
    No,
    /// The service received the request; its execution is unknown.
    Perhaps,
    /// The service ran and reports a failure.
    Yes,
}

/// The outcome of a call.
#[derive(Debug)]
pub struct ServiceOutcome {
    /// The source of the call.
    pub(super) of: CallCause,
    /// The response, or the reason why there is none.
    pub(super) result: Result<Bytes, FailedCall>,
}

/// A call without a response.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text}{}", if *again { ": trying again" } else { "" })]
pub(super) struct FailedCall {
    /// Text for the user.
    text: String,
    /// Whether the same request is sent again.
    again: bool,
}

/// The cause of calls.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum CallCause {
    /// The values of a topic.
    Value(TopicId),
    /// A periodic poll, by its number.
    Poll(usize),
}

/// Calls a service and reports the outcomes.
#[derive(Debug)]
pub(super) struct ServiceCallTask<C> {
    client: C,
    of: CallCause,
    report: mpsc::Sender<ServiceOutcome>,
    /// Whether the last call failed.
    failing: bool,
}

impl<C: ServiceCall> ServiceCallTask<C> {
    pub(super) const fn new(
        client: C,
        of: CallCause,
        report: mpsc::Sender<ServiceOutcome>,
    ) -> Self {
        Self {
            client,
            of,
            report,
            failing: false,
        }
    }

    /// Calls the service with each request in turn. An event is sent once. A state (`insist`) is
    /// sent again after a temporary failure, until the service accepts it or a newer value arrives.
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

    /// Calls the service periodically with the same request.
    pub(super) async fn poll(mut self, request: Bytes, every: Duration) {
        let mut ticks = interval(every);
        // After a slow call the next call waits for a full interval.
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            let answer = self.client.call_by(request.clone(), None).await;
            self.report(answer, false).await;
        }
    }

    /// Calls the service with a request, and records whether the service has received it.
    async fn call_for(
        &mut self,
        (pending, number): (&Pending, u64),
        request: Bytes,
        insist: bool,
    ) -> Next {
        let answer = {
            let mut call = pin!(self.client.call_by(request, None));
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
            Err(CallFault {
                ran: MayHaveRun::No,
                ..
            }) => pending.refused(number),
            Ok(_) | Err(_) => pending.took(number),
        }
        self.report(answer, insist).await
    }

    async fn report(&mut self, answer: Result<Bytes, CallFault>, insist: bool) -> Next {
        let mut next = Next::Done;
        let result = answer.map_err(|CallFault { text, may_pass, .. }| {
            self.failing = true;
            let again = insist && may_pass;
            if again {
                next = Next::Again;
            }
            FailedCall { text, again }
        });
        if result.is_ok() && std::mem::take(&mut self.failing) {
            info!(
                service = self.client.service(),
                "the service responds again"
            );
        }
        let outcome = ServiceOutcome {
            of: self.of,
            result,
        };
        // The channel is closed when the port is dropped.
        drop(self.report.send(outcome).await);
        next
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Next {
    Done,
    Again,
}

/// Interval of the checks whether a service has received the request.
const LOOK: Duration = Duration::from_millis(20);
/// The first pause before a state is sent to its service again, doubling up to the last pause.
const FIRST_WAIT: Duration = Duration::from_millis(250);
const LAST_WAIT: Duration = Duration::from_secs(5);
