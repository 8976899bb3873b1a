//! Finds programs and servers: from announcements, discovery servers, the PubSub group, and scanned
//! addresses if the user requests a scan.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use discovery::client::{FoundServer, describe, find_servers, find_servers_on_network};
use discovery::scan::{ScanLimits, ScanOutcome, scan};
use discovery::{DEFAULT_LDS, MdnsInterface, PresentServer, ServerChange, WatchSettings, watch};
use mdns::{HeardBridge, heard_bridges};
use tokio::signal::ctrl_c;
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::entry::{DiscoveredEntry, DiscoveredKind, DiscoveryMethod, merged};
use crate::arguments::DiscoverArguments;
use crate::exit::CommandFailure;
use crate::live::{self, InGroup};
use crate::report::warn;

/// The result of a discovery.
pub(crate) struct DiscoveryResult {
    pub(crate) entries: Vec<DiscoveredEntry>,
    /// The number of scanned addresses, if there was a scan.
    pub(crate) tried: Option<u32>,
}

/// Discovers programs and servers. Ctrl-C ends it with [`CommandFailure::Interrupted`].
pub(crate) async fn around(look: &DiscoverArguments) -> Result<DiscoveryResult, CommandFailure> {
    let hearing = live::in_the_group(&look.group, look.seconds);
    let (found, heard) = around_and(look, hearing).await?;
    if let Err(failure) = heard {
        warn(&format!("the group is not heard: {failure}"));
    }
    Ok(found)
}

/// Discovers programs and servers together with a given listener in the group.
pub(crate) async fn around_and<T>(
    look: &DiscoverArguments,
    hearing: impl Future<Output = Result<(InGroup, T), CommandFailure>>,
) -> Result<(DiscoveryResult, Result<T, CommandFailure>), CommandFailure> {
    tokio::select! {
        found = Box::pin(gathered(look, hearing)) => Ok(found),
        _ = ctrl_c() => Err(CommandFailure::Interrupted),
    }
}

async fn gathered<T>(
    look: &DiscoverArguments,
    hearing: impl Future<Output = Result<(InGroup, T), CommandFailure>>,
) -> (DiscoveryResult, Result<T, CommandFailure>) {
    let limit = Duration::from_secs_f64(look.seconds);
    let pace = ScanLimits {
        per_second: look.rate,
        ..ScanLimits::default()
    };
    let scanning = async {
        match look.scan.as_slice() {
            [] => None,
            ranges => Some(scan(ranges, &look.port, pace).await),
        }
    };
    let (heard, bridges, in_group, scanned) =
        tokio::join!(heard(look, limit), told(look, limit), hearing, scanning);
    let mut found: Vec<DiscoveredEntry> = Vec::new();
    let mut asked: BTreeSet<String> = look.lds.iter().cloned().collect();
    asked.insert(DEFAULT_LDS.to_owned());
    for known in &heard {
        if known.is_lds() {
            asked.insert(known.url.clone());
        }
    }
    let tried = scanned.as_ref().map(|scanned| scanned.tried);
    for entry in scanned.into_iter().flat_map(of_scan) {
        if entry.kind == DiscoveredKind::Lds {
            asked.extend(entry.urls.first().cloned());
        }
        found.push(entry);
    }
    let mut places: Vec<ServerLocation> = heard.into_iter().map(ServerLocation::of_mdns).collect();
    places.extend(listed(look, asked).await);
    found.extend(reached(places).await);
    found.extend(bridges.into_iter().map(of_bridge));
    let heard = in_group.map(|(in_group, rest)| {
        found.extend(in_group.applications.iter().map(application));
        found.extend(in_group.senders.into_iter().map(bridge));
        rest
    });
    let around = DiscoveryResult {
        entries: merged(found),
        tried,
    };
    (around, heard)
}

fn interfaces(look: &DiscoverArguments) -> impl Iterator<Item = MdnsInterface> + use<> {
    let interfaces = match &look.group.interface {
        Some(interface) => vec![MdnsInterface::parse(interface)],
        None => MdnsInterface::all(),
    };
    interfaces.into_iter().take(MOST_INTERFACES)
}

/// Returns the bridges announced on the network.
async fn told(look: &DiscoverArguments, limit: Duration) -> Vec<HeardBridge> {
    let mut hearing = JoinSet::new();
    for interface in interfaces(look) {
        hearing.spawn(async move { heard_bridges(&interface, limit).await });
    }
    // Interfaces without mDNS are reported by the search for servers.
    let all = hearing.join_all().await;
    all.into_iter().flatten().flatten().collect()
}

