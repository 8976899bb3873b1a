//! The servers of a level, from all sources: a server may be registered, announce itself, and be
//! announced by other programs.

use std::collections::BTreeMap;

/// Change of the roster.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RosterChange {
    /// A server is available at this URL.
    Joined(String),
    /// The server at this URL is no longer available.
    Left(String),
}

/// The servers of a level by source. URLs that differ only by a trailing slash are equal.
#[derive(Debug)]
pub struct Roster {
    told: BTreeMap<String, String>,
    most: usize,
}

impl Roster {
    /// Creates an empty roster with at most `most` servers.
    #[must_use]
    pub fn new(most: usize) -> Self {
        Self {
            told: BTreeMap::new(),
            most,
        }
    }

    /// Sets the server of a source, such as an ApplicationUri or an mDNS name, in place of its
    /// previous server.
    pub fn put(&mut self, source: &str, url: &str) -> Vec<RosterChange> {
        let url = url.trim_end_matches('/').to_owned();
        if self.told.get(source) == Some(&url) {
            return Vec::new();
        }
        let mut changes = self.remove(source);
        if self.told.len() < self.most {
            if !self.told.values().any(|known| *known == url) {
                changes.push(RosterChange::Joined(url.clone()));
            }
            self.told.insert(source.to_owned(), url);
        }
        changes
    }

    /// Removes the server of a source.
    pub fn remove(&mut self, source: &str) -> Vec<RosterChange> {
        let Some(url) = self.told.remove(source) else {
            return Vec::new();
        };
        if self.told.values().any(|known| *known == url) {
            Vec::new()
        } else {
            vec![RosterChange::Left(url)]
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_is_there_until_nobody_tells_of_it() {
        let mut roster = Roster::new(3);
        let joined = |url: &str| vec![RosterChange::Joined(url.to_owned())];
        let left = |url: &str| vec![RosterChange::Left(url.to_owned())];
        assert_eq!(
            roster.put("urn:arm", "opc.tcp://a:1/"),
            joined("opc.tcp://a:1")
        );
        assert!(roster.put("arm", "opc.tcp://a:1").is_empty(), "the same");
        assert!(roster.remove("urn:arm").is_empty());
        let moved = roster.put("arm", "opc.tcp://a:2");
        assert_eq!(
            moved,
            [left("opc.tcp://a:1"), joined("opc.tcp://a:2")].concat()
        );
        assert_eq!(roster.remove("arm"), left("opc.tcp://a:2"));
        assert!(roster.remove("arm").is_empty());
        for at in 0..3 {
            assert_eq!(roster.put(&at.to_string(), &format!("u{at}")).len(), 1);
        }
        assert!(roster.put("3", "u3").is_empty(), "there is no room");
    }
}
