//! What FindServersOnNetwork lists (OPC 10000-4, 5.5.3).

use std::collections::BTreeMap;

/// A server as mDNS tells of it, resolved to a URL.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Announcement {
    /// The instance name, without the service and the domain.
    pub instance: String,
    /// `opc.tcp://host:port/path`, of the SRV record and the key `path` of the TXT record.
    pub url: String,
    /// Of the key `caps`.
    pub capabilities: Vec<String>,
}

/// A ServerOnNetwork of OPC 10000-4, 7.38.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NetworkRecord {
    /// Rises with each record and is never given again, so that a client can go on where it stopped.
    pub record_id: u32,
    /// What mDNS tells.
    pub announcement: Announcement,
}

/// Records by instance name in small letters: names of DNS differ by more than their case.
#[derive(Debug, Default)]
pub(crate) struct Network {
    records: BTreeMap<String, NetworkRecord>,
    last_id: u32,
}

impl Network {
    /// Takes a record in. One that changed gets a new id. Gives the record it takes the place of, or itself where nothing
    /// is new.
    pub(crate) fn put(&mut self, announcement: Announcement) -> Option<NetworkRecord> {
        let key = announcement.instance.to_ascii_lowercase();
        let known = self.records.get(&key);
        if let Some(known) = known.filter(|known| known.announcement == announcement) {
            return Some(known.clone());
        }
        self.last_id = self.last_id.saturating_add(1);
        let record = NetworkRecord {
            record_id: self.last_id,
            announcement,
        };
        self.records.insert(key, record)
    }

    pub(crate) fn remove(&mut self, instance: &str) -> Option<NetworkRecord> {
        self.records.remove(&instance.to_ascii_lowercase())
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

    /// Records from an id on that have all capabilities, whatever their case, in the order of their ids; `most` 0 for all.
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