/// Returns the servers announced on the network.
async fn heard(look: &DiscoverArguments, limit: Duration) -> Vec<PresentServer> {
    let mut hearing = JoinSet::new();
    for interface in interfaces(look) {
        let settings = WatchSettings {
            mdns: Some(interface.clone()),
            ..WatchSettings::default()
        };
        match watch(settings) {
            Ok(mut watcher) => {
                hearing.spawn(async move {
                    let mut known = BTreeMap::new();
                    let all = async {
                        while let Some(found) = watcher.next().await {
                            let name = found.known().name.clone();
                            match found {
                                ServerChange::Seen(one) | ServerChange::Restarted(one) => {
                                    known.insert(name, one);
                                }
                                ServerChange::Gone { .. } => {
                                    known.remove(&name);
                                }
                            }
                        }
                    };
                    // The search ends at the limit.
                    let _over = timeout(limit, all).await;
                    known.into_values().collect::<Vec<PresentServer>>()
                });
            }
            Err(fault) => warn(&format!("mDNS is not heard on {interface}: {fault}")),
        }
    }
    hearing.join_all().await.into_iter().flatten().collect()
}

/// The announced or listed location of a server.
struct ServerLocation {
    by: DiscoveryMethod,
    url: String,
    name: String,
    capabilities: Vec<String>,
    is_lds: bool,
    uri: String,
    /// The host of the discovery server that listed the server, which is also the host of the
    /// servers registered with it.
    host: Option<String>,
}

impl ServerLocation {
    fn of_mdns(known: PresentServer) -> Self {
        Self {
            by: DiscoveryMethod::Mdns,
            is_lds: known.is_lds(),
            url: known.url,
            name: known.name,
            capabilities: known.capabilities,
            uri: known.application_uri.unwrap_or_default(),
            host: None,
        }
    }

    fn of_lds(lds: &str, application: FoundServer) -> Option<Self> {
        let mut urls = application.discovery_urls.into_iter();
        Some(Self {
            by: DiscoveryMethod::Lds,
            url: urls.find(|url| url.starts_with("opc.tcp://"))?,
            name: application.name,
            capabilities: Vec::new(),
            is_lds: application.is_discovery_server,
            uri: application.application_uri,
            host: host(lds),
        })
    }

    /// Requests the description of the server.
    async fn reached(self) -> DiscoveredEntry {
        let first = describe(&self.url, ANSWER).await;
        // The host name in the URL may not resolve on this host.
        let elsewhere = self.host.as_deref().and_then(|host| moved(&self.url, host));
        let (url, described) = match (first, elsewhere) {
            (Err(fault), Some(url)) => match describe(&url, ANSWER).await {
                Ok(described) => (url, Ok(described)),
                Err(_) => (self.url, Err(fault)),
            },
            (first, _) => (self.url, first),
        };
        let mut entry = DiscoveredEntry::new(DiscoveredKind::Server, self.by, url);
        entry.name = self.name;
        entry.uri = self.uri;
        entry.capabilities.extend(self.capabilities);
        match described {
            Ok(told) => {
                entry.kind = DiscoveredKind::of_product(&told.product_uri);
                entry.security = told.security;
                let application = told.application;
                if !application.application_uri.is_empty() {
                    entry.uri = application.application_uri;
                }
                if !application.name.is_empty() {
                    entry.name = application.name;
                }
                if application.is_discovery_server {
                    entry.kind = DiscoveredKind::Lds;
                }
            }
            Err(fault) => entry.fault = Some(fault.to_string()),
        }
        if self.is_lds {
            entry.kind = DiscoveredKind::Lds;
        }
        entry
    }
}

/// Returns the servers that the discovery servers list.
async fn listed(look: &DiscoverArguments, asked: BTreeSet<String>) -> Vec<ServerLocation> {
    let mut asking = JoinSet::new();
    for url in asked.into_iter().take(MOST_LDS) {
        asking.spawn(async move {
            let (registered, announced) = tokio::join!(
                find_servers(&url, ANSWER),
                find_servers_on_network(&url, ANSWER)
            );
            (url, registered, announced)
        });
    }
    let mut places = Vec::new();
    for (url, registered, announced) in asking.join_all().await {
        match registered {
            Ok(all) => places.extend(
                all.into_iter()
                    .filter_map(|one| ServerLocation::of_lds(&url, one)),
            ),
            Err(fault) if look.lds.contains(&url) => {
                warn(&format!("the discovery server {url} is not there: {fault}"));
            }
            Err(_) => {}
        }
        // A server that is not a discovery server has no such list.
        for one in announced.into_iter().flatten() {
            places.push(ServerLocation {
                by: DiscoveryMethod::Lds,
                is_lds: one.capabilities.iter().any(|code| code == "LDS"),
                url: one.url,
                name: one.name,
                capabilities: one.capabilities,
                uri: String::new(),
                host: None,
            });
        }
    }
    places
}

