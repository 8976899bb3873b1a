//! The clocks of other hosts, compared with the clock of this host while `trace` runs.
//!
//! Each exchange asks a program for its `/status`, which has the time there.

use std::collections::{BTreeMap, VecDeque};
use std::net::{IpAddr, UdpSocket};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::net::lookup_host;
use tokio::task::AbortHandle;
use tokio::time::{MissedTickBehavior, interval};

use super::super::unix_nanos;
use super::clocks::{Estimate, Exchange, fit};
use crate::cell::page_of_url;
use crate::http::HttpServer;

/// The clocks of the hosts of programs, by address. Asks again until it is dropped.
#[derive(Debug, Default)]
pub(super) struct ClockOffsets {
    hosts: Arc<Mutex<BTreeMap<IpAddr, Host>>>,
    asking: Option<AbortHandle>,
}

/// A host with the exchanges of the last minute.
#[derive(Debug, Default)]
struct Host {
    exchanges: VecDeque<Exchange>,
    estimate: Option<Estimate>,
}

impl Drop for ClockOffsets {
    fn drop(&mut self) {
        if let Some(asking) = &self.asking {
            asking.abort();
        }
    }
}

impl ClockOffsets {
    /// Compares the clocks of the hosts of these programs, and continues in the background. The
    /// clock of this host, and programs that do not answer, are left out.
    pub(super) async fn watch(urls: &[String]) -> Self {
        let mut offsets = Self::default();
        let mut others = Vec::new();
        for url in urls {
            if let Some(ip) = other_host(url).await {
                others.push((ip, url.clone()));
            }
        }
        if others.is_empty() {
            return offsets;
        }
        let hosts = Arc::clone(&offsets.hosts);
        ask(&others, &hosts).await;
        let asking = tokio::spawn(async move {
            let mut ticks = interval(PERIOD);
            ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
            loop {
                ticks.tick().await;
                ask(&others, &hosts).await;
            }
        });
        offsets.asking = Some(asking.abort_handle());
        offsets
    }

    /// Returns a time of the clock of a host as a time of this host; unchanged if the clock is not
    /// known.
    pub(super) fn corrected(&self, host: IpAddr, time: i128) -> i128 {
        let hosts = locked(&self.hosts);
        let estimate = hosts.get(&host).and_then(|host| host.estimate.as_ref());
        estimate.map_or(time, |estimate| estimate.corrected(time))
    }

    /// Returns the clocks of the hosts.
    pub(super) fn clocks(&self) -> Vec<(IpAddr, Estimate)> {
        let hosts = locked(&self.hosts);
        let known = hosts.iter();
        let known = known.filter_map(|(ip, host)| Some((*ip, host.estimate?)));
        known.collect()
    }
}

fn locked(hosts: &Mutex<BTreeMap<IpAddr, Host>>) -> MutexGuard<'_, BTreeMap<IpAddr, Host>> {
    hosts.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Asks each program for its time, and keeps the shortest of a few exchanges.
async fn ask(others: &[(IpAddr, String)], hosts: &Mutex<BTreeMap<IpAddr, Host>>) {
    for (ip, url) in others {
        let mut shortest: Option<Exchange> = None;
        for _ in 0..AT_ONCE {
            let exchange = exchange(url).await;
            let is_shorter = |one: &Exchange| shortest.is_none_or(|other| one.half < other.half);
            shortest = exchange.filter(is_shorter).or(shortest);
        }
        if let Some(exchange) = shortest {
            locked(hosts).entry(*ip).or_default().add(exchange);
        }
    }
}

async fn exchange(url: &str) -> Option<Exchange> {
    let sent = unix_nanos();
    let pages = page_of_url(url).await.ok()?;
    let received = unix_nanos();
    let there = i128::from(pages.first()?.time_us?) * 1000;
    let at = i128::midpoint(sent, received);
    // The clock of this host was set back meanwhile.
    if received < sent {
        return None;
    }
    Some(Exchange {
        at,
        offset: there - at,
        half: (received - sent) / 2,
    })
}

impl Host {
    fn add(&mut self, exchange: Exchange) {
        // A clock that is set meanwhile, or this one, makes the exchanges before meaningless.
        let is_set = self.estimate.is_some_and(|estimate| {
            (exchange.offset - estimate.at(exchange.at)).abs() > exchange.half + STEP
        });
        if is_set {
            self.exchanges.clear();
        }
        if self.exchanges.len() >= MOST_EXCHANGES {
            self.exchanges.pop_front();
        }
        self.exchanges.push_back(exchange);
        self.estimate = fit(self.exchanges.iter().copied().collect());
    }
}

/// Returns the address of the host of a URL, if it is not this host.
async fn other_host(url: &str) -> Option<IpAddr> {
    let server = HttpServer::parse(url).ok()?;
    let ip = lookup_host(server.authority()).await.ok()?.next()?.ip();
    // The route to an address of this host begins there. Nothing is sent.
    let any: IpAddr = match ip {
        IpAddr::V4(_) => std::net::Ipv4Addr::UNSPECIFIED.into(),
        IpAddr::V6(_) => std::net::Ipv6Addr::UNSPECIFIED.into(),
    };
    let route = UdpSocket::bind((any, 0)).ok()?;
    route.connect((ip, 9)).ok()?;
    let own = route.local_addr().ok()?.ip();
    (own != ip && !ip.is_loopback()).then_some(ip)
}

/// The interval of the exchanges, and the number of exchanges of which the shortest counts.
const PERIOD: Duration = Duration::from_millis(500);
const AT_ONCE: usize = 3;
const MOST_EXCHANGES: usize = 120;
/// A larger difference from the estimate, in nanoseconds, is a clock that was set.
const STEP: i128 = 50_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i128 = 1_000_000;

    fn exchange(number: i128, offset: i128) -> Exchange {
        Exchange {
            at: number * 500 * MS,
            offset,
            half: MS / 4,
        }
    }

    #[test]
    fn a_clock_that_is_set_is_followed_at_once() {
        let mut host = Host::default();
        for number in 0..20 {
            host.add(exchange(number, 3_000 * MS));
        }
        assert_eq!(host.estimate.unwrap().offset, 3_000 * MS);
        host.add(exchange(20, 0));
        assert_eq!(host.estimate.unwrap().offset, 0);
        let mut offsets = ClockOffsets::default();
        let ip: IpAddr = "10.0.0.2".parse().unwrap();
        host.add(exchange(21, 7 * MS));
        offsets.hosts = Arc::new(Mutex::new(BTreeMap::from([(ip, host)])));
        let other: IpAddr = "10.0.0.3".parse().unwrap();
        assert_eq!(offsets.corrected(other, 100 * MS), 100 * MS);
        let corrected = offsets.corrected(ip, 100 * MS);
        assert!((93 * MS..=100 * MS).contains(&corrected), "{corrected}");
    }

    #[tokio::test]
    async fn this_host_needs_no_comparison() {
        assert_eq!(other_host("http://127.0.0.1:9100").await, None);
        let offsets = ClockOffsets::watch(&["http://127.0.0.1:9".to_owned()]).await;
        assert!(offsets.clocks().is_empty() && offsets.asking.is_none());
    }
}
