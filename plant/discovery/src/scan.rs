//! Servers that announce themselves to nobody, found by trying addresses.
//!
//! It connects, asks who is there (GetEndpoints) and leaves: it opens no session and changes nothing. How many addresses are
//! tried, how many at once and how many a second is bounded. It is never done unless somebody asks for it.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::str::FromStr;
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, timeout};

use crate::client::{Described, describe};
use crate::url::Url;

/// IPv4 addresses that are tried: those of hosts in a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Range {
    first: u32,
    count: u32,
}

/// Why a range is none.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RangeFault {
    /// It is not written as one.
    #[error("`{0}` is no range of IPv4 addresses, as 192.168.0.0/24")]
    Malformed(String),
    /// There are more addresses in it than are tried.
    #[error("/{0} is more than 65536 addresses, which are not tried: /16 is the widest")]
    Wide(u8),
}

impl Range {
    /// How many addresses it has.
    #[must_use]
    pub const fn hosts(self) -> u32 {
        self.count
    }

    /// Returns whether an address is that of a host in the network.
    #[must_use]
    pub fn contains(self, address: Ipv4Addr) -> bool {
        let at = address.to_bits().checked_sub(self.first);
        at.is_some_and(|at| at < self.count)
    }

    fn addresses(self) -> impl Iterator<Item = Ipv4Addr> {
        (0..self.count).map(move |at| Ipv4Addr::from_bits(self.first.saturating_add(at)))
    }
}

impl FromStr for Range {
    type Err = RangeFault;

    /// An address, or a network as `192.168.0.0/24`. The addresses of the network itself and of all its hosts are no hosts
    /// where it has more than two.
    fn from_str(text: &str) -> Result<Self, RangeFault> {
        let malformed = || RangeFault::Malformed(text.to_owned());
        let (address, prefix) = text.split_once('/').unwrap_or((text, "32"));
        let address: Ipv4Addr = address.parse().map_err(|_| malformed())?;
        let prefix: u8 = prefix.parse().map_err(|_| malformed())?;
        if prefix > 32 {
            return Err(malformed());
        }
        if prefix < WIDEST {
            return Err(RangeFault::Wide(prefix));
        }
        let count = 1_u32 << (32 - prefix);
        let network = address.to_bits() & !(count - 1);
        Ok(match prefix {
            31 | 32 => Self {
                first: network,
                count,
            },
            _ => Self {
                first: network + 1,
                count: count - 2,
            },
        })
    }
}

/// How hard the network is asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pace {
    /// How many connections are begun in a second at most, from 1 on.
    pub per_second: u32,
    /// How many are open at once at most, from 1 on.
    pub at_once: usize,
    /// How long to wait for a connection.
    pub connect: Duration,
    /// How long to wait for an answer.
    pub answer: Duration,
}

impl Default for Pace {
    fn default() -> Self {
        Self {
            per_second: 200,
            at_once: 64,
            connect: Duration::from_millis(700),
            answer: Duration::from_secs(3),
        }
    }
}

/// A server that was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Scanned {
    /// Where it was reached: the address that was tried, and the path it tells.
    pub url: String,
    /// The other places it was reached at.
    pub also_at: Vec<String>,
    /// What it says of itself.
    pub described: Described,
}

/// What a scan came to.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Outcome {
    /// The servers, one for each ApplicationUri, in the order of their addresses.
    pub servers: Vec<Scanned>,
    /// Places where somebody listens who does not answer as an OPC UA server, and why, in the same order.
    pub others: Vec<(SocketAddr, String)>,
    /// How many places were tried.
    pub tried: u32,
}

/// Tries those ports of all those addresses.
pub async fn scan(ranges: &[Range], ports: &[u16], pace: Pace) -> Outcome {
    let all = ranges.iter().flat_map(|range| range.addresses());
    let mut places = all.flat_map(|ip| ports.iter().map(move |port| SocketAddr::from((ip, *port))));
    let gap = Duration::from_secs(1) / pace.per_second.max(1);
    let mut beat = interval(gap.max(Duration::from_millis(1)));
    beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut trying: JoinSet<(SocketAddr, Option<Tried>)> = JoinSet::new();
    let mut told = BTreeMap::new();
    let mut tried = 0_u32;
    let mut more = true;
    while more || !trying.is_empty() {
        tokio::select! {
            _ = beat.tick(), if more && trying.len() < pace.at_once.max(1) => match places.next() {
                Some(place) => {
                    tried = tried.saturating_add(1);
                    trying.spawn(async move { (place, try_one(place, pace).await) });
                }
                None => more = false,
            },
            Some(ended) = trying.join_next(), if !trying.is_empty() => {
                if let Ok((place, Some(found))) = ended {
                    told.insert(place, found);
                }
            }
        }
    }
    let mut outcome = merged(told);
    outcome.tried = tried;
    outcome
}

/// What a server says, or why one that listens says nothing.
type Tried = Result<Described, String>;

