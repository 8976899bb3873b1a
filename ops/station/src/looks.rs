//! The searches for the nodes of servers, which share the time of the station.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use plant_opcua::client::{ClientError, Link, OpcUaClient};
use tokio::sync::{AcquireError, Semaphore, SemaphorePermit, watch};
use tokio::time::{Instant, sleep};

use crate::mirror::{self, MirroredServer};

/// Limits the searches of all servers of a level: few run at the same time, and the more servers
/// there are, the less often each is searched. A server that reports its model changes is searched
/// at once after each.
#[derive(Debug)]
pub(crate) struct StationSearches {
    slots: Semaphore,
    /// Slots of the searches that have waited for `patience`.
    late: Semaphore,
    patience: Duration,
    servers: AtomicUsize,
}

impl Default for StationSearches {
    fn default() -> Self {
        Self {
            slots: Semaphore::new(AT_ONCE),
            late: Semaphore::new(LATE_AT_ONCE),
            patience: MOST_WAIT,
            servers: AtomicUsize::new(0),
        }
    }
}

impl StationSearches {
    /// Adds a server, which is searched until the returned value is dropped.
    pub(crate) fn enter(&self) -> SearchedServer<'_> {
        self.servers.fetch_add(1, Ordering::Relaxed);
        SearchedServer {
            looks: self,
            took: Duration::ZERO,
        }
    }

    /// Waits until another search may run. Servers that do not respond must not keep the others
    /// from being shown: after a while, more searches run.
    async fn slot(&self) -> Result<SemaphorePermit<'_>, AcquireError> {
        let late = async {
            sleep(self.patience).await;
            self.late.acquire().await
        };
        tokio::select! {
            biased;
            slot = self.slots.acquire() => slot,
            slot = late => slot,
        }
    }
}

/// A server that is searched.
#[derive(Debug)]
pub(crate) struct SearchedServer<'l> {
    looks: &'l StationSearches,
    /// Duration of the last search.
    took: Duration,
}

impl SearchedServer<'_> {
    /// Reads the nodes of the server when few other searches are running. Returns `None` when the
    /// connection changes meanwhile.
    ///
    /// # Errors
    /// No response.
    pub(crate) async fn look(
        &mut self,
        client: &OpcUaClient,
        link: &mut watch::Receiver<Link>,
    ) -> Option<Result<MirroredServer, ClientError>> {
        tokio::select! {
            biased;
            changed = link.changed() => {
                drop(changed);
                None
            }
            looked = async {
                let slot = self.looks.slot().await;
                let began = Instant::now();
                let looked = mirror::look(client).await;
                self.took = began.elapsed();
                drop(slot);
                looked
            } => Some(looked),
        }
    }

    /// Returns the time until the next search of a server without reported changes.
    pub(crate) fn pause(&self) -> Duration {
        let servers = self.looks.servers.load(Ordering::Relaxed);
        let servers = u32::try_from(servers).unwrap_or(u32::MAX);
        let of_all = EACH.saturating_mul(servers);
        AGAIN.max(self.took * SELDOM).max(of_all).min(AT_LAST)
    }
}

impl Drop for SearchedServer<'_> {
    fn drop(&mut self) {
        self.looks.servers.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Number of searches at the same time.
const AT_ONCE: usize = 8;
/// Number of further searches at the same time, for searches that have waited long.
const LATE_AT_ONCE: usize = 32;
/// How long a search waits before it counts among the late ones.
const MOST_WAIT: Duration = Duration::from_secs(5);
/// Shortest pause between the searches of a server.
const AGAIN: Duration = Duration::from_secs(2);
/// A search of a server's nodes takes at most one part in so many of the time.
const SELDOM: u32 = 20;
/// The pause grows by this for each server, so that all together are searched four times a second.
const EACH: Duration = Duration::from_millis(250);
/// Longest pause.
const AT_LAST: Duration = Duration::from_secs(120);

#[cfg(test)]
mod tests {
    use tokio::time::timeout;

    use super::*;

    #[tokio::test]
    async fn searches_that_have_waited_long_are_few_at_the_same_time_too() {
        let looks = StationSearches {
            patience: Duration::ZERO,
            ..StationSearches::default()
        };
        let mut slots = Vec::new();
        for _ in 0..AT_ONCE + LATE_AT_ONCE {
            slots.push(looks.slot().await.unwrap());
        }
        let more = timeout(Duration::from_millis(20), looks.slot()).await;
        assert!(more.is_err(), "{more:?}");
        drop(slots.pop());
        let next = timeout(Duration::from_secs(10), looks.slot()).await;
        assert!(next.is_ok(), "{next:?}");
    }

    #[test]
    fn many_servers_are_searched_as_often_together_as_a_few() {
        let looks = StationSearches::default();
        let mut first = looks.enter();
        assert_eq!(first.pause(), AGAIN);
        let others: Vec<_> = (1..100).map(|_| looks.enter()).collect();
        assert_eq!(first.pause(), Duration::from_secs(25));
        drop(others);
        assert_eq!(first.pause(), AGAIN);
        first.took = Duration::from_secs(1);
        assert_eq!(first.pause(), Duration::from_secs(20));
    }
}
