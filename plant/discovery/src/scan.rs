//! Servers that announce themselves to nobody, found by trying addresses.
//!
//! It connects, asks who is there (GetEndpoints) and leaves: it opens no session and changes nothing. How many addresses are
//! tried, how many at once and how many a second is bounded. It is never done unless somebody asks for it.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use mdns::Url;
pub use mdns::{Range, RangeFault};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, timeout};

use crate::client::{Described, describe};

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::client::Application;

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
