//! What a program that only announces its server reads of the packets of others: how many servers
//! there are, whether another server has its name, and when its discovery server starts.
//!
//! Packets without these contents cost a pass over their records, and no memory.

use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hasher as _};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

use mdns_sd::MDNS_PORT;
use registry::AnnouncedServer;
use tokio::time::Instant;

use crate::announcement::{Aside, ServerRecords, same_place};
use crate::group::{OPCUA_TCP, instance_of};
use crate::interface::Subnets;
use crate::own::SERVERS_AT_FULL_RATE;
use crate::packet::{DnsName, DnsPacket, DnsRecord};
use crate::url::Url;

/// The servers of other programs on the network.
#[derive(Debug, Default)]
pub(crate) struct NearbyServers {
    /// The last announcement of each server, by the hash of its name.
    heard: BTreeMap<u64, Instant>,
    /// The discovery server of this program.
    heeded: Option<HeededServer>,
}

/// The discovery server that this program follows.
#[derive(Debug)]
struct HeededServer {
    url: String,
    port: u16,
    last: Option<(AnnouncedServer, Aside, Instant)>,
}

/// A content of a packet that concerns this program.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Sighting {
    /// The heeded server was announced for the first time, with changes, or after a pause.
    Heeded {
        announcement: AnnouncedServer,
        aside: Aside,
    },
    /// The heeded server said goodbye.
    Left {
        /// The instance name of the server.
        instance: String,
    },
    /// A name of this program is announced with another port or host name.
    Rival { announcement: AnnouncedServer },
    /// A program on the network may need the announcements of this program.
    Newcomer,
}

impl NearbyServers {
    /// Reads the announcements of the server with this URL, or of none.
    pub(crate) fn heed(&mut self, url: Option<&str>) {
        self.heeded = url.and_then(|url| {
            Some(HeededServer {
                url: url.to_owned(),
                port: Url::parse(url)?.port,
                last: None,
            })
        });
    }

    /// Returns whether another server was announced with this name in the last minutes.
    pub(crate) fn knows(&self, name: &str) -> bool {
        self.heard.contains_key(&hash(name.as_bytes()))
    }

    /// Returns the number of servers that were announced in the last minutes.
    pub(crate) fn count(&self) -> usize {
        self.heard.len()
    }

    /// Removes the servers that were not announced for longer than their records are valid.
    pub(crate) fn forget(&mut self, now: Instant) {
        self.heard
            .retain(|_, at| now.saturating_duration_since(*at) < VALID);
    }

    /// Reads a packet of a host in the subnets. `own` returns the port and the host name in the
    /// announcement of a name of this program.
    pub(crate) fn take<'o>(
        &mut self,
        (packet, from): (&[u8], SocketAddr),
        own: impl Fn(&str) -> Option<(u16, &'o str)>,
        subnets: &Subnets,
        now: Instant,
    ) -> Vec<Sighting> {
        let IpAddr::V4(sender) = from.ip().to_canonical() else {
            return Vec::new();
        };
        let packet = DnsPacket::new(packet).filter(|_| subnets.contains(sender));
        let Some(packet) = packet else {
            return Vec::new();
        };
        if !packet.is_response() {
            // The response is sent to the port of the query, where its sender may not listen.
            let mut asked = packet.questions();
            let asks = from.port() != MDNS_PORT && asked.any(|name| name.is(&OPCUA_TCP));
            return asks.then_some(Sighting::Newcomer).into_iter().collect();
        }
        let mut seen = Vec::new();
        let mut descriptions = MOST_DESCRIPTIONS;
        for record in packet.records() {
            let Some(server) = ServerName::of(&record) else {
                continue;
            };
            if record.is_withdrawn {
                seen.extend(self.left(server.label));
                continue;
            }
            // Each description is another pass over the records.
            let mut described = || {
                descriptions = descriptions.checked_sub(1)?;
                described((packet, sender), &record, subnets)
            };
            let name = std::str::from_utf8(server.label).ok();
            if let Some(own) = name.and_then(&own) {
                let rival = (!server.is_at(own)).then(&mut described).flatten();
                seen.extend(rival.map(|described| Sighting::Rival {
                    announcement: described.announcement,
                }));
                continue;
            }
            if self.hear(server.label, now) && is_to_be_told(from.port(), self.count()) {
                seen.push(Sighting::Newcomer);
            }
            let heeded = self.heeded.as_ref();
            if heeded.is_some_and(|heeded| heeded.port == server.port) {
                seen.extend(described().and_then(|told| self.heeded_told(told, now)));
            }
        }
        seen
    }

