//! The subscriptions of a connection.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

/// The subscriptions that the broker has not confirmed. A refused subscription is requested again:
/// a cluster that elects a leader refuses subscriptions for some seconds, and without them a
/// connected program would receive nothing.
#[derive(Debug, Default)]
pub(crate) struct Subscriptions {
    /// Requested filters by packet identifier.
    requested: BTreeMap<u16, usize>,
    refused: BTreeSet<usize>,
    /// The time of the next attempt, and the pause after it.
    retry: Option<(Instant, Duration)>,
}

impl Subscriptions {
    /// Records the request for a filter.
    pub(crate) fn request(&mut self, id: u16, filter: usize) {
        self.requested.insert(id, filter);
    }

    /// Records the response of the broker.
    pub(crate) fn respond(&mut self, id: u16, is_refused: bool, now: Instant) -> Response {
        let Some(filter) = self.requested.remove(&id) else {
            return Response::Unknown;
        };
        if is_refused {
            let is_new = self.refused.insert(filter);
            let (_, pause) = self.retry.unwrap_or((now, FIRST_RETRY));
            if self.retry.is_none_or(|(at, _)| at <= now) {
                self.retry = Some((now + pause, (pause * 2).min(LAST_RETRY)));
            }
            return match is_new {
                true => Response::Refused(filter),
                false => Response::RefusedAgain,
            };
        }
        let was_refused = self.refused.remove(&filter);
        if self.refused.is_empty() {
            self.retry = None;
        }
        match was_refused {
            true => Response::Mended(filter),
            false => Response::Confirmed,
        }
    }

    /// Returns the packet identifiers of the requests without a response.
    #[cfg(test)]
    pub(crate) fn requested_ids(&self) -> impl Iterator<Item = u16> {
        self.requested.keys().copied()
    }

    /// Returns whether the broker has responded to all requests.
    pub(crate) fn is_settled(&self) -> bool {
        self.requested.is_empty()
    }

    /// Returns the time of the next attempt.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        let (at, _) = self.retry?;
        self.requested.is_empty().then_some(at)
    }

    /// Returns the refused filters to request again, if the time has come.
    pub(crate) fn take_due(&self, now: Instant) -> Vec<usize> {
        match self.poll_timeout() {
            Some(at) if at <= now => self.refused.iter().copied().collect(),
            Some(_) | None => Vec::new(),
        }
    }
}

/// The evaluation of a response to a subscription.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Response {
    Confirmed,
    /// The broker refuses the filter for the first time.
    Refused(usize),
    RefusedAgain,
    /// The broker has refused the filter before, and confirms it.
    Mended(usize),
    /// Nothing was requested with this identifier.
    Unknown,
}

/// The first and the longest pause before a refused subscription is requested again.
const FIRST_RETRY: Duration = Duration::from_secs(1);
const LAST_RETRY: Duration = Duration::from_secs(10);

#[cfg(test)]
mod tests {
    use super::*;

    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn start() -> Instant {
        Instant::now()
    }

    fn seconds(count: u64) -> Duration {
        Duration::from_secs(count)
    }

    #[test]
    fn a_refused_subscription_is_requested_again_until_the_broker_confirms_it() {
        let mut subscriptions = Subscriptions::default();
        let start = start();
        subscriptions.request(1, 0);
        subscriptions.request(2, 1);
        assert_eq!(subscriptions.respond(1, false, start), Response::Confirmed);
        assert!(!subscriptions.is_settled());
        assert_eq!(subscriptions.respond(2, true, start), Response::Refused(1));
        assert!(subscriptions.is_settled());
        assert_eq!(subscriptions.poll_timeout(), Some(start + FIRST_RETRY));
        assert!(subscriptions.take_due(start).is_empty());

        let later = start + FIRST_RETRY;
        assert_eq!(subscriptions.take_due(later), [1]);
        subscriptions.request(3, 1);
        assert_eq!(subscriptions.poll_timeout(), None);
        let again = subscriptions.respond(3, true, later);
        assert_eq!(again, Response::RefusedAgain);
        assert_eq!(subscriptions.poll_timeout(), Some(later + seconds(2)));

        let latest = later + seconds(2);
        assert_eq!(subscriptions.take_due(latest), [1]);
        subscriptions.request(4, 1);
        let mended = subscriptions.respond(4, false, latest);
        assert_eq!(mended, Response::Mended(1));
        assert_eq!(subscriptions.poll_timeout(), None);
        assert_eq!(subscriptions.respond(4, false, latest), Response::Unknown);
    }

    #[test]
    fn the_pauses_before_further_requests_are_bounded() {
        let mut subscriptions = Subscriptions::default();
        let mut now = start();
        let mut longest = Duration::ZERO;
        for id in 1..10 {
            subscriptions.request(id, 0);
            let _refused = subscriptions.respond(id, true, now);
            let next = subscriptions.poll_timeout().unwrap();
            longest = longest.max(next - now);
            now = next;
        }
        assert_eq!(longest, LAST_RETRY);
    }
}
