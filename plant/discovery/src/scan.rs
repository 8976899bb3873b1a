//! Finds servers without announcement by a scan of addresses.
//!
//! A scan connects, sends GetEndpoints and disconnects: it opens no session and changes nothing.
//! The number of addresses, of concurrent connections and of connections per second is limited. A
//! scan runs only on request of the user.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use mdns::Url;
pub use mdns::{Range, RangeFault};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, timeout};

use crate::client::{DiscoveryQueryFault, SelfDescription, describe};

/// The limits of a scan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ScanLimits {
    /// Maximum number of new connections per second, at least 1.
    pub per_second: u32,
    /// Maximum number of concurrent connections, at least 1.
    pub at_once: usize,
    /// The timeout of a connection.
    pub connect: Duration,
    /// The timeout of a response.
    pub answer: Duration,
}

impl Default for ScanLimits {
    fn default() -> Self {
        Self {
            per_second: 200,
            at_once: 64,
            connect: Duration::from_millis(700),
            answer: Duration::from_secs(3),
        }
    }
}

/// A server that the scan found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Scanned {
    /// The URL: the scanned address with the path that the server reports.
    pub url: String,
    /// The other URLs of the same server.
    pub also_at: Vec<String>,
    /// The self-description of the server.
    pub described: SelfDescription,
}

/// The result of a scan.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct ScanOutcome {
    /// The servers, one per ApplicationUri, ordered by address.
    pub servers: Vec<Scanned>,
    /// Addresses with a listener that is not an OPC UA server, with the reason, ordered by address.
    pub others: Vec<(SocketAddr, String)>,
    /// The number of scanned addresses.
    pub tried: u32,
}

/// Scans these ports of all addresses.
pub async fn scan(ranges: &[Range], ports: &[u16], pace: ScanLimits) -> ScanOutcome {
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

/// The self-description of a server, or the reason why a listener did not answer.
type Tried = Result<SelfDescription, DiscoveryQueryFault>;

/// Scans an address; `None` without a listener.
async fn try_one(place: SocketAddr, pace: ScanLimits) -> Option<Tried> {
    let connected = timeout(pace.connect, TcpStream::connect(place)).await;
    drop(connected.ok()?.ok()?);
    let url = Url::of(place.ip(), place.port(), "").to_string();
    Some(describe(&url, pace.answer).await)
}

/// Merges the results by ApplicationUri.
fn merged(told: BTreeMap<SocketAddr, Tried>) -> ScanOutcome {
    let mut outcome = ScanOutcome::default();
    for (place, tried) in told {
        let described = match tried {
            Ok(described) => described,
            Err(fault) => {
                outcome.others.push((place, fault.to_string()));
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

/// Returns the URL of a scanned address, with the path that the server reports for this port.
/// Reported host names cannot always be resolved.
fn reached(ip: IpAddr, port: u16, described: &SelfDescription) -> String {
    let told = described.application.discovery_urls.iter();
    let mut told = told.filter_map(|url| Url::parse(url));
    let path = told.find(|url| url.port == port).map(|url| url.path);
    Url::of(ip, port, path.as_deref().unwrap_or_default()).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::client::FoundServer;

    fn described(uri: &str, url: &str) -> Tried {
        Ok(SelfDescription {
            application: FoundServer {
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
            (
                place(3, 4840),
                Err(DiscoveryQueryFault::Protocol("refused".to_owned())),
            ),
            // Servers without ApplicationUri are not merged.
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