async fn reached(places: Vec<ServerLocation>) -> Vec<DiscoveredEntry> {
    let mut waiting = places.into_iter().take(MOST_PLACES);
    let mut asking = JoinSet::new();
    let mut found = Vec::new();
    loop {
        while asking.len() < AT_ONCE
            && let Some(place) = waiting.next()
        {
            asking.spawn(place.reached());
        }
        match asking.join_next().await {
            Some(Ok(entry)) => found.push(entry),
            Some(Err(_)) => {}
            None => return found,
        }
    }
}

fn of_scan(scanned: ScanOutcome) -> Vec<DiscoveredEntry> {
    let servers = scanned.servers.into_iter().map(|one| {
        let told = one.described;
        let kind = if told.application.is_discovery_server {
            DiscoveredKind::Lds
        } else {
            DiscoveredKind::of_product(&told.product_uri)
        };
        let mut entry = DiscoveredEntry::new(kind, DiscoveryMethod::Scan, one.url);
        entry.urls.extend(one.also_at);
        entry.name = told.application.name;
        entry.uri = told.application.application_uri;
        entry.security = told.security;
        entry
    });
    let others = scanned.others.into_iter().map(|(place, why)| {
        let mut entry = DiscoveredEntry::new(
            DiscoveredKind::Other,
            DiscoveryMethod::Scan,
            format!("opc.tcp://{place}"),
        );
        entry.fault = Some(why);
        entry
    });
    servers.chain(others).collect()
}

fn bridge(((space, from), topics): ((u16, String), usize)) -> DiscoveredEntry {
    let mut entry = DiscoveredEntry::new(DiscoveredKind::Bridge, DiscoveryMethod::Group, from);
    entry.name = match space {
        1 => "space 1 (ROS 1)".to_owned(),
        space => format!("space {space} (ROS 2)"),
    };
    entry.space = Some(space);
    entry.topics = Some(topics);
    entry
}

fn of_bridge(heard: HeardBridge) -> DiscoveredEntry {
    let HeardBridge { name, bridge, .. } = heard;
    let mut entry = DiscoveredEntry::new(
        DiscoveredKind::Bridge,
        DiscoveryMethod::Mdns,
        heard.host.to_string(),
    );
    entry.name = name;
    entry.uri = bridge.uri;
    entry.space = Some(bridge.space);
    entry.group = Some(bridge.group.to_string());
    entry
}

/// Returns the entry of an application announced in the group. An application without URLs is not a
/// server.
fn application(
    ((space, from), told): (&(u16, String), &live::AnnouncedProgram),
) -> DiscoveredEntry {
    let kind = if told.urls.is_empty() {
        DiscoveredKind::Bridge
    } else {
        DiscoveredKind::of_product(&told.product_uri)
    };
    let mut entry = DiscoveredEntry::new(kind, DiscoveryMethod::Group, from.clone());
    if !told.urls.is_empty() {
        entry.urls.clone_from(&told.urls);
    }
    entry.name.clone_from(&told.name);
    entry.uri.clone_from(&told.uri);
    entry.capabilities.extend(told.capabilities.iter().cloned());
    entry.space = Some(*space);
    entry
}

/// Returns the host of a URL, with the brackets of an IPv6 address.
fn host(url: &str) -> Option<String> {
    let place = url.strip_prefix("opc.tcp://")?.split('/').next()?;
    let host = match place.rsplit_once(':') {
        Some((host, port)) if !port.contains(']') => host,
        Some(_) | None => place,
    };
    Some(host.to_owned())
}

/// Returns the URL with its host replaced.
fn moved(url: &str, to: &str) -> Option<String> {
    let from = host(url)?;
    let rest = url.strip_prefix("opc.tcp://")?.strip_prefix(&from)?;
    (from != to).then(|| format!("opc.tcp://{to}{rest}"))
}

const ANSWER: Duration = Duration::from_secs(3);
const AT_ONCE: usize = 32;
const MOST_PLACES: usize = 4_096;
const MOST_LDS: usize = 64;
const MOST_INTERFACES: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_url_keeps_its_port_and_path_at_another_host() {
        assert_eq!(
            moved("opc.tcp://plc-7:4841/a", "10.0.0.7").as_deref(),
            Some("opc.tcp://10.0.0.7:4841/a")
        );
        assert_eq!(
            moved("opc.tcp://[fe80::1]:1", "b").as_deref(),
            Some("opc.tcp://b:1")
        );
        assert_eq!(moved("opc.tcp://b", "b"), None);
        assert_eq!(host("opc.tcp://[::1]").as_deref(), Some("[::1]"));
    }
}