    /// Records an announcement. Returns whether the server is new.
    fn hear(&mut self, label: &[u8], now: Instant) -> bool {
        let key = hash(label);
        if let Some(at) = self.heard.get_mut(&key) {
            *at = now;
            return false;
        }
        let has_room = self.heard.len() < MOST;
        if has_room {
            self.heard.insert(key, now);
        }
        has_room
    }

    /// Records a goodbye. Returns a sighting if it is that of the heeded server.
    fn left(&mut self, label: &[u8]) -> Option<Sighting> {
        self.heard.remove(&hash(label));
        let last = &mut self.heeded.as_mut()?.last;
        // The server has ended, so its next announcement is a restart.
        let (known, ..) = last.take_if(|(known, ..)| {
            let instance = known.instance.as_bytes();
            instance.eq_ignore_ascii_case(label)
        })?;
        Some(Sighting::Left {
            instance: known.instance,
        })
    }

    /// Returns an announcement of the heeded server, unless it repeats the last announcement.
    fn heeded_told(&mut self, described: ServerInPacket, now: Instant) -> Option<Sighting> {
        let ServerInPacket {
            announcement,
            aside,
            has_texts,
        } = described;
        let heeded = self.heeded.as_mut()?;
        if !has_texts || !same_place(&heeded.url, &announcement.url) {
            return None;
        }
        let last = heeded
            .last
            .replace((announcement.clone(), aside, now))
            .filter(|(.., at)| now.saturating_duration_since(*at) < VALID);
        let is_repeated =
            last.is_some_and(|(known, beside, _)| (known, beside) == (announcement.clone(), aside));
        (!is_repeated).then_some(Sighting::Heeded {
            announcement,
            aside,
        })
    }
}

/// The name of a server in its SRV record, and its port and host name.
struct ServerName<'p> {
    label: &'p [u8],
    port: u16,
    host: DnsName<'p>,
}

impl<'p> ServerName<'p> {
    /// Returns `None` for records of other types and of other services.
    fn of(record: &DnsRecord<'p>) -> Option<Self> {
        let (port, host) = record.server()?;
        let (label, service) = record.owner.split_first()??;
        service.is(&OPCUA_TCP).then_some(Self { label, port, host })
    }

    /// Returns whether the server has this port and this host name.
    fn is_at(&self, (port, host): (u16, &str)) -> bool {
        let name = self.host.text();
        self.port == port && name.is_some_and(|name| name.eq_ignore_ascii_case(host))
    }
}

/// Returns whether a new server is a reason to announce the servers of this program soon. A server
/// that sends from the port of mDNS receives the responses to its queries. Others may not receive
/// them.
fn is_to_be_told(from_port: u16, servers: usize) -> bool {
    from_port != MDNS_PORT || u32::try_from(servers).is_ok_and(|few| few <= SERVERS_AT_FULL_RATE)
}

/// The announcement of a server in one packet.
struct ServerInPacket {
    announcement: AnnouncedServer,
    aside: Aside,
    /// Whether the packet has the texts of the server, which complete its URL.
    has_texts: bool,
}

/// Reads the announcement of a server from one packet. If the packet has no address of the host,
/// the address of the sender is used: some programs announce their addresses in another packet.
fn described(
    (packet, sender): (DnsPacket<'_>, Ipv4Addr),
    server: &DnsRecord<'_>,
    subnets: &Subnets,
) -> Option<ServerInPacket> {
    let (port, host) = server.server()?;
    let valid = || packet.records().filter(|record| !record.is_withdrawn);
    let is_text = |record: &DnsRecord<'_>| record.is_text() && record.owner.is_same(server.owner);
    let texts = valid().find(is_text);
    let of_host = valid().filter(|record| record.owner.is_same(host));
    let mut addresses: Vec<_> = of_host.filter_map(|record| record.address()).collect();
    if addresses.is_empty() {
        addresses.push(sender);
    }
    let records = ServerRecords {
        instance: instance_of(server.owner)?,
        addresses,
        port,
    };
    let text = |key: &str| texts.and_then(|texts| texts.text(key));
    let (announcement, aside) = records.announcement(text, subnets)?;
    Some(ServerInPacket {
        announcement,
        aside,
        has_texts: texts.is_some(),
    })
}

fn hash(label: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    for byte in label {
        hasher.write_u8(byte.to_ascii_lowercase());
    }
    hasher.finish()
}

/// The lifetime of the records of an address (RFC 6762, 10), and some time for a late
/// announcement.
const VALID: Duration = Duration::from_secs(150);
/// Maximum number of descriptions that are read from a packet.
const MOST_DESCRIPTIONS: u32 = 4;
/// Maximum number of stored servers.
const MOST: usize = 4096;

#[cfg(test)]
mod tests;
