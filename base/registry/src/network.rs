//! The records of FindServersOnNetwork (OPC 10000-4, 5.5.3).

use std::collections::BTreeMap;
use std::time::Instant;

/// A server as announced by mDNS, resolved to a URL.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AnnouncedServer {
    /// The instance name, without the service and the domain.
    pub instance: String,
    /// `opc.tcp://host:port/path`, from the SRV record and the key `path` of the TXT record.
    pub url: String,
    /// Capabilities, from the key `caps`.
    pub capabilities: Vec<String>,
}

/// A ServerOnNetwork of OPC 10000-4, 7.38.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NetworkRecord {
    /// Ascending and never reused, so that a client can continue after the last record.
    pub record_id: u32,
    /// The announcement.
    pub announcement: AnnouncedServer,
    /// The source of the announcement.
    pub source: RecordSource,
}

/// Source of a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RecordSource {
    /// The server registered here, and this program announces it.
    Registration,
    /// mDNS.
    Multicast,
    /// A Global Discovery Server lists the server, and the server answers.
    Gds,
}

impl RecordSource {
    /// Returns the label for logs and the status.
    #[must_use]
    pub fn label(self) -> &'static str {
        match self {
            Self::Registration => "registration",
            Self::Multicast => "multicast",
            Self::Gds => "gds",
        }
    }
}

/// Records by instance name in lower case: names of DNS that differ only in case are equal.
#[derive(Debug, Default)]
pub(crate) struct NetworkRecords {
    records: BTreeMap<String, NetworkRecord>,
    /// First announcement of each name.
    arrivals: BTreeMap<String, FirstAnnouncement>,
    last_arrival: u64,
    last_id: u32,
}

/// First announcement of a name, and the endpoint of its server.
#[derive(Debug)]
pub(crate) struct FirstAnnouncement {
    /// Ascending with each name.
    pub(crate) order: u64,
    pub(crate) since: Instant,
    /// The [`place`] of its URL.
    pub(crate) place: String,
}

impl NetworkRecords {
    /// Adds a record. A changed record gets a new id. Returns the replaced record, or the record
    /// itself if it is unchanged.
    pub(crate) fn put(
        &mut self,
        announcement: AnnouncedServer,
        source: RecordSource,
        now: Instant,
    ) -> Option<NetworkRecord> {
        let key = announcement.instance.to_ascii_lowercase();
        let place = place(&announcement.url);
        if let Some(arrival) = self.arrivals.get_mut(&key) {
            arrival.place = place;
        } else {
            self.last_arrival += 1;
            let arrival = FirstAnnouncement {
                order: self.last_arrival,
                since: now,
                place,
            };
            self.arrivals.insert(key.clone(), arrival);
        }
        let known = self.records.get(&key);
        let is_same =
            |known: &&NetworkRecord| known.announcement == announcement && known.source == source;
        if let Some(known) = known.filter(is_same) {
            return Some(known.clone());
        }
        self.last_id = self.last_id.saturating_add(1);
        let record = NetworkRecord {
            record_id: self.last_id,
            announcement,
            source,
        };
        self.records.insert(key, record)
    }

    pub(crate) fn remove(&mut self, instance: &str) -> Option<NetworkRecord> {
        let key = instance.to_ascii_lowercase();
        self.arrivals.remove(&key);
        self.records.remove(&key)
    }

    /// Returns all records with their arrivals.
    pub(crate) fn arrivals(&self) -> impl Iterator<Item = (&NetworkRecord, &FirstAnnouncement)> {
        // Both have the same keys.
        self.records.values().zip(self.arrivals.values())
    }

    /// Returns whether a name is not the first announced name of its endpoint.
    pub(crate) fn is_further(&self, instance: &str) -> bool {
        let own = self.arrivals.get(&instance.to_ascii_lowercase());
        own.is_some_and(|own| {
            let mut all = self.arrivals.values();
            all.any(|other| other.place == own.place && other.order < own.order)
        })
    }

    pub(crate) fn get(&self, instance: &str) -> Option<&NetworkRecord> {
        self.records.get(&instance.to_ascii_lowercase())
    }

    pub(crate) fn len(&self) -> usize {
        self.records.len()
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = &NetworkRecord> {
        self.records.values()
    }

    /// Returns the records from an id on that have all capabilities, regardless of case, in the
    /// order of their ids. `most` limits their number; 0 selects all.
    pub(crate) fn find(&self, from: u32, most: u32, capabilities: &[&str]) -> Vec<&NetworkRecord> {
        let mut found: Vec<_> = self
            .records
            .values()
            .filter(|record| record.record_id >= from && record.has(capabilities))
            .collect();
        found.sort_by_key(|record| record.record_id);
        if most > 0 {
            found.truncate(usize::try_from(most).unwrap_or(usize::MAX));
        }
        found
    }
}

impl NetworkRecord {
    fn has(&self, wanted: &[&str]) -> bool {
        let has = &self.announcement.capabilities;
        wanted
            .iter()
            .all(|wanted| has.iter().any(|has| has.eq_ignore_ascii_case(wanted)))
    }
}

/// Returns the endpoint that a URL is served at: scheme, host in lower case and port, without the
/// path.
pub(crate) fn place(url: &str) -> String {
    let (scheme, rest) = url.split_once("://").unwrap_or(("", url));
    let authority = rest.split('/').next().unwrap_or_default();
    let authority = authority.to_ascii_lowercase();
    let has_port = match authority.rsplit_once(':') {
        Some((_, port)) => port.bytes().all(|byte| byte.is_ascii_digit()),
        None => false,
    };
    if has_port {
        format!("{scheme}://{authority}")
    } else {
        format!("{scheme}://{authority}:{DEFAULT_PORT}")
    }
}

/// Returns the host of a [`place`].
pub(crate) fn host(place: &str) -> &str {
    place.rsplit_once(':').map_or(place, |(host, _)| host)
}

/// The default port of OPC UA over TCP (OPC 10000-6, 7.2).
const DEFAULT_PORT: u16 = 4840;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_of_one_host_and_port_are_one_place() {
        for (url, wanted) in [
            ("opc.tcp://PC:4841/a", "opc.tcp://pc:4841"),
            ("opc.tcp://pc", "opc.tcp://pc:4840"),
            ("opc.tcp://[fe80::1]/", "opc.tcp://[fe80::1]:4840"),
            ("opc.tcp://[fe80::1]:7/b", "opc.tcp://[fe80::1]:7"),
        ] {
            assert_eq!(place(url), wanted);
        }
        assert_eq!(host(&place("opc.tcp://[fe80::1]:7")), "opc.tcp://[fe80::1]");
    }
}
