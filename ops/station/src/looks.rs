//! The searches for the nodes of servers, which share the time of the station.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use plant_opcua::client::{Client, ClientError};
use tokio::sync::Semaphore;
use tokio::time::{Instant, timeout};

use crate::mirror::{self, Mirror};

/// Limits the searches of all servers of a level: few run at the same time, and the more servers
/// there are, the less often each is searched. A server that reports its model changes is searched
/// at once after each.
#[derive(Debug)]
pub(crate) struct Looks {
    slots: Semaphore,
    servers: AtomicUsize,
}

impl Default for Looks {
    fn default() -> Self {
        Self {
            slots: Semaphore::new(AT_ONCE),
            servers: AtomicUsize::new(0),
        }
    }
}

impl Looks {
    /// Adds a server, which is searched until the returned value is dropped.
    pub(crate) fn enter(&self) -> SearchedServer<'_> {
        self.servers.fetch_add(1, Ordering::Relaxed);
        SearchedServer {
            looks: self,
            took: Duration::ZERO,
        }
    }
}

/// A server that is searched.
#[derive(Debug)]
pub(crate) struct SearchedServer<'l> {
    looks: &'l Looks,
    /// Duration of the last search.
    took: Duration,
}

impl SearchedServer<'_> {
    /// Reads the nodes of the server when few other searches are running.
    ///
    /// # Errors
    /// No response.
    pub(crate) async fn look(&mut self, client: &Client) -> Result<Mirror, ClientError> {
        // Servers that do not respond must not keep the others from being shown.
        let slot = timeout(MOST_WAIT, self.looks.slots.acquire()).await;
        let began = Instant::now();
        let looked = mirror::look(client).await;
        self.took = began.elapsed();
        drop(slot);
        looked
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
/// How long a search waits for the others at most.
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
    use super::*;

    #[test]
    fn many_servers_are_searched_as_often_together_as_a_few() {
        let looks = Looks::default();
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