/// `None` where nobody listens.
async fn try_one(place: SocketAddr, pace: Pace) -> Option<Tried> {
    let connected = timeout(pace.connect, TcpStream::connect(place)).await;
    drop(connected.ok()?.ok()?);
    let url = Url::of(place.ip(), place.port(), "").to_string();
    let described = describe(&url, pace.answer).await;
    Some(described.map_err(|fault| fault.to_string()))
}

/// One server for each ApplicationUri.
fn merged(told: BTreeMap<SocketAddr, Tried>) -> Outcome {
    let mut outcome = Outcome::default();
    for (place, tried) in told {
        let described = match tried {
            Ok(described) => described,
            Err(why) => {
                outcome.others.push((place, why));
                continue;
            }
        };
        let url = reached(place.ip(), place.port(), &described);
        let uri = &described.application.application_uri;
        let same = |one: &&mut Scanned| {
            !uri.is_empty() && one.described.application.application_uri == *uri
        };
        match outcome.servers.iter_mut().find(same) {
            Some(known) => known.also_at.push(url),
            None => outcome.servers.push(Scanned {
                url,
                also_at: Vec::new(),
                described,
            }),
        }
    }
    outcome
}

/// The place, with the path that the server tells of that port: hosts' names that are announced are not always to be resolved.
fn reached(ip: IpAddr, port: u16, described: &Described) -> String {
    let told = described.application.discovery_urls.iter();
    let mut told = told.filter_map(|url| Url::parse(url));
    let path = told.find(|url| url.port == port).map(|url| url.path);
    Url::of(ip, port, path.as_deref().unwrap_or_default()).to_string()
}

/// The widest network is /16.
const WIDEST: u8 = 16;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::client::Application;

    fn range(text: &str) -> Result<Range, RangeFault> {
        text.parse()
    }

    fn all(text: &str) -> Vec<String> {
        let range = range(text).unwrap();
        range.addresses().map(|ip| ip.to_string()).collect()
    }

    fn described(uri: &str, url: &str) -> Tried {
        Ok(Described {
            application: Application {
                application_uri: uri.to_owned(),
                name: "plc".to_owned(),
                is_discovery_server: false,
                discovery_urls: vec![url.to_owned()],
            },
            product_uri: String::new(),
            security: vec!["None".to_owned()],
        })
    }

    #[test]
    fn the_hosts_of_a_network_are_tried_and_not_the_network() {
        assert_eq!(all("10.0.0.7/30"), ["10.0.0.5", "10.0.0.6"]);
        assert_eq!(all("10.0.0.7/31"), ["10.0.0.6", "10.0.0.7"]);
        assert_eq!(all("10.0.0.7"), ["10.0.0.7"]);
        assert_eq!(range("10.1.2.3/16").unwrap().hosts(), 65_534);
        let last: Vec<String> = all("255.255.255.255/24");
        assert_eq!(last.last().map(String::as_str), Some("255.255.255.254"));
    }

    #[test]
    fn what_is_wider_or_no_range_is_refused() {
        assert_eq!(range("10.0.0.0/15"), Err(RangeFault::Wide(15)));
        assert_eq!(range("0.0.0.0/0"), Err(RangeFault::Wide(0)));
        for text in [
            "",
            "10.0.0",
            "10.0.0.0/33",
            "10.0.0.0/",
            "10.0.0.0/-1",
            "::1/128",
            "a/24",
        ] {
            assert_eq!(range(text), Err(RangeFault::Malformed(text.to_owned())));
        }
    }

    #[test]
    fn a_server_with_two_addresses_is_one_and_is_where_it_was_reached() {
        let place = |last: u8, port: u16| SocketAddr::from(([10, 0, 0, last], port));
        let outcome = merged(BTreeMap::from([
            (
                place(9, 4840),
                described("urn:plc", "opc.tcp://plc-7.plant.local:4840/a"),
            ),
            (
                place(10, 4840),
                described("urn:plc", "opc.tcp://plc-7.plant.local:4840/a"),
            ),
            (
                place(2, 4840),
                described("urn:other", "opc.tcp://other:4841/b"),
            ),
            (place(3, 4840), Err("refused".to_owned())),
            // Who does not say who it is is not the same as another.
            (place(20, 4840), described("", "")),
            (place(21, 4840), described("", "")),
        ]));
        let urls = outcome
            .servers
            .iter()
            .map(|one| (one.url.as_str(), one.also_at.len()));
        assert_eq!(
            urls.collect::<Vec<_>>(),
            [
                ("opc.tcp://10.0.0.2:4840", 0),
                ("opc.tcp://10.0.0.9:4840/a", 1),
                ("opc.tcp://10.0.0.20:4840", 0),
                ("opc.tcp://10.0.0.21:4840", 0),
            ]
        );
        assert_eq!(outcome.others, [(place(3, 4840), "refused".to_owned())]);
    }
}
